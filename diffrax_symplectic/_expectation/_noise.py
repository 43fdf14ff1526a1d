"""What the noise of one step does to a function of the state."""

import abc
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .._brownian import AbstractLaw, Discrete, random_words
from .._custom_types import Y
from .._terms import outcomes, step_variables
from ._steps import Level, Problem


# Up to so many outcomes a step is taken for each of them.
_MOST_OUTCOMES = 100

# A function of the state.
Function: TypeAlias = Callable[[Y], Array]


class Ends(eqx.Module):
    """Where a step may end: the states of the path and of the solver, whether the step
    there succeeds, weights with which their mean is the expectation over the step (or an
    estimate of it), and which of them is that of the path."""

    y: Y
    state: PyTree[Array]
    success: Bool[Array, " K"]
    weights: Float[Array, " K"]
    own: Int[Array, ""]

    def mean(self, values: Float[Array, "K ..."]) -> Array:
        return jnp.tensordot(self.weights.astype(values.dtype), values, 1)


class AbstractNoise(eqx.Module):
    """The noise of the steps of a level."""

    problem: eqx.AbstractVar[Problem]
    level: eqx.AbstractVar[Level]

    @property
    @abc.abstractmethod
    def num_outcomes(self) -> int:
        """How many ends of a step are looked at."""

    @abc.abstractmethod
    def ends(
        self, i, y: Y, state: PyTree, key: PRNGKeyArray, draw, wide=False, brief=False
    ) -> Ends:
        """Of step number `i` from `y`. The path is that of the key and the number `draw`.
        With `wide` it may go further than its law says, and with `brief` the mean may be an
        estimate."""

    @abc.abstractmethod
    def advance(
        self, i, y: Y, state: PyTree, u: Function, second: Array | None, key
    ) -> tuple[Y, PyTree, Array, Bool[Array, ""]]:
        """The states after step number `i` of a path with this key; `u` there less its
        expectation, or another variable with mean zero that is close to it; whether the
        step succeeded. `second` is what `second` returns."""

    @abc.abstractmethod
    def second(self, i, ys: Y, u: Function) -> Array | None:
        """What is computed once for all paths, at the states `ys`."""

    def step(self, i, y: Y, state: PyTree, variables: Array):
        return self.problem.step(self._terms(variables), i, self.level.h, y, state)

    def fresh(self, i, y: Y) -> PyTree[Array]:
        """The state of a solver that begins with step number `i`. It serves for a fit,
        which decides the variance only: a path takes its own state along."""
        laws = step_variables(self.problem.terms, self.level.h).laws
        return self.problem.init(self._terms(np.zeros(len(laws))), i, self.level.h, y)

    def _terms(self, variables):
        return step_variables(self.problem.terms, self.level.h).terms_with(variables)


class EnumeratedNoise(AbstractNoise):
    """A step is taken for each outcome, so that expectations are finite sums."""

    problem: Problem
    level: Level
    values: Float[np.ndarray, "K n"]
    probabilities: Float[np.ndarray, " K"]

    @property
    def num_outcomes(self):
        return len(self.probabilities)

    def ends(self, i, y, state, key, draw, wide=False, brief=False):
        one = lambda variables: self.step(i, y, state, variables)
        y, state, success = jax.vmap(one)(self.values)
        word = random_words(key, (draw, self.level.index), 1, 1)[0, 0]
        cuts = np.round(np.cumsum(self.probabilities)[:-1] * 2.0**32).astype(np.uint32)
        own = jnp.sum((word >= cuts).astype(jnp.int32))
        if wide:
            own = (word % np.uint32(len(self.values))).astype(jnp.int32)
        return Ends(y, state, success, jnp.asarray(self.probabilities), own)

    def advance(self, i, y, state, u, second, key):
        ends = self.ends(i, y, state, key, i)
        values = jax.vmap(u)(ends.y)
        take = lambda x: x[ends.own]
        y, state = jtu.tree_map(take, (ends.y, ends.state))
        return y, state, take(values) - ends.mean(values), jnp.all(ends.success)

    def second(self, i, ys, u):
        return None


