"""The samples of `ValueFunctions`: paths with a control variate from value functions,
weighted by likelihood ratios."""

import functools as ft
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree, UInt32

from ..._custom_types import Args, Y
from ..._products import tensordot
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


class _Sums(NamedTuple):
    """What paths sum up over their steps.

    - `control`: the control variates of the steps.
    - `log_ratios`: for each law of the mixture, the logarithm of the probability of the
        noise by the law divided by the probability by the noise's own law.
    """

    control: Float[Array, "n S m"]
    log_ratios: Float[Array, "n laws"]


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
    - `mixture`: the laws by which paths draw their noise.
    """
    starts = jax.vmap(problem.draw_start)(keys)
    # A path draws by the law with this number on all levels.
    laws = jax.vmap(mixture.draw_law)(keys)

    def motion_on(level: Level) -> Motion:
        steps = _StepsOfLevel(
            Noise.of(problem, level),
            jtu.tree_map(lambda x: x[level.index], functions),
            cuts=jnp.asarray(mixture.cuts)[level.index],
            log_ratios=jnp.asarray(mixture.log_ratios)[level.index],
        )

        def step(i: Any, paths: PathStates) -> PathStates:
            end = jax.vmap(ft.partial(steps.step_of_path, i))(
                paths.y, paths.solver_state, paths.args, keys, laws
            )
            sums: _Sums = paths.control
            # The control variate of a failed path is not used, but must be finite.
            has_control = mask_like(end.success, end.control) & is_used
            sums = _Sums(
                control=sums.control + jnp.where(has_control, end.control, 0),
                log_ratios=sums.log_ratios + end.log_ratios,
            )
            return paths.after_step(problem, end.y, end.solver_state, end.success, sums)

        no_sums = steps.no_sums(len(keys))
        solver_state = jax.vmap(steps.first_solver_state)(*starts)
        start = PathStates.start(problem, starts, solver_state, control=no_sums)
        return Motion(step, start)

    return _weighted_samples(problem, mixture, laws, simulate(problem, motion_on))


class _ControlledStep(NamedTuple):
    """The end of a step of a path.

    - `y`, `solver_state`: the states of the equation and of the solver.
    - `success`: whether the step succeeded.
    - `control`, `log_ratios`: what the step adds to the `_Sums` of the path.
    """

    y: Y
    solver_state: PyTree[Array]
    success: Bool[Array, ""]
    control: Float[Array, "S m"]
    log_ratios: Float[Array, " laws"]


class _StepsOfLevel(NamedTuple):
    r"""The steps of single paths on one level, with control variates. For the value
    functions $u$ after a step and the state $y_1$ at its end, the control variate is

    - $u(y_1) - \mathbb E[u(y_1)]$, if a step has few outcomes;
    - otherwise $a \cdot x + \frac12 (x^\top C x - \mathrm{tr}\, C \Sigma)$, with the first
        and second derivatives $a$ and $C$ of $u(y_1(x))$ at $x = 0$, and the variances
        $\Sigma$ of the random variables $x$. This is the same for a quadratic $u$ and noise
        that enters the step linearly. Its mean is zero for any $a$ and $C$, so one $C$,
        averaged over states, serves all paths.

    The fields are `functions`, the value functions of the level, and the `cuts` and
    `log_ratios` of the `Mixture` on the level.
    """

    noise: Noise
    functions: FittedFunctions
    cuts: UInt32[Array, "laws variables cuts"]
    log_ratios: Float[Array, "laws variables outcomes"]

    def first_solver_state(self, y: Y, args: Args) -> PyTree[Array]:
        """The state of the solver before the first step of a path."""
        return self.noise.with_args(args).new_solver_state(0, y)

    def no_sums(self, num_paths: int) -> _Sums:
        """The sums of so many paths before their first step."""
        y0 = self.noise.problem.y0
        control = jax.eval_shape(lambda: self.functions(0, y0))
        return _Sums(
            control=jnp.zeros((num_paths, *control.shape), control.dtype),
            log_ratios=jnp.zeros((num_paths, len(self.log_ratios)), control.dtype),
        )

    def step_of_path(
        self,
        i: Any,
        y: Y,
        solver_state: PyTree[Array],
        args: Args,
        key: PRNGKeyArray,
        law: Int[Array, ""],
    ) -> _ControlledStep:
        """Takes step `i` of a path that draws by the law with this number."""
        noise = self.noise.with_args(args)
        x, has_outcome = noise.draw(key, i, self.cuts[law])
        u = ft.partial(self.functions, i)
        if noise.few_outcomes is not None:
            all_outcomes, probabilities = noise.few_outcomes
            step_by_outcome = jax.vmap(ft.partial(noise.step, i, y, solver_state))
            ends, solver_states, successes = step_by_outcome(all_outcomes)
            values = jax.vmap(u)(ends)
            mean = tensordot(probabilities.astype(values.dtype), values, 1)
            # The path itself takes the step whose outcome is equal to `x`.
            index_of_x = jnp.argmax(jnp.all(all_outcomes == x, axis=1))
            y1, next_solver_state, value = jtu.tree_map(
                lambda of_outcomes: of_outcomes[index_of_x],
                (ends, solver_states, values),
            )
            # If one of these steps fails, the mean is wrong, and so is the control variate.
            success = jnp.all(successes)
            control = value - mean
        else:
            assert self.functions.second_derivatives is not None
            C = self.functions.second_derivatives[i]
            y1, next_solver_state, success = noise.step(i, y, solver_state, x)
            value_after = ft.partial(noise.value_after, i, y, solver_state, u)
            a = jax.jacrev(value_after)(jnp.zeros_like(x))
            # Multiplied by `C` entry by entry, and summed over all entries, this is
            # `x^T C x - tr(C Sigma)`.
            centred_square = jnp.outer(x, x) - np.diag(noise.variances()).astype(
                x.dtype
            )
            control = tensordot(a, x, 1) + tensordot(centred_square, C, 2) / 2
        log_ratios = log_ratios_of_outcomes(self.log_ratios, has_outcome)
        return _ControlledStep(y1, next_solver_state, success, control, log_ratios)


def _weighted_samples(
    problem: Problem, mixture: Mixture, laws: Int[Array, " n"], simulated: Simulated
) -> Samples:
    """The samples from simulated paths, which drew by the laws with these numbers."""
    sums: _Sums = simulated.control
    # (levels, n, numbers)
    plain = as_vectors(simulated.saved)
    control = sums.control.reshape(plain.shape).astype(plain.dtype)
    # Levels draw their random variables independently, so the likelihood ratio of a path on
    # all levels is the product over levels.
    ratios = mixture.weights(jnp.sum(sums.log_ratios, axis=0))
    # A failed path has weight zero, so `_weighted` gives it the mean of the others. If it
    # drew by another law than the noise's own, which has number 0, it still counts as a
    # good sample: such paths are rare by the own law, and the paths that draw by the own
    # law show how many fail.
    has_failed = jnp.any(simulated.failed, axis=0)
    has_own_law = laws == 0
    weights = jnp.where(has_failed, 0, ratios).astype(plain.dtype)
    # (combinations, n, numbers)
    value = _weighted(weights, combinations(problem.weights, plain - control))
    plain_value = _weighted(weights, combinations(problem.weights, plain))
    return Samples(
        Averaged(value, plain=plain_value, control=plain_value - value),
        good=~(has_failed & has_own_law),
        num_failed=simulated.failed & has_own_law,
        also_failed=has_failed & ~has_own_law,
    )


def _weighted(
    weights: Float[Array, " n"], value: Float[Array, "combinations n numbers"]
) -> Float[Array, "combinations n numbers"]:
    """Weights values with less variance than by a product: for a path with the weight `w`
    and the value `x` the result is `m + w (x - m)`, where `m` is the weighted mean of the
    values of the other paths. The expectation is that of `w x`, since `w` has mean one and
    is independent of `m`. Where `w` is zero, `x` does not matter, and need not be finite.
    """
    # (n, 1)
    column = weights[:, None]
    # The part of each path in the sum of all weights.
    shares = column / jnp.sum(column)
    parts = jnp.where(shares > 0, shares * value, 0)
    sum_of_others = jnp.sum(parts, axis=1, keepdims=True) - parts
    # A single path with all of the weight has no others.
    mean_of_others = jnp.where(shares < 1, sum_of_others / (1 - shares), 0)
    deviations = jnp.where(column > 0, column * (value - mean_of_others), 0)
    return mean_of_others + deviations
