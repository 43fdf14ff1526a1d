"""Langevin dynamics by splitting: kicks of the forces, drifts of the positions, and
friction and noise between them."""

import functools as ft
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

import diffrax
import equinox as eqx
from jaxtyping import Array, ArrayLike, PyTree

from .._arguments import check_state, whole_number
from .._compat import unwrapped
from .._custom_types import Args, Y
from .._tableau import Structure
from .._terms import (
    apply,
    check_structure,
    constraint_of,
    momentum_first,
    rate,
    split_friction,
)
from .base import AbstractSymplecticSolver
from .bath import after_friction, check_friction
from .constrained import baoab_step, begin_baoab
from .driven import drawn_variables
from .flow import (
    after_flow,
    begin_flow,
    check_flow,
    check_follows,
    Flow,
    forces_at_start,
    is_solver,
    kicks_and_rest,
    moved,
)
from .record import Record
from .step import result_of
from .times import result_with_times_checked


if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar, ClassVar as AbstractVar
else:
    from equinox import AbstractClassVar, AbstractVar


class SplittingState(NamedTuple):
    """What a splitting hands on from the end of a step to the start of the next one.

    - `forces`: those of the kicks, if a step begins and ends with half a kick.
    - `flow`: the state of the solver that is the flow; of a function, whether it returned
        NaN at the start.
    """

    forces: PyTree[Array]
    flow: PyTree[Array]


class AbstractLangevinSplitting(AbstractSymplecticSolver):
    """A kick, half a flow, friction and noise, half a flow. A symmetric splitting makes one
    half of the kick at the start of the step and one at its end; any other makes the whole
    kick at the start."""

    variables: ClassVar[tuple[str, ...]] = ("W",)
    symmetric: AbstractClassVar[bool]
    flow: AbstractVar[Flow]
    # The steps of a solver over half a flow.
    steps: AbstractVar[int]

    @property
    def friction_parts(self) -> int:
        """How many parts of a step are friction and noise, each over an equal share of
        it."""
        return 1

    def area_factor(self, rate_times_step: ArrayLike) -> Any:
        """The factor by which a step shrinks areas, where friction is one rate for all
        momenta. At zero a step has no inverse."""
        # Each part is the midpoint rule for friction over its share of the step.
        x = rate_times_step / (2 * self.friction_parts)
        return ((1 - x) / (1 + x)) ** self.friction_parts

    def stage_vectors(self, num_noises):
        if not is_solver(self.flow):
            return ()
        # The steps of the flow before and after the bath, one after another.
        return 2 * self.steps * self.flow.stage_vectors(num_noises)  # pyright: ignore

    @property
    def undoes_its_steps(self) -> bool:
        if not self.symmetric:
            return False
        return not is_solver(self.flow) or self.flow.undoes_its_steps  # pyright: ignore

    def order(self, terms):
        return 2 if self.symmetric else 1

    def check(self, terms, t0, y0: Y, args: Args) -> None:
        solver_name = type(self).__name__
        check_state(solver_name, y0)
        terms, y0 = momentum_first(terms, y0)
        drift, friction, noise = split_friction(terms)
        kicks, rest = kicks_and_rest(self.flow, drift)
        check_structure("separable", kicks, noise, t0, y0, args, solver_name)
        if not all(isinstance(unwrapped(term), diffrax.ODETerm) for term in drift):
            raise ValueError(
                f"`{solver_name}` needs a drift driven by time: pass `langevin_terms(H0, "
                "friction, temperature, path)`."
            )
        check_friction(drift, friction, t0, y0, args, solver_name)
        check_follows(self.flow, rest, t0, y0, args)

    def init(self, terms, t0, t1, y0, args) -> Any:
        self.check(terms, t0, y0, args)
        terms, y0 = momentum_first(terms, y0)
        drift, _, _ = split_friction(terms)
        kicks, rest = kicks_and_rest(self.flow, drift)
        forces = None
        if self.symmetric and kicks:
            forces, _ = rate(kicks, t0, y0, args)
        return SplittingState(forces, begin_flow(self.flow, rest, t0, t1, y0, args))

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        # The user's own terms and state: those of Diffrax have the state (x, v).
        own_terms = terms
        own_y0 = y0
        terms, y0 = momentum_first(own_terms, own_y0)
        drift, friction, noise = split_friction(terms)
        kicks, rest = kicks_and_rest(self.flow, drift)
        forces, flow_state = solver_state
        p, q = y0
        h = t1 - t0
        half = h / 2
        middle = t0 + half

        def compute_forces() -> PyTree[Array]:
            forces, _ = rate(kicks, t0, y0, args)
            return forces

        # Kick
        if self.symmetric and kicks:
            forces = forces_at_start(forces, made_jump, compute_forces)
            p = moved(p, half, forces)
        elif kicks:
            p = moved(p, h, compute_forces())
        # Flow. Of the rates at (p, q) only the velocities are used; XLA drops the forces.
        follow = ft.partial(after_flow, self.flow, self.steps, rest)
        (p, q), flow_state, _ = follow(t0, middle, half, (p, q), args, flow_state)
        # Friction and noise
        noise_change = None
        if len(noise) > 0:
            variables = drawn_variables(noise, ["W"], t0, t1, type(self).__name__)
            noise_change, _ = apply(noise, variables["W"], args, middle, (p, q))
        p = after_friction(friction, middle, h, (p, q), args, noise_change)
        # Flow. Velocities of free flight do not depend on time. Taken at `t1`, the time of
        # the forces below, they share with these what depends on time alone.
        start = t1 if self.flow is None else middle
        (p, q), flow_state, flow_result = follow(
            start, t1, half, (p, q), args, flow_state
        )
        # Kick
        if self.symmetric and kicks:
            forces, _ = rate(kicks, t1, (p, q), args)
            p = moved(p, half, forces)
        R: Any = diffrax.RESULTS
        result = result_of(None, (p, q))
        if self.flow is not None:
            result = R.where(flow_result == R.successful, result, flow_result)
        result = result_with_times_checked(terms, t0, t1, result)
        # If the state is Diffrax's (x, v), its halves are exchanged once more.
        _, y1 = momentum_first(own_terms, (p, q))
        state = SplittingState(forces, flow_state)
        return y1, None, dict(y0=own_y0, y1=y1), state, result


