"""Whether forces or noise jump in time in a way that two levels do not show.

A field here is a vector field of the problem, as a function of time and state. Jumps are
found by its values at many times.
"""

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


# The values just before and just after a time are taken at this distance from it, in units
# in the last place of the largest time. (The time at which a function of the user jumps is
# rounded, as is the end of a step.)
_ROUNDINGS = 16
# The fraction of a step over which the change of a smooth field is measured.
_SMOOTH_FRACTION = 1e-3
# A field jumps if it changes by more than this many times the change of a smooth field.
_JUMP_PER_SMOOTH_CHANGE = 4
# At most this many steps are looked at, the first ones, and this many of them at once.
_MOST_STEPS = 2**14
_STEPS_AT_ONCE = 256
# At most this many steps are searched for a jump, those over which the field changes most.
_MOST_STEPS_SEARCHED = 256
# A step that is searched is divided into this many parts, and the part that changes most is
# bisected. (Over a whole step, a smooth change may be larger than the jump.)
_PARTS_OF_STEP = 32


def jumps_within_steps(problem: Problem) -> str | None:
    """A warning if forces or noise jump in time within one of the shortest steps, away from
    its ends; `None` if they do not.

    At such a jump any solver makes an error of first order, as if the jump came at another
    time of the step, such as an end. If this time is the same on all levels, so is the
    error, and they agree on a wrong mean. A jump at a random time, which differs between
    paths, does not count, since the errors of the paths average out."""
    if not depends_on_time(all_fields(problem), problem.t0, problem.y0):
        return None
    steps = _steps_to_look_at(problem)
    if steps is None:
        return None
    times = _times_of_jumps(problem, steps)
    # If each path draws its own `args`, only jumps that a second draw has at the same times
    # count.
    if problem.args_of is not None and times.size:
        _, other_args = problem.draw_start(jr.key(2))
        other_times = _times_of_jumps(problem.with_args(other_args), steps)
        # With a row for each jump of the first draw, a column for each of the second.
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
    """A warning if forces or noise jump in time at the end of a step, and the solver
    evaluates them there; `None` otherwise.

    At the time of its jump a field has a single value, such as that of the side before. The
    step that ends at this time and the step that begins at it both take this value, and for
    one of them it is wrong. So the mean converges with order 1. But two levels extrapolate
    by the order of the solver: if it is 2, they report less than the error. For solvers of
    order 1 there is no check.

    It is enough to look at the ends of the shortest steps: they include the ends and the
    middles of all others."""
    solver = problem.solver
    if isinstance(solver, AbstractLangevinSplitting):
        at_ends = _kicks_at_ends(problem, solver)
    elif isinstance(solver, AbstractSymplecticRungeKutta):
        at_ends = _stages_at_ends(problem, solver)
    else:
        return None
    for what_happens, field in at_ends.fields.items():
        end = _first_jump_at_end(field, problem, at_ends.y0)
        if end is not None:
            return (
                f"The {what_happens} at step ends, such as t={end:.6g}, and "
                f"`{type(solver).__name__}` takes one side of the jump for both steps: "
                "the mean converges to first order only, and two levels do not see it. "
                f"{at_ends.cure}."
            )
    return None


class _AtEnds(NamedTuple):
    """What a solver evaluates at the ends of steps.

    - `fields`: the fields, by what the warning says of their jumps: `forces jump` or
        `noise jumps`. There are none if the solver has order 1.
    - `y0`: the initial state that the fields take.
    - `cure`: what to do about a jump, as a sentence without its period.
    """

    fields: dict[str, Field]
    y0: Y
    cure: str


def _kicks_at_ends(problem: Problem, solver: AbstractLangevinSplitting) -> _AtEnds:
    """The forces of a splitting whose steps begin and end with a kick, a change of the
    momenta by forces alone."""
    # Diffrax's Langevin terms have the velocity last, and kicks are made of terms that have
    # it first.
    terms, y0 = momentum_first(problem.terms, problem.y0)
    drift, _, _ = split_friction(without_constraint(terms))
    kicks, _ = kicks_and_rest(has_flow=solver.has_flow, drift=drift)
    fields = {}
    # Splittings that are not symmetric have order 1.
    if kicks and solver.symmetric and solver.kicks_at_ends:
        fields["forces jump"] = jtu.Partial(forces, kicks, problem.args)
    cure = "Let the function of time return the mean of both sides at a jump"
    if not solver.has_flow:
        cure += ", or pass `BAOAB(ImplicitMidpoint())`, which takes forces within steps"
    return _AtEnds(fields, y0, cure)


