"""Exact flows around the step of another solver: friction, or a linear part."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, PyTree

from .._arguments import check_pair, check_takes
from .._compat import direction
from .._custom_types import Args, RealScalarLike, Y
from .._tableau import Structure
from .._terms import (
    Dependence,
    has_lifted,
    is_hamiltonian,
    refuse_constraint,
    split_terms,
)
from ._friction import (
    apply_friction,
    checked,
    decay,
    Fault,
    friction_modes,
    friction_result,
    GAMMA,
    matrix_faults,
    Modes,
    velocity_of,
)
from .base import AbstractSymplecticSolver, Order, Record


class AbstractSplitting(AbstractSymplecticSolver, diffrax.AbstractWrappedSolver[Any]):
    """Strang splitting: an exact flow over half a step, a step of `solver` for the rest of
    the system, and the flow over the other half."""

    solver: eqx.AbstractVar[AbstractSymplecticSolver]
    # When to choose it, in a sentence.
    choose: ClassVar[str]
    # The highest orders of the splitting.
    weak: ClassVar[int] = 2
    strong: ClassVar[int] = 1
    # What to do for solvers of other packages.
    advice: ClassVar[str] = ""

    @abc.abstractmethod
    def prepare(self, terms, t0, time: RealScalarLike, y0: Y, args: Args) -> Any:
        """What all flows over `time` of a solve from `t0` share, computed once."""

    @abc.abstractmethod
    def exact_flow(self, prepared: Any, time: RealScalarLike, y: Y, args: Args) -> Y:
        """The flow over `time`, which is negative in a solve backward in time."""

    @abc.abstractmethod
    def result_with(self, prepared: Any, result: diffrax.RESULTS) -> diffrax.RESULTS:
        """The `result` of a step of the solver, or the failure of the flow."""

    def __check_init__(self):
        # `isinstance` would look through wrappers, such as `diffrax.HalfSolver`.
        if not issubclass(type(self.solver), AbstractSymplecticSolver):
            name = type(self).__name__
            raise ValueError(
                f"`{name}` wraps a solver of this package, such as `StormerVerlet()`; got "
                f"`{type(self.solver).__name__}`. {self.advice}".rstrip()
            )

    @property
    def record(self) -> Record | None:  # pyright: ignore
        record = self.solver.record
        return record and record._replace(
            weak=_at_most(record.weak, self.weak),
            strong=_at_most(record.strong, self.strong),
        )

    def weak_order(self, terms) -> int | None:
        order = self.solver.weak_order(terms)
        return None if order is None else min(order, self.weak)

    def strong_order(self, terms) -> int | float | None:
        order: Any = self.solver.strong_order(terms)
        return None if order is None else min(order, self.strong)

    @property
    def includes_friction(self) -> bool:  # pyright: ignore
        return self.solver.includes_friction

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

    def stage_vectors(self, num_noises):
        return self.solver.stage_vectors(num_noises)

    def order(self, terms):
        order = self.solver.order(terms)
        return None if order is None else min(order, 2)

    def init(self, terms, t0, t1, y0, args) -> Any:
        refuse_constraint(terms, type(self).__name__)
        check_pair(y0)
        prepared = self.prepare(terms, t0, direction(terms) * (t1 - t0) / 2, y0, args)
        return self.solver.init(terms, t0, t1, y0, args), prepared

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        del made_jump
        inner, prepared = solver_state
        # In Diffrax `t1 - t0` is positive even in a solve backward in time.
        time = direction(terms) * (t1 - t0) / 2
        y = self.exact_flow(prepared, time, y0, args)
        # The flow is a jump for a solver that remembers the end of its last step.
        y, error, _, inner, result = self.solver.step(
            terms, t0, t1, y, args, inner, True
        )
        y1 = self.exact_flow(prepared, time, y, args)
        result = self.result_with(prepared, result)
        return y1, error, dict(y0=y0, y1=y1), (inner, prepared), result


def _at_most(order: Order | None, most: int) -> Order | None:
    if isinstance(order, tuple):
        return min(order[0], most), min(order[1], most)
    return None if order is None else min(order, most)


class Damped(AbstractSplitting):
    r"""Any solver of this package with friction, $\mathrm{d}p = \ldots - \gamma p\,
    \mathrm{d}t$.

    $$p \gets e^{-\gamma h / 2} p, \qquad (p, q) \gets \text{a step of the solver}, \qquad
      p \gets e^{-\gamma h / 2} p$$

    The terms do not include the friction, so they remain separable for separable solvers.

    For a single constant $\gamma$ a step is conformally symplectic: with its Jacobian $S'$,
    $S'^\top J S' = e^{-\gamma h} J$. It is explicit if the solver is. The orders are the
    solver's, but at most weak order 2, strong order 1, and order 2 without noise.

    The friction acts on the canonical momentum $p$. In a magnetic field, friction on the
    kinetic momentum $p - A(q)$ needs its own term.

    For Langevin dynamics with constant noise, [`diffrax_symplectic.BAOAB`][] and
    [`diffrax_symplectic.LangevinMiddle`][] have far less bias.

    **Source:** the splitting of [Strang (1968)](https://doi.org/10.1137/0705041).
    """

    solver: AbstractSymplecticSolver
    gamma: PyTree[ArrayLike] = eqx.field(converter=checked)
    _faults: tuple[Fault | None, ...] = eqx.field(static=True, init=False, repr=False)

    def __post_init__(self):
        self._faults = matrix_faults(self.gamma)
        if getattr(self.solver, "includes_friction", False):
            raise ValueError(
                f"`{type(self.solver).__name__}` already includes friction. Pass all "
                "friction to it, without `Damped`."
            )

    includes_friction: ClassVar[bool] = True  # pyright: ignore
    choose: ClassVar[str] = "Friction: collisions, damping, thermostats."
    advice: ClassVar[str] = (
        "Other solvers take friction as a term: `diffrax.MultiTerm(terms, "
        "diffrax.ODETerm(friction))`."
    )

    def prepare(self, terms, t0, time, y0, args) -> list[Modes | None]:
        """The modes of the friction."""
        del time
        _check_has_momentum(terms)
        velocity = velocity_of(terms, t0, y0, args)
        return friction_modes(self.gamma, self._faults, y0[0], velocity)

    def exact_flow(self, prepared: list[Modes | None], time, y, args):
        p, q = y
        return apply_friction(self.gamma, prepared, time, (decay, p)), q

    def result_with(self, prepared, result):
        return friction_result(self.gamma, prepared, result)


def _check_has_momentum(terms: PyTree[diffrax.AbstractTerm]) -> None:
    """Raises a `ValueError` unless the first half of the state is a canonical momentum."""
    if has_lifted(terms):
        raise ValueError(
            "`Damped` applies friction to a canonical momentum, which the state of "
            "`spin_terms` or `wave_terms` does not have: spins would get shorter. For "
            "damped spins pass `damping=` to `spin_terms`."
        )
    if not any(map(is_hamiltonian, split_terms(terms)[0])):
        raise ValueError(
            "`Damped` applies friction to the momentum p of a state `(p, q)`. Plain terms "
            "(`ODETerm`, `ControlTerm`) may have other states, such as (position, "
            "velocity). Construct the terms with `hamiltonian_terms`; or use "
            "`BAOAB(gamma)`, if the noise is constant and in the forces; or include the "
            "friction in the drift, for solvers of general systems."
        )


Damped.__init__.__doc__ = f"""**Arguments:**

- `solver`: a solver of this package.
- `gamma`: {GAMMA}

**Raises:** a `ValueError` if `gamma` is negative, not finite or an invalid matrix (unless
    it is traced), if it does not fit `p` (in the solve), or for a solver of another package
    or one that already includes friction.
"""


class LinearFlow(AbstractSplitting):
    r"""Any solver of this package for $H_0 = L + R$, with the exact flow of $L$ around a
    step for the rest $R$.

    $$y \gets \varphi_L(\tfrac h2)\, y, \qquad y \gets \text{a step of the solver for } R
      \text{ and the noises}, \qquad y \gets \varphi_L(\tfrac h2)\, y$$

    Use it for systems whose fast parts are linear, $L = \frac12 y \cdot A y$, such as waves
    on a lattice or the bonds of a molecule. Their frequencies then do not limit the step.
    The error is proportional to commutators of $L$ with the rest.

    The terms contain $R$ and all noises, without $L$. If they depend on $q$ alone,
    `LinearFlow(StormerVerlet(), flow)` is explicit. With friction and thermal noise use
    `LinearFlow(BAOAB(gamma), flow)`, in which both are exact.

    The method is symplectic if the solver and `flow` are, which
    [`diffrax_symplectic.symplecticity_defect`][] tests. The orders are the solver's, but at
    most weak order 2, strong order 1, and order 2 without noise.

    !!! warning

        If $\omega h$ is close to a multiple of $\pi$ for a mode of frequency $\omega$, the
        splitting is in resonance and the rest makes this mode grow. The width of the
        resonance is proportional to the rest. To detect it, compare with half the step.

    **Source:** the splitting of [Strang (1968)](https://doi.org/10.1137/0705041); impulse
    methods of [Grubmüller, Heller, Windemuth and Schulten
    (1991)](https://doi.org/10.1080/08927029108022142).
    """

    solver: AbstractSymplecticSolver
    flow: Callable[[RealScalarLike, Y, Args], Y]

    choose: ClassVar[str] = (
        "Solves the fast linear waves of lattices and molecules exactly."
    )

    def __check_init__(self):
        check_takes("flow", self.flow, "time", "y", "args")

    def prepare(self, terms, t0, time, y0, args):
        flow = lambda time, y: self.exact_flow(None, time, y, args)
        if Dependence(flow, jnp.asarray(time), y0).independent(lambda time, y: time):
            raise ValueError(
                "`flow(time, y, args)` of `LinearFlow` does not depend on `time`, so it is "
                "not a flow: for `time = 0` it must return `y`. It is called with half of "
                "each step."
            )

    def exact_flow(self, prepared, time, y, args):
        y1 = self.flow(time, y, args)
        shape = lambda x: jax.eval_shape(lambda: x)
        if not eqx.tree_equal(shape(y1), shape(y)):
            raise ValueError(
                "`flow(time, y, args)` must return a pair like the state, "
                f"{eqx.tree_pformat(y)}; got {eqx.tree_pformat(y1)}."
            )
        return y1

    def result_with(self, prepared, result):
        del prepared
        return result


LinearFlow.__init__.__doc__ = """**Arguments:**

- `solver`: a solver of this package.
- `flow`: `flow(time, y, args)`, the exact flow of $L$: the state after `time` (which may be
    negative) from `y = (p, q)`. Any function or Module, for example by Fourier transforms
    for a lattice, or by eigenvectors for a molecule.

**Raises:** a `ValueError` if `flow` is not such a function, for a solver of another
    package, and while the solve is traced if `flow` returns another structure or shape, or
    does not depend on `time`.
"""
