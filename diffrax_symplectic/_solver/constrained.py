"""Steps of constrained systems."""

from typing import Any

import diffrax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike, Y
from .._terms import (
    apply,
    check_start,
    controls,
    drift_driven,
    split_terms,
    Surface,
    without_constraint,
)
from .base import AbstractSymplecticSolver
from .step import no_failure


def init_constrained(
    solver: AbstractSymplecticSolver,
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> optx.RESULTS:
    """The solver state at a start. Raises a `ValueError` for terms that the solver does not
    take, and for starts off the constraint; a path fails if that is not known."""
    check_pair(y0)
    solver.check(without_constraint(terms), t0, y0, args)
    dependent, off = check_start(terms, t0, y0, args)
    R: Any = optx.RESULTS
    fault = R.where(off, R.nonlinear_divergence, no_failure())
    return R.where(dependent, R.singular, fault)


def verlet_step(
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    before: optx.RESULTS,
    name: str,
) -> tuple[Y, optx.RESULTS]:
    """A step of [`diffrax_symplectic.StormerVerlet`][] on the surface, and the state of the
    solver `name` after it."""
    surface = Surface.of(terms, t0, y0, args)
    drift, noise = split_terms(without_constraint(terms))
    (p, unravel_p), (q, unravel_q) = map(jfu.ravel_pytree, y0)
    half = (t1 - t0) / 2
    pending = before == optx.RESULTS.successful

    p, q, first = surface.fly(p, surface.frame(q), half, pending)
    y = unravel_p(p), unravel_q(q)
    force, _ = drift_driven(drift, t0, t1, args)(t0 + half, y)
    p = p + jfu.ravel_pytree(force)[0]
    if len(noise) > 0:
        drawn = controls(noise, ["W"], t0, t1, name)["W"]
        kick, _ = apply(noise, drawn, args, t0 + half, y)
        p = p + jfu.ravel_pytree(kick)[0]
    p, q, second = surface.fly(p, surface.frame(q), half, pending)
    y1 = unravel_p(surface.tangent(p, surface.frame(q))), unravel_q(q)
    return ended(y1, first & second, before)


def ended(
    y1: Y, found: Bool[Array, ""], before: optx.RESULTS
) -> tuple[Y, optx.RESULTS]:
    """The end of a step, and the state of the solver after it."""
    R: Any = optx.RESULTS
    now = R.where(found, R.successful, R.nonlinear_max_steps_reached)
    result = R.where(before == R.successful, now, before)
    # Without a solution there is no derivative. It is set to zero, so that a failed path
    # does not spoil gradients that are summed over a batch.
    fixed = lambda x: jnp.where(result == R.successful, x, lax.stop_gradient(x))
    return jtu.tree_map(fixed, y1), result
