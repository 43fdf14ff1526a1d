"""Linear systems of many unknowns, by products with their matrix alone."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Scalar

from .._custom_types import IntScalarLike


# The most directions that are kept; with fewer unknowns, as many as there are.
_DIRECTIONS = 10
# By how much the residual is reduced: a correction of Newton's method needs no more
# accuracy than the next one makes up for.
_REDUCTION = 1e-3
# The most products, and how much a cycle of all directions has to reduce the residual by.
_MOST_PRODUCTS = 2000
_LEAST_REDUCTION = 0.99


class _State(NamedTuple):
    """An iterate `x`, its residual `r` and the size of that; the basis, whose rows are the
    image of a direction and the direction; the next direction; how many products there
    were, and the size of the residual when the basis was last forgotten."""

    x: Float[Array, " n"]
    r: Float[Array, " n"]
    size: Scalar
    basis: Float[Array, "m 2*n"]
    following: Float[Array, " n"]
    step: IntScalarLike
    before: Scalar


def gmres(
    apply: Callable[[Array], Array], rhs: Float[Array, " n"]
) -> Float[Array, " n"]:
    """An `x` with `apply(x)` near `rhs`, or one that is no nearer than this can reach. It
    is NaN if `rhs` is not finite.

    Restarted GMRES as "adaptive simpler GMRES" by Jiranek and Rozloznik (Numerical
    Algorithms 53, 2010, 93-112): images of directions are kept orthonormal, so that the
    best step along each is a product of vectors, and no least-squares problem remains. The
    next direction is the residual if it became smaller, and otherwise the last image. It is
    one short loop, which compiles in a fraction of the time of Lineax' GMRES.
    """
    n = rhs.size
    m = min(n, _DIRECTIONS)
    norm = lambda x: jnp.sqrt(jnp.sum(x**2))
    start = norm(rhs)

    def advance(state: _State) -> _State:
        x, r, _, basis, p, step, before = state
        # What rounding errors leave of the other images only makes the method slower:
        # `x` and `r` belong together whatever the directions are.
        new = jnp.concatenate([apply(p), p])
        new = new - (basis[:, :n] @ new[:n]) @ basis
        length = norm(new[:n])
        new = new * jnp.where(length > 0, 1 / length, 0)
        q, p = new[:n], new[n:]
        along = jnp.sum(q * r)
        x, r = x + along * p, r - along * q
        size = norm(r)
        full = step % m == m - 1
        basis = jnp.where(full, 0, basis.at[step % m].set(new))
        shrunk = size <= _LEAST_REDUCTION * state.size
        p = jnp.where(full | shrunk, r / size, q)
        # A cycle that gained nothing ends it.
        stuck = full & ~(size <= _LEAST_REDUCTION * before)
        step = jnp.where(stuck, _MOST_PRODUCTS, step + 1)
        before = jnp.where(full, size, before)
        return _State(x, r, size, basis, p, step, before)

    def proceed(state: _State):
        return (state.size > _REDUCTION * start) & (state.step < _MOST_PRODUCTS)

    none = jnp.zeros((m, 2 * n), rhs.dtype)
    state = _State(jnp.zeros_like(rhs), rhs, start, none, rhs / start, 0, start)
    x = lax.while_loop(proceed, advance, state).x
    # Nothing was solved where there is no number to begin with.
    return jnp.where(jnp.isfinite(start), x, jnp.nan)
