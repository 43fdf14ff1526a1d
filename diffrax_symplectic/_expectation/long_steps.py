"""Whether steps are too long for an explicit solver, where paths start."""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from .._compat import quickly_compiled
from .._simulation import Problem
from .._solver import AbstractSymplecticSolver
from .._terms import brownian_paths, constraint_of, has_unknown_law


# A step that enlarges a small change of the state by more than this, and turns it around,
# is unstable. Exact flows turn changes around, too, but over a step that resolves them they
# do not enlarge them at the same time. On an oscillator of frequency omega the steps of
# `StormerVerlet` enlarge changes by this factor at omega h = 2.003.
_UNSTABLE = 1.1
# After this many steps of the tangent flow any change of the state points in the most
# unstable direction. Its growth is measured over as many more steps.
_ITERATIONS = 50
# The part of `dt0` that is surely short enough. If such a step fails, too, the length of
# steps is not the cause.
_SHORT = 1e-6


class _Growth(NamedTuple):
    """How a small change of the state grows in steps that are all taken from one state.

    - `change`: the change, scaled to length one.
    - `log_growth`: the logarithm of the factor by which it grew in the steps that count.
    - `along_itself`: the scalar product of the change after the last step with the one
        before it. It is negative if the step turned the change around.
    """

    change: Float[Array, " n"]
    log_growth: Float[Array, ""]
    along_itself: Float[Array, ""]


def is_unstable_at_start(problem: Problem) -> bool:
    """Whether an explicit solver of this package is unstable at the start of a path, with
    steps of `dt0` and increments of zero. Two levels need not show it: where forces are
    bounded, steps of `dt0` and half of it may both leave a random state.

    This sees the frequencies at `y0` alone. To look at the states of a path without noise,
    too, would not find the usual case: on an ellipse of eccentricity 0.8 steps of a
    thirtieth of the period jump over the nearest point, where they are too long, and the
    states on either side of it look stable."""
    if not isinstance(problem.solver, AbstractSymplecticSolver):
        return False
    if not _is_explicit(problem) or not _has_step_without_noise(problem):
        return False
    growth = _quick_growth(problem)
    grows = growth.log_growth > _ITERATIONS * np.log(_UNSTABLE)
    turns_around = growth.along_itself < 0
    return bool(grows and turns_around)


def may_be_too_long(problem: Problem) -> bool:
    """Whether the length of steps is the likely cause if most paths fail: for an explicit
    solver whose step without noise succeeds from `y0` if it is very short, with a finite
    `phi` after it."""
    if not _is_explicit(problem) or not _has_step_without_noise(problem):
        return False
    return bool(_quick_short_step_succeeds(problem))


def _is_explicit(problem: Problem) -> bool:
    """Whether the solver is known to be explicit: one of this package without implicit
    stages, or an explicit Runge-Kutta method of Diffrax."""
    solver = problem.solver
    if isinstance(solver, AbstractSymplecticSolver):
        return not solver.stage_vectors(1)
    return isinstance(solver, diffrax.AbstractERK)


def _has_step_without_noise(problem: Problem) -> bool:
    """Whether increments can be set to zero."""
    if constraint_of(problem.terms) is not None:
        return False
    return not any(map(has_unknown_law, brownian_paths(problem.terms)))


def _terms_without_noise(problem: Problem, h: Any) -> PyTree:
    """The terms with increments of zero."""
    variables = problem.variables(h)
    return variables.terms_with(jnp.zeros(len(variables.laws)))


def _short_step_succeeds(problem: Problem) -> Bool[Array, ""]:
    """Whether a very short step without noise succeeds, with a finite `phi` after it."""
    h = _SHORT * problem.level(0).h
    terms = _terms_without_noise(problem, h)
    state = problem.init(terms, 0, h, problem.y0)
    y, _, success = problem.step(terms, 0, h, problem.y0, state)
    return success & jnp.all(jnp.isfinite(problem.values(problem.t0, y)))


def _growth(problem: Problem) -> _Growth:
    """The growth of the change that a step from `y0` enlarges most, by power iteration with
    the derivative of the step."""
    h = problem.level(0).h
    terms = _terms_without_noise(problem, h)
    flat_y0, unravel = jfu.ravel_pytree(problem.y0)

    def step(x: Array) -> Array:
        y = unravel(x)
        y1, *_ = problem.step(terms, 0, h, y, problem.init(terms, 0, h, y))
        return jfu.ravel_pytree(y1)[0]

    def after_step(number: Array, before: _Growth) -> _Growth:
        _, change = jax.jvp(step, (flat_y0,), (before.change,))
        # The change before the step has length one, so this is its growth.
        length = jnp.linalg.norm(change)
        counted_log = jnp.where(number < _ITERATIONS, 0.0, jnp.log(length))
        along_itself = before.change @ change
        return _Growth(change / length, before.log_growth + counted_log, along_itself)

    # An arbitrary direction, without the symmetries that a problem may have: it contains
    # the most unstable one.
    direction = jnp.cos(1.0 + jnp.arange(flat_y0.size, dtype=flat_y0.dtype))
    zero = jnp.zeros((), flat_y0.dtype)
    start = _Growth(direction / jnp.linalg.norm(direction), zero, zero)
    return lax.fori_loop(0, 2 * _ITERATIONS, after_step, start)


_quick_growth = quickly_compiled(_growth)
_quick_short_step_succeeds = quickly_compiled(_short_step_succeeds)
