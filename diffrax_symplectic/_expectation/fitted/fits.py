"""Target functions, fitted backwards in time at the states of a pilot run."""

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
from .noise import Noise


# The states over which second derivatives along the noise are averaged. A rough mean will
# do: with any number in place of it, the control variate has mean zero.
_STATES_FOR_SECOND = 32


class Choice(NamedTuple):
    """What is used for each time at which to average and each component of `phi`.

    - `best`: the number of the candidate.
    - `used`: whether its control variate is used, or none.
    """

    best: Int[Array | np.ndarray, "S m"]
    used: Bool[Array | np.ndarray, "S m"]


class FittedFunctions(eqx.Module):
    """The value functions of a level, one after each step, for each time at which to
    average (`S`) and each component of `phi` (`m`); and for each candidate (`C`), until one
    is chosen. For several levels there is another leading axis.

    - `frames`: the coordinates of the basis, with a leading axis of steps.
    - `coefficients`: of the functions of the basis, which are `size` many, with axes for
        steps, `size`, `C`, `S` and `m`.
    - `second`: second derivatives along the noise, from `Noise.second`, with axes for
        steps, twice the random variables, `C`, `S` and `m`.
    """

    frames: PyTree[Array]
    coefficients: Float[Array, "..."]
    second: Float[Array, "..."] | None
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i: Any, y: Y) -> Float[Array, "*C S m"]:
        """Their values at a state after step `i`."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.value_at(frame, ravel(y), self.coefficients[i])

    def chosen(self, best: Int[Array | np.ndarray, "S m"]) -> "FittedFunctions":
        """The functions with one candidate for each component."""

        def take(x: Float[Array, "... C S m"]) -> Float[Array, "... S m"]:
            index = best.reshape(*[1] * (x.ndim - 2), *best.shape)
            return jnp.take_along_axis(x, index, -3).squeeze(-3)

        coefficients = take(self.coefficients)
        second = None if self.second is None else take(self.second)
        return FittedFunctions(self.frames, coefficients, second, self.basis)


def fit(
    noise: Noise, key: PRNGKeyArray, basis: AbstractBasis
) -> tuple[FittedFunctions, Int[Array, ""]]:
    """The functions of a level, for its noise: a pilot run forward, and fits backward; and
    how many of the pilot's paths failed."""
    p = noise.problem
    num_steps = noise.level.num_steps
    pilot = _pilot(noise, jr.split(key, basis.pilots))
    unit = _unit(p, pilot, num_steps)

    def frame_after(i: Any) -> PyTree[Array]:
        return basis.frame(pilot.states[i], pilot.good, unit)

    def backward(j: Any, u: FittedFunctions) -> FittedFunctions:
        i = num_steps - 1 - j
        frame = frame_after(i)
        target = _target(noise, u, i)
        c = basis.coefficients(target, frame, pilot.states[i], pilot.good, pilot.keys)
        put = lambda of_steps, of_step: of_steps.at[i].set(of_step)
        frames = jtu.tree_map(put, u.frames, frame)
        return FittedFunctions(frames, put(u.coefficients, c), None, basis)

    # Arrays have room for the most steps of a level, so that levels share one program.
    zeros = lambda struct: jnp.zeros((p.finest_steps, *struct.shape), struct.dtype)
    frames = jtu.tree_map(zeros, jax.eval_shape(lambda: frame_after(0)))
    shape = p.finest_steps, basis.size, len(basis.candidates), *p.num_outputs
    u = FittedFunctions(frames, jnp.zeros(shape, p.dtype), None, basis)
    u = lax.fori_loop(0, num_steps, backward, u)
    second = _second(noise, pilot, u)
    functions = FittedFunctions(u.frames, u.coefficients, second, basis)
    return functions, jnp.sum(~pilot.good)


