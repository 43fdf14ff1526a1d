"""What the package uses of other packages that these do not promise to keep.

Nothing of the kind is used anywhere else. `tests/test_private_parts.py` tests each of these
by itself.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import diffrax
import jax
import jax.tree_util as jtu
from diffrax._term import AdjointTerm, WrapTerm
from equinox.internal import (
    nondifferentiable as nondifferentiable,
    nondifferentiable_backward as nondifferentiable_backward,
    while_loop as while_loop,
    ω as ω,
)
from jax import lax
from jax.extend.core import (
    ClosedJaxpr as ClosedJaxpr,
    Jaxpr as Jaxpr,
    jaxpr_as_fun as jaxpr_as_fun,
    JaxprEqn as JaxprEqn,
)
from jax.interpreters.partial_eval import dce_jaxpr as dce_jaxpr
from jaxtyping import PyTree


def unwrapped(term: diffrax.AbstractTerm) -> diffrax.AbstractTerm:
    """The term that the user passed. In a solve Diffrax has wrapped it, to be able to go
    backward in time."""
    return term.term if isinstance(term, WrapTerm) else term


def direction(terms: PyTree[diffrax.AbstractTerm]) -> Any:
    """The sign of the direction of time in the solve that the terms come from. Terms that
    are in no solve run forward."""
    leaves = jtu.tree_leaves(terms, is_leaf=_is_wrapped)
    return next((x.direction for x in leaves if _is_wrapped(x)), 1)


def reversed_in_time(terms: PyTree[diffrax.AbstractTerm]) -> PyTree:
    """The terms of a solve, with time running the other way."""
    turn = lambda x: WrapTerm(x.term, -x.direction) if _is_wrapped(x) else x
    return jtu.tree_map(turn, terms, is_leaf=_is_wrapped)


def _is_wrapped(x: Any) -> bool:
    return isinstance(x, WrapTerm)


def is_adjoint_term(term: diffrax.AbstractTerm) -> bool:
    """Whether the term is one of those that `diffrax.BacksolveAdjoint` solves."""
    return isinstance(unwrapped(term), AdjointTerm)


def solves_without_throwing(program: Jaxpr) -> bool:
    """Whether a program calls `diffrax.diffeqsolve` with `throw=False`: whether no error is
    raised after the loop of a solve. (The programs of a gradient are a solve forward and
    one backward, of which the first may raise an error.)"""
    is_solve = lambda eqn: eqn.params.get("name") == "diffeqsolve"
    solves = [x for eqn in program.eqns if is_solve(eqn) for x in inner_programs(eqn)]
    if solves:
        return not any(map(_ends_with_an_error, solves))
    inner = [x for eqn in program.eqns for x in inner_programs(eqn)]
    return any(solves_without_throwing(getattr(x, "jaxpr", x)) for x in inner)


def _ends_with_an_error(program: ClosedJaxpr) -> bool:
    eqns = program.jaxpr.eqns
    loops = [i for i, eqn in enumerate(eqns) if _has_loop(eqn)]
    after = eqns[max(loops, default=-1) + 1 :]
    return any(eqn.params.get("name") == "branched_error_if_impl" for eqn in after)


def _has_loop(eqn: JaxprEqn) -> bool:
    if eqn.primitive.name in ("while", "scan"):
        return True
    inner = [getattr(x, "jaxpr", x) for x in inner_programs(eqn)]
    return any(_has_loop(eqn) for program in inner for eqn in program.eqns)


def inner_programs(eqn: JaxprEqn) -> Iterator[Any]:
    """The programs among the parameters of a primitive."""
    for value in eqn.params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, Jaxpr | ClosedJaxpr):
                yield item


_T = TypeVar("_T")


def materialize(fn: Callable[[], _T]) -> _T:
    """`fn()`, computed once and kept in memory.

    On CPUs, XLA may fuse a computation into every kernel that reads its result, and so
    repeat it in each. For Gaussian numbers and transcendental functions this costs more
    than it saves. XLA fuses nothing across the border of a conditional. So `fn` is called
    in one branch of a conditional, and the barrier hides from XLA that the condition is
    always true.
    """
    fn = jax.jit(fn)  # traced once

    def in_a_conditional() -> _T:
        shapes = jax.eval_shape(fn)
        zeros = lambda: jtu.tree_map(lambda s: lax.full_like(s, 0), shapes)
        return lax.cond(lax.optimization_barrier(True), fn, zeros)

    return lax.platform_dependent(cpu=in_a_conditional, default=fn)
