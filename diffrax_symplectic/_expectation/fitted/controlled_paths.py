"""Paths with a control variate from value functions."""

import functools as ft
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, PyTree

from ..._custom_types import Args, Y
from ..._simulation import (
    as_vectors,
    combinations,
    Level,
    mask_like,
    Motion,
    PathStates,
    Problem,
    simulate,
    Simulated,
)
from ..sampling import Averaged, Samples
from .fits import Choice, FittedFunctions
from .mixture import log_ratios_of_outcomes, Mixture
from .noise import Noise, StepOfPath


class _Control(NamedTuple):
    """The control variate of a path so far.

    - `value`: the control variate.
    - `log_ratios`: the logarithm of the probability of the path's noise by each law of a
        `Mixture`, divided by that by its own law.
    """

    value: Float[Array, "S m"]
    log_ratios: Float[Array, " laws"]


def controlled_paths(
    problem: Problem,
    functions: FittedFunctions,
    choice: Choice,
    mixture: Mixture,
    keys: Key[Array, " n"],
) -> Samples:
    """A sample is the value of a path minus its control variate, by `functions` with a
    leading axis of levels. It is weighted by the likelihood ratio of the path, since paths
    draw their noise by the laws of the `mixture`, not all by their own."""
    functions = functions.of_candidates(choice.best)
    starts = jax.vmap(problem.draw_start)(keys)
    laws = jax.vmap(mixture.draw_law)(keys)

    def motion_on(level: Level) -> Motion:
        of_level = _Level(
            noise=Noise.of(problem, level),
            value_functions=jtu.tree_map(lambda x: x[level.index], functions),
            cuts_of_laws=jnp.asarray(mixture.cuts)[level.index],
            log_ratios=jnp.asarray(mixture.log_ratios)[level.index],
        )

        def step(i: Any, paths: PathStates) -> PathStates:
            states = paths.y, paths.solver_state, paths.args
            advance = ft.partial(of_level.advance, i)
            after_step, log_ratios = jax.vmap(advance)(*states, keys, laws)
            # A failed path has no value, but its control must be finite.
            control_of_step = jnp.where(
                mask_like(after_step.success, after_step.control), after_step.control, 0
            )
            so_far = paths.control
            control = _Control(
                value=so_far.value + jnp.where(choice.used, control_of_step, 0),
                log_ratios=so_far.log_ratios + log_ratios,
            )
            return paths.after_step(
                problem,
                after_step.y,
                after_step.solver_state,
                after_step.success,
                control,
            )

        def first_solver_state(y: Y, args: Args) -> PyTree[Array]:
            return of_level.noise.with_args(args).new_solver_state(0, y)

        dtype = jax.eval_shape(lambda: of_level.value_functions(0, problem.y0)).dtype
        num_laws = len(of_level.log_ratios)
        no_control = _Control(
            value=jnp.zeros((len(keys), *problem.output_shape), dtype),
            log_ratios=jnp.zeros((len(keys), num_laws), dtype),
        )
        solver_state = jax.vmap(first_solver_state)(*starts)
        return Motion(step, PathStates.start(problem, starts, solver_state, no_control))

    simulated = simulate(problem, motion_on)
    return _samples_of(problem, mixture, laws, simulated)


class _Level(NamedTuple):
    """What the paths on a level need.

    - `noise`, `value_functions`: those of the level.
    - `cuts_of_laws`, `log_ratios`: the fields of a `Mixture`, for this level.
    """

    noise: Noise
    value_functions: FittedFunctions
    cuts_of_laws: Array
    log_ratios: Array

    def advance(
        self,
        i: Any,
        y: Y,
        solver_state: PyTree[Array],
        args: Args,
        key: PRNGKeyArray,
        law: Int[Array, ""],
    ) -> tuple[StepOfPath, Float[Array, " laws"]]:
        """A path after step `i`, with noise by this law; and the logarithms of the
        likelihood ratios of this noise."""
        functions = self.value_functions
        second_derivatives = jtu.tree_map(lambda x: x[i], functions.second_derivatives)
        variables, has_outcome = self.noise.draw(key, i, self.cuts_of_laws[law])
        path_after_step = self.noise.with_args(args).advance(
            i,
            y,
            solver_state,
            ft.partial(functions, i),
            second_derivatives,
            variables,
        )
        return path_after_step, log_ratios_of_outcomes(self.log_ratios, has_outcome)


def _samples_of(
    problem: Problem,
    mixture: Mixture,
    laws: Int[Array, " n"],
    simulated: Simulated,
) -> Samples:
    """The samples from simulated paths, which drew their noise by `laws` of the mixture,
    and whose `control` is a `_Control`."""
    # (levels, n, numbers)
    plain = as_vectors(simulated.saved)
    control = simulated.control.value.reshape(plain.shape).astype(plain.dtype)
    # (combinations, n, numbers)
    value = combinations(problem.weights, plain - control)
    plain = combinations(problem.weights, plain)

    # The levels draw their random variables independently, so that their likelihood ratios
    # are multiplied.
    ratios = mixture.weights(jnp.sum(simulated.control.log_ratios, axis=0))
    # A failed path has the weight zero, and then the mean of the others for a value. If it
    # drew by another law than its own (number 0), it still counts as a good sample: such
    # paths are rare by their own law, by which other paths show how many fail.
    has_failed = jnp.any(simulated.failed, axis=0)
    has_own_law = laws == 0
    weights = jnp.where(has_failed, 0, ratios).astype(plain.dtype)
    value = _weighted(weights, value)
    plain = _weighted(weights, plain)
    return Samples(
        Averaged(value, plain=plain, control=plain - value),
        good=~(has_failed & has_own_law),
        num_failed=simulated.failed & has_own_law,
        also_failed=has_failed & ~has_own_law,
    )


def _weighted(
    weights: Float[Array, " n"], value: Float[Array, "combinations n numbers"]
) -> Float[Array, "combinations n numbers"]:
    """For each path `m + w (x - m)`, with its weight `w`, its value `x` and the weighted
    mean `m` of the other paths: the expectation is that of `w x`, since `w` has the mean
    one and is independent of `m`; but it varies less. Where `w` is zero, `x` does not
    matter, and need not be finite."""
    # (n, 1)
    column = weights[:, None]
    shares = column / jnp.sum(column)
    parts = jnp.where(shares > 0, shares * value, 0)
    sum_of_others = jnp.sum(parts, axis=1, keepdims=True) - parts
    # A single path with all of the weight has no others.
    mean_of_others = jnp.where(shares < 1, sum_of_others / (1 - shares), 0)
    deviations = jnp.where(column > 0, column * (value - mean_of_others), 0)
    return mean_of_others + deviations
