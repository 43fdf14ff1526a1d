"""Loops that compile faster."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Shaped


_T = TypeVar("_T")


def while_loop(
    proceed: Callable[[_T], Bool[Array, ""]], body: Callable[[_T], _T], carry: _T
) -> _T:
    """`jax.lax.while_loop` for a carry of many small arrays, of each of which XLA makes a
    program. Here it sees one array for all of one shape, numbers and flags alike, so that
    integers have to be small."""
    leaves, treedef = jtu.tree_flatten(jtu.tree_map(jnp.asarray, carry))
    floating = [x for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    dtype = jnp.result_type(*floating)
    shapes = list(dict.fromkeys(x.shape for x in leaves))

    def pack(carry: _T) -> list[Shaped[Array, "..."]]:
        leaves = [jnp.asarray(x, dtype) for x in jtu.tree_leaves(carry)]
        return [_stack([x for x in leaves if x.shape == s]) for s in shapes]

    def unpack(packed: list[Shaped[Array, "..."]]) -> _T:
        rows = dict(zip(shapes, map(iter, packed)))
        return treedef.unflatten(next(rows[x.shape]).astype(x.dtype) for x in leaves)

    last = lax.while_loop(
        lambda packed: proceed(unpack(packed)),
        lambda packed: pack(body(unpack(packed))),
        pack(carry),
    )
    return unpack(last)


def _stack(arrays: list[Shaped[Array, "..."]]) -> Shaped[Array, "n ..."]:
    if arrays[0].ndim > 0:
        return jnp.stack(arrays)
    # Scalars by selection: XLA puts it into one program with what computes them, which it
    # does not do with the concatenation of many arrays.
    row = np.arange(len(arrays))
    select = lambda rest, i: jnp.where(row == i, arrays[i], rest)
    return ft.reduce(select, range(1, len(arrays)), jnp.full(row.shape, arrays[0]))