def _stages_at_ends(problem: Problem, solver: AbstractSymplecticRungeKutta) -> _AtEnds:
    """The drift and the noise, each if a stage of the tableau evaluates it at the start or
    the end of a step."""
    drift, noise = split_terms(without_constraint(problem.terms))
    stages = solver.tableau.flatten().stages
    # Without a stated weak order, two levels extrapolate by order 1.
    if solver.weak_order(problem.terms) in (1, None):
        stages = ()
    # `stage.c` is the time of a stage, as a fraction of the step.
    stages_at_ends = [stage for stage in stages if stage.c in (0, 1)]
    # Stages with the step size as their control evaluate the drift, all others noise.
    drift_stages = [stage for stage in stages_at_ends if stage.channels == ("h",)]
    has_noise_stages = len(drift_stages) < len(stages_at_ends)
    # Stages that change positions alone evaluate velocities, which do not depend on time.
    has_force_stages = any(stage.writes != "q" for stage in drift_stages)
    fields = {}
    if drift and has_force_stages:
        fields["forces jump"] = jtu.Partial(drift_rate, drift, problem.args)
    if noise and has_noise_stages:
        fields["noise jumps"] = jtu.Partial(noise_change, noise, problem.args)
    cure = "Pass a solver that takes forces and noise within steps, such as "
    cure += "`ImplicitMidpoint()`"
    return _AtEnds(fields, problem.y0, cure)


class _Steps(NamedTuple):
    """The shortest steps of a problem, as many as are looked at.

    - `starts`, `h`: when they start, and how long they are.
    - `near`: a span of time just longer than the rounding errors of times.
    - `far`: a longer span, over which smooth fields still change little.

    A field jumps at a time `t` if it changes far more from just before it to just after it,
    from `t - near` to `t + near`, than from `t - far` to `t - near` and from `t + near` to
    `t + far`.
    """

    starts: Float[np.ndarray, " steps"]
    h: float
    near: float
    far: float

    @property
    def around(self) -> Float[np.ndarray, "4"]:
        """The times at which fields are compared, relative to the time of a jump."""
        return np.array([-self.far, -self.near, self.near, self.far])


def _steps_to_look_at(problem: Problem) -> _Steps | None:
    """The first steps of the finest level; `None` if times are rounded so coarsely that the
    neighbourhood of a jump is a large part of a step, as in single precision long after
    time zero."""
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
    """The times at which the forces or the noise jump within steps, away from their
    ends."""
    # Steps are searched without both ends: a jump that is this near to an end does as
    # little harm as one at the end.
    interior = np.array([steps.far, steps.h - steps.far])
    interiors = (steps.starts[:, None] + interior).astype(problem.dtype)
    # A part of a step is bisected until it is no longer than `near`.
    halvings = max(0, int(np.ceil(np.log2(steps.h / _PARTS_OF_STEP / steps.near))))
    around = steps.around.astype(problem.dtype)
    times, jumps = _search(all_fields(problem), problem.y0, interiors, halvings, around)
    return np.asarray(times)[np.asarray(jumps)]


def _first_jump_at_end(field: Field, problem: Problem, y0: Y) -> float | None:
    """The first end of a step at which a field jumps and does not have the mean of the
    values on both sides; `None` if there is none. The start of the first step is not looked
    at, since paths see only the side after it."""
    if not depends_on_time(field, problem.t0, y0):
        return None
    steps = _steps_to_look_at(problem)
    if steps is None:
        return None
    ends = steps.starts + steps.h
    # Whether an end is the end of the path, which may have more steps than are looked at.
    is_last = np.arange(1, len(ends) + 1) == problem.finest_steps
    # For each end the four times around it, and the end itself.
    times = (ends[:, None] + np.append(steps.around, 0)).astype(problem.dtype)
    jumps = _jumps_at_ends(field, y0, times, is_last)
    return float(ends[np.argmax(jumps)]) if np.any(jumps) else None


