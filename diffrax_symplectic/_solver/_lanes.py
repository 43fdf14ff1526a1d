"""What only a few paths of a batch need."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree


_T = TypeVar("_T")

# A batch is served a sixteenth at a time.
_PARTS = 16


def where_pending(
    fn: Callable[[PyTree, _T], _T], pending: Bool[Array, ""], args: PyTree, value: _T
) -> _T:
    """`fn(args, value)` where `pending`, and `value` elsewhere; `fn` must not capture
    arrays.

    A conditional would do, but under `vmap` it becomes a selection: all paths compute, and
    memory is set aside for all of them. Here, the batch is served in parts, and only
    those with a path in them for which `pending` holds. This has no derivative.
    """
    dynamic, static = eqx.partition(args, eqx.is_array)
    # Batched more than once, but traced only here.
    call = jax.jit(lambda dynamic, value: fn(eqx.combine(dynamic, static), value))

    @jax.custom_batching.custom_vmap
    def serve(pending, dynamic, value):
        body = lambda carry: (jnp.array(False), call(dynamic, carry[1]))
        return lax.while_loop(lambda carry: carry[0], body, (pending, value))[1]

    @serve.def_vmap
    def serve_batch(size, in_batched, pending, dynamic, value):
        spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))
        pending, value = jtu.tree_map(
            spread, (pending, value), (in_batched[0], in_batched[2])
        )
        dynamic_batched = in_batched[1]
        part = -(-size // _PARTS)
        axes = jtu.tree_map(lambda b: 0 if b else None, dynamic_batched)

        def one(pending, dynamic, value):
            new = call(dynamic, value)
            return jtu.tree_map(lambda a, b: jnp.where(pending, a, b), new, value)

        def body(carry):
            pending, value = carry
            first = jnp.minimum(jnp.argmax(pending), size - part)
            cut = lambda x: lax.dynamic_slice_in_dim(x, first, part)
            paste = lambda x, new: lax.dynamic_update_slice_in_dim(x, new, first, 0)
            some = jtu.tree_map(
                lambda x, b: cut(x) if b else x, dynamic, dynamic_batched
            )
            new = jax.vmap(one, in_axes=(0, axes, 0))(
                cut(pending), some, jtu.tree_map(cut, value)
            )
            done = jnp.zeros(part, bool)
            return paste(pending, done), jtu.tree_map(paste, value, new)

        _, value = lax.while_loop(lambda c: jnp.any(c[0]), body, (pending, value))
        return value, jtu.tree_map(lambda _: True, value)

    return serve(pending, dynamic, value)
