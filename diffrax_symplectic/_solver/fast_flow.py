"""The flow of a fast linear part around the step of another solver."""

from typing import Any, ClassVar

import diffrax
import jax.numpy as jnp

from .._arguments import check_pair, check_takes
from .._compat import direction
from .._custom_types import RealScalarLike, Y
from .._tableau import Structure
from .._terms import (
    check_unconstrained,
    Dependence,
    momentum_first,
    slow_apart,
    split_friction,
)
from .base import AbstractSymplecticSolver
from .flow import check_returns_pair, FlowFunction, returns_nan
from .record import Order, Record
from .splitting import AbstractLangevinSplitting


# The end of several error messages: what to use in a heat bath.
_FOR_A_BATH = (
    "In a heat bath use `BAOAB(linear_flow(...))`, or `BAOAB(flow)` with a function of "
    "your own, for `langevin_terms(H0, friction, temperature, path, slow=rest)` of the "
    "whole energy: friction acts between two halves of the flow."
)


class LinearFlow(AbstractSymplecticSolver, diffrax.AbstractWrappedSolver[Any]):
    r"""Any solver of this package for $H_0 = L + R$ without a heat bath, with the exact
    flow of $L$ around a step for the rest $R$.

    $$y \gets \varphi_L(\tfrac h2)\, y, \qquad y \gets \text{a step of the solver for } R
      \text{ and the noises}, \qquad y \gets \varphi_L(\tfrac h2)\, y$$

    Use it for systems whose fast parts are linear, $L = \frac12 y \cdot A y$, such as waves
    on a lattice or the bonds of a molecule. Their frequencies then do not limit the step.
    The error is proportional to commutators of $L$ with the rest.

    The terms contain $R$ and all noises, without $L$: energy must not be
    in both. If they depend on $q$ alone, `LinearFlow(StormerVerlet(), flow)` is
    explicit. If $R$ depends on $p$ and $q$ together, as for complex amplitudes, take a
    solver for general systems.

    Terms with friction are refused. They are for [`diffrax_symplectic.BAOAB`][], which
    takes the same `flow` or a [`diffrax_symplectic.linear_flow`][], and $R$ as `slow=` of
    [`diffrax_symplectic.langevin_terms`][].

    The method is symplectic if the solver and `flow` are, which
    [`diffrax_symplectic.symplecticity_defect`][] tests. The orders are the solver's, but at
    most weak order 2, strong order 1, and order 2 without noise.

    !!! warning

        If $\omega h$ is close to a multiple of $\pi$ for a mode of frequency $\omega$, the
        splitting is in resonance and the rest makes this mode grow. The width of the
        resonance is proportional to the rest. To detect it, compare with half the step. A
        [`diffrax_symplectic.linear_flow`][] has no resonances.

    **Source:** the splitting of [Strang (1968)](https://doi.org/10.1137/0705041); impulse
    methods of [Grubmüller, Heller, Windemuth and Schulten
    (1991)](https://doi.org/10.1080/08927029108022142).
    """

    solver: AbstractSymplecticSolver
    flow: FlowFunction

    # When to choose it, in a sentence.
    choose: ClassVar[str] = (
        "Solves the fast linear waves of lattices and molecules exactly, without a bath."
    )
    # The highest orders of the splitting.
    weak: ClassVar[int] = 2
    strong: ClassVar[int] = 1

    def __check_init__(self):
        # `isinstance` would look through wrappers, such as `diffrax.HalfSolver`.
        inner = type(self.solver)
        if not issubclass(inner, AbstractSymplecticSolver):
            raise ValueError(
                "`LinearFlow` wraps a solver of this package, such as `StormerVerlet()`; "
                f"got `{inner.__name__}`."
            )
        if issubclass(inner, AbstractLangevinSplitting):
            raise ValueError(f"`LinearFlow` takes no `{inner.__name__}`. {_FOR_A_BATH}")
        check_takes("flow", self.flow, "time", "y", "args")

    @property
    def record(self) -> Record | None:  # pyright: ignore
        record = self.solver.record
        if record is None:
            return None
        # Stationary moments that are exact for the solver alone need not be exact with a
        # flow around its steps.
        return record._replace(
            weak=_at_most(record.weak, self.weak),
            strong=_at_most(record.strong, self.strong),
            stationary=(),
        )

    def weak_order(self, terms) -> int | None:
        return _at_most(self.solver.weak_order(terms), self.weak)  # pyright: ignore

    def strong_order(self, terms) -> int | float | None:
        return _at_most(self.solver.strong_order(terms), self.strong)  # pyright: ignore

    @property
    def structure(self) -> Structure:
        return self.solver.structure

    @property
    def variables(self) -> tuple[str, ...]:
        return self.solver.variables

    @property
    def root_finder(self):
        return self.solver.root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self) -> int:
        return self.solver.root_find_max_steps  # pyright: ignore

    @property
    def undoes_its_steps(self) -> bool:
        return self.solver.undoes_its_steps

    def stage_vectors(self, num_noises):
        return self.solver.stage_vectors(num_noises)

    def order(self, terms):  # pyright: ignore
        # Strang's splitting has order 2.
        return _at_most(self.solver.order(terms), 2)

    def check(self, terms, t0, y0, args):
        check_pair(y0)
        # `momentum_first` finds the friction in Diffrax's own Langevin terms. The flow gets
        # `y0` in its own order.
        terms, _ = momentum_first(terms, y0)
        drift, friction, _ = split_friction(terms)
        if len(friction) > 0:
            raise ValueError(
                f"`LinearFlow` takes no terms with friction. {_FOR_A_BATH}"
            )
        _, slow = slow_apart(drift)
        if len(slow) > 0:
            raise ValueError(
                "The terms of `LinearFlow` contain the rest alone, without the energy that "
                "`flow` stands for: pass `hamiltonian_terms(rest)`, without `slow=`. "
                f"{_FOR_A_BATH}"
            )
        check_returns_pair(self.flow, t0, y0, args)
        t0 = jnp.asarray(t0, jnp.result_type(t0, jnp.float32))

        def after_flow(time: RealScalarLike, y: Y) -> Y:
            return self.flow(time, y, args)

        # `t0` stands for the duration: `Dependence` traces the flow, and reads no values.
        dependence = Dependence(after_flow, t0, y0)
        if dependence.independent(lambda time, y: time):
            raise ValueError(
                "`flow(time, y, args)` of `LinearFlow` does not depend on `time`, so it is "
                "not a flow: for `time = 0` it must return `y`. It is called with half of "
                "each step."
            )

    def init(self, terms, t0, t1, y0, args) -> Any:
        check_unconstrained(terms, type(self).__name__)
        self.check(terms, t0, y0, args)
        inner_state = self.solver.init(terms, t0, t1, y0, args)
        half = direction(terms) * (t1 - t0) / 2
        is_broken = returns_nan(self.flow, half, y0, args)
        return inner_state, is_broken

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        del made_jump
        # The state of the solver for the rest, and whether the flow returned NaN at the
        # start of the solve.
        inner_state, is_broken = solver_state
        # Steps are positive even in a solve backward in time, where the flow runs back.
        half = direction(terms) * (t1 - t0) / 2
        y_before_step = self.flow(half, y0, args)
        # The flow is a jump for a solver that remembers the end of its last step.
        flow_is_jump = True
        y_after_step, error, _, inner_state, result = self.solver.step(
            terms, t0, t1, y_before_step, args, inner_state, flow_is_jump
        )
        y1 = self.flow(half, y_after_step, args)
        R: Any = diffrax.RESULTS
        result = R.where(is_broken, R.nonfinite, result)
        return y1, error, dict(y0=y0, y1=y1), (inner_state, is_broken), result


def _at_most(order: Order | None, splitting_order: int) -> Order | None:
    """The `order` of a solver, or a pair of orders for two kinds of noises, each lowered to
    the order of the splitting around it if that is lower."""
    if isinstance(order, tuple):
        commuting, others = order
        return min(commuting, splitting_order), min(others, splitting_order)
    return None if order is None else min(order, splitting_order)


LinearFlow.__init__.__doc__ = """**Arguments:**

- `solver`: a solver of this package for systems without a heat bath.
- `flow`: `flow(time, y, args)`, the exact flow of $L$: the state after `time` (which may be
    negative) from `y = (p, q)`. Any function or Module, for example by Fourier transforms
    for a lattice, or by eigenvectors for a molecule; or a
    [`diffrax_symplectic.linear_flow`][].

**Raises:** a `ValueError` if `flow` is not such a function, for a solver of another package
    or of Langevin dynamics, and while the solve is traced for terms with friction or
    `slow=`, and if `flow` returns another structure or shape, or does not depend on `time`.
    An error when run if `flow` returns NaN at the start; in a batch its path fails alone.
"""
