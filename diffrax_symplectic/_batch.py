"""Control flow for batches: loops that all paths share, work that only stragglers need, and
values that are computed once."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ._compat import captured_arrays
from ._custom_types import IntScalarLike


_T = TypeVar("_T")

# Stragglers are gathered and served in groups of a batch's size over this number. Usually
# there are few, and each group costs its full size. When all paths computed for as long as
# any was pending, ensembles with a few hard paths took 8 to 85 times as long.
_PARTS = 256


@jax.custom_batching.custom_vmap
def most_of_batch(number: IntScalarLike) -> IntScalarLike:
    """The largest `number` over all paths of a batch, itself not batched. A loop of this
    length keeps unbatched values unbatched."""
    return number


@most_of_batch.def_vmap
def _(size, in_batched, number):
    del size
    return most_of_batch(jnp.max(number, 0) if in_batched[0] else number), False


def batched_like(values: _T, others: PyTree) -> _T:
    """The same `values`, batched if any array in `others` is.

    JAX traces a loop again whenever one more of its values turns out to be batched, and
    nested loops again each time. Batching the initial values before the loop halves the
    time to trace `StrangGauss`.
    """
    arrays = [x for x in jtu.tree_leaves(others) if eqx.is_array(x)]
    # Copies, which are no operations of the program: `custom_jvp` does not convert arrays
    # of NumPy, over which a user may have batched.
    return _batched(*jtu.tree_map(jnp.array, (values, arrays)))


@jax.custom_batching.custom_vmap
def _all_or_none(values: _T, others: list[Array]) -> _T:
    del others
    return values


@_all_or_none.def_vmap
def _(size, in_batched, values, others):
    spread = lambda b, x: x if b else jnp.broadcast_to(x, (size, *jnp.shape(x)))
    values = jtu.tree_map(spread, in_batched[0], values)
    return _all_or_none(values, others), jtu.tree_map(lambda _: True, values)


# Custom batching rules cannot be differentiated in reverse mode.
_batched = jax.custom_jvp(_all_or_none)


@_batched.defjvp
def _(primals, tangents):
    return _batched(*primals), tangents[0]


def error_if_alone(pred: Bool[Array, ""], message: str) -> Bool[Array, ""]:
    """`pred`; if it is true, an error when run. In a batch there is no error: it would stop
    the other paths."""

    @jax.custom_batching.custom_vmap
    def checked(pred):
        return eqx.error_if(pred, pred, message)

    @checked.def_vmap
    def _(size, in_batched, pred):
        del size
        return pred, in_batched[0]

    return checked(pred)


def where_pending(fn: Callable[[_T], _T], pending: Bool[Array, ""], value: _T) -> _T:
    """`fn(value)` where `pending`, and `value` elsewhere. Not differentiable.

    Under `vmap` a conditional becomes a select: all paths compute, with memory for all.
    Here the stragglers (`pending` paths) are gathered from the batch and served in groups.
    """
    # Trace `fn` once, here: under `vmap`, `jax.jit` would trace it again.
    call, arrays = captured_arrays(fn, value)
    by_parts = jax.jit(ft.partial(_by_parts, call))

    # Each path's `own` arrays have a leading axis; `common` arrays are shared.
    @jax.custom_batching.custom_vmap
    def serve(pending, value, own, common):
        return by_parts(pending, value, own, common)

    @serve.def_vmap
    def _(size, in_batched, pending, value, own, common):
        # Nested batches are joined into one.
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
        # Like `jnp.nonzero`, which compiles to a dozen kernels. If fewer paths are pending,
        # the surplus indices lie beyond the batch and are dropped. Unsigned indices need no
        # code for negative ones.
        flag, which = lax.top_k(pending.astype(jnp.float32), part)
        which = jnp.where(flag > 0, which, size).astype(jnp.uint32)
        new = jax.vmap(one)(*jtu.tree_map(lambda x: x[which], (value, own)))
        scatter = lambda x, y: x.at[which].set(y, mode="drop")
        return scatter(pending, False), jtu.tree_map(scatter, value, new)

    some_pending = lambda carry: jnp.any(carry[0])
    return lax.while_loop(some_pending, serve_part, (pending, value))[1]


def materialize(fn: Callable[[], _T]) -> _T:
    """`fn()`, computed once and stored.

    On CPUs, XLA may fuse a computation into every kernel that reads its result, and so
    repeat it. For Gaussian numbers and transcendental functions this costs more than it
    saves. XLA does not fuse across the boundary of a conditional, so `fn` is called in one
    branch of a conditional, and a barrier hides that the condition is always true.
    """
    fn = jax.jit(fn)  # traced once

    def in_a_conditional() -> _T:
        shapes = jax.eval_shape(fn)
        zeros = lambda: jtu.tree_map(lambda s: lax.full_like(s, 0), shapes)
        return lax.cond(lax.optimization_barrier(True), fn, zeros)

    return lax.platform_dependent(cpu=in_a_conditional, default=fn)
