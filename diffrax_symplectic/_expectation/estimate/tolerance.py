"""When an estimate is as accurate as asked, and what it would take where it is not."""

import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..._simulation import Combination
from .estimate import combined_results, Expectation


# More samples are of no use once the standard error is at most this share of the tolerance:
# without it an error as large as the tolerance would be less by about an eighth at
# most.
_SHARE_OF_SAMPLING = 0.5
# The same without a tolerance, for the share of the discretization error: then the sampling
# error is a half percent of the whole.
_SHARE_BESIDE_STEPS = 0.1
# What remains of the discretization error is known up to noise. By chance it exceeds the
# tolerance by this many of its standard errors once in fifty times.
_ERRORS_BY_CHANCE = 2


def is_reached(estimate: Expectation, tol: float) -> bool:
    """Whether the whole error of each mean is small enough, and can be trusted."""
    return _all_within(estimate.error, tol) and not is_any_true(estimate.off_order)


def is_stuck(estimate: Expectation, tol: float) -> bool:
    """Whether more samples would not reach the tolerance."""
    if is_any_true(estimate.off_order) or _is_discretization_beyond(estimate, tol):
        return True
    # If the standard error is small, the rest of the error comes from the step or from
    # failed paths.
    has_enough_samples = _all_within(estimate.std_error, _SHARE_OF_SAMPLING * tol)
    return has_enough_samples and not _all_within(estimate.error, tol)


def is_bounded_by_steps(estimate: Expectation) -> bool:
    """Whether the sampling error of each mean is a small part of the error of the steps,
    which more samples would not change."""
    if estimate.levels == 1 or estimate.num_failed > 0:
        return False

    def is_small(std_error: np.ndarray, discretization_error: np.ndarray) -> np.bool_:
        return np.all(std_error <= _SHARE_BESIDE_STEPS * discretization_error)

    are_small = jtu.tree_map(
        is_small, estimate.std_error, estimate.discretization_error
    )
    return all(jtu.tree_leaves(are_small))


def needs_level(estimate: Expectation, tol: float) -> bool:
    """Whether another level, of half the step, may reach the tolerance."""
    if is_reached(estimate, tol) or not is_stuck(estimate, tol):
        return False
    return _all_within(estimate.failed_error, tol)


def share_of_needed(estimate: Expectation, tol: float | None) -> float:
    """The estimated share of the samples needed that has been taken."""
    if tol is None or estimate.num_samples < 2:
        return 0.0
    std_error = max(largest_error(estimate.std_error), tol)
    # The standard error decreases like one over the square root of the number of samples.
    return (tol / std_error) ** 2 if np.isfinite(std_error) else 0.0


def shortfall(estimate: Expectation, tol: float) -> str:
    """Which part of the error keeps it above the tolerance, and what it would take: for
    messages, one or two sentences without their first capital and their last full stop."""
    if is_any_true(estimate.off_order):
        return (
            "the changes from step to step do not fit the order of the solver, so the "
            "error is not known. Pass a smaller `dt0`"
        )
    discretization = largest_error(estimate.discretization_error)
    sampling_error = largest_error(estimate.std_error)
    failed_error = largest_error(estimate.failed_error)
    if failed_error > max(discretization, sampling_error):
        return (
            f"failed paths could change the mean by {failed_error:.1e}. Take smaller "
            "steps, or a more stable solver"
        )
    if discretization > sampling_error:
        return (
            f"{discretization:.1e} remains of the discretization error with "
            f"{estimate.levels} levels. Pass a smaller `dt0`, or more `levels`"
        )
    # What the other parts of the error leave of the tolerance, at least a tenth.
    others = np.hypot(discretization, failed_error)
    # The square of a small tolerance would underflow.
    allowed = max(np.sqrt(max(tol - others, 0.0)) * np.sqrt(tol + others), tol / 10)
    ratio = sampling_error / float(allowed)
    needed_paths = estimate.num_paths * ratio * ratio
    return (
        f"the sampling error is {sampling_error:.1e} after {estimate.num_paths:,} paths. "
        f"It takes about {needed_paths:.1e} paths: continue with `start=`, or pass another "
        "`sampling`"
    )


def is_any_true(tree: PyTree[np.ndarray] | None) -> bool:
    """Whether any entry of the masks in a PyTree is true."""
    return any(bool(np.any(leaf)) for leaf in jtu.tree_leaves(tree))


def largest_error(errors: PyTree[np.ndarray | np.floating] | None) -> float:
    """The largest number in a PyTree of errors, or zero if there is none."""
    leaves = jtu.tree_leaves(errors)
    return max((float(np.max(leaf, initial=0.0)) for leaf in leaves), default=0.0)


def _all_within(errors: PyTree[np.ndarray | np.floating], tol: float) -> bool:
    return all(bool(np.all(error <= tol)) for error in jtu.tree_leaves(errors))


def _is_discretization_beyond(estimate: Expectation, tol: float) -> bool:
    """Whether the discretization error alone exceeds the tolerance, beyond its noise."""
    if estimate.levels == 1:
        return False

    def is_beyond(error: np.ndarray, noise: np.ndarray) -> np.bool_:
        return np.any(error - _ERRORS_BY_CHANCE * noise > tol)

    # The discretization error is the change by the last extrapolation.
    noise = combined_results(estimate, Combination.EXTRAPOLATION).std_error
    is_any_beyond = jtu.tree_map(is_beyond, estimate.discretization_error, noise)
    return any(jtu.tree_leaves(is_any_beyond))
