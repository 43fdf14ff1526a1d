"""Splittings for Langevin dynamics that have names of their own."""

import functools as ft
from typing import ClassVar

import equinox as eqx

from .._arguments import whole_number
from .flow import check_flow, Flow as AnyFlow
from .pieces import AbstractPiece, Bath, Flight, Flow, Kick
from .record import Record
from .splitting import AbstractLangevinSplitting, check_has_no_bath


_HALF_KICK = Kick(1 / 2)
_HALF_FLIGHT = Flight(1 / 2)
_BATH = Bath(1)

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

    flow: AnyFlow | None = None
    steps: int = eqx.field(
        default=1, static=True, converter=ft.partial(whole_number, "steps")
    )

    keeps_constraints: ClassVar[bool] = True

    def __check_init__(self):
        if self.flow is not None:
            check_flow(self.flow, self.steps, type(self).__name__)
            check_has_no_bath(self.flow)
        elif self.steps > 1:
            raise ValueError(
                f"`steps={self.steps}` of `BAOAB` are those of a solver: pass one as "
                "`flow`, such as `StormerVerlet()`."
            )

    @property
    def pieces(self) -> tuple[AbstractPiece, ...]:  # pyright: ignore
        flow = self.flow
        move = _HALF_FLIGHT if flow is None else Flow(1 / 2, flow, self.steps)
        return (_HALF_KICK, move, _BATH, move, _HALF_KICK)

    @property
    def record(self) -> Record:  # pyright: ignore
        if self.flow is None:
            return _FREE_FLIGHT
        keeps_constraints = getattr(self.flow, "keeps_constraints", False)
        choose = _CHOOSE_FOR_CONSTRAINTS if keeps_constraints else _CHOOSE_A_FLOW
        # Which stationary moments are exact depends on the flow, so none is promised.
        return _FREE_FLIGHT._replace(choose=choose, stationary=())


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

    pieces: ClassVar[tuple[AbstractPiece, ...]] = (
        Kick(1),
        _HALF_FLIGHT,
        _BATH,
        _HALF_FLIGHT,
    )
    record: ClassVar[Record] = Record(
        weak=1,
        strong=1,
        choose="Langevin dynamics in equilibrium, for functions of p alone. Its momenta "
        "lag by half a step and are wrong where a force drives a current: not for "
        "functions of p and q together, such as a heat current.",
        stationary=("qq", "pp"),
    )
