"""The warnings that users get about an estimate."""

from collections.abc import Iterator

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._simulation import Combination
from ..sampling import ROUNDING
from .error_bars import least_deviation, share_of_largest
from .estimate import combined_results, Expectation, label_of
from .moments import total
from .tolerance import largest_error, shortfall


# With a `heaviness` above this, means of exp(5 x) with normal x were off by forty standard
# errors, and means of exp(3 x) by five.
_HEAVY = 0.35
# Heavy tails do not matter where even this many standard errors are less than the whole
# error, as for value functions with a standard error of 1e-16 beside a discretization error
# of 1e-7.
_NEGLIGIBLE_STD_ERRORS = 100
# Two steps do not agree if the extrapolation from them changes the mean by more than each
# of three bounds. The first is this share of the mean. (For a method of order 2, the bias
# of the longer step is four times the change, and thus more than twice the mean.)
_LARGE_SHARE_OF_MEAN = 0.5
# The second is this share of the standard deviation of a path, since any change is large
# beside a mean of about zero.
_LARGE_SHARE_OF_DEVIATION = 0.05
# The third is this many standard errors of the change, which it exceeds by chance once in
# sixteen thousand times.
_STD_ERRORS_TO_BE_SURE = 4
# If this many times as many paths fail with the longer step as with half of it, they fail
# because the longer step is too long, and not for another reason.
_MANY_TIMES_MORE = 10


def cautions(estimate: Expectation, tol: float | None, advice: str) -> Iterator[str]:
    """The warnings for an estimate. The warning of failed paths ends with `advice`, which
    says in sentences what to do about them."""
    if estimate.num_failed > 0:
        yield from _cautions_on_failures(estimate, advice)
    if estimate.num_samples > 1:
        yield from _cautions_on_mean(estimate)
        yield from _cautions_on_tails(estimate)
        yield from _cautions_on_samples(estimate)
        yield from _cautions_on_steps(estimate)
    if tol is not None and not estimate.tol_reached:
        yield f"`tol={tol}` was not reached: {shortfall(estimate, tol)}."


def _cautions_on_failures(estimate: Expectation, advice: str) -> Iterator[str]:
    """Warns of failed paths that could change the mean by more than its standard error."""
    vectors = estimate.vectors
    # Without samples both errors are NaN, so the comparison is false.
    if np.all(vectors.failed_error <= vectors.std_error):
        return
    if estimate.num_samples == 0:
        consequence = "there is no mean"
    else:
        consequence = (
            "they are left out of the mean, and could change it by more than its standard "
            f"error, up to {largest_error(vectors.failed_error):.1e}, which is part of "
            "`error`"
        )
    if estimate.levels > 1:
        num_with_dt0, num_with_half, *_ = estimate.failed_on
        if num_with_dt0 > _MANY_TIMES_MORE * num_with_half:
            consequence += (
                f"; the first two steps do not agree, since {num_with_dt0:,} paths fail "
                f"with steps of `dt0` and {num_with_half:,} with half of it"
            )
            # Where most paths fail, the caller's `advice` speaks of the steps already.
            if estimate.num_failed <= estimate.num_paths:
                advice = f"Pass a smaller `dt0`. {advice}"
    yield f"{estimate.num_failed:,} paths failed: {consequence}. {advice}"


def _cautions_on_mean(estimate: Expectation) -> Iterator[str]:
    """Warns of means or standard errors that are not finite, and of a control variate that
    was dropped."""
    vectors = estimate.vectors
    if not np.all(np.isfinite([vectors.mean, vectors.std_error])):
        yield (
            "The mean or its standard error is not finite: the averaged values overflow. "
            "Take smaller steps or a more stable solver, and check whether single paths "
            "stay bounded."
        )
    if np.any(combined_results(estimate, Combination.BEST).dropped):
        yield (
            "A control variate was dropped: its mean over these paths is more than five "
            "standard errors from zero, or not finite. The estimate is crude Monte Carlo. "
            "Pass a smaller `degree`, or another `sampling`."
        )


