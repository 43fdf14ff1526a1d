"""Newton's method with continuation, for stragglers."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from .._batch import batched_like
from .._custom_types import IntScalarLike
from .linear import correction
from .tolerance import all_finite, converged, largest, log2, max_norm, ratio, Tolerance


_Vector: TypeAlias = Float[Array, " n"]

# The number of iterations for the whole step after which corrections must shrink. From a
# poor guess the first few may grow although the method converges.
_MAY_GROW_IN_WHOLE_STEP = 8
# In a part of the step, corrections must shrink as soon as there are two to compare.
_MAY_GROW_IN_PART = 2
# The most iterations for a part of the step, which starts near a solution: there Newton's
# method converges soon or not at all.
_MOST_IN_PART = 4
# A correction makes progress if it is below this fraction of the previous one.
_SHRINKAGE_OF_PROGRESS = 0.5
# A part of the step is solved once corrections are below this fraction of the iterate. It
# only serves as the guess for the next part.
_TOLERANCE_OF_PART = 0.1
# Near a solution Newton's method converges quadratically. Corrections there that are above
# this fraction of the previous one have reached rounding errors.
_SHRINKAGE_AT_ROUNDING = 0.25
# The next part is twice as long after a success, and a quarter as long after a failure.
_FACTOR_AFTER_SUCCESS = 2.0
_FACTOR_AFTER_FAILURE = 0.25
# When parts, as fractions of the step, get this short, the branch of solutions from the
# start of the step has turned back: the step has no solution on it. Solutions on other
# branches are no steps.
_SHORTEST_PART = 1e-3


class Progress(NamedTuple):
    r"""The state of the continuation. With the residual $r$ and the guess $k_0$ it solves
    $(1 - s) (k - k_0) + s\, r(k) = 0$ for $s \in [0, 1]$. For $k_0 = 0$ this is
    $k = s\, \Phi(k)$: the equations of a step with its length and increments scaled by $s$.

    - `anchor`: the approximate solution at `reached`.
    - `reached`, `target`: the last $s$ solved, and the $s$ being solved for.
    - `tries`: the number of iterations for this target.
    - `size`: the size of the last correction, in units of the tolerance.
    - `is_solved`: whether the full equations are solved.
    - `has_turned_back`: whether the branch of solutions from $s = 0$ ends before $s = 1$.
    """

    anchor: _Vector
    reached: Scalar
    target: Scalar
    tries: IntScalarLike
    size: Scalar
    is_solved: Bool[Array, ""]
    has_turned_back: Bool[Array, ""]


def solve_by_newton(
    residual: Callable[[_Vector], _Vector],
    guess: _Vector,
    start: _Vector,
    restore: Callable[[_Vector], PyTree[Array]],
    scale: Callable[[PyTree[Array]], PyTree[Array]],
    tolerance: Tolerance,
    linear_solver: lx.AbstractLinearSolver | None,
    max_iterations: int,
) -> tuple[_Vector, optx.RESULTS]:
    """Solves `residual(k) = 0` for a vector `k` by Newton's method: first the full
    equations from `guess`, and if that fails, part by part from `start` (see `Progress`).
    Returns the last iterate, and success or the reason why it is no solution.

    - `restore`: maps the vector to the PyTree that `scale` and `tolerance` take.
    - `scale`: maps unknowns to the size of the state that they change.
    """

    def is_going(carry: tuple) -> Bool[Array, ""]:
        count, _, progress = carry
        in_time = count < max_iterations
        return in_time & ~progress.is_solved & ~progress.has_turned_back

    def iterate(carry: tuple) -> tuple:
        """One iteration for the current target, and the choice of the next target. After
        the iteration the whole step `is_solved`, or `part_is_solved`, or Newton's method
        `has_failed`, or none of these and the target stays the same."""
        count, k, progress = carry
        s = progress.target
        is_whole_step = progress.target == 1

        def equations(k: _Vector) -> _Vector:
            return (1 - s) * (k - start) + s * residual(k)

        newton = correction(equations, k, linear_solver)
        next_k = k - newton.change
        scale_of_next = scale(restore(next_k))
        correction_size = tolerance.measure(restore(newton.change), scale_of_next)
        size = correction_size.size
        # The first correction has none to be compared with.
        shrinkage = jnp.where(progress.tries > 0, ratio(size, progress.size), 1)
        has_converged = converged(
            log2(size),
            log2(shrinkage),
            correction_size.is_rounding,
            has_stalled=shrinkage >= _SHRINKAGE_AT_ROUNDING,
        )
        size_of_iterate = max_norm(k)
        residual_fits = _residual_fits(
            newton.residual, size_of_iterate, scale_of_next, tolerance.atol
        )
        is_correct = newton.found & residual_fits & all_finite(next_k)
        is_solved = has_converged & is_whole_step & is_correct
        is_near = max_norm(newton.change) < _TOLERANCE_OF_PART * size_of_iterate
        part_is_solved = is_near & ~is_whole_step
        next_progress = progress._replace(
            tries=progress.tries + 1, size=size, is_solved=is_solved
        )
        is_stuck = _is_stuck(next_progress, shrinkage, is_whole_step)
        has_failed = is_stuck & ~part_is_solved & ~is_solved
        return count + 1, *_next_target(
            next_progress, next_k, part_is_solved, has_failed
        )

    # With `optx.root_find` a step would take a seventh longer to trace.
    zero = jnp.zeros((), start.dtype)
    false = jnp.array(False)
    first = Progress(
        anchor=start,
        reached=zero,
        target=zero + 1,
        tries=jnp.array(0),
        size=zero,
        is_solved=false,
        has_turned_back=false,
    )
    first, count = batched_like((first, jnp.array(0)), guess)
    _, k, progress = lax.while_loop(is_going, iterate, (count, guess, first))
    R: Any = optx.RESULTS
    # Where steps leave the domain of the equations, the last correction is not finite.
    no_solution = R.where(
        jnp.isfinite(progress.size), R.nonlinear_divergence, R.nonfinite
    )
    failure = R.where(
        progress.has_turned_back, no_solution, R.nonlinear_max_steps_reached
    )
    return k, R.where(progress.is_solved, R.successful, failure)


def _residual_fits(
    residual: _Vector, size_of_iterate: Scalar, scale: PyTree[Array], atol: float
) -> Bool[Array, ""]:
    """Whether the residual is no larger than the iterate or the state, whose size is
    `scale`, as for any solution. Far from solutions, rounding errors of a large Jacobian
    can hide the unknowns with small coefficients: corrections are then small, but not the
    residual."""
    size_of_state = largest([max_norm(x) for x in jtu.tree_leaves(scale)])
    allowed_size = jnp.maximum(size_of_state, size_of_iterate)
    return max_norm(residual) <= allowed_size + atol


def _is_stuck(
    progress: Progress, shrinkage: Scalar, is_whole_step: Bool[Array, ""]
) -> Bool[Array, ""]:
    """Whether further iterations would not reach the target, since the last correction

    - is not finite,
    - is not smaller than the one before by enough, after `num_may_grow` iterations,
    - or is one of too many for a part of the step.

    `shrinkage` is the ratio of its size to that of the one before, and `is_whole_step` is
    whether the target is the end of the step.
    """
    # The whole step at once is tried first, from a guess that may be poor. The last part of
    # a continuation has the same target, but begins near a solution, or fails soon.
    is_first_try = is_whole_step & (progress.reached == 0)
    num_may_grow = jnp.where(is_first_try, _MAY_GROW_IN_WHOLE_STEP, _MAY_GROW_IN_PART)
    # A zero correction away from a solution is no progress either.
    makes_progress = (shrinkage < _SHRINKAGE_OF_PROGRESS) & (progress.size > 0)
    has_stopped = (progress.tries >= num_may_grow) & ~makes_progress
    is_slow = ~is_whole_step & (progress.tries >= _MOST_IN_PART)
    return ~jnp.isfinite(progress.size) | has_stopped | is_slow


def _next_target(
    progress: Progress,
    k: _Vector,
    part_is_solved: Bool[Array, ""],
    has_failed: Bool[Array, ""],
) -> tuple[_Vector, Progress]:
    """The next iterate and target, from the corrected iterate `k`:

    - `part_is_solved`: continues from `k`, the new anchor, to a target further ahead.
    - `has_failed`: goes back to the anchor, for a nearer target.
    - otherwise: continues from `k` to the same target.
    """
    target = progress.target
    # How much of the step this part is.
    stride = progress.target - progress.reached
    further = jnp.minimum(target + _FACTOR_AFTER_SUCCESS * stride, 1)
    nearer = progress.reached + _FACTOR_AFTER_FAILURE * stride
    next_k = jnp.where(has_failed, progress.anchor, k)
    anchor = jnp.where(part_is_solved, next_k, progress.anchor)
    reached = jnp.where(part_is_solved, target, progress.reached)
    same_or_nearer = jnp.where(has_failed, nearer, target)
    return next_k, progress._replace(
        anchor=anchor,
        reached=reached,
        target=jnp.where(part_is_solved, further, same_or_nearer),
        tries=jnp.where(part_is_solved | has_failed, 0, progress.tries),
        has_turned_back=has_failed & (_FACTOR_AFTER_FAILURE * stride < _SHORTEST_PART),
    )
