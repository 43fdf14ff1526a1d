"""Fitted value functions as control variates.

$u_n(y)$ stands for $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. What $u_{n+1}$ does in a step, less
its expectation over the random variables of that step, has mean zero whatever $u$ is. For
the exact $u$ these sum up to all that is random in $\\phi(y_N)$.
"""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._custom_types import Y
from ._noise import AbstractNoise, noise_of
from ._polynomials import exponents, Frame, hermite, least_squares
from ._steps import (
    AbstractLevelSampler,
    along,
    Ensemble,
    ensemble_of,
    Level,
    moved,
    Problem,
    simulate,
)


# By default there are no more polynomials than this in a fit.
MOST_POLYNOMIALS = 130
_PILOTS_PER_POLYNOMIAL, _FEWEST_PILOTS = 15, 256
# The pilot's states are moved at random by this share of their deviations: the paths of the
# first steps have few different states.
_MOVE = 0.2
# Second derivatives are averaged over so many paths.
_QUADRATIC_PILOTS = 128
# The degree is chosen by so many paths.
_TRIALS = 512


class AbstractFunctions(eqx.Module):
    """The value functions of a level: one after each step, for each candidate (`C`), each
    time at which to average (`S`) and each number of `phi` (`m`)."""

    @abc.abstractmethod
    def __call__(self, i, y: Y) -> Float[Array, "C S m"]:
        """Their values at a state after step number `i`."""

    @abc.abstractmethod
    def chosen(self, best: np.ndarray) -> "AbstractFunctions":
        """Those of the candidates `best`, of shape `(S, m)`, as the only candidate."""


class PolynomialFunctions(AbstractFunctions):
    frames: Frame
    coefficients: Float[Array, "steps P C S m"]
    degree: int = eqx.field(static=True)

    def __call__(self, i, y):
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        x = jfu.ravel_pytree(y)[0]
        products = hermite(_dot(frame.to, x - frame.mean), self.degree)
        return sum(b * c for b, c in zip(products, self.coefficients[i]))

    def chosen(self, best):
        c = jnp.take_along_axis(self.coefficients, jnp.asarray(best)[None, None, None], 2)
        used = np.any(np.asarray(c) != 0, axis=(0, 2, 3, 4))
        d, degree = self.frames.mean.shape[-1], 0
        while not np.all(~used[len(exponents(d, degree)) :]):
            degree += 1
        return PolynomialFunctions(self.frames, c[:, : len(exponents(d, degree))], degree)


class QuadraticFunctions(AbstractFunctions):
    """From their mean first and second derivatives."""

    centre: Float[Array, "steps d"]
    first: Float[Array, "steps C S m d"]
    second: Float[Array, "steps C S m d d"]

    def __call__(self, i, y):
        z = jfu.ravel_pytree(y)[0] - self.centre[i]
        return _dot(self.first[i] + _dot(self.second[i], z) / 2, z)

    def chosen(self, best):
        at = lambda x: jnp.take_along_axis(
            x, jnp.asarray(best).reshape(1, 1, *best.shape, *[1] * (x.ndim - 4)), 1
        )
        return QuadraticFunctions(self.centre, at(self.first), at(self.second))


_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


class ValueFunctionsSampler(AbstractLevelSampler):
    """A sample is a path, with its value less what `functions`, along an axis of levels,
    say of its noise."""

    problem: Problem
    weights: Float[np.ndarray, "combinations levels"]
    functions: AbstractFunctions
    second: Array

    def on_level(self, keys, level):
        own = jtu.tree_map(lambda x: x[level.index], (self.functions, self.second))
        noise = noise_of(self.problem, level)
        saved, ensemble, control = paths(noise, keys, *own)
        values = controlled(saved, control[:, 0])
        return values, ~ensemble.failed, ensemble.failed


