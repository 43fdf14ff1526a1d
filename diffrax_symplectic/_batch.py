"""What all paths of a batch do together, and what only a few of them need."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ._compat import ClosedJaxpr, jaxpr_as_fun
from ._custom_types import IntScalarLike


_T = TypeVar("_T")

# Paths that need more than the others are gathered, and served by parts of the batch: so
# many of them. Mostly there are a few, and the work is that of whole parts.
_PARTS = 256


@jax.custom_batching.custom_vmap
def most_of_batch(number: IntScalarLike) -> IntScalarLike:
    """The largest `number` of all paths of a batch: one for all of them. As the length of a
    loop it leaves what is the same for all paths the same."""
    return number


@most_of_batch.def_vmap
def _(size, in_batched, number):
    del size
    return most_of_batch(jnp.max(number, 0) if in_batched[0] else number), False


# Outside of a program, arrays of NumPy may be batched, for which JAX has not these rules.
@jax.jit
def batched_together(values: _T, others: PyTree = ()) -> _T:
    """The same `values`, all of them batched if one is, or one of the `others`. JAX batches
    what is in a loop anew whenever one more of its values turns out to be batched."""
    return _differentiable(values, others)


@jax.custom_jvp
def _differentiable(values: _T, others: PyTree) -> _T:
    return _batched_together(values, others)


@_differentiable.defjvp
def _(primals, tangents):
    return _differentiable(*primals), tangents[0]


@jax.custom_batching.custom_vmap
def _batched_together(values: _T, others: PyTree) -> _T:
    del others
    return values


@_batched_together.def_vmap
def _(size, in_batched, values, others):
    values = _spread(size, in_batched[0], values)
    return batched_together(values, others), jtu.tree_map(lambda _: True, values)


def _spread(size: int, in_batched: PyTree[bool], values: _T) -> _T:
    spread = lambda b, x: x if b else jnp.broadcast_to(x, (size, *jnp.shape(x)))
    return jtu.tree_map(spread, in_batched, values)


def where_pending(fn: Callable[[_T], _T], pending: Bool[Array, ""], value: _T) -> _T:
    """`fn(value)` where `pending`, and `value` elsewhere.

    A conditional would do, but under `vmap` it becomes a selection: all paths compute, and
    memory is set aside for all of them. Here the paths for which `pending` holds are
    gathered from the batch, and served by parts. This has no derivative.
    """
    # Batched more than once, but traced only here. What `fn` captures is batched, too.
    traced = jax.make_jaxpr(fn)(value)
    unflatten = jtu.tree_structure(value).unflatten

    def call(captured, value):
        own = jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, captured))
        return unflatten(own(*jtu.tree_leaves(value)))

    # Traced once, for what is in a loop is batched several times.
    serve_batch = jax.jit(ft.partial(_serve_batch, call))

    def serve(depth: int) -> Callable[..., _T]:
        """For that many axes of a batch, of which arguments have those that they need."""

        @jax.custom_batching.custom_vmap
        def serve_all(pending, captured, value):
            if depth > 0:
                return serve_batch(pending, captured, value)
            return lax.cond(pending, call, lambda _, value: value, captured, value)

        @serve_all.def_vmap
        def _(size, in_batched, pending, captured, value):
            pending, value = _spread(
                size, (in_batched[0], in_batched[2]), (pending, value)
            )
            captured = [x if b else x[None] for b, x in zip(in_batched[1], captured)]
            value = serve(depth + 1)(pending, captured, value)
            return value, jtu.tree_map(lambda _: True, value)

        return serve_all

    return serve(0)(pending, list(traced.consts), value)


def _serve_batch(call, pending, captured, value):
    """What was `captured` has each axis of the batch, or in its place one of length 1."""
    depth, shape, size = pending.ndim, pending.shape, pending.size
    part = -(-size // _PARTS)
    flat = lambda x: x.reshape(size, *x.shape[depth:])
    own = [any(n > 1 for n in x.shape[:depth]) for x in captured]

    def body(carry):
        pending, value = carry
        # As `jnp.nonzero`, which is compiled to a dozen kernels. Where fewer paths are
        # left, the numbers beyond the batch are dropped in the end.
        flag, which = lax.top_k(pending.astype(jnp.float32), part)
        place = jnp.unravel_index(which, shape) if depth > 1 else (which,)
        which = jnp.where(flag > 0, which, size)

        def gather(x, own):
            axes = zip(place, x.shape)
            return (
                x[tuple(i if n > 1 else 0 for i, n in axes)] if own else x[(0,) * depth]
            )

        few = [gather(x, b) for x, b in zip(captured, own)]
        axes = [0 if b else None for b in own]
        new = jax.vmap(call, (axes, 0))(few, jtu.tree_map(lambda x: x[which], value))
        scatter = lambda x, y: x.at[which].set(y, mode="drop")
        return scatter(pending, False), jtu.tree_map(scatter, value, new)

    some_pending = lambda carry: jnp.any(carry[0])
    begin = flat(pending), jtu.tree_map(flat, value)
    value = lax.while_loop(some_pending, body, begin)[1]
    return jtu.tree_map(lambda x: x.reshape(*shape, *x.shape[1:]), value)
