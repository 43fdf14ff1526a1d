"""Functions of the state of which value functions are made, and how they are fitted."""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ._polynomials import dot, hermite, least_squares, num_polynomials
from ._steps import along


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
# What a grid adds to: polynomials of these degrees.
_BASE = 0, 2, 4
# Derivatives are averaged over so many paths, in many dimensions fewer.
_QUADRATIC_PILOTS, _QUADRATIC_NUMBERS = 128, 2**13

# What a function is to be at a state; with a random key, an estimate of it.
Value: TypeAlias = Callable[..., Float[Array, "C S m"]]


class Frame(eqx.Module):
    """Coordinates of states: in units of their spread, and along the axes of their
    covariance if `to` is there. What does not move has the unit zero, and is left out."""

    mean: Float[Array, " d"]
    unit: Float[Array, " d"]
    # Of shape `(d, d)`, if they are there.
    to: Any = None
    back: Any = None

    def at(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        moves = self.unit > 0
        z = jnp.where(moves, (y - self.mean) / jnp.where(moves, self.unit, 1), 0)
        return z if self.to is None else dot(z, self.to.T)

    def states(self, z: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        z = z if self.back is None else dot(z, self.back.T)
        return self.mean + self.unit * z

    @staticmethod
    def of(
        points: Float[Array, "n d"], good: Bool[Array, " n"], unit: Float[Array, " d"]
    ) -> "Frame":
        """In which the points that are good have mean zero and deviations of about one. In
        units of `unit` coordinates are comparable."""
        share = good.astype(points.dtype) / jnp.maximum(jnp.sum(good), 1)
        mean = share @ points
        off = Frame(mean, unit).at(points)
        variances, axes = jnp.linalg.eigh((off.T * share) @ off)
        tiny = jnp.finfo(points.dtype).eps ** 2
        size = jnp.sqrt(jnp.maximum(variances, _FLOOR**2 * variances[-1]) + tiny)
        return Frame(mean, unit, axes.T / size[:, None], axes * size)

    def moved(self, states: Float[Array, "n d"]) -> Float[Array, "n d"]:
        # The same in all steps: what a program makes of keys takes long to compile.
        z = np.random.default_rng(0).normal(0, _MOVE, states.shape)
        return states + self.unit * dot(jnp.asarray(z, states.dtype), self.back.T)


class AbstractBasis(eqx.Module):
    """Functions of `d` coordinates. Candidates, numbers of a kind, are there to choose
    among; the first is 0, a constant, which takes nothing away from a path.

    Coefficients are a PyTree of arrays whose last axes are those of the times at which to
    average and of the numbers of `phi`, with one for the candidates before them.
    """

    kind: eqx.AbstractClassVar[str]
    d: eqx.AbstractVar[int]
    candidates: eqx.AbstractVar[tuple[int, ...]]

    @property
    @abc.abstractmethod
    def pilots(self) -> int:
        """How many paths of a pilot are wanted."""

    @property
    @abc.abstractmethod
    def sites(self) -> int:
        """At how many states a function is looked at."""

    @abc.abstractmethod
    def zeros(self, outputs: tuple[int, int], dtype) -> PyTree[Array]:
        """Coefficients of functions that are zero."""

    @abc.abstractmethod
    def frame(
        self, states: Float[Array, "n d"], good: Bool[Array, " n"], unit
    ) -> PyTree:
        """Coordinates for the pilot's states, those of its paths that have not failed, and
        the unit of each coordinate."""

    @abc.abstractmethod
    def fitted(
        self, value: Value, frame: Any, states, good, keys: PRNGKeyArray
    ) -> PyTree[Array]:
        """The coefficients. `keys` are those of the pilot's paths, for estimates."""

    @abc.abstractmethod
    def combined(self, frame: Any, y: Float[Array, " d"], c: PyTree[Array]) -> Array:
        """The function with these coefficients, at a state."""

    def chosen(self, c: PyTree[Array], best: Int[np.ndarray, "S m"]) -> PyTree[Array]:
        """Of each number the coefficients of its own candidate."""
        return _taken(c, best)


def _taken(c: Float[Array, "... C S m"], best: Int[np.ndarray, "S m"]) -> Array:
    index = best.reshape(*[1] * (c.ndim - 2), *best.shape)
    return jnp.take_along_axis(c, index, -3).squeeze(-3)


class Stretched(eqx.Module):
    """Coordinates from -1 to 1 on a grid: about a middle they are even, further out they
    grow with the logarithm, where few paths go far."""

    inner: Frame
    middle: Float[Array, " d"]
    # `asinh(factor * z) / width`
    factor: Float[Array, " d"]
    width: Float[Array, " d"]

    def at(self, z: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return jnp.arcsinh(self.factor * (z - self.middle)) / self.width

    def back(self, x: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return self.middle + jnp.sinh(self.width * x) / self.factor


class Grid(AbstractBasis):
    """Polynomials, and what they leave on a grid with `size` points along each axis. In
    between is the polynomial of degree 5 in each coordinate through the 6 nearest points on
    its axis. Towards the edge it falls to zero: beyond it the polynomial stays, of the
    degree that is closest near the edge. Candidates are the polynomials alone, and with the
    grid."""

    kind: ClassVar[str] = "degree, or grid points along an axis"
    d: int
    size: int

    @property
    def candidates(self):
        return *_BASE, self.size

    @property
    def pilots(self):
        return _PILOTS_OF_GRID

    @property
    def sites(self):
        return self.size**self.d + self._few

    @property
    def _few(self) -> int:
        return max(
            _FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * num_polynomials(self.d, _BASE[-1])
        )

    def zeros(self, outputs, dtype):
        count = num_polynomials(self.d, _BASE[-1])
        polynomials = jnp.zeros((count, len(self.candidates), *outputs), dtype)
        return polynomials, jnp.zeros((self.size**self.d, *outputs), dtype)

    def frame(self, states, good, unit):
        inner = Frame.of(states, good, unit)
        z = inner.at(states)
        at = lambda q: jnp.nanquantile(jnp.where(good[:, None], z, jnp.nan), q, axis=0)
        low, quarter, middle, other, high = map(at, (0.0, 0.25, 0.5, 0.75, 1.0))
        half = jnp.maximum(_WIDER * jnp.maximum(high - middle, middle - low), 1)
        # As far from each other in the middle as on an even grid of eight times the
        # quartile's distance to either side, or of all if that is less.
        even = jnp.clip(8 * (other - quarter), half / 1e4, half)
        width = _asinh_width(half / even)
        factor = jnp.sinh(width) / half
        return Stretched(inner, middle, factor, width)

    def fitted(self, value, frame, states, good, keys):
        few, inner = slice(None, self._few), frame.inner
        axis = np.linspace(-1, 1, self.size)
        x = np.stack(np.meshgrid(*[axis] * self.d, indexing="ij"), -1).reshape(
            -1, self.d
        )
        nodes = inner.states(frame.back(jnp.asarray(x, states.dtype)))
        points = jnp.concatenate([inner.moved(states[few]), nodes])
        values = jax.vmap(value)(points)
        B = jax.vmap(lambda x: jnp.stack(hermite(x, _BASE[-1])))(inner.at(points))
        # Of the last candidate, the grid, with each of the polynomials.
        grids = values[:, -1:]
        each = jnp.concatenate([values[few], *[grids[few]] * (len(_BASE) - 1)], axis=1)
        sizes = [num_polynomials(self.d, k) for k in _BASE]
        c = _polynomials(B[few], each, good[few], (*sizes, *sizes))
        alone, base = c[:, : len(_BASE)], c[:, len(_BASE) :]
        nodes = slice(self._few, None)
        left = grids[nodes] - jnp.tensordot(B[nodes], base, 1)
        finite = jnp.isfinite(left)
        far = np.max(np.abs(x), axis=1)
        edge = (far > _FALLS * 0.8) & (far < _FALLS)
        near_edge = jnp.where(finite & edge[:, None, None, None], jnp.abs(left), 0)
        best = jnp.argmin(jnp.max(near_edge, axis=0), axis=0)[None, None]
        left = jnp.take_along_axis(jnp.where(finite, left, 0), best, 1)[:, 0]
        falling = np.prod(_falling((np.abs(x) - _FALLS) / (1 - _FALLS)), axis=1)
        grid = left * jnp.asarray(falling, left.dtype)[:, None, None]
        return jnp.concatenate([alone, jnp.take_along_axis(base, best, 1)], 1), grid

    def combined(self, frame, y, c):
        polynomials, grid = c
        z = frame.inner.at(y)
        out = jnp.tensordot(jnp.stack(hermite(z, _BASE[-1])), polynomials, 1)
        there = self._interpolated(frame.at(z), grid)
        return out.at[-1].add(there) if polynomials.ndim > grid.ndim else out + there

    def _interpolated(self, x, c):
        n, k, last = self.size, _STENCIL, c.shape[1:]
        place = (x + 1) * (n - 1) / 2
        inside = jnp.all((place >= k // 2 - 1) & (place <= n - k // 2))
        place = jnp.clip(jnp.where(inside, place, n / 2), k // 2 - 1, n - k // 2)
        begin = jnp.minimum(jnp.floor(place) - (k // 2 - 1), n - k)
        off = (place - begin)[:, None] - np.arange(k)
        each = [(j, np.delete(np.arange(k), j)) for j in range(k)]
        weights = jnp.stack([jnp.prod(off[:, m] / (j - m), axis=1) for j, m in each])
        block = lax.dynamic_slice(
            c.reshape(*[n] * self.d, *last),
            jnp.pad(begin.astype(jnp.int32), (0, len(last))),
            (*[k] * self.d, *last),
        )
        for j in range(self.d):
            block = jnp.tensordot(weights[:, j], block, 1)
        return jnp.where(inside, block, 0)

    def chosen(self, c, best):
        polynomials, grid = c
        last = len(self.candidates) - 1
        return _taken(polynomials, best), grid * (best == last).astype(grid.dtype)


def _asinh_width(ratio):
    """`w` with `sinh(w) / w = ratio`, by Newton's method for its logarithm from above;
    no smaller than 0.1, which is even."""
    w = jnp.log(2 * ratio) + jnp.log(jnp.log(2 * ratio) + 1) + 1
    for _ in range(12):
        f = jnp.log(jnp.sinh(w) / w) - jnp.log(ratio)
        w = jnp.maximum(w - f / jnp.maximum(1 / jnp.tanh(w) - 1 / w, 0.03), 0.1)
    return w


def _falling(x: np.ndarray) -> np.ndarray:
    """From 1 at 0 to 0 at 1, with two derivatives that are zero at both."""
    x = np.clip(x, 0, 1)
    return 1 - x**3 * (10 - 15 * x + 6 * x**2)


class Hermite(AbstractBasis):
    """Products of Hermite polynomials, with a candidate for each of the total degrees."""

    kind: ClassVar[str] = "degree"
    d: int
    candidates: tuple[int, ...]

    @property
    def pilots(self):
        count = num_polynomials(self.d, max(self.candidates))
        return max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * count)

    @property
    def sites(self):
        return self.pilots

    def zeros(self, outputs, dtype):
        count = num_polynomials(self.d, max(self.candidates))
        return jnp.zeros((count, len(self.candidates), *outputs), dtype)

    def frame(self, states, good, unit):
        return Frame.of(states, good, unit)

    def fitted(self, value, frame, states, good, keys):
        points = frame.moved(states)
        degree = max(self.candidates)
        B = jax.vmap(lambda x: jnp.stack(hermite(x, degree)))(frame.at(points))
        sizes = tuple(num_polynomials(self.d, k) for k in self.candidates)
        return _polynomials(B, jax.vmap(value)(points), good, sizes)

    def combined(self, frame, y, c):
        products = zip(hermite(frame.at(y), max(self.candidates)), c)
        return ft.reduce(jnp.add, [b * c for b, c in products])


def _polynomials(B, values, good, sizes) -> Float[Array, "P C S m"]:
    """The fit to the values at the points where the polynomials are `B`, of those that are
    good and finite."""
    flat = values.reshape(*values.shape[:2], -1)
    finite = lambda x: jnp.isfinite(x).reshape(len(x), -1).all(axis=1)
    good = good & finite(B) & finite(flat)
    rows = lambda x: jnp.where(along(good, x), x, 0)
    c = least_squares(rows(B), rows(flat), sizes)
    return c.reshape(-1, *values.shape[1:])


class Quadratic(AbstractBasis):
    """Linear and quadratic functions, with a candidate for each degree. Their coefficients
    are the first and the second derivatives at the origin, one after another. They are the
    means of those at the pilot's states: for Gaussian states that is best in the mean
    square, by Stein's lemma."""

    kind: ClassVar[str] = "degree"
    d: int
    candidates: tuple[int, ...]

    @property
    def pilots(self):
        return int(np.clip(_QUADRATIC_NUMBERS // self.d, 16, _QUADRATIC_PILOTS))

    @property
    def sites(self):
        # A Hessian takes as long as `d` gradients, and a gradient as two values.
        return 2 * self.d * self.pilots

    def zeros(self, outputs, dtype):
        shape = self.d + self.d**2, len(self.candidates), *outputs
        return jnp.zeros(shape, dtype)

    def frame(self, states, good, unit):
        share = good.astype(states.dtype) / jnp.maximum(jnp.sum(good), 1)
        return Frame(share @ states, unit)

    def fitted(self, value, frame, states, good, keys):
        def derivatives(args):
            key, y = args
            at = lambda z: value(y + frame.unit * z, key)

            def slope(z):
                first = jax.jacrev(at)(z)
                return first, first

            second, first = jax.jacfwd(slope, has_aux=True)(jnp.zeros_like(y))
            second = second.reshape(*first.shape[:-1], -1)
            return jnp.moveaxis(jnp.concatenate([first, second], -1), -1, 0)

        each = lax.map(derivatives, (keys, states))
        share = good.astype(each.dtype) / jnp.maximum(jnp.sum(good), 1)
        mean = jnp.tensordot(share, jnp.where(jnp.isfinite(each), each, 0), 1)
        order = np.repeat([1, 2], [self.d, self.d**2])[:, None, None, None]
        return jnp.where(order <= np.array(self.candidates)[:, None, None], mean, 0)

    def combined(self, frame, y, c):
        z, d = frame.at(y), len(y)
        second = c[d:].reshape(d, d, *c.shape[1:])
        return jnp.tensordot(z, c[:d] + jnp.tensordot(z, second, 1) / 2, 1)
