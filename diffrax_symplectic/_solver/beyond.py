"""Solvers for any Hamiltonians that are not from Wang, Hong and Xu."""

import dataclasses
from typing import ClassVar

import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array

from .._tableau import (
    drift_order,
    FlatTableau,
    GeneralTableau,
    make_plan,
    Stage,
    Structure,
)
from .._terms import apply_one, number_of_noises, split_terms
from .base import (
    AbstractImplicitStages,
    AbstractSymplecticRungeKutta,
    AbstractSymplecticSolver,
)
from .driven import drawn_variables, drift_change
from .general import GAUSS, ImplicitMidpoint
from .record import Record
from .step import no_failure, result_of, Step, take_step
from .times import result_with_times_checked


_HALVES = np.array([1 / 2, 1 / 2])


class StrangGauss(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""A symplectic method of weak order 2 for one noise or noises that commute: half a
    step of the drift by the midpoint rule, the noise by the Gauss method of order 4, and
    another half step of the drift.

    In the form of [`diffrax_symplectic.GeneralTableau`][], with $r = \sqrt 3$,

    $$A^0 = \begin{pmatrix} \frac14 & 0 \\ \frac12 & \frac14 \end{pmatrix}, \quad
      B^0 = \begin{pmatrix} 0 & 0 \\ \frac12 & \frac12 \end{pmatrix}, \quad
      A^1 = \begin{pmatrix} \frac12 & 0 \\ \frac12 & 0 \end{pmatrix},$$

    $$B^1 = \begin{pmatrix} \frac14 & \frac14 - \frac r6 \\
        \frac14 + \frac r6 & \frac14 \end{pmatrix}, \quad
      \alpha = \beta = (\tfrac12, \tfrac12).$$

    It satisfies the 17 conditions of [`diffrax_symplectic.SRKw2`][] with four stage vectors
    instead of six, in three small systems, solved one after the other. Weak order 2 for one
    noise or noises that commute; otherwise weak order 1.

    **Source:** [Strang (1968)](https://doi.org/10.1137/0705041) for the splitting.
    """

    record: ClassVar[Record] = Record(
        weak=(2, 1),
        strong=None,
        choose="For accurate expectations: four stage vectors in three small systems.",
        noises="commuting",
        right_energy_unresolved=True,
        most_friction=0.5,
        # Measured with two levels, as the share of means that were off by more than two
        # error bars. For a Kubo oscillator with noise 0.27 (p^2 + q^2) / 2 in units of
        # omega, at all phases: 1, 3, 11, 19 and 36% for omega h = 0.5, 1, 1.5, 2 and 3 up
        # to the time 30 / omega; 4, 14, 31, 54 and 73% up to 100 / omega. For a quantum
        # system of three levels, coupled by pulses: 3 of 36 populations for omega h up to
        # 1.1, where one, between changes of opposite signs, was off by 3.8 error bars; 21
        # of 36 for 2 and more, by up to 27.
        most_frequency=1.0,
    )
    tableau: ClassVar[GeneralTableau] = GeneralTableau(
        alpha=_HALVES,
        beta=_HALVES,
        A0=[[1 / 4, 0], [1 / 2, 1 / 4]],
        B0=[[0, 0], [1 / 2, 1 / 2]],
        A1=[[1 / 2, 0], [1 / 2, 0]],
        B1=GAUSS,
    )


# The flow of one vector field: two stages of the Gauss method, of order 4. Their channel is
# called "h" whatever drives them, the drift or one noise.
_FLOW = make_plan(
    FlatTableau(
        stages=tuple(
            Stage(channels=("h",), c=c, reads="y", writes="y")
            for c in GAUSS.sum(axis=1)
        ),
        matrix=GAUSS,
        weights=_HALVES,
    )
)


class NinomiyaVictoir(AbstractSymplecticSolver, AbstractImplicitStages):
    r"""A symplectic method of weak order 2 for any Hamiltonians and any number of noises,
    whether they commute or not: splitting in random order.

    Let $F_0(t)$ be the flow of the drift over time $t$, $F_k(x)$ the flow of the noise
    $b_k$ over "time" $x$, and $\hat I_k$ three-point variables. A fair coin chooses

    $$y_{n+1} = F_0(\tfrac h2)\, F_m(\hat I_m) \cdots F_1(\hat I_1)\, F_0(\tfrac h2)\, y_n
      \quad \text{or} \quad
      F_0(\tfrac h2)\, F_1(\hat I_1) \cdots F_m(\hat I_m)\, F_0(\tfrac h2)\, y_n.$$

    Each flow is one step of the Gauss method with two stages, of order 4. (With the
    midpoint rule the method would have weak order 1.) So a step solves $m + 2$ systems of
    two stage vectors, one after another. For one noise [`diffrax_symplectic.StrangGauss`][]
    also has weak order 2, and is cheaper.

    **Many noises.** Each flow needs only one noise. With an
    [`diffrax_symplectic.IndexedNoise`][] it evaluates only that noise, otherwise all of
    them: for a thousand sites and a thousand noises that depend on all sites, a step of one
    path took 0.04 s with `IndexedNoise`, and 2.8 s with a function.

    For two or more noises the path must be a [`diffrax_symplectic.WeakBrownianPath`][] with
    `two_point=True`: the coin is the sign of the first two-point variable.

    **Source:** [Ninomiya and Victoir (2008)](https://doi.org/10.1080/13504860701413958) for
    the splitting; [Ninomiya and Ninomiya (2009)](https://doi.org/10.1007/s00780-009-0101-4)
    for high-order Runge--Kutta methods in place of the flows.
    """

    record: ClassVar[Record] = Record(
        weak=2,
        strong=None,
        choose="For few noises: two stage vectors per noise, and four for the drift.",
        noises="not commuting",
        right_energy_unresolved=True,
        most_friction=0.5,
    )
    structure: ClassVar[Structure] = "any"
    variables: ClassVar[tuple[str, ...]] = ("W", "two_point")

    def stage_vectors(self, num_noises):
        return (2,) * (num_noises + 2)

    @property
    def undoes_its_steps(self):
        # With negated increments a step takes its flows in reverse order: the coin is
        # negated, too.
        return True

    def order(self, terms):
        """The order without noise, which is the order of the flows."""
        del terms
        return drift_order(_FLOW.tableau)

    def init(self, terms, t0, t1, y0, args):
        del t1
        self.check(terms, t0, y0, args)
        return no_failure()

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del made_jump
        drift, noise = split_terms(terms)
        # There is no state if the step is called by itself, or by `diffrax.HalfSolver`.
        outcome = no_failure() if solver_state is None else solver_state
        indices, increments = self._noises_in_order(terms, t0, t1)
        # Each of these arrays has an entry for each flow: first the drift, which moves to
        # the middle of the step, then the noises, which stay there, and last the drift,
        # which moves to the end. Padding adds the entries of the drift, first and last. The
        # drift ignores the index and the increment of a noise.
        is_drift = np.pad(np.full(indices.size, False), 1, constant_values=True)
        middles = [t0 + (t1 - t0) / 2] * (indices.size + 1)
        begins = jnp.stack([t0, *middles])
        ends = jnp.stack([*middles, t1])
        flows = (is_drift, begins, ends, jnp.pad(indices, 1), jnp.pad(increments, 1))

        def after_drift(begin, end, index, increment, y, outcome):
            if len(drift) == 0:
                return y, outcome
            change = drift_change(drift, begin, end, args)
            step = Step(t0=begin, h=end - begin, changes={"h": change})
            return take_step(_FLOW, step, y, self, outcome)

        def after_noise(begin, end, index, increment, y, outcome):
            if len(noise) == 0:
                return y, outcome
            change = jtu.Partial(apply_one, noise, index, increment, args)
            # Time stands still, so the size of the step is zero. `change` already contains
            # the increment.
            step = Step(t0=begin, h=jnp.zeros_like(begin), changes={"h": change})
            return take_step(_FLOW, step, y, self, outcome)

        def after_flow(carry, flow):
            is_drift, *inputs = flow
            return lax.cond(is_drift, after_drift, after_noise, *inputs, *carry), None

        # A loop compiles each kind of flow only once.
        (y1, outcome), _ = lax.scan(after_flow, (y0, outcome), flows)
        result = result_with_times_checked(terms, t0, t1, result_of(outcome, y1))
        return y1, None, dict(y0=y0, y1=y1), outcome, result

    def _noises_in_order(self, terms, t0, t1) -> tuple[Array, Array]:
        """The indices of the noises in the order of their flows, which the coin chooses;
        and their increments in the same order."""
        _, noise = split_terms(terms)
        if len(noise) == 0:
            return jnp.zeros(0, int), jnp.zeros(0)
        num_noises = number_of_noises(terms)
        # For several noises, a two-point variable is the coin that chooses their order.
        names = ["W", "two_point"] if num_noises > 1 else ["W"]
        variables = drawn_variables(noise, names, t0, t1, type(self).__name__)
        # One vector, with an increment for each noise of all terms.
        increments, _ = jfu.ravel_pytree(variables["W"])
        indices = jnp.arange(num_noises)
        if num_noises > 1:
            # The sign of the first two-point variable is the coin.
            first_leaf, *_ = jtu.tree_leaves(variables["two_point"])
            is_heads = first_leaf.reshape(-1)[0] > 0
            indices = jnp.where(is_heads, indices, indices[::-1])
        return indices, increments[indices]


class LevyAreaMidpoint(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The implicit midpoint rule with Lévy areas: strong order 1 for any number of noises,
    whether they commute or not.

    $$G = \tfrac12 (y_n + y_{n+1}), \qquad y_{n+1} = y_n + h\,a(G) + \sum_k b_k(G) I_k
      + \sum_{k<l} [b_k, b_l](G)\, A_{kl}$$

    with the Lie brackets $[b_k, b_l] = b_l' b_k - b_k' b_l$ and the Lévy areas $A_{kl}$ of
    a [`diffrax_symplectic.LevyAreaBrownianPath`][]. This is one midpoint step, over unit
    time, of the Hamiltonian

    $$h H_0 + \sum_k I_k H_k + \sum_{k<l} A_{kl} \{H_k, H_l\}, \qquad
      \{F, G\} = \frac{\partial F}{\partial p} \cdot \frac{\partial G}{\partial q}
      - \frac{\partial F}{\partial q} \cdot \frac{\partial G}{\partial p},$$

    since the Lie bracket of two Hamiltonian vector fields is the vector field of their
    Poisson bracket. Derivatives are computed by JAX. The terms need not come from
    Hamiltonians, but all noises must be in one term.

    Strong order 1 and weak order 1; without the areas the midpoint rule has strong order
    1/2. For `m` noises the areas cost `m` directional derivatives of the noise per
    evaluation. For one noise, or noises that commute, use
    [`diffrax_symplectic.ImplicitMidpoint`][].

    **Source:** [Milstein and Tretyakov (2021)](https://doi.org/10.1007/978-3-030-82040-4)
    for strong order 1 by Lévy areas and Lie brackets, due to Milstein. We know of no source
    for the combination with the midpoint rule.
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=1,
        choose="The midpoint rule with Lévy areas, for noises that do not commute.",
        noises="not commuting",
        stationary=("qq", "pq", "pp"),
        right_energy_unresolved=False,
    )
    tableau: ClassVar[GeneralTableau] = dataclasses.replace(
        ImplicitMidpoint.tableau, noise=("W", "A")
    )


class PlateauGauss(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""A symplectic method of strong order 3/2 for any Hamiltonians, with one noise or with
    noises that commute.

    A step is one step of the two-stage Gauss method, over unit time, with the vector field

    $$h a + \sum_k b_k W_k + h \sum_k [b_k, a] H_k + \sum_{k, l} [b_k, [b_l, a]]\, L_{kl},
      \qquad [b, a] = a' b - b' a,$$

    with the increments $W_k$, the space-time Lévy areas $H_k$, and

    $$L_{kl} = \tfrac35 h H_k H_l + \tfrac{1}{30} h^2 \delta_{kl}.$$

    If the path also has space-time-time areas $K_k$ (`diffrax.SpaceTimeTimeLevyArea`), then

    $$L_{kl} = \tfrac35 h H_k H_l + \tfrac{60}{7} h K_k K_l
      - \tfrac12 h (W_k K_l + K_k W_l) + \tfrac{3}{140} h^2 \delta_{kl}.$$

    Both are conditional expectations, given these variables of the path, of integrals in
    the logarithm of the solution. With the second, errors of small steps were less than
    half as large.

    The brackets of Hamiltonian vector fields are the vector fields of their Poisson
    brackets, so a step is symplectic. Derivatives are computed by JAX: for $m$ noises, $m$
    second derivatives of the vector fields per evaluation. The terms need not come from
    Hamiltonians, and may depend on time: the brackets include time derivatives.

    A step solves for two stage vectors, in one system, for any number of noises. Strong
    order 3/2 and weak order 2 for one noise or noises that commute, $[b_k, b_l] = 0$;
    otherwise strong order 1/2 and weak order 1. The path needs space-time Lévy area. If the
    noise is in the forces alone, [`diffrax_symplectic.PlateauVerlet`][] is explicit and
    much cheaper.

    **Source:** the vector field is from the log-ODE method of [Foster, Lyons and Oberhauser
    (2020)](https://doi.org/10.1137/19M1261912), section 4.
    """

    record: ClassVar[Record] = Record(
        weak=(2, 1),
        strong=(3 / 2, 1 / 2),
        choose="For accurate paths: two stage vectors, and brackets of vector fields.",
        noises="commuting",
        stationary=("qq", "pq", "pp"),
        right_energy_unresolved=False,
    )
    tableau: ClassVar[GeneralTableau] = dataclasses.replace(
        GeneralTableau.strong(A=GAUSS, B=GAUSS, alpha=_HALVES, beta=_HALVES),
        noise=("W", "L"),
    )
