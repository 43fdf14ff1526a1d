"""The loop over fixed steps that all samplings share."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Key, PyTree

from .._custom_types import Y
from .._root_finder import all_finite
from .._terms import path_keys, with_keys
from .levels import Level
from .problem import Problem


# The number of paths that take a step at once on CPUs. The stage equations of an implicit
# step are solved by sweeps over the arrays of all these paths. With more paths, the arrays
# would not fit into the cache: for a million paths of `ArrayRQMC` by the midpoint rule,
# blocks save a quarter to a half of the processor time. In smaller blocks the batches of
# `ensemble` take up to a fifth longer.
_PATHS_AT_ONCE = 2**16


class PathStates(eqx.Module):
    """The states of many paths at one time, along the first axis of each array.

    - `y`: the state of the equation.
    - `solver_state`: the arrays of the solver's state.
    - `failed`: which paths have failed. A failed path stays failed, but continues from the
        `y0` of the problem: stage equations without a solution would hold up the other
        paths in every later step.
    - `args`: the arrays of `args`, if each path has its own.
    - `control`: the control variate, if any.
    """

    y: Y
    solver_state: PyTree[Array]
    failed: Bool[Array, " n"]
    args: PyTree[Array]
    control: Any

    @staticmethod
    def start(
        problem: Problem,
        starts: tuple[Y, PyTree[Array]],
        solver_state: PyTree[Array],
        control: Any = None,
    ) -> "PathStates":
        """The paths before their first step, from the results of `Problem.draw_start` for
        each. A path whose initial state is not finite has failed."""
        y0, args = starts
        # Without a barrier XLA checks a start that is constant, such as momenta at rest,
        # while compiling: for 30,000 paths of 36 momenta this takes 3 seconds.
        y0 = lax.optimization_barrier(y0)
        failed = ~jax.vmap(all_finite)(y0)
        y = _replaced_where(failed, y0, problem.y0)
        return PathStates(y, solver_state, failed, args, control)

    def after_step(
        self,
        problem: Problem,
        y: Y,
        solver_state: PyTree[Array],
        success: Bool[Array, " n"],
        control: Any = None,
    ) -> "PathStates":
        """The paths after a step to `y`. Paths that have failed, in this step or before,
        are reset to the `y0` of the problem, and to their solver state before the step."""
        failed = self.failed | ~success
        solver_state = _replaced_where(failed, solver_state, self.solver_state)
        y = _replaced_where(failed, y, problem.y0)
        return PathStates(y, solver_state, failed, self.args, control)


def _replaced_where(
    failed: Bool[Array, " n"], values: PyTree, replacements: PyTree
) -> PyTree:
    """The values of all paths, with replacements for those of failed paths. An array of
    replacements has an axis of paths, or is the same for all paths and has no such axis."""

    def replaced(value: Array, replacement: Array) -> Array:
        return jnp.where(mask_like(failed, value), replacement, value)

    return jtu.tree_map(replaced, values, replacements)


class Motion(NamedTuple):
    """How the paths of one level move.

    - `step`: maps the number of a step and the paths before this step to the paths after.
    - `start`: the paths before step 0.
    """

    step: Callable[[Any, PathStates], PathStates]
    start: PathStates


class Simulated(NamedTuple):
    """The results of `simulate` for all levels, along a leading axis. (Within `simulate`,
    those of one level have no such axis.)

    - `saved`: what `measure` of `simulate` returned at each saved time.
    - `failed`: which paths have failed at the end.
    - `control`: the control variates at the end.
    """

    saved: Float[Array, "levels S ..."]
    failed: Bool[Array, "levels n"]
    control: Any


def _values_alone(values: Array, failed: Bool[Array, " n"]) -> Array:
    """The default of `measure` in `simulate`: saves the values of `phi` as they are."""
    del failed
    return values


def simulate(
    problem: Problem,
    motion_on: Callable[[Level], Motion],
    measure: Callable[[Array, Bool[Array, " n"]], Array] = _values_alone,
) -> Simulated:
    """Simulates the paths of all levels, which move as `motion_on(level)` says.

    At each saved time `measure(values, failed)` is saved: `values` has shape `(n, m)`, with
    the values of `phi` for each of `n` paths, and `failed` says which paths have failed.
    The loop over steps carries the paths, and an array `saved` with a row for each saved
    time, which is zero until this time has come."""

    def measure_if_saved(
        level: Level, num_steps: Any, paths: PathStates, saved: Float[Array, "S ..."]
    ) -> tuple[PathStates, Float[Array, "S ..."]]:
        """If the time after `num_steps` steps is a saved one, writes a measurement to its
        row of `saved`, and marks paths whose values are not finite as failed."""

        def with_measurement():
            t = problem.t0 + num_steps * level.h

            def values_of_path(y: Y, args: PyTree[Array]) -> Array:
                return problem.with_args(args).values(t, y)

            values = jax.vmap(values_of_path)(paths.y, paths.args)
            failed = paths.failed | ~jax.vmap(all_finite)(values)
            # `ts` may repeat a time, so several rows of `saved` may belong to this time.
            is_row_of_time = mask_like(level.saved_steps == num_steps, saved)
            return failed, jnp.where(is_row_of_time, measure(values, failed), saved)

        # The predicate is one truth value for all paths. With a value for each path, JAX
        # would evaluate `phi` after every step.
        is_saved = jnp.any(level.saved_steps == num_steps)
        failed, saved = lax.cond(
            is_saved, with_measurement, lambda: (paths.failed, saved)
        )
        return dataclasses.replace(paths, failed=failed), saved

    def simulate_level(level: Level) -> Simulated:
        motion = motion_on(level)

        def step_and_measure(i, carry):
            paths, saved = carry
            return measure_if_saved(level, i + 1, motion.step(i, paths), saved)

        # The shape of a measurement follows from that of the values.
        num_saves, m = problem.output_shape
        dtype = problem.dtype_of_values
        values = jax.ShapeDtypeStruct((len(motion.start.failed), m), dtype)
        measurement = jax.eval_shape(measure, values, motion.start.failed)
        nothing_saved = jnp.zeros((num_saves, *measurement.shape), dtype)
        # A saved time may be `t0`, before the first step.
        carry = measure_if_saved(level, 0, motion.start, nothing_saved)
        paths, saved = lax.fori_loop(0, level.num_steps, step_and_measure, carry)
        return Simulated(saved, paths.failed, paths.control)

    if len(problem.levels.h) == 1:
        return jtu.tree_map(lambda x: x[None], simulate_level(problem.level(0)))
    # All levels share one compiled program.
    return lax.map(simulate_level, problem.levels)


def independent_motion(
    problem: Problem,
    level: Level,
    starts: tuple[Y, PyTree[Array]],
    terms_of: Callable[[Any], PyTree],
    randomness_of_step: Callable[[Any], PyTree[Array]],
) -> Motion:
    """The motion of paths that move independently of each other.

    - `starts`: the results of `Problem.draw_start` for all paths.
    - `terms_of`: makes the terms of one path in a step, from its row of random numbers or
        keys.
    - `randomness_of_step`: maps the number of a step to these rows, as a PyTree of arrays
        with a leading axis of paths.
    """

    def step(i: Any, paths: PathStates) -> PathStates:
        def step_of_path(row, y, solver_state, args):
            problem_of_path = problem.with_args(args)
            return problem_of_path.step(terms_of(row), i, level.h, y, solver_state)

        y, solver_state, success = _vmapped_in_blocks(
            step_of_path, randomness_of_step(i), paths.y, paths.solver_state, paths.args
        )
        return paths.after_step(problem, y, solver_state, success)

    def solver_state_at_start(row, y, args):
        problem_of_path = problem.with_args(args)
        return problem_of_path.init(terms_of(row), 0, level.h, y)

    # `PathStates.start` replaces initial states that are not finite only afterwards. The
    # solver state of such a path does not matter, since the path has failed.
    solver_state = jax.vmap(solver_state_at_start)(randomness_of_step(0), *starts)
    return Motion(step, PathStates.start(problem, starts, solver_state))


def values_of_paths(
    problem: Problem, keys: Key[Array, " n"]
) -> tuple[Float[Array, "levels S n m"], Bool[Array, "levels n"]]:
    """Simulates independent paths, one for each key, on all levels. Returns the values of
    `phi` at all saved times, and which paths failed."""
    keys_of_paths = jax.vmap(lambda key: path_keys(problem.terms, key))(keys)
    starts = jax.vmap(problem.draw_start)(keys)

    def motion_on(level: Level) -> Motion:
        return independent_motion(
            problem,
            level,
            starts,
            terms_of=lambda keys_of_path: with_keys(problem.terms, keys_of_path),
            # A path draws the increments of all steps from the same keys.
            randomness_of_step=lambda i: keys_of_paths,
        )

    simulated = simulate(problem, motion_on)
    return simulated.saved, simulated.failed


def _vmapped_in_blocks(fn: Callable, *args: PyTree[Array]) -> Any:
    """The result of `jax.vmap(fn)(*args)`, which maps over paths. For many paths on CPUs,
    one block of `_PATHS_AT_ONCE` paths is computed after another."""
    num_paths = len(jtu.tree_leaves(args)[0])
    # If whole blocks would leave some paths over, there are no blocks, since a smaller one
    # would need a program of its own.
    has_whole_blocks = num_paths > _PATHS_AT_ONCE and num_paths % _PATHS_AT_ONCE == 0
    if not has_whole_blocks or jax.default_backend() != "cpu":
        return jax.vmap(fn)(*args)

    def in_blocks(x: Array) -> Array:
        return x.reshape(-1, _PATHS_AT_ONCE, *x.shape[1:])

    # `lax.map` could make blocks by its `batch_size`, but older versions of JAX then trace
    # `fn` once more, for a remainder of no paths.
    results = lax.map(lambda block: jax.vmap(fn)(*block), jtu.tree_map(in_blocks, args))
    return jtu.tree_map(lambda x: x.reshape(num_paths, *x.shape[2:]), results)


def mask_like(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask for the first axis of `x`, with further axes of length 1, so that it
    broadcasts against `x`."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))
