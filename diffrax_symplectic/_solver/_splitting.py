"""Splittings around the step of another solver."""

import abc
from typing import Any, ClassVar

import diffrax
from jaxtyping import PyTree

from .._compat import direction
from .._custom_types import Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from .._hamiltonian import check_pair
from .._tableau import Structure
from ._record import Record
from .base import AbstractSymplecticSolver, AbstractVar


class AbstractSplitting(AbstractSymplecticSolver, diffrax.AbstractWrappedSolver[Any]):
    """An exact flow over half of the step, a step of `solver` for all else, and the flow
    over the other half."""

    # When to choose it, in a sentence.
    choose: AbstractVar[str]
    # The orders of the splitting. The solver may have lower ones.
    weak: ClassVar[int] = 2
    strong: ClassVar[int] = 1
    # What to do with solvers of other packages.
    advice: ClassVar[str] = ""

    @abc.abstractmethod
    def prepare(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        time: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> Any:
        """What all flows of a solve have in common."""

    @abc.abstractmethod
    def exact_flow(self, prepared: Any, time: RealScalarLike, y: Y, args: Args) -> Y:
        """The flow over `time`, which is negative in a solve backward in time."""

    def __check_init__(self):
        if not isinstance(self.solver, AbstractSymplecticSolver):
            name = type(self).__name__
            raise ValueError(
                f"`{name}` wraps a solver of this package, such as `StormerVerlet()`; got "
                f"`{type(self.solver).__name__}`. {self.advice}".rstrip()
            )

    @property
    def record(self) -> Record | None:  # pyright: ignore
        record = self.solver.record  # pyright: ignore
        return record and record.at_most(self.weak, self.strong)

    @property
    def structure(self) -> Structure:
        return self.solver.structure  # pyright: ignore

    @property
    def variables(self) -> tuple[str, ...]:
        return self.solver.variables  # pyright: ignore

    @property
    def root_finder(self):
        """That of the solver, if its stages are implicit."""
        return self.solver.root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self) -> int:
        """That of the solver, if its stages are implicit."""
        return self.solver.root_find_max_steps  # pyright: ignore

    def stage_vectors(self, num_noises):
        return self.solver.stage_vectors(num_noises)  # pyright: ignore

    def order(self, terms):
        order = self.solver.order(terms)
        return None if order is None else min(order, 2)

    def init(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> Any:
        """The state of the solver, and what all flows have in common."""
        check_pair(y0)
        prepared = self.prepare(terms, direction(terms) * (t1 - t0) / 2, y0, args)
        return self.solver.init(terms, t0, t1, y0, args), prepared

    def step(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: Any,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y | None, DenseInfo, Any, diffrax.RESULTS]:
        del made_jump
        inner, prepared = solver_state
        # Diffrax makes `t1 - t0` positive in a solve backward in time, too.
        time = direction(terms) * (t1 - t0) / 2
        y = self.exact_flow(prepared, time, y0, args)
        # What the solver remembers is the end of its last step, and this one begins
        # elsewhere.
        y, error, _, inner, result = self.solver.step(
            terms, t0, t1, y, args, inner, True
        )
        y1 = self.exact_flow(prepared, time, y, args)
        return y1, error, dict(y0=y0, y1=y1), (inner, prepared), result
