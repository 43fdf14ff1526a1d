"""The bases in which value functions are fitted."""

import abc
import functools as ft
import itertools
import math
from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .polynomials import dot, hermite, least_squares, num_polynomials, tensordot


_PILOTS_PER_POLYNOMIAL, _FEWEST_PILOTS = 30, 256
# The pilot's states are perturbed by this fraction of their standard deviations: after the
# first steps the paths are in only a few different states.
_MOVE = 0.2
# Lower bound of the standard deviations along the axes of the covariance, as a fraction of
# the largest. Along shorter axes the points do not determine a fit.
_FLOOR = 0.1
# The width of a grid relative to the pilot's range; the fraction of the width at which its
# values start to fall to zero; the interpolation points along each axis.
_WIDER, _FALLS, _STENCIL = 1.5, 0.9, 6
# With 1,024 pilot paths for a grid of 32 points, means were off by 15 standard errors:
# paths of probability 1e-6 left the grid. This many suffice, at no loss of speed.
_PILOTS_OF_GRID = 2**13
# A grid corrects the best polynomial of these degrees.
_BASE = 0, 2, 4
# Derivatives are averaged over this many paths, fewer in many dimensions.
_QUADRATIC_PILOTS, _QUADRATIC_NUMBERS = 128, 2**13

# The target value of a function at a state; with a random key, an estimate of it.
Value: TypeAlias = Callable[..., Float[Array, "C S m"]]


