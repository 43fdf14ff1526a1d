"""Paths with a control variate from value functions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, Key

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
from .noise import Noise


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
    leading axis of levels, weighted by the likelihood ratio of a path that draws its noise
    by a mixture of laws."""
    functions = functions.of_candidates(choice.best)
    starts = jax.vmap(problem.draw_start)(keys)
    laws = jax.vmap(mixture.draw_law)(keys)

    def motion_on(level: Level) -> Motion:
        noise = Noise.of(problem, level)
        u = jtu.tree_map(lambda x: x[level.index], functions)
        cuts = jnp.asarray(mixture.cuts)[level.index]
        log_ratios = jnp.asarray(mixture.log_ratios)[level.index]

        def step(i, paths):
            second_derivatives = jtu.tree_map(lambda x: x[i], u.second_derivatives)

            def step_of_path(y, solver_state, args, key, law):
                x, has_outcome = noise.draw(key, i, cuts[law])
                u_after_step = lambda y1: u(i, y1)
                path_after = noise.with_args(args).advance(
                    i, y, solver_state, u_after_step, second_derivatives, x
                )
                return path_after, log_ratios_of_outcomes(log_ratios, has_outcome)

            states = paths.y, paths.solver_state, paths.args
            step_taken, log_ratios_of_step = jax.vmap(step_of_path)(*states, keys, laws)
            # A failed path has no value, but its control must be finite.
            control_of_step = jnp.where(
                mask_like(step_taken.success, step_taken.control), step_taken.control, 0
            )
            so_far = paths.control
            control = _Control(
                value=so_far.value + jnp.where(choice.used, control_of_step, 0),
                log_ratios=so_far.log_ratios + log_ratios_of_step,
            )
            return paths.after_step(
                problem,
                step_taken.y,
                step_taken.solver_state,
                step_taken.success,
                control,
            )

        def first_solver_state(y, args):
            return noise.with_args(args).new_solver_state(0, y)

        dtype = jax.eval_shape(lambda: u(0, problem.y0)).dtype
        zero = jnp.zeros((len(keys), *problem.output_shape), dtype)
        no_control = _Control(zero, jnp.zeros((len(keys), len(log_ratios)), dtype))
        solver_state = jax.vmap(first_solver_state)(*starts)
        return Motion(step, PathStates.start(problem, starts, solver_state, no_control))

    simulated = simulate(problem, motion_on)
    return _samples_of(problem, mixture, laws, simulated)


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

    # The random variables of all levels are drawn independently, so ratios are multiplied.
    weights = mixture.weights(jnp.sum(simulated.control.log_ratios, axis=0))
    # A path that fails by another law is rare by its own, of which other paths tell. It
    # counts as one without a deviation.
    has_failed = jnp.any(simulated.failed, axis=0)
    has_own_law = laws == 0
    weights = jnp.where(has_failed, 0, weights).astype(plain.dtype)
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
    """Values of which the mean is that of the weighted ones. The values of paths without
    weight, which may have failed, do not matter."""
    weights = weights[:, None]
    shares = weights / jnp.sum(weights)
    weighted = jnp.where(shares > 0, shares * value, 0)
    mean_of_others = (jnp.sum(weighted, axis=1, keepdims=True) - weighted) / (
        1 - shares
    )
    mean_of_others = jnp.where(shares < 1, mean_of_others, 0)
    # The mean of a weight is one, and independent of the other paths. So only deviations
    # from their mean are weighted, which vary less.
    deviations = jnp.where(weights > 0, weights * (value - mean_of_others), 0)
    return mean_of_others + deviations
