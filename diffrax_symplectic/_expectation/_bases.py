"""Functions of the state of which value functions are made, and how they are fitted."""

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

from ._polynomials import dot, hermite, least_squares, num_polynomials, tensordot


_PILOTS_PER_POLYNOMIAL, _FEWEST_PILOTS = 30, 256
# The pilot's states are moved at random by this share of their deviations: the paths of the
# first steps have few different states.
_MOVE = 0.2
# Deviations along the axes of the covariance are taken for no smaller than this share of
# the largest. Along shorter ones the points of a fit say too little.
_FLOOR = 0.1
# A grid is so many times as wide as where the pilot was, and what it holds begins to fall
# to zero at this share of that. Points of a polynomial on an axis.
_WIDER, _FALLS, _STENCIL = 1.5, 0.9, 6
# With 1,024 paths in the pilot of a grid with 32 points, means were off by 15 standard
# errors: paths of probability 1e-6 left it. Not so with these, at no loss.
_PILOTS_OF_GRID = 2**13
# What a grid adds to: the best polynomial of these degrees.
_BASE = 0, 2, 4
# Derivatives are averaged over so many paths, in many dimensions fewer.
_QUADRATIC_PILOTS, _QUADRATIC_NUMBERS = 128, 2**13

# What a function is to be at a state; with a random key, an estimate of it.
Value: TypeAlias = Callable[..., Float[Array, "C S m"]]


class Frame(eqx.Module):
    """Coordinates of states, in which they have mean zero and deviations of about one.
    Coordinates of the state that do not move are left out."""

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
        """For the points that are good, along the axes of their covariance. In units of
        `unit`, which is zero for what does not move, coordinates are comparable."""
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
        # The same in all steps: what a program makes of keys takes long to compile.
        z = np.random.default_rng(0).normal(0, _MOVE, states.shape)
        return states + dot(jnp.asarray(z, states.dtype), self.back.T)


def _inverse(unit: Float[Array, " d"]) -> Float[Array, " d"]:
    return jnp.where(unit > 0, 1 / jnp.where(unit > 0, unit, 1), 0)


class AbstractBasis(eqx.Module):
    """Functions of `d` coordinates. Candidates, numbers of a kind, are there to choose
    among. A function is a sum with `size` coefficients, an array of which the last axes are
    those of the times at which to average and of the numbers of `phi`, with one for the
    candidates before them."""

    kind: eqx.AbstractClassVar[str]
    d: eqx.AbstractVar[int]
    candidates: eqx.AbstractVar[tuple[int, ...]]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """How many coefficients a function has."""

    @property
    @abc.abstractmethod
    def pilots(self) -> int:
        """How many paths of a pilot are wanted."""

    @property
    @abc.abstractmethod
    def sites(self) -> int:
        """At how many states a function is looked at."""

    @abc.abstractmethod
    def frame(
        self, states: Float[Array, "n d"], good: Bool[Array, " n"], unit
    ) -> PyTree:
        """Coordinates for the pilot's states, those of its paths that have not failed, and
        the unit of each coordinate."""

    @abc.abstractmethod
    def fitted(
        self, value: Value, frame: Any, states, good, keys: PRNGKeyArray
    ) -> Float[Array, "size C S m"]:
        """The coefficients. `keys` are those of the pilot's paths, for estimates."""

    @abc.abstractmethod
    def combined(
        self, frame: Any, y: Float[Array, " d"], c: Float[Array, "size *C S m"]
    ) -> Float[Array, "*C S m"]:
        """The function with these coefficients, at a state."""


class Hermite(AbstractBasis):
    """Products of Hermite polynomials, with a candidate for each of the total degrees."""

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
        """The polynomials that are closest to the values at the points that are good."""
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
    """Coordinates from -1 to 1 on a grid: about a middle they are even, further out they
    grow with the fourth root, where few paths go far."""

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
    """An odd function with the slope 1 at zero, which grows with the square root. (It takes
    a quarter of the time of a logarithm.)"""
    return x / jnp.sqrt(jnp.sqrt(1 + x**2))


def _straight(x):
    """Its inverse."""
    return x * jnp.sqrt(x**2 / 2 + jnp.sqrt(1 + x**4 / 4))


class Grid(AbstractBasis):
    """A polynomial, and what it leaves on a grid with so many points along each axis. In
    between is the polynomial of degree 5 in each coordinate through the 6 nearest points on
    its axis. Towards the edge it falls to zero: beyond it the polynomial stays, of the
    degree that is closest near the edge."""

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
        # A few of them tell quartiles well enough.
        few = jnp.where(good[:, None], z, jnp.nan)[: self._base.pilots]
        quarter, middle, other = jnp.nanquantile(
            few, jnp.array([0.25, 0.5, 0.75]), axis=0
        )
        half = jnp.maximum(_WIDER * jnp.maximum(high - middle, middle - low), 1)
        # As far from each other in the middle as on an even grid of seven times the
        # quartile's distance to either side, or of all if that is less.
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
        # Where it grows fast it is not finite.
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
        """What is on the grid, at a point."""
        n, k, last = self.candidates[0], _STENCIL, c.shape[1:]
        place = (x + 1) * (n - 1) / 2
        inside = jnp.all((place >= k // 2 - 1) & (place <= n - k // 2))
        place = jnp.clip(jnp.where(inside, place, n / 2), k // 2 - 1, n - k // 2)
        begin = jnp.minimum(jnp.floor(place) - (k // 2 - 1), n - k)
        start = jnp.pad(begin.astype(jnp.int32), (0, len(last)))
        shape = *[k] * self.d, *last
        block = lax.dynamic_slice(c.reshape(*[n] * self.d, *last), start, shape)
        # Lagrange's polynomials, as products of what is left and right of each point.
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
    """From 1 at 0 to 0 at 1, with two derivatives that are zero at both."""
    x = np.clip(x, 0, 1)
    return 1 - x**3 * (10 - 15 * x + 6 * x**2)


class Quadratic(AbstractBasis):
    """Linear and quadratic functions, with a candidate for each degree. Their coefficients
    are the first and the second derivatives at the origin, one after another. They are the
    means of those at the pilot's states: for Gaussian states that is best in the mean
    square, by Stein's lemma."""

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
        # A Hessian takes as long as `d` gradients, and a gradient as two values.
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