def _target(noise: Noise, u: FittedFunctions, i: Any) -> Target:
    """What the functions after step `i` are fitted to, as a function of a flat state:
    `phi` itself for the time at the end of this step, and for later times the mean over the
    next step of the functions after it, which are known. For earlier times it is zero."""
    p = noise.problem
    level = noise.level
    _, unravel = jfu.ravel_pytree(p.y0)
    # After the last step there is no next one, whose mean is not used.
    next_step = jnp.minimum(i + 1, level.num_steps - 1)

    def value(x: Float[Array, " d"], key: PRNGKeyArray | None = None) -> Array:
        y = unravel(x)
        draw = None
        if key is not None:
            # Other numbers than those of the pilot's own steps.
            draw, _ = noise.draw(key, p.finest_steps + i)
        later = noise.mean(next_step, y, lambda y1: u(next_step, y1), draw)
        phi = p.values(p.t0 + (i + 1) * level.h, y).astype(later.dtype)
        is_now = level.saved_steps == i + 1
        is_later = level.saved_steps > i + 1
        of_later = jnp.where(is_later[:, None], later, 0)
        return jnp.where(is_now[:, None], phi, of_later)

    return value


def _second(
    noise: Noise, pilot: "_Pilot", u: FittedFunctions
) -> Float[Array, "steps n n C S m"] | None:
    """Second derivatives of the functions along the noise, at some states before each
    step."""
    _, unravel = jfu.ravel_pytree(noise.problem.y0)

    def of_step(step_and_states):
        i, states = step_and_states
        return noise.second(i, jax.vmap(unravel)(states), lambda y: u(i, y))

    before = jnp.concatenate([pilot.starts[None], pilot.states[:-1]])
    few = before[:, :_STATES_FOR_SECOND]
    return lax.map(of_step, (jnp.arange(noise.problem.finest_steps), few))


class _Pilot(NamedTuple):
    """Paths at whose states functions are fitted.

    - `keys`: their random keys.
    - `starts`: their states at the start.
    - `states`: their states after each step.
    - `good`: which of them did not fail.
    """

    keys: Key[Array, " n"]
    starts: Float[Array, "paths d"]
    states: Float[Array, "steps paths d"]
    good: Bool[Array, " paths"]


def _pilot(noise: Noise, keys: Key[Array, " n"]) -> _Pilot:
    """The paths with these keys."""
    p = noise.problem

    def step(i: Any, y: Y, args: PyTree[Array], key: PRNGKeyArray):
        # With equal probabilities the pilot spreads further than the paths, so that the fit
        # also holds for outliers.
        x, _ = noise.draw(key, i, jnp.ones(()))
        noise_of_path = noise.with_args(args)
        solver_state = noise_of_path.fresh(i, y)
        y, _, success = noise_of_path.step(i, y, solver_state, x)
        return y, success

    def forward(i: Any, carry: tuple[PathStates, Array]) -> tuple[PathStates, Array]:
        paths, states = carry
        each = jax.vmap(lambda *of_path: step(i, *of_path))
        y, success = each(paths.y, paths.args, keys)
        paths = paths.moved(p, y, None, success)
        return paths, states.at[i].set(jax.vmap(ravel)(paths.y))

    # For a fit it is good enough that solvers start anew in each step.
    paths = PathStates.start(p, jax.vmap(p.draw_start)(keys), solver_state=None)
    starts = jax.vmap(ravel)(paths.y)
    states = jnp.broadcast_to(starts, (p.finest_steps, *starts.shape))
    carry = paths, states
    paths, states = lax.fori_loop(0, noise.level.num_steps, forward, carry)
    return _Pilot(keys, starts, states, ~paths.failed)


def _unit(p: Problem, pilot: _Pilot, num_steps: Any) -> Float[Array, " d"]:
    """How far each component moves: the root of the mean squared distance from the start
    over all steps of good paths. Zero for components that do not move."""
    start, _ = jfu.ravel_pytree(p.y0)
    if p.y0_of is not None:
        start = jnp.mean(pilot.starts, axis=0)
    distances = jnp.where(pilot.good[:, None], jnp.abs(pilot.states - start), 0)
    # Dividing by the largest value first avoids underflow of squares in single precision.
    most = jnp.max(distances, axis=(0, 1))
    distances = distances / jnp.where(most > 0, most, 1)
    weights = equal_weights(pilot.good, start.dtype)
    return most * jnp.sqrt(jnp.einsum("n,ind->d", weights, distances**2) / num_steps)
