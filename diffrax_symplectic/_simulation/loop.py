"""The loop over fixed steps that all samplings share."""

import functools as ft
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
from .problem import DrawnStart, Problem


# The number of paths that are stepped at once on CPUs. The arrays of more paths overflow
# the cache in every sweep over their stage equations: for a million paths of `ArrayRQMC` by
# the midpoint rule blocks save a quarter to a half of the processor time. In smaller blocks
# the batches of `ensemble` take up to a fifth longer.
_PATHS_AT_ONCE = 2**16


class PathStates(eqx.Module):
    """The states of many paths at one time, along the first axis of each array.

    - `y`: the state of the equation.
    - `solver_state`: the arrays of the solver's state.
    - `failed`: which paths have failed. A failed path stays failed, and continues from
        `y0`: otherwise stage equations without a solution would hold up the other paths in
        every later step.
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
        drawn: DrawnStart,
        solver_state: PyTree[Array],
        control: Any = None,
    ) -> "PathStates":
        """Paths before their first step. A path whose initial state is not finite has
        failed."""
        failed = ~jax.vmap(all_finite)(drawn.y0)
        y = _kept_where(failed, problem.y0, drawn.y0)
        return PathStates(y, solver_state, failed, drawn.args, control)

    def moved(
        self,
        problem: Problem,
        y: Y,
        solver_state: PyTree[Array],
        success: Bool[Array, " n"],
        control: Any = None,
    ) -> "PathStates":
        """The paths after a step to `y`, with failed paths reset."""
        failed = self.failed | ~success
        solver_state = _kept_where(failed, self.solver_state, solver_state)
        y = _kept_where(failed, problem.y0, y)
        return PathStates(y, solver_state, failed, self.args, control)


def _kept_where(failed: Bool[Array, " n"], old: PyTree, new: PyTree) -> PyTree:
    """The new values, and the old ones for failed paths."""

    def kept(new_leaf: Array, old_leaf: Array) -> Array:
        return jnp.where(mask_like(failed, new_leaf), old_leaf, new_leaf)

    return jtu.tree_map(kept, new, old)


class Motion(NamedTuple):
    """How the paths of a level move.

    - `step`: maps the number of a step and the paths before it to those after it.
    - `start`: the paths before step 0.
    """

    step: Callable[[Any, PathStates], PathStates]
    start: PathStates


class Simulated(NamedTuple):
    """The paths of all levels, or of one level without the axis of levels.

    - `saved`: the measured values after each saved step.
    - `failed`: which paths have failed at the end.
    - `control`: the control variates at the end.
    """

    saved: Float[Array, "levels S ..."]
    failed: Bool[Array, "levels n"]
    control: Any


def _phi_itself(phi: Array, failed: Bool[Array, " n"]) -> Array:
    """The values of `phi`: the measurement that saves them as they are."""
    del failed
    return phi


def simulate(
    problem: Problem,
    begin: Callable[[Level], Motion],
    measure: Callable[[Array, Bool[Array, " n"]], Array] = _phi_itself,
) -> Simulated:
    """Simulates the paths of all levels, which `begin(level)` starts. After each saved step
    `measure(phi, failed)` is saved, with `phi` of shape `(n, m)`."""
    on_level = ft.partial(_on_level, problem, begin, measure)
    if len(problem.levels.h) == 1:
        only_level = on_level(problem.level(0))
        return jtu.tree_map(lambda x: x[None], only_level)
    # All levels share one compiled program.
    return lax.map(on_level, problem.levels)


def _on_level(
    problem: Problem, begin: Callable[[Level], Motion], measure: Callable, level: Level
) -> Simulated:
    """Simulates the paths of one level."""
    motion = begin(level)

    def step_and_measure(i, carry):
        paths, saved = carry
        num_steps = i + 1
        paths = motion.step(i, paths)
        return _measure_if_saved(problem, level, measure, num_steps, paths, saved)

    num_saves, m = problem.num_outputs
    num_paths = len(motion.start.failed)
    dtype = problem.dtype_of_values
    phi = jax.ShapeDtypeStruct((num_paths, m), dtype)
    measured = jax.eval_shape(measure, phi, motion.start.failed)
    saved = jnp.zeros((num_saves, *measured.shape), dtype)
    # A saved time may be `t0`.
    carry = _measure_if_saved(problem, level, measure, 0, motion.start, saved)
    paths, saved = lax.fori_loop(0, level.num_steps, step_and_measure, carry)
    return Simulated(saved, paths.failed, paths.control)


def _measure_if_saved(
    problem: Problem,
    level: Level,
    measure: Callable,
    i: Any,
    paths: PathStates,
    saved: Float[Array, "S ..."],
) -> tuple[PathStates, Float[Array, "S ..."]]:
    """The paths after `i` steps, and the saved values, to which this adds a measurement if
    step `i` is a saved one. A path whose `phi` is not finite has failed."""

    def measured():
        def phi_of(y, args):
            return problem.with_args(args).values(problem.t0 + i * level.h, y)

        phi = jax.vmap(phi_of)(paths.y, paths.args)
        failed = paths.failed | ~jax.vmap(all_finite)(phi)
        # `ts` may repeat a time, so several rows of `saved` may belong to this step.
        is_row_of_step = mask_like(level.saved_steps == i, saved)
        return failed, jnp.where(is_row_of_step, measure(phi, failed), saved)

    def unchanged():
        return paths.failed, saved

    # One predicate for all paths, so that `phi` is evaluated only after saved steps.
    is_saved = jnp.any(level.saved_steps == i)
    failed, saved = lax.cond(is_saved, measured, unchanged)
    return eqx.tree_at(lambda states: states.failed, paths, failed), saved


def independent_steps(
    problem: Problem,
    level: Level,
    drawn: DrawnStart,
    terms_of: Callable[[Any], PyTree],
    randomness: Callable[[Any], PyTree[Array]],
) -> Motion:
    """The motion of independent paths, whose starts were `drawn`. In step `i` each path has
    the terms `terms_of(random)`, where `random` is the row of `randomness(i)` that belongs
    to the path."""

    def step(i: Any, paths: PathStates) -> PathStates:
        def step_of_path(random, y, solver_state, args):
            problem_of_path = problem.with_args(args)
            terms = terms_of(random)
            return problem_of_path.step(terms, i, level.h, y, solver_state)

        y, solver_state, success = _vmapped_in_blocks(
            step_of_path, randomness(i), paths.y, paths.solver_state, paths.args
        )
        return paths.moved(problem, y, solver_state, success)

    def solver_state_at_start(random, y, args):
        problem_of_path = problem.with_args(args)
        return problem_of_path.init(terms_of(random), 0, level.h, y)

    solver_state = jax.vmap(solver_state_at_start)(randomness(0), drawn.y0, drawn.args)
    return Motion(step, PathStates.start(problem, drawn, solver_state))


def values_of_paths(
    problem: Problem, keys: Key[Array, " n"]
) -> tuple[Float[Array, "levels S n m"], Bool[Array, "levels n"]]:
    """The values of `phi` for independent paths, one for each key, on all levels and at the
    times at which to average, and which paths failed."""
    keys_of_paths = jax.vmap(lambda key: path_keys(problem.terms, key))(keys)
    drawn = jax.vmap(problem.draw_start)(keys)

    def begin(level: Level) -> Motion:
        return independent_steps(
            problem,
            level,
            drawn,
            terms_of=lambda keys_of_path: with_keys(problem.terms, keys_of_path),
            # A path draws the increments of all steps from its keys.
            randomness=lambda i: keys_of_paths,
        )

    simulated = simulate(problem, begin)
    return simulated.saved, simulated.failed


def _vmapped_in_blocks(fn: Callable, *args: PyTree[Array]) -> Any:
    """`jax.vmap(fn)(*args)`, on CPUs one block of paths after another."""
    num_paths = len(jtu.tree_leaves(args)[0])
    # A last block of another size would be compiled for itself.
    has_whole_blocks = num_paths > _PATHS_AT_ONCE and num_paths % _PATHS_AT_ONCE == 0
    if not has_whole_blocks or jax.default_backend() != "cpu":
        return jax.vmap(fn)(*args)
    return lax.map(lambda args: fn(*args), args, batch_size=_PATHS_AT_ONCE)


def mask_like(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask of the first axis of `x`, with axes of length 1 for the others."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))
