"""Whether forces or noise change in time too fast for the steps.

A field here is a vector field of the problem, as a function of time and state. It is
compared, at many times within each step, with a straight line.
"""

import functools as ft

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._custom_types import Y
from .._programs import compiled
from .._simulation import Problem
from .fields_in_time import (
    all_fields,
    at_both_states,
    depends_on_time,
    Field,
    spread_evenly,
)


# The most times that are looked at, spread over the interval. A pulse is seen if it is
# longer than the time between two of them.
_MOST_TIMES = 2**16
# The most numbers that are computed, which takes some tenths of a second: of large systems
# fewer times are looked at.
_MOST_NUMBERS = 2**22
# Whatever the size of the system, at least this many times are looked at in a step, and at
# least this many steps, or all if there are fewer.
_FEWEST_TIMES_IN_STEP = 16
_FEWEST_STEPS = 2**6
# Over each step, a field departs from a straight line, and from its mean over the step.
# Steps do not resolve the field if the first departure is more than this multiple of the
# second, in the root mean square. A drive of angular frequency Omega reaches this multiple
# at Omega h = 3.4 with many times in a step, and at 4.2 with 16 times.
# Measured on a damped oscillator that is driven at random phases, by `BAOAB` and the
# midpoint rule: if Omega h is up to 4, for the shorter of two steps, one mean in twenty is
# more than two error bars off. Beyond, up to nineteen in twenty are, by a thousand bars and
# more.
_MOST_DEPARTURE = 1.0
# Changes of less than this fraction of a field are too small to matter.
_SMALL_CHANGE = 1e-3


def unresolved_drive(problem: Problem) -> str | None:
    """A warning if forces or noise change in time so fast that steps do not resolve them;
    `None` if steps do.

    Levels then need not show an error. For example, if all steps are multiples of a period,
    no level sees any change."""
    # If each path draws its own `args`, changes come at other times on each path. A step
    # misses the changes of some paths and not of others, so levels do not agree on a wrong
    # mean.
    if problem.args_of is not None:
        return None
    field = all_fields(problem)
    if not depends_on_time(field, problem.t0, problem.y0):
        return None
    departure = _departure(field, problem.y0, _times_in_steps(problem))
    # A departure that is NaN gives no warning.
    if not float(departure) > _MOST_DEPARTURE:
        return None
    h = float(problem.levels.h[-1])
    return (
        f"The forces or the noise change in time too fast for steps of {h:.3g}, the "
        "shortest of all levels. Where a pulse is shorter than a step, or a step is a "
        "multiple of a period, no level may see it, and all agree on a wrong mean. Pass a "
        "`dt0` below a third of the pulse or period."
    )


def _times_in_steps(problem: Problem) -> Float[np.ndarray, "steps times"]:
    """The times to look at, with a row for each step: many in each of the shortest steps,
    or if there are too many of these, in some from all over the interval."""
    # The most times of all steps together.
    most_times = min(_MOST_TIMES, _MOST_NUMBERS // max(problem.num_components, 1))
    most_steps = max(_FEWEST_STEPS, most_times // _FEWEST_TIMES_IN_STEP)
    step_numbers = np.arange(problem.finest_steps)
    if len(step_numbers) > most_steps:
        spread = spread_evenly(most_steps) * problem.finest_steps
        step_numbers = np.unique(np.floor(spread))
    times_in_step = max(_FEWEST_TIMES_IN_STEP, most_times // len(step_numbers))
    # Times within a step, as fractions of it. The first point, which is the start of the
    # step, is left out: a jump there would belong to the step before.
    fractions = np.sort(spread_evenly(times_in_step + 1)[1:])
    # Time in units of a step, counted from `t0`.
    in_steps = step_numbers[:, None] + fractions
    times = float(problem.t0) + float(problem.levels.h[-1]) * in_steps
    return times.astype(problem.dtype)


@ft.partial(compiled, quickly=True)
def _departure(
    field: Field, y0: Y, times: Float[Array, "steps times"]
) -> Float[Array, ""]:
    """The departure of a field from a straight line over each step, divided by its
    departure from its mean over the step, both in the root mean square over all steps; zero
    if the field changes little. The line joins the values at the first and the last of the
    `times` in a step. If steps resolve the field, it is almost a straight line over each,
    and the result is small."""
    # The field at `y0` and at another state, as one vector for each time.
    values_at = at_both_states(field, y0)

    def squares(times: Float[Array, " times"]) -> Float[Array, "3"]:
        """The sums of squares of both departures and of the field, over one step."""
        values = values_at(times)
        fractions = (times - times[0]) / (times[-1] - times[0])
        line = values[0] + fractions[:, None] * (values[-1] - values[0])
        from_line = jnp.sum((values - line) ** 2)
        from_mean = jnp.sum((values - jnp.mean(values, axis=0)) ** 2)
        return jnp.stack([from_line, from_mean, jnp.sum(values**2)])

    from_line, from_mean, of_field = jnp.sum(lax.map(squares, times), axis=0)
    is_small = from_mean <= _SMALL_CHANGE**2 * of_field
    return jnp.where(is_small, 0, jnp.sqrt(from_line / from_mean))
