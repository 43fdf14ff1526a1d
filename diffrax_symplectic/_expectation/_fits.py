"""Value functions, fitted backwards in time from where a pilot was."""

import abc
import functools as ft
import itertools
import math
from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .._custom_types import Y
from ._steps import along, Ensemble, ravel


_PILOTS_PER_POLYNOMIAL, _FEWEST_PILOTS = 30, 256
# The pilot's states are moved at random by this share of their deviations: the paths of the
# first steps have few different states.
_MOVE = 0.2
# Deviations along the axes of the covariance are taken for no smaller than this share of
# the largest. Along shorter ones the points of a fit say too little.
_FLOOR = 0.1
# A grid is so many times as wide as where the pilot was: with 1.5 rare paths near its edge
# made errors that the spread of others does not show. Points of a polynomial on an axis.
_WIDER, _STENCIL = 2, 6
# With 1,024 paths in the pilot of a grid with 32 points, means were off by 15 standard
# errors: paths of probability 1e-6 left it. Not so with these, at no loss.
_PILOTS_OF_GRID = 2**13
# Derivatives are averaged over so many paths.
_QUADRATIC_PILOTS = 128
# Second derivatives by the noise are averaged over so many states.
_SECOND = 32
_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)

# What a function is to be at a state; with a random key, an estimate of it.
Value: TypeAlias = Callable[..., Float[Array, "C S m"]]


