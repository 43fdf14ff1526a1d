"""The basis of value functions of one or two coordinates: a polynomial, and a correction on
a grid of points."""

import functools as ft
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..._products import tensordot
from .bases import AbstractBasis, CovarianceFrame, Hermite


# The half-width of a grid, in distances from the median to the furthest pilot path. For the
# mean of q^2 of a pendulum, the standard error was 1.3e-10, where it was 1.7e-2 without a
# fit. With a half-width of 1.05, which paths leave, it was 2e-6, and with one of 2.5, which
# sets the points far apart, 3e-9.
_WIDTH_PER_RANGE = 1.5
# The correction falls to zero from this coordinate to the edge of the grid, where the
# coordinate is 1. (With 0.6 the standard error of the pendulum was 2e-7.)
_START_OF_FALL = 0.9
# The grid points at which polynomials of different degrees are compared have coordinates
# between this one and the start of the fall.
_START_NEAR_EDGE = 0.8 * _START_OF_FALL
# The number of interpolation points along each axis, for polynomials of degree 5. With 4
# points the standard error of the pendulum was 4e-8, with 8 it was 7e-12 to 5e-10.
_STENCIL = 6
# The number of pilot paths. With 1,024 for a grid of 32 points, means were off by 15
# standard errors, since paths of probability 1e-6 left the grid. This many suffice, at no
# loss of speed.
_PILOTS = 2**13
# The grid corrects the best of the polynomials of these degrees.
_DEGREES = (0, 2, 4)
# In the middle the spacing is that of a uniform grid whose half-width is this many
# interquartile ranges. For normal states, whose interquartile range is 1.35 standard
# deviations, these are 9.4 standard deviations.
_RANGES_OF_UNIFORM_GRID = 7
# The grid is at most this many times as wide as the uniform one, since the interquartile
# range may be zero.
_MOST_STRETCH = 1e4
# The least square of `bend` in `Grid.frame`. Without bending, coordinates would be divided
# by zero.
_LEAST_SQUARED_BEND = 0.01


