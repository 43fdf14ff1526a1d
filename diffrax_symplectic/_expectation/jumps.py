"""Whether forces or noise jump in time, where two levels do not show what that does."""

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
    drift_field,
    Field,
    force_field,
    noise_field,
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


class _Sides(NamedTuple):
    """A vector field around a time, such as the end of a step.

    - `far_before`, `far_after`: on both sides, as far away as smooth fields change little.
    - `before`, `after`: on both sides, as near as the rounding of times allows.
    """

    far_before: Float[Array, " n"]
    before: Float[Array, " n"]
    after: Float[Array, " n"]
    far_after: Float[Array, " n"]

    @property
    def largest_smooth_change(self) -> Float[Array, ""]:
        """The largest change from `before` to `after` that does not count as a jump:
        several times the changes on both sides, plus an allowance for rounding."""
        change_before = jnp.linalg.norm(self.before - self.far_before)
        change_after = jnp.linalg.norm(self.far_after - self.after)
        size = jnp.linalg.norm(jnp.stack(self))
        rounding = jnp.sqrt(jnp.finfo(size.dtype).eps) * size
        return _JUMP_PER_SMOOTH_CHANGE * (change_before + change_after) + rounding


class _Steps(NamedTuple):
    """The shortest steps of a problem, as many as are looked at.

    - `starts`, `h`: when they start, and how long they are.
    - `near`, `far`: how far before and after a time the fields of `_Sides` are taken.
    """

    starts: Float[np.ndarray, " steps"]
    h: float
    near: float
    far: float


def jumps_within_steps(problem: Problem) -> str | None:
    """What is wrong with forces or noise that jump in time between the ends of the shortest
    steps, as a sentence; `None` if none do.

    Any solver then makes an error of first order. As long as all levels take the jump at
    the same end of a step, this error is the same on all of them, so that they agree. A
    jump whose time is random, with another one for each path, does not count: the errors
    of the paths average out."""
    field = all_fields(problem, problem.args)
    if not depends_on_time(field, problem, problem.y0):
        return None
    steps = _steps_to_look_at(problem)
    if steps is None:
        return None
    times = _times_of_jumps(field, problem, steps)
    # Only jumps that another draw of `args` has, too, are at the same time on all paths.
    if problem.args_of is not None and times.size:
        _, other_args = problem.draw_start(jr.key(2))
        other_field = all_fields(problem, problem.with_args(other_args).args)
        other_times = _times_of_jumps(other_field, problem, steps)
        # (jumps of one draw, jumps of the other)
        are_equal = np.abs(times[:, None] - other_times) < steps.far
        is_in_both = np.any(are_equal, axis=1)
        times = times[is_in_both]
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
    solver = problem.solver
    if isinstance(solver, AbstractLangevinSplitting):
        if not solver.symmetric or not solver.kicks_at_ends:
            return None
        return _jumping_kicks(problem, solver)
    if isinstance(solver, AbstractSymplecticRungeKutta):
        return _jumping_stages(problem, solver)
    return None


def _jumping_kicks(problem: Problem, solver: AbstractLangevinSplitting) -> str | None:
    """`jumps_at_step_ends` for the forces of splittings that begin and end with a kick."""
    terms, y0 = momentum_first(problem.terms, problem.y0)
    drift, _, _ = split_friction(without_constraint(terms))
    kicks, _ = kicks_and_rest(solver.has_flow, drift)
    if not kicks:
        return None
    end = _first_jump_at_end(force_field(kicks, problem.args), problem, y0)
    if end is None:
        return None
    name = type(solver).__name__
    other_cure = ""
    if not solver.has_flow:
        other_cure = (
            ", or pass `BAOAB(ImplicitMidpoint())`, which takes forces within steps"
        )
    return (
        f"The forces jump at step ends, such as t={end:.6g}, and `{name}` takes one side "
        "of the jump for both steps: the mean converges to first order only, and two "
        "levels do not see it. Let the function of time return the mean of both sides at "
        f"a jump{other_cure}."
    )


def _jumping_stages(
    problem: Problem, solver: AbstractSymplecticRungeKutta
) -> str | None:
    """`jumps_at_step_ends` for tableaus."""
    # Two levels extrapolate by the weak order, or by 1 if there is none.
    if solver.weak_order(problem.terms) in (1, None):
        return None
    drift, noise = split_terms(without_constraint(problem.terms))
    stages = solver.tableau.flatten().stages
    stages_at_ends = [stage for stage in stages if stage.c in (0, 1)]
    # The others evaluate noise.
    drift_stages = [stage for stage in stages_at_ends if stage.channels == ("h",)]
    # The fields that are evaluated at ends of steps, by what they would do there.
    fields = {}
    # Stages that move positions alone evaluate velocities, which do not depend on time.
    if drift and any(stage.writes != "q" for stage in drift_stages):
        fields["forces jump"] = drift_field(drift, problem.args)
    if noise and len(drift_stages) < len(stages_at_ends):
        fields["noise jumps"] = noise_field(noise, problem.args)
    for what_happens, field in fields.items():
        end = _first_jump_at_end(field, problem, problem.y0)
        if end is not None:
            return (
                f"The {what_happens} at step ends, such as t={end:.6g}, and "
                f"`{type(solver).__name__}` takes one side of the jump for both steps: the "
                "mean converges to first order only, and two levels do not see it. Pass a "
                "solver that takes forces and noise within steps, such as "
                "`ImplicitMidpoint()`."
            )
    return None


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


