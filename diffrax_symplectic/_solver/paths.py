"""The Brownian path that a solver needs, one of this package or of Diffrax."""

from typing import cast

import diffrax
from jaxtyping import PRNGKeyArray, PyTree

from .._brownian import (
    FixedStepBrownianPath,
    LevyAreaBrownianPath,
    LevyAreaIncrement,
    PlateauBrownianPath,
    PlateauIncrement,
)
from .base import AbstractSymplecticSolver
from .record import Want


def own_path(
    solver: diffrax.AbstractSolver, want: Want, shape: PyTree, key: PRNGKeyArray
) -> diffrax.AbstractBrownianPath:
    """The path of a solver of this package, or else a Gaussian path."""
    # `isinstance` would look through a `diffrax.HalfSolver`.
    if issubclass(type(solver), AbstractSymplecticSolver):
        return cast(AbstractSymplecticSolver, solver).path(shape, key, want=want)
    return common_path(solver, None, shape, key)


def common_path(
    solver: diffrax.AbstractSolver, cell: float | None, shape: PyTree, key: PRNGKeyArray
) -> diffrax.AbstractBrownianPath:
    """A Gaussian path with the Lévy areas that the solver needs. With `cell` it is the same
    Brownian motion for all solvers."""
    area = diffrax.SpaceTimeLevyArea
    path = FixedStepBrownianPath(shape, key, levy_area=area, cell=cell)
    needs = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    if needs is PlateauIncrement:
        return PlateauBrownianPath(path, key)
    if needs is LevyAreaIncrement:
        num_terms = 0 if cell else 2
        return LevyAreaBrownianPath(path, key, num_terms=num_terms, cell=cell)
    return path
