"""Value functions, fitted backwards in time from the states of a pilot."""

import abc
import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._custom_types import Y
from ._noise import AbstractNoise, Ends
from ._polynomials import Frame, hermite, least_squares, num_polynomials
from ._steps import along, Ensemble, ensemble_of, moved, Problem


# By default there are no more polynomials than this in a fit.
MOST_POLYNOMIALS = 130
_PILOTS_PER_POLYNOMIAL, _FEWEST_PILOTS = 30, 256
# The pilot's states are moved at random by this share of their deviations: the paths of the
# first steps have few different states.
_MOVE = 0.2
# Derivatives are averaged over so many paths, second ones by the noise over fewer.
_QUADRATIC_PILOTS, SECOND_PILOTS = 128, 32


class AbstractFunctions(eqx.Module):
    """The value functions of a level: one after each step, for each time at which to
    average (`S`) and each number of `phi` (`m`), and before that axis for each candidate
    (`C`) if there are several."""

    @abc.abstractmethod
    def __call__(self, i, y: Y) -> Float[Array, "*C S m"]:
        """Their values at a state after step number `i`."""

    @abc.abstractmethod
    def replaced(self, fn: Callable[[Array], Array]) -> "AbstractFunctions":
        """With `fn` of the coefficients, which end with the axes `C`, `S` and `m`."""


class PolynomialFunctions(AbstractFunctions):
    frames: Frame
    coefficients: Float[Array, "steps P *C S m"]
    degree: int = eqx.field(static=True)

    def __call__(self, i, y):
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        x = _dot(frame.to, _ravel(y) - frame.mean)
        products = zip(hermite(x, self.degree), self.coefficients[i])
        return ft.reduce(jnp.add, [b * c for b, c in products])

    def replaced(self, fn):
        return PolynomialFunctions(self.frames, fn(self.coefficients), self.degree)


class QuadraticFunctions(AbstractFunctions):
    centre: Float[Array, "steps d"]
    first: Float[Array, "steps d *C S m"]
    second: Float[Array, "steps d d *C S m"]

    def __call__(self, i, y):
        z = _ravel(y) - self.centre[i]
        slope = self.first[i] + jnp.tensordot(z, self.second[i], 1) / 2
        return jnp.tensordot(z, slope, 1)

    def replaced(self, fn):
        return QuadraticFunctions(self.centre, fn(self.first), fn(self.second))


_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


def fit_polynomials(
    noise: AbstractNoise, key: PRNGKeyArray, degrees: tuple[int, ...]
) -> tuple[PolynomialFunctions, Float[Array, "steps n d"]]:
    """By least squares, for each of the degrees. Returns the pilot's states, too.

    The pilot goes forward and the fit goes backward in one loop, since both need the ends
    of the steps of many paths: to compile these takes most of the time."""
    p, level = noise.problem, noise.level
    y0, unravel = jfu.ravel_pytree(p.y0)
    d, degree, steps = y0.size, max(degrees), level.num_steps
    sizes = tuple(num_polynomials(d, k) for k in degrees)
    n = num_pilots(d, degree)
    k_path, k_move = jr.split(key)
    keys = jr.split(k_path, n)

    def body(j, carry):
        forward = j < steps
        i = jnp.where(forward, j, 2 * steps - 1 - j)
        ensemble, states, squares, u = carry
        good = ~ensemble.failed
        frame = Frame.of(states[i], good, jnp.sqrt(squares / steps))
        z = _MOVE * jr.normal(jr.fold_in(k_move, i), (n, d), y0.dtype)
        noisy = states[i] + _dot(z, frame.back.T)
        x = jnp.where(forward, jax.vmap(_ravel)(ensemble.y), noisy)
        step = jnp.where(forward, i, jnp.minimum(i + 1, steps - 1))
        draw = jnp.where(forward, i, p.max_steps + i)
        ys = jax.vmap(unravel)(x)
        ends = jax.vmap(lambda y, key: noise.ends(step, y, key, draw))(ys, keys)

        def go():
            new = _own(p, ensemble, ends)
            flat = jax.vmap(_ravel)(new.y)
            # By how far they move, coordinates are comparable.
            share = (~new.failed).astype(y0.dtype) / jnp.maximum(
                jnp.sum(~new.failed), 1
            )
            return new, states.at[i].set(flat), squares + share @ (flat - y0) ** 2, u

        def fit():
            put = lambda all, one: all.at[i].set(one)
            frames = jtu.tree_map(put, u.frames, frame)
            values = _values(noise, i, u, ys, ends)
            at = lambda x: jnp.stack(hermite(_dot(frame.to, x - frame.mean), degree))
            B = jax.vmap(at)(x)
            finite = lambda x: jnp.isfinite(x).reshape(n, -1).all(axis=1)
            rows = lambda x: jnp.where(
                along(good & finite(values) & finite(B), x), x, 0
            )
            flat = rows(values).reshape(n, len(degrees), -1)
            found = least_squares(rows(B), flat, sizes)
            c = u.coefficients.at[i].set(found.reshape(u.coefficients.shape[1:]))
            return ensemble, states, squares, PolynomialFunctions(frames, c, degree)

        return lax.cond(forward, go, fit)

    zero = lambda *shape: jnp.zeros((p.max_steps, *shape), y0.dtype)
    frames = Frame(zero(d), zero(d, d), zero(d, d))
    c = zero(max(sizes), *_shape(p, degrees))
    u = PolynomialFunctions(frames, c, degree)
    carry = ensemble_of(p, n, None), zero(n, d) + y0, jnp.zeros_like(y0), u
    _, states, _, u = lax.fori_loop(0, 2 * steps, body, carry)
    return u, states


