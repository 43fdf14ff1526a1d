"""Value functions, fitted backwards in time from where a pilot was."""

import abc
import functools as ft
import itertools
import math
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from .._custom_types import Y
from ._noise import AbstractNoise, Ends
from ._steps import along, Ensemble, Problem, ravel


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
# Derivatives are averaged over so many paths.
_QUADRATIC_PILOTS = 128
_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


class Frame(eqx.Module):
    """Coordinates of states: the axes of their covariance, or none but their mean."""

    mean: Float[Array, " d"]
    # Of shape `(d, d)`, if they are there.
    to: Any = None
    back: Any = None

    def at(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        return y - self.mean if self.to is None else _dot(y - self.mean, self.to.T)

    def states(self, x: Float[Array, "n d"]) -> Float[Array, "n d"]:
        return self.mean + _dot(x, self.back.T)

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
    """Functions of the coordinates, of which value functions are made."""

    @abc.abstractmethod
    def combined(self, x: Float[Array, " d"], c: Float[Array, "P ..."]) -> Array:
        """Their sum with these coefficients, at a point."""


class AbstractFitted(AbstractBasis):
    """Functions with coefficients from values at some states."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """How many states, coefficients, and candidates with some of these, there are."""

    @abc.abstractmethod
    def sites(
        self, frame: Frame, states, good, key
    ) -> tuple[Frame, Float[Array, "n d"]]:
        """The coordinates that are used, and where to take values, for the pilot's
        states."""

    @abc.abstractmethod
    def fitted(
        self,
        x: Float[Array, "n d"],
        values: Float[Array, "n C m"],
        good: Bool[Array, " n"],
    ) -> Float[Array, "P C m"]:
        """The coefficients. `good` says which of the pilot's paths have not failed."""


class Grid(AbstractFitted):
    """Values on a grid with `size` points along each of `d` axes. In between is the
    polynomial of degree 5 in each coordinate through the 6 nearest points on its axis."""

    d: int
    size: int

    @property
    def shape(self):
        return self.size**self.d, self.size**self.d, 1

    def sites(self, frame, states, good, key):
        x = frame.at(states)
        low = jnp.min(jnp.where(good[:, None], x, jnp.inf), axis=0)
        high = jnp.max(jnp.where(good[:, None], x, -jnp.inf), axis=0)
        half = jnp.maximum(_WIDER * (high - low) / 2, 1)
        middle = frame.mean + _dot(frame.back, (low + high) / 2)
        frame = Frame(middle, frame.to / half[:, None], frame.back * half)
        axis = np.linspace(-1, 1, self.size)
        nodes = np.stack(np.meshgrid(*[axis] * self.d, indexing="ij"), -1)
        return frame, frame.states(jnp.asarray(nodes.reshape(-1, self.d), x.dtype))

    def fitted(self, x, values, good):
        return jnp.where(jnp.isfinite(values), values, 0)

    def combined(self, x, c):
        n, k, last = self.size, _STENCIL, c.shape[1:]
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


class Hermite(AbstractFitted):
    """Products of Hermite polynomials, with a candidate for each of the total degrees."""

    d: int
    degrees: tuple[int, ...]

    @property
    def shape(self):
        count = num_polynomials(self.d, max(self.degrees))
        pilots = max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * count)
        return pilots, count, len(self.degrees)

    def sites(self, frame, states, good, key):
        z = _MOVE * jr.normal(key, states.shape, states.dtype)
        return frame, states + _dot(z, frame.back.T)

    def fitted(self, x, values, good):
        B = jax.vmap(lambda x: jnp.stack(hermite(x, max(self.degrees))))(x)
        finite = lambda x: jnp.isfinite(x).reshape(len(x), -1).all(axis=1)
        good = good & finite(B) & finite(values)
        rows = lambda x: jnp.where(along(good, x), x, 0)
        sizes = tuple(num_polynomials(self.d, k) for k in self.degrees)
        return least_squares(rows(B), rows(values), sizes)

    def combined(self, x, c):
        products = zip(hermite(x, max(self.degrees)), c)
        return ft.reduce(jnp.add, [b * c for b, c in products])


