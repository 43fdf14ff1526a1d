"""Whether steps are too long for the friction of Langevin terms, in the state in which
paths start.

A rate of decay is compared with the length of a step by its product with `dt0`. A number
that is NaN gives no warning: each comparison with it is false.
"""

import functools as ft

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._compat import unwrapped
from .._custom_types import Terms
from .._programs import compiled, once_for_each_signature
from .._simulation import Problem
from .._solver import (
    AbstractLangevinSplitting,
    AbstractSymplecticSolver,
    after_friction,
)
from .._terms import (
    BathNoise,
    constraint_of,
    Dependence,
    field_of,
    rate,
    split_friction,
    tree_sum,
)
from .fields_in_time import change_by_increments, drift_rate
from .linear_maps import largest_growth, linearized
from .long_steps import drift_frequencies


# A splitting with a flow relaxes a mode too slowly if both the angle by which the mode
# turns in a step, and its rate of friction times the step, are more than this. The position
# then changes its sign in each step.
_MOST_BY_FLOW = 2.0
# This many applications of power iteration find a direction, and as many more measure its
# growth.
_ITERATIONS = 15
# Two levels may agree on a wrong mean if the friction changes along a step by more than the
# first number, relative to itself, and its rate times `dt0` is more than the second.
# Measured for the mean of q^2 of a free particle after 40 steps, with a friction tensor
# that turns with the position, G = R(k q) diag(a, b) R(k q)^T. Two levels leave their error
# bar, by two standard errors, from a change of 0.5 on with a h = 20 and b = a / 100; from
# 0.87 with b = a / 10; from 1.2 with a h = 5 and a h = 2; and with a h = 1 at k h v = 10,
# but not at 5.
_MOST_CHANGE = 0.5
_HARDLY_DAMPED = 1.0
# The change is measured at this many velocities.
_VELOCITIES = 16
# Momenta count as thermal after this many steps of the bath, each twice as long as the one
# before: all momenta that decay at more than 2^-16 of the largest rate have then forgotten
# where they began.
_DOUBLINGS = 16
# Two directions count as parallel if the cosine of the angle between them is above this.
_COSINE_OF_PARALLEL = 0.9


def unresolved_friction(problem: Problem, dt0: float) -> str | None:
    """A warning if steps of `dt0` do not resolve the friction where paths start; `None` if
    they do, or for solvers of other packages.

    Two levels need not show unresolved friction: momenta may be wrong by about the same
    factor on both levels, and positions may rest on both. The first of these that applies
    gives the warning:

    - There are no terms of friction, but the drift damps the state too fast.
    - The friction damps momenta too fast for the solver.
    - The flow of a splitting turns a mode too far, for strong friction.
    - The friction changes too much along a step."""
    solver = problem.solver
    is_own = isinstance(solver, AbstractSymplecticSolver)
    if not is_own or constraint_of(problem.terms) is not None:
        return None
    drift, friction, noise = split_friction(problem.terms)
    if not noise:
        return None
    # The largest rate of friction times `dt0` that the solver takes; `None` for any rate.
    most_friction = None if solver.record is None else solver.record.most_friction
    if not friction:
        if not drift or most_friction is None:
            return None
        return _unresolved_decay(problem, dt0, most_friction)
    has_flow = isinstance(solver, AbstractLangevinSplitting) and solver.has_flow
    may_change = _may_change(problem)
    if most_friction is None and not has_flow and not may_change:
        return None
    # The rate takes a program to compile, so it is computed only if a check needs it.
    damping = float(_friction_rate(problem)) * dt0
    if most_friction is not None and damping > most_friction:
        return (
            f"Steps of `dt0={dt0:g}` do not resolve the friction: momenta decay at a rate "
            f"of {damping:.3g} / `dt0` where paths start, and `{type(solver).__name__}` "
            f"has the right temperature only up to {most_friction:g} / `dt0`. Pass a "
            "smaller `dt0`, or `BAOAB()`, which takes every friction."
        )
    message = None
    if has_flow and damping > _MOST_BY_FLOW:
        message = _unresolved_vibration(problem, dt0)
    if message is None and may_change and damping > _HARDLY_DAMPED:
        message = _unresolved_change(problem, dt0, damping)
    return message


