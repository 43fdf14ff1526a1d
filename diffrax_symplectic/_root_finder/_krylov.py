"""Linear systems of many unknowns, by products with their matrix alone.

Restarted GMRES as "adaptive simpler GMRES" by Jiranek and Rozloznik (Numerical Algorithms
53, 2010, 93-112): images of directions are kept orthonormal, so that the best step along
each is a product of vectors, and no least-squares problem remains. The next direction is
the residual if it became smaller, and otherwise the last image. All directions lie in the
span of the images and of the residual that they began with, and are kept as combinations of
these. The images are kept in single precision, as by Aliaga et al. (International Journal
of High Performance Computing Applications 37, 2023, 82-100): they are most of the memory
that a step needs, and no more accuracy is asked of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Float32, Scalar

from .._custom_types import BoolScalarLike, IntScalarLike


# How many images are kept. As many as there are unknowns need no restart, after which
# indefinite matrices, those of long steps, can stall. Up to this size they take little
# memory.
_NO_RESTART = 30
_IMAGES = 8
# By how much the residual is reduced: a correction of Newton's method needs no more
# accuracy than the next one makes up for.
_REDUCTION = 1e-3
# The most products, and how much a cycle that fills the basis has to reduce the square of
# the residual by.
_MOST_PRODUCTS = 2000
_LEAST_REDUCTION = 0.98


class Krylov(NamedTuple):
    """Where the solution of `A x = b` stands.

    - `x`, `r`, `p`: the iterate and its residual in units of `unit`, and the direction
        whose product with `A` is needed next.
    - `basis`: the residual with which it began, and the images, which are orthonormal. The
        first `full` rows are in use.
    - `directions`, `by_r`, `by_p`: the directions that the images are of, the residual and
        the next direction, as combinations of `basis`.
    - `unit`, `start`: the largest entry of `b`, and the square of its length in this unit.
    - `size`, `before`: the square of the length of `r` now, and when the basis began.
    - `left`: how many products there may be.
    """

    x: Float[Array, " n"]
    r: Float[Array, " n"]
    p: Float[Array, " n"]
    basis: Float32[Array, "m n"]
    directions: Float[Array, "m m"]
    by_r: Float[Array, " m"]
    by_p: Float[Array, " m"]
    unit: Scalar
    start: Scalar
    size: Scalar
    before: Scalar
    full: IntScalarLike
    left: IntScalarLike

    @property
    def reduced(self) -> Bool[Array, ""]:
        """Whether the residual is small enough."""
        return ~(self.size > _REDUCTION**2 * self.start)

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether the residual is small enough, or becomes no smaller."""
        return self.reduced | (self.left <= 0)

    @property
    def solution(self) -> Float[Array, " n"]:
        # Nothing was solved where there is no number to begin with.
        return jnp.where(jnp.isfinite(self.start), self.x * self.unit, jnp.nan)


def empty(n: int, dtype) -> Krylov:
    """Without a system."""
    x, one = jnp.zeros(n, dtype), jnp.ones((), dtype)
    m = (n if n <= _NO_RESTART else _IMAGES) + 1
    basis, directions = jnp.zeros((m, n), jnp.float32), jnp.zeros((m, m), dtype)
    by = jnp.zeros(m, dtype)
    return Krylov(x, x, x, basis, directions, by, by, one, one, one, one, 1, 0)


def extend(
    state: Krylov, vector: Float[Array, " n"], fresh: BoolScalarLike = False
) -> Krylov:
    """After the product `vector` of the matrix with `state.p`. Where `fresh`, a solution
    begins instead, and `vector` is the right-hand side."""
    rows, single = jnp.arange(len(state.basis)), jnp.float32
    images = (rows > 0) & (rows < state.full)
    # Sums in place of matrix products make a shorter program, and as fast a one.
    # What rounding errors leave of the other images only makes the method slower. Rounding
    # errors of `pair` make `r` differ from the residual of `x`. The difference is far
    # smaller than the accuracy that is asked for.
    parts = jnp.where(images, jnp.sum(state.basis * vector.astype(single), 1), 0)
    direction = state.by_p - jnp.sum(parts[:, None] * state.directions, 0)
    # Both at once, so that the basis has been read when it is overwritten, in place.
    pair = jnp.stack([parts, direction]).astype(single)
    pair = jnp.sum(pair[:, :, None] * state.basis, 1).astype(vector.dtype)
    q = vector - pair[0]
    square = jnp.sum(q**2)
    scale = jnp.where(square > 0, lax.rsqrt(square), 0)
    q = q * scale
    along = jnp.sum(q * state.r)

    # Squares of very small or large numbers are zero or infinite.
    unit = jnp.max(jnp.abs(vector))
    unit = jnp.where(fresh, jnp.where(unit > 0, unit, 1), state.unit)
    r = jnp.where(fresh, vector / unit, state.r - along * q)
    size = jnp.sum(r**2)
    last = state.full == len(rows) - 1
    forget = last | fresh
    by_residual = (size <= _LEAST_REDUCTION * state.size) | forget
    # The next row of the basis. Rows that are not in use have the weight zero, and zero
    # times NaN is NaN: so all rows must be finite, whatever the equations return.
    here = rows == jnp.where(forget, 0, state.full)
    at, finite = here[:, None], jnp.isfinite(size)
    row = jnp.where(finite, jnp.where(forget, r, q), 0)
    row_direction = jnp.where(finite & ~forget, scale * direction, 0)
    by_r = jnp.where(
        here, jnp.where(forget, 1, -along), jnp.where(forget, 0, state.by_r)
    )
    # A cycle that gained nothing ends it.
    stuck = last & ~(size <= _LEAST_REDUCTION * state.before)
    left = jnp.where(stuck, 0, state.left - 1)
    return Krylov(
        x=jnp.where(fresh, 0, state.x + along * scale * pair[1]),
        r=r,
        p=jnp.where(by_residual, r, q),
        basis=jnp.where(at, row.astype(single), state.basis),
        directions=jnp.where(at, row_direction, state.directions),
        by_r=by_r,
        by_p=jnp.where(by_residual, by_r, here),
        unit=unit,
        start=jnp.where(fresh, size, state.start),
        size=size,
        before=jnp.where(forget, size, state.before),
        full=jnp.where(forget, 1, state.full + 1),
        left=jnp.where(fresh, _MOST_PRODUCTS, left),
    )


def gmres(apply: Callable[[Array], Array], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """An `x` with `apply(x)` near `b`, or one that is no nearer than this can reach. It is
    NaN if `b` is not finite."""
    advance = lambda state: extend(state, apply(state.p))
    first = extend(empty(b.size, b.dtype), b, True)
    return lax.while_loop(lambda state: ~state.done, advance, first).solution
