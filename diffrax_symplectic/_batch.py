"""What all paths of a batch do together, what only a few of them need, and what is kept in
memory for all of them."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ._custom_types import IntScalarLike


_T = TypeVar("_T")

# Stragglers are gathered, and served by parts of the batch: so many of them. Mostly there
# are a few, and the work is that of whole parts. Where all paths computed as long as any is
# pending, ensembles with some hard paths took 8 to 85 times as long.
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


def batched_like(values: _T, others: PyTree) -> _T:
    """The same `values`, batched if one of the arrays in `others` is.

    JAX batches a loop anew whenever one more of the values in it turns out to be batched,
    and loops within loops as many times each. So what a loop begins with is batched before
    it: `StrangGauss` is traced in half the time.
    """
    return _batched(values, [x for x in jtu.tree_leaves(others) if eqx.is_array(x)])


@jax.custom_batching.custom_vmap
def _all_or_none(values: _T, others: list[Array]) -> _T:
    del others
    return values


@_all_or_none.def_vmap
def _(size, in_batched, values, others):
    spread = lambda b, x: x if b else jnp.broadcast_to(x, (size, *jnp.shape(x)))
    values = jtu.tree_map(spread, in_batched[0], values)
    return _all_or_none(values, others), jtu.tree_map(lambda _: True, values)


# Rules of batching have no derivatives in reverse mode.
_batched = jax.custom_jvp(_all_or_none)


@_batched.defjvp
def _(primals, tangents):
    return _batched(*primals), tangents[0]


def where_pending(fn: Callable[[_T], _T], pending: Bool[Array, ""], value: _T) -> _T:
    """`fn(value)` where `pending`, and `value` elsewhere. This has no derivative.

    Under `vmap` a conditional becomes a selection: all paths compute, and memory is set
    aside for all of them. Here the stragglers, for which `pending` holds, are gathered from
    the batch, and served by parts.
    """
    # Traced once, here: `vmap` would have `jax.jit` trace it once more.
    traced = eqx.filter_closure_convert(fn, value)
    arrays, static = eqx.partition(traced, eqx.is_array)
    call = lambda value, arrays: eqx.combine(arrays, static)(value)
    by_parts = jax.jit(ft.partial(_by_parts, call))

    # What each path has of its own, along a first axis, and what all have in common.
    @jax.custom_batching.custom_vmap
    def serve(pending, value, own, common):
        return by_parts(pending, value, own, common)

    @serve.def_vmap
    def _(size, in_batched, pending, value, own, common):
        # Nested batches are one long batch.
        n = pending.shape[1 if in_batched[0] else 0]

        def joined(batched, x):
            x = x if batched else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(size * n, *x.shape[2:])

        each = jtu.tree_map(joined, tuple(in_batched[:3]), (pending, value, own))
        pending, value, own = each
        repeat = lambda b, x: jnp.repeat(x, n, axis=0) if b else None
        more = jtu.tree_map(repeat, in_batched[3], common)
        rest = jtu.tree_map(lambda b, x: None if b else x, in_batched[3], common)
        value = serve(pending, value, eqx.combine(own, more), rest)
        apart = lambda x: x.reshape(size, n, *x.shape[1:])
        return jtu.tree_map(apart, value), jtu.tree_map(lambda _: True, value)

    # One path is a batch of one.
    none = jtu.tree_map(lambda _: None, arrays)
    value = serve(*jtu.tree_map(lambda x: x[None], (pending, value)), none, arrays)
    return jtu.tree_map(lambda x: x[0], value)


def _by_parts(call, pending, value, own, common):
    size = len(pending)
    part = -(-size // _PARTS)
    one = lambda value, own: call(value, eqx.combine(own, common))
    if size == 1:
        alone = jtu.tree_map(lambda x: x[0], (value, own))
        new = lax.cond(pending[0], one, lambda value, _: value, *alone)
        return jtu.tree_map(lambda x: x[None], new)

    def serve_part(carry):
        pending, value = carry
        # As `jnp.nonzero`, which is compiled to a dozen kernels. Where fewer paths are
        # left, the numbers beyond the batch are dropped in the end. Unsigned ones need no
        # code for counting from the end.
        flag, which = lax.top_k(pending.astype(jnp.float32), part)
        which = jnp.where(flag > 0, which, size).astype(jnp.uint32)
        new = jax.vmap(one)(*jtu.tree_map(lambda x: x[which], (value, own)))
        scatter = lambda x, y: x.at[which].set(y, mode="drop")
        return scatter(pending, False), jtu.tree_map(scatter, value, new)

    some_pending = lambda carry: jnp.any(carry[0])
    return lax.while_loop(some_pending, serve_part, (pending, value))[1]


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
