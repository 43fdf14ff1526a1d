"""The random variables of a step: one record for each says all that others need to know."""

from typing import NamedTuple

import diffrax

from ._levy_area import LevyAreaIncrement
from ._paths import WeakIncrement
from ._wrappers import PlateauIncrement


class RandomVariable(NamedTuple):
    """One random variable of a step for each noise (or for each pair of noises).

    - `increment`: the increments that hold it.
    - `advice`: what it is called, and how to ask for increments that hold it.
    - `variance`: in units of the step size, whichever law of the path it has; `None` if
        it has no law of its own.
    - `even`: whether it stays the same when time runs backward. Diffrax changes the sign
        of all.
    """

    increment: type[diffrax.AbstractBrownianIncrement]
    advice: str
    variance: float | None
    even: bool = False


_SPACE_TIME_AREA = (
    "space-time Lévy area. Pass a path that has it, for example "
    "`FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`"
)
_PLATEAUS = (
    "plateaus. Wrap a path with space-time Lévy area as `PlateauBrownianPath(path, "
    "key)`"
)
# By the attribute of the increment that holds the variable. A variable comes before another
# one if its increments hold more: that is the order in which missing ones are named.
VARIABLES = {
    "A": RandomVariable(
        LevyAreaIncrement,
        "Lévy areas. Wrap a path with space-time Lévy area as `LevyAreaBrownianPath(path, "
        "key)`",
        variance=None,
    ),
    "C": RandomVariable(PlateauIncrement, _PLATEAUS, variance=1 / 6),
    # The sign of `C`, which alone is drawn: its size is a function of `W` and `H`.
    "sign": RandomVariable(PlateauIncrement, _PLATEAUS, variance=1.0),
    # No increment has this attribute. It is computed from `W`, `H` and, if there is one,
    # from `K`.
    "L": RandomVariable(
        diffrax.AbstractSpaceTimeLevyArea, _SPACE_TIME_AREA, variance=None
    ),
    "H": RandomVariable(
        diffrax.AbstractSpaceTimeLevyArea,
        _SPACE_TIME_AREA,
        variance=1 / 12,
        # The bridge from the end of the step to its start has the same integral.
        even=True,
    ),
    "third": RandomVariable(
        WeakIncrement,
        "four-point variables and two more sets. Construct the path as "
        "`WeakBrownianPath(..., order=3)`",
        variance=1.0,
    ),
    "second": RandomVariable(
        WeakIncrement,
        "a second set of three-point variables. Construct the path as "
        "`WeakBrownianPath(..., second=True)`",
        variance=1.0,
    ),
    "two_point": RandomVariable(
        WeakIncrement,
        "two-point variables. Construct the path as `WeakBrownianPath(..., "
        "two_point=True)`",
        variance=1.0,
    ),
    "W": RandomVariable(
        diffrax.AbstractBrownianIncrement,
        "the increment of a Brownian path. Pass `WeakBrownianPath(shape, key)` or "
        "`FixedStepBrownianPath(shape, key)`",
        variance=1.0,
    ),
}