def _largest_smooth_change(sides: Float[Array, "4 n"]) -> Float[Array, ""]:
    """The largest change of a field at a time that does not count as a jump: several times
    the changes before and after this time, plus an allowance for rounding. `sides` are the
    values of the field at the times `_Steps.around`."""
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
    """Searches for jumps of a field in time, at most one in each interval:

    1. Choose the intervals over which the field changes most.
    2. Divide each of them into parts, and choose the part over which the field changes
       most. Bisect it `halvings` times, each time into the half over which the field
       changes more. What remains is the time at which the field changes fastest.
    3. The field jumps at this time if its change from just before to just after is too
       large for a smooth field.

    Returns for each chosen interval the time, and whether the field jumps there.

    - `intervals`: the start and the end of each interval.
    - `around`: the times `_Steps.around`."""
    # The field at `y0` and at another state, as one vector for each time.
    values_at = at_both_states(field, y0)

    def changes(times: Float[Array, " times"]) -> Float[Array, " times-1"]:
        """The size of the change from each time to the next."""
        return jnp.linalg.norm(jnp.diff(values_at(times), axis=0), axis=1)

    def with_middle(interval: Float[Array, "2"]) -> Float[Array, "3"]:
        start, end = interval
        return jnp.stack([start, (start + end) / 2, end])

    def largest_change(interval: Float[Array, "2"]) -> Float[Array, ""]:
        """The larger of the changes over both halves of an interval."""
        return jnp.max(changes(with_middle(interval)))

    def half_that_changes_more(_, interval: Float[Array, "2"]) -> Float[Array, "2"]:
        times = with_middle(interval)
        first_change, second_change = changes(times)
        return jnp.where(first_change >= second_change, times[:2], times[1:])

    def jump_in(interval: Float[Array, "2"]) -> tuple[Array, Bool[Array, ""]]:
        """The time at which the field changes fastest, and whether it jumps there."""
        times = jnp.linspace(interval[0], interval[1], _PARTS_OF_STEP + 1)
        # The start and the end of the part that changes most.
        part = times[jnp.argmax(changes(times)) + jnp.arange(2)]
        time = jnp.mean(lax.fori_loop(0, halvings, half_that_changes_more, part))
        sides = values_at(time + around)
        _, just_before, just_after, _ = sides
        change = jnp.linalg.norm(just_after - just_before)
        return time, change > _largest_smooth_change(sides)

    largest_changes = lax.map(largest_change, intervals, batch_size=_STEPS_AT_ONCE)
    num_searched = min(_MOST_STEPS_SEARCHED, len(intervals))
    _, chosen = lax.top_k(largest_changes, num_searched)
    return jax.vmap(jump_in)(intervals[chosen])


@ft.partial(compiled, quickly=True)
def _jumps_at_ends(
    field: Field, y0: Y, times: Float[Array, "ends 5"], is_last: Bool[Array, " ends"]
) -> Bool[Array, " ends"]:
    """For the end of each step, whether a field jumps there, and has a value at the end
    itself with which steps are wrong. The steps before and after the end both take this
    value, so the mean of the values just before and just after the end is right. If no step
    follows, the value just before is right, too.

    - `times`: for each end the four times of `_Steps.around`, and the end itself.
    - `is_last`: whether no step follows."""
    # The field at `y0` and at another state, as one vector for each time.
    values_at = at_both_states(field, y0)

    def jumps_at(end: tuple[Array, Array]) -> Bool[Array, ""]:
        times_of_end, is_last_end = end
        values = values_at(times_of_end)
        _, just_before, just_after, _, at_end = values
        from_mean = jnp.linalg.norm(at_end - (just_before + just_after) / 2)
        from_before = jnp.linalg.norm(at_end - just_before)
        error = jnp.where(is_last_end, jnp.minimum(from_mean, from_before), from_mean)
        # With the value of one side, the error is half of the jump. (If a value is NaN, the
        # comparison is false: that is no jump.)
        return 2 * error > _largest_smooth_change(values[:4])

    return lax.map(jumps_at, (times, is_last), batch_size=_STEPS_AT_ONCE)
