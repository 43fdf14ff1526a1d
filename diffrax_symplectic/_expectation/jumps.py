"""Whether forces jump at step ends, for solvers that take them there."""

from typing import NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from .._compat import quickly_compiled
from .._custom_types import Args, Terms, Y
from .._simulation import Problem
from .._solver import AbstractLangevinSplitting, kicks_and_rest
from .._terms import (
    Dependence,
    momentum_first,
    rate,
    split_friction,
    without_constraint,
)


# How far on either side of the end of a step forces are compared, in units in the last
# place of the largest time: the user's time of a jump and that of a step are rounded.
_ROUNDINGS = 16
# The part of a step over which the change of a smooth force is measured.
_SMOOTH_PART = 1e-3
# A jump is larger than so many times this change.
_JUMP = 4
# The most ends of steps that are looked at, the first ones, and how many at once.
_MOST_ENDS = 2**14
_ENDS_AT_ONCE = 256


class _Sides(NamedTuple):
    """The forces around the end of a step, each as one vector.

    - `far_before`, `far_after`: on both sides, as far away as smooth forces change little.
    - `before`, `after`: on both sides, as near as the rounding of times allows.
    - `there`: at the end of the step itself.
    """

    far_before: Float[Array, " n"]
    before: Float[Array, " n"]
    there: Float[Array, " n"]
    after: Float[Array, " n"]
    far_after: Float[Array, " n"]


def jumping_forces(problem: Problem) -> str | None:
    """What is wrong with forces that jump at the end of a step, as a sentence; `None` if
    none do, or for other solvers than `BAOAB` and its like: these take no forces there, or
    are of order 1 anyway, by which two levels extrapolate.

    The half kicks before and after the jump both see the same side of it, so the step is of
    order 1. Two levels extrapolate by order 2, and differ by less than the error. Looks at
    the ends of the shortest steps, so also at the middles of the longest ones."""
    solver = problem.solver
    # The stages of all tableaus are within the step.
    if not isinstance(solver, AbstractLangevinSplitting) or not solver.symmetric:
        return None
    terms, y0 = momentum_first(problem.terms, problem.y0)
    drift, _, _ = split_friction(without_constraint(terms))
    kicks, _ = kicks_and_rest(solver.flow, drift)
    if not kicks or not _depend_on_time(kicks, problem, y0):
        return None
    h = float(problem.levels.h[-1])
    t0 = float(problem.t0)
    # A jump at `t0` is none: paths see one side of it alone.
    numbers = np.arange(1, min(problem.finest_steps, _MOST_ENDS) + 1)
    ends = t0 + h * numbers
    is_last = numbers == problem.finest_steps
    rounding = float(np.finfo(problem.dtype).eps) * max(abs(t0), abs(ends[-1]))
    near = _ROUNDINGS * rounding
    far = max(_SMOOTH_PART * h, 4 * near)
    # In single precision, long after time zero, the other times may be whole steps away.
    if far > h / 8:
        return None
    times = np.stack([ends - far, ends - near, ends, ends + near, ends + far], axis=1)
    times = times.astype(problem.dtype)
    do_jump = _quick_jumps(kicks, problem.args, y0, times, is_last)
    if not np.any(do_jump):
        return None
    first = float(ends[np.argmax(do_jump)])
    name = type(solver).__name__
    other_cure = ""
    if solver.flow is None:
        other_cure = (
            f", or pass `{name}(ImplicitMidpoint())`, which takes forces within steps"
        )
    return (
        f"The forces jump at step ends, such as t={first:.6g}, and `{name}` takes one side "
        "of the jump for both steps: the mean converges to first order only, and two "
        "levels do not see it. Let the function of time return the mean of both sides at "
        f"a jump{other_cure}."
    )


def _depend_on_time(forces: Terms, problem: Problem, y0: Y) -> bool:
    """Whether forces read the time, by their dependence, not by their values."""

    def forces_at(t: Array) -> Y:
        return rate(forces, t, y0, problem.args)[0]

    dependence = Dependence(forces_at, jnp.asarray(problem.t0))
    return not dependence.independent(lambda t: t)


def _jumps(
    forces: Terms,
    args: Args,
    y0: Y,
    times: Float[Array, "ends 5"],
    is_last: Bool[Array, " ends"],
) -> Bool[Array, " ends"]:
    """For the end of each step, whether forces jump there without a mean of both sides.
    `times` are those of `_Sides`."""
    y0_and_moved = jtu.tree_map(lambda *leaves: jnp.stack(leaves), y0, _moved(y0))

    def force_at(t: Array, y: Y) -> Float[Array, " n"]:
        force, _ = rate(forces, t, y, args)
        return jfu.ravel_pytree(force)[0]

    def jumps_there(end: tuple[Array, Array]) -> Bool[Array, ""]:
        times, is_last = end

        def jumps_at(y: Y) -> Bool[Array, ""]:
            sides = jax.vmap(force_at, in_axes=(0, None))(times, y)
            return _is_jump(_Sides(*sides), is_last)

        return jnp.any(jax.vmap(jumps_at)(y0_and_moved))

    return lax.map(jumps_there, (times, is_last), batch_size=_ENDS_AT_ONCE)


def _is_jump(sides: _Sides, is_last: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether the force at the end of a step is not that of a step which ends there."""
    error = jnp.linalg.norm(sides.there - (sides.before + sides.after) / 2)
    # No step follows the last end, so that the side before it is right, too.
    error_at_last = jnp.linalg.norm(sides.there - sides.before)
    error = jnp.where(is_last, jnp.minimum(error, error_at_last), error)
    smooth_change = jnp.linalg.norm(sides.before - sides.far_before)
    smooth_change += jnp.linalg.norm(sides.far_after - sides.after)
    size = jnp.linalg.norm(jnp.stack(sides))
    rounding = jnp.sqrt(jnp.finfo(size.dtype).eps) * size
    # Values that are not finite are no jumps.
    return 2 * error > _JUMP * smooth_change + rounding


def _moved(y0: Y) -> Y:
    """An arbitrary state: at `y0` a force that jumps may vanish, as in a trap that is
    stiffened while a particle rests in it."""

    def moved_leaf(x: PyTree[Array]) -> Array:
        x = jnp.asarray(x)
        largest = jnp.max(jnp.abs(x), initial=0)
        size = jnp.where(largest > 0, largest, 1)
        direction = jnp.cos(1.0 + jnp.arange(x.size, dtype=x.dtype))
        return x + size * direction.reshape(x.shape)

    return jtu.tree_map(moved_leaf, y0)


_quick_jumps = quickly_compiled(_jumps)
