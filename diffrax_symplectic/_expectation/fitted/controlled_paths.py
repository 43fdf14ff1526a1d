"""Paths with a control variate from value functions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Key

from ..._simulation import (
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
from .noise import Noise
from .tails import TrialLaw, UsualDeviations


class _Control(NamedTuple):
    """The control variate of a path so far.

    - `value`: the control variate.
    - `fitted_mean`: the mean of `phi` by the fitted functions, from the first step on.
    - `log_ratio`: the log likelihood ratio of the path, as from `Noise.draw`.
    """

    value: Float[Array, "S m"]
    fitted_mean: Float[Array, "S m"]
    log_ratio: Float[Array, ""]


def controlled_paths(
    problem: Problem,
    functions: FittedFunctions,
    choice: Choice,
    usual_deviations: UsualDeviations,
    law: TrialLaw,
    keys: Key[Array, " n"],
) -> Samples:
    """A sample is the value of a path minus its control variate, by `functions` with a
    leading axis of levels. Deviations beyond the usual ones are averaged apart: trials in
    which the noise has another `law` estimate them."""
    functions = functions.of_candidates(choice.best)
    starts = jax.vmap(problem.draw_start)(keys)

    def motion_on(level: Level) -> Motion:
        noise = Noise.of(problem, level)
        u = jtu.tree_map(lambda x: x[level.index], functions)
        share = law.share[level.index]
        tilts = law.tilts[level.index]

        def step(i, paths):
            second_derivatives = jtu.tree_map(lambda x: x[i], u.second_derivatives)

            def step_of_path(y, solver_state, args, key):
                x, log_ratio = noise.draw(key, i, share, tilts)
                u_after_step = lambda y1: u(i, y1)
                path_after = noise.with_args(args).advance(
                    i, y, solver_state, u_after_step, second_derivatives, x
                )
                return path_after, log_ratio

            states = paths.y, paths.solver_state, paths.args
            step_taken, log_ratio = jax.vmap(step_of_path)(*states, keys)
            # A failed path has no value, but its control must be finite.
            control_of_step = jnp.where(
                mask_like(step_taken.success, step_taken.control), step_taken.control, 0
            )
            control_so_far = paths.control
            # The control of a step is the value after it minus the mean over the step. So
            # this is the mean over the first step of the functions after it.
            fitted_mean = jnp.where(
                i == 0, step_taken.value - control_of_step, control_so_far.fitted_mean
            )
            control = _Control(
                value=control_so_far.value + jnp.where(choice.used, control_of_step, 0),
                fitted_mean=fitted_mean,
                log_ratio=control_so_far.log_ratio + log_ratio,
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
        no_control = _Control(zero, zero, jnp.zeros(len(keys), dtype))
        solver_state = jax.vmap(first_solver_state)(*starts)
        return Motion(step, PathStates.start(problem, starts, solver_state, no_control))

    simulated = simulate(problem, motion_on)
    return _samples_of(problem, choice, usual_deviations, simulated)


def _samples_of(
    problem: Problem,
    choice: Choice,
    usual_deviations: UsualDeviations,
    simulated: Simulated,
) -> Samples:
    """The samples from simulated paths, whose `control` is a `_Control`."""
    # (levels, S, n, m)
    plain = simulated.saved
    # From (levels, n, S, m) to the same.
    control = jnp.swapaxes(simulated.control.value, 1, 2).astype(plain.dtype)
    fitted_mean = jnp.swapaxes(simulated.control.fitted_mean, 1, 2).astype(plain.dtype)
    # At the start itself nothing is random, and no function is fitted.
    is_at_start = mask_like(problem.levels.saved_steps[0] == 0, plain[0])
    fitted_mean = jnp.where(is_at_start, plain, fitted_mean)
    # (combinations, S, n, m)
    value = problem.combinations(plain - control)
    plain = problem.combinations(plain)
    control = problem.combinations(control)
    fitted_mean = problem.combinations(fitted_mean)

    center = usual_deviations.center[:, :, None]
    mean = jnp.where(choice.used[:, None], fitted_mean, center)
    deviations = jnp.abs(value - mean)
    # The random variables of all levels are drawn independently, so ratios are multiplied.
    log_ratio = jnp.sum(simulated.control.log_ratio, axis=0)
    tails = usual_deviations.deviations_beyond(deviations, plain, log_ratio)
    averaged = Averaged(
        problem.unravel_samples(value),
        plain=problem.unravel_samples(plain),
        control=problem.unravel_samples(control),
        tails=problem.unravel_samples(tails),
    )
    good = ~jnp.any(simulated.failed, axis=0)
    return Samples(averaged, good, num_failed=simulated.failed)