class Frame(eqx.Module):
    """Coordinates of states: the axes of their covariance, or none but their mean."""

    mean: Float[Array, " d"]
    # Of shape `(d, d)`, if they are there.
    to: Any = None
    back: Any = None

    def at(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return y - self.mean if self.to is None else _dot(y - self.mean, self.to.T)

    @staticmethod
    def of(
        points: Float[Array, "n d"], good: Bool[Array, " n"], unit: Float[Array, " d"]
    ) -> "Frame":
        """In which the points that are good have mean zero and deviations of about one. In
        units of `unit` coordinates are comparable."""
        share = good.astype(points.dtype) / jnp.maximum(jnp.sum(good), 1)
        unit = jnp.where(unit > 0, unit, 1)
        mean = share @ points
        off = (points - mean) / unit
        variances, axes = jnp.linalg.eigh((off.T * share) @ off)
        tiny = jnp.finfo(points.dtype).eps ** 2
        size = jnp.sqrt(jnp.maximum(variances, _FLOOR**2 * variances[-1]) + tiny)
        return Frame(mean, axes.T / size[:, None] / unit, unit[:, None] * axes * size)


class AbstractBasis(eqx.Module):
    """Functions of `d` coordinates, of which value functions are made. Candidates, numbers
    of a kind, are there to choose among."""

    kind: eqx.AbstractClassVar[str]
    d: eqx.AbstractVar[int]
    candidates: eqx.AbstractVar[tuple[int, ...]]

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """How many paths of a pilot are wanted, how many coefficients (`P`) there are, and
        for how many candidates (`C`) there are some."""

    @abc.abstractmethod
    def sites(
        self, states: Float[Array, "n d"], good: Bool[Array, " n"], unit, key
    ) -> tuple[Frame, Float[Array, "sites d"]]:
        """Coordinates, and states at which to look at the function that is to be fitted,
        for the pilot's states, those of its paths that have not failed, the unit of each
        coordinate, and a random key."""

    @abc.abstractmethod
    def fitted(
        self, value: Value, frame: Frame, sites, good, keys
    ) -> Float[Array, "P C S m"]:
        """The coefficients."""

    @abc.abstractmethod
    def combined(self, x: Float[Array, " d"], c: Float[Array, "P ..."]) -> Array:
        """The sum with these coefficients, at a point."""

    def chosen(self, c: Float[Array, "... C S m"], best: Int[np.ndarray, "S m"]):
        """Of each number the coefficients of its own candidate."""
        index = best.reshape(*[1] * (c.ndim - 2), *best.shape)
        return jnp.take_along_axis(c, index, -3).squeeze(-3)


class Grid(AbstractBasis):
    """Values on a grid with `candidates[1]` points along each axis. In between is the
    polynomial of degree 5 in each coordinate through the 6 nearest points on its axis. The
    other candidate, 0, is nothing at all."""

    kind: ClassVar[str] = "grid points along an axis"
    d: int
    candidates: tuple[int, int]

    @property
    def shape(self):
        nodes = self.candidates[1] ** self.d
        return max(nodes, _PILOTS_OF_GRID), nodes, 1

    def sites(self, states, good, unit, key):
        frame = Frame.of(states, good, unit)
        x = frame.at(states)
        low = jnp.min(jnp.where(good[:, None], x, jnp.inf), axis=0)
        high = jnp.max(jnp.where(good[:, None], x, -jnp.inf), axis=0)
        half = jnp.maximum(_WIDER * (high - low) / 2, 1)
        middle = frame.mean + _dot(frame.back, (low + high) / 2)
        frame = Frame(middle, frame.to / half[:, None], frame.back * half)
        axis = np.linspace(-1, 1, self.candidates[1])
        nodes = np.stack(np.meshgrid(*[axis] * self.d, indexing="ij"), -1)
        nodes = jnp.asarray(nodes.reshape(-1, self.d), x.dtype)
        return frame, frame.mean + _dot(nodes, frame.back.T)

    def fitted(self, value, frame, sites, good, keys):
        values = jax.vmap(value)(sites)
        return jnp.where(jnp.isfinite(values), values, 0)

    def combined(self, x, c):
        n, k, last = self.candidates[1], _STENCIL, c.shape[1:]
        # Beyond the grid, and between points with too few others about them, it is
        # constant. To go on with the polynomial would amplify errors in each step.
        place = jnp.clip((x + 1) * (n - 1) / 2, k // 2 - 1, n - k // 2)
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
        return block

    def chosen(self, c, best):
        return c[..., 0, :, :] * best.astype(c.dtype)


class Hermite(AbstractBasis):
    """Products of Hermite polynomials, with a candidate for each of the total degrees."""

    kind: ClassVar[str] = "degree"
    d: int
    candidates: tuple[int, ...]

    @property
    def shape(self):
        count = num_polynomials(self.d, max(self.candidates))
        pilots = max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * count)
        return pilots, count, len(self.candidates)

    def sites(self, states, good, unit, key):
        frame = Frame.of(states, good, unit)
        z = _MOVE * jr.normal(key, states.shape, states.dtype)
        return frame, states + _dot(z, frame.back.T)

    def fitted(self, value, frame, sites, good, keys):
        values = jax.vmap(value)(sites)
        flat = values.reshape(*values.shape[:2], -1)
        B = jax.vmap(lambda x: jnp.stack(hermite(x, max(self.candidates))))(
            frame.at(sites)
        )
        finite = lambda x: jnp.isfinite(x).reshape(len(x), -1).all(axis=1)
        good = good & finite(B) & finite(flat)
        rows = lambda x: jnp.where(along(good, x), x, 0)
        sizes = tuple(num_polynomials(self.d, k) for k in self.candidates)
        c = least_squares(rows(B), rows(flat), sizes)
        return c.reshape(-1, *values.shape[1:])

    def combined(self, x, c):
        products = zip(hermite(x, max(self.candidates)), c)
        return ft.reduce(jnp.add, [b * c for b, c in products])


class Quadratic(AbstractBasis):
    """Linear and quadratic functions, with a candidate for each degree. Their coefficients
    are the first and the second derivatives at the origin, one after another. They are the
    means of those at the pilot's states: for Gaussian states that is best in the mean
    square, by Stein's lemma."""

    kind: ClassVar[str] = "degree"
    d: int
    candidates: tuple[int, ...]

    @property
    def shape(self):
        return _QUADRATIC_PILOTS, self.d + self.d**2, len(self.candidates)

    def sites(self, states, good, unit, key):
        share = good.astype(states.dtype) / jnp.maximum(jnp.sum(good), 1)
        return Frame(share @ states), states

    def fitted(self, value, frame, sites, good, keys):
        def derivatives(args):
            key, x = args

            def slope(x):
                first = jax.jacrev(lambda x: value(x, key))(x)
                return first, first

            second, first = jax.jacfwd(slope, has_aux=True)(x)
            second = second.reshape(*first.shape[:-1], -1)
            return jnp.moveaxis(jnp.concatenate([first, second], -1), -1, 0)

        each = lax.map(derivatives, (keys, sites))
        share = good.astype(each.dtype) / jnp.maximum(jnp.sum(good), 1)
        mean = jnp.tensordot(share, jnp.where(jnp.isfinite(each), each, 0), 1)
        order = np.repeat([1, 2], [self.d, self.d**2])[:, None, None, None]
        return jnp.where(order <= np.array(self.candidates)[:, None, None], mean, 0)

    def combined(self, x, c):
        d = len(x)
        second = c[d:].reshape(d, d, *c.shape[1:])
        return jnp.tensordot(x, c[:d] + jnp.tensordot(x, second, 1) / 2, 1)


class Functions(eqx.Module):
    """The value functions of a level: one after each step, for each time at which to
    average (`S`) and each number of `phi` (`m`), and before that axis for each candidate
    (`C`) if there are several."""

    frames: Frame
    coefficients: Float[Array, "steps P *C S m"]
    # What the noise keeps of them, to know what they do in a step.
    second: Float[Array, "steps n n *C S m"] | None
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i, y: Y) -> Float[Array, "*C S m"]:
        """Their values at a state after step number `i`."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.combined(frame.at(ravel(y)), self.coefficients[i])

    def chosen(self, best: Int[np.ndarray, "S m"]) -> "Functions":
        """With one candidate for each number."""
        take = lambda c: self.basis.chosen(c, best)
        c, second = jtu.tree_map(take, (self.coefficients, self.second))
        return Functions(self.frames, c, second, self.basis)


def fit(noise, key: PRNGKeyArray, basis: AbstractBasis) -> Functions:
    """The functions of a level, for its noise. A pilot goes forward, and the fit goes
    backward."""
    p, level = noise.problem, noise.level
    y0, unravel = jfu.ravel_pytree(p.y0)
    (n, *shape), steps, last = basis.shape, level.num_steps, p.max_steps
    k_path, k_move = jr.split(key)
    keys = jr.split(k_path, n)

    def forward(i, carry):
        def one(y, key):
            # It goes further than paths do: a fit has to hold for the last of them.
            x = noise.draw(key, i, wide=True)
            return noise.step(i, y, noise.fresh(i, y), x)

        ensemble, states = carry
        y, _, success = jax.vmap(one)(ensemble.y, keys)
        ensemble = ensemble.moved(p, y, None, success)
        return ensemble, states.at[i].set(jax.vmap(ravel)(ensemble.y))

    states = jnp.broadcast_to(y0, (last, n, y0.size))
    carry = Ensemble.start(p, n, None), states
    ensemble, states = lax.fori_loop(0, steps, forward, carry)
    good = ~ensemble.failed
    share = good.astype(y0.dtype) / jnp.maximum(jnp.sum(good), 1)
    # By how far they move, coordinates are comparable.
    unit = jnp.sqrt(jnp.einsum("n,ind->d", share, (states - y0) ** 2) / steps)
    sites = lambda i: basis.sites(states[i], good, unit, jr.fold_in(k_move, i))

    def backward(j, u):
        i = steps - 1 - j
        after = jnp.minimum(i + 1, steps - 1)

        def value(x, key=None):
            y = unravel(x)
            draw = None if key is None else noise.draw(key, last + i)
            later = noise.mean(after, y, lambda y: u(after, y), draw)
            phi = p.values(p.t0 + (i + 1) * level.h, y).astype(later.dtype)
            here, before = level.saved_steps == i + 1, level.saved_steps > i + 1
            return jnp.where(here[:, None], phi, jnp.where(before[:, None], later, 0))

        put = lambda all, one: all.at[i].set(one)
        frame, points = sites(i)
        c = put(u.coefficients, basis.fitted(value, frame, points, good, keys))
        return Functions(jtu.tree_map(put, u.frames, frame), c, None, basis)

    zeros = lambda shape: jnp.zeros((last, *shape), y0.dtype)
    frames = jtu.tree_map(lambda s: zeros(s.shape), jax.eval_shape(lambda: sites(0)[0]))
    u = Functions(frames, zeros((*shape, *p.num_outputs)), None, basis)
    u = lax.fori_loop(0, steps, backward, u)

    def kept(args):
        i, few = args
        return noise.second(i, jax.vmap(unravel)(few), lambda y: u(i, y))

    # The states before each step.
    few = jnp.concatenate([states[:1] * 0 + y0, states[:-1]])[:, :_SECOND]
    second = lax.map(kept, (jnp.arange(last), few))
    return Functions(u.frames, u.coefficients, second, basis)


def exponents(d: int, degree: int) -> list[tuple[int, ...]]:
    """Of all products of powers of `d` variables up to the total degree, lower degrees
    first."""
    choices = itertools.combinations_with_replacement
    chosen = [c for total in range(degree + 1) for c in choices(range(d), total)]
    return [tuple(c.count(j) for j in range(d)) for c in chosen]


def num_polynomials(d: int, degree: int) -> int:
    return math.comb(d + degree, degree)


def hermite(x: Float[Array, " d"], degree: int) -> list[Float[Array, ""]]:
    """Products of normalized Hermite polynomials, in the order of `exponents`. Each is one
    product of two that are known, so that a sum over them is one loop without memory."""
    tables = []
    for variable in x:
        table = [jnp.ones_like(variable), variable]
        for k in range(1, degree):
            last = variable * table[-1] - math.sqrt(k) * table[-2]
            table.append(last / math.sqrt(k + 1))
        tables.append(table)
    known = {(0,) * len(x): jnp.ones_like(x[0])}
    for powers in exponents(len(x), degree)[1:]:
        j = max(j for j, power in enumerate(powers) if power > 0)
        rest = (*powers[:j], 0, *powers[j + 1 :])
        known[powers] = known[rest] * tables[j][powers[j]]
    return [*known.values()]


def least_squares(
    B: Float[Array, "n P"], values: Float[Array, "n C m"], sizes: tuple[int, ...]
) -> Float[Array, "P C m"]:
    """For each of `C` fits the coefficients of the first so many polynomials of `sizes`;
    the others are zero.

    The normal equations are regularized and the solution is refined. For polynomials that
    are independent at the points this leaves rounding errors alone. Where they depend on
    each other the solution stays small.
    """
    scale = jnp.sqrt(jnp.sum(B**2, axis=0))
    B = B / jnp.where(scale > 0, scale, 1)
    n = B.shape[1]
    ridge = 1e4 * jnp.finfo(B.dtype).eps * jnp.eye(n, dtype=B.dtype)
    L = jnp.linalg.cholesky(_dot(B.T, B) + ridge)

    def fit(size, values):
        used = jnp.arange(n) < size
        # A leading block of the factor is the factor of that block.
        own = jnp.where(used[:, None] & used, L, jnp.eye(n, dtype=L.dtype))
        solve = lambda r: jax.scipy.linalg.cho_solve((own, True), r)
        c = jnp.zeros((n, values.shape[1]), values.dtype)
        for _ in range(3):
            c = c + solve(jnp.where(used[:, None], _dot(B.T, values - _dot(B, c)), 0))
        return c

    out = [fit(size, values[:, k]) for k, size in enumerate(sizes)]
    return jnp.stack(out, axis=1) / jnp.where(scale > 0, scale, 1)[:, None, None]
