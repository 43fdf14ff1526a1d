"""Langevin dynamics by splitting: kicks of the forces, drifts of the positions, and
friction and noise between them."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, PyTree

from .._arguments import check_state
from .._compat import unwrapped
from .._custom_types import Args, RealScalarLike, Y
from .._tableau import Structure
from .._terms import (
    apply,
    check_structure,
    constraint_of,
    drawn_variables,
    momentum_first,
    rate,
    split_friction,
)
from .base import AbstractSymplecticSolver, Record
from .bath import after_friction, check_friction
from .constrained import baoab_step, force_at, init_constrained
from .step import result_of
from .times import result_at


class AbstractLangevinSplitting(AbstractSymplecticSolver):
    """A kick, half a drift, friction and noise, half a drift. A symmetric splitting makes
    one half of the kick at the start of the step and one at its end; any other makes the
    whole kick at the start."""

    structure: ClassVar[Structure] = "separable"
    variables: ClassVar[tuple[str, ...]] = ("W",)
    symmetric: eqx.AbstractClassVar[bool]

    def stage_vectors(self, num_noises):
        return ()

    def order(self, terms):
        return 2 if self.symmetric else 1

    def check(self, terms, t0, y0: Y, args: Args) -> None:
        name = type(self).__name__
        check_state(y0, name)
        terms, y0 = momentum_first(terms, y0)
        drift, friction, noise = split_friction(terms)
        check_structure(self.structure, drift, noise, t0, y0, args, name)
        if not all(isinstance(unwrapped(x), diffrax.ODETerm) for x in drift):
            raise ValueError(
                f"`{name}` needs a drift driven by time: pass `langevin_terms(H0, "
                "friction, temperature, path)`."
            )
        check_friction(drift, friction, t0, y0, args, name)

    def init(self, terms, t0, t1, y0, args) -> Any:
        """The forces, which a symmetric splitting hands on from the end of a step to the
        start of the next one."""
        del t1
        self.check(terms, t0, y0, args)
        if not self.symmetric:
            return None
        terms, y0 = momentum_first(terms, y0)
        drift, _, _ = split_friction(terms)
        forces, _ = rate(drift, t0, y0, args)
        return forces

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        own_terms = terms
        own_y0 = y0
        terms, y0 = momentum_first(own_terms, own_y0)
        drift, friction, noise = split_friction(terms)
        p, q = y0
        h = t1 - t0
        half = h / 2

        def forces_at_start() -> PyTree[Array]:
            return rate(drift, t0, y0, args)[0]

        # B
        if self.symmetric:
            forces = _handed_on(solver_state, made_jump, forces_at_start)
            p = moved(p, half, forces)
        else:
            p = moved(p, h, forces_at_start())
        # A. Of the rates at (p, q), XLA drops the half that is not used.
        _, velocities = rate(drift, t0, (p, q), args)
        q = moved(q, half, velocities)
        # O
        kick = None
        if len(noise) > 0:
            drawn = drawn_variables(noise, ["W"], t0, t1, type(self).__name__)
            kick, _ = apply(noise, drawn["W"], args, t0 + half, (p, q))
        p = after_friction(friction, t0 + half, h, (p, q), args, kick)
        # A
        _, velocities = rate(drift, t1, (p, q), args)
        q = moved(q, half, velocities)
        # B
        state = None
        if self.symmetric:
            state, _ = rate(drift, t1, (p, q), args)
            p = moved(p, half, state)
        result = result_at(terms, t0, t1, result_of(None, (p, q)))
        # Exchanged once more, if the state is Diffrax's (x, v).
        _, y1 = momentum_first(own_terms, (p, q))
        return y1, None, dict(y0=own_y0, y1=y1), state, result


def _handed_on(
    forces: PyTree[Array], made_jump: Any, anew: Callable[[], PyTree[Array]]
) -> PyTree[Array]:
    """The forces from the end of the last step, or after a jump, which moved the state,
    those that are computed `anew`."""
    if made_jump is False:
        return forces
    return lax.cond(made_jump, anew, lambda: forces)


class ConstrainedState(NamedTuple):
    """The state of `BAOAB` for terms with a constraint.

    - `force`: the force at the start of the step, as a vector.
    - `solved`: whether the multipliers were found in all steps so far.
    """

    force: Array
    solved: optx.RESULTS


class BAOAB(AbstractLangevinSplitting):
    r"""Langevin dynamics, by a splitting whose stationary positions are very accurate, and
    whose mobility and free diffusion are exact. Explicit, with one evaluation of the forces
    in a step.

    For the terms of [`diffrax_symplectic.langevin_terms`][] with $H_0 = V(p) + U(t, q)$,
    the forces $f = -\partial U / \partial q$ and the velocities $g = \partial V / \partial
    p$,

    $$\begin{aligned}
      \text{B:} &\quad p \gets p + \tfrac h2 f(t_n, q) \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{O:} &\quad \bar p = p - h G g(\tfrac12 (p + \bar p)) + B W, \quad
        p \gets \bar p \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{B:} &\quad p \gets p + \tfrac h2 f(t_{n+1}, q)
    \end{aligned}$$

    with $G$ and $B$ at $t_n + \frac h2$ and the current $q$. O is the implicit midpoint
    rule for friction and noise, one linear equation: $V$ must be quadratic. It keeps the
    Maxwell distribution exactly for every friction and all masses. For numbers, $p \gets
    ((1 - x) p + B W) / (1 + x)$ with $x = \gamma h / 2$, $\gamma = G / m$.

    Other noise is added as further terms. It goes into O as well, and must be in the
    forces, $H_k = U_k(t, q)$. A drift added as a further term must be separable.

    **Positions, momenta, transport.** In a harmonic well of frequency $\omega$ the law of
    $q$ is exact for every step with $\omega h < 2$. Momenta are too cold,
    $\langle p^2 \rangle = m T (1 - \omega^2 h^2 / 4)$: for functions of p alone, such as
    kinetic temperatures, use [`diffrax_symplectic.LangevinMiddle`][], which has the same
    positions. Functions of p and q together, such as heat currents, are for this solver,
    since its momenta and positions belong to the same time. The mobility $G^{-1}$ and the
    diffusion $T G^{-1}$ of a free particle are exact for every step.

    Weak order 2, strong order 1, order 2 without noise. If $G = \gamma M$ with one
    constant number $\gamma$, a step is conformally symplectic: with its Jacobian $S'$,
    $S'^\top J S' = \frac{1 - x}{1 + x} J$. As an explicit method it is limited to
    $\omega h < 2$.

    Takes any Brownian path: a [`diffrax_symplectic.WeakBrownianPath`][] for
    expectations, a [`diffrax_symplectic.FixedStepBrownianPath`][] for paths.

    **Diffrax's terms.** It also takes `diffrax.UnderdampedLangevinDriftTerm` and
    `diffrax.UnderdampedLangevinDiffusionTerm`, with their state `(x, v)`.

    **Constraints.** For terms with a `constraint` this is g-BAOAB: each A is a step of
    RATTLE, as in [`diffrax_symplectic.StormerVerlet`][], B and O end with momenta that are
    tangent, and O is the midpoint rule with multipliers of its own, so that it keeps the
    Maxwell distribution of the tangent momenta exactly.

    **Source:** [Leimkuhler and Matthews (2013)](https://doi.org/10.1093/amrx/abs010) for
    the splitting; [Grønbech-Jensen and Farago
    (2013)](https://doi.org/10.1080/00268976.2012.760055) for the method with this O;
    [Leimkuhler and Matthews (2016)](https://doi.org/10.1098/rspa.2016.0138) for
    constraints.
    """

    symmetric: ClassVar[bool] = True
    keeps_constraints: ClassVar[bool] = True
    record: ClassVar[Record] = Record(
        weak=2,
        strong=1,
        choose="Langevin dynamics: explicit, with very accurate stationary positions, and "
        "exact mobility and diffusion of free particles. For functions of p and q "
        "together, such as a heat current, too. Not for functions of p alone, such as a "
        "kinetic temperature, for transients to more than three digits, or for "
        "frequencies omega > 2 / h.",
        suggested=("weak", "strong"),
        stationary=("qq", "pq"),
    )

    def init(self, terms, t0, t1, y0, args) -> Any:
        if constraint_of(terms) is None:
            return super().init(terms, t0, t1, y0, args)
        solved = init_constrained(self, terms, t0, y0, args)
        return ConstrainedState(force_at(terms, t0, y0, args), solved)

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        if constraint_of(terms) is None:
            return super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        force = _handed_on(
            solver_state.force, made_jump, lambda: force_at(terms, t0, y0, args)
        )
        y1, force, solved = baoab_step(
            terms, t0, t1, y0, args, force, solver_state.solved, type(self).__name__
        )
        result = result_at(terms, t0, t1, result_of(solved, y1))
        state = ConstrainedState(force, solved)
        return y1, None, dict(y0=y0, y1=y1), state, result


class LangevinMiddle(AbstractLangevinSplitting):
    r"""Langevin dynamics, by a splitting whose stationary momenta are as accurate as its
    positions. Explicit, with one evaluation of the forces in a step.

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
    $\frac12 (c^{-2} - 1) \langle T - p^2 / m \rangle$, $c = (1 - x) / (1 + x)$. Mobility
    and free diffusion are exact, as for [`diffrax_symplectic.BAOAB`][].

    The steps are those of [`diffrax_symplectic.BAOAB`][] in other variables: if this solver
    has $p$ and $q$, then BAOAB has $p + \frac h2 f(t, q)$ and $q$ along the same path. Weak
    order 1, strong order 1, and order 1 without noise, since momenta are late; order 2 for
    stationary means of functions of $q$ alone or of $p$ alone. Conformally symplectic, like
    BAOAB.

    **Source:** [Zhang, Liu, Yan, Tuckerman and Liu
    (2019)](https://doi.org/10.1021/acs.jpca.9b02771) for the splitting.
    """

    symmetric: ClassVar[bool] = False
    record: ClassVar[Record] = Record(
        weak=1,
        strong=1,
        choose="Langevin dynamics, for functions of p alone. Same positions as `BAOAB`, "
        "but momenta lag by half a step: not for functions of p and q together, such as a "
        "heat current.",
        suggested=("weak", "strong"),
        stationary=("qq", "pp"),
    )


def moved(x: PyTree, time: RealScalarLike, rate: PyTree) -> PyTree:
    """`x` after `time` at a constant rate."""

    def leaf_moved(x: Array, v: Array) -> Array:
        # In the precision of the state, which times need not have.
        return x + jnp.asarray(time, jnp.result_type(x)) * v

    return jtu.tree_map(leaf_moved, x, rate)
