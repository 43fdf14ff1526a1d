"""The random variables of a step: one record for each says all that others need to know,
the path that holds them among it."""

from collections.abc import Callable, Collection
from typing import Any, Literal, NamedTuple

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
    - `drives`: what it multiplies: the vector fields of the noise, the brackets between
        them, or their brackets with the drift.
    - `held`: the attributes of the increment that it is computed from, if it is not an
        attribute itself; and those that are read if the increment holds them.
    """

    increment: type[diffrax.AbstractBrownianIncrement]
    name: str
    path: PathKind
    variance: float | None
    even: bool = False
    drives: Literal["noise", "noise brackets", "drift brackets"] = "noise"
    held: tuple[tuple[str, ...], tuple[str, ...]] | None = None

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
        drives="noise brackets",
    ),
    "C": RandomVariable(PlateauIncrement, "plateaus", _PLATEAUS, variance=1 / 6),
    # The sign of `C`, which alone is drawn: its size is a function of `W` and `H`.
    "sign": RandomVariable(PlateauIncrement, "plateaus", _PLATEAUS, variance=1.0),
    "L": RandomVariable(
        diffrax.AbstractSpaceTimeLevyArea,
        "space-time Lévy area",
        _AREA,
        variance=None,
        even=True,
        drives="drift brackets",
        held=(("W", "H"), ("K",)),
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


def drives(name: str) -> str:
    """What the random variable of this name multiplies. Variables of a user's own
    increments multiply the vector fields of the noise."""
    return VARIABLES[name].drives if name in VARIABLES else "noise"


def path_of(variables: Collection[str], *, gaussian: bool, bounded: bool) -> PathKind:
    """The path with these random variables. Where the increment alone is needed there is a
    choice: it may have to be `gaussian`, and then `bounded`, for equations that have to be
    solved."""
    for name, variable in VARIABLES.items():
        if name in variables and (name != "W" or not gaussian):
            return variable.path
    return _TRUNCATED if bounded else _GAUSSIAN
