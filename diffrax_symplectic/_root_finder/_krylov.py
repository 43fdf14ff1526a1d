"""Linear systems of many unknowns, by products with their matrix alone.

Restarted GMRES as "adaptive simpler GMRES" by Jiranek and Rozloznik (Numerical Algorithms
53, 2010, 93-112): images of directions are kept orthonormal, so that the best step along
each is a product of vectors, and no least-squares problem remains. The next direction is
the residual if it became smaller, and otherwise the last image.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Scalar

from .._custom_types import IntScalarLike


# The most directions that are kept; with fewer unknowns, as many as there are.
_DIRECTIONS = 10
# By how much the residual is reduced: a correction of Newton's method needs no more
# accuracy than the next one makes up for.
_REDUCTION = 1e-3
# The most products, and how much a cycle of all directions has to reduce the square of the
# residual by.
_MOST_PRODUCTS = 2000
_LEAST_REDUCTION = 0.98


class Krylov(NamedTuple):
    """Where the solution of `A x = b` stands.

    - `x`, `r`: the iterate and its residual, in units of `unit`.
    - `p`: the direction whose product with `A` is needed next.
    - `basis`: earlier images, which are orthonormal, and the directions that they are of.
    - `start`, `size`, `before`: the square of the length of the residual at first, now,
        and when the basis was last forgotten.
    - `full`: how many directions there are.
    - `left`: how many products there may be.
    """

    x: Float[Array, " n"]
    r: Float[Array, " n"]
    p: Float[Array, " n"]
    basis: Float[Array, "2 m n"]
    unit: Scalar
    start: Scalar
    size: Scalar
    before: Scalar
    full: IntScalarLike
    left: IntScalarLike

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether the residual is small enough, or becomes no smaller."""
        return ~(self.size > _REDUCTION**2 * self.start) | (self.left <= 0)

    @property
    def solution(self) -> Float[Array, " n"]:
        # Nothing was solved where there is no number to begin with.
        return jnp.where(jnp.isfinite(self.start), self.x * self.unit, jnp.nan)


def begin(b: Float[Array, " n"]) -> Krylov:
    """Before the first product."""
    # Squares of very small or large numbers are zero or infinite.
    unit = jnp.max(jnp.abs(b))
    unit = jnp.where(unit > 0, unit, 1)
    r = b / unit
    size = jnp.sum(r**2)
    basis = jnp.zeros((2, min(b.size, _DIRECTIONS), b.size), b.dtype)
    return Krylov(
        jnp.zeros_like(b), r, r, basis, unit, size, size, size, 0, _MOST_PRODUCTS
    )


def extend(state: Krylov, image: Float[Array, " n"]) -> Krylov:
    """After the product `image` of the matrix with `state.p`."""
    # Sums in place of matrix products make a shorter program, and as fast a one.
    # What rounding errors leave of the other images only makes the method slower: `x` and
    # `r` belong together whatever the directions are.
    parts = jnp.sum(state.basis[0] * image, 1)
    pair = jnp.stack([image, state.p])
    pair = pair - jnp.sum(parts[:, None] * state.basis, 1)
    square = jnp.sum(pair[0] ** 2)
    q, p = pair * jnp.where(square > 0, lax.rsqrt(square), 0)
    along = jnp.sum(q * state.r)
    x, r = state.x + along * p, state.r - along * q
    size = jnp.sum(r**2)
    m = state.basis.shape[1]
    last = state.full == m - 1
    here = (jnp.arange(m) == state.full)[:, None]
    basis = jnp.where(here, jnp.stack([q, p])[:, None], state.basis)
    # A cycle that gained nothing ends it.
    stuck = last & ~(size <= _LEAST_REDUCTION * state.before)
    return Krylov(
        x=x,
        r=r,
        p=jnp.where(last | (size <= _LEAST_REDUCTION * state.size), r, q),
        basis=jnp.where(last, 0, basis),
        unit=state.unit,
        start=state.start,
        size=size,
        before=jnp.where(last, size, state.before),
        full=jnp.where(last, 0, state.full + 1),
        left=jnp.where(stuck, 0, state.left - 1),
    )


def gmres(apply: Callable[[Array], Array], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """An `x` with `apply(x)` near `b`, or one that is no nearer than this can reach. It is
    NaN if `b` is not finite."""
    advance = lambda state: extend(state, apply(state.p))
    return lax.while_loop(lambda state: ~state.done, advance, begin(b)).solution
