"""The solvers' common base, and the step of any tableau."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, TYPE_CHECKING, TypeAlias

import diffrax

from .._brownian import VARIABLES
from .._custom_types import Args, BoolScalarLike, DenseInfo, RealScalarLike, VF, Y
from .._plan import make_plan
from .._tableau import AbstractTableau, FlatTableau
from .._terms import (
    check_state,
    drift_driven,
    noise_driven,
    split_terms,
)
from ._implicit_step import take_step
from ._stages import Step
from ._structure import check_structure


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

SolverState: TypeAlias = None


class AbstractSymplecticSolver(diffrax.AbstractStratonovichSolver[SolverState]):
    """The base of all solvers of this package."""

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., diffrax.LocalLinearInterpolation]] = (
        diffrax.LocalLinearInterpolation
    )

    def func(
        self, terms: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
    ) -> VF:
        return terms.vf(t0, y0, args)


class AbstractSymplecticRungeKutta(AbstractSymplecticSolver):
    r"""A Runge--Kutta method with its own coefficients for drift and noise.

    Subclasses give a `tableau` and their orders. If stages are implicit, they also subclass
    [`diffrax_symplectic.AbstractImplicitStages`][]. Everything else is decided by the
    tableau: unused stages are dropped, equal ones are evaluated once, and explicit ones are
    evaluated directly. The implicit ones are solved for in small systems, one after
    another, as far as the coefficients allow. The unknowns are the stage values $k_i$, not
    the stages, so that the end of the step is their weighted sum and needs no further
    evaluation.

    **Terms.** `MultiTerm(drift, noise)` as from
    [`diffrax_symplectic.hamiltonian_terms`][] or of Diffrax's own `ODETerm` and
    `ControlTerm`; any number of noise terms; or the drift alone.

    **State.** Any PyTree of real floating-point arrays.

    **Failures.** If a stage equation is not solved, or the step does not end at finite
    numbers, `diffeqsolve` stops there and says so: as an error, or with `throw=False`
    through `sol.result`. In a batch the other paths go on.
    """

    tableau: AbstractVar[AbstractTableau]

    @property
    def minimal_levy_area(self) -> type[diffrax.AbstractBrownianIncrement]:
        """The least that the increments of the path have to hold."""
        variables = _variables(make_plan(self.tableau.flatten()).tableau)
        for name, variable in VARIABLES.items():
            if name in variables:
                return variable.increment
        return diffrax.AbstractBrownianIncrement

    def init(
        self,
        terms: diffrax.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> SolverState:
        del t1
        check_state(y0, type(self).__name__)
        drift, noise = split_terms(terms)
        name = type(self).__name__
        check_structure(self.tableau, drift, noise, t0, y0, args, name)
        return None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: SolverState,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, SolverState, diffrax.RESULTS]:
        del solver_state, made_jump
        drift, noise = split_terms(terms)
        plan = make_plan(_drop_absent(self.tableau.flatten(), drift, noise))
        variables = _variables(plan.tableau)
        driven = {"h": drift_driven(drift, t0, t1, args)} if drift else {}
        name = type(self).__name__
        driven |= noise_driven(drift, noise, variables, t0, t1, args, name)
        y1, result = take_step(plan, Step(t0, t1 - t0, driven), y0, self)
        return y1, None, dict(y0=y0, y1=y1), None, result


def _drop_absent(tableau: FlatTableau, drift: tuple, noise: tuple) -> FlatTableau:
    """Leaves out the stages that no term drives (an ODE has no noise), and the brackets of
    drift and noise unless there are both."""
    keep = [
        i
        for i, stage in enumerate(tableau.stages)
        if len(drift if stage.channels == ("h",) else noise) > 0
    ]
    tableau = tableau.take(keep)
    if len(drift) > 0:
        return tableau
    without = lambda stage: tuple(c for c in stage.channels if c != "L")
    stages = tuple(stage._replace(channels=without(stage)) for stage in tableau.stages)
    return dataclasses.replace(tableau, stages=stages)


def _variables(tableau: FlatTableau) -> list[str]:
    """The random variables that drive the stages."""
    channels = [c for stage in tableau.stages for c in stage.channels]
    return [c for c in dict.fromkeys(channels) if c != "h"]
