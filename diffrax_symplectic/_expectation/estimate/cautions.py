"""What users are warned of in an estimate."""

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
# Two steps do not agree if the extrapolation from them changes the mean by more than this
# share of it. For a method of order 2, the bias of the longer step is four times this
# change, and thus more than twice the mean.
_LARGE_SHARE_OF_MEAN = 0.5
# The change must also be more than this share of the standard deviation of a path: any
# change is large beside a mean of about zero.
_LARGE_SHARE_OF_SPREAD = 0.05
# The change must also be more than this many of its standard errors: by chance it is more
# once in sixteen thousand times.
_STD_ERRORS_TO_BE_SURE = 4
# If this many times as many paths fail with the longer step as with half of it, they fail
# because it is too long, and not for another reason.
_MANY_TIMES_MORE = 10


def cautions(estimate: Expectation, tol: float | None, advice: str) -> Iterator[str]:
    """The warnings for an estimate. `advice` is what to do about failed paths, in
    sentences."""
    if estimate.num_failed > 0:
        yield from _cautions_on_failures(estimate, advice)
    if estimate.num_samples > 1:
        yield from _cautions_on_mean(estimate)
        yield from _cautions_on_samples(estimate)
        yield from _cautions_on_steps(estimate)
    if tol is not None and not estimate.tol_reached:
        yield f"`tol={tol}` was not reached: {shortfall(estimate, tol)}."


def _cautions_on_failures(estimate: Expectation, advice: str) -> Iterator[str]:
    """Warns of failed paths that could change the mean by more than its standard error."""
    vectors = estimate.vectors
    # Without samples both are NaN, so this is false.
    if np.all(vectors.failed_error <= vectors.std_error):
        return
    if estimate.num_samples == 0:
        consequence = "there is no mean"
    else:
        largest = largest_error(vectors.failed_error)
        consequence = (
            "they are left out of the mean, and could change it by more than its standard "
            f"error, up to {largest:.1e}, which is part of `error`"
        )
    if estimate.levels > 1:
        num_with_dt0, num_with_half, *_ = estimate.failed_on
        if num_with_dt0 > _MANY_TIMES_MORE * num_with_half:
            consequence += (
                f"; the first two steps do not agree, since {num_with_dt0:,} paths fail "
                f"with steps of `dt0` and {num_with_half:,} with half of it"
            )
            # Where most paths fail, `advice` speaks of the steps already.
            if estimate.num_failed <= estimate.num_paths:
                advice = f"Pass a smaller `dt0`. {advice}"
    yield f"{estimate.num_failed:,} paths failed: {consequence}. {advice}"


def _cautions_on_mean(estimate: Expectation) -> Iterator[str]:
    """Warns of a mean or a standard error that cannot be trusted."""
    vectors = estimate.vectors
    if not np.all(np.isfinite([vectors.mean, vectors.std_error])):
        yield (
            "The mean or its standard error is not finite: the averaged values overflow. "
            "Take smaller steps or a more stable solver, and check whether single paths "
            "stay bounded."
        )
    best = combined_results(estimate, Combination.BEST)
    if np.any(best.dropped):
        yield (
            "A control variate was dropped: its mean over these paths is more than five "
            "standard errors from zero, or not finite. The estimate is crude Monte Carlo. "
            "Pass a smaller `degree`, or another `sampling`."
        )

    matters = _NEGLIGIBLE_STD_ERRORS * vectors.std_error >= vectors.error
    # Zero where it does not matter.
    heaviness = best.heaviness * matters
    heaviest = int(np.argmax(np.nan_to_num(heaviness)))
    r = heaviness[heaviest]
    if r > _HEAVY:
        # For sorted paths, `r` is that of the paths of one replicate.
        is_replicate = estimate.paths_per_sample > 1
        num_paths = estimate.paths_per_sample if is_replicate else estimate.num_samples
        share = share_of_largest(r, num_paths)
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
    # Without the control variate. With it, a sample is not zero where `phi` is.
    largest_values = moments.size.without_control[Combination.BEST]
    arrays = jtu.tree_leaves(estimate.layout.unravel(largest_values))
    # The smallest number whose rounding errors do not underflow.
    precision = jnp.finfo(estimate.dtype)
    smallest = float(precision.tiny / precision.eps)
    # An array of `phi` must be zero as a whole: a single entry may well be, such as that of
    # a momentum at the start.
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
    """Warns of two steps whose means differ much. (Three are checked for the order.)"""
    if estimate.levels != 2:
        return
    vectors = estimate.vectors
    best = combined_results(estimate, Combination.BEST)
    change = combined_results(estimate, Combination.EXTRAPOLATION)
    finest = vectors.mean + vectors.bias
    size_of_change = np.abs(change.mean)
    moments = total(estimate.moments)
    # The largest absolute values of samples, by which their rounding is measured.
    size = np.fmax(moments.size.value, moments.size.without_control)[Combination.BEST]
    rounding = ROUNDING * float(jnp.finfo(estimate.dtype).eps) * size
    noise = _STD_ERRORS_TO_BE_SURE * change.std_error
    # The standard deviation of a path, or for sorted paths a number that is not above it.
    spread = best.plain_s
    if estimate.paths_per_sample > 1:
        spread = least_deviation(best.spread, best.heaviness, estimate.paths_per_sample)
    is_real = size_of_change > np.maximum(noise, rounding)
    is_large = size_of_change > _LARGE_SHARE_OF_MEAN * np.abs(finest)
    is_seen = size_of_change > _LARGE_SHARE_OF_SPREAD * spread
    # The mean may be zero.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = size_of_change / np.abs(finest)
    ratios_to_tell = np.nan_to_num(np.where(is_real & is_large & is_seen, ratios, 0))
    worst = int(np.argmax(ratios_to_tell))
    if ratios_to_tell[worst] > 0:
        yield (
            f"The first two steps do not agree{label_of(estimate, worst)}: extrapolation "
            "from steps of `dt0` and half of it changes the mean from "
            f"{finest[worst]:.3g} to {vectors.mean[worst]:.3g}. Pass a smaller `dt0`, or "
            "`levels=3`, which checks the order."
        )
