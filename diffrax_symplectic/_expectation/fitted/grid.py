"""Value functions of one or two coordinates on a grid."""

import functools as ft
import itertools
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..._products import tensordot
from .bases import AbstractBasis, CovarianceFrame, Hermite


# The width of a grid relative to the pilot's range. For the mean of q^2 of a pendulum, the
# standard error was 1.3e-10 (1.7e-2 without a fit); 2e-6 with a width of 1.05, where paths
# leave the grid, and 3e-9 with one of 2.5, where its points are far apart.
_WIDER = 1.5
# The fraction of the width at which the values start to fall to zero (with 0.6 the standard
# error of the pendulum was 2e-7), and the fraction of that where the polynomials are
# compared, near the edge.
_FALLS = 0.9
_NEAR_EDGE = 0.8
# The interpolation points along each axis: polynomials of degree 5. With 4 points the
# standard error of the pendulum was 4e-8, with 8 it was 7e-12 to 5e-10.
_STENCIL = 6
# With 1,024 pilot paths for a grid of 32 points, means were off by 15 standard errors:
# paths of probability 1e-6 left the grid. This many suffice, at no loss of speed.
_PILOTS = 2**13
# A grid corrects the best polynomial of these degrees.
_DEGREES = (0, 2, 4)
# In the middle the spacing is that of a uniform grid whose half-width is this many
# interquartile ranges: for normal states, 9.4 standard deviations.
_EVEN = 7
# The grid is at most this many times as wide as that, since the interquartile range may be
# zero, and always stretched a little, since coordinates are divided by the stretching.
_MOST_STRETCHED = 1e4
_LEAST_BENT = 0.01


