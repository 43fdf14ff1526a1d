"""The private parts of other packages that this one uses, and may change without notice.

They are used nowhere else, except for the loop of a solve, its state and that of its step
size controller in `_adjoint.py`. `tests/test_private_parts.py` tests each of them.
"""

from collections.abc import Callable
from typing import Any

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
from jax.extend.core import (
    ClosedJaxpr,
    Jaxpr as Jaxpr,
    jaxpr_as_fun,
    Literal as Literal,
)
from jax.interpreters.partial_eval import dce_jaxpr as dce_jaxpr
from jaxtyping import PyTree


def unwrapped(term: diffrax.AbstractTerm) -> diffrax.AbstractTerm:
    """The user's term. In a solve Diffrax wraps it, to be able to run backward in time."""
    return term.term if isinstance(term, WrapTerm) else term


def replaced(term: diffrax.AbstractTerm, new: diffrax.AbstractTerm) -> Any:
    """`new` in place of the user's term, in the same direction of time."""
    return WrapTerm(new, term.direction) if isinstance(term, WrapTerm) else new


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
