"""Whether steps are too long for an explicit solver, where paths start."""

from typing import NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._compat import quickly_compiled
from .._simulation import Problem
from .._solver import AbstractSymplecticSolver
from .._terms import brownian_paths, constraint_of, has_unknown_law


# A step that enlarges a small change of the state by more than this, and turns it around,
# is unstable. Exact flows turn changes around, too, but over a step that resolves them they
# do not enlarge them at the same time. `StormerVerlet` has it for omega h = 2.003.
_UNSTABLE = 1.1
# So many steps of the tangent flow leave the most unstable direction of a random one. As
# many more show its growth.
_ITERATIONS = 50


class _Growth(NamedTuple):
    """How a small change of the state grows in steps that are all taken from one state.

    - `change`: the change, scaled to length one.
    - `log`: the logarithm of its growth so far.
    - `along_itself`: the scalar product of the change after the last step with the one
        before it. It is negative if the step turned the change around.
    """

    change: Float[Array, " n"]
    log: Float[Array, ""]
    along_itself: Float[Array, ""]


def is_unstable_at_start(problem: Problem) -> bool:
    """Whether an explicit solver of this package's kind is unstable at the start of a path,
    with steps of `dt0` and increments of zero. Two levels need not show it: where forces
    are bounded, steps of `dt0` and half of it may both leave a random state."""
    solver = problem.solver
    if not isinstance(solver, AbstractSymplecticSolver) or solver.stage_vectors(1):
        return False
    if constraint_of(problem.terms) is not None:
        return False
    if any(map(has_unknown_law, brownian_paths(problem.terms))):
        return False
    growth = _quick_growth(problem)
    return bool(
        growth.log > _ITERATIONS * np.log(_UNSTABLE) and growth.along_itself < 0
    )


def _growth(problem: Problem) -> _Growth:
    """The growth of the change that a step enlarges most."""
    h = problem.level(0).h
    variables = problem.variables(h)
    terms = variables.terms_with(jnp.zeros(len(variables.laws)))
    flat, unravel = jfu.ravel_pytree(problem.y0)

    def step(x: Array) -> Array:
        y = unravel(x)
        y1, *_ = problem.step(terms, 0, h, y, problem.init(terms, 0, h, y))
        return jfu.ravel_pytree(y1)[0]

    def after_step(number: Array, before: _Growth) -> _Growth:
        _, after = jax.jvp(step, (flat,), (before.change,))
        length = jnp.linalg.norm(after)
        counted = jnp.where(number < _ITERATIONS, 0.0, jnp.log(length))
        along_itself = before.change @ after
        return _Growth(after / length, before.log + counted, along_itself)

    # No symmetry singles it out.
    change = jnp.cos(1.0 + jnp.arange(flat.size, dtype=flat.dtype))
    zero = jnp.zeros((), flat.dtype)
    start = _Growth(change / jnp.linalg.norm(change), zero, zero)
    return lax.fori_loop(0, 2 * _ITERATIONS, after_step, start)


_quick_growth = quickly_compiled(_growth)