class Frame(eqx.Module):
    """Coordinates in which the states have mean zero and standard deviations of about one.
    Components of the state that do not move are ignored."""

    mean: Float[Array, " d"]
    to: Float[Array, "d d"]
    back: Float[Array, "d d"]

    def at(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return dot(y - self.mean, self.to.T)

    def states(self, z: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return self.mean + dot(z, self.back.T)

    @staticmethod
    def of(
        points: Float[Array, "n d"], good: Bool[Array, " n"], unit: Float[Array, " d"]
    ) -> "Frame":
        """The frame along the axes of the covariance of the good points. `unit` makes the
        components comparable, and is zero for components that do not move."""
        share = good.astype(points.dtype) / jnp.maximum(jnp.sum(good), 1)
        mean, inverse = share @ points, _inverse(unit)
        off = (points - mean) * inverse
        variances, axes = jnp.linalg.eigh((off.T * share) @ off)
        tiny = jnp.finfo(points.dtype).eps ** 2
        size = jnp.sqrt(jnp.maximum(variances, _FLOOR**2 * variances[-1]) + tiny)
        return Frame(
            mean, axes.T / size[:, None] * inverse, unit[:, None] * axes * size
        )

    def moved(self, states: Float[Array, "n d"]) -> Float[Array, "n d"]:
        # The same in all steps: drawing from keys would take long to compile.
        z = np.random.default_rng(0).normal(0, _MOVE, states.shape)
        return states + dot(jnp.asarray(z, states.dtype), self.back.T)


def _inverse(unit: Float[Array, " d"]) -> Float[Array, " d"]:
    return jnp.where(unit > 0, 1 / jnp.where(unit > 0, unit, 1), 0)


class AbstractBasis(eqx.Module):
    """Functions of `d` coordinates, with several candidates (such as degrees) to choose
    from. A function is a linear combination with `size` coefficients. The trailing axes of
    the coefficients are candidates, times at which to average, and components of `phi`."""

    kind: eqx.AbstractClassVar[str]
    d: eqx.AbstractVar[int]
    candidates: eqx.AbstractVar[tuple[int, ...]]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """The number of coefficients of a function."""

    @property
    @abc.abstractmethod
    def pilots(self) -> int:
        """The number of pilot paths that a fit needs."""

    @property
    @abc.abstractmethod
    def sites(self) -> int:
        """The number of states at which a fit evaluates its target."""

    @abc.abstractmethod
    def frame(
        self, states: Float[Array, "n d"], good: Bool[Array, " n"], unit
    ) -> PyTree:
        """The coordinates, from the pilot's states, its good paths, and the unit of each
        component."""

    @abc.abstractmethod
    def fitted(
        self, value: Value, frame: Any, states, good, keys: PRNGKeyArray
    ) -> Float[Array, "size C S m"]:
        """The coefficients. `keys` are the keys of the pilot's paths, for estimates."""

    @abc.abstractmethod
    def combined(
        self, frame: Any, y: Float[Array, " d"], c: Float[Array, "size *C S m"]
    ) -> Float[Array, "*C S m"]:
        """The function with these coefficients at a state."""


class Hermite(AbstractBasis):
    """Products of Hermite polynomials, with a candidate for each total degree."""

    kind: ClassVar[str] = "degree"
    d: int
    candidates: tuple[int, ...]

    @property
    def size(self):
        return num_polynomials(self.d, max(self.candidates))

    @property
    def pilots(self):
        return max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * self.size)

    @property
    def sites(self):
        return self.pilots

    def frame(self, states, good, unit):
        return Frame.of(states, good, unit)

    def fitted(self, value, frame, states, good, keys):
        points = frame.moved(states)
        return self.fitted_to(jax.vmap(value)(points), frame, points, good)

    def fitted_to(self, values, frame, points, good):
        """The least-squares fit to the values at the good points."""
        B, flat = self.at(frame, points), values.reshape(*values.shape[:2], -1)
        finite = lambda x: jnp.isfinite(x).reshape(len(x), -1).all(axis=1)
        good = good & finite(B) & finite(flat)
        B, flat = (
            jnp.where(good[:, None], B, 0),
            jnp.where(good[:, None, None], flat, 0),
        )
        c = least_squares(
            B, flat, [num_polynomials(self.d, k) for k in self.candidates]
        )
        return c.reshape(-1, *values.shape[1:])

    def at(self, frame, points: Float[Array, "n d"]) -> Float[Array, "n size"]:
        each = lambda z: jnp.stack(hermite(z, max(self.candidates)))
        return jax.vmap(each)(frame.at(points))

    def combined(self, frame, y, c):
        products = zip(hermite(frame.at(y), max(self.candidates)), c)
        return ft.reduce(jnp.add, [b * c for b, c in products])


class Stretched(eqx.Module):
    """Coordinates from -1 to 1 on a grid: linear near the middle, and growing with the
    fourth root further out, where there are few paths."""

    inner: Frame
    middle: Float[Array, " d"]
    # `_bent(_bent(factor * (z - middle))) / edge`
    factor: Float[Array, " d"]
    edge: Float[Array, " d"]

    def at(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return _bent(_bent(self.factor * (self.inner.at(y) - self.middle))) / self.edge

    def states(self, x: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        far = _straight(_straight(self.edge * x))
        return self.inner.states(self.middle + far / self.factor)


def _bent(x):
    """An odd function with slope 1 at zero, which grows like the square root. (It takes a
    quarter of the time of a logarithm.)"""
    return x / jnp.sqrt(jnp.sqrt(1 + x**2))


def _straight(x):
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
        return _PILOTS_OF_GRID

    @property
    def sites(self):
        return self._base.pilots + self.candidates[0] ** self.d

    @property
    def _base(self) -> Hermite:
        return Hermite(self.d, _BASE)

    def frame(self, states, good, unit):
        inner = Frame.of(states, good, unit)
        z = inner.at(states)
        low = jnp.min(jnp.where(good[:, None], z, jnp.inf), axis=0)
        high = jnp.max(jnp.where(good[:, None], z, -jnp.inf), axis=0)
        # A few states suffice for the quartiles.
        few = jnp.where(good[:, None], z, jnp.nan)[: self._base.pilots]
        quarter, middle, other = jnp.nanquantile(
            few, jnp.array([0.25, 0.5, 0.75]), axis=0
        )
        half = jnp.maximum(_WIDER * jnp.maximum(high - middle, middle - low), 1)
        # In the middle the spacing is as on a uniform grid whose half-width is seven times
        # the interquartile range, or `half` if that is less.
        even = jnp.clip(7 * (other - quarter), half / 1e4, half)
        bend = jnp.sqrt(jnp.maximum((half / even) ** (8 / 3) - 1, 0.01))
        return Stretched(inner, middle, bend / half, _bent(_bent(bend)))

    def fitted(self, value, frame, states, good, keys):
        base, inner, n = self._base, frame.inner, self._base.pilots
        axes = [np.linspace(-1, 1, self.candidates[0])] * self.d
        x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, self.d)
        nodes = frame.states(jnp.asarray(x, states.dtype))
        points = jnp.concatenate([inner.moved(states[:n]), nodes])
        values = jax.vmap(value)(points)
        few = jnp.repeat(values[:n], len(_BASE), axis=1)
        c = base.fitted_to(few, inner, points[:n], good[:n])
        left = values[n:] - tensordot(base.at(inner, nodes), c, 1)
        # The target may overflow where it grows fast.
        left = jnp.where(jnp.isfinite(left), left, 0)
        far = np.max(np.abs(x), axis=1)
        near_edge = left[(far > _FALLS * 0.8) & (far < _FALLS)]
        best = jnp.argmin(jnp.max(jnp.abs(near_edge), axis=0), axis=0)[None, None]
        left, c = (jnp.take_along_axis(y, best, 1) for y in (left, c))
        falling = np.prod(_falling((np.abs(x) - _FALLS) / (1 - _FALLS)), axis=1)
        falling = jnp.asarray(falling, left.dtype)[:, None, None, None]
        return jnp.concatenate([c, left * falling])

    def combined(self, frame, y, c):
        there = self.interpolated(frame.at(y), c[self._base.size :])
        return self._base.combined(frame.inner, y, c[: self._base.size]) + there

    def interpolated(self, x: Float[Array, " d"], c: Float[Array, "nodes ..."]):
        """The values on the grid, interpolated at a point."""
        n, k, last = self.candidates[0], _STENCIL, c.shape[1:]
        place = (x + 1) * (n - 1) / 2
        inside = jnp.all((place >= k // 2 - 1) & (place <= n - k // 2))
        place = jnp.clip(jnp.where(inside, place, n / 2), k // 2 - 1, n - k // 2)
        begin = jnp.minimum(jnp.floor(place) - (k // 2 - 1), n - k)
        start = jnp.pad(begin.astype(jnp.int32), (0, len(last)))
        shape = *[k] * self.d, *last
        block = lax.dynamic_slice(c.reshape(*[n] * self.d, *last), start, shape)
        # Lagrange polynomials, as products over the points to the left and to the right.
        off = [place - begin - j for j in range(k)]
        left = [*itertools.accumulate(off[:-1], jnp.multiply, initial=1.0)]
        right = [*itertools.accumulate(off[:0:-1], jnp.multiply, initial=1.0)][::-1]
        signed = [(-1) ** (k - 1 - j) * math.factorial(j) for j in range(k)]
        scale = [s * math.factorial(k - 1 - j) for j, s in enumerate(signed)]
        weights = [x * y / s for x, y, s in zip(left, right, scale)]
        for j in range(self.d):
            products = [w[j] * values for w, values in zip(weights, block)]
            block = ft.reduce(jnp.add, products)
        return jnp.where(inside, block, 0)


def _falling(x: np.ndarray) -> np.ndarray:
    """Falls from 1 at 0 to 0 at 1, with two vanishing derivatives at both ends."""
    x = np.clip(x, 0, 1)
    return 1 - x**3 * (10 - 15 * x + 6 * x**2)


class Quadratic(AbstractBasis):
    """Linear and quadratic functions, with a candidate for each degree. The coefficients
    are the first and then the second derivatives, averaged over the pilot's states. For
    Gaussian states this is the least-squares fit, by Stein's lemma."""

    kind: ClassVar[str] = "degree"
    d: int
    candidates: tuple[int, ...]

    @property
    def size(self):
        return self.d + self.d**2

    @property
    def pilots(self):
        return int(np.clip(_QUADRATIC_NUMBERS // self.d, 16, _QUADRATIC_PILOTS))

    @property
    def sites(self):
        # A Hessian costs as much as `d` gradients, and a gradient as much as two values.
        return 2 * self.d * self.pilots

    def frame(self, states, good, unit):
        share = good.astype(states.dtype) / jnp.maximum(jnp.sum(good), 1)
        return share @ states, unit

    def fitted(self, value, frame, states, good, keys):
        def derivatives(args):
            key, y = args
            at = lambda z: value(y + frame[1] * z, key)

            def slope(z):
                first = jax.jacrev(at)(z)
                return first, first

            second, first = jax.jacfwd(slope, has_aux=True)(jnp.zeros_like(y))
            second = second.reshape(*first.shape[:-1], -1)
            return jnp.moveaxis(jnp.concatenate([first, second], -1), -1, 0)

        each = lax.map(derivatives, (keys, states))
        share = good.astype(each.dtype) / jnp.maximum(jnp.sum(good), 1)
        mean = tensordot(share, jnp.where(jnp.isfinite(each), each, 0), 1)
        order = np.repeat([1, 2], [self.d, self.d**2])[:, None, None, None]
        return jnp.where(order <= np.array(self.candidates)[:, None, None], mean, 0)

    def combined(self, frame, y, c):
        mean, unit = frame
        z, d = (y - mean) * _inverse(unit), len(y)
        second = c[d:].reshape(d, d, *c.shape[1:])
        return tensordot(z, c[:d] + tensordot(z, second, 1) / 2, 1)
