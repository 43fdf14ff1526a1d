"""Steps of constrained systems."""

from typing import Any

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike, Y
from .._terms import check_start, split_terms, Surface, without_constraint
from .base import AbstractSymplecticSolver
from .driven import drawn_variables
from .pieces import Flight, Kick, lengths_and_times, Moving, Setting
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


# Momenta and positions move as in the tableau of `StormerVerlet`.
_VERLET = (Flight(1 / 2), Kick(1), Flight(1 / 2))


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
    variables = {"W": []}
    if noise:
        variables = drawn_variables(noise, ["W"], t0, t1, solver_name)
    length, time = lengths_and_times(t0, t1)
    setting = Setting(
        kicks=drift,
        rest=drift,
        friction=(),
        noise=noise,
        increments=[variables["W"]],
        args=args,
        length=length,
        time=time,
        surface=surface,
        # A path that failed before needs no multipliers: in a batch, others would wait.
        pending=last_outcome == optx.RESULTS.successful,
    )
    moving = Moving(y0, forces=None, flows={})
    for number, piece in enumerate(_VERLET):
        moving = piece.move(setting, moving, number)
    moving = moving.made_tangent(surface)
    return end_and_outcome(moving.y, moving.found, last_outcome)


def end_and_outcome(
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
