"""Target functions, fitted backwards in time at the states of a pilot run."""

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
from ..._simulation import PathStates, Problem, ravel
from .bases import AbstractBasis, equal_weights, Target
from .noise import cuts_by, cuts_of, Noise


# The number of states over which second derivatives along the noise are averaged. A rough
# mean will do: with any number in place of it, the control variate has mean zero.
_STATES_FOR_SECOND = 32


class Choice(NamedTuple):
    """What is used for each time at which to average and each component of `phi`.

    - `best`: the number of the best candidate.
    - `used`: whether its control variate is used, or none.
    """

    best: Int[Array | np.ndarray, "S m"]
    used: Bool[Array | np.ndarray, "S m"]

    @staticmethod
    def of_all(candidate: int, output_shape: tuple[int, int]) -> "Choice":
        """The same candidate for all."""
        best = np.full(output_shape, candidate)
        return Choice(best, np.ones(output_shape, bool))


class FittedFunctions(eqx.Module):
    """The value functions of a level, one after each step, for each time at which to
    average (`S`) and each component of `phi` (`m`); and for each candidate (`C`), until one
    is chosen. For several levels there is another leading axis.

    - `frames`: the coordinates of the basis, with a leading axis of steps.
    - `coefficients`: the coefficients of the `size` functions of the basis, with axes for
        steps, `size`, `C`, `S` and `m`.
    - `second_derivatives`: those along the noise, from `Noise.mean_second_derivatives`,
        with axes for steps, twice the random variables, `C`, `S` and `m`; `None` if there
        are few outcomes.
    """

    frames: PyTree[Array]
    coefficients: Float[Array, "..."]
    second_derivatives: Float[Array, "..."] | None
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i: Any, y: Y) -> Float[Array, "*C S m"]:
        """Their values at a state after step `i`."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.value_at(frame, ravel(y), self.coefficients[i])

    def of_candidates(self, best: Int[Array | np.ndarray, "S m"]) -> "FittedFunctions":
        """The functions of these candidates, one for each time and component."""

        def take(x: Float[Array, "... C S m"]) -> Float[Array, "... S m"]:
            index = best.reshape(*[1] * (x.ndim - 2), *best.shape)
            return jnp.take_along_axis(x, index, -3).squeeze(-3)

        return FittedFunctions(
            frames=self.frames,
            coefficients=take(self.coefficients),
            # `None` has no leaves.
            second_derivatives=jtu.tree_map(take, self.second_derivatives),
            basis=self.basis,
        )


def fit(
    noise: Noise, key: PRNGKeyArray, basis: AbstractBasis
) -> tuple[FittedFunctions, Int[Array, ""]]:
    """The functions of a level, by a pilot run forward in time and fits backward; and how
    many of the pilot's paths failed."""
    problem = noise.problem
    num_steps = noise.level.num_steps
    pilot = _run_pilot(noise, jr.split(key, basis.num_pilots))
    scales = _scales(problem, pilot, num_steps)

    def frame_after(i: Any) -> PyTree[Array]:
        return basis.frame(pilot.states[i], pilot.good, scales)

    def fit_step(num_fitted: Any, fitted: FittedFunctions) -> FittedFunctions:
        # The functions after later steps come first: those after a step are fitted to them.
        i = num_steps - 1 - num_fitted
        frame = frame_after(i)
        target = _target(noise, fitted, i)
        coefficients = basis.coefficients(
            target, frame, pilot.states[i], pilot.good, pilot.keys
        )
        put_step = lambda of_steps, of_step: of_steps.at[i].set(of_step)
        return FittedFunctions(
            frames=jtu.tree_map(put_step, fitted.frames, frame),
            coefficients=put_step(fitted.coefficients, coefficients),
            second_derivatives=None,
            basis=basis,
        )

    # All levels have arrays for the same number of steps, so that they share a program.
    def zeros_for_all_steps(of_step: jax.ShapeDtypeStruct) -> Array:
        return jnp.zeros((problem.most_steps, *of_step.shape), of_step.dtype)

    shape = (basis.size, len(basis.candidates), *problem.output_shape)
    struct_of_frame = jax.eval_shape(lambda: frame_after(0))
    struct_of_coefficients = jax.ShapeDtypeStruct(shape, problem.dtype)
    unfitted = FittedFunctions(
        frames=jtu.tree_map(zeros_for_all_steps, struct_of_frame),
        coefficients=zeros_for_all_steps(struct_of_coefficients),
        second_derivatives=None,
        basis=basis,
    )
    fitted = lax.fori_loop(0, num_steps, fit_step, unfitted)
    # No fit reads second derivatives, so they are computed once, at the end.
    functions = FittedFunctions(
        frames=fitted.frames,
        coefficients=fitted.coefficients,
        second_derivatives=_second_derivatives(noise, pilot, fitted),
        basis=basis,
    )
    num_failed = jnp.sum(~pilot.good)
    return functions, num_failed


