"""Friction, or the exact flow of a linear part, around the step of another solver."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._arguments import check_pair, check_takes
from .._compat import direction
from .._custom_types import Args, RealScalarLike, Y
from .._tableau import Structure
from .._terms import Dependence, has_lifted, refuse_constraint, split_friction
from .base import AbstractSymplecticSolver, Order, Record
from .bath import after_friction, check_friction
from .langevin import AbstractLangevinSplitting, LangevinMiddle


class AbstractSplitting(AbstractSymplecticSolver, diffrax.AbstractWrappedSolver[Any]):
    """Strang splitting: a flow over half a step, a step of `solver` for the rest of the
    system, and the flow over the other half."""

    solver: eqx.AbstractVar[AbstractSymplecticSolver]
    # When to choose it, in a sentence.
    choose: ClassVar[str]
    # The highest orders of the splitting.
    weak: ClassVar[int] = 2
    strong: ClassVar[int] = 1
    # What to do for solvers of other packages.
    advice: ClassVar[str] = ""

    @abc.abstractmethod
    def half_step(self, terms, t, time: RealScalarLike, y: Y, args: Args) -> Y:
        """The state after the flow over half of a step, `time`. `t` is the end of the step
        that belongs to this half. Like these, `time` is positive even in a solve backward
        in time."""

    @abc.abstractmethod
    def rest(self, terms) -> PyTree[diffrax.AbstractTerm]:
        """The terms for `solver`."""

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
        if record is None:
            return None
        # What the solver alone keeps exactly, it need not keep with a flow around it.
        return record._replace(
            weak=_at_most(record.weak, self.weak),
            strong=_at_most(record.strong, self.strong),
            stationary=(),
        )

    def weak_order(self, terms) -> int | None:
        order = self.solver.weak_order(terms)
        return None if order is None else min(order, self.weak)

    def strong_order(self, terms) -> int | float | None:
        order: Any = self.solver.strong_order(terms)
        return None if order is None else min(order, self.strong)

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
        # Strang's splitting has order 2.
        return None if order is None else min(order, 2)

    def init(self, terms, t0, t1, y0, args) -> Any:
        refuse_constraint(terms, type(self).__name__)
        self.check(terms, t0, y0, args)
        return self.solver.init(self.rest(terms), t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        del made_jump
        half = (t1 - t0) / 2
        y = self.half_step(terms, t0, half, y0, args)
        # The flow is a jump for a solver that remembers the end of its last step.
        y, error, _, state, result = self.solver.step(
            self.rest(terms), t0, t1, y, args, solver_state, True
        )
        y1 = self.half_step(terms, t1, half, y, args)
        return y1, error, dict(y0=y0, y1=y1), state, result


def _at_most(order: Order | None, most: int) -> Order | None:
    """The order of a splitting that has at most this order itself."""
    if isinstance(order, tuple):
        commuting, others = order
        return min(commuting, most), min(others, most)
    return None if order is None else min(order, most)


class Damped(AbstractSplitting):
    r"""Any solver of this package for Langevin terms, with the friction around its step.

    $$p \gets C_{h/2}\, p, \qquad (p, q) \gets \text{a step of the solver}, \qquad
      p \gets C_{h/2}\, p$$

    where $C$ is the implicit midpoint rule for the friction of
    [`diffrax_symplectic.langevin_terms`][], $\mathrm{d}p = -G v\,\mathrm{d}t$, at fixed
    $q$. The solver gets all other terms, with the noise of the bath and any other noise. If
    these are separable it may be a separable solver, such as
    [`diffrax_symplectic.StormerVerlet`][]; then the method is explicit. The velocity $v =
    \partial H_0 / \partial p$ must be linear in $p$. Solvers for general systems take
    Langevin terms as they are, without `Damped`.

    If $G = \gamma M$ with one constant number $\gamma$, a step is conformally symplectic:
    with its Jacobian $S'$, $S'^\top J S' = c^2 J$ for $c = (1 - \gamma h / 4) / (1 + \gamma
    h / 4)$. The orders are the solver's, but at most weak order 2, strong order 1, and
    order 2 without noise.

    For Langevin dynamics with separable $H_0$, [`diffrax_symplectic.BAOAB`][] and
    [`diffrax_symplectic.LangevinMiddle`][] have far less bias. With friction that a step
    does not resolve, $\gamma h > \frac12$, the temperature is wrong: see [strong
    friction](../stability.md#strong-friction).

    **Source:** the splitting of [Strang (1968)](https://doi.org/10.1137/0705041).
    """

    solver: AbstractSymplecticSolver

    choose: ClassVar[str] = "Friction: collisions, damping, thermostats."
    advice: ClassVar[str] = (
        "Other solvers take the terms of `langevin_terms` as they are, without `Damped`."
    )

    def __check_init__(self):
        inner = self.solver
        # Below any `LinearFlow`.
        while issubclass(type(inner), AbstractSplitting):
            inner = inner.solver  # pyright: ignore
        if issubclass(type(inner), AbstractLangevinSplitting):
            raise ValueError(
                f"`{type(inner).__name__}` takes the friction of the terms itself: use it "
                "without `Damped`."
            )

    @property
    def record(self) -> Record | None:  # pyright: ignore
        record = super().record
        if record is None:
            return None
        # Half of the friction comes after the noise, whatever the solver is: with c as
        # above, a free particle has <p^2> / m T = 2 gamma h c^2 / (1 - c^4), 0.95 and 0.83
        # for gamma h = 1/2 and 1.
        return record._replace(most_friction=0.5)

    def check(self, terms, t0, y0, args):
        if has_lifted(terms):
            raise ValueError(
                "`Damped` applies friction to a canonical momentum, which the state of "
                "`spin_terms` or `wave_terms` does not have: spins would get shorter. Pass "
                "`damping=` to `spin_terms` or `wave_terms` instead."
            )
        check_pair(y0)
        drift, friction, _ = split_friction(terms)
        check_friction(drift, friction, t0, y0, args, type(self).__name__)

    def half_step(self, terms, t, time, y, args):
        _, friction, _ = split_friction(terms)
        return after_friction(friction, t, time, y, args), y[1]

    def rest(self, terms):
        drift, _, noise = split_friction(terms)
        return diffrax.MultiTerm(*drift, *noise)


Damped.__init__.__doc__ = """**Arguments:**

- `solver`: a solver of this package.

**Raises:** a `ValueError` for a solver of another package, or one that takes friction
    itself; and in the solve if the terms have no friction, or one that is not linear in
    `p`.
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
    `LinearFlow(StormerVerlet(), flow)` is explicit.

    **Friction.** With friction and noise of a temperature use `LinearFlow(BAOAB(), flow)`.
    Friction acts on the velocities of the whole system, so it comes from terms of the whole
    Hamiltonian: `MultiTerm(*hamiltonian_terms(R).terms, *bath_terms(H0, friction,
    temperature, path).terms)`.

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
        if issubclass(type(self.solver), LangevinMiddle):
            raise ValueError(
                "The momenta of `LangevinMiddle` are late by half a step, which makes "
                "positions wrong to first order if a flow moves them. Use "
                "`LinearFlow(BAOAB(), flow)`."
            )

    def check(self, terms, t0, y0, args):
        check_pair(y0)
        t0 = jnp.asarray(t0, jnp.result_type(t0, jnp.float32))

        def after(time: RealScalarLike, y: Y) -> Y:
            return self.half_step(terms, t0, time, y, args)

        # `t0` serves as any duration: what depends on what is decided without values.
        dependence = Dependence(after, t0, y0)
        if dependence.independent(lambda time, y: time):
            raise ValueError(
                "`flow(time, y, args)` of `LinearFlow` does not depend on `time`, so it is "
                "not a flow: for `time = 0` it must return `y`. It is called with half of "
                "each step."
            )

    def half_step(self, terms, t, time, y, args):
        del t
        # Steps are positive even in a solve backward in time, where the flow runs back.
        y1 = self.flow(direction(terms) * time, y, args)
        if not eqx.tree_equal(_shapes_of(y1), _shapes_of(y)):
            raise ValueError(
                "`flow(time, y, args)` must return a pair like the state, "
                f"{eqx.tree_pformat(y)}; got {eqx.tree_pformat(y1)}."
            )
        return y1

    def rest(self, terms):
        return terms


def _shapes_of(y: Y) -> PyTree[jax.ShapeDtypeStruct]:
    return jax.eval_shape(lambda: y)


LinearFlow.__init__.__doc__ = """**Arguments:**

- `solver`: a solver of this package.
- `flow`: `flow(time, y, args)`, the exact flow of $L$: the state after `time` (which may be
    negative) from `y = (p, q)`. Any function or Module, for example by Fourier transforms
    for a lattice, or by eigenvectors for a molecule.

**Raises:** a `ValueError` if `flow` is not such a function, for a solver of another
    package, and while the solve is traced if `flow` returns another structure or shape, or
    does not depend on `time`.
"""
