"""What all paths of a batch do together, and what only a few of them need."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from .._compat import ClosedJaxpr, jaxpr_as_fun


_T = TypeVar("_T")

# Paths that need more than the others are gathered, and served by parts of the batch: so
# many of them.
_PARTS = 64


@jax.custom_batching.custom_vmap
def any_of_batch(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether `flag` holds for any path of a batch: one answer for all of them. As the
    condition of a loop it leaves what is the same for all paths the same, and the body
    selects which paths it changes."""
    return flag


@any_of_batch.def_vmap
def _(size, in_batched, flag):
    del size
    return any_of_batch(jnp.any(flag, 0) if in_batched[0] else flag), False


def where_pending(
    fn: Callable[[PyTree, _T], _T], pending: Bool[Array, ""], args: PyTree, value: _T
) -> _T:
    """`fn(args, value)` where `pending`, and `value` elsewhere.

    A conditional would do, but under `vmap` it becomes a selection: all paths compute, and
    memory is set aside for all of them. Here the paths for which `pending` holds are
    gathered from the batch, and served by parts. This has no derivative.
    """
    dynamic, static = eqx.partition(args, eqx.is_array)
    leaves, treedef = jtu.tree_flatten(dynamic)
    # Batched more than once, but traced only here. What `fn` captures is batched, too.
    merged = lambda x, y: fn(eqx.combine(treedef.unflatten(x), static), y)
    traced = jax.make_jaxpr(merged)(leaves, value)
    unflatten, num = jtu.tree_structure(value).unflatten, len(leaves)

    @jax.jit
    def call(leaves, value):
        own = jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, leaves[num:]))
        return unflatten(own(*leaves[:num], *jtu.tree_leaves(value)))

    @jax.custom_batching.custom_vmap
    def serve(pending, leaves, value):
        return lax.cond(pending, call, lambda _, value: value, leaves, value)

    serve.def_vmap(ft.partial(_serve_batch, call))
    return serve(pending, [*leaves, *traced.consts], value)


def _serve_batch(call, size, in_batched, pending, leaves, value):
    """The rule by which JAX serves a batch."""
    spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))
    pending, value = jtu.tree_map(
        spread, (pending, value), (in_batched[0], in_batched[2])
    )
    part = -(-size // _PARTS)
    axes = [0 if b else None for b in in_batched[1]]

    def body(carry):
        pending, value = carry
        # Where fewer paths are left, the numbers beyond the batch are dropped in the end.
        which = jnp.nonzero(pending, size=part, fill_value=size)[0]
        gather = lambda x: x.at[which].get(mode="clip")
        few = [gather(x) if b else x for x, b in zip(leaves, in_batched[1])]
        new = jax.vmap(call, (axes, 0))(few, jtu.tree_map(gather, value))
        scatter = lambda x, y: x.at[which].set(y, mode="drop")
        return scatter(pending, False), jtu.tree_map(scatter, value, new)

    some_pending = lambda carry: jnp.any(carry[0])
    _, value = lax.while_loop(some_pending, body, (pending, value))
    return value, jtu.tree_map(lambda _: True, value)
