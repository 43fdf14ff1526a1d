"""The start of a solve with a constraint, and the end of each of its steps."""

from typing import Any

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike, Y
from .._terms import check_start, Surface, without_constraint
from .base import AbstractSymplecticSolver
from .pieces import Moving
from .step import no_failure


def init_constrained(
    solver: AbstractSymplecticSolver,
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> optx.RESULTS:
    """The outcome before the first step, which is a failure if the path cannot start at
    `y0`. Raises a `ValueError` for terms that the solver does not take.

    A start off the surface of the constraint raises a `ValueError`, too. If `y0` is traced,
    it is an error when run, or under `vmap` a failure of this path alone."""
    check_pair(y0)
    solver.check(without_constraint(terms), t0, y0, args)
    is_dependent, is_off = check_start(terms, t0, y0, args)
    R: Any = optx.RESULTS
    outcome = R.where(is_off, R.nonlinear_divergence, no_failure())
    # Dependent constraints come first: with them it is not known where the surface is.
    return R.where(is_dependent, R.singular, outcome)


def end_on_surface(
    moving: Moving, surface: Surface, last_outcome: optx.RESULTS
) -> tuple[Y, optx.RESULTS]:
    """The state at the end of a constrained step, whose last piece ended at `moving`, with
    momenta made tangent to the surface; and the outcome of all steps so far. A step fails
    if multipliers were not found or a flow failed. `last_outcome` is the outcome of all
    steps before."""
    found = moving.found
    for flow_result in moving.results.values():
        found = found & (flow_result == diffrax.RESULTS.successful)
    y1 = moving.made_tangent(surface).y
    R: Any = optx.RESULTS
    outcome = R.where(found, R.successful, R.nonlinear_max_steps_reached)
    # The first failure is the one that is reported.
    outcome = R.where(last_outcome == R.successful, outcome, last_outcome)

    # A failed path has no derivative. It is set to zero, so that this path does not spoil
    # gradients that are summed over a batch.
    def fixed_if_failed(x: Array) -> Array:
        return jnp.where(outcome == R.successful, x, lax.stop_gradient(x))

    return jtu.tree_map(fixed_if_failed, y1), outcome
