"""Whether steps are too long for the friction of Langevin terms, where paths start."""

from typing import NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._compat import quickly_compiled
from .._simulation import Problem
from .._solver import AbstractLangevinSplitting, AbstractSymplecticSolver
from .._terms import constraint_of, rate, split_friction


# With a flow, a mode that turns by more than this in a step, and whose momentum decays at
# more than this rate times the step, relaxes too slowly: from friction and frequencies of 2
# in units of 1 / h on, a step takes its position to the other side.
_RESOLVED = 2.0
_ITERATIONS = 30


class _Rates(NamedTuple):
    """The largest rates of the equation at the start.

    - `friction`: the rate at which friction takes away a momentum.
    - `squared_frequency`: the square of the angular frequency of a vibration without
        friction, or zero if the stiffest direction is unstable.
    """

    friction: Float[Array, ""]
    squared_frequency: Float[Array, ""]


def unresolved_friction(problem: Problem, dt0: float) -> str | None:
    """What is wrong with steps of `dt0` for the friction at the start of a path, as a
    sentence; `None` if nothing is, or for solvers of others. Two levels need not show it:
    momenta may be wrong by about the same factor on both, and positions may rest on both.
    """
    solver = problem.solver
    if not isinstance(solver, AbstractSymplecticSolver):
        return None
    if constraint_of(problem.terms) is not None:
        return None
    _, friction, noise = split_friction(problem.terms)
    if not friction or not noise:
        return None
    record = solver.record
    most = None if record is None else record.most_friction
    has_flow = isinstance(solver, AbstractLangevinSplitting) and solver.flow is not None
    if most is None and not has_flow:
        return None
    rates = _quick_rates(problem)
    name = type(solver).__name__
    friction_of_step = float(rates.friction) * dt0
    angle = float(rates.squared_frequency) ** 0.5 * dt0
    if most is not None and friction_of_step > most:
        return (
            f"Steps of `dt0={dt0:g}` do not resolve the friction: momenta decay at a rate "
            f"of {friction_of_step:.3g} / `dt0` where paths start, and `{name}` has the "
            f"right temperature only up to {most:g} / `dt0`. Pass a smaller `dt0`, or "
            "`BAOAB()`, which takes every friction."
        )
    if has_flow and friction_of_step > _RESOLVED and angle > _RESOLVED:
        return (
            f"Steps of `dt0={dt0:g}` do not resolve a vibration with strong friction, "
            f"omega h = {angle:.3g} where paths start: with a `flow`, `{name}` keeps its "
            "stationary law, but takes its position to the other side in each step, and "
            "relaxes far too slowly. Pass `dt0` below 2 / omega, and `BAOAB()` if "
            "masses are constant."
        )
    return None


def _rates(problem: Problem) -> _Rates:
    """The rates by power iteration with derivatives of the drift and of the friction."""
    drift, friction, _ = split_friction(problem.terms)
    p0, q0 = problem.y0
    flat_p, unravel_p = jfu.ravel_pytree(p0)
    flat_q, unravel_q = jfu.ravel_pytree(q0)

    def friction_force(p: Array) -> Array:
        y = unravel_p(p), q0
        force, _ = rate(friction, problem.t0, y, problem.args)
        return jfu.ravel_pytree(force)[0]

    def velocity(p: Array) -> Array:
        y = unravel_p(p), q0
        _, dq = rate(drift, problem.t0, y, problem.args)
        return jfu.ravel_pytree(dq)[0]

    def force(q: Array) -> Array:
        y = p0, unravel_q(q)
        dp, _ = rate(drift, problem.t0, y, problem.args)
        return jfu.ravel_pytree(dp)[0]

    def damped(change: Array) -> Array:
        return jax.jvp(friction_force, (flat_p,), (change,))[1]

    def accelerated(change: Array) -> Array:
        moved = jax.jvp(velocity, (flat_p,), (change,))[1]
        return jax.jvp(force, (flat_q,), (moved,))[1]

    # The eigenvalues of both are real for symmetric masses, friction and stiffness, and
    # negative where friction damps and where the potential is stable.
    return _Rates(_largest_decay(damped, flat_p), _largest_decay(accelerated, flat_p))


def _largest_decay(derivative, like: Float[Array, " n"]) -> Float[Array, ""]:
    """Minus the eigenvalue of `derivative` that is largest in size, or zero if this
    eigenvalue is positive."""

    def iterate(_, change: Array) -> Array:
        image = derivative(change)
        length = jnp.linalg.norm(image)
        return jnp.where(length > 0, image / jnp.where(length > 0, length, 1), change)

    # An arbitrary direction, without the symmetries that a problem may have.
    start = jnp.cos(1.0 + jnp.arange(like.size, dtype=like.dtype))
    change = lax.fori_loop(0, _ITERATIONS, iterate, start / jnp.linalg.norm(start))
    return jnp.maximum(-(change @ derivative(change)), 0)


_quick_rates = quickly_compiled(_rates)
