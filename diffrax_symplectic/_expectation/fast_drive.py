"""Whether forces or noise change in time too fast for the steps."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._compat import quickly_compiled
from .._custom_types import Y
from .._simulation import Problem
from .fields_in_time import all_fields, at_both_states, depends_on_time, Field


# The most steps that are looked at, spread over the interval, and at how many times within
# each. Multiples of the golden ratio, without their whole parts, fill an interval evenly,
# and no period repeats in step with them.
_STEPS = 256
_TIMES = 8
_GOLDEN_RATIO = (1 + 5**0.5) / 2
# How far fields depart from straight lines over a step, as a part of their whole change in
# it, in the root mean square. A drive of frequency Omega reaches this at Omega h = 3.7.
# Measured on a damped oscillator that is driven at random phases, by `BAOAB` and the
# midpoint rule: up to 4, for the shorter of two steps, one mean in twenty is more than two
# error bars off; beyond, up to nineteen in twenty, by a thousand bars and more.
_UNRESOLVED = 0.9
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
    fractions = np.sort(np.arange(1, _TIMES + 1) * _GOLDEN_RATIO % 1)
    numbers = np.floor(np.arange(_STEPS) * _GOLDEN_RATIO % 1 * problem.finest_steps)
    numbers = np.unique(numbers)
    times = float(problem.t0) + h * (numbers[:, None] + fractions)
    departure = _quick_departure(field, problem.y0, times.astype(problem.dtype))
    if not float(departure) > _UNRESOLVED:
        return None
    return (
        f"The forces or the noise change in time too fast for steps of {h:.3g}, the "
        "shortest of all levels. If a step is a multiple of a period, no level sees any "
        "change, and all agree on a wrong mean. Pass a `dt0` below a third of the period."
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


_quick_departure = quickly_compiled(_departure)