def _cautions_on_tails(estimate: Expectation) -> Iterator[str]:
    """Warns if a single path accounts for so much of the variance that the standard error
    cannot be trusted."""
    vectors = estimate.vectors
    heaviness = combined_results(estimate, Combination.BEST).heaviness
    matters = _NEGLIGIBLE_STD_ERRORS * vectors.std_error >= vectors.error
    # Zero where heavy tails do not matter.
    relevant_heaviness = np.nan_to_num(heaviness * matters)
    heaviest = int(np.argmax(relevant_heaviness))
    if relevant_heaviness[heaviest] > _HEAVY:
        # For replicates of many paths, the heaviness is that within one replicate.
        is_replicate = estimate.paths_per_sample > 1
        num_paths = estimate.paths_per_sample if is_replicate else estimate.num_samples
        share = share_of_largest(relevant_heaviness[heaviest], num_paths)
        yield (
            f"One path in {num_paths:,} accounts for {share:.0%} of the variance"
            f"{label_of(estimate, heaviest)}: still rarer paths may contribute much to the "
            "mean, and the standard error may be too small. If forces are steep, steps may "
            "be too long on such paths: pass a smaller `dt0`. If `phi` grows fast, average "
            "a function that grows more slowly, or take many more paths."
        )


def _cautions_on_samples(estimate: Expectation) -> Iterator[str]:
    """Warns of samples that are all zero, or all equal."""
    moments = total(estimate.moments)
    # The largest absolute values of `phi` itself. (With a control variate, a sample is not
    # zero where `phi` is.)
    largest_values = moments.size.without_control[Combination.BEST]
    arrays = jtu.tree_leaves(estimate.layout.unravel(largest_values))
    # The smallest number whose rounding errors do not underflow.
    precision = jnp.finfo(estimate.dtype)
    smallest = float(precision.tiny / precision.eps)
    # Users are warned only if all entries of an array of `phi` are zero. A single entry may
    # well be zero, such as a momentum at the start.
    if any(np.max(array) < smallest for array in arrays):
        yield (
            f"An output of `phi` is zero, or underflows {estimate.dtype}, on all paths. If "
            'it underflows, use other units, or call `jax.config.update("jax_enable'
            '_x64", True)` first. If it is the indicator of a rare event, the event did '
            "not occur, and the standard error is meaningless. The gradient of an "
            "indicator, or of another step function, is zero wherever it exists: average a "
            "smooth function instead, or difference two estimates."
        )
    elif not np.any(estimate.vectors.variance > 0):
        yield (
            f"All {estimate.num_samples:,} samples are equal, so the error is unknown. "
            "Check that phi depends on the noise, and a function for `monte_carlo` on its "
            "key."
        )


def _cautions_on_steps(estimate: Expectation) -> Iterator[str]:
    """Warns of two steps that do not agree: the change of the mean by extrapolation exceeds
    each of three bounds. (With three levels or more, `Expectation.off_order` tells whether
    the steps are too long.)"""
    if estimate.levels != 2:
        return
    vectors = estimate.vectors
    best = combined_results(estimate, Combination.BEST)
    change = combined_results(estimate, Combination.EXTRAPOLATION)
    size_of_change = np.abs(change.mean)
    # The mean with the smaller step.
    finest = vectors.mean + vectors.bias
    # The standard deviation of a path.
    deviation = best.plain_s
    num_paths = estimate.paths_per_sample
    if num_paths > 1:
        # A sample is a mean over many paths. The deviation of one path is at least this.
        deviation = least_deviation(best.max_deviation, r=best.heaviness, n=num_paths)
    # Rounding errors are in proportion to the largest absolute values of samples.
    sizes = total(estimate.moments).size
    size = np.fmax(sizes.value, sizes.without_control)[Combination.BEST]
    rounding = ROUNDING * float(jnp.finfo(estimate.dtype).eps) * size
    bounds = [
        _LARGE_SHARE_OF_MEAN * np.abs(finest),
        _LARGE_SHARE_OF_DEVIATION * deviation,
        np.maximum(_STD_ERRORS_TO_BE_SURE * change.std_error, rounding),
    ]
    disagrees = np.all(size_of_change > np.stack(bounds), axis=0)
    # The mean may be zero, and the ratio infinite.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = size_of_change / np.abs(finest)
    ratios_to_tell = np.nan_to_num(np.where(disagrees, ratios, 0))
    worst = int(np.argmax(ratios_to_tell))
    if ratios_to_tell[worst] > 0:
        yield (
            f"The first two steps do not agree{label_of(estimate, worst)}: extrapolation "
            "from steps of `dt0` and half of it changes the mean from "
            f"{finest[worst]:.3g} to {vectors.mean[worst]:.3g}. Pass a smaller `dt0`, or "
            "`levels=3`, which checks the order."
        )
