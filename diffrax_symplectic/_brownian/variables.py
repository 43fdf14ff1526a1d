"""The random variables of a step: a record of each, for solvers, conditions and
suggestions."""

import functools as ft
from collections.abc import Callable, Collection
from typing import Any, Literal, NamedTuple, TypeAlias

import diffrax
from jaxtyping import PRNGKeyArray

from .levy_area import LevyAreaBrownianPath, LevyAreaIncrement
from .paths import FixedStepBrownianPath, WeakBrownianPath, WeakIncrement
from .wrappers import PlateauBrownianPath, PlateauIncrement, TruncatedBrownianPath


# Makes a Brownian path of a shape from a key.
_MakePath: TypeAlias = Callable[[Any, PRNGKeyArray], diffrax.AbstractBrownianPath]

_AREA = ft.partial(FixedStepBrownianPath, levy_area=diffrax.SpaceTimeLevyArea)


def _truncated(shape, key) -> TruncatedBrownianPath:
    return TruncatedBrownianPath(FixedStepBrownianPath(shape, key))


# Wrappers draw other random words from the same key.
def _with_levy_areas(shape, key) -> LevyAreaBrownianPath:
    return LevyAreaBrownianPath(_AREA(shape, key), key)


def _with_plateaus(shape, key) -> PlateauBrownianPath:
    return PlateauBrownianPath(_AREA(shape, key), key)


class RandomVariable(NamedTuple):
    """One random variable of a step for each noise (or for each pair of noises).

    - `increment`: the type of increments that contain it.
    - `name`: its name in messages.
    - `path`: makes a path that has it.
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
    path: _MakePath
    variance: float | None = 1.0
    even: bool = False
    drives: Literal["noise", "noise brackets", "drift brackets"] = "noise"
    held: tuple[tuple[str, ...], tuple[str, ...]] | None = None

    @property
    def advice(self) -> str:
        """Its name, and how to get it."""
        return f"{self.name}. Make its path by `solver.path(shape, key)`"


_area = ft.partial(
    RandomVariable, diffrax.AbstractSpaceTimeLevyArea, "space-time Lévy area", _AREA
)
_plateau = ft.partial(RandomVariable, PlateauIncrement, "plateaus", _with_plateaus)

# By the attribute of the increment. Variables whose increments contain the most come first:
# messages name missing variables in this order.
VARIABLES = {
    "A": RandomVariable(
        LevyAreaIncrement, "Lévy areas", _with_levy_areas, None, drives="noise brackets"
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
        ft.partial(WeakBrownianPath, order=3),
    ),
    "second": RandomVariable(
        WeakIncrement,
        "a second set of three-point variables",
        ft.partial(WeakBrownianPath, second=True),
    ),
    "two_point": RandomVariable(
        WeakIncrement,
        "two-point variables",
        ft.partial(WeakBrownianPath, two_point=True),
    ),
    "W": RandomVariable(
        diffrax.AbstractBrownianIncrement,
        "the increment of a Brownian path",
        WeakBrownianPath,
    ),
}


def drives(name: str) -> str:
    """The `drives` of the random variable of this name. Unknown variables drive the vector
    fields of the noise."""
    return VARIABLES[name].drives if name in VARIABLES else "noise"


def path_of(variables: Collection[str], *, gaussian: bool, bounded: bool) -> _MakePath:
    """Makes a path with these random variables. If only increments are needed, they may be
    `gaussian`, and then also `bounded`, for implicit methods."""
    for name, variable in VARIABLES.items():
        if name in variables and (name != "W" or not gaussian):
            return variable.path
    return _truncated if bounded else FixedStepBrownianPath
