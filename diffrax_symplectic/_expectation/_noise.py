"""What the noise of one step does to a function of the state: a variable with mean zero,
and the expectation of the function."""

import abc
from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from .._brownian import AbstractLaw, Discrete, random_words
from .._custom_types import Y
from .._quadrature import outcomes, step_variables
from ._steps import Level, Problem


# Up to so many outcomes a step is taken for each of them.
_MOST_OUTCOMES = 100

# A value function, on one state.
Function: TypeAlias = Callable[[Y], Array]


class AbstractNoise(eqx.Module):
    """The noise of the steps of a level."""

    problem: eqx.AbstractVar[Problem]
    level: eqx.AbstractVar[Level]

    @abc.abstractmethod
    def draw(self, i, key: PRNGKeyArray) -> Array:
        """The random variables of step number `i` of a path with this key."""

    @abc.abstractmethod
    def expected(self, i, y: Y, u: Function, key: PRNGKeyArray) -> Array:
        """The expectation of `u` after step number `i` from `y`, or an estimate of it."""

    @abc.abstractmethod
    def advance(
        self, i, y: Y, u: Function, second: Array, key: PRNGKeyArray
    ) -> tuple[Y, Array, Bool[Array, ""]]:
        """The state after step number `i` of a path with this key; `u` there less its
        expectation, or another variable with mean zero that is close to it; whether the step
        succeeded. `second` is what `second` returns."""

    @abc.abstractmethod
    def second(self, i, ys: Y, u: Function) -> Array:
        """What is computed once for all paths, at the states `ys`."""

    def step(self, i, y: Y, variables: Array) -> tuple[Y, Bool[Array, ""]]:
        p, h = self.problem, self.level.h
        terms = step_variables(p.terms, h).terms_with(variables)
        t = p.t0 + i * h
        state = p.solver.init(terms, t, t + h, y, p.args)
        y, _, success = p.step(terms, i, h, y, state)
        return y, success


class EnumeratedNoise(AbstractNoise):
    """A step is taken for each outcome, so that expectations are finite sums."""

    problem: Problem
    level: Level
    values: Float[np.ndarray, "K n"]
    probabilities: Float[np.ndarray, " K"]

    def _after(self, i, y, u):
        ends, success = jax.vmap(lambda x: self.step(i, y, x))(self.values)
        values = jax.vmap(u)(ends)
        p = jnp.asarray(self.probabilities, values.dtype)
        return ends, success, values, jnp.tensordot(p, values, 1)

    def expected(self, i, y, u, key):
        return self._after(i, y, u)[3]

    def second(self, i, ys, u):
        return jnp.zeros(())

    def _number(self, i, key):
        word = random_words(key, (i, self.level.index), 1, 1)[0, 0]
        cuts = np.round(np.cumsum(self.probabilities)[:-1] * 2.0**32).astype(np.uint32)
        return jnp.sum(word >= cuts)

    def draw(self, i, key):
        return jnp.asarray(self.values)[self._number(i, key)]

    def advance(self, i, y, u, second, key):
        ends, success, values, mean = self._after(i, y, u)
        k = self._number(i, key)
        take = lambda x: x[k]
        return jtu.tree_map(take, ends), take(values) - mean, jnp.all(success)


class DifferentiatedNoise(AbstractNoise):
    """For more outcomes than can be enumerated. With the random variables $x$ of a step, and
    the first and second derivatives $a$ and $C$ of $u(y_1(x))$ at $x = 0$, the variable is
    $a \\cdot x + \\frac12 (x^\\top C x - \\mathrm{tr}\\, C \\Sigma)$, with the variances
    $\\Sigma$. Its mean is zero whatever $a$ and $C$ are, so that one $C$ does for all
    paths. For a quadratic function and noise that enters the step linearly it is $u$ less
    its expectation."""

    problem: Problem
    level: Level
    laws: tuple[AbstractLaw, ...] = eqx.field(static=True)

    def draw(self, i, key):
        words = random_words(key, (i, self.level.index), 1, len(self.laws))[0]
        dtype = jnp.result_type(*jtu.tree_leaves(self.problem.y0))
        kinds = [*dict.fromkeys(self.laws)]
        which = np.array([kinds.index(law) for law in self.laws])
        return jnp.select(
            [which == k for k in range(len(kinds))],
            [law.from_words(words, dtype) for law in kinds],
        )

    def expected(self, i, y, u, key):
        x = self.draw(i, key)
        return (u(self.step(i, y, x)[0]) + u(self.step(i, y, -x)[0])) / 2

    def second(self, i, ys, u):
        zero = self._zero()
        at = lambda y: jax.hessian(lambda x: u(self.step(i, y, x)[0]))(zero)
        total = jax.lax.map(at, ys)
        return jnp.mean(total, axis=0)

    def advance(self, i, y, u, second, key):
        x, zero = self.draw(i, key), self._zero()
        y1, success = self.step(i, y, x)
        first = jax.jacrev(lambda x: u(self.step(i, y, x)[0]))(zero)
        square = jnp.outer(x, x) - jnp.diag(jnp.asarray(self._variances(), x.dtype))
        control = jnp.tensordot(first, x, 1) + jnp.tensordot(second, square, 2) / 2
        return y1, control, success

    def _zero(self) -> Array:
        dtype = jnp.result_type(*jtu.tree_leaves(self.problem.y0))
        return jnp.zeros(len(self.laws), dtype)

    def _variances(self) -> np.ndarray:
        moment = lambda values, weights: weights @ values**2
        return np.array([moment(*law.outcomes(1)) for law in self.laws])


def noise_of(problem: Problem, level: Level) -> AbstractNoise:
    """Raises a `ValueError` for random variables without finitely many outcomes."""
    laws = step_variables(problem.terms, level.h).laws
    _check_discrete(laws)
    count = np.prod([len(law.outcomes(1)[1]) for law in laws], dtype=float)
    if count > _MOST_OUTCOMES:
        return DifferentiatedNoise(problem, level, laws)
    values, probabilities = outcomes(laws, 1)
    dtype = jnp.result_type(*jtu.tree_leaves(problem.y0))
    return EnumeratedNoise(problem, level, values.astype(dtype), probabilities)


def _check_discrete(laws: Sequence[AbstractLaw]) -> None:
    if not all(isinstance(law, Discrete) for law in laws):
        raise ValueError(
            "`ValueFunctions` sums over the outcomes of a step, of which Gaussian "
            "increments have infinitely many. Use a `WeakBrownianPath` in place of the path "
            "in `terms` (for the area of a step with `second=True`), or pass "
            "`sampling=ArrayRQMC(num_paths)`."
        )
