"""Whether forces or noise change in time too fast for the steps."""

import jax
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


# The most times that are looked at, spread over the interval: a pulse is seen if it is
# longer than the time between them. Fewer for large systems, so that no more than so many
# numbers are computed, in some tenths of a second; but so many in each step.
_MOST_TIMES = 2**16
_MOST_NUMBERS = 2**22
_TIMES_IN_STEP = 16
_FEWEST_STEPS = 2**6
# How far fields depart from straight lines over a step, as a part of their whole change in
# it, in the root mean square. A drive of frequency Omega reaches this at Omega h = 3.5 to
# 4.1, with many and with 16 times in a step.
# Measured on a damped oscillator that is driven at random phases, by `BAOAB` and the
# midpoint rule: up to 4, for the shorter of two steps, one mean in twenty is more than two
# error bars off; beyond, up to nineteen in twenty, by a thousand bars and more.
_UNRESOLVED = 1.0
# Changes of less than this part of a field are too small to look at.
_SMALL = 1e-3


def unresolved_drive(problem: Problem) -> str | None:
    """What is wrong with forces or noise that change in time many times in a step, as a
    sentence; `None` if they do not.

    If all steps are multiples of a period, no level sees that anything changes."""
    # Where a field changes at random times of each path, these fill the steps.
    if problem.args_of is not None:
        return None
    field = all_fields(problem, problem.args)
    if not depends_on_time(field, problem, problem.y0):
        return None
    h = float(problem.levels.h[-1])
    size = problem.num_components
    most_times = min(_MOST_TIMES, _MOST_NUMBERS // max(size, 1))
    most_steps = max(_FEWEST_STEPS, most_times // _TIMES_IN_STEP)
    numbers = np.arange(problem.finest_steps)
    if len(numbers) > most_steps:
        spread = spread_evenly(most_steps) * problem.finest_steps
        numbers = np.unique(np.floor(spread))
    times_in_step = max(_TIMES_IN_STEP, most_times // len(numbers))
    # Not the start of a step, which is the end of the one before.
    fractions = np.sort(spread_evenly(times_in_step + 1)[1:])
    times = float(problem.t0) + h * (numbers[:, None] + fractions)
    departure = _quick_departure(field, problem.y0, times.astype(problem.dtype))
    if not float(departure) > _UNRESOLVED:
        return None
    return (
        f"The forces or the noise change in time too fast for steps of {h:.3g}, the "
        "shortest of all levels. Where a pulse is shorter than a step, or a step is a "
        "multiple of a period, no level may see it, and all agree on a wrong mean. Pass a "
        "`dt0` below a third of the pulse or period."
    )


def _departure(
    field: Field, y0: Y, times: Float[Array, "steps times"]
) -> Float[Array, ""]:
    """How far a field departs from a straight line over each step, as a part of its change
    in it; zero if it changes little."""
    at_both = at_both_states(field, y0)

    def squares(times: Float[Array, " times"]) -> Float[Array, "3"]:
        """Of the departure, of the change, and of the field."""
        values = jax.vmap(at_both)(times)
        fractions = (times - times[0]) / (times[-1] - times[0])
        line = values[0] + fractions[:, None] * (values[-1] - values[0])
        departure = jnp.sum((values - line) ** 2)
        change = jnp.sum((values - jnp.mean(values, axis=0)) ** 2)
        return jnp.stack([departure, change, jnp.sum(values**2)])

    departure, change, size = jnp.sum(lax.map(squares, times), axis=0)
    is_small = change <= _SMALL**2 * size
    return jnp.where(is_small, 0, jnp.sqrt(departure / change))


_quick_departure = compiled(_departure, quickly=True)
