"""The multipliers of a constraint, by Newton's method; and sums of vectors, for short
vectors in a form that XLA compiles well."""

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
    - `residual`: the values of the constraints before the last correction, which was to
        make them zero.
    - `correction`: the last correction, which was subtracted from the multipliers.
    - `remaining`: how many corrections may follow; `_SOLVED` if the method has converged,
        and 0 if it failed. (With three arrays in place of this one, a count and two flags,
        steps of 1,000 rigid dimers took 1.2 times as long.)
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
    """The multipliers, a root of `residual`, and whether they were found. If not, they are
    zero.

    - `residual`: the values of the constraints as a function of the multipliers.
    - `gram`: a matrix of about the size of the derivative of `residual`.
    - `rounding`: the change of the constraints by rounding errors of the positions.
    - `start`: the multipliers to start from.
    - `pending`: if false, no step is taken and nothing is found, so that in a batch a path
        that failed before does not keep the others waiting.

    Newton's method ends when the next correction would be below rounding errors. Each step

    1. computes a correction;
    2. estimates how small the next correction would be, from the change of the derivative
        of `residual` along the last correction;
    3. ends the method if the next correction would change no constraint by more than
        rounding errors.

    It would not do to wait for a correction below the rounding errors of the positions. It
    may never be so small: near the origin `(q - 1)**2 - 1` is a difference of numbers that
    are larger than `q`, and so are its rounding errors. How large these numbers are is not
    known from the positions, nor from the constraint, which is zero.
    """
    # About the change of each constraint by each multiplier.
    slopes = jnp.abs(gram)
    relative_rounding = _ROUNDING_UNITS * float(jnp.finfo(start.dtype).eps)

    def is_going(state: _Newton) -> Bool[Array, ""]:
        return state.remaining > 0

    def step(state: _Newton) -> _Newton:
        newton = correction(residual, state.x, None)
        # The most that this correction, and the last one, change each constraint.
        change = weighted_sum(jnp.abs(newton.change), slopes)
        change_before = weighted_sum(jnp.abs(state.correction), slopes) + rounding
        # How much the derivative along the last correction has changed by that correction.
        # The old derivative times the last correction was `state.residual`.
        bend = jnp.abs(newton.derivative(state.correction) - state.residual)
        # Convergence is quadratic: if this correction is r times the last one, the next one
        # is about r^2 times this one. There are two estimates of r, `change /
        # change_before` and `bend / change_before / 2`, since the last correction has left
        # half of `bend` in the constraints. Their product without the factor 1/2 is on the
        # safe side. (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.)
        # Ratios are taken constraint by constraint, since these differ in units.
        fraction = max_norm(change / change_before) * max_norm(bend / change_before)
        # The first correction has no other before it, from which to estimate the next one.
        fraction = jnp.where(state.remaining < _MOST_STEPS, fraction, 1)
        # `change * fraction`: the most that the next correction changes each constraint.
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
    """The solution `x` of the linear equations `apply(x) = rhs`: the `tangent_solve` of
    `lax.custom_root`, for the derivative of the multipliers."""
    # The columns of the matrix of `apply` are the images of the unit vectors.
    matrix = jax.vmap(apply, out_axes=1)(jnp.eye(len(rhs), dtype=rhs.dtype))
    return solve_matrix(matrix, rhs)


def products(a: Float[Array, "c n"], b: Float[Array, "d n"]) -> Float[Array, "c d"]:
    """The scalar products of all rows of `a` with all rows of `b`."""
    # (n, c, d), summed over the first axis.
    return _total(a.T[:, :, None] * b.T[:, None, :])


def weighted_sum(x: Multipliers, vectors: Float[Array, "c n"]) -> Vector:
    """The sum of the rows of `vectors`, each times its number in `x`."""
    # (c, n), summed over the first axis.
    return _total(x[:, None] * vectors)


# Sums over axes up to this length are unrolled, so that XLA fuses them. For other sums and
# for products of matrices, XLA calls a library on CPUs: with these, steps of rigid dimers
# took three times as long.
_MOST_UNROLLED = 32


def _total(x: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """The sum over the first axis."""
    if len(x) <= _MOST_UNROLLED:
        return ft.reduce(operator.add, x)
    return jnp.sum(x, axis=0)
