"""Value functions, fitted backward in time at the states of a pilot run: a simulation of
some paths, whose states show where the functions are needed."""

import dataclasses
import functools as ft
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from ..._custom_types import Y
from ..._lapack import lapack_in_turn
from ..._programs import compiled
from ..._simulation import PathStates, Problem, ravel
from .bases import AbstractBasis, equal_weights, Target
from .noise import cuts_of, Noise


# The number of states over which second derivatives along the noise are averaged. Few are
# enough: whatever the second derivatives are, the control variate has mean zero.
_STATES_FOR_SECOND = 32


class FittedFunctions(eqx.Module):
    """The value functions of a level: after each step one function for each time at which
    to average (`S`) and each component of `phi` (`m`). For several levels all arrays have
    another leading axis.

    - `frames`: the coordinates of the basis after each step, with a leading axis of steps.
    - `coefficients`: the coefficients of the `size` functions of the basis, of shape
        `(steps, size, S, m)`.
    - `second_derivatives`: the mean second derivatives along the random variables of each
        step, from `Noise.mean_second_derivatives`, of shape `(steps, n, n, S, m)`; `None`
        if a step has few outcomes.
    """

    frames: PyTree[Array]
    coefficients: Float[Array, "..."]
    second_derivatives: Float[Array, "..."] | None
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i: Any, y: Y) -> Float[Array, "S m"]:
        """The values of the functions after step `i` at a state."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.value_at(frame, ravel(y), self.coefficients[i])


class _Pilot(NamedTuple):
    """The paths of a pilot run.

    - `starts`: the states at the start.
    - `states_after`: the states after each step.
    - `good`: which paths did not fail.
    """

    starts: Float[Array, "paths d"]
    states_after: Float[Array, "steps paths d"]
    good: Bool[Array, " paths"]


def room_for_steps(problem: Problem) -> int:
    """The number of steps for which the arrays of a fit have room on each level. (The
    number of steps itself is traced, but shapes must be known when compiling.)"""
    # With two levels a trial may fit functions once more, with all steps halved.
    most = problem.finest_steps * (2 if len(problem.levels.h) == 2 else 1)
    # Powers of two, so that most other numbers of steps compile nothing anew.
    return 1 << (most - 1).bit_length()


@ft.partial(compiled, quickly=True)
@lapack_in_turn
def fit(
    problem: Problem,
    index: Int[Array, ""],
    key: PRNGKeyArray,
    basis: AbstractBasis,
    most_steps: int,
) -> tuple[FittedFunctions, Int[Array, ""]]:
    """Fits the value functions of the level with this index. Returns the functions, with a
    leading axis of one level, and the number of the pilot's paths that failed. All levels
    share a program, since each has arrays for `most_steps` steps."""
    noise = Noise.of(problem, problem.level(index))
    num_steps = noise.level.num_steps
    keys = jr.split(jr.fold_in(key, index), basis.num_pilots)
    # 1. A simulation of some paths, the pilot, gives states at which to fit.
    pilot = _run_pilot(noise, keys, most_steps)
    scales = _length_scales(noise, pilot)

    def frame_after(i: Any) -> PyTree[Array]:
        return basis.frame(pilot.states_after[i], pilot.good, scales)

    def fit_step(num_fitted: Any, fitted: FittedFunctions) -> FittedFunctions:
        """Fits the functions after step `i`, counted from the last step backward."""
        i = num_steps - 1 - num_fitted
        frame = frame_after(i)
        target = _target(noise, fitted, i)
        # All steps share the keys of the pilot's paths. Their draws are independent, since
        # the target also takes the number of the step to draw.
        coefficients = basis.coefficients(
            target, frame, pilot.states_after[i], pilot.good, keys
        )
        fitted_after_i = FittedFunctions(frame, coefficients, None, basis)
        return jtu.tree_map(
            lambda all_steps, this: all_steps.at[i].set(this), fitted, fitted_after_i
        )

    # 2. A loop backward in time fits the functions after each step to the mean of those
    # after the next one.
    no_frames = jtu.tree_map(
        lambda x: jnp.zeros((most_steps, *x.shape), x.dtype),
        jax.eval_shape(frame_after, 0),
    )
    no_coefficients = jnp.zeros(
        (most_steps, basis.size, *problem.output_shape), problem.dtype
    )
    unfitted = FittedFunctions(no_frames, no_coefficients, None, basis)
    fitted = lax.fori_loop(0, num_steps, fit_step, unfitted)

    # 3. No fit reads second derivatives, so they are computed once, at the end. The states
    # before a step are those after the previous step: (steps, paths, d).
    states_before = jnp.concatenate([pilot.starts[None], pilot.states_after[:-1]])
    _, unravel = jfu.ravel_pytree(problem.y0)

    def second_derivatives_of_step(step_and_states):
        i, states = step_and_states
        ys = jax.vmap(unravel)(states)
        return noise.mean_second_derivatives(i, ys, ft.partial(fitted, i))

    second_derivatives = lax.map(
        second_derivatives_of_step,
        (jnp.arange(most_steps), states_before[:, :_STATES_FOR_SECOND]),
    )
    functions = dataclasses.replace(fitted, second_derivatives=second_derivatives)
    return jtu.tree_map(lambda x: x[None], functions), jnp.sum(~pilot.good)


def _run_pilot(noise: Noise, keys: Key[Array, " paths"], most_steps: int) -> _Pilot:
    """Simulates a path for each key."""
    problem = noise.problem
    # With equal probabilities of all outcomes the pilot's paths spread further than others,
    # so that the fit also holds for outliers.
    num_values = [len(law.values) for law in noise.laws]
    equal_cuts = cuts_of([np.full(count, 1 / count) for count in num_values])

    def step_of_path(i, y, args, key):
        x, _ = noise.draw(key, i, equal_cuts)
        noise_of_path = noise.with_args(args)
        # Solvers start anew in each step, which is good enough for a fit.
        solver_state = noise_of_path.new_solver_state(i, y)
        y, _, success = noise_of_path.step(i, y, solver_state, x)
        return y, success

    def step(i: Any, carry: tuple[PathStates, Array]) -> tuple[PathStates, Array]:
        paths, states = carry
        y, success = jax.vmap(ft.partial(step_of_path, i))(paths.y, paths.args, keys)
        paths = paths.after_step(problem, y, None, success)
        return paths, states.at[i].set(jax.vmap(ravel)(paths.y))

    paths = PathStates.start(
        problem, jax.vmap(problem.draw_start)(keys), solver_state=None
    )
    starts = jax.vmap(ravel)(paths.y)
    states = jnp.broadcast_to(starts, (most_steps, *starts.shape))
    paths, states = lax.fori_loop(0, noise.level.num_steps, step, (paths, states))
    return _Pilot(starts, states, ~paths.failed)


def _length_scales(noise: Noise, pilot: _Pilot) -> Float[Array, " d"]:
    """How far each component of the state moves: the root of the mean squared distance from
    the start, over all steps of the good paths of the pilot run. It is zero for components
    that do not move."""
    start = ravel(noise.problem.y0)
    if noise.problem.y0_of is not None:
        start = jnp.mean(pilot.starts, axis=0)
    # (steps, paths, d)
    distances = jnp.where(pilot.good[:, None], jnp.abs(pilot.states_after - start), 0)
    # Dividing by the largest value first avoids underflow of squares in single precision.
    largest = jnp.max(distances, axis=(0, 1))
    scaled = distances / jnp.where(largest > 0, largest, 1)
    weights = equal_weights(pilot.good, start.dtype)
    # Means over the paths `n` of the squares, summed over the steps `i`.
    sum_over_steps = jnp.einsum("n,ind->d", weights, scaled**2)
    return largest * jnp.sqrt(sum_over_steps / noise.level.num_steps)


def _target(noise: Noise, fitted: FittedFunctions, i: Any) -> Target:
    """The function of a flat state to which the functions after step `i` are fitted. Its
    value depends on the time at which to average:

    - At the end of step `i` it is `phi` itself.
    - At a later time it is the mean, over the outcomes of the next step, of the functions
        after the next step, which are already fitted.
    - At an earlier time it is zero.

    If a step has many outcomes, the target may also be called with a random key, and then
    estimates the mean from a draw."""
    problem = noise.problem
    level = noise.level
    _, unravel = jfu.ravel_pytree(problem.y0)
    # There is no step after the last one. The mean is then taken over the last step once
    # more, and not used: no time at which to average is later.
    next_step = jnp.minimum(i + 1, level.num_steps - 1)

    def value(flat_y: Float[Array, " d"], key: PRNGKeyArray | None = None) -> Array:
        y = unravel(flat_y)
        variables = None
        if key is not None:
            # The pilot draws its steps by the same keys, with smaller numbers: those of the
            # steps for which the arrays have room.
            draw_index = len(fitted.coefficients) + i
            cuts = cuts_of([law.probabilities for law in noise.laws])
            variables, _ = noise.draw(key, draw_index, cuts)
        # (S, m)
        mean = noise.mean(next_step, y, ft.partial(fitted, next_step), variables)
        # (m)
        phi = problem.values(problem.t0 + (i + 1) * level.h, y).astype(mean.dtype)
        # For each time at which to average.
        is_end_of_step = level.saved_steps == i + 1
        is_later = level.saved_steps > i + 1
        mean_or_zero = jnp.where(is_later[:, None], mean, 0)
        return jnp.where(is_end_of_step[:, None], phi, mean_or_zero)

    return value
