"""The random variables of a step: one record for each, which the solvers, conditions and
suggestions read."""

import functools as ft
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

    def within(self, wrapper: Callable, code: str) -> "PathKind":
        """Such a path within another; `code` is what comes before and after it."""
        make = lambda shape, key: wrapper(self.make(shape, key), key)
        return PathKind(code.format(self.code), make)


def _weak(more: str, **kwargs) -> PathKind:
    code = f"WeakBrownianPath(shape, key{more})"
    return PathKind(code, ft.partial(WeakBrownianPath, **kwargs))


_GAUSSIAN = PathKind("FixedStepBrownianPath(shape, key)", FixedStepBrownianPath)
_AREA = PathKind(
    "FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)",
    ft.partial(FixedStepBrownianPath, levy_area=diffrax.SpaceTimeLevyArea),
)
_TRUNCATED = _GAUSSIAN.within(
    lambda path, key: TruncatedBrownianPath(path), "TruncatedBrownianPath({})"
)
# Wrappers draw random words of their own from the same key.
_LEVY_AREA = _AREA.within(LevyAreaBrownianPath, "LevyAreaBrownianPath({}, key)")
_PLATEAUS = _AREA.within(PlateauBrownianPath, "PlateauBrownianPath({}, key)")


class RandomVariable(NamedTuple):
    """One random variable of a step for each noise (or for each pair of noises).

    - `increment`: the increments that hold it.
    - `name`: what it is called.
    - `path`: a path that has it.
    - `variance`: in units of the step size, the same for all laws; `None` if it has no law
        of its own.
    - `even`: whether it stays the same when time runs backward, where Diffrax changes the
        sign of all.
    - `drives`: what it multiplies: the vector fields of the noise, the brackets between
        them, or their brackets with the drift.
    - `held`: if it is not an attribute of the increment itself, the attributes that it is
        computed from, and those that are used if the increment has them.
    """

    increment: type[diffrax.AbstractBrownianIncrement]
    name: str
    path: PathKind
    variance: float | None = 1.0
    even: bool = False
    drives: Literal["noise", "noise brackets", "drift brackets"] = "noise"
    held: tuple[tuple[str, ...], tuple[str, ...]] | None = None

    @property
    def advice(self) -> str:
        """What it is called, and how to get it."""
        return f"{self.name}. Pass `solver.path(shape, key)`, or `{self.path.code}`"


_area = ft.partial(
    RandomVariable, diffrax.AbstractSpaceTimeLevyArea, "space-time Lévy area", _AREA
)
_plateau = ft.partial(RandomVariable, PlateauIncrement, "plateaus", _PLATEAUS)

# By the attribute of the increment that holds the variable. Variables whose increments hold
# most come first: that is the order in which missing ones are named.
VARIABLES = {
    "A": RandomVariable(
        LevyAreaIncrement, "Lévy areas", _LEVY_AREA, None, drives="noise brackets"
    ),
    "C": _plateau(1 / 6),
    # The sign of `C`, which alone is drawn: its size is a function of `W` and `H`.
    "sign": _plateau(1.0),
    "L": _area(None, even=True, drives="drift brackets", held=(("W", "H"), ("K",))),
    # The bridge from the end of the step to its start has the same integral.
    "H": _area(1 / 12, even=True),
    "third": RandomVariable(
        WeakIncrement,
        "four-point variables and two more sets",
        _weak(", order=3", order=3),
    ),
    "second": RandomVariable(
        WeakIncrement,
        "a second set of three-point variables",
        _weak(", second=True", second=True),
    ),
    "two_point": RandomVariable(
        WeakIncrement, "two-point variables", _weak(", two_point=True", two_point=True)
    ),
    "W": RandomVariable(
        diffrax.AbstractBrownianIncrement, "the increment of a Brownian path", _weak("")
    ),
}


def drives(name: str) -> str:
    """What the random variable of this name multiplies. Variables of other increments
    multiply the vector fields of the noise."""
    return VARIABLES[name].drives if name in VARIABLES else "noise"


def path_of(variables: Collection[str], *, gaussian: bool, bounded: bool) -> PathKind:
    """The path with these random variables. If they are increments alone, it may have to be
    `gaussian`, and then also `bounded`, for implicit equations."""
    for name, variable in VARIABLES.items():
        if name in variables and (name != "W" or not gaussian):
            return variable.path
    return _TRUNCATED if bounded else _GAUSSIAN
