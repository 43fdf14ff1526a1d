"""Whether steps are too long for the friction of Langevin terms, where paths start."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._compat import unwrapped
from .._custom_types import Terms
from .._programs import compiled
from .._simulation import Problem
from .._solver import (
    AbstractLangevinSplitting,
    AbstractSymplecticSolver,
    after_friction,
)
from .._terms import (
    apply,
    BathNoise,
    constraint_of,
    control_struct,
    Dependence,
    field_of,
    rate,
    split_friction,
    tree_sum,
)
from .fields_in_time import drift_field
from .linear_maps import derivative_at, largest_growth


# With a flow, a mode relaxes too slowly if it turns by more than this in a step, and the
# rate of its friction times the step is more than this, too. Its position then changes
# sign in each step.
_MOST_BY_FLOW = 2.0
# So many applications of power iteration find a direction, and as many more measure it.
_ITERATIONS = 15
# Where friction changes along a step by more than the first number, and over `dt0` damps
# momenta at more than the second, two levels may be wrong together. Measured for the mean
# of q^2 of a free particle after 40 steps, with a friction tensor that turns with the
# position, G = R(k q) diag(a, b) R(k q)^T. Two levels leave their bar, by two standard
# errors, from a change of 0.5 on with a h = 20 and b = a / 100; from 0.87 with b = a / 10;
# from 1.2 with a h = 5 and a h = 2; and with a h = 1 at k h v = 10, but not at 5.
_MOST_CHANGE = 0.5
_HARDLY_DAMPED = 1.0
# At how many velocities the change is measured, and after how many steps of the bath, each
# twice as long as the one before, momenta count as thermal: all that decay at more than
# 2^-16 of the largest rate have forgotten where they began.
_VELOCITIES = 16
_DOUBLINGS = 16
# Two directions count as parallel if the cosine of the angle between them is above this.
_COSINE_OF_PARALLEL = 0.9


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
    drift, friction, noise = split_friction(problem.terms)
    record = solver.record
    # In units of 1 / `dt0`; `None` if the solver takes every friction.
    most_friction = None if record is None else record.most_friction
    if drift and noise and not friction and most_friction is not None:
        return _unresolved_decay(problem, dt0, most_friction)
    if not friction or not noise:
        return None
    has_flow = isinstance(solver, AbstractLangevinSplitting) and solver.has_flow
    may_change = _depends_on_positions(problem, friction)
    if most_friction is None and not has_flow and not may_change:
        return None
    rates = _quick_rates(problem)
    name = type(solver).__name__
    friction_of_step = float(rates.friction) * dt0
    angle = float(rates.squared_frequency) ** 0.5 * dt0
    if most_friction is not None and friction_of_step > most_friction:
        return (
            f"Steps of `dt0={dt0:g}` do not resolve the friction: momenta decay at a rate "
            f"of {friction_of_step:.3g} / `dt0` where paths start, and `{name}` has the "
            f"right temperature only up to {most_friction:g} / `dt0`. Pass a smaller "
            "`dt0`, or `BAOAB()`, which takes every friction."
        )
    if has_flow and friction_of_step > _MOST_BY_FLOW and angle > _MOST_BY_FLOW:
        return (
            f"Steps of `dt0={dt0:g}` do not resolve a vibration with strong friction, "
            f"omega h = {angle:.3g} where paths start: with a `flow`, `{name}` keeps its "
            "stationary law, but takes its position to the other side in each step, and "
            "relaxes far too slowly. Pass `dt0` below 2 / omega, and `BAOAB()` if "
            "masses are constant."
        )
    if may_change and friction_of_step > _HARDLY_DAMPED:
        return _unresolved_change(problem, dt0, friction_of_step)
    return None


def _unresolved_decay(problem: Problem, dt0: float, most_friction: float) -> str | None:
    """`unresolved_friction` for friction that is a part of the drift, such as the loss of a
    wave. Only a state that decays hardly oscillating counts."""
    decay = float(_quick_decay(problem)) * dt0
    if not decay > most_friction:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve a decay: where paths start, the drift "
        f"damps the state at a rate of {decay:.3g} / `dt0`, and "
        f"`{type(problem.solver).__name__}` has the right size of fluctuations only up to "
        f"{most_friction:g} / `dt0`. Pass a smaller `dt0`."
    )


def _unresolved_change(
    problem: Problem, dt0: float, friction_of_step: float
) -> str | None:
    """`unresolved_friction` for the change of strong friction with positions."""
    change = float(_quick_change(problem, dt0))
    if not change > _MOST_CHANGE:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve how the friction changes with positions: "
        f"by {change:.0%} along one step from where paths start, at the speed of the heat "
        f"bath, while momenta decay at a rate of {friction_of_step:.3g} / `dt0`. Two "
        "levels may agree on a wrong mean, as of a diffusion. Pass a smaller `dt0`, in "
        "which the friction changes, or turns, by a small part."
    )


def _depends_on_positions(problem: Problem, friction: Terms) -> bool:
    """Whether the friction depends on positions: whether its program reads them. (Forces at
    several positions might be equal by chance.)"""
    p0, q0 = problem.y0

    def force(q: PyTree[Array], velocity: PyTree[Array]) -> Float[Array, " n"]:
        return _friction_force(problem, friction, q, velocity)

    # A velocity has the shape of its momentum.
    return not Dependence(force, q0, p0).independent(lambda q, velocity: q)


def _friction_force(
    problem: Problem, friction: Terms, q: PyTree[Array], velocity: PyTree[Array]
) -> Float[Array, " n"]:
    """`-G v` at the positions `q`, as one vector."""
    fields = [field_of(term) for term in friction]
    forces = [field.force(problem.t0, q, problem.args, velocity) for field in fields]
    return jfu.ravel_pytree(tree_sum(forces))[0]


def _change_along_step(problem: Problem, dt0: float) -> Float[Array, ""]:
    """How much the friction changes with positions along one step, relative to the friction
    where paths start. For a few thermal velocities, the force of the friction on the same
    velocity is compared before and after the step, in the root mean square."""
    drift, friction, noise = split_friction(problem.terms)
    bath_noise = tuple(term for term in noise if isinstance(unwrapped(term), BathNoise))
    p0, q0 = problem.y0
    controls = [control_struct(term, problem.t0) for term in bath_noise]

    def thermal_momentum(key: PRNGKeyArray) -> PyTree[Array]:
        """A momentum with the law of the bath, by steps of the bath alone, which keep this
        law whatever their length. The first, short ones draw the parts of the momentum that
        decay fast, and the last, long ones those that decay slowly."""

        def step_of_bath(number: Array, p: PyTree[Array]) -> PyTree[Array]:
            h = dt0 * 2.0**number
            increments = _normal_like(controls, jr.fold_in(key, number), jnp.sqrt(h))
            y = p, q0
            noise_change, _ = apply(bath_noise, increments, problem.args, problem.t0, y)
            return after_friction(
                friction, problem.t0, h, y, problem.args, noise_change
            )

        return lax.fori_loop(0, _DOUBLINGS, step_of_bath, p0)

    def squared_forces(key: PRNGKeyArray) -> tuple[Array, Array]:
        """The squares of the friction's force at the start, and of its change."""
        p = thermal_momentum(key)
        _, velocity = rate(drift, problem.t0, (p, q0), problem.args)
        q1 = jtu.tree_map(lambda q, v: q + dt0 * v, q0, velocity)
        force = _friction_force(problem, friction, q0, velocity)
        force_after = _friction_force(problem, friction, q1, velocity)
        return jnp.sum(force**2), jnp.sum((force_after - force) ** 2)

    keys = jr.split(jr.key(0), _VELOCITIES)
    squares, squared_changes = jax.vmap(squared_forces)(keys)
    return jnp.sqrt(jnp.sum(squared_changes) / jnp.sum(squares))


