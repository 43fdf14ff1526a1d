"""Whether forces or noise jump in time, where two levels do not show what that does."""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._custom_types import Y
from .._programs import compiled
from .._simulation import Problem
from .._solver import (
    AbstractLangevinSplitting,
    AbstractSymplecticRungeKutta,
    kicks_and_rest,
)
from .._terms import (
    momentum_first,
    split_friction,
    split_terms,
    without_constraint,
)
from .fields_in_time import (
    all_fields,
    at_both_states,
    depends_on_time,
    drift_rate,
    Field,
    forces,
    noise_change,
)


# How far on either side of the end of a step forces are compared, in units in the last
# place of the largest time: the user's time of a jump and that of a step are rounded.
_ROUNDINGS = 16
# The fraction of a step over which the change of a smooth force is measured.
_SMOOTH_FRACTION = 1e-3
# A change that is more than so many times this one is a jump.
_JUMP_PER_SMOOTH_CHANGE = 4
# The most steps that are looked at, the first ones, and how many at once.
_MOST_STEPS = 2**14
_STEPS_AT_ONCE = 256
# A jump is searched for in this many steps at most, those with the largest changes. Over a
# whole step a smooth change may be larger than the jump, so the step is divided into this
# many parts first, and only the part that changes most is bisected.
_MOST_STEPS_SEARCHED = 256
_PARTS_OF_STEP = 32


def jumps_within_steps(problem: Problem) -> str | None:
    """What is wrong with forces or noise that jump in time between the ends of the shortest
    steps, as a sentence; `None` if none do.

    Any solver then makes an error of first order. As long as all levels take the jump at
    the same end of a step, this error is the same on all of them, so that they agree. A
    jump whose time is random, with another one for each path, does not count: the errors
    of the paths average out."""
    if not depends_on_time(all_fields(problem), problem.t0, problem.y0):
        return None
    steps = _steps_to_look_at(problem)
    if steps is None:
        return None
    times = _times_of_jumps(problem, steps)
    # Only jumps that another draw of `args` has, too, are at the same time on all paths.
    if problem.args_of is not None and times.size:
        _, other_args = problem.draw_start(jr.key(2))
        other_times = _times_of_jumps(problem.with_args(other_args), steps)
        # (jumps of one draw, jumps of the other)
        are_equal = np.abs(times[:, None] - other_times) < steps.far
        times = times[np.any(are_equal, axis=1)]
    if not times.size:
        return None
    return (
        f"The forces or the noise jump within a step, such as at t={np.min(times):.6g}. "
        "Then all solvers converge to first order only, and two levels may agree on a "
        "wrong mean. Choose `dt0` so that steps end at each jump."
    )


def jumps_at_step_ends(problem: Problem) -> str | None:
    """What is wrong with forces or noise that jump at the end of a step, as a sentence;
    `None` if none do, or for solvers that do not evaluate them there, or are of order 1
    anyway, by which two levels extrapolate.

    Such a field has one value at the time of the jump, which the step that ends there and
    the one that begins there both take: for one of them it is that of the wrong side. So
    the mean converges with order 1. But two levels extrapolate by order 2, and find less
    than the error. The ends of the shortest steps include the middles of steps twice as
    long."""
    y0 = problem.y0
    if isinstance(problem.solver, AbstractLangevinSplitting):
        _, y0 = momentum_first(problem.terms, y0)
        fields = _kicks_at_ends(problem, problem.solver)
        cure = "Let the function of time return the mean of both sides at a jump"
        if not problem.solver.has_flow:
            cure += (
                ", or pass `BAOAB(ImplicitMidpoint())`, which takes forces within steps"
            )
    elif isinstance(problem.solver, AbstractSymplecticRungeKutta):
        fields = _stages_at_ends(problem, problem.solver)
        cure = (
            "Pass a solver that takes forces and noise within steps, such as "
            "`ImplicitMidpoint()`"
        )
    else:
        return None
    for what_happens, field in fields.items():
        end = _first_jump_at_end(field, problem, y0)
        if end is not None:
            return (
                f"The {what_happens} at step ends, such as t={end:.6g}, and "
                f"`{type(problem.solver).__name__}` takes one side of the jump for both "
                "steps: the mean converges to first order only, and two levels do not see "
                f"it. {cure}."
            )
    return None


