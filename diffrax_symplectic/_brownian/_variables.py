"""The random variables of a step: a record of each, for solvers, conditions and
suggestions."""

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
        """Such a path within a wrapper; `code` is a template for both."""
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
# Wrappers draw other random words from the same key.
_LEVY_AREA = _AREA.within(LevyAreaBrownianPath, "LevyAreaBrownianPath({}, key)")
_PLATEAUS = _AREA.within(PlateauBrownianPath, "PlateauBrownianPath({}, key)")


class RandomVariable(NamedTuple):
    """One random variable of a step for each noise (or for each pair of noises).

    - `increment`: the type of increments that contain it.
    - `name`: its name in messages.
    - `path`: a path that has it.
    - `variance`: in units of the step size, the same for all laws; `None` if it has no law
        of its own.
    - `even`: whether it is unchanged when time runs backward, although Diffrax negates all
        random variables.
    - `drives`: the vector fields that it multiplies: the noise, the brackets between
        noises, or their brackets with the drift.
    - `held`: if it is not an attribute of the increment itself, the attributes from which
        it is computed, and optional attributes that are used if present.
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
        """Its name, and how to get it."""
        return f"{self.name}. Pass `solver.path(shape, key)`, or `{self.path.code}`"


_area = ft.partial(
    RandomVariable, diffrax.AbstractSpaceTimeLevyArea, "space-time Lévy area", _AREA
)
_plateau = ft.partial(RandomVariable, PlateauIncrement, "plateaus", _PLATEAUS)

# By the attribute of the increment. Variables whose increments contain the most come first:
# messages name missing variables in this order.
VARIABLES = {
    "A": RandomVariable(
        LevyAreaIncrement, "Lévy areas", _LEVY_AREA, None, drives="noise brackets"
    ),
    "C": _plateau(1 / 6),
    # The sign of `C`. Only the sign is drawn: the size is a function of `W` and `H`.
    "sign": _plateau(1.0),
    "L": _area(None, even=True, drives="drift brackets", held=(("W", "H"), ("K",))),
    # The time-reversed bridge has the same integral.
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
    """The `drives` of the random variable of this name. Unknown variables drive the vector
    fields of the noise."""
    return VARIABLES[name].drives if name in VARIABLES else "noise"


def path_of(variables: Collection[str], *, gaussian: bool, bounded: bool) -> PathKind:
    """The path with these random variables. If only increments are needed, they may be
    `gaussian`, and then also `bounded`, for implicit methods."""
    for name, variable in VARIABLES.items():
        if name in variables and (name != "W" or not gaussian):
            return variable.path
    return _TRUNCATED if bounded else _GAUSSIAN
