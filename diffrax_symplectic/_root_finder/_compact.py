"""Loops that compile faster."""

import functools as ft
from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Scalar


_T = TypeVar("_T")


def while_loop(
    proceed: Callable[[_T], Bool[Array, ""]], body: Callable[[_T], _T], carry: _T
) -> _T:
    """`jax.lax.while_loop` for a carry with many scalars, of each of which XLA makes a
    program. Here it sees one array for all of them, numbers and flags alike, so that
    integers have to be small."""
    leaves, treedef = jtu.tree_flatten(jtu.tree_map(jnp.asarray, carry))
    dtype = jnp.result_type(
        *(x for x in leaves if jnp.issubdtype(x.dtype, jnp.floating))
    )
    is_scalar = [x.ndim == 0 for x in leaves]

    def pack(carry: _T) -> tuple[Float[Array, " k"], list[Array]]:
        leaves = [*zip(jtu.tree_leaves(carry), is_scalar)]
        scalars = [jnp.asarray(x, dtype) for x, scalar in leaves if scalar]
        return _row(scalars), [x for x, scalar in leaves if not scalar]

    def unpack(packed: tuple[Float[Array, " k"], list[Array]]) -> _T:
        scalars, arrays = map(iter, packed)
        rest = [next(scalars if s else arrays) for s in is_scalar]
        return treedef.unflatten(x.astype(y.dtype) for x, y in zip(rest, leaves))

    last = lax.while_loop(
        lambda packed: proceed(unpack(packed)),
        lambda packed: pack(body(unpack(packed))),
        pack(carry),
    )
    return unpack(last)


def _row(scalars: list[Scalar]) -> Float[Array, " k"]:
    """By selection: XLA puts it into one program with what computes the numbers, which it
    does not do with the concatenation of many arrays."""
    row = np.arange(len(scalars))
    select = lambda rest, i: jnp.where(row == i, scalars[i], rest)
    return ft.reduce(select, range(1, len(scalars)), jnp.full(row.shape, scalars[0]))
