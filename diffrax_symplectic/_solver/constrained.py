"""Steps of constrained systems."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree

from .._arguments import check_pair
from .._compat import unwrapped, wrapped_like
from .._custom_types import Args, RealScalarLike, Terms, Y
from .._terms import (
    apply,
    check_start,
    constraint_of,
    NormalSpace,
    rate,
    split_friction,
    split_terms,
    Surface,
    with_constraint,
    without_constraint,
)
from .base import AbstractSymplecticSolver
from .bath import after_friction
from .driven import drawn_variables, drift_change
from .flow import after_flow, begin_flow, Flow, forces_at_start, kicks_and_rest
from .step import no_failure


def init_constrained(
    solver: AbstractSymplecticSolver,
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> optx.RESULTS:
    """Whether a path can start here, as the state of the solver. Raises a `ValueError` for
    terms that the solver does not take, and for starts off the surface; if the start is
    traced, so that this is not known, a path off the surface fails."""
    check_pair(y0)
    solver.check(without_constraint(terms), t0, y0, args)
    is_dependent, is_off = check_start(terms, t0, y0, args)
    R: Any = optx.RESULTS
    outcome = R.where(is_off, R.nonlinear_divergence, no_failure())
    # With dependent constraints it is not known where the surface is, so this comes first.
    return R.where(is_dependent, R.singular, outcome)


def verlet_step(
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    last_outcome: optx.RESULTS,
    solver_name: str,
) -> tuple[Y, optx.RESULTS]:
    """A step of [`diffrax_symplectic.StormerVerlet`][] on the surface, and the outcome of
    all steps so far, which is the state of the solver. `last_outcome` is the outcome before
    this step. `solver_name` is for errors about the path."""
    surface = Surface.of(terms, t0, y0, args)
    drift, noise = split_terms(without_constraint(terms))
    (p, unravel_p), (q, unravel_q) = map(jfu.ravel_pytree, y0)
    half = (t1 - t0) / 2
    # A path that failed before needs no multipliers: in a batch, others would wait for it.
    pending = last_outcome == optx.RESULTS.successful

    p, q, first_found = surface.free_flight(p, surface.normal_space(q), half, pending)
    # The momentum is not tangent here. It need not be: forces do not depend on it, and the
    # multipliers of the next flight make up for it.
    y = (unravel_p(p), unravel_q(q))
    force_kick, _ = drift_change(drift, t0, t1, args)(t0 + half, y)
    p = p + jfu.ravel_pytree(force_kick)[0]
    if len(noise) > 0:
        p = p + _noise_change(noise, t0, t1, y, args, solver_name)
    p, q, second_found = surface.free_flight(p, surface.normal_space(q), half, pending)
    p = surface.tangent(p, surface.normal_space(q))
    y1 = (unravel_p(p), unravel_q(q))
    return _end_and_outcome(y1, first_found & second_found, last_outcome)


class ConstrainedState(NamedTuple):
    """What [`diffrax_symplectic.BAOAB`][] hands on from step to step on the surface.

    - `force`: that of the kicks, as a vector, if there are kicks.
    - `flow`: the state of the solver that is the flow, if there is one.
    - `outcome`: whether the multipliers were found in all steps so far.
    """

    force: Array | None
    flow: PyTree[Array]
    outcome: optx.RESULTS


def begin_baoab(
    solver: AbstractSymplecticSolver,
    flow: Flow,
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
) -> ConstrainedState:
    """The state of a solver with this flow at the start. Raises a `ValueError` for a flow
    that leaves the surface, and like `init_constrained`."""
    # Free flight keeps constraints by multipliers; a function does not.
    keeps_constraints = flow is None or getattr(flow, "keeps_constraints", False)
    if not keeps_constraints:
        raise ValueError(
            f"The flow {flow!r} does not keep the constraint of the terms. Use "
            "`BAOAB()` or `BAOAB(StormerVerlet())`."
        )
    outcome = init_constrained(solver, terms, t0, y0, args)
    kicks, rest = _kicks_and_rest(flow, terms)
    force = _force(kicks, t0, y0, args) if kicks else None
    return ConstrainedState(force, begin_flow(flow, rest, t0, t1, y0, args), outcome)


def baoab_step(
    flow: Flow,
    steps: int,
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    solver_state: ConstrainedState,
    made_jump: Any,
    solver_name: str,
) -> tuple[Y, ConstrainedState]:
    """A step of [`diffrax_symplectic.BAOAB`][] on the surface, and the state of the solver
    after it. `solver_name` is for errors about the path."""
    surface = Surface.of(terms, t0, y0, args)
    kicks, rest = _kicks_and_rest(flow, terms)
    _, friction, noise = split_friction(without_constraint(terms))
    (p, unravel_p), (q, unravel_q) = map(jfu.ravel_pytree, y0)
    half = jnp.asarray((t1 - t0) / 2, p.dtype)
    middle = t0 + (t1 - t0) / 2
    half_step_of_flow = _HalfStepOfFlow(
        surface=surface,
        flow=flow,
        steps=steps,
        terms=rest,
        args=args,
        unravel_p=unravel_p,
        unravel_q=unravel_q,
        half=half,
        pending=solver_state.outcome == optx.RESULTS.successful,
    )

    # B and A. Between them the momentum need not be tangent: the multipliers of the flight
    # make up for it.
    force = None
    if kicks:
        compute_force = ft.partial(_force, kicks, t0, y0, args)
        force = forces_at_start(solver_state.force, made_jump, compute_force)
        p = p + half * force
    p, q, flow_state, first_found = half_step_of_flow.take(
        p, surface.normal_space(q), t0, middle, solver_state.flow
    )
    normal_space = surface.normal_space(q)
    p = surface.tangent(p, normal_space)
    y = (unravel_p(p), unravel_q(q))
    # O
    if noise:
        noise_change = _noise_change(noise, t0, t1, y, args, solver_name)
    else:
        noise_change = jnp.zeros_like(p)

    def after_bath(impulse: Array) -> Array:
        """The momenta after friction over the step, with this impulse in the course of
        it."""
        p = after_friction(friction, middle, t1 - t0, y, args, unravel_p(impulse))
        return jfu.ravel_pytree(p)[0]

    p = _tangent_after_bath(surface, normal_space, after_bath, noise_change)
    # A and B
    p, q, flow_state, second_found = half_step_of_flow.take(
        p, normal_space, middle, t1, flow_state
    )
    if kicks:
        force = _force(kicks, t1, (unravel_p(p), unravel_q(q)), args)
        p = p + half * force
    p = surface.tangent(p, surface.normal_space(q))
    y1 = (unravel_p(p), unravel_q(q))
    y1, outcome = _end_and_outcome(y1, first_found & second_found, solver_state.outcome)
    return y1, ConstrainedState(force, flow_state, outcome)


class _AfterFlow(NamedTuple):
    """What half a step of the flow leads to.

    - `p`, `q`: the momenta and positions, as vectors.
    - `state`: the state of the flow.
    - `found`: whether the flow succeeded, and found the multipliers.
    """

    p: Array
    q: Array
    state: PyTree
    found: Bool[Array, ""]


class _HalfStepOfFlow(NamedTuple):
    """What both half steps of the flow, A, have in common.

    - `surface`: the surface of the constraint.
    - `flow`, `steps`: the flow, and the number of its steps if it is a solver.
    - `terms`, `args`: what the flow follows.
    - `unravel_p`, `unravel_q`: from vectors to momenta and positions.
    - `half`: the length of half a step.
    - `pending`: whether multipliers have to be found; not for a path that failed before.
    """

    surface: Surface
    flow: Flow
    steps: int
    terms: Terms
    args: Args
    unravel_p: Callable[[Array], PyTree]
    unravel_q: Callable[[Array], PyTree]
    half: Array
    pending: Bool[Array, ""]

    def take(
        self,
        p: Array,
        normal_space: NormalSpace,
        begin: RealScalarLike,
        end: RealScalarLike,
        flow_state: PyTree,
    ) -> _AfterFlow:
        """Half a step of the flow from these momenta and the position of the normal
        space."""
        if self.flow is None:
            p, q, found = self.surface.free_flight(
                p, normal_space, self.half, self.pending
            )
            return _AfterFlow(p, q, flow_state, found)
        y = (self.unravel_p(p), self.unravel_q(normal_space.q))
        y, flow_state, result = after_flow(
            self.flow,
            self.steps,
            self.terms,
            begin,
            end,
            self.half,
            y,
            self.args,
            flow_state,
        )
        (p, _), (q, _) = map(jfu.ravel_pytree, y)
        return _AfterFlow(p, q, flow_state, result == diffrax.RESULTS.successful)


def _tangent_after_bath(
    surface: Surface,
    normal_space: NormalSpace,
    after_bath: Callable[[Array], Array],
    noise_change: Array,
) -> Array:
    """The tangent momenta after friction and noise, as a vector. `after_bath(impulse)` are
    the momenta after friction with this impulse, which changes them as noise does."""

    # Friction acts on the impulses of the constraint forces, too: then friction and noise
    # are the midpoint rule within the tangent space, which keeps its Maxwell distribution.
    def response(impulse: Array) -> Array:
        _, change_of_p = jax.jvp(after_bath, (noise_change,), (impulse,))
        return change_of_p

    return surface.tangent(after_bath(noise_change), normal_space, response)


def _kicks_and_rest(flow: Flow, terms: diffrax.AbstractTerm) -> tuple[Terms, Terms]:
    """The terms whose forces are the kicks, and those that the flow follows on the
    surface."""
    drift, _, _ = split_friction(without_constraint(terms))
    kicks, rest = kicks_and_rest(flow, drift)
    # The flow finds the constraint of the terms at the first of them.
    first, *others = rest
    first = wrapped_like(first, with_constraint(unwrapped(first), constraint_of(terms)))
    return kicks, (first, *others)


def _force(kicks: Terms, t: RealScalarLike, y: Y, args: Args) -> Array:
    """The force of the kicks, as a vector."""
    force, _ = rate(kicks, t, y, args)
    return jfu.ravel_pytree(force)[0]


def _noise_change(
    noise: Terms,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y: Y,
    args: Args,
    solver_name: str,
) -> Array:
    """The change of the momenta by the noise, as a vector. The vector fields are taken at
    the middle of the step."""
    variables = drawn_variables(noise, ["W"], t0, t1, solver_name)
    change, _ = apply(noise, variables["W"], args, t0 + (t1 - t0) / 2, y)
    return jfu.ravel_pytree(change)[0]


def _end_and_outcome(
    y1: Y, found: Bool[Array, ""], last_outcome: optx.RESULTS
) -> tuple[Y, optx.RESULTS]:
    """The end of a step, and the outcome of all steps so far, from whether the multipliers
    of this one were `found` and the outcome before this step."""
    R: Any = optx.RESULTS
    outcome = R.where(found, R.successful, R.nonlinear_max_steps_reached)
    # The first failure is the one that is reported.
    outcome = R.where(last_outcome == R.successful, outcome, last_outcome)

    # Without a solution there is no derivative. It is set to zero, so that a failed path
    # does not spoil gradients that are summed over a batch.
    def fixed_if_failed(x: Array) -> Array:
        return jnp.where(outcome == R.successful, x, lax.stop_gradient(x))

    return jtu.tree_map(fixed_if_failed, y1), outcome
