"""Linear systems of many unknowns, by products with their matrix alone."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Scalar


# The most directions that are kept; with fewer unknowns, as many as there are.
_DIRECTIONS = 10
# By how much the residual is reduced: a correction of Newton's method needs no more
# accuracy than the next one makes up for.
_REDUCTION = 1e-3
# The most products, and how much a cycle of all directions has to reduce the residual by.
_MOST_PRODUCTS = 400
_LEAST_REDUCTION = 0.9


class _State(NamedTuple):
    """An iterate `x` and its residual `r`; directions and their images, which are
    orthonormal; the next direction; how many products there were, and the size of the
    residual when the directions were last forgotten."""

    x: Float[Array, " n"]
    r: Float[Array, " n"]
    directions: Float[Array, "m n"]
    images: Float[Array, "m n"]
    following: Float[Array, " n"]
    step: Int[Array, ""]
    before: Scalar


def gmres(
    apply: Callable[[Array], Array], rhs: Float[Array, " n"]
) -> Float[Array, " n"]:
    """An `x` with `apply(x)` near `rhs`, or one that is no nearer than this can reach.

    Restarted GMRES as "adaptive simpler GMRES" by Jiranek and Rozloznik (Numerical
    Algorithms 53, 2010, 93-112): images of directions are kept orthonormal, so that the
    best step along each is a product of vectors, and no least-squares problem remains. The
    next direction is the residual if it became smaller, and otherwise the last image. It is
    one short loop, which compiles in a fraction of the time of Lineax' GMRES.
    """
    n = rhs.size
    m = min(n, _DIRECTIONS)
    norm = lambda x: jnp.sqrt(jnp.sum(x**2))
    size = norm(rhs)

    def advance(state: _State) -> _State:
        x, r, directions, images, p, step, before = state
        q = apply(p)
        # Twice, since one pass leaves what rounding errors put there.
        for _ in range(2):
            along = images @ q
            p, q = p - along @ directions, q - along @ images
        length = norm(q)
        unit = jnp.where(length > 0, 1 / length, 0)
        p, q = p * unit, q * unit
        size_before, along = norm(r), jnp.sum(q * r)
        x, r = x + along * p, r - along * q
        j = step % m
        directions, images = directions.at[j].set(p), images.at[j].set(q)
        size = norm(r)
        full = j == m - 1
        forget = lambda stack: jnp.where(full, 0, stack)
        better = full | (size <= _LEAST_REDUCTION * size_before)
        p = jnp.where(better, r / size, q)
        # A cycle that gained nothing ends it.
        stuck = full & ~(size <= _LEAST_REDUCTION * before)
        step = jnp.where(stuck, _MOST_PRODUCTS, step + 1)
        before = jnp.where(full, size, before)
        return _State(x, r, forget(directions), forget(images), p, step, before)

    def proceed(state: _State):
        return (norm(state.r) > _REDUCTION * size) & (state.step < _MOST_PRODUCTS)

    none = jnp.zeros((m, n), rhs.dtype)
    state = _State(jnp.zeros_like(rhs), rhs, none, none, rhs / size, jnp.array(0), size)
    return lax.while_loop(proceed, advance, state).x
