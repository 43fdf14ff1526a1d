"""The samples of `ValueFunctions`: paths with a control variate from value functions,
weighted by likelihood ratios."""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

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
from .fits import FittedFunctions
from .mixture import log_ratios_of_outcomes, Mixture
from .noise import Noise


def controlled_paths(
    problem: Problem,
    functions: FittedFunctions,
    is_used: Bool[Array, "S m"],
    mixture: Mixture,
    keys: Key[Array, " n"],
) -> Samples:
    """Takes one sample for each key: the value of a path minus its control variate,
    weighted by the likelihood ratio of the path.

    - `functions`: the value functions, with a leading axis of levels.
    - `is_used`: for which times and components the control variate is used.
    - `mixture`: the laws by which paths draw their noise. Law number 0 is the noise's own.
    """
    starts = jax.vmap(problem.draw_start)(keys)
    laws = jax.vmap(mixture.draw_law)(keys)

    def motion_on(level: Level) -> Motion:
        noise = Noise.of(problem, level)
        value_functions = jtu.tree_map(lambda x: x[level.index], functions)
        cuts = jnp.asarray(mixture.cuts)[level.index]
        log_ratios_of_laws = jnp.asarray(mixture.log_ratios)[level.index]

        def step_of_path(i, y, solver_state, args, key, law):
            """Step `i` of a path that draws by the law with this number. The last two
            results are for this step alone: its control variate, and for each law the
            logarithm of a likelihood ratio, as from `log_ratios_of_outcomes`."""
            x, has_outcome = noise.draw(key, i, cuts[law])
            # `None` if there are few outcomes.
            second_derivatives = jtu.tree_map(
                lambda of_steps: of_steps[i], value_functions.second_derivatives
            )
            y, solver_state, success, control = noise.with_args(args).advance(
                i,
                y,
                solver_state,
                ft.partial(value_functions, i),
                second_derivatives,
                x,
            )
            log_ratios = log_ratios_of_outcomes(log_ratios_of_laws, has_outcome)
            return y, solver_state, success, control, log_ratios

        def step(i: Any, paths: PathStates) -> PathStates:
            y, solver_state, success, control_of_step, log_ratios_of_step = jax.vmap(
                ft.partial(step_of_path, i)
            )(paths.y, paths.solver_state, paths.args, keys, laws)
            control, log_ratios = paths.control
            # The control variate of a failed path is not used, but must be finite.
            has_control = mask_like(success, control_of_step) & is_used
            control += jnp.where(has_control, control_of_step, 0)
            log_ratios += log_ratios_of_step
            return paths.after_step(
                problem, y, solver_state, success, (control, log_ratios)
            )

        def first_solver_state(y: Y, args: Args) -> PyTree[Array]:
            return noise.with_args(args).new_solver_state(0, y)

        dtype = jax.eval_shape(lambda: value_functions(0, problem.y0)).dtype
        # What a path sums up over its steps: control variates, and for each law logarithms
        # of likelihood ratios.
        start_of_control = (
            jnp.zeros((len(keys), *problem.output_shape), dtype),
            jnp.zeros((len(keys), len(log_ratios_of_laws)), dtype),
        )
        solver_state = jax.vmap(first_solver_state)(*starts)
        start = PathStates.start(problem, starts, solver_state, start_of_control)
        return Motion(step, start)

    return _weighted_samples(problem, mixture, laws, simulate(problem, motion_on))


def _weighted_samples(
    problem: Problem, mixture: Mixture, laws: Int[Array, " n"], simulated: Simulated
) -> Samples:
    """The samples from simulated paths, which drew by the laws with these numbers."""
    control, log_ratios = simulated.control
    # (levels, n, numbers)
    plain = as_vectors(simulated.saved)
    control = control.reshape(plain.shape).astype(plain.dtype)
    # Levels draw their random variables independently, so the likelihood ratio of a path on
    # all levels is the product over levels.
    ratios = mixture.weights(jnp.sum(log_ratios, axis=0))
    # A failed path has weight zero, so `_weighted` gives it the mean of the others. If it
    # drew by another law than the own one, it still counts as a good sample: such paths are
    # rare by the own law, and the paths that draw by the own law show how many fail.
    has_failed = jnp.any(simulated.failed, axis=0)
    has_own_law = laws == 0
    weights = jnp.where(has_failed, 0, ratios).astype(plain.dtype)
    # (combinations, n, numbers)
    value = _weighted(weights, combinations(problem.weights, plain - control))
    plain = _weighted(weights, combinations(problem.weights, plain))
    return Samples(
        Averaged(value, plain=plain, control=plain - value),
        good=~(has_failed & has_own_law),
        num_failed=simulated.failed & has_own_law,
        also_failed=has_failed & ~has_own_law,
    )


def _weighted(
    weights: Float[Array, " n"], value: Float[Array, "combinations n numbers"]
) -> Float[Array, "combinations n numbers"]:
    """For each path `m + w (x - m)`, with its weight `w`, its value `x`, and the weighted
    mean `m` of the values of the other paths. The expectation is that of `w x`, since `w`
    has mean one and is independent of `m`, but the variance is smaller. Where `w` is zero,
    `x` does not matter, and need not be finite."""
    # (n, 1)
    column = weights[:, None]
    shares = column / jnp.sum(column)
    parts = jnp.where(shares > 0, shares * value, 0)
    sum_of_others = jnp.sum(parts, axis=1, keepdims=True) - parts
    # A single path with all of the weight has no others.
    mean_of_others = jnp.where(shares < 1, sum_of_others / (1 - shares), 0)
    deviations = jnp.where(column > 0, column * (value - mean_of_others), 0)
    return mean_of_others + deviations
