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
from .._terms import check_start, without_constraint
from .base import AbstractSymplecticSolver
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