class Quadratic(AbstractBasis):
    """Linear and quadratic functions, with a candidate for each degree. Their coefficients
    are the first and the second derivatives at the origin, one after another."""

    degrees: tuple[int, ...]

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
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i, y: Y) -> Float[Array, "*C S m"]:
        """Their values at a state after step number `i`."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.combined(frame.at(ravel(y)), self.coefficients[i])


def fit_values(
    noise: AbstractNoise, key: PRNGKeyArray, basis: AbstractFitted
) -> tuple[Functions, Float[Array, "steps n d"]]:
    """By values at the sites of the basis. Returns the pilot's states, too.

    The pilot goes forward and the fit goes backward in one loop, since both need the ends
    of the steps of many paths: to compile these takes most of the time."""
    p, level = noise.problem, noise.level
    y0, unravel = jfu.ravel_pytree(p.y0)
    d, n, steps = y0.size, basis.shape[0], level.num_steps
    k_path, k_move = jr.split(key)
    keys = jr.split(k_path, n)

    def body(j, carry):
        forward = j < steps
        i = jnp.where(forward, j, 2 * steps - 1 - j)
        ensemble, states, squares, u = carry
        good = ~ensemble.failed
        frame = Frame.of(states[i], good, jnp.sqrt(squares / steps))
        frame, sites = basis.sites(frame, states[i], good, jr.fold_in(k_move, i))
        x = jnp.where(forward, jax.vmap(ravel)(ensemble.y), sites)
        step = jnp.where(forward, i, jnp.minimum(i + 1, steps - 1))
        draw = jnp.where(forward, i, p.max_steps + i)
        ys = jax.vmap(unravel)(x)
        # The pilot goes further than paths do: a fit has to hold for the last of them.
        one = lambda y, key: noise.ends(
            step, y, noise.fresh(step, y), key, draw, wide=True
        )
        ends = jax.vmap(one)(ys, keys)

        def go():
            new = _own(p, ensemble, ends)
            flat = jax.vmap(ravel)(new.y)
            # By how far they move, coordinates are comparable.
            share = (~new.failed).astype(y0.dtype)
            share = share / jnp.maximum(jnp.sum(share), 1)
            return new, states.at[i].set(flat), squares + share @ (flat - y0) ** 2, u

        def fit():
            put = lambda all, one: all.at[i].set(one)
            values = _values(noise, i, u, ys, ends)
            flat = values.reshape(n, basis.shape[2], -1)
            found = basis.fitted(frame.at(x), flat, good)
            c = put(u.coefficients, found.reshape(u.coefficients.shape[1:]))
            frames = jtu.tree_map(put, u.frames, frame)
            return ensemble, states, squares, Functions(frames, c, basis)

        return lax.cond(forward, go, fit)

    zero = lambda *shape: jnp.zeros((p.max_steps, *shape), y0.dtype)
    frames = Frame(zero(d), zero(d, d), zero(d, d))
    u = Functions(frames, zero(*basis.shape[1:], *p.num_outputs), basis)
    ensemble = Ensemble.start(p, n, None)
    carry = ensemble, zero(n, d) + y0, jnp.zeros_like(y0), u
    _, states, _, u = lax.fori_loop(0, 2 * steps, body, carry)
    return u, states


def fit_derivatives(
    noise: AbstractNoise, key: PRNGKeyArray, basis: Quadratic
) -> tuple[Functions, Float[Array, "steps n d"]]:
    """By mean first and second derivatives at the pilot's states, which are returned, too.
    For Gaussian states that is best in the mean square, by Stein's lemma."""
    p, level = noise.problem, noise.level
    y0, unravel = jfu.ravel_pytree(p.y0)
    n, d = _QUADRATIC_PILOTS, y0.size
    keys = jr.split(key, n)
    state, brief = noise.fresh, dict(brief=True)
    ends_of = lambda i, y, key, draw: noise.ends(i, y, state(i, y), key, draw, **brief)

    def forward(i, carry):
        ensemble, states = carry
        ends = jax.vmap(lambda y, key: ends_of(i, y, key, i))(ensemble.y, keys)
        ensemble = _own(p, ensemble, ends)
        return ensemble, states.at[i].set(jax.vmap(ravel)(ensemble.y))

    zero = lambda *shape: jnp.zeros((p.max_steps, *shape), y0.dtype)
    carry = Ensemble.start(p, n, None), zero(n, d) + y0
    ensemble, states = lax.fori_loop(0, level.num_steps, forward, carry)
    share = (~ensemble.failed).astype(y0.dtype) / jnp.sum(~ensemble.failed)
    centre = jnp.einsum("inj,n->ij", states, share)
    uses = np.array([[x >= 1] * d + [x >= 2] * d**2 for x in basis.degrees]).T[
        ..., None, None
    ]

    def backward(j, u):
        i = level.num_steps - 1 - j
        step = jnp.minimum(i + 1, level.num_steps - 1)

        def derivatives(args):
            key, x = args

            def value(x):
                y = unravel(x)
                ends = ends_of(step, y, key, p.max_steps + i)
                axis = lambda tree: jtu.tree_map(lambda x: x[None], tree)
                return _values(noise, i, u, axis(y), axis(ends))[0]

            def slope(x):
                first = jax.jacrev(value)(x)
                return first, first

            second, first = jax.jacfwd(slope, has_aux=True)(x)
            second = second.reshape(*first.shape[:-1], -1)
            return jnp.moveaxis(jnp.concatenate([first, second], -1), -1, 0)

        each = lax.map(derivatives, (keys, states[i]))
        mean = jnp.tensordot(share, jnp.where(jnp.isfinite(each), each, 0), 1)
        c = u.coefficients.at[i].set(jnp.where(uses, mean, 0))
        return Functions(u.frames, c, u.basis)

    c = zero(d + d**2, len(basis.degrees), *p.num_outputs)
    u = Functions(Frame(centre), c, basis)
    return lax.fori_loop(0, level.num_steps, backward, u), states


def _values(
    noise: AbstractNoise, i, u: Functions, ys: Y, ends: Ends
) -> Float[Array, "n C S m"]:
    """What the functions after step number `i` are to be at these states: `phi` at the
    saved steps, and before them the expectation of the functions a step later."""
    p, level = noise.problem, noise.level
    after = jnp.minimum(i + 1, p.max_steps - 1)
    at_ends = jax.vmap(jax.vmap(lambda y: u(after, y)))(ends.y)
    later = jax.vmap(lambda ends, values: ends.mean(values))(ends, at_ends)
    t = p.t0 + (i + 1) * level.h
    phi = jax.vmap(lambda y: ravel(p.phi(t, y, p.args)))(ys).astype(later.dtype)
    here = (level.saved_steps == i + 1)[:, None]
    before = (level.saved_steps > i + 1)[:, None]
    return jnp.where(here, phi[:, None, None], jnp.where(before, later, 0))


def _own(p: Problem, ensemble: Ensemble, ends: Ends) -> Ensemble:
    """The paths at their own ends."""
    take = lambda x: jax.vmap(lambda x, k: x[k])(x, ends.own)
    return ensemble.moved(p, jtu.tree_map(take, ends.y), None, take(ends.success))


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
