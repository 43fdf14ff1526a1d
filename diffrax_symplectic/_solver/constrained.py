"""Steps of constrained systems."""

from typing import Any

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike, Y
from .._terms import (
    apply,
    check_start,
    drawn_variables,
    drift_driven,
    rate,
    split_friction,
    split_terms,
    Surface,
    without_constraint,
)
from .base import AbstractSymplecticSolver
from .bath import after_friction
from .step import no_failure


def init_constrained(
    solver: AbstractSymplecticSolver,
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> optx.RESULTS:
    """Whether a path can start here. Raises a `ValueError` for terms that the solver does
    not take, and for starts off the constraint; a path fails if that is not known."""
    check_pair(y0)
    solver.check(without_constraint(terms), t0, y0, args)
    dependent, off = check_start(terms, t0, y0, args)
    results: Any = optx.RESULTS
    # With dependent constraints it is not known where the surface is.
    fault = results.where(off, results.nonlinear_divergence, no_failure())
    return results.where(dependent, results.singular, fault)


def verlet_step(
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    before: optx.RESULTS,
    name: str,
) -> tuple[Y, optx.RESULTS]:
    """A step of [`diffrax_symplectic.StormerVerlet`][] on the surface, and its result,
    which is the state of the solver. `before` is the state before the step, and `name` that
    of the solver, for errors about its path."""
    surface = Surface.of(terms, t0, y0, args)
    drift, noise = split_terms(without_constraint(terms))
    p, unravel_p = jfu.ravel_pytree(y0[0])
    q, unravel_q = jfu.ravel_pytree(y0[1])
    half = (t1 - t0) / 2
    # A path that failed before needs no multipliers: in a batch, others would wait for it.
    pending = before == optx.RESULTS.successful

    p, q, first = surface.fly(p, surface.frame(q), half, pending)
    # The momentum is not tangent here. It need not be: forces do not depend on it, and the
    # multipliers of the next flight make up for it.
    y = (unravel_p(p), unravel_q(q))
    # The force times the step.
    impulse, _ = drift_driven(drift, t0, t1, args)(t0 + half, y)
    p = p + jfu.ravel_pytree(impulse)[0]
    if len(noise) > 0:
        p = p + _kick(noise, t0, t1, y, args, name)
    p, q, second = surface.fly(p, surface.frame(q), half, pending)
    p = surface.tangent(p, surface.frame(q))
    y1 = (unravel_p(p), unravel_q(q))
    return _ended(y1, first & second, before)


def baoab_step(
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    force: Array,
    before: optx.RESULTS,
    name: str,
) -> tuple[Y, Array, optx.RESULTS]:
    """A step of [`diffrax_symplectic.BAOAB`][] on the surface, from the `force` at its
    start; the force at its end, and the state of the solver `name` after it."""
    surface = Surface.of(terms, t0, y0, args)
    _, friction, noise = split_friction(without_constraint(terms))
    p, unravel_p = jfu.ravel_pytree(y0[0])
    q, unravel_q = jfu.ravel_pytree(y0[1])
    half = jnp.asarray((t1 - t0) / 2, p.dtype)
    middle = t0 + (t1 - t0) / 2
    pending = before == optx.RESULTS.successful

    # B and A
    p, q, first = surface.fly(p + half * force, surface.frame(q), half, pending)
    at = surface.frame(q)
    p = surface.tangent(p, at)
    y = (unravel_p(p), unravel_q(q))
    # O
    kick = _kick(noise, t0, t1, y, args, name) if noise else jnp.zeros_like(p)

    # Friction acts on the impulses of the constraint forces, too: then friction and noise
    # are the midpoint rule within the tangent space, which keeps its Maxwell distribution.
    def after(impulse: Array) -> Array:
        moved = after_friction(friction, middle, t1 - t0, y, args, unravel_p(impulse))
        return jfu.ravel_pytree(moved)[0]

    def response(impulse: Array) -> Array:
        return jax.jvp(after, (kick,), (impulse,))[1]

    p = surface.tangent(after(kick), at, response)
    # A and B
    p, q, second = surface.fly(p, at, half, pending)
    force = force_at(terms, t1, (unravel_p(p), unravel_q(q)), args)
    p = surface.tangent(p + half * force, surface.frame(q))
    y1 = (unravel_p(p), unravel_q(q))
    y1, solved = _ended(y1, first & second, before)
    return y1, force, solved


def force_at(
    terms: PyTree[diffrax.AbstractTerm], t: RealScalarLike, y: Y, args: Args
) -> Array:
    """The force without friction, as a vector."""
    drift, _, _ = split_friction(without_constraint(terms))
    force, _ = rate(drift, t, y, args)
    return jfu.ravel_pytree(force)[0]


def _kick(
    noise: tuple, t0: RealScalarLike, t1: RealScalarLike, y: Y, args: Args, name: str
) -> Array:
    """The change of the momenta by the noise, as a vector."""
    drawn = drawn_variables(noise, ["W"], t0, t1, name)
    kick, _ = apply(noise, drawn["W"], args, t0 + (t1 - t0) / 2, y)
    return jfu.ravel_pytree(kick)[0]


def _ended(
    y1: Y, found: Bool[Array, ""], before: optx.RESULTS
) -> tuple[Y, optx.RESULTS]:
    """The end of a step, and the state of the solver after it."""
    results: Any = optx.RESULTS
    now = results.where(found, results.successful, results.nonlinear_max_steps_reached)
    # The first failure is the one that is reported.
    result = results.where(before == results.successful, now, before)

    # Without a solution there is no derivative. It is set to zero, so that a failed path
    # does not spoil gradients that are summed over a batch.
    def fixed_if_failed(x: Array) -> Array:
        return jnp.where(result == results.successful, x, lax.stop_gradient(x))

    return jtu.tree_map(fixed_if_failed, y1), result
