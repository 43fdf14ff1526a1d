"""The random variables of a step: one record for each says all that others need to know,
the path that holds them among it."""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import diffrax
from jaxtyping import PRNGKeyArray

from ._levy_area import LevyAreaBrownianPath, LevyAreaIncrement
from ._paths import FixedStepBrownianPath, WeakBrownianPath, WeakIncrement
from ._wrappers import PlateauBrownianPath, PlateauIncrement, TruncatedBrownianPath


class PathKind(NamedTuple):
    """A way to make Brownian paths, as code and as a function of a shape and a key."""

    code: str
    make: Callable[[Any, PRNGKeyArray], diffrax.AbstractBrownianPath]


def _weak(**kwargs) -> PathKind:
    more = "".join(f", {name}={value}" for name, value in kwargs.items())
    make = lambda shape, key: WeakBrownianPath(shape, key, **kwargs)
    return PathKind(f"WeakBrownianPath(shape, key{more})", make)


def _around(wrapper: type, path: PathKind, *, keys: int = 1) -> PathKind:
    # Wrappers that draw more take their own random words of the same key.
    make = lambda shape, key: wrapper(path.make(shape, key), *[key] * keys)
    code = ", ".join([path.code, *["key"] * keys])
    return PathKind(f"{wrapper.__name__}({code})", make)


_GAUSSIAN = PathKind("FixedStepBrownianPath(shape, key)", FixedStepBrownianPath)
_AREA = PathKind(
    "FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)",
    lambda shape, key: FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea),
)
_TRUNCATED = _around(TruncatedBrownianPath, _GAUSSIAN, keys=0)
_PLATEAUS = _around(PlateauBrownianPath, _AREA)


class RandomVariable(NamedTuple):
    """One random variable of a step for each noise (or for each pair of noises).

    - `increment`: the increments that hold it.
    - `name`: what it is called.
    - `path`: a path that has it.
    - `variance`: in units of the step size, whichever law of the path it has; `None` if
        it has no law of its own.
    - `even`: whether it stays the same when time runs backward. Diffrax changes the sign
        of all.
    """

    increment: type[diffrax.AbstractBrownianIncrement]
    name: str
    path: PathKind
    variance: float | None
    even: bool = False

    @property
    def advice(self) -> str:
        """What it is called, and how to get it."""
        return f"{self.name}. Pass `solver.path(shape, key)`, or `{self.path.code}`"


# By the attribute of the increment that holds the variable. A variable comes before another
# one if its increments hold more: that is the order in which missing ones are named.
VARIABLES = {
    "A": RandomVariable(
        LevyAreaIncrement,
        "Lévy areas",
        _around(LevyAreaBrownianPath, _AREA),
        variance=None,
    ),
    "C": RandomVariable(PlateauIncrement, "plateaus", _PLATEAUS, variance=1 / 6),
    # The sign of `C`, which alone is drawn: its size is a function of `W` and `H`.
    "sign": RandomVariable(PlateauIncrement, "plateaus", _PLATEAUS, variance=1.0),
    # No increment has this attribute. It is computed from `W`, `H` and, if there is one,
    # from `K`.
    "L": RandomVariable(
        diffrax.AbstractSpaceTimeLevyArea,
        "space-time Lévy area",
        _AREA,
        variance=None,
    ),
    "H": RandomVariable(
        diffrax.AbstractSpaceTimeLevyArea,
        "space-time Lévy area",
        _AREA,
        variance=1 / 12,
        # The bridge from the end of the step to its start has the same integral.
        even=True,
    ),
    "third": RandomVariable(
        WeakIncrement,
        "four-point variables and two more sets",
        _weak(order=3),
        variance=1.0,
    ),
    "second": RandomVariable(
        WeakIncrement,
        "a second set of three-point variables",
        _weak(second=True),
        variance=1.0,
    ),
    "two_point": RandomVariable(
        WeakIncrement, "two-point variables", _weak(two_point=True), variance=1.0
    ),
    "W": RandomVariable(
        diffrax.AbstractBrownianIncrement,
        "the increment of a Brownian path",
        _weak(),
        variance=1.0,
    ),
}


def path_of(variables: Collection[str], *, gaussian: bool, bounded: bool) -> PathKind:
    """The path with these random variables. Where the increment alone is needed there is a
    choice: it may have to be `gaussian`, and then `bounded`, for equations that have to be
    solved."""
    for name, variable in VARIABLES.items():
        if name in variables and (name != "W" or not gaussian):
            return variable.path
    return _TRUNCATED if bounded else _GAUSSIAN
