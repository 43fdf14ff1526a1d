"""What only a few paths of a batch need."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from .._compat import jaxpr_as_fun


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
    leaves, treedef = jtu.tree_flatten(dynamic)
    # Batched more than once, but traced only here.
    merged = lambda x, y: fn(eqx.combine(treedef.unflatten(x), static), y)
    traced = jaxpr_as_fun(jax.make_jaxpr(merged)(leaves, value))
    unflatten = jtu.tree_structure(value).unflatten
    call = jax.jit(lambda x, y: unflatten(traced(*x, *jtu.tree_leaves(y))))

    @jax.custom_batching.custom_vmap
    def serve(pending, leaves, value):
        body = lambda carry: (jnp.array(False), call(leaves, carry[1]))
        return lax.while_loop(lambda carry: carry[0], body, (pending, value))[1]

    serve.def_vmap(_in_parts(call))
    return serve(pending, leaves, value)


def _in_parts(call: Callable[[list[Array], _T], _T]) -> Callable:
    """The rule by which JAX serves a batch."""

    # JAX batches a loop again and again until it knows what varies from path to path. This,
    # the long part of the program, is the same each time.
    @ft.partial(jax.jit, static_argnums=0)
    def serve_part(axes, pending, leaves, value):
        def one(pending, leaves, value):
            new = call(leaves, value)
            return jtu.tree_map(lambda a, b: jnp.where(pending, a, b), new, value)

        return jax.vmap(one, in_axes=(0, list(axes), 0))(pending, leaves, value)

    def serve_batch(size, in_batched, pending, leaves, value):
        spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))
        pending, value = jtu.tree_map(
            spread, (pending, value), (in_batched[0], in_batched[2])
        )
        part = -(-size // _PARTS)
        state_size = max(x.size for x in jtu.tree_leaves(value)) // size
        # What is shared and no larger than the state is repeated, so that it makes no
        # difference that it is shared.
        batched = in_batched[1]
        own = [b or x.size <= state_size for x, b in zip(leaves, batched)]

        def cut(x, first):
            return lax.dynamic_slice_in_dim(x, first, part)

        def body(carry):
            pending, value = carry
            # Where the batch ends before the part does, JAX begins the part earlier.
            first = jnp.argmax(pending)
            repeat = lambda x: jnp.broadcast_to(x, (part, *x.shape))
            few = [
                cut(x, first) if b else repeat(x) if o else x
                for x, b, o in zip(leaves, batched, own)
            ]
            old = jtu.tree_map(lambda x: cut(x, first), (pending, value))
            new = serve_part(axes, old[0], few, old[1])
            paste = lambda x, y: lax.dynamic_update_slice_in_dim(x, y, first, 0)
            pending = paste(pending, jnp.zeros(part, bool))
            return pending, jtu.tree_map(paste, value, new)

        axes = tuple(0 if o else None for o in own)
        some_pending = lambda carry: jnp.any(carry[0])
        _, value = lax.while_loop(some_pending, body, (pending, value))
        return value, jtu.tree_map(lambda _: True, value)

    return serve_batch