def _normal_like(structs: PyTree, key: PRNGKeyArray, scale: Array) -> PyTree[Array]:
    """Normal numbers with this standard deviation, in these shapes and dtypes."""
    leaves, treedef = jtu.tree_flatten(structs)
    keys = jr.split(key, len(leaves))
    draws = [
        scale.astype(leaf.dtype) * jr.normal(leaf_key, leaf.shape, leaf.dtype)
        for leaf, leaf_key in zip(leaves, keys)
    ]
    return treedef.unflatten(draws)


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

    # The derivatives of the equation `dp/dt = force(q) + friction_force(p)`,
    # `dq/dt = velocity(p)`, each a linear map of changes of `p` or `q`.
    force_by_p = derivative_at(friction_force, flat_p)
    velocity_by_p = derivative_at(velocity, flat_p)
    force_by_q = derivative_at(force, flat_q)

    def second_derivative_of_p(change: Array) -> Array:
        return force_by_q(velocity_by_p(change))

    def negative_eigenvalue(linear: Callable[[Array], Array]) -> Float[Array, ""]:
        """The size of the largest eigenvalue if that is negative, and otherwise zero."""
        # Eigenvalues are real for symmetric masses, friction and stiffness. They are
        # negative where friction damps, and where the potential is stable.
        growth = largest_growth(linear, flat_p, _ITERATIONS)
        return jnp.maximum(-growth.rayleigh_quotient, 0)

    return _Rates(
        friction=negative_eigenvalue(force_by_p),
        squared_frequency=negative_eigenvalue(second_derivative_of_p),
    )


def _decay(problem: Problem) -> Float[Array, ""]:
    """The rate at which the drift damps the state, at `y0`, in the direction in which it
    changes most; zero if the state grows or oscillates there."""
    drift, _, _ = split_friction(problem.terms)
    field = drift_field(drift, problem.args)
    flat_y0, unravel = jfu.ravel_pytree(problem.y0)

    def rate_of_drift(x: Array) -> Array:
        return field(jnp.asarray(problem.t0), unravel(x))

    derivative = derivative_at(rate_of_drift, flat_y0)
    direction = largest_growth(derivative, flat_y0, _ITERATIONS).direction
    once = derivative(direction)
    twice = derivative(once)
    # The derivative of a decay turns its direction around, and applied twice back again.
    # That of an oscillation may also turn it around, where positions and momenta differ
    # much in size. But applied twice it is -omega^2, which does not turn it back.
    turns_around = _cosine(direction, once) < -_COSINE_OF_PARALLEL
    turns_back = _cosine(direction, twice) > _COSINE_OF_PARALLEL
    # Where the derivative is zero, cosines are NaN, and both comparisons false.
    return jnp.where(turns_around & turns_back, jnp.linalg.norm(once), 0)


def _cosine(x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, ""]:
    """The cosine of the angle between two vectors; NaN if one of them is zero."""
    return x @ y / (jnp.linalg.norm(x) * jnp.linalg.norm(y))


_quick_rates = compiled(_rates, quickly=True)
_quick_change = compiled(_change_along_step, quickly=True)
_quick_decay = compiled(_decay, quickly=True)