def paths(
    noise: AbstractNoise, keys: PRNGKeyArray, u: AbstractFunctions, second: Array
) -> tuple[PyTree[Array], Ensemble, Float[Array, "n C S m"]]:
    """`phi` of independent paths, with axes in front for the saved steps and the paths;
    their ends; and the sums of what `u` says of their noise."""
    p, n = noise.problem, len(keys)

    def step(i, ensemble, control):
        at = lambda y: u(i, y)
        here = jax.tree.map(lambda x: x[i], second)
        one = lambda y, key: noise.advance(i, y, at, here, key)
        y, change, success = jax.vmap(one)(ensemble.y, keys)
        # A path that failed has no value, and its control must be finite all the same.
        control = control + jnp.where(along(success, change), change, 0)
        return moved(p, ensemble, y, None, success), control

    shape = jax.eval_shape(lambda: u(0, p.y0))
    control = jnp.zeros((n, *shape.shape), shape.dtype)
    measure = lambda x, failed: x
    return simulate(p, noise.level, ensemble_of(p, n, None), step, control, measure)


def controlled(saved: PyTree[Array], control: Float[Array, "n S m"]) -> PyTree[Array]:
    """The values less their control variates."""
    leaves, treedef = jtu.tree_flatten(saved)
    ends = np.cumsum([x[0, 0].size for x in leaves])
    parts = jnp.split(jnp.moveaxis(control, 1, 0), ends[:-1], axis=2)
    less = lambda x, c: x - c.reshape(x.shape).astype(x.dtype)
    return treedef.unflatten([less(x, c) for x, c in zip(leaves, parts)])


def flat(tree: PyTree[Array]) -> Float[Array, " m"]:
    """The numbers of `phi`."""
    leaves = jtu.tree_leaves(tree)
    dtype = jnp.result_type(float, *leaves)
    return jnp.concatenate([jnp.ravel(x).astype(dtype) for x in leaves])


@eqx.filter_jit
def fitted(
    problem: Problem, level: Level, key: PRNGKeyArray, degrees: tuple[int, ...]
) -> tuple[AbstractFunctions, Array, Float[Array, "C S m"]]:
    """Functions of these degrees, what the noise keeps of them, and an estimate of the
    variance that they leave, by fresh paths."""
    noise = noise_of(problem, level)
    k_pilot, k_fit, k_trial = jr.split(key, 3)
    d = _ravel(problem.y0).size
    many = len(exponents(d, 2)) > MOST_POLYNOMIALS if max(degrees) <= 2 else False
    if many:
        u, states = _quadratic(noise, k_pilot, k_fit, degrees)
    else:
        u, states = _polynomial(noise, k_pilot, k_fit, degrees)
    few = jtu.tree_map(lambda x: x[:, :_QUADRATIC_PILOTS], states)
    unravel = _unravel(problem)

    def second(i, ys):
        ys = jax.vmap(unravel)(ys)
        return noise.second(i, ys, lambda y: u(i, y))

    indices = jnp.arange(problem.max_steps)
    second = jax.lax.map(lambda x: second(*x), (indices, few))
    keys = jr.split(k_trial, _TRIALS)
    saved, ensemble, control = paths(noise, keys, u, second)
    left = jax.vmap(lambda c: flat_rows(controlled(saved, c)), 1)(control)
    return u, second, _spread(left, ~ensemble.failed)


def flat_rows(tree: PyTree[Array]) -> Float[Array, "S n m"]:
    return jax.vmap(jax.vmap(flat))(tree)


def _spread(values: Float[Array, "C S n m"], good) -> Float[Array, "C S m"]:
    """The variance and twice its standard error: where a few paths make up for most of it,
    as where a polynomial leaves the range of its points, it is larger than it seems."""
    share = (good / jnp.maximum(jnp.sum(good), 1))[:, None]
    mean_of = lambda x: jnp.sum(jnp.where(good[:, None], x, 0) * share, axis=2)
    off = values - mean_of(values)[:, :, None]
    variance, fourth = mean_of(off**2), mean_of(off**4)
    error = jnp.sqrt(jnp.maximum(fourth - variance**2, 0) / jnp.sum(good))
    return jnp.nan_to_num(variance + 2 * error, nan=jnp.inf)


