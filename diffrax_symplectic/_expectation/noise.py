"""The random variables of a step, and expectations over them."""

import collections
import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .._brownian import Discrete, random_words
from .._custom_types import Y
from .._terms import outcomes, step_variables
from ._problem import Level, Problem
from .polynomials import tensordot


# Up to this many outcomes, a step is taken for each of them.
_MOST_OUTCOMES = 100
# The relative entropy of a whole path's wider noise with respect to its own law, in nats.
_NATS = 8.0
# With this tilt nearly all outcomes are the largest.
_MOST_TILTED = 4.0

# A function of the state.
Function: TypeAlias = Callable[[Y], Array]


class Noise(eqx.Module):
    r"""The random variables $x$ of the steps of a level. If there are few outcomes, a step
    is taken for each of them, and expectations are finite sums.

    Otherwise $u(y_1) - \mathbb E[u(y_1)]$ is replaced by $a \cdot x + \frac12 (x^\top C x -
    \mathrm{tr}\, C \Sigma)$, with the first and second derivatives $a$ and $C$ of
    $u(y_1(x))$ at $x = 0$ and the variances $\Sigma$. Its mean is zero for any $a$ and $C$,
    so one $C$ serves all paths. For a quadratic function and noise that enters the step
    linearly it is exact.
    """

    problem: Problem
    level: Level
    laws: tuple[Discrete, ...] = eqx.field(static=True)
    # Values and probabilities, if there are few.
    outcomes: tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]] | None

    @staticmethod
    def of(problem: Problem, level: Level) -> "Noise":
        """Raises a `ValueError` for random variables without finitely many outcomes."""
        laws = step_variables(problem.terms, level.h).laws
        discrete = tuple(law for law in laws if isinstance(law, Discrete))
        if len(discrete) < len(laws):
            raise ValueError(
                "`ValueFunctions` sums over the outcomes of a step, but Gaussian "
                "increments have infinitely many. Use a `WeakBrownianPath` in place of the "
                "path in `terms`, or pass `sampling=ArrayRQMC(num_paths)`."
            )
        if math.prod(len(law.values) for law in discrete) > _MOST_OUTCOMES:
            return Noise(problem, level, discrete, None)
        values, probabilities = outcomes(discrete, 1)
        few = values.astype(problem.dtype), probabilities
        return Noise(problem, level, discrete, few)

    def with_args(self, own: PyTree[Array]) -> "Noise":
        """The noise for a path with its own `args`."""
        return dataclasses.replace(self, problem=self.problem.with_args(own))

    def draw(
        self, key: PRNGKeyArray, number, share: Any = 0.0, tilt: Any = 0.0
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """The variables drawn from the key and this number, and their log likelihood ratio.
        In a fraction `share` (from 0 to 1) of draws all outcomes are equally probable.
        Probabilities are multiplied by the exponential of `tilt`, a number or one for each
        variable, times the outcome."""
        place = number, jnp.asarray(self.level.index)
        words = random_words(key, place, 1, len(self.laws))[0]
        x = jnp.zeros(len(self.laws), self.problem.dtype)
        log_ratio, tilts = jnp.zeros_like(x), jnp.broadcast_to(tilt, x.shape)
        own = (share == 0) & (tilts == 0)
        for law in dict.fromkeys(self.laws):
            mine = np.array([other == law for other in self.laws])
            p, q = np.array(law.probabilities, x.dtype), _widened(law, share)
            q = jax.vmap(lambda tilt: _tilted(law, q, tilt))(tilts)
            cuts = (jnp.cumsum(q, axis=1)[:, :-1] * 2.0**32).astype(jnp.uint32)
            cuts = jnp.where(own[:, None], np.array(law.cuts, np.uint32), cuts)
            place = jnp.sum(words[:, None] >= cuts, axis=1)
            x = jnp.where(mine, jnp.asarray(law.values, x.dtype)[place], x)
            ratio = jnp.take_along_axis(jnp.log(q / p), place[:, None], axis=1)[:, 0]
            log_ratio = jnp.where(mine, ratio, log_ratio)
        return x, jnp.sum(log_ratio)

    @property
    def share(self) -> Array:
        """The largest `share` for `draw` that `_strongest` allows."""
        return self._strongest(_widened, 1.0)

    @property
    def tilt(self) -> Array:
        """The largest `tilt` for `draw` that `_strongest` allows."""
        own = lambda law: np.array(law.probabilities)
        return self._strongest(lambda law, z: _tilted(law, own(law), z), _MOST_TILTED)

    def _strongest(self, changed: Callable, most: float) -> Array:
        """The largest `z`, up to `most`, for which the laws `changed(law, z)` give all
        variables of a path together a relative entropy of at most 8 nats with respect to
        their own laws."""
        levels = len(self.problem.levels.h)
        steps = self.problem.max_steps / 2 ** np.arange(levels)[::-1]
        counts = collections.Counter(self.laws).items()

        def information(z: float) -> float:
            each = [(n, changed(x, z), np.array(x.probabilities)) for x, n in counts]
            return sum(n * np.sum(q * np.log(q / p)) for n, q, p in each)

        low, high = np.zeros(levels), np.full(levels, most)
        for _ in range(30):
            z = (low + high) / 2
            enough = steps * [*map(information, z)] > _NATS / levels
            low, high = np.where(enough, low, z), np.where(enough, z, high)
        return jnp.asarray(low, self.problem.dtype)[self.level.index]

    def nodes(self, x: Array | None = None) -> tuple[Any, np.ndarray]:
        """Nodes and weights of the expectation over the variables. Given a draw `x`, unless
        there are few outcomes, two nodes that estimate it."""
        if self.outcomes is not None:
            return self.outcomes
        if x is not None:
            return jnp.stack([x, -x]), np.full(2, 0.5)
        # Exact for polynomials of degree 3, or 5 in one variable.
        m, arms = len(self.laws), np.diag(np.sqrt(3 * self._variances()))
        points = np.concatenate([arms, -arms, np.zeros((1, m))])
        weights = np.append(np.full(2 * m, 1 / 6), 1 - m / 3)
        return points.astype(self.problem.dtype), weights

    def mean(self, i, y: Y, u: Function, x: Array | None = None) -> Array:
        """The expectation of `u` after step `i` from `y`, over `nodes(x)`; NaN if a step
        fails."""
        (points, weights), state = self.nodes(x), self.fresh(i, y)

        def value(x: Array) -> Array:
            y1, _, success = self.step(i, y, state, x)
            return jnp.where(success, u(y1), jnp.nan)

        values = jax.vmap(value)(points)
        return tensordot(weights.astype(values.dtype), values, 1)

    def advance(
        self, i, y: Y, state: PyTree, u: Function, second: Array | None, x: Array
    ) -> tuple[Y, PyTree, Bool[Array, ""], tuple[Array, Array]]:
        """The states of the path and the solver after step `i` with variables `x`; whether
        the step succeeded; and a pair of `u` at the end and its control variate. `second`
        comes from the method of the same name."""
        if self.outcomes is None:
            assert second is not None
            y1, new, success = self.step(i, y, state, x)
            first = jax.jacrev(lambda x: u(self.step(i, y, state, x)[0]))(0 * x)
            square = jnp.outer(x, x) - np.diag(self._variances()).astype(x.dtype)
            control = tensordot(first, x, 1) + tensordot(square, second, 2) / 2
            return y1, new, success, (u(y1), control)
        points, weights = self.outcomes
        ends, states, success = jax.vmap(lambda x: self.step(i, y, state, x))(points)
        values, own = jax.vmap(u)(ends), jnp.argmax(jnp.all(points == x, axis=1))
        mean = tensordot(weights.astype(values.dtype), values, 1)
        y1, new, value = jtu.tree_map(lambda x: x[own], (ends, states, values))
        return y1, new, jnp.all(success), (value, value - mean)

    def second(self, i, ys: Y, u: Function) -> Array | None:
        """The mean of the second derivatives over `ys`, if there are many outcomes."""
        if self.outcomes is not None:
            return None
        zero = jnp.zeros(len(self.laws), self.problem.dtype)
        after = lambda y, x: u(self.step(i, y, self.fresh(i, y), x)[0])
        at = lambda y: jax.hessian(lambda x: after(y, x))(zero)
        mean = jnp.mean(jax.lax.map(at, ys), axis=0)
        return jnp.moveaxis(mean, (-2, -1), (0, 1))

    def step(self, i, y: Y, state: PyTree, x: Array):
        return self.problem.step(self._terms(x), i, self.level.h, y, state)

    def fresh(self, i, y: Y) -> PyTree[Array]:
        """The state of a solver that starts at step `i`. It is used in fits, which affect
        only the variance; paths carry their own solver state."""
        terms = self._terms(np.zeros(len(self.laws)))
        state = self.problem.init(terms, i, self.level.h, y)

        # XLA would evaluate what follows from a constant result for all states and outcomes
        # while compiling: for 6,300 states and 27 outcomes for more than a second, with an
        # alarm.
        def hidden(x: Array) -> Array:
            is_result = jnp.issubdtype(x.dtype, jnp.integer)
            return jax.lax.optimization_barrier(x) if is_result else x

        return jtu.tree_map(hidden, state)

    def _terms(self, x):
        return step_variables(self.problem.terms, self.level.h).terms_with(x)

    def _variances(self) -> np.ndarray:
        return np.array(
            [np.dot(x.probabilities, np.square(x.values)) for x in self.laws]
        )


def _widened(law: Discrete, share: Any) -> Any:
    p = np.array(law.probabilities, jnp.result_type(share))
    return (1 - share) * p + share / len(p)


def _tilted(law: Discrete, q: Any, tilt: Any) -> Any:
    numpy = jnp if isinstance(tilt, jax.Array) else np
    weights = q * numpy.exp(tilt * np.array(law.values, jnp.result_type(tilt)))
    return weights / numpy.sum(weights)


def num_outcomes(problem: Problem) -> int | None:
    """The number of outcomes of a step, or `None` if there are many."""
    try:
        outcomes = Noise.of(problem, problem.level(0)).outcomes
    except ValueError:
        return None
    return None if outcomes is None else len(outcomes[1])
