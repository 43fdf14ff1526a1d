"""The random variables of a step, and expectations over them."""

import dataclasses
import functools as ft
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree, UInt32

from ..._brownian import Discrete, random_words
from ..._custom_types import Y
from ..._products import tensordot
from ..._simulation import Level, Problem
from ..._terms import outcomes


# Up to this many outcomes, a step is taken for each of them. Four noises of three values
# each have 81 outcomes, five have 243.
_MOST_OUTCOMES = 100

# A function of the state.
Function: TypeAlias = Callable[[Y], Array]


# Values of the random variables of a step, those of all variables along the last axis, and
# weights by which the expectation of any function of them is a sum over these values.
WeightedNodes: TypeAlias = tuple[
    Float[Array | np.ndarray, "K n"], Float[np.ndarray, " K"]
]


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
    # All outcomes of a step with their probabilities, if there are few outcomes.
    outcomes: WeightedNodes | None

    @staticmethod
    def of(problem: Problem, level: Level) -> "Noise":
        """The noise of a level. Raises a `ValueError` for random variables without finitely
        many outcomes."""
        laws = problem.variables(level.h).laws
        discrete_laws = tuple(law for law in laws if isinstance(law, Discrete))
        if len(discrete_laws) < len(laws):
            raise ValueError(
                "`ValueFunctions` sums over the outcomes of a step, but Gaussian "
                "increments have infinitely many. Use a `WeakBrownianPath` in place of the "
                "path in `terms`, or pass `sampling=ArrayRQMC(num_paths)`."
            )
        few_outcomes = None
        if math.prod(len(law.values) for law in discrete_laws) <= _MOST_OUTCOMES:
            # Only Gaussian variables have nodes, of which there are none here.
            values, probabilities = outcomes(discrete_laws, num_nodes=1)
            few_outcomes = values.astype(problem.dtype), probabilities
        return Noise(problem, level, discrete_laws, few_outcomes)

    def with_args(self, own_args: PyTree[Array]) -> "Noise":
        """The noise for a path with its own `args`."""
        return dataclasses.replace(self, problem=self.problem.with_args(own_args))

    def draw(
        self,
        key: PRNGKeyArray,
        draw_index: Any,
        cuts: UInt32[Array | np.ndarray, "n cuts"],
    ) -> tuple[Float[Array, " n"], Bool[Array, "n outcomes"]]:
        """The variables `x` drawn from the key and this index, and which outcomes they
        have. A variable has outcome `k` if its random word is not below `k` of its `cuts`,
        as from `cuts_of`, and below all others."""
        place = draw_index, jnp.asarray(self.level.index)
        # One random word for each variable, from a single block of words.
        words = random_words(key, place, 1, len(self.laws))[0]
        outcome_numbers = jnp.sum(words[:, None] >= cuts, axis=1)
        # (n, outcomes)
        values = padded([np.array(law.values) for law in self.laws])
        _, num_outcomes = values.shape
        has_outcome = outcome_numbers[:, None] == np.arange(num_outcomes)
        values = values.astype(self.problem.dtype)
        return jnp.sum(jnp.where(has_outcome, values, 0), axis=1), has_outcome

    def weighted_nodes(self, x: Array | None = None) -> WeightedNodes:
        """Nodes and weights of the expectation over the variables: all outcomes and their
        probabilities, if there are few outcomes. Otherwise two nodes that estimate the
        expectation from a draw `x`, or without a draw `2 * n + 1` nodes."""
        if self.outcomes is not None:
            return self.outcomes
        if x is not None:
            # The mean over a draw and its opposite is right for all odd functions.
            return jnp.stack([x, -x]), np.full(2, 0.5)
        # Two nodes along each axis, at `sqrt(3)` standard deviations with weight 1/6, as in
        # Gauss-Hermite quadrature, and zero, with the remainder of a total weight of one.
        # They are exact for polynomials of degree 3, or 5 in one variable.
        n = len(self.laws)
        nodes_on_axes = np.diag(np.sqrt(3 * self._variances()))
        nodes = np.concatenate([nodes_on_axes, -nodes_on_axes, np.zeros((1, n))])
        weights = np.append(np.full(2 * n, 1 / 6), 1 - n / 3)
        return nodes.astype(self.problem.dtype), weights

    def mean(self, i: Any, y: Y, u: Function, x: Array | None = None) -> Array:
        """The expectation of `u` after step `i` from `y`, over `weighted_nodes(x)`; NaN if
        a step fails."""
        nodes, weights = self.weighted_nodes(x)
        solver_state = self.new_solver_state(i, y)

        def value(x: Array | np.ndarray) -> Array:
            y1, _, success = self.step(i, y, solver_state, x)
            return jnp.where(success, u(y1), jnp.nan)

        values = jax.vmap(value)(nodes)
        return tensordot(weights.astype(values.dtype), values, 1)

    def advance(
        self,
        i: Any,
        y: Y,
        solver_state: PyTree[Array],
        u: Function,
        second_derivatives: Array | None,
        x: Array,
    ) -> tuple[Y, PyTree[Array], Bool[Array, ""], Array]:
        """Step `i` of a path with variables `x`: the states of the path and of the solver
        after it, whether it succeeded, and the control variate of `u`, whose mean over `x`
        is zero. `second_derivatives` comes from `mean_second_derivatives`."""
        if self.outcomes is not None:
            outcomes_of_x, probabilities = self.outcomes
            # A step for each outcome: the states of the path and of the solver after it.
            step_by_outcome = jax.vmap(lambda x: self.step(i, y, solver_state, x))
            ends, solver_states, success = step_by_outcome(outcomes_of_x)
            values = jax.vmap(u)(ends)
            mean = tensordot(probabilities.astype(values.dtype), values, 1)
            # The path itself takes the outcome that is equal to `x`.
            index_of_x = jnp.argmax(jnp.all(outcomes_of_x == x, axis=1))
            y1, next_solver_state, value = jtu.tree_map(
                lambda of_outcomes: of_outcomes[index_of_x],
                (ends, solver_states, values),
            )
            # One failed outcome makes the mean wrong, and with it the control variate.
            return y1, next_solver_state, jnp.all(success), value - mean

        # By the formula of this class.
        assert second_derivatives is not None
        y1, next_solver_state, success = self.step(i, y, solver_state, x)
        value_after = ft.partial(self._value_after, i, y, solver_state, u)
        first_derivatives = jax.jacrev(value_after)(jnp.zeros_like(x))
        # The second derivatives `C`, multiplied by this matrix and summed over both axes,
        # are `x^T C x - tr(C Sigma)`.
        centred_square = jnp.outer(x, x) - np.diag(self._variances()).astype(x.dtype)
        linear = tensordot(first_derivatives, x, 1)
        quadratic = tensordot(centred_square, second_derivatives, 2) / 2
        return y1, next_solver_state, success, linear + quadratic

    def mean_second_derivatives(self, i: Any, ys: Y, u: Function) -> Array | None:
        """The mean of the second derivatives of `u` after step `i` along the variables,
        over the states `ys` before it; `None` if there are few outcomes."""
        if self.outcomes is not None:
            return None
        zero = jnp.zeros(len(self.laws), self.problem.dtype)

        def hessian(y: Y) -> Array:
            solver_state = self.new_solver_state(i, y)
            value_after = ft.partial(self._value_after, i, y, solver_state, u)
            return jax.hessian(value_after)(zero)

        # One state after another, since a Hessian of many variables takes much memory.
        # (S, m, n, n)
        mean = jnp.mean(jax.lax.map(hessian, ys), axis=0)
        # (n, n, S, m)
        return jnp.moveaxis(mean, (-2, -1), (0, 1))

    def _value_after(
        self, i: Any, y: Y, solver_state: PyTree[Array], u: Function, x: Array
    ) -> Array:
        """The value of `u` after step `i` with variables `x`."""
        end, _, _ = self.step(i, y, solver_state, x)
        return u(end)

    def step(
        self, i: Any, y: Y, solver_state: PyTree[Array], x: Array | np.ndarray
    ) -> tuple[Y, PyTree[Array], Bool[Array, ""]]:
        """`Problem.step` with these variables."""
        terms = self.problem.variables(self.level.h).terms_with(x)
        return self.problem.step(terms, i, self.level.h, y, solver_state)

    def new_solver_state(self, i: Any, y: Y) -> PyTree[Array]:
        """The state of a solver that starts at step `i`. It is used in fits, which affect
        only the variance; paths carry their own solver state."""
        no_noise = np.zeros(len(self.laws))
        terms = self.problem.variables(self.level.h).terms_with(no_noise)
        solver_state = self.problem.init(terms, i, self.level.h, y)
        return jtu.tree_map(_hidden_if_result, solver_state)

    def _variances(self) -> np.ndarray:
        """The variance of each variable. (All have mean zero.)"""
        return np.array(
            [np.dot(law.probabilities, np.square(law.values)) for law in self.laws]
        )