def _kicks_at_ends(
    problem: Problem, solver: AbstractLangevinSplitting
) -> dict[str, Field]:
    """The forces of splittings that begin and end with a kick, by what they would do
    there."""
    if not solver.symmetric or not solver.kicks_at_ends:
        return {}
    terms, _ = momentum_first(problem.terms, problem.y0)
    drift, _, _ = split_friction(without_constraint(terms))
    kicks, _ = kicks_and_rest(solver.has_flow, drift)
    return {"forces jump": jtu.Partial(forces, kicks, problem.args)} if kicks else {}


def _stages_at_ends(
    problem: Problem, solver: AbstractSymplecticRungeKutta
) -> dict[str, Field]:
    """The fields that a tableau evaluates at ends of steps, by what they would do there."""
    # Two levels extrapolate by the weak order, or by 1 if there is none.
    if solver.weak_order(problem.terms) in (1, None):
        return {}
    drift, noise = split_terms(without_constraint(problem.terms))
    stages = solver.tableau.flatten().stages
    stages_at_ends = [stage for stage in stages if stage.c in (0, 1)]
    # The others evaluate noise.
    drift_stages = [stage for stage in stages_at_ends if stage.channels == ("h",)]
    fields = {}
    # Stages that move positions alone evaluate velocities, which do not depend on time.
    if drift and any(stage.writes != "q" for stage in drift_stages):
        fields["forces jump"] = jtu.Partial(drift_rate, drift, problem.args)
    if noise and len(drift_stages) < len(stages_at_ends):
        fields["noise jumps"] = jtu.Partial(noise_change, noise, problem.args)
    return fields


class _Steps(NamedTuple):
    """The shortest steps of a problem, as many as are looked at.

    - `starts`, `h`: when they start, and how long they are.
    - `near`, `far`: how far before and after a time fields are compared: as near as the
        rounding of times allows, and as far as smooth fields change little.
    """

    starts: Float[np.ndarray, " steps"]
    h: float
    near: float
    far: float

    @property
    def around(self) -> Float[np.ndarray, "4"]:
        """The times at which fields are compared, from a time between them on."""
        return np.array([-self.far, -self.near, self.near, self.far])


def _steps_to_look_at(problem: Problem) -> _Steps | None:
    """The first steps of the finest level; `None` where times are rounded so coarsely, as
    in single precision long after time zero, that both sides of the end of a step cannot be
    told from other parts of the step."""
    h = float(problem.levels.h[-1])
    step_numbers = np.arange(min(problem.finest_steps, _MOST_STEPS))
    starts = float(problem.t0) + h * step_numbers
    largest_time = max(abs(float(problem.t0)), abs(starts[-1] + h))
    near = _ROUNDINGS * float(np.finfo(problem.dtype).eps) * largest_time
    far = max(_SMOOTH_FRACTION * h, 4 * near)
    if far > h / 8:
        return None
    return _Steps(starts, h, near, far)


def _times_of_jumps(problem: Problem, steps: _Steps) -> Float[np.ndarray, " jumps"]:
    """When the forces or the noise jump within steps, not at their ends."""
    # Jumps that are nearer than this to an end of a step do as little harm as those at it,
    # so both ends are left out.
    interior = np.array([steps.far, steps.h - steps.far])
    interiors = (steps.starts[:, None] + interior).astype(problem.dtype)
    # Bisection goes on until a part of a step is no longer than `near`.
    halvings = max(0, int(np.ceil(np.log2(steps.h / _PARTS_OF_STEP / steps.near))))
    around = steps.around.astype(problem.dtype)
    found = _search(all_fields(problem), problem.y0, interiors, halvings, around)
    times, is_jump = map(np.asarray, found)
    return times[is_jump]


def _first_jump_at_end(field: Field, problem: Problem, y0: Y) -> float | None:
    """The first end of a step at which a field jumps; `None` if there is none. A jump at
    `t0` does not count: paths see only the side after it."""
    if not depends_on_time(field, problem.t0, y0):
        return None
    steps = _steps_to_look_at(problem)
    if steps is None:
        return None
    ends = steps.starts + steps.h
    is_last = np.arange(1, len(ends) + 1) == problem.finest_steps
    times = (ends[:, None] + np.append(steps.around, 0)).astype(problem.dtype)
    jumps = _jumps_at_ends(field, y0, times, is_last)
    return float(ends[np.argmax(jumps)]) if np.any(jumps) else None


