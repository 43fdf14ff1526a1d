"""The Brownian path that a solver needs, one of this package or of Diffrax."""

from typing import cast

import diffrax
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from .._brownian import (
    CommonBrownianPath,
    FixedStepBrownianPath,
    LevyAreaBrownianPath,
    LevyAreaIncrement,
    PlateauBrownianPath,
    PlateauIncrement,
    TruncatedBrownianPath,
)
from .base import AbstractSymplecticSolver
from .record import Want


def own_path(
    solver: diffrax.AbstractSolver, want: Want, shape: PyTree, key: PRNGKeyArray
) -> diffrax.AbstractBrownianPath:
    """The path `solver.path(shape, key)` of a solver of this package, or a Gaussian path
    for any other solver. The path is not truncated: whether it must be depends on the
    terms, and `which_need_truncation` decides it."""
    # `isinstance` would look through a `diffrax.HalfSolver`.
    if not issubclass(type(solver), AbstractSymplecticSolver):
        return common_path(solver, cell=None, shape=shape, key=key)
    path = cast(AbstractSymplecticSolver, solver).path(shape, key, want=want)
    return path.path if isinstance(path, TruncatedBrownianPath) else path


def common_path(
    solver: diffrax.AbstractSolver,
    cell: float | np.ndarray | None,
    shape: PyTree,
    key: PRNGKeyArray,
) -> diffrax.AbstractBrownianPath:
    """A Gaussian path with the Lévy areas that the solver needs.

    With a `cell`, a length of time of which all steps are multiples, the path is the same
    Brownian motion for all solvers and all such steps. If `cell` is an array, another value
    of it compiles nothing anew, except for solvers that need Lévy areas of pairs of noises.
    """
    if isinstance(cell, np.ndarray):
        path = CommonBrownianPath(shape, key, cell)  # pyright: ignore
    else:
        path = FixedStepBrownianPath(
            shape, key, levy_area=diffrax.SpaceTimeLevyArea, cell=cell
        )
    increment = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    if increment is PlateauIncrement:
        return PlateauBrownianPath(path, key)
    if increment is not LevyAreaIncrement:
        return path
    if cell is None:
        return LevyAreaBrownianPath(path, key)
    # A step samples the areas of each of its cells. Fourier terms in each cell would cost
    # time, so there are none.
    return LevyAreaBrownianPath(path, key, num_terms=0, cell=float(cell))