def _pilot(noise: AbstractNoise, key: PRNGKeyArray, n: int):
    """The states of `n` paths after each step, and which paths are good."""
    p = noise.problem
    def step(i, ensemble, states):
        one = lambda y, key: noise.step(i, y, noise.draw(i, key))
        y, success = jax.vmap(one)(ensemble.y, keys)
        ensemble = moved(p, ensemble, y, None, success)
        return ensemble, states.at[i].set(jax.vmap(_ravel)(ensemble.y))

    keys = jr.split(key, n)
    start = _ravel(p.y0)
    states = jnp.zeros((p.max_steps, n, start.size), start.dtype) + start
    ensemble = ensemble_of(p, n, None)
    out = simulate(p, noise.level, ensemble, step, states, lambda x, failed: x)
    return out[2], ~out[1].failed


def _ravel(y: Y) -> Float[Array, " d"]:
    return jfu.ravel_pytree(y)[0]


def _unravel(p: Problem) -> Callable[[Array], Y]:
    return jfu.ravel_pytree(p.y0)[1]


def _target(noise: AbstractNoise, i, u: AbstractFunctions, shape, key, x) -> Array:
    """What the functions are after step number `i`, at a state: `phi` at the saved steps, and
    otherwise the expectation of the functions a step later."""
    p, level = noise.problem, noise.level
    y = _unravel(p)(x)
    last = u.coefficients.shape[0] if isinstance(u, PolynomialFunctions) else len(u.centre)
    after = jnp.minimum(i + 1, last - 1)
    step = jnp.minimum(i + 1, level.num_steps - 1)
    later = noise.expected(step, y, lambda y: u(after, y), key)
    # Those whose time has come, and those whose time is still to come.
    here = (level.saved_steps == i + 1)[:, None]
    ahead = (level.saved_steps > i + 1)[:, None]
    phi = flat(p.phi(p.t0 + (i + 1) * level.h, y, p.args)).astype(shape.dtype)
    return jnp.where(here, phi, jnp.where(ahead, later, 0))


def _backward(noise: AbstractNoise, body: Callable, u: Any) -> Any:
    """Calls `body(i, u)` for each step, the last one first."""
    n = noise.level.num_steps
    return jax.lax.fori_loop(0, n, lambda j, u: body(n - 1 - j, u), u)


def _polynomial(noise, k_pilot, k_fit, degrees: tuple[int, ...]):
    """Least squares at the states of a pilot."""
    p = noise.problem
    d, degree = _ravel(p.y0).size, max(degrees)
    sizes = tuple(len(exponents(d, x)) for x in degrees)
    n = num_pilots(d, degree)
    states, good = _pilot(noise, k_pilot, n)
    weight = good.astype(states.dtype)
    share = weight / jnp.maximum(jnp.sum(weight), 1)
    centre = jnp.mean(jnp.einsum("inj,n->ij", states, share), axis=0)
    unit = jnp.sqrt(jnp.mean(jnp.einsum("inj,n->ij", (states - centre) ** 2, share), 0))
    unit = jnp.where(unit > 0, unit, 1)
    frames = jax.vmap(lambda x: Frame.of(x, weight, unit))(states)
    shape = jax.ShapeDtypeStruct(
        (len(degrees), len(noise.level.saved_steps), flat_size(p)), states.dtype
    )
    coefficients = jnp.zeros((p.max_steps, max(sizes), *shape.shape), shape.dtype)

    def body(i, c):
        frame = jtu.tree_map(lambda x: x[i], frames)
        key = jr.fold_in(k_fit, i)
        z = _MOVE * jr.normal(key, states.shape[1:], states.dtype)
        x = states[i] + _dot(z, frame.back.T)
        u = PolynomialFunctions(frames, c, degree)
        keys = jr.split(jr.fold_in(key, 1), n)
        one = lambda key, x: _target(noise, i, u, shape, key, x)
        values = jax.vmap(one)(keys, x)
        at = lambda x: jnp.stack(hermite(_dot(frame.to, x - frame.mean), degree))
        B = jax.vmap(at)(x)
        use = good & jnp.isfinite(values).reshape(n, -1).all(1) & jnp.isfinite(B).all(1)
        rows = lambda x: jnp.where(along(use, x), x, 0)
        found = least_squares(rows(B), rows(values).reshape(n, len(degrees), -1), sizes)
        return c.at[i].set(found.reshape(-1, *shape.shape))

    c = _backward(noise, body, coefficients)
    return PolynomialFunctions(frames, c, degree), states


