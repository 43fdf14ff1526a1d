"""Fitted value functions as control variates.

$u_n(y)$ stands for $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. What $u_{n+1}$ does in a step,
less its expectation over the random variables of that step, has mean zero whatever $u$ is.
For the exact $u$ these sum up to all that is random in $\\phi(y_N)$.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from ._fits import (
    AbstractFunctions,
    fit_polynomials,
    fit_quadratics,
    MOST_POLYNOMIALS,
    SECOND_PILOTS,
)
from ._noise import noise_of
from ._polynomials import num_polynomials
from ._steps import (
    AbstractLevelSampler,
    along,
    ensemble_of,
    Level,
    moved,
    Problem,
    simulate,
)


class ValueFunctionsSampler(AbstractLevelSampler):
    """A sample is a path, with its value less what `functions`, along an axis of levels,
    say of its noise; `second` is what the noise keeps of them."""

    problem: Problem
    weights: Float[np.ndarray, "combinations levels"]
    functions: AbstractFunctions
    second: Array

    def on_level(self, keys, level):
        p, n = self.problem, len(keys)
        noise = noise_of(p, level)
        u, second = jtu.tree_map(
            lambda x: x[level.index], (self.functions, self.second)
        )

        def step(i, ensemble, control):
            at = lambda y: u(i, y)
            one = lambda y, key: noise.advance(i, y, at, second[i], key)
            y, change, success = jax.vmap(one)(ensemble.y, keys)
            # A path that failed has no value, and its control must be finite all the same.
            control = control + jnp.where(along(success, change), change, 0)
            return moved(p, ensemble, y, None, success), control

        shape = jax.eval_shape(lambda: u(0, p.y0))
        control = jnp.zeros((n, *shape.shape), shape.dtype)
        ensemble, measure = ensemble_of(p, n, None), lambda x, failed: x
        saved, ensemble, control = simulate(p, level, ensemble, step, control, measure)
        return _controlled(saved, control), ~ensemble.failed, ensemble.failed


def _controlled(saved: PyTree[Array], control: Float[Array, "n S m"]) -> PyTree[Array]:
    """The values less their control variates."""
    leaves, treedef = jtu.tree_flatten(saved)
    ends = np.cumsum([x[0, 0].size for x in leaves])
    parts = jnp.split(jnp.moveaxis(control, 1, 0), ends[:-1], axis=2)
    less = lambda x, c: x - c.reshape(x.shape).astype(x.dtype)
    return treedef.unflatten([less(x, c) for x, c in zip(leaves, parts)])


@eqx.filter_jit
def _fit(
    problem: Problem, level: Level, key: PRNGKeyArray, degrees: tuple[int, ...]
) -> tuple[AbstractFunctions, Array]:
    """Functions of these degrees, with an axis for the candidates, and what the noise keeps
    of them."""
    noise = noise_of(problem, level)
    flat, unravel = jfu.ravel_pytree(problem.y0)
    fit = fit_quadratics if is_quadratic(flat.size, degrees) else fit_polynomials
    u, states = fit(noise, key, degrees)
    # Those before each step.
    few = jnp.concatenate([states[:1] * 0 + flat, states[:-1]])[:, :SECOND_PILOTS]

    def second(i):
        return noise.second(i, jax.vmap(unravel)(few[i]), lambda y: u(i, y))

    return u, jax.lax.map(second, jnp.arange(problem.max_steps))


def is_quadratic(d: int, degrees: tuple[int, ...]) -> bool:
    """Whether there are too many polynomials for least squares, and derivatives do."""
    return max(degrees) <= 2 and num_polynomials(d, 2) > MOST_POLYNOMIALS


def value_functions(
    problem: Problem,
    weights: np.ndarray,
    key: PRNGKeyArray,
    degrees: tuple[int, ...],
    spread: Callable[[ValueFunctionsSampler, PRNGKeyArray], PyTree[np.ndarray]],
) -> tuple[ValueFunctionsSampler, np.ndarray]:
    """A sampler with the best of the degrees for each time and each number of `phi`, by the
    `spread` of a few fresh samples; and which these are."""
    fits = [
        _fit(problem, problem.level(k), jr.fold_in(key, k), degrees)
        for k in range(len(problem.levels.h))
    ]
    u, second = jtu.tree_map(lambda *xs: jnp.stack(xs), *fits)

    def sampler(best):
        return ValueFunctionsSampler(problem, weights, *_chosen(u, second, best))

    shape = problem.levels.saved_steps.shape[1], sum(s.size for s in problem.outputs())
    same = lambda k: np.full(shape, k)
    if len(degrees) == 1:
        return sampler(same(0)), same(degrees[0])
    # The paths that choose are not those that are averaged.
    own = jr.fold_in(key, len(fits))
    each = []
    for k in range(len(degrees)):
        leaves = jtu.tree_leaves(spread(sampler(same(k)), own))
        each.append(np.concatenate([x.reshape(shape[0], -1) for x in leaves], axis=1))
    best = np.argmin(np.stack(each), axis=0)
    return sampler(best), np.asarray(degrees)[best]


def _chosen(u: AbstractFunctions, second: Array, best: np.ndarray):
    """The candidates `best`, of shape `(S, m)`."""
    index = jnp.asarray(best)[None]

    def take(x):
        # The axes C, S and m come where a name says so.
        axis = x.ndim - 3
        shaped = index.reshape(*[1] * axis, *index.shape)
        return jnp.take_along_axis(x, shaped, axis).squeeze(axis)

    if second.ndim > 2:
        moved = jnp.moveaxis(second, (2, 3, 4), (-3, -2, -1))
        second = jnp.moveaxis(take(moved), (-2, -1), (2, 3))
    return u.replaced(take), second