class StretchedFrame(eqx.Module):
    """Coordinates from -1 to 1 on a grid: linear near the middle, and growing with the
    fourth root further out, where there are few paths.

    For the coordinate `z` of `inner` it is `_bent(_bent(factor * (z - median))) / edge`.
    """

    inner: CovarianceFrame
    median: Float[Array, " d"]
    factor: Float[Array, " d"]
    edge: Float[Array, " d"]

    @staticmethod
    def of(
        inner: CovarianceFrame,
        z: Float[Array, "n d"],
        good: Bool[Array, " n"],
        num_for_quartiles: int,
    ) -> "StretchedFrame":
        """The coordinates for paths at `z`, of which some are `good`. A few of them suffice
        for the quartiles."""
        least = jnp.min(jnp.where(good[:, None], z, jnp.inf), axis=0)
        most = jnp.max(jnp.where(good[:, None], z, -jnp.inf), axis=0)
        few = jnp.where(good[:, None], z, jnp.nan)[:num_for_quartiles]
        levels = jnp.array([0.25, 0.5, 0.75])
        first_quartile, median, third_quartile = jnp.nanquantile(few, levels, axis=0)
        furthest = jnp.maximum(most - median, median - least)
        half_width = jnp.maximum(_WIDER * furthest, 1)
        # In the middle the spacing is as on a uniform grid of this half-width.
        uniform_half = jnp.clip(
            _EVEN * (third_quartile - first_quartile),
            half_width / _MOST_STRETCHED,
            half_width,
        )
        # With `bend`, the argument of `_bent(_bent(...))` at the edge, the coordinate has
        # the slope `bend / half_width / edge` in the middle, where `_bent` has slope 1. So
        # `half_width / uniform_half` is `bend / edge`, about `(1 + bend**2) ** (3 / 8)`. Of
        # this follows `bend`.
        ratio = half_width / uniform_half
        bend = jnp.sqrt(jnp.maximum(ratio ** (8 / 3) - 1, _LEAST_BENT))
        return StretchedFrame(inner, median, bend / half_width, _bent(_bent(bend)))

    def at(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The coordinates of states."""
        return _bent(_bent(self.factor * (self.inner.at(y) - self.median))) / self.edge

    def states(self, x: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The states with these coordinates."""
        unscaled = _straight(_straight(self.edge * x))
        return self.inner.states(self.median + unscaled / self.factor)


def _bent(x: Array) -> Array:
    """An odd function with slope 1 at zero, which grows like the square root. (It takes a
    quarter of the time of a logarithm.)"""
    return x / jnp.sqrt(jnp.sqrt(1 + x**2))


def _straight(x: Array) -> Array:
    """The inverse of `_bent`."""
    return x * jnp.sqrt(x**2 / 2 + jnp.sqrt(1 + x**4 / 4))


class Grid(AbstractBasis):
    """A polynomial plus a correction on a grid, interpolated by polynomials of degree 5
    through the 6 nearest points along each axis. The candidate is the number of points
    along an axis. The correction falls to zero towards the edge of the grid; beyond it only
    the polynomial remains, whose degree is the one that fits best near the edge."""

    kind: ClassVar[str] = "grid points along an axis"
    d: int
    candidates: tuple[int]

    @property
    def size(self):
        return self._base.size + self.candidates[0] ** self.d

    @property
    def pilots(self):
        return _PILOTS

    @property
    def sites(self):
        return self._base.pilots + self.candidates[0] ** self.d

    @property
    def _base(self) -> Hermite:
        """The polynomials that the grid corrects."""
        return Hermite(self.d, _DEGREES)

    def frame(self, states, good, unit):
        inner = CovarianceFrame.of(states, good, unit)
        return StretchedFrame.of(inner, inner.at(states), good, self._base.pilots)

    def coefficients(self, target, frame, states, good, keys):
        base = self._base
        n = base.pilots
        axes = [np.linspace(-1, 1, self.candidates[0])] * self.d
        x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, self.d)
        nodes = frame.states(jnp.asarray(x, states.dtype))
        # In one call, so that the target is compiled once.
        points = jnp.concatenate([frame.inner.perturbed(states[:n]), nodes])
        values = jax.vmap(target)(points)
        # One copy for each degree.
        at_pilots = jnp.repeat(values[:n], len(_DEGREES), axis=1)
        c = base.least_squares_fit(at_pilots, frame.inner, points[:n], good[:n])
        residual = values[n:] - tensordot(base.at(frame.inner, nodes), c, 1)
        # The target may overflow where it grows fast.
        residual = jnp.where(jnp.isfinite(residual), residual, 0)
        # The degree that leaves the least near the edge, for each component.
        distance = np.max(np.abs(x), axis=1)
        is_near_edge = (distance > _FALLS * _NEAR_EDGE) & (distance < _FALLS)
        most = jnp.max(jnp.abs(residual[is_near_edge]), axis=0)
        best = jnp.argmin(most, axis=0)[None, None]
        residual = jnp.take_along_axis(residual, best, 1)
        c = jnp.take_along_axis(c, best, 1)
        falling = np.prod(_falling((np.abs(x) - _FALLS) / (1 - _FALLS)), axis=1)
        falling = jnp.asarray(falling, residual.dtype)[:, None, None, None]
        return jnp.concatenate([c, residual * falling])

    def value_at(self, frame, y, c):
        size = self._base.size
        correction = self.interpolate(frame.at(y), c[size:])
        return self._base.value_at(frame.inner, y, c[:size]) + correction

    def interpolate(
        self, x: Float[Array, " d"], c: Float[Array, "nodes ..."]
    ) -> Float[Array, "..."]:
        """The values on the grid, interpolated at a point, and zero beyond the grid."""
        n = self.candidates[0]
        rest = c.shape[1:]
        # Grid points to each side of the point.
        half = _STENCIL // 2
        place = (x + 1) * (n - 1) / 2
        inside = jnp.all((place >= half - 1) & (place <= n - half))
        # Outside, the result at some place inside is computed, and dropped.
        place = jnp.clip(jnp.where(inside, place, n / 2), half - 1, n - half)
        begin = jnp.minimum(jnp.floor(place) - (half - 1), n - _STENCIL)
        start = jnp.pad(begin.astype(jnp.int32), (0, len(rest)))
        grid = c.reshape(*[n] * self.d, *rest)
        block = lax.dynamic_slice(grid, start, (*[_STENCIL] * self.d, *rest))
        weights = _lagrange([place - begin - j for j in range(_STENCIL)])
        for j in range(self.d):
            products = [weight[j] * row for weight, row in zip(weights, block)]
            block = ft.reduce(jnp.add, products)
        return jnp.where(inside, block, 0)


def _lagrange(distances: list[Float[Array, " d"]]) -> list[Float[Array, " d"]]:
    """The Lagrange polynomials of the points `0, 1, ..., k - 1`, from the distances to each
    of them."""
    k = len(distances)
    # Each is a product over the points to the left, times one over the points to the right.
    left = [*itertools.accumulate(distances[:-1], jnp.multiply, initial=1.0)]
    right = [*itertools.accumulate(distances[:0:-1], jnp.multiply, initial=1.0)][::-1]
    weights = []
    for j in range(k):
        # The same product at point `j`.
        at_own_point = math.factorial(j) * math.factorial(k - 1 - j)
        sign = (-1) ** (k - 1 - j)
        weights.append(left[j] * right[j] / (sign * at_own_point))
    return weights


def _falling(x: np.ndarray) -> np.ndarray:
    """Falls from 1 at 0 to 0 at 1, with two vanishing derivatives at both ends."""
    x = np.clip(x, 0, 1)
    return 1 - x**3 * (10 - 15 * x + 6 * x**2)
