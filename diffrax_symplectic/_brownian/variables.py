"""The random variables of a step, with the facts about each that solvers, conditions on
tableaus and suggestions need."""

import functools as ft
from collections.abc import Callable, Collection
from typing import Any, Literal, NamedTuple, TypeAlias

import diffrax
from jaxtyping import PRNGKeyArray

from .levy_area import LevyAreaBrownianPath, LevyAreaIncrement
from .paths import FixedStepBrownianPath, WeakBrownianPath, WeakIncrement
from .wrappers import PlateauBrownianPath, PlateauIncrement, TruncatedBrownianPath


# Makes a Brownian path from a shape and a key.
_MakePath: TypeAlias = Callable[[Any, PRNGKeyArray], diffrax.AbstractBrownianPath]

_path_with_space_time_area = ft.partial(
    FixedStepBrownianPath, levy_area=diffrax.SpaceTimeLevyArea
)


def _truncated_path(shape: Any, key: PRNGKeyArray) -> TruncatedBrownianPath:
    return TruncatedBrownianPath(FixedStepBrownianPath(shape, key))


# A wrapper and its path may share a key: they draw different random words from it.
def _path_with_levy_areas(shape: Any, key: PRNGKeyArray) -> LevyAreaBrownianPath:
    return LevyAreaBrownianPath(_path_with_space_time_area(shape, key), key)


def _path_with_plateaus(shape: Any, key: PRNGKeyArray) -> PlateauBrownianPath:
    return PlateauBrownianPath(_path_with_space_time_area(shape, key), key)


class RandomVariable(NamedTuple):
    """Facts about a random variable that a step has for each noise, or for each pair of
    noises.

    - `increment`: the type of increments that contain the variable.
    - `name`: its name in messages.
    - `path`: makes a path that has the variable.
    - `rank`: a path with a variable of higher rank also has those of lower rank that a
        solver may need with it. So the highest rank decides which path a solver needs.
    - `variance`: the variance in units of the step size, which is the same for all laws
        that the variable may have; `None` if it has no law independent of the others.
    - `even`: whether the variable is unchanged if the path is reversed in time. (In a solve
        backward in time Diffrax negates all random variables, even ones, too.)
    - `drives`: the vector fields that the variable multiplies: those of the noise, the
        brackets between noises, or the brackets of noises with the drift.
    """

    increment: type[diffrax.AbstractBrownianIncrement]
    name: str
    path: _MakePath
    rank: int
    variance: float | None = 1.0
    even: bool = False
    drives: Literal["noise", "noise brackets", "drift brackets"] = "noise"

    @property
    def advice(self) -> str:
        """The end of a message: the name of the variable, and how to get a path with it."""
        return f"{self.name}. Make its path by `solver.path(shape, key)`"


# `H` and `L` belong to the same increment and path, and so do `C` and `sign`. These
# functions make their records, and hold what the two records have in common.
_area = ft.partial(
    RandomVariable,
    increment=diffrax.AbstractSpaceTimeLevyArea,
    name="space-time Lévy area",
    path=_path_with_space_time_area,
    rank=4,
)
_plateau = ft.partial(
    RandomVariable,
    increment=PlateauIncrement,
    name="plateaus",
    path=_path_with_plateaus,
    rank=5,
)

# All random variables, by name. Each but `L` is an attribute of the increment.
VARIABLES = {
    "A": RandomVariable(
        increment=LevyAreaIncrement,
        name="Lévy areas",
        path=_path_with_levy_areas,
        rank=6,
        # The law of the areas is known only given `W` and `H`.
        variance=None,
        drives="noise brackets",
    ),
    "C": _plateau(variance=1 / 6),
    # The sign of `C`. Only the sign is drawn: the size of `C` is a function of `W` and `H`.
    "sign": _plateau(variance=1.0),
    "L": _area(
        # `L` is a quadratic form in `W`, `H` and, if the increment has it, `K`.
        variance=None,
        even=True,
        drives="drift brackets",
    ),
    # A Brownian bridge that is reversed in time has the same integral.
    "H": _area(variance=1 / 12, even=True),
    "third": RandomVariable(
        increment=WeakIncrement,
        name="four-point variables and two sets of three-point ones beside them",
        path=ft.partial(WeakBrownianPath, order=3),
        rank=3,
    ),
    "second": RandomVariable(
        increment=WeakIncrement,
        name="a second set of three-point variables",
        path=ft.partial(WeakBrownianPath, second=True),
        rank=2,
    ),
    "two_point": RandomVariable(
        increment=WeakIncrement,
        name="two-point variables",
        path=ft.partial(WeakBrownianPath, two_point=True),
        rank=1,
    ),
    "W": RandomVariable(
        increment=diffrax.AbstractBrownianIncrement,
        name="the increment of a Brownian path",
        path=WeakBrownianPath,
        rank=0,
    ),
}


def drives(name: str) -> str:
    """What the random variable of this name multiplies, as in `RandomVariable.drives`.
    Variables that are not known here multiply the noise."""
    return VARIABLES[name].drives if name in VARIABLES else "noise"


def most_demanding_variable(names: Collection[str]) -> RandomVariable | None:
    """The random variable of the highest rank among these, or `None` if none of them is
    known here."""
    # A user's solver may have variables that are not known here.
    variables = [VARIABLES[name] for name in names if name in VARIABLES]
    return max(variables, key=lambda variable: variable.rank, default=None)


def path_maker(
    variables: Collection[str], *, gaussian: bool, bounded: bool
) -> _MakePath:
    """A function of a shape and a key that makes a path with these random variables:

    - with any variable but the increment `"W"`, the path that has the most demanding one;
    - with `"W"` alone, a discrete path, or if `gaussian` a Gaussian path, which is
        truncated if `bounded`, as for implicit methods.
    """
    # The path of `"W"` in `VARIABLES` is the discrete one. So it is left out if increments
    # are to be Gaussian.
    names = set(variables) - {"W"} if gaussian else variables
    variable = most_demanding_variable(names)
    if variable is not None:
        return variable.path
    return _truncated_path if bounded else FixedStepBrownianPath