def _hidden_if_result(x: Array) -> Array:
    """An array of a solver's state, hidden from XLA behind a barrier if it is an integer:
    the result of a solve, which is a constant in a new state. XLA would evaluate what
    follows from this constant for all states and outcomes while compiling: for 6,300 states
    and 27 outcomes for more than a second, with an alarm."""
    is_result = jnp.issubdtype(x.dtype, jnp.integer)
    return jax.lax.optimization_barrier(x) if is_result else x


def cuts_of(
    probabilities: Sequence[Sequence[float] | Float[np.ndarray, " outcomes"]],
) -> UInt32[np.ndarray, "n cuts"]:
    """The cuts between the random words of the outcomes of variables, from the
    probabilities of the outcomes of each."""
    cumulative = padded([np.cumsum(p) for p in probabilities])[:, :-1]
    # A cut of 2^32 is no word, and the largest word takes its place. (The one random word
    # that reaches this cut has the number of an outcome past the last, which `padded` makes
    # equal to the last.)
    largest_word = np.iinfo(np.uint32).max
    return np.minimum(np.round(cumulative * 2.0**32), largest_word).astype(np.uint32)


def padded(rows: Sequence[np.ndarray]) -> np.ndarray:
    """The rows as one array, each with its last entry in place of those that it lacks."""
    most = max(map(len, rows))
    return np.stack([np.pad(row, (0, most - len(row)), mode="edge") for row in rows])


def count_outcomes(problem: Problem) -> int | None:
    """The number of outcomes of a step, or `None` if there are many or infinitely many."""
    try:
        noise = Noise.of(problem, problem.level(0))
    except ValueError:
        return None
    if noise.outcomes is None:
        return None
    values, _ = noise.outcomes
    return len(values)
