"""What the package uses of other packages that these do not promise to keep.

Nothing of the kind is used anywhere else. `tests/test_private_parts.py` tests each of these
by itself.
"""

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
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
    Literal as Literal,
)
from jaxtyping import PyTree
from lineax.internal import (
    pack_structures as pack_structures,
    PackedStructures as PackedStructures,
    ravel_vector as ravel_vector,
    transpose_packed_structures as transpose_packed_structures,
    unravel_solution as unravel_solution,
)


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


def innermost_solve() -> Mapping[str, Any] | None:
    """The local variables, `terms`, `solver` and `stepsize_controller` among them, of the
    innermost `diffrax.diffeqsolve` that is being traced; `None` if there is none on the
    Python stack."""
    frame = _frame_of_solve("loop", "diffeqsolve")
    return None if frame is None else frame.f_locals


def innermost_call() -> Mapping[str, Any] | None:
    """The arguments of the innermost solve as they were passed, numbers of Python among
    them; `None` if there is no solve on the Python stack."""
    frame = _frame_of_solve("diffeqsolve")
    # Diffrax traces its numbers. Those that were passed are held by `equinox.filter_jit`.
    outer = None if frame is None else frame.f_back
    if outer is None or outer.f_globals.get("__name__") != "equinox._jit":
        return None
    args, kwargs = outer.f_locals["args"], outer.f_locals["kwargs"]
    return inspect.signature(diffrax.diffeqsolve).bind(*args, **kwargs).arguments


def _frame_of_solve(*functions: str) -> FrameType | None:
    frame = sys._getframe(2)
    while frame is not None:
        in_diffrax = frame.f_globals.get("__name__") == "diffrax._integrate"
        if in_diffrax and frame.f_code.co_name in functions:
            return frame
        frame = frame.f_back
    return None


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
