"""Which structure of the system the coefficients of a tableau are for."""

import functools as ft

from .._custom_types import Args, RealScalarLike, Y
from .._structure_checks import check_additive, check_separable
from .._tableau import (
    AbstractTableau,
    AdditiveTableau,
    GeneralTableau,
    PartitionedTableau,
    SeparableTableau,
)


@ft.singledispatch
def check_structure(
    tableau: AbstractTableau,
    drift: tuple,
    noise: tuple,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    solver: str,
) -> None:
    """Checks, while tracing, that the terms have the structure that the coefficients of
    `tableau` are for. Every solve does so once, before its first step.

    For tableaus of one's own a check is registered by
    `@diffrax_symplectic.check_structure.register`; it may be empty.

    **Arguments:**

    - `tableau`: the tableau, whose class decides which check is made.
    - `drift`, `noise`: the terms driven by time, and those driven by Brownian motion.
    - `t0`, `y0`, `args`: where the solve begins.
    - `solver`: the name of the solver, for the message.

    **Raises:** a `ValueError` if the terms do not have the structure, or if no check is
    registered for the tableau.
    """
    del drift, noise, t0, y0, args
    name = type(tableau).__name__
    raise ValueError(
        f"`{solver}` has a `{name}`, for which no check of the structure is registered. "
        "Register one with `diffrax_symplectic.check_structure.register`; if the "
        "coefficients are for any structure, it may be empty."
    )


@check_structure.register
def _(tableau: GeneralTableau, *_) -> None:
    """Any structure will do."""


@check_structure.register(SeparableTableau)
@check_structure.register(PartitionedTableau)
def _(tableau, drift, noise, t0, y0, args, solver) -> None:
    check_separable(drift, noise, t0, y0, args, solver)


@check_structure.register
def _(tableau: AdditiveTableau, drift, noise, t0, y0, args, solver) -> None:
    check_additive(noise, t0, y0, args, solver, tableau.constant)