def _quadratic(noise, k_pilot, k_fit, degrees: tuple[int, ...]):
    """By the mean derivatives at the states of a pilot. For Gaussian states that is the best
    quadratic function in the mean square, by Stein's lemma."""
    p = noise.problem
    n = _QUADRATIC_PILOTS
    states, good = _pilot(noise, k_pilot, n)
    share = (good / jnp.maximum(jnp.sum(good), 1)).astype(states.dtype)
    centre = jnp.einsum("inj,n->ij", states, share)
    shape = jax.ShapeDtypeStruct(
        (len(degrees), len(noise.level.saved_steps), flat_size(p)), states.dtype
    )
    d = states.shape[-1]
    has = lambda least: jnp.array([x >= least for x in degrees]).reshape(-1, 1, 1)
    zeros = lambda k: jnp.zeros((p.max_steps, *shape.shape, *[d] * k), shape.dtype)

    def body(i, u):
        def derivatives(args):
            f = lambda x: _target(noise, i, u, shape, args[0], x)
            return jax.jacrev(f)(args[1]), jax.jacfwd(jax.jacrev(f))(args[1])

        keys = jr.split(jr.fold_in(k_fit, i), n)
        first, second = jax.lax.map(derivatives, (keys, states[i]))
        mean = lambda x: jnp.tensordot(share, jnp.where(jnp.isfinite(x), x, 0), 1)
        return QuadraticFunctions(
            centre,
            u.first.at[i].set(jnp.where(has(1)[..., None], mean(first), 0)),
            u.second.at[i].set(jnp.where(has(2)[..., None, None], mean(second), 0)),
        )

    return _backward(noise, body, QuadraticFunctions(centre, zeros(1), zeros(2))), states


def flat_size(p: Problem) -> int:
    return sum(s.size for s in p.outputs())


def num_pilots(d: int, degree: int) -> int:
    return max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * len(exponents(d, degree)))


def value_functions(
    problem: Problem, weights: np.ndarray, key: PRNGKeyArray, degrees: tuple[int, ...]
) -> tuple[ValueFunctionsSampler, np.ndarray, float]:
    """The sampler; of the degrees the best for each time and number of `phi`; and the
    variance of a sample that is left, by an estimate of the largest."""
    each = []
    left = 0.0
    for k in range(len(problem.levels.h)):
        own = jr.fold_in(key, k)
        u, second, spread = fitted(problem, problem.level(k), own, degrees)
        spread = np.asarray(spread)
        best = np.argmin(spread, axis=0)
        left = left + weights[0, k] ** 2 * np.max(np.min(spread, axis=0))
        u = u.chosen(best)
        if second.ndim > 1:
            second = jnp.take_along_axis(
                second, jnp.asarray(best)[None, None, :, :, None, None], 1
            )
        each.append((u, second, np.asarray(degrees)[best]))
    # The levels share one program: their polynomials are of one degree.
    functions = _stacked([u for u, _, _ in each])
    second = jnp.stack([second for _, second, _ in each])
    sampler = ValueFunctionsSampler(problem, weights, functions, second)
    return sampler, np.max([best for _, _, best in each], axis=0), float(left)


def _stacked(each: list[AbstractFunctions]) -> AbstractFunctions:
    if isinstance(each[0], PolynomialFunctions):
        largest = max(each, key=lambda u: u.degree)
        size = largest.coefficients.shape[1]
        each = [
            PolynomialFunctions(
                u.frames,
                jnp.pad(u.coefficients, [(0, 0), (0, size - u.coefficients.shape[1])] + [(0, 0)] * 3),
                largest.degree,
            )
            for u in each
        ]
    return jtu.tree_map(lambda *xs: jnp.stack(xs), *each)