class StretchedFrame(eqx.Module):
    """Coordinates that go from -1 to 1 on a grid. They are linear near the middle, and grow
    with the fourth root further out, where there are few paths.

    From the coordinate `z` of `inner`, the coordinate is
    `_compressed(_compressed(factor * (z - median))) / edge`.
    """

    inner: CovarianceFrame
    median: Float[Array, " d"]
    factor: Float[Array, " d"]
    edge: Float[Array, " d"]

    def coordinates(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The coordinates of states."""
        scaled = self.factor * (self.inner.coordinates(y) - self.median)
        return _compressed(_compressed(scaled)) / self.edge

    def states(self, x: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The states with these coordinates."""
        unscaled = _expanded(_expanded(self.edge * x))
        return self.inner.states(self.median + unscaled / self.factor)


def _compressed(x: Array) -> Array:
    """An odd function with slope 1 at zero, which grows like the square root. (It takes a
    quarter of the time of a logarithm.)"""
    return x / jnp.sqrt(jnp.sqrt(1 + x**2))


def _expanded(x: Array) -> Array:
    """The inverse of `_compressed`."""
    return x * jnp.sqrt(x**2 / 2 + jnp.sqrt(1 + x**4 / 4))


def _falling_factors(x: Float[np.ndarray, "nodes d"]) -> Float[np.ndarray, " nodes"]:
    """The factors of the correction at grid points: one in the middle, and zero at the edge
    of the grid. Where they fall along an axis, their first two derivatives vanish at both
    ends."""
    fall = np.clip((np.abs(x) - _START_OF_FALL) / (1 - _START_OF_FALL), 0, 1)
    return np.prod(1 - fall**3 * (10 - 15 * fall + 6 * fall**2), axis=1)


class Grid(AbstractBasis):
    """A polynomial plus a correction on a grid. The correction is interpolated by
    polynomials of degree 5 through the 6 nearest points along each axis. It falls to zero
    towards the edge of the grid, beyond which only the polynomial remains. The polynomial
    has the degree that fits best near the edge. The `resolution` is the number of grid
    points along an axis.

    The coefficients are those of the polynomial, and then the correction at all grid
    points."""

    d: int
    resolution: int
    resolution_name: ClassVar[str] = "grid points along an axis"

    @property
    def size(self):
        return self._base.size + self.resolution**self.d

    @property
    def num_pilots(self):
        return _PILOTS

    @property
    def num_sites(self):
        return self._base.num_pilots + self.resolution**self.d

    @property
    def _base(self) -> Hermite:
        """The polynomials that the grid corrects."""
        return Hermite(self.d, max(_DEGREES))

    def frame(self, states, good, scales):
        inner = CovarianceFrame.of(states, good, scales)
        z = inner.coordinates(states)
        least = jnp.min(jnp.where(good[:, None], z, jnp.inf), axis=0)
        most = jnp.max(jnp.where(good[:, None], z, -jnp.inf), axis=0)
        # A few paths suffice for the quartiles, which leave out the NaNs of failed paths.
        few_paths = jnp.where(good[:, None], z, jnp.nan)[: self._base.num_pilots]
        probabilities = jnp.array([0.25, 0.5, 0.75])
        quartiles = jnp.nanquantile(few_paths, probabilities, axis=0)
        first_quartile, median, third_quartile = quartiles
        furthest = jnp.maximum(most - median, median - least)
        half_width = jnp.maximum(_WIDTH_PER_RANGE * furthest, 1)
        # In the middle the spacing is as on a uniform grid of this half-width.
        uniform_half_width = jnp.clip(
            _RANGES_OF_UNIFORM_GRID * (third_quartile - first_quartile),
            half_width / _MOST_STRETCH,
            half_width,
        )
        # Two conditions give `factor` and `edge` of the coordinate
        # `c(factor * (z - median)) / edge`, where `c` applies `_compressed` twice:
        #
        # 1. At the edge the coordinate is 1: `edge = c(bend)` for `bend = factor *
        #    half_width`.
        # 2. In the middle, where `c` has slope 1, the coordinate has the slope `factor /
        #    edge`, which must be `1 / uniform_half_width`.
        #
        # Together this is `bend / c(bend) = stretch`. The left side is one for `bend = 0`,
        # and about `bend ** (3 / 4)` for large `bend`. For a closed solution it is replaced
        # by `(1 + bend**2) ** (3 / 8)`, which has both properties.
        stretch = half_width / uniform_half_width
        bend = jnp.sqrt(jnp.maximum(stretch ** (8 / 3) - 1, _LEAST_SQUARED_BEND))
        return StretchedFrame(
            inner=inner,
            median=median,
            factor=bend / half_width,
            edge=_compressed(_compressed(bend)),
        )

    def coefficients(self, target, frame, states, good, keys):
        base = self._base
        num_pilots = base.num_pilots
        axes = [np.linspace(-1, 1, self.resolution)] * self.d
        # First, polynomials are fitted to the target near the pilot's states. What the best
        # of them leaves of the target at the nodes, the grid points, is the correction.
        # The coordinates of the nodes: (nodes, d).
        x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, self.d)
        nodes = frame.states(jnp.asarray(x, states.dtype))
        pilots = frame.inner.perturbed(states[:num_pilots])
        # All points are in one call, so that the target is compiled once.
        values = jax.vmap(target)(jnp.concatenate([pilots, nodes]))
        # (size of the base, degrees, S, m)
        c = base.least_squares_fits(
            values[:num_pilots], frame.inner, pilots, good[:num_pilots], _DEGREES
        )
        polynomials = base.polynomials(frame.inner, nodes)
        # (nodes, degrees, S, m)
        residual = values[num_pilots:, None] - tensordot(polynomials, c, 1)
        # A target that grows fast may overflow.
        residual = jnp.where(jnp.isfinite(residual), residual, 0)
        # For each time and component, the polynomial with the smallest residual near the
        # edge is the best.
        distance = np.max(np.abs(x), axis=1)
        is_near_edge = (distance > _START_NEAR_EDGE) & (distance < _START_OF_FALL)
        largest_residual = jnp.max(jnp.abs(residual[is_near_edge]), axis=0)
        best = jnp.argmin(largest_residual, axis=0)[None, None]
        c_of_best = jnp.take_along_axis(c, best, 1)[:, 0]
        residual_of_best = jnp.take_along_axis(residual, best, 1)[:, 0]
        factors = jnp.asarray(_falling_factors(x), residual.dtype)
        correction = residual_of_best * factors[:, None, None]
        return jnp.concatenate([c_of_best, correction])

    def value_at(self, frame, y, c):
        size = self._base.size
        correction = self.interpolate(frame.coordinates(y), c[size:])
        return self._base.value_at(frame.inner, y, c[:size]) + correction

    def interpolate(
        self, x: Float[Array, " d"], c: Float[Array, "nodes ..."]
    ) -> Float[Array, "..."]:
        """Interpolates the values `c` on the grid at the point `x`: a sum over a block of
        the nearest grid points, weighted by Lagrange polynomials. Beyond the grid the
        result is zero."""
        # The number of grid points along each axis.
        n = self.resolution
        value_shape = c.shape[1:]
        # The number of interpolation points on each side of the point.
        half = _STENCIL // 2
        # The point in units of the spacing, from the first grid point along each axis.
        position = (x + 1) * (n - 1) / 2
        # Whether `half` grid points lie on each side, along each axis.
        is_inside = jnp.all((position >= half - 1) & (position <= n - half))
        # For a point outside, the value at some point inside is computed, and dropped.
        safe_position = jnp.where(is_inside, position, n / 2)
        # The first interpolation point along each axis.
        begin = jnp.minimum(jnp.floor(safe_position) - (half - 1), n - _STENCIL)
        start_indices = jnp.pad(begin.astype(jnp.int32), (0, len(value_shape)))
        values_on_grid = c.reshape(*[n] * self.d, *value_shape)
        block_shape = *[_STENCIL] * self.d, *value_shape
        block = lax.dynamic_slice(values_on_grid, start_indices, block_shape)
        # The Lagrange polynomials of the interpolation points, at the point.
        distances = [safe_position - begin - j for j in range(_STENCIL)]
        weights = []
        for j in range(_STENCIL):
            others = [k for k in range(_STENCIL) if k != j]
            product = ft.reduce(jnp.multiply, [distances[k] for k in others])
            weights.append(product / math.prod(j - k for k in others))
        # Each pass sums over the leading axis of the block, and so removes it. What is then
        # the leading axis is the next axis of the grid.
        for axis in range(self.d):
            products = [weight[axis] * row for weight, row in zip(weights, block)]
            block = ft.reduce(jnp.add, products)
        return jnp.where(is_inside, block, 0)
