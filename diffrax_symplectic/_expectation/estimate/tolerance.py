"""Whether an estimate is as accurate as asked, and if not, what it would take."""

import numpy as np

from ..._simulation import Combination
from .estimate import combined_results, Expectation


# More samples are of no use once the standard error is at most this share of the tolerance,
# but the whole error is still larger than the tolerance. Since the squares of errors are
# added, the whole error would be less by about an eighth at most without sampling error.
_SHARE_OF_TOLERANCE = 0.5
# Without a tolerance, more samples are of no use once the standard error is at most this
# share of the discretization error: together the two are then larger than the
# discretization error by half a percent at most.
_SHARE_OF_DISCRETIZATION = 0.1
# What remains of the discretization error is known up to noise. By chance it exceeds the
# tolerance by this many of its standard errors once in fifty times.
_STD_ERRORS_BY_CHANCE = 2


def is_reached(estimate: Expectation, tol: float) -> bool:
    """Whether the whole error of each mean is at most `tol`, and can be trusted, since the
    changes of the means by smaller steps fit the order of the solver."""
    vectors = estimate.vectors
    return bool(np.all(vectors.error <= tol)) and not vectors.is_off_order


def is_stuck(estimate: Expectation, tol: float) -> bool:
    """Whether more samples would not reach the tolerance, because too much of the error
    comes from the steps or from failed paths. This is so in three cases:

    - The changes of the means by smaller steps do not fit the order of the solver.
    - What remains of a discretization error alone is surely above the tolerance.
    - The standard errors are far below the tolerance, and a whole error is not."""
    vectors = estimate.vectors
    if vectors.is_off_order:
        return True
    if vectors.discretization_error is not None:
        # The discretization error is taken from the change by the last extrapolation, so it
        # has the noise of this change.
        change = combined_results(estimate, Combination.EXTRAPOLATION)
        noise = _STD_ERRORS_BY_CHANCE * change.std_error
        if np.any(vectors.discretization_error - noise > tol):
            return True
    has_enough_samples = np.all(vectors.std_error <= _SHARE_OF_TOLERANCE * tol)
    return bool(has_enough_samples and not np.all(vectors.error <= tol))


def is_bounded_by_steps(estimate: Expectation) -> bool:
    """Whether each mean has a sampling error that is a small part of its discretization
    error. More samples would then hardly make the whole error smaller."""
    vectors = estimate.vectors
    if vectors.discretization_error is None or estimate.num_failed > 0:
        return False
    small_part = _SHARE_OF_DISCRETIZATION * vectors.discretization_error
    return bool(np.all(vectors.std_error <= small_part))


def needs_level(estimate: Expectation, tol: float) -> bool:
    """Whether one more level, with half the smallest step, may reach the tolerance where
    more samples do not."""
    if is_reached(estimate, tol) or not is_stuck(estimate, tol):
        return False
    # The error of failed paths would remain.
    return bool(np.all(estimate.vectors.failed_error <= tol))


def share_of_needed(estimate: Expectation, tol: float | None) -> float:
    """The estimated share of the needed samples that have been taken, from 0 to 1."""
    if tol is None or estimate.num_samples < 2:
        return 0.0
    # With a standard error of at least `tol`, the share is at most one.
    std_error = max(largest_error(estimate.vectors.std_error), tol)
    # The standard error decreases like one over the square root of the number of samples.
    return (tol / std_error) ** 2 if np.isfinite(std_error) else 0.0


def shortfall(estimate: Expectation, tol: float) -> str:
    """Says which part of the error keeps the whole error above `tol`, and what to do about
    it. This is the largest part: failed paths, the discretization or the sampling. If the
    changes by smaller steps do not fit the order of the solver, the error is not known.

    The result is the rest of a sentence of a message, and sometimes one more sentence,
    without the full stop at the end."""
    vectors = estimate.vectors
    if vectors.is_off_order:
        return (
            "the changes from step to step do not fit the order of the solver, so the "
            "error is not known. Pass a smaller `dt0`"
        )
    discretization = largest_error(vectors.discretization_error)
    sampling_error = largest_error(vectors.std_error)
    failed_error = largest_error(vectors.failed_error)
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
    rest = np.hypot(discretization, failed_error)
    # The rest of the error leaves `sqrt(tol**2 - rest**2)` for sampling, or nothing. It is
    # computed as `sqrt(tol - rest) * sqrt(tol + rest)`, since the square of a small
    # tolerance would underflow.
    left_for_sampling = np.sqrt(max(tol - rest, 0.0)) * np.sqrt(tol + rest)
    # With nothing left, the number of paths would be infinite.
    allowed = max(left_for_sampling, tol / 10)
    ratio = sampling_error / float(allowed)
    # The sampling error decreases like one over the square root of the number of paths.
    needed_paths = estimate.num_paths * ratio * ratio
    return (
        f"the sampling error is {sampling_error:.1e} after {estimate.num_paths:,} paths. "
        f"It takes about {needed_paths:.1e} paths: continue with `start=`, or pass another "
        "`sampling`"
    )


def largest_error(errors: np.ndarray | None) -> float:
    """The largest of some errors; zero for `None` or no errors."""
    return 0.0 if errors is None else float(np.max(errors, initial=0.0))