def fit_quadratics(
    noise: AbstractNoise, key: PRNGKeyArray, degrees: tuple[int, ...]
) -> tuple[QuadraticFunctions, Float[Array, "steps n d"]]:
    """By mean first and second derivatives at the pilot's states. For Gaussian states that
    is the best quadratic function in the mean square, by Stein's lemma. Returns these,
    too."""
    p, level = noise.problem, noise.level
    y0, unravel = jfu.ravel_pytree(p.y0)
    n, d = _QUADRATIC_PILOTS, y0.size
    keys = jr.split(key, n)

    def forward(i, carry):
        ensemble, states = carry
        one = lambda y, key: noise.ends(i, y, key, i, brief=True)
        ensemble = _own(p, ensemble, jax.vmap(one)(ensemble.y, keys))
        return ensemble, states.at[i].set(jax.vmap(_ravel)(ensemble.y))

    zero = lambda *shape: jnp.zeros((p.max_steps, *shape), y0.dtype)
    carry = ensemble_of(p, n, None), zero(n, d) + y0
    ensemble, states = lax.fori_loop(0, level.num_steps, forward, carry)
    share = (~ensemble.failed).astype(y0.dtype) / jnp.sum(~ensemble.failed)
    centre = jnp.einsum("inj,n->ij", states, share)
    uses = [
        jnp.array([x >= k for x in degrees], y0.dtype)[:, None, None] for k in (1, 2)
    ]

    def backward(j, u):
        i = level.num_steps - 1 - j
        step = jnp.minimum(i + 1, level.num_steps - 1)

        def derivatives(args):
            key, x = args

            def value(x):
                y = unravel(x)
                ends = noise.ends(step, y, key, p.max_steps + i, brief=True)
                axis = lambda tree: jtu.tree_map(lambda x: x[None], tree)
                return _values(noise, i, u, axis(y), axis(ends))[0]

            def slope(x):
                first = jax.jacrev(value)(x)
                return first, first

            second, first = jax.jacfwd(slope, has_aux=True)(x)
            return tuple(
                jnp.moveaxis(x, range(3, x.ndim), range(x.ndim - 3))
                for x in (first, second)
            )

        mean = lambda x: jnp.tensordot(share, jnp.where(jnp.isfinite(x), x, 0), 1)
        first, second = map(mean, lax.map(derivatives, (keys, states[i])))
        first, second = u.first.at[i].set(first * uses[0]), second * uses[1]
        return QuadraticFunctions(centre, first, u.second.at[i].set(second))

    shape = _shape(p, degrees)
    u = QuadraticFunctions(centre, zero(d, *shape), zero(d, d, *shape))
    return lax.fori_loop(0, level.num_steps, backward, u), states


def _values(
    noise: AbstractNoise, i, u: AbstractFunctions, ys: Y, ends: Ends
) -> Float[Array, "n C S m"]:
    """What the functions after step number `i` are to be at these states: `phi` at the
    saved steps, and before them the expectation of the functions a step later."""
    p, level = noise.problem, noise.level
    after = jnp.minimum(i + 1, p.max_steps - 1)
    at_ends = jax.vmap(jax.vmap(lambda y: u(after, y)))(ends.y)
    later = jax.vmap(lambda ends, values: ends.mean(values))(ends, at_ends)
    t = p.t0 + (i + 1) * level.h
    phi = jax.vmap(lambda y: _flat(p.phi(t, y, p.args)))(ys).astype(later.dtype)
    here = (level.saved_steps == i + 1)[:, None]
    before = (level.saved_steps > i + 1)[:, None]
    return jnp.where(here, phi[:, None, None], jnp.where(before, later, 0))


def _own(p: Problem, ensemble: Ensemble, ends: Ends) -> Ensemble:
    """The paths at their own ends."""
    take = lambda x: jax.vmap(lambda x, k: x[k])(x, ends.own)
    return moved(p, ensemble, jtu.tree_map(take, ends.y), None, take(ends.success))


def _flat(tree: PyTree[Array]) -> Float[Array, " m"]:
    """The numbers of `phi`."""
    leaves = jtu.tree_leaves(tree)
    dtype = jnp.result_type(float, *leaves)
    return jnp.concatenate([jnp.ravel(x).astype(dtype) for x in leaves])


def _ravel(y: Y) -> Float[Array, " d"]:
    return jfu.ravel_pytree(y)[0]


def _shape(p: Problem, degrees: tuple[int, ...]) -> tuple[int, int, int]:
    m = sum(s.size for s in p.outputs())
    return len(degrees), p.levels.saved_steps.shape[1], m


def num_pilots(d: int, degree: int) -> int:
    return max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * num_polynomials(d, degree))