def _target(noise: Noise, fitted: FittedFunctions, i: Any) -> Target:
    """What the functions after step `i` are fitted to, as a function of a flat state and
    maybe a random key. For averages at the end of this step that is `phi` itself; for later
    times the mean, over the outcomes of the next step, of the functions after that one,
    which are already fitted; and for earlier times zero. If a step has many outcomes, a key
    serves to estimate the mean from a draw."""
    problem = noise.problem
    level = noise.level
    _, unravel = jfu.ravel_pytree(problem.y0)
    # There is no step after the last one. The mean is then computed over the last step
    # itself, and not used: no time at which to average is later.
    next_step = jnp.minimum(i + 1, level.num_steps - 1)

    def value(flat_y: Float[Array, " d"], key: PRNGKeyArray | None = None) -> Array:
        y = unravel(flat_y)
        variables = None
        if key is not None:
            # Draws by one key are numbered. The pilot's own steps have the numbers below
            # `most_steps`.
            number = problem.most_steps + i
            variables, _ = noise.draw(key, number, cuts_of(noise.laws))
        # (C, S, m), and `phi` (m).
        mean = noise.mean(next_step, y, ft.partial(fitted, next_step), variables)
        phi = problem.values(problem.t0 + (i + 1) * level.h, y).astype(mean.dtype)
        # Which of the times at which to average are the end of this step, or later.
        is_end_of_step = level.saved_steps == i + 1
        is_later = level.saved_steps > i + 1
        mean_or_zero = jnp.where(is_later[:, None], mean, 0)
        return jnp.where(is_end_of_step[:, None], phi, mean_or_zero)

    return value


def _second_derivatives(
    noise: Noise, pilot: "_Pilot", fitted: FittedFunctions
) -> Float[Array, "steps n n C S m"] | None:
    """Second derivatives of the functions after each step along its noise, averaged over
    some of the pilot's states before the step; `None` if they are not needed."""
    _, unravel = jfu.ravel_pytree(noise.problem.y0)

    def mean_of_step(step_and_states):
        i, states = step_and_states
        value_after_step = lambda y1: fitted(i, y1)
        return noise.mean_second_derivatives(
            i, jax.vmap(unravel)(states), value_after_step
        )

    # The states before each step are those after the step before: (steps, paths, d).
    states_before = jnp.concatenate([pilot.starts[None], pilot.states[:-1]])
    few_states = states_before[:, :_STATES_FOR_SECOND]
    steps = jnp.arange(noise.problem.most_steps)
    return lax.map(mean_of_step, (steps, few_states))


class _Pilot(NamedTuple):
    """Paths at whose states functions are fitted.

    - `keys`: their random keys.
    - `starts`: their states at the start.
    - `states`: their states after each step.
    - `good`: which of them did not fail.
    """

    keys: Key[Array, " paths"]
    starts: Float[Array, "paths d"]
    states: Float[Array, "steps paths d"]
    good: Bool[Array, " paths"]


def _run_pilot(noise: Noise, keys: Key[Array, " paths"]) -> _Pilot:
    """Simulates a path for each key."""
    problem = noise.problem
    # With equal probabilities of all outcomes the pilot's paths spread further than others,
    # so that the fit also holds for outliers.
    equal_cuts = cuts_by(
        [np.full_like(x.values, 1 / len(x.values)) for x in noise.laws]
    )

    def step_one(
        i: Any, y: Y, args: PyTree[Array], key: PRNGKeyArray
    ) -> tuple[Y, Bool[Array, ""]]:
        x, _ = noise.draw(key, i, equal_cuts)
        noise_of_path = noise.with_args(args)
        solver_state = noise_of_path.new_solver_state(i, y)
        y, _, success = noise_of_path.step(i, y, solver_state, x)
        return y, success

    def step_all(i: Any, carry: tuple[PathStates, Array]) -> tuple[PathStates, Array]:
        paths, states = carry
        vectorized_step = jax.vmap(ft.partial(step_one, i))
        y, success = vectorized_step(paths.y, paths.args, keys)
        paths = paths.after_step(problem, y, None, success)
        return paths, states.at[i].set(jax.vmap(ravel)(paths.y))

    # Solvers start anew in each step, which is good enough for a fit.
    paths = PathStates.start(
        problem, jax.vmap(problem.draw_start)(keys), solver_state=None
    )
    starts = jax.vmap(ravel)(paths.y)
    states = jnp.broadcast_to(starts, (problem.most_steps, *starts.shape))
    carry = paths, states
    paths, states = lax.fori_loop(0, noise.level.num_steps, step_all, carry)
    return _Pilot(keys, starts, states, ~paths.failed)


def _scales(problem: Problem, pilot: _Pilot, num_steps: Any) -> Float[Array, " d"]:
    """How far each component moves: the root of the mean squared distance from the start
    over all steps of good paths. Zero for components that do not move."""
    start, _ = jfu.ravel_pytree(problem.y0)
    if problem.y0_of is not None:
        start = jnp.mean(pilot.starts, axis=0)
    # (steps, paths, d)
    distances = jnp.where(pilot.good[:, None], jnp.abs(pilot.states - start), 0)
    # Dividing by the largest value first avoids underflow of squares in single precision.
    largest = jnp.max(distances, axis=(0, 1))
    scaled = distances / jnp.where(largest > 0, largest, 1)
    weights = equal_weights(pilot.good, start.dtype)
    mean_square = jnp.einsum("n,ind->d", weights, scaled**2) / num_steps
    return largest * jnp.sqrt(mean_square)
