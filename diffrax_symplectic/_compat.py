"""The private parts of other packages that this one uses, and may change without notice.

They are used nowhere else, except for the loop of a solve, its state and that of its step
size controller in `_adjoint.py`. `tests/test_private_parts.py` tests each of them.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.core
import jax.random as jr
import jax.tree_util as jtu
import lineax as lx
from diffrax._term import AdjointTerm, WrapTerm
from equinox.internal import (
    nondifferentiable as nondifferentiable,
    nondifferentiable_backward as nondifferentiable_backward,
    while_loop as while_loop,
    ω as ω,
)
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr as dce_jaxpr
from jaxtyping import Array, PRNGKeyArray, PyTree


def is_threefry(key: PRNGKeyArray) -> bool:
    """Whether the key belongs to JAX's default generator, by its name, which is all that
    JAX tells of a generator."""
    return str(jr.key_impl(key)) == "threefry2x32"


def is_traced(x: Any) -> bool:
    """Whether this value is known only when the program runs."""
    return isinstance(x, jax.core.Tracer)


def computed_by(
    solver: lx.AbstractLinearSolver[Any],
    operator: lx.AbstractLinearOperator,
    rhs: Array,
) -> tuple[Array, lx.RESULTS]:
    """The solution of a linear system by a solver of Lineax, and whether it was found.

    `lineax.linear_solve` does the same, with derivatives that would not be used here, and
    with a longer trace.
    """
    x, result, _ = solver.compute(solver.init(operator, {}), rhs, {})
    return x, result


def unwrapped(term: diffrax.AbstractTerm) -> diffrax.AbstractTerm:
    """The user's term. In a solve Diffrax wraps it, to be able to run backward in time."""
    return term.term if isinstance(term, WrapTerm) else term


def direction(terms: PyTree[diffrax.AbstractTerm]) -> Any:
    """The sign of the direction of time in the solve that the terms come from. Terms from
    outside a solve run forward."""
    leaves = jtu.tree_leaves(terms, is_leaf=_is_wrapped)
    return next((x.direction for x in leaves if _is_wrapped(x)), 1)


def reversed_in_time(terms: PyTree[diffrax.AbstractTerm]) -> PyTree:
    """The terms of a solve with the direction of time reversed."""
    turn = lambda x: WrapTerm(x.term, -x.direction) if _is_wrapped(x) else x
    return jtu.tree_map(turn, terms, is_leaf=_is_wrapped)


def _is_wrapped(x: Any) -> bool:
    return isinstance(x, WrapTerm)


def is_adjoint_term(term: diffrax.AbstractTerm) -> bool:
    """Whether the term comes from `diffrax.BacksolveAdjoint`."""
    return isinstance(unwrapped(term), AdjointTerm)


def captured_arrays(fn: Callable, value: PyTree) -> tuple[Callable, list[Any]]:
    """`fn(value)` as a function of `value` and of the arrays that `fn` captures; and these.
    (`eqx.filter_closure_convert` checks types that `shard_map` changes.)"""
    traced, struct = jax.make_jaxpr(fn, return_shape=True)(value)
    treedef = jtu.tree_structure(struct)
    closed = lambda arrays: jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, arrays))
    call = lambda x, arrays: treedef.unflatten(closed(arrays)(*jtu.tree_leaves(x)))
    return call, traced.consts