def _unresolved_decay(problem: Problem, dt0: float, most_friction: float) -> str | None:
    """A warning if the drift damps the state too fast for the solver, as the loss of a wave
    does. `most_friction` is the largest rate times `dt0` that the solver takes."""
    decay = float(_decay(problem)) * dt0
    if not decay > most_friction:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve a decay: where paths start, the drift "
        f"damps the state at a rate of {decay:.3g} / `dt0`, and "
        f"`{type(problem.solver).__name__}` has the right size of fluctuations only up to "
        f"{most_friction:g} / `dt0`. Pass a smaller `dt0`."
    )


def _unresolved_vibration(problem: Problem, dt0: float) -> str | None:
    """A warning if the flow of a splitting turns a mode too far, for strong friction."""
    (frequency,) = drift_frequencies(problem, np.zeros(1, problem.dtype))
    angle = float(frequency) * dt0
    if not angle > _MOST_BY_FLOW:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve a vibration with strong friction, omega h "
        f"= {angle:.3g} where paths start: with a `flow`, "
        f"`{type(problem.solver).__name__}` keeps its stationary law, but takes its "
        "position to the other side in each step, and relaxes far too slowly. Pass `dt0` "
        "below 2 / omega, and `BAOAB()` if masses are constant."
    )


def _unresolved_change(problem: Problem, dt0: float, damping: float) -> str | None:
    """A warning if the friction changes too much along a step. `damping` is its rate times
    `dt0`."""
    change = float(_change_along_step(problem))
    if not change > _MOST_CHANGE:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve how the friction changes with positions: "
        f"by {change:.0%} along one step from where paths start, at the speed of the heat "
        f"bath, while momenta decay at a rate of {damping:.3g} / `dt0`. Two levels may "
        "agree on a wrong mean, as of a diffusion. Pass a smaller `dt0`, in which the "
        "friction changes, or turns, by a small part."
    )


@once_for_each_signature
def _may_change(problem: Problem) -> bool:
    """Whether the friction may change with the positions: whether its program reads them.
    (Forces at several positions might be equal by chance.)"""
    _, friction, _ = split_friction(problem.terms)
    force = ft.partial(_friction_force, problem, friction)
    p0, q0 = problem.y0
    # A velocity has the shape of its momentum.
    return not Dependence(force, q0, p0).independent(lambda q, velocity: q)


def _friction_force(
    problem: Problem, friction: Terms, q: PyTree[Array], velocity: PyTree[Array]
) -> Float[Array, " n"]:
    """The force `-G(q) v` of the friction at the positions `q` and the velocity `v`, as one
    vector."""
    fields = [field_of(term) for term in friction]
    forces = [field.force(problem.t0, q, problem.args, velocity) for field in fields]
    return jfu.ravel_pytree(tree_sum(forces))[0]