class DifferentiatedNoise(AbstractNoise):
    r"""For more outcomes than can be enumerated. With the random variables $x$ of a step,
    and the first and second derivatives $a$ and $C$ of $u(y_1(x))$ at $x = 0$, the variable
    is $a \cdot x + \frac12 (x^\top C x - \mathrm{tr}\, C \Sigma)$, with the variances
    $\Sigma$. Its mean is zero whatever $a$ and $C$ are, so that one $C$ does for all
    paths. For a quadratic function and noise that enters the step linearly it is $u$ less
    its expectation."""

    problem: Problem
    level: Level
    laws: tuple[AbstractLaw, ...] = eqx.field(static=True)

    @property
    def num_outcomes(self):
        return 2 * len(self.laws) + 2

    def ends(self, i, y, state, key, draw, wide=False, brief=False):
        x, m = self._draw(key, draw), len(self.laws)
        if brief:
            points, weights = jnp.stack([x, -x]), np.full(2, 0.5)
        else:
            # Exact for polynomials of degree 3, and 5 in one variable; the path has no
            # weight.
            arms = np.diag(np.sqrt(3 * self._variances()))
            points = np.concatenate([arms, -arms, np.zeros((1, m))]).astype(x.dtype)
            points = jnp.concatenate([x[None], points])
            weights = np.concatenate([[0], np.full(2 * m, 1 / 6), [1 - m / 3]])
        y, state, success = jax.vmap(lambda x: self.step(i, y, state, x))(points)
        return Ends(y, state, success, jnp.asarray(weights, x.dtype), jnp.array(0))

    def advance(self, i, y, state, u, second, key):
        assert second is not None
        x = self._draw(key, i)
        y1, new, success = self.step(i, y, state, x)
        first = jax.jacrev(lambda x: u(self.step(i, y, state, x)[0]))(0 * x)
        square = jnp.outer(x, x) - np.diag(self._variances()).astype(x.dtype)
        control = jnp.tensordot(first, x, 1) + jnp.tensordot(square, second, 2) / 2
        return y1, new, control, success

    def second(self, i, ys, u):
        zero = jnp.zeros(len(self.laws), self.problem.dtype)
        after = lambda y, x: u(self.step(i, y, self.fresh(i, y), x)[0])
        at = lambda y: jax.hessian(lambda x: after(y, x))(zero)
        mean = jnp.mean(jax.lax.map(at, ys), axis=0)
        return jnp.moveaxis(mean, (-2, -1), (0, 1))

    def _draw(self, key, number) -> Array:
        words = random_words(key, (number, self.level.index), 1, len(self.laws))[0]
        x = jnp.zeros(len(self.laws), self.problem.dtype)
        for law in dict.fromkeys(self.laws):
            here = np.array([other == law for other in self.laws])
            x = jnp.where(here, law.from_words(words, x.dtype), x)
        return x

    def _variances(self) -> np.ndarray:
        variance = lambda values, weights: weights @ values**2
        return np.array([variance(*law.outcomes(1)) for law in self.laws])


def noise_of(problem: Problem, level: Level) -> AbstractNoise:
    """Raises a `ValueError` for random variables without finitely many outcomes."""
    laws = step_variables(problem.terms, level.h).laws
    if not all(isinstance(law, Discrete) for law in laws):
        raise ValueError(
            "`ValueFunctions` sums over the outcomes of a step, of which Gaussian "
            "increments have infinitely many. Use a `WeakBrownianPath` in place of the "
            "path in `terms`, or pass `sampling=ArrayRQMC(num_paths)`."
        )
    count = np.prod([len(law.outcomes(1)[1]) for law in laws], dtype=float)
    if count > _MOST_OUTCOMES:
        return DifferentiatedNoise(problem, level, laws)
    values, probabilities = outcomes(laws, 1)
    return EnumeratedNoise(problem, level, values.astype(problem.dtype), probabilities)
