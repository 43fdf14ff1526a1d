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

# A function of the state of the equation.
Function: TypeAlias = Callable[[Y], Array]


# Nodes and weights of an expectation over the random variables of a step. A node has a
# value for each variable. The expectation of a function of the variables is the weighted
# sum of its values at all nodes.
WeightedNodes: TypeAlias = tuple[
    Float[Array | np.ndarray, "K n"], Float[np.ndarray, " K"]
]


class Noise(eqx.Module):
    """The random variables `x` of the steps of a level. If a step has few outcomes, a step
    is taken for each of them, and expectations are finite sums."""

    problem: Problem
    level: Level
    laws: tuple[Discrete, ...] = eqx.field(static=True)
    # All outcomes of a step with their probabilities; `None` if there are many outcomes.
    few_outcomes: WeightedNodes | None

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
            # `num_nodes` is for Gaussian variables, of which there are none here.
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
        """Draws the variables by this key. Other indices and levels give independent draws.
        Returns the values of the variables, and for each variable which of its outcomes it
        has. By `cuts`, as from `cuts_of`, a random word that is at or above `k` of the cuts
        of its variable gives outcome `k`."""
        # The index and the level stand for the time and the length of a step, which a
        # Brownian path would take.
        place = draw_index, jnp.asarray(self.level.index)
        # One set of words, with one word for each variable.
        words = random_words(key, place, 1, len(self.laws))[0]
        outcome_numbers = jnp.sum(words[:, None] >= cuts, axis=1)
        # (n, outcomes)
        values = padded([np.array(law.values) for law in self.laws])
        _, num_outcomes = values.shape
        has_outcome = outcome_numbers[:, None] == np.arange(num_outcomes)
        values = values.astype(self.problem.dtype)
        return jnp.sum(jnp.where(has_outcome, values, 0), axis=1), has_outcome

    def weighted_nodes(self, x: Array | None = None) -> WeightedNodes:
        """Nodes and weights of the expectation over the variables:

        - if there are few outcomes, all of them with their probabilities;
        - otherwise with a draw `x`, two nodes that estimate the expectation from it;
        - otherwise `2 * n + 1` nodes of a quadrature.
        """
        if self.few_outcomes is not None:
            return self.few_outcomes
        if x is not None:
            # The mean over a draw and its opposite is right for all odd functions.
            return jnp.stack([x, -x]), np.full(2, 0.5)
        # As in Gauss-Hermite quadrature, there are two nodes along each axis, at `sqrt(3)`
        # standard deviations with weight 1/6. The node at zero has the rest of the total
        # weight of one. The sum is exact for polynomials of degree 3, or 5 in one variable.
        n = len(self.laws)
        nodes_on_axes = np.diag(np.sqrt(3 * self.variances()))
        nodes = np.concatenate([nodes_on_axes, -nodes_on_axes, np.zeros((1, n))])
        weights = np.append(np.full(2 * n, 1 / 6), 1 - n / 3)
        return nodes.astype(self.problem.dtype), weights

    def mean(self, i: Any, y: Y, u: Function, x: Array | None = None) -> Array:
        """The expectation of `u` after step `i` from `y`, by the nodes and weights of
        `weighted_nodes(x)`; NaN if a step fails."""
        nodes, weights = self.weighted_nodes(x)
        solver_state = self.new_solver_state(i, y)

        def value(node: Array | np.ndarray) -> Array:
            y1, _, success = self.step(i, y, solver_state, node)
            return jnp.where(success, u(y1), jnp.nan)

        values = jax.vmap(value)(nodes)
        return tensordot(weights.astype(values.dtype), values, 1)

    def mean_second_derivatives(self, i: Any, ys: Y, u: Function) -> Array | None:
        """The second derivatives of `u` after step `i` along the variables, averaged over
        the states `ys` before the step; `None` if there are few outcomes."""
        if self.few_outcomes is not None:
            return None
        zero = jnp.zeros(len(self.laws), self.problem.dtype)

        def hessian(y: Y) -> Array:
            solver_state = self.new_solver_state(i, y)
            value_after = ft.partial(self.value_after, i, y, solver_state, u)
            return jax.hessian(value_after)(zero)

        # One state after another, since a Hessian of many variables takes much memory.
        # (S, m, n, n)
        mean = jnp.mean(jax.lax.map(hessian, ys), axis=0)
        # (n, n, S, m)
        return jnp.moveaxis(mean, (-2, -1), (0, 1))

    def value_after(
        self, i: Any, y: Y, solver_state: PyTree[Array], u: Function, x: Array
    ) -> Array:
        """The value of `u` after step `i` with variables `x`."""
        end, _, _ = self.step(i, y, solver_state, x)
        return u(end)

    def step(
        self, i: Any, y: Y, solver_state: PyTree[Array], x: Array | np.ndarray
    ) -> tuple[Y, PyTree[Array], Bool[Array, ""]]:
        """`Problem.step` with these values of the variables."""
        terms = self.problem.variables(self.level.h).terms_with(x)
        return self.problem.step(terms, i, self.level.h, y, solver_state)

    def new_solver_state(self, i: Any, y: Y) -> PyTree[Array]:
        """The state of a solver that starts anew at step `i`. Fits start one in each step,
        which affects only the variance. Paths start one in step 0, and carry it along."""
        no_noise = np.zeros(len(self.laws))
        terms = self.problem.variables(self.level.h).terms_with(no_noise)
        solver_state = self.problem.init(terms, i, self.level.h, y)
        return jtu.tree_map(_hidden_if_result, solver_state)

    def variances(self) -> np.ndarray:
        """The variance of each variable. (All have mean zero.)"""
        return np.array(
            [np.dot(law.probabilities, np.square(law.values)) for law in self.laws]
        )


def _hidden_if_result(x: Array) -> Array:
    """Hides an integer of a solver's state from XLA behind a barrier, and returns other
    arrays as they are. The integers are the results of solves, which in a new state are
    constants. While compiling, XLA would evaluate for all states and outcomes what follows
    from these constants: for 6,300 states and 27 outcomes it took more than a second, with
    an alarm."""
    is_result = jnp.issubdtype(x.dtype, jnp.integer)
    return jax.lax.optimization_barrier(x) if is_result else x


def cuts_of(
    probabilities: Sequence[Sequence[float] | Float[np.ndarray, " outcomes"]],
) -> UInt32[np.ndarray, "n cuts"]:
    """For each variable the random words that are the cuts between its outcomes, from the
    probabilities of its outcomes."""
    cumulative = padded([np.cumsum(p) for p in probabilities])[:, :-1]
    # A variable with fewer outcomes than others has cuts at 2^32, which is no word, and the
    # largest word takes its place. (If this word is drawn, the number of the outcome is
    # past the last outcome of the variable, where `padded` has a copy of the last one.)
    largest_word = np.iinfo(np.uint32).max
    return np.minimum(np.round(cumulative * 2.0**32), largest_word).astype(np.uint32)


def padded(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Stacks the rows, with shorter rows extended by copies of their last entry."""
    most = max(map(len, rows))
    return np.stack([np.pad(row, (0, most - len(row)), mode="edge") for row in rows])


def count_outcomes(problem: Problem) -> int | None:
    """The number of outcomes of a step, or `None` if there are many or infinitely many."""
    try:
        few_outcomes = Noise.of(problem, problem.level(0)).few_outcomes
    except ValueError:
        # There are infinitely many.
        return None
    return None if few_outcomes is None else len(few_outcomes[0])