@ft.partial(compiled, quickly=True)
def _change_along_step(problem: Problem) -> Float[Array, ""]:
    """How much the friction, with the force `-G(q) v`, changes along the first step because
    positions change: the root mean square of `G(q1) v - G(q0) v`, divided by that of `G(q0)
    v`, over a few thermal velocities `v`. The step takes `q0` to `q1 = q0 + dt0 v`."""
    t0 = problem.t0
    dt0 = problem.level(0).h
    p0, q0 = problem.y0
    drift, friction, noise = split_friction(problem.terms)
    bath_noise = tuple(term for term in noise if isinstance(unwrapped(term), BathNoise))
    noise_change, zeros = change_by_increments(bath_noise, problem.args, t0)

    def thermal_momentum(key: PRNGKeyArray) -> PyTree[Array]:
        """A momentum with the law of the heat bath. It is drawn by steps of the bath alone,
        which keep this law whatever their length: of length `dt0`, `2 dt0`, `4 dt0` and so
        on. The first steps are short, and draw the parts of the momentum that decay fast.
        The last steps are long, and draw the parts that decay slowly."""

        def step_of_bath(doublings: Array, p: PyTree[Array]) -> PyTree[Array]:
            h = dt0 * 2.0**doublings
            draws = jr.normal(jr.fold_in(key, doublings), zeros.shape, zeros.dtype)
            increments = jnp.sqrt(h).astype(zeros.dtype) * draws
            y = p, q0
            momentum_change, _ = noise_change(y, increments)
            return after_friction(friction, t0, h, y, problem.args, momentum_change)

        return lax.fori_loop(0, _DOUBLINGS, step_of_bath, p0)

    def squared_forces(key: PRNGKeyArray) -> tuple[Array, Array]:
        """The squares of `G(q0) v`, and of `G(q1) v - G(q0) v`."""
        p = thermal_momentum(key)
        _, velocity = rate(drift, t0, (p, q0), problem.args)
        q1 = jtu.tree_map(lambda q, v: q + dt0 * v, q0, velocity)
        force = _friction_force(problem, friction, q0, velocity)
        force_after = _friction_force(problem, friction, q1, velocity)
        return jnp.sum(force**2), jnp.sum((force_after - force) ** 2)

    keys = jr.split(jr.key(0), _VELOCITIES)
    squares, squared_changes = jax.vmap(squared_forces)(keys)
    return jnp.sqrt(jnp.sum(squared_changes) / jnp.sum(squares))


@ft.partial(compiled, quickly=True)
def _friction_rate(problem: Problem) -> Float[Array, ""]:
    """The largest rate at which friction damps a momentum where paths start: minus the
    largest eigenvalue, in size, of the derivative of its force by the momentum; zero if
    this eigenvalue is positive."""
    _, friction, _ = split_friction(problem.terms)
    p0, q0 = problem.y0

    def force(t: Array, p: PyTree[Array]) -> PyTree[Array]:
        return rate(friction, t, (p, q0), problem.args)[0]

    force_by_p, flat_p0 = linearized(force, problem.t0, p0)
    growth = largest_growth(force_by_p, flat_p0, _ITERATIONS)
    # Eigenvalues are real for symmetric masses and friction, and negative where friction
    # damps. Power iteration finds the one of largest size.
    return jnp.maximum(-growth.rayleigh_quotient, 0)


@ft.partial(compiled, quickly=True)
def _decay(problem: Problem) -> Float[Array, ""]:
    """The rate at which the drift damps the state, at `y0`, in the direction in which it
    changes the state most; zero if the state grows or oscillates in this direction."""
    drift, _, _ = split_friction(problem.terms)
    field = jtu.Partial(drift_rate, drift, problem.args)
    derivative, flat_y0 = linearized(field, problem.t0, problem.y0)
    direction = largest_growth(derivative, flat_y0, _ITERATIONS).direction
    once = derivative(direction)
    twice = derivative(once)
    # For a decay, the derivative turns the direction around, and applied twice turns it
    # back. For an oscillation, the derivative may also turn the direction around, if
    # positions and momenta differ much in size. But applied twice it multiplies by
    # -omega^2, so the direction is not turned back.
    turns_around = _cosine(direction, once) < -_COSINE_OF_PARALLEL
    turns_back = _cosine(direction, twice) > _COSINE_OF_PARALLEL
    # Where the derivative is zero, cosines are NaN, and both comparisons false.
    return jnp.where(turns_around & turns_back, jnp.linalg.norm(once), 0)


def _cosine(x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, ""]:
    """The cosine of the angle between two vectors; NaN if one of them is zero."""
    return x @ y / (jnp.linalg.norm(x) * jnp.linalg.norm(y))