def _times_of_jumps(
    field: Field, problem: Problem, steps: _Steps
) -> Float[np.ndarray, " jumps"]:
    """When a field jumps within steps, not at their ends."""
    # Jumps that are nearer than this to an end of a step do as little harm as those at it,
    # so both ends are left out.
    interiors = np.stack(
        [steps.starts + steps.far, steps.starts + steps.h - steps.far], axis=1
    )
    interiors = interiors.astype(problem.dtype)
    # Bisection goes on until a part of a step is no longer than `near`.
    halvings = max(0, int(np.ceil(np.log2(steps.h / _PARTS_OF_STEP / steps.near))))
    near_and_far = np.array([steps.near, steps.far], problem.dtype)
    times, is_jump = _quick_search(field, problem.y0, interiors, halvings, near_and_far)
    return np.asarray(times)[np.asarray(is_jump)]


def _search(
    field: Field,
    y0: Y,
    intervals: Float[Array, "steps 2"],
    halvings: int,
    near_and_far: Float[Array, "2"],
) -> tuple[Float[Array, " searched"], Bool[Array, " searched"]]:
    """For the `intervals`, from a start to an end, in which a field changes most: the time
    at which it changes fastest, and whether it jumps there."""
    at_both = at_both_states(field, y0)
    near, far = near_and_far

    def largest_change(interval: Array) -> Array:
        """The larger of the changes over both halves of an interval."""
        start, end = interval
        values = jax.vmap(at_both)(jnp.stack([start, (start + end) / 2, end]))
        return jnp.max(jnp.linalg.norm(jnp.diff(values, axis=0), axis=1))

    def jump_in(interval: Array) -> tuple[Array, Bool[Array, ""]]:
        def halve(_, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            """The half that changes more of a bracket: two times, and the values there."""
            times, values = bracket
            middle = jnp.mean(times)
            value = at_both(middle)
            changes = jnp.linalg.norm(values - value, axis=1)
            is_first = changes[0] >= changes[1]
            first = jnp.array([times[0], middle]), jnp.stack([values[0], value])
            second = jnp.array([middle, times[1]]), jnp.stack([value, values[1]])
            return jtu.tree_map(lambda x, y: jnp.where(is_first, x, y), first, second)

        times = jnp.linspace(interval[0], interval[1], _PARTS_OF_STEP + 1)
        values = jax.vmap(at_both)(times)
        part = jnp.argmax(jnp.linalg.norm(jnp.diff(values, axis=0), axis=1))
        both_ends = part + jnp.arange(2)
        bracket = times[both_ends], values[both_ends]
        last_times, _ = lax.fori_loop(0, halvings, halve, bracket)
        time = jnp.mean(last_times)
        around = jnp.array([-far, -near, near, far])
        sides = _Sides(*jax.vmap(at_both)(time + around))
        jump = jnp.linalg.norm(sides.after - sides.before)
        return time, jump > sides.largest_smooth_change

    changes = lax.map(largest_change, intervals, batch_size=_STEPS_AT_ONCE)
    _, largest = lax.top_k(changes, min(_MOST_STEPS_SEARCHED, len(intervals)))
    return jax.vmap(jump_in)(intervals[largest])


def _first_jump_at_end(field: Field, problem: Problem, y0: Y) -> float | None:
    """The first end of a step at which a field jumps; `None` if there is none. A jump at
    `t0` does not count: paths see only the side after it."""
    if not depends_on_time(field, problem, y0):
        return None
    steps = _steps_to_look_at(problem)
    if steps is None:
        return None
    ends = steps.starts + steps.h
    is_last = np.arange(1, len(ends) + 1) == problem.finest_steps
    # The times of the four fields of `_Sides`, in their order, and the end itself.
    offsets = np.array([-steps.far, -steps.near, steps.near, steps.far, 0])
    times = (ends[:, None] + offsets).astype(problem.dtype)
    jumps = _quick_jumps_at_ends(field, y0, times, is_last)
    if not np.any(jumps):
        return None
    return float(ends[np.argmax(jumps)])


def _jumps_at_ends(
    field: Field, y0: Y, times: Float[Array, "ends 5"], is_last: Bool[Array, " ends"]
) -> Bool[Array, " ends"]:
    """For the end of each step, whether a field jumps there, and does not have the mean of
    both sides as its value, which would be right. `times` are those of the fields of
    `_Sides` and the end itself."""
    at_both = at_both_states(field, y0)

    def jumps_at(end: tuple[Array, Array]) -> Bool[Array, ""]:
        times, is_last = end
        *side_values, value = jax.vmap(at_both)(times)
        sides = _Sides(*side_values)
        off_mean = jnp.linalg.norm(value - (sides.before + sides.after) / 2)
        # No step follows the last end, so the value of the side before is right there, too.
        off_before = jnp.linalg.norm(value - sides.before)
        error = jnp.where(is_last, jnp.minimum(off_mean, off_before), off_mean)
        # A field with the value of one side is off the mean by half of its jump. (With a
        # NaN among the values, the comparison is false: that is no jump.)
        return 2 * error > sides.largest_smooth_change

    return lax.map(jumps_at, (times, is_last), batch_size=_STEPS_AT_ONCE)


_quick_search = compiled(_search, quickly=True)
_quick_jumps_at_ends = compiled(_jumps_at_ends, quickly=True)
