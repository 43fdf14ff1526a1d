"""Calls of LAPACK one after another, where JAX lets them block each other.

On CPUs, JAX 0.10 shares out the matrices of a batch between the threads of XLA's pool, and
the thread that calls LAPACK waits for the others. XLA runs operations that do not depend on
each other at the same time, in the same pool. Once every thread of the pool waits in a call
of LAPACK, no thread is left to do the work, and the program never returns. On two cores,
two calls suffice. JAX 0.11.2 computes a batch in the thread that calls.

Options of XLA only make such a deadlock rarer. So here each call is made to depend on the
results of the call before, and no two calls ever run at the same time.

This module, `has_blocking_lapack` and the uses of `lapack_in_turn` can go as soon as
`pyproject.toml` asks for JAX 0.11.2 or later.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from ._compat import (
    CALLS,
    ClosedJaxpr,
    has_blocking_lapack,
    is_program,
    Jaxpr,
    programs_in,
    results_of_operation,
    results_of_program,
)


# The operations that JAX leaves to LAPACK on CPUs.
LAPACK = frozenset(
    "cholesky eig eigh geqp3 geqrf hessenberg householder_product lu qr schur svd "
    "symmetric_product triangular_solve tridiagonal tridiagonal_solve".split()
)
_CONTROL_FLOW = frozenset({"cond", "scan", "while"})


def lapack_in_turn(fn: Callable) -> Callable:
    """`fn`, with its calls of LAPACK one after another where this version of JAX needs it.
    The results are the same. `fn` may be compiled, but not transformed any further."""

    @ft.wraps(fn)
    def call(*args: Any) -> Any:
        if not has_blocking_lapack():
            return fn(*args)
        # The leaves of what `fn` returns: arrays in `dynamic`, all others in `static`.
        program, dynamic, static = eqx.filter_make_jaxpr(fn)(*args)
        arrays = jtu.tree_leaves(eqx.filter(args, eqx.is_array))
        results = _run_in_turn(program, arrays)
        treedef = jtu.tree_structure(dynamic)
        return eqx.combine(treedef.unflatten(results), static)

    return call


def _run_in_turn(program: Jaxpr | ClosedJaxpr, args: Sequence[Any]) -> list[Any]:
    """The results of a program for these arguments, operation by operation. An operation
    that contains a call of LAPACK is treated by its kind:

    - A call of a function is replaced by the operations of the function.
    - So is the solution of a linear system with derivatives of its own.
    - A call of LAPACK waits for the results of the one before.
    - So does control flow, as a whole. Inside of it, each call waits for the one before.
    """
    # The results of the last call of LAPACK, or of control flow around such calls, so far.
    results_before: Sequence[Any] = ()

    def results_of_eqn(eqn: Any, args: list[Any]) -> Sequence[Any]:
        nonlocal results_before
        if not _calls_lapack(eqn):
            return results_of_operation(eqn, args, eqn.params)
        name = eqn.primitive.name
        if name in CALLS:
            return results_of_program(eqn.params[CALLS[name]], args, results_of_eqn)
        if name == "custom_linear_solve":
            # The arguments are the constants of four functions, `matvec`, `vecmat`, `solve`
            # and `transpose_solve`, and the right-hand side. Only `solve` runs.
            lengths = eqn.params["const_lengths"]
            begin = lengths.matvec + lengths.vecmat
            constants = args[begin : begin + lengths.solve]
            args = [*constants, *args[sum(lengths) :]]
            return results_of_program(eqn.params["jaxprs"].solve, args, results_of_eqn)
        params = eqn.params
        if name in _CONTROL_FLOW:
            params = jtu.tree_map(_with_turns_inside, params, is_leaf=is_program)
        waiting_args = _with_dependence(args, results_before)
        results_before = results_of_operation(eqn, waiting_args, params)
        return results_before

    return results_of_program(program, args, results_of_eqn)


def _calls_lapack(eqn: Any) -> bool:
    """Whether an operation is one of LAPACK's or contains one."""
    if eqn.primitive.name in LAPACK:
        return True
    inner_eqns = [inner for jaxpr in programs_in(eqn) for inner in jaxpr.eqns]
    return any(map(_calls_lapack, inner_eqns))


def _with_dependence(args: list[Any], results_before: Sequence[Any]) -> list[Any]:
    """The arguments, for an operation that is to wait for all of `results_before`.

    Each argument `x` becomes `where(never, 0, x)`. Here `never` is always false, but is
    computed from an entry of each of the results, so that the operation waits for them.
    (A barrier around results and arguments would not suffice: XLA removes it before it
    decides which operations can run side by side.)"""
    if len(results_before) == 0:
        return args
    # False at the start, `never` stays false. The barrier hides this from XLA.
    never = lax.optimization_barrier(jnp.array(False))
    for x in results_before:
        if _has_numbers(x):
            never = never & (jnp.ravel(x)[0] != 0)
    return [
        jnp.where(never, jnp.zeros_like(x), x) if _has_numbers(x) else x for x in args
    ]


def _has_numbers(x: Any) -> bool:
    """Whether an array has an entry that is a number. Arrays of random keys have none."""
    is_extended = jnp.issubdtype(jnp.result_type(x), jax.dtypes.extended)
    return jnp.size(x) > 0 and not is_extended


def _with_turns_inside(param: Any) -> Any:
    """The parameter of an operation. If it is a program, it becomes one in which each call
    of LAPACK waits for the call before. The first call in it need not wait, since the
    operation as a whole waits for the calls before."""
    if not isinstance(param, ClosedJaxpr):
        return param
    structs = [variable.aval for variable in param.jaxpr.invars]
    return jax.make_jaxpr(lambda *args: _run_in_turn(param, args))(*structs)