_FREE_FLIGHT = Record(
    weak=2,
    strong=1,
    choose="Langevin dynamics, explicit: very accurate stationary positions (not under "
    "constraints), and exact mobility and diffusion of free particles. For functions of p "
    "and q together, such as a heat current, too. Not for functions of p alone in "
    "equilibrium, such as a kinetic temperature, for transients to more than three digits, "
    "or for frequencies omega > 2 / h.",
    stationary=("qq", "pq"),
)
_CHOOSE_A_FLOW = (
    "A heat bath for any energy that is quadratic in p, such as masses that depend on "
    "positions: friction and noise by a step of their own, which keeps Maxwell's law at "
    "every friction."
)
_CHOOSE_FOR_CONSTRAINTS = (
    "A heat bath under constraints, for kinetic energies at the ends of long steps, for "
    "twice the evaluations of forces. Positions may be better or worse than with free "
    "flight."
)


class BAOAB(AbstractLangevinSplitting):
    r"""Langevin dynamics, explicit: one force evaluation per step, very accurate stationary
    positions, exact mobility and diffusion of free particles.

    For [`diffrax_symplectic.langevin_terms`][] with $H_0 = V(p) + U(t, q)$ and quadratic
    $V$; weak order 2, strong order 1, order 2 without noise. A step is kick, flow, friction
    and noise, flow, kick. By default the flow is free flight: with the forces $f =
    -\partial U / \partial q$ and the velocities $g = \partial V / \partial p$,

    $$\begin{aligned}
      \text{B:} &\quad p \gets p + \tfrac h2 f(t_n, q) \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{O:} &\quad \bar p = p - h G g(\tfrac12 (p + \bar p)) + B W, \quad
        p \gets \bar p \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{B:} &\quad p \gets p + \tfrac h2 f(t_{n+1}, q)
    \end{aligned}$$

    with $G$ and $B$ at $t_n + \frac h2$ and the current $q$. O is the implicit midpoint
    rule for friction and noise, one linear equation. It keeps the Maxwell distribution
    exactly, for every friction and all masses (its second moments, with three-point
    increments). For numbers, $p \gets ((1 - x) p + B W) / (1 + x)$ with $x = \gamma h / 2$,
    $\gamma = G / m$.

    Other noise is added as further terms. It goes into O as well, and must be in the
    forces, $H_k = U_k(t, q)$. A drift added as a further term must be separable.

    **Positions, momenta, transport.** In a harmonic well ($\omega h < 2$) the law of $q$ is
    exact; momenta are too cold, $\langle p^2 \rangle = m T (1 - \omega^2 h^2 / 4)$. For
    functions of p alone, such as a kinetic temperature, use
    [`diffrax_symplectic.LangevinMiddle`][]. Functions of p and q together are for this
    solver. The mobility $G^{-1}$ and the diffusion $T G^{-1}$ of a free particle are exact
    for every step.

    If $G = \gamma M$ with one constant number $\gamma$, a step is conformally symplectic:
    with its Jacobian $S'$, $S'^\top J S' = \frac{1 - x}{1 + x} J$.

    Takes any Brownian path; use [`diffrax_symplectic.FixedStepBrownianPath`][] for paths
    and for Metropolis chains.

    **Source:** [Leimkuhler and Matthews (2013)](https://doi.org/10.1093/amrx/abs010) for
    the splitting; [Grønbech-Jensen and Farago
    (2013)](https://doi.org/10.1080/00268976.2012.760055) for the method with this O;
    [Leimkuhler and Matthews (2016)](https://doi.org/10.1098/rspa.2016.0138) for
    constraints; [Tuckerman, Berne and Martyna (1992)](https://doi.org/10.1063/1.463137) for
    multiple time steps.

    **Flows.** With a `flow`, A is half a step of that flow, and B kicks with the force of
    the `slow` potential of the terms alone, if they have one. It is evaluated once in a
    step:

    - a solver of this package, in `steps` steps each half: `BAOAB(ImplicitMidpoint())` for
        any $H_0$ that is quadratic in $p$; `BAOAB(StormerVerlet(), steps=4)` for multiple
        time steps;
    - a [`diffrax_symplectic.linear_flow`][], for stiff springs, rings of beads and waves,
        whose frequencies then do not limit the step;
    - a function `flow(time, y, args)`, called with half of each step. An exact flow
        resonates with the kicks where a step turns a mode by $\pi$.

    The last two stand for the whole of $H_0$: only the friction is taken from it. Weak and
    stationary order 2; without friction a step is symplectic, and without `slow` it
    conserves what the flow does.

    **Diffrax's terms.** It also takes `diffrax.UnderdampedLangevinDriftTerm` and
    `diffrax.UnderdampedLangevinDiffusionTerm`, with their state `(x, v)`.

    **Constraints.** For constrained terms this is g-BAOAB: A is a step of RATTLE,
    as in [`diffrax_symplectic.StormerVerlet`][], and B and O keep momenta tangent, with
    their exact Maxwell distribution. With the flow `StormerVerlet()`, kinetic energies at
    the ends of long steps are better.
    """

    flow: Flow = None
    steps: int = eqx.field(
        default=1, static=True, converter=ft.partial(whole_number, "steps")
    )

    symmetric: ClassVar[bool] = True
    keeps_constraints: ClassVar[bool] = True

    def __check_init__(self):
        check_flow(self.flow, self.steps, type(self).__name__)
        if issubclass(type(self.flow), AbstractLangevinSplitting):
            raise ValueError(
                f"`{type(self.flow).__name__}` has a bath of its own. Pass a solver for "
                "systems without noise as `flow`, such as `StormerVerlet()`."
            )

    @property
    def record(self) -> Record:  # pyright: ignore
        if self.flow is None:
            return _FREE_FLIGHT
        keeps_constraints = getattr(self.flow, "keeps_constraints", False)
        choose = _CHOOSE_FOR_CONSTRAINTS if keeps_constraints else _CHOOSE_A_FLOW
        # Which stationary moments are exact depends on the flow, so none is promised.
        return _FREE_FLIGHT._replace(choose=choose, stationary=())

    @property
    def structure(self) -> Structure:
        return self.flow.structure if is_solver(self.flow) else "separable"  # pyright: ignore

    def init(self, terms, t0, t1, y0, args) -> Any:
        if constraint_of(terms) is None:
            return super().init(terms, t0, t1, y0, args)
        return begin_baoab(self, self.flow, terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        if constraint_of(terms) is None:
            return super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        y1, state = baoab_step(
            self.flow,
            self.steps,
            terms,
            t0,
            t1,
            y0,
            args,
            solver_state,
            made_jump,
            type(self).__name__,
        )
        result = result_with_times_checked(terms, t0, t1, result_of(state.outcome, y1))
        return y1, None, dict(y0=y0, y1=y1), state, result


class LangevinMiddle(AbstractLangevinSplitting):
    r"""Langevin dynamics, by a splitting whose stationary momenta are as accurate as its
    positions, in equilibrium. Explicit, with one evaluation of the forces in a step.

    $$\begin{aligned}
      \text{B:} &\quad p \gets p + h f(t_n, q) \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{O:} &\quad \bar p = p - h G g(\tfrac12 (p + \bar p)) + B W, \quad
        p \gets \bar p \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p)
    \end{aligned}$$

    Takes the same terms and paths as [`diffrax_symplectic.BAOAB`][].

    **Positions, momenta, transport.** In a harmonic well the laws of $q$ and of $p$ are
    exact, each by itself, for every step with $\omega h < 2$. The momenta belong to half a
    step before the positions, so that $\langle p q \rangle = h T / 2$ and not zero. Use it
    for functions of p alone or of q alone, not for functions of p and q together, such as a
    heat current: these are for [`diffrax_symplectic.BAOAB`][]. Momenta come right after
    friction and noise: in a step, the bath gives a particle of mass $m$ the mean energy
    $\frac12 (c^{-2} - 1) \langle T - p^2 / m \rangle$, $c = (1 - x) / (1 + x)$. Free
    diffusion is exact, as for [`diffrax_symplectic.BAOAB`][].

    **In equilibrium only.** Under a current momenta are wrong to first order: a constant
    force $F$ and the friction $G$ give the mean velocity $F / G$ but the mean momentum $m F
    / G - h F / 2$; two baths at the ends of a bond do the same to temperatures.

    The steps are those of [`diffrax_symplectic.BAOAB`][] in other variables: if this solver
    has $p$ and $q$, then BAOAB has $p + \frac h2 f(t, q)$ and $q$ along the same path. Weak
    order 1, strong order 1, and order 1 without noise, since momenta are late; order 2 for
    stationary means of functions of $q$ alone or of $p$ alone. Conformally symplectic, like
    BAOAB.

    **Source:** [Zhang, Liu, Yan, Tuckerman and Liu
    (2019)](https://doi.org/10.1021/acs.jpca.9b02771) for the splitting.
    """

    symmetric: ClassVar[bool] = False
    structure: ClassVar[Structure] = "separable"
    flow: ClassVar[None] = None
    steps: ClassVar[int] = 1
    record: ClassVar[Record] = Record(
        weak=1,
        strong=1,
        choose="Langevin dynamics in equilibrium, for functions of p alone. Its momenta "
        "lag by half a step and are wrong where a force drives a current: not for "
        "functions of p and q together, such as a heat current.",
        stationary=("qq", "pp"),
    )
