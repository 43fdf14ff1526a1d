"""Target functions, fitted backwards in time at the states of a pilot run."""

import dataclasses
import functools as ft
from typing import Any

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


# The number of states over which second derivatives along the noise are averaged. A rough
# mean will do: with any number in place of it, the control variate has mean zero.
_STATES_FOR_SECOND = 32


class FittedFunctions(eqx.Module):
    """The value functions of a level, one after each step, for each time at which to
    average (`S`) and each component of `phi` (`m`). For several levels there is another
    leading axis.

    - `frames`: the coordinates of the basis, with a leading axis of steps.
    - `coefficients`: the coefficients of the `size` functions of the basis, with axes for
        steps, `size`, `S` and `m`.
    - `second_derivatives`: those along the noise, from `Noise.mean_second_derivatives`,
        with axes for steps, twice the random variables, `S` and `m`; `None` if there are
        few outcomes.
    """

    frames: PyTree[Array]
    coefficients: Float[Array, "..."]
    second_derivatives: Float[Array, "..."] | None
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i: Any, y: Y) -> Float[Array, "S m"]:
        """Their values at a state after step `i`."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.value_at(frame, ravel(y), self.coefficients[i])


def room_for_steps(problem: Problem) -> int:
    """The number of steps for which the arrays of a fit have room, on any level: their
    shapes must be known when compiling."""
    # With two levels a trial halves all steps.
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
    """The functions of the level with this index, with a leading axis of levels, by a pilot
    run forward in time and fits backward; and how many of the pilot's paths failed. All
    levels have arrays for `most_steps` steps, so that they share a program."""
    noise = Noise.of(problem, problem.level(index))
    num_steps = noise.level.num_steps
    keys = jr.split(jr.fold_in(key, index), basis.num_pilots)
    starts, states, good = _run_pilot(noise, keys, most_steps)

    # How far each component moves: the root of the mean squared distance from the start
    # over all steps of good paths. It is zero for components that do not move.
    start = ravel(problem.y0)
    if problem.y0_of is not None:
        start = jnp.mean(starts, axis=0)
    # (steps, paths, d)
    distances = jnp.where(good[:, None], jnp.abs(states - start), 0)
    # Dividing by the largest value first avoids underflow of squares in single precision.
    largest = jnp.max(distances, axis=(0, 1))
    scaled = distances / jnp.where(largest > 0, largest, 1)
    weights = equal_weights(good, start.dtype)
    mean_square = jnp.einsum("n,ind->d", weights, scaled**2) / num_steps
    scales = largest * jnp.sqrt(mean_square)

    def frame_after(i: Any) -> PyTree[Array]:
        return basis.frame(states[i], good, scales)

    def fit_step(num_fitted: Any, fitted: FittedFunctions) -> FittedFunctions:
        # The functions after later steps come first: those after a step are fitted to them.
        i = num_steps - 1 - num_fitted
        frame = frame_after(i)
        target = _target(noise, fitted, i)
        coefficients = basis.coefficients(target, frame, states[i], good, keys)
        put_step = lambda of_steps, of_step: of_steps.at[i].set(of_step)
        return dataclasses.replace(
            fitted,
            frames=jtu.tree_map(put_step, fitted.frames, frame),
            coefficients=put_step(fitted.coefficients, coefficients),
        )

    struct_of_coefficients = jax.ShapeDtypeStruct(
        (basis.size, *problem.output_shape), problem.dtype
    )
    frames, coefficients = jtu.tree_map(
        lambda of_step: jnp.zeros((most_steps, *of_step.shape), of_step.dtype),
        (jax.eval_shape(frame_after, 0), struct_of_coefficients),
    )
    unfitted = FittedFunctions(frames, coefficients, None, basis)
    fitted = lax.fori_loop(0, num_steps, fit_step, unfitted)

    # No fit reads second derivatives, so they are computed once, at the end.
    _, unravel = jfu.ravel_pytree(problem.y0)

    def second_derivatives_of_step(step_and_states):
        i, states = step_and_states
        ys = jax.vmap(unravel)(states)
        return noise.mean_second_derivatives(i, ys, ft.partial(fitted, i))

    # The states before each step are those after the step before: (steps, paths, d).
    states_before = jnp.concatenate([starts[None], states[:-1]])
    few_states = states_before[:, :_STATES_FOR_SECOND]
    second_derivatives = lax.map(
        second_derivatives_of_step, (jnp.arange(most_steps), few_states)
    )
    functions = dataclasses.replace(fitted, second_derivatives=second_derivatives)
    return jtu.tree_map(lambda x: x[None], functions), jnp.sum(~good)


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
            # Draws by one key are numbered. The pilot's own steps have the numbers of the
            # steps for which there is room.
            number = len(fitted.coefficients) + i
            cuts = cuts_of([law.probabilities for law in noise.laws])
            variables, _ = noise.draw(key, number, cuts)
        # (S, m), and `phi` (m).
        mean = noise.mean(next_step, y, ft.partial(fitted, next_step), variables)
        phi = problem.values(problem.t0 + (i + 1) * level.h, y).astype(mean.dtype)
        # Which of the times at which to average are the end of this step, or later.
        is_end_of_step = level.saved_steps == i + 1
        is_later = level.saved_steps > i + 1
        mean_or_zero = jnp.where(is_later[:, None], mean, 0)
        return jnp.where(is_end_of_step[:, None], phi, mean_or_zero)

    return value


def _run_pilot(
    noise: Noise, keys: Key[Array, " paths"], most_steps: int
) -> tuple[
    Float[Array, "paths d"], Float[Array, "steps paths d"], Bool[Array, " paths"]
]:
    """Simulates a path for each key, at whose states functions are fitted. The states at
    the start and after each step, and which of the paths did not fail."""
    problem = noise.problem
    # With equal probabilities of all outcomes the pilot's paths spread further than others,
    # so that the fit also holds for outliers.
    equal_cuts = cuts_of(
        [np.full(len(x.values), 1 / len(x.values)) for x in noise.laws]
    )

    def step_one(i, y, args, key):
        x, _ = noise.draw(key, i, equal_cuts)
        noise_of_path = noise.with_args(args)
        # Solvers start anew in each step, which is good enough for a fit.
        solver_state = noise_of_path.new_solver_state(i, y)
        y, _, success = noise_of_path.step(i, y, solver_state, x)
        return y, success

    def step_all(i: Any, carry: tuple[PathStates, Array]) -> tuple[PathStates, Array]:
        paths, states = carry
        y, success = jax.vmap(ft.partial(step_one, i))(paths.y, paths.args, keys)
        paths = paths.after_step(problem, y, None, success)
        return paths, states.at[i].set(jax.vmap(ravel)(paths.y))

    paths = PathStates.start(
        problem, jax.vmap(problem.draw_start)(keys), solver_state=None
    )
    starts = jax.vmap(ravel)(paths.y)
    states = jnp.broadcast_to(starts, (most_steps, *starts.shape))
    num_steps = noise.level.num_steps
    paths, states = lax.fori_loop(0, num_steps, step_all, (paths, states))
    return starts, states, ~paths.failed
