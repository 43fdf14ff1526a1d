"""The multipliers of a constraint, by Newton's method, and the sums over vectors that they
and the constraints need."""

import functools as ft
import operator
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..._batch import batched_like
from ..._root_finder import correction, max_norm, solve_matrix


Vector: TypeAlias = Float[Array, " n"]
Multipliers: TypeAlias = Float[Array, " c"]

# Newton's method takes three or four steps, and up to twice as many from far away.
_MOST_STEPS = 30
# Changes of a number by up to so many units in the last place are rounding errors.
_ROUNDING_UNITS = 10.0


class _Newton(NamedTuple):
    """The state of Newton's method.

    - `x`: the multipliers.
    - `residual`: the constraints before their last correction.
    - `correction`: the last correction.
    - `remaining`: how many corrections may follow; `_SOLVED` after the last one, and 0 if
        the method failed. (With an array for each of the three, steps of 1,000 rigid dimers
        took 1.2 times as long.)
    """

    x: Multipliers
    residual: Multipliers
    correction: Multipliers
    remaining: Array


_SOLVED = -1


def find_multipliers(
    residual: Callable,
    gram: Float[Array, "c c"],
    rounding: Multipliers,
    start: Multipliers,
    pending: Bool[Array, ""],
) -> tuple[Multipliers, Bool[Array, ""]]:
    """The root of `residual`, from `start`, and whether it was found; otherwise zero.

    - `residual`: the constraints as a function of the multipliers.
    - `gram`: about the size of its derivative.
    - `rounding`: the change of the constraints by rounding errors of the positions.
    - `pending`: if false, no step is taken and nothing is found, so that in a batch a path
        that failed before does not keep the others waiting.

    The method ends when the next correction would be below rounding errors, by the change
    of the derivative in the last one. Corrections themselves may never get as small as the
    rounding errors of the positions: near the origin `(q - 1)**2 - 1` is a difference of
    numbers larger than `q`. How large is not known, neither from the positions nor from the
    constraint, which is zero.
    """
    slopes = jnp.abs(gram)
    relative_rounding = _ROUNDING_UNITS * float(jnp.finfo(start.dtype).eps)

    def is_going(state: _Newton) -> Bool[Array, ""]:
        return state.remaining > 0

    def step(state: _Newton) -> _Newton:
        newton = correction(residual, state.x, None)
        # At most, this correction and the one before change each constraint by so much.
        change = weighted_sum(jnp.abs(newton.change), slopes)
        change_before = weighted_sum(jnp.abs(state.correction), slopes) + rounding
        # The change of the derivative along the correction before. The old derivative times
        # that correction was `state.residual`, the residual that it was to remove. The
        # change has the units of each constraint, so that none hides others.
        bend = jnp.abs(newton.derivative(state.correction) - state.residual)
        # The next correction is at most this fraction of this one. (Half of the bend is
        # what was left to this one, and the square of the ratio of both is left to the
        # next: Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.)
        fraction = max_norm(change / change_before) * max_norm(bend / change_before)
        # The first correction has none before it, and so no estimate of the next.
        fraction = jnp.where(state.remaining < _MOST_STEPS, fraction, 1)
        # The inequality is strict, since infinite corrections, for which both sides are
        # infinite, solve nothing.
        is_solved = jnp.all(change * fraction < rounding + relative_rounding * change)
        failed = jnp.any(jnp.isnan(change))
        remaining = jnp.where(failed, 0, state.remaining - 1)
        return _Newton(
            x=state.x - newton.change,
            residual=newton.residual,
            correction=newton.change,
            remaining=jnp.where(is_solved, _SOLVED, remaining),
        )

    first = _Newton(
        x=start,
        residual=jnp.zeros_like(start),
        correction=jnp.zeros_like(start),
        remaining=jnp.where(pending, _MOST_STEPS, 0),
    )
    first = batched_like(first, (residual(start), gram, rounding, pending))
    last = lax.while_loop(is_going, step, first)
    found = last.remaining == _SOLVED
    return jnp.where(found, last.x, 0), found


def solve_tangent(apply: Callable, rhs: Multipliers) -> Multipliers:
    """Solves the linear equations `apply(x) = rhs` for the derivative of the multipliers,
    in the form that `lax.custom_root` asks for."""
    # Its columns are the images of the unit vectors.
    matrix = jax.vmap(apply, out_axes=1)(jnp.eye(len(rhs), dtype=rhs.dtype))
    return solve_matrix(matrix, rhs)


def products(a: Float[Array, "c n"], b: Float[Array, "d n"]) -> Float[Array, "c d"]:
    """The scalar products of all rows of `a` with all rows of `b`."""
    # (n, c, d), summed over the first axis.
    return _total(a.T[:, :, None] * b.T[:, None, :])


def weighted_sum(x: Multipliers, vectors: Float[Array, "c n"]) -> Vector:
    """The sum of the vectors, the rows, times the numbers `x`."""
    # (c, n), summed over the first axis.
    return _total(x[:, None] * vectors)


# Sums over axes up to this length are unrolled, so that XLA fuses them. On CPUs it calls a
# library for each other sum or product of matrices: steps of rigid dimers took three times
# as long.
_MOST_UNROLLED = 32


def _total(x: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """The sum over the first axis."""
    return (
        ft.reduce(operator.add, x) if len(x) <= _MOST_UNROLLED else jnp.sum(x, axis=0)
    )
