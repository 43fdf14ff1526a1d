"""Which solvers are suggested for which systems, and the paths that they need: the data
behind `suggest_solver` and the tables of docs/choosing.md."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax
import jax.random as jr
from jaxtyping import PRNGKeyArray

from ._brownian import (
    FixedStepBrownianPath,
    LevyAreaBrownianPath,
    PlateauBrownianPath,
    TruncatedBrownianPath,
    WeakBrownianPath,
)
from ._solver import (
    AdditiveGauss,
    ImplicitMidpoint,
    LevyAreaMidpoint,
    NinomiyaVictoir,
    PlateauGauss,
    PlateauVerlet,
    SRKs2,
    SRKs4,
    SRKw1,
    SRKw4,
    SRKw5,
    StormerVerlet,
    StrangGauss,
)


Want = Literal["expectations", "paths"]
_Path = diffrax.AbstractBrownianPath


class PathKind(NamedTuple):
    """A way to make Brownian paths, as code in `shape` and keys, and as a function."""

    code: str
    make: Callable[[Any, PRNGKeyArray], _Path]


def _gaussian(shape, key) -> _Path:
    return FixedStepBrownianPath(shape, key)


def _with_area(shape, key) -> _Path:
    return FixedStepBrownianPath(shape, key, levy_area=diffrax.SpaceTimeLevyArea)


_GAUSSIAN = "ds.FixedStepBrownianPath({shape}, key)"
_AREA = "ds.FixedStepBrownianPath({shape}, key, levy_area=diffrax.SpaceTimeLevyArea)"
_weak = lambda **kwargs: lambda shape, key: WeakBrownianPath(shape, key, **kwargs)
_around_area = lambda wrapper: (
    lambda shape, key: wrapper(_with_area(shape, key), jr.fold_in(key, 1))
)

PATHS = {
    "weak": PathKind("ds.WeakBrownianPath({shape}, key)", _weak()),
    "weak, second set": PathKind(
        "ds.WeakBrownianPath({shape}, key, second=True)", _weak(second=True)
    ),
    "weak, two-point": PathKind(
        "ds.WeakBrownianPath({shape}, key, two_point=True)", _weak(two_point=True)
    ),
    "weak, four-point": PathKind(
        "ds.WeakBrownianPath({shape}, key, order=3)", _weak(order=3)
    ),
    "Gaussian": PathKind(_GAUSSIAN, _gaussian),
    "truncated": PathKind(
        f"ds.TruncatedBrownianPath({_GAUSSIAN})",
        lambda shape, key: TruncatedBrownianPath(_gaussian(shape, key)),
    ),
    "space-time area": PathKind(_AREA, _with_area),
    "plateaus": PathKind(
        f"ds.PlateauBrownianPath({_AREA}, jr.fold_in(key, 1))",
        _around_area(PlateauBrownianPath),
    ),
    "Lévy areas": PathKind(
        f"ds.LevyAreaBrownianPath({_AREA}, jr.fold_in(key, 1))",
        _around_area(LevyAreaBrownianPath),
    ),
}


class Rule(NamedTuple):
    """One solver, and the systems that it is suggested for."""

    want: Want
    structure: Literal["any", "separable", "additive", "constant"]
    noises: Literal["any", "commuting", "not commuting"]
    solver: type[diffrax.AbstractSolver]
    # One of `PATHS`.
    path: str


# Each rule with its reason, in a sentence. The best comes first. A test compares the tables
# of docs/choosing.md with this one.
RULES = {
    Rule("expectations", "constant", "any", AdditiveGauss, "weak, four-point"): (
        "Two stage vectors, and by far the smallest errors for constant noise."
    ),
    Rule("expectations", "separable", "any", StormerVerlet, "weak"): (
        "Explicit, the cheapest step of all. The step has to resolve the fastest "
        "frequency: omega h < 2."
    ),
    Rule("expectations", "constant", "any", SRKw5, "weak, second set"): (
        "Few digits at the cost of the midpoint rule."
    ),
    Rule("expectations", "additive", "any", SRKs4, "space-time area"): (
        "Additive noise may depend on time here."
    ),
    Rule("expectations", "separable", "any", SRKw4, "weak"): (
        "Implicit, on half of the state: for systems too stiff for explicit steps."
    ),
    Rule("expectations", "any", "commuting", StrangGauss, "weak"): (
        "Four stage vectors in three small systems, for one noise or commuting ones."
    ),
    Rule("expectations", "any", "not commuting", NinomiyaVictoir, "weak, two-point"): (
        "Two stage vectors for each noise and four for the drift; its errors repay "
        "them if the noises are few."
    ),
    Rule("expectations", "any", "any", SRKw1, "weak"): (
        "The midpoint rule: one stage vector for any number of noises, for few digits."
    ),
    Rule("paths", "separable", "any", PlateauVerlet, "plateaus"): (
        "Explicit. The step has to resolve the fastest frequency: omega h < 4."
    ),
    Rule("paths", "additive", "any", SRKs4, "space-time area"): (
        "Two stage vectors, one after the other."
    ),
    Rule("paths", "any", "commuting", PlateauGauss, "space-time area"): (
        "Two stage vectors, and brackets of the vector fields: accurate paths for one "
        "noise or commuting ones."
    ),
    Rule("paths", "any", "not commuting", LevyAreaMidpoint, "Lévy areas"): (
        "The midpoint rule with Lévy areas, which bring the order if noises do not commute."
    ),
    Rule("paths", "separable", "any", StormerVerlet, "Gaussian"): (
        "Explicit, the cheapest step of all, for few digits: omega h < 2."
    ),
    Rule("paths", "any", "any", ImplicitMidpoint, "truncated"): (
        "The first to try: one stage vector for any number of noises."
    ),
    Rule("paths", "separable", "any", SRKs2, "truncated"): (
        "The midpoint rule on half of the state: for systems too stiff for explicit steps."
    ),
}
