"""What the noise of one step does to a function of the state."""

import abc
from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .._brownian import AbstractLaw, Discrete, random_words
from .._custom_types import Y
from .._quadrature import outcomes, step_variables
from ._steps import Level, Problem


# Up to so many outcomes a step is taken for each of them.
_MOST_OUTCOMES = 100

# A function of the state.
Function: TypeAlias = Callable[[Y], Array]


class Ends(eqx.Module):
    """Where a step may end: the states, whether the step to each succeeds, weights with
    which their mean is the expectation over the step (or an estimate of it), and which of
    them is that of the path."""

    y: Y
    success: Bool[Array, " K"]
    weights: Float[Array, " K"]
    own: Int[Array, ""]

    def mean(self, values: Float[Array, "K ..."]) -> Array:
        return jnp.tensordot(self.weights.astype(values.dtype), values, 1)


class AbstractNoise(eqx.Module):
    """The noise of the steps of a level."""

    problem: eqx.AbstractVar[Problem]
    level: eqx.AbstractVar[Level]

    @abc.abstractmethod
    def ends(self, i, y: Y, key: PRNGKeyArray, draw, brief: bool = False) -> Ends:
        """Of step number `i` from `y`. The path is that of the key and the number `draw`.
        With `brief` the mean may be an estimate."""

    @abc.abstractmethod
    def advance(
        self, i, y: Y, u: Function, second: Array, key: PRNGKeyArray
    ) -> tuple[Y, Array, Bool[Array, ""]]:
        """The state after step number `i` of a path with this key; `u` there less its
        expectation, or another variable with mean zero that is close to it; whether the
        step succeeded. `second` is what `second` returns."""

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

    def ends(self, i, y, key, draw, brief=False):
        y, success = jax.vmap(lambda x: self.step(i, y, x))(self.values)
        word = random_words(key, (draw, self.level.index), 1, 1)[0, 0]
        cuts = np.round(np.cumsum(self.probabilities)[:-1] * 2.0**32).astype(np.uint32)
        own = jnp.sum((word >= cuts).astype(jnp.int32))
        return Ends(y, success, jnp.asarray(self.probabilities), own)

    def second(self, i, ys, u):
        return jnp.zeros(())

    def advance(self, i, y, u, second, key):
        ends = self.ends(i, y, key, i)
        values = jax.vmap(u)(ends.y)
        take = lambda x: x[ends.own]
        control = take(values) - ends.mean(values)
        return jtu.tree_map(take, ends.y), control, jnp.all(ends.success)


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

    def _draw(self, key, number) -> Array:
        words = random_words(key, (number, self.level.index), 1, len(self.laws))[0]
        x = jnp.zeros_like(self._zero())
        for law in dict.fromkeys(self.laws):
            here = np.array([other == law for other in self.laws])
            x = jnp.where(here, law.from_words(words, x.dtype), x)
        return x

    def ends(self, i, y, key, draw, brief=False):
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
        y, success = jax.vmap(lambda x: self.step(i, y, x))(points)
        return Ends(y, success, jnp.asarray(weights, x.dtype), jnp.array(0))

    def second(self, i, ys, u):
        at = lambda y: jax.hessian(lambda x: u(self.step(i, y, x)[0]))(self._zero())
        return jnp.mean(jax.lax.map(at, ys), axis=0)

    def advance(self, i, y, u, second, key):
        x = self._draw(key, i)
        y1, success = self.step(i, y, x)
        first = jax.jacrev(lambda x: u(self.step(i, y, x)[0]))(self._zero())
        square = jnp.outer(x, x) - np.diag(self._variances()).astype(x.dtype)
        control = jnp.tensordot(first, x, 1) + jnp.tensordot(second, square, 2) / 2
        return y1, control, success

    def _variances(self) -> np.ndarray:
        variance = lambda values, weights: weights @ values**2
        return np.array([variance(*law.outcomes(1)) for law in self.laws])

    def _zero(self) -> Array:
        dtype = jnp.result_type(*jtu.tree_leaves(self.problem.y0))
        return jnp.zeros(len(self.laws), dtype)


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
            "increments have infinitely many. Use a `WeakBrownianPath` in place of the "
            "path in `terms`, or pass `sampling=ArrayRQMC(num_paths)`."
        )