def _largest_smooth_change(sides: Float[Array, "4 n"]) -> Float[Array, ""]:
    """The largest change of a field that does not count as a jump: several times the
    changes on both sides, plus an allowance for rounding. `sides` are its values far and
    near before a time, and near and far after it."""
    change_before, _, change_after = jnp.linalg.norm(jnp.diff(sides, axis=0), axis=1)
    size = jnp.linalg.norm(sides)
    rounding = jnp.sqrt(jnp.finfo(size.dtype).eps) * size
    return _JUMP_PER_SMOOTH_CHANGE * (change_before + change_after) + rounding


@ft.partial(compiled, quickly=True)
def _search(
    field: Field,
    y0: Y,
    intervals: Float[Array, "steps 2"],
    halvings: int,
    around: Float[Array, "4"],
) -> tuple[Float[Array, " searched"], Bool[Array, " searched"]]:
    """For the `intervals`, from a start to an end, in which a field changes most: the time
    at which it changes fastest, and whether it jumps there, by its values `around` it."""
    values_at = at_both_states(field, y0)

    def changes(times: Float[Array, " times"]) -> Float[Array, " intervals"]:
        """The changes from each time to the next."""
        return jnp.linalg.norm(jnp.diff(values_at(times), axis=0), axis=1)

    def with_middle(interval: Float[Array, "2"]) -> Float[Array, "3"]:
        start, end = interval
        return jnp.stack([start, (start + end) / 2, end])

    def largest_change(interval: Float[Array, "2"]) -> Float[Array, ""]:
        """The larger of the changes over both halves of an interval."""
        return jnp.max(changes(with_middle(interval)))

    def half_that_changes_more(_, interval: Float[Array, "2"]) -> Float[Array, "2"]:
        times = with_middle(interval)
        in_first, in_second = changes(times)
        return jnp.where(in_first >= in_second, times[:2], times[1:])

    def jump_in(interval: Float[Array, "2"]) -> tuple[Array, Bool[Array, ""]]:
        times = jnp.linspace(interval[0], interval[1], _PARTS_OF_STEP + 1)
        part = times[jnp.argmax(changes(times)) + jnp.arange(2)]
        time = jnp.mean(lax.fori_loop(0, halvings, half_that_changes_more, part))
        sides = values_at(time + around)
        jump = jnp.linalg.norm(sides[2] - sides[1])
        return time, jump > _largest_smooth_change(sides)

    changes_in_steps = lax.map(largest_change, intervals, batch_size=_STEPS_AT_ONCE)
    num_searched = min(_MOST_STEPS_SEARCHED, len(intervals))
    _, largest = lax.top_k(changes_in_steps, num_searched)
    return jax.vmap(jump_in)(intervals[largest])


@ft.partial(compiled, quickly=True)
def _jumps_at_ends(
    field: Field, y0: Y, times: Float[Array, "ends 5"], is_last: Bool[Array, " ends"]
) -> Bool[Array, " ends"]:
    """For the end of each step, whether a field jumps there, and does not have the mean of
    both sides as its value, which would be right. `times` are far and near before the end,
    near and far after it, and the end itself."""
    values_at = at_both_states(field, y0)

    def jumps_at(end: tuple[Array, Array]) -> Bool[Array, ""]:
        times, is_last = end
        values = values_at(times)
        sides = values[:4]
        value = values[4]
        off_mean = jnp.linalg.norm(value - (sides[1] + sides[2]) / 2)
        # No step follows the last end, so the value of the side before is right there, too.
        off_before = jnp.linalg.norm(value - sides[1])
        error = jnp.where(is_last, jnp.minimum(off_mean, off_before), off_mean)
        # A field with the value of one side is off the mean by half of its jump. (With a
        # NaN among the values, the comparison is false: that is no jump.)
        return 2 * error > _largest_smooth_change(sides)

    return lax.map(jumps_at, (times, is_last), batch_size=_STEPS_AT_ONCE)
