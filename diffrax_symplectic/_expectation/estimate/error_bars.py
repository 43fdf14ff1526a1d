"""Means, standard errors and what else follows from the moments of samples."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..._simulation import Combination
from ..sampling import ROUNDING
from .moments import Moments


# A control variate is dropped if its mean is this many standard errors from zero: by chance
# that happens less than once in a million times.
_STD_ERRORS_TO_DROP = 5
# A control variate with a `heaviness` above this is kept all the same: its tails are then
# so heavy that the standard error of its mean is not reliable.
_HEAVY_CONTROL = 0.1
# The largest deviation of n normal samples exceeds the root of this number times log(n), in
# standard deviations, with a probability of less than n^(-5/4).
_SQUARE_PER_LOG = 4.5
# The largest `heaviness` that is used: with r = 1, where a single sample accounts for all
# of the variance, the standard error would be infinite.
_LARGEST_HEAVINESS = 1 - 1e-6
# The steps fit the order if the last change by a smaller step, divided by what the order
# foretells from the change before, is between these. (An order less by a half makes this
# ratio 1.41, and an order more by two 0.25.)
_LEAST_RATIO = 0.25
_LARGEST_RATIO = 1.33
# The last change may be outside that range by this many standard errors, and a change by
# fewer powers counts only beyond as many.
_STD_ERRORS_BY_CHANCE = 2


def heaviness(largest: Any, s: Any, n: Any, numpy: Any = np) -> Any:
    """The `r` of `Expectation.std_error`, which measures how heavy the tails of `n` values
    are, from their largest deviation and their standard deviation `s`. `numpy` is NumPy or
    `jax.numpy`. Not finite if `s` is zero."""
    largest_of_normal = s * numpy.sqrt(_SQUARE_PER_LOG * numpy.log(numpy.maximum(n, 2)))
    return numpy.maximum(largest - largest_of_normal, 0) / (s * numpy.sqrt(n))


def share_of_largest(r: Any, n: int) -> Any:
    """The share of the largest deviation in the sum of squared deviations of `n` values,
    from their `heaviness` `r`, which must not be zero."""
    # The formula of `heaviness`, solved for `largest`, squared and divided by `n s^2`.
    return np.minimum((r + np.sqrt(_SQUARE_PER_LOG * np.log(max(n, 2)) / n)) ** 2, 1)


def least_deviation(largest: Any, r: Any, n: int) -> Any:
    """The standard deviation of `n` values, from their largest deviation and their
    `heaviness` `r`; or where `r` is zero, a lower bound of it."""
    # The formula of `heaviness`, solved for `s`.
    return largest / (r * np.sqrt(n) + np.sqrt(_SQUARE_PER_LOG * np.log(max(n, 2))))


class Results(NamedTuple):
    """What follows from the moments of samples. Arrays have an axis for all numbers of
    `phi`, and until `of_combination` one for combinations of levels before it.

    - `mean`, `std_error`, `variance`: as in `Expectation`.
    - `plain_std_error`: the standard error without a control variate.
    - `plain_s`: the standard deviation of a sample without a control variate.
    - `heaviness`: the `r` of `Expectation.std_error`.
    - `dropped`: whether a control variate was dropped because its mean is not zero.
    - `spread`: the largest deviation of a path's value from the mean, without a control
        variate. (For replicates it is averaged over them.)
    """

    mean: np.ndarray
    std_error: np.ndarray
    plain_std_error: np.ndarray
    plain_s: np.ndarray
    variance: np.ndarray
    heaviness: np.ndarray
    dropped: np.ndarray
    spread: np.ndarray

    def of_combination(self, combination: Combination) -> "Results":
        """The results for one combination of levels."""
        return Results(*[x[combination] for x in self])


@np.errstate(all="ignore")
def results_of(moments: Moments, dtype: str, rounding_floor: int) -> Results:
    """The results for all combinations of levels. `dtype` and `rounding_floor` are those
    of `Expectation`."""
    n = moments.num_good
    mean = moments.mean
    plain_mean = mean.without_control
    # The first combination of levels is the best one. The others are differences of numbers
    # of its size, so all have rounding errors of the same size.
    size = np.fmax(np.abs(mean.value[:1]), np.abs(plain_mean[:1]))
    rounding = rounding_floor * float(jnp.finfo(dtype).eps) * size
    norm = moments.norm
    largest = moments.largest
    of_value = _spread_of(n, rounding, norm.value, largest.value, mean.heaviness)
    of_plain = of_value
    dropped = np.zeros(plain_mean.shape, bool)
    if mean.control is not None:
        of_plain = _spread_of(n, rounding, norm.plain, largest.plain)
        of_control = _spread_of(n, rounding, norm.control, largest.control)
        allowed = np.fmax(
            _STD_ERRORS_TO_DROP * of_control.std_error, ROUNDING * rounding
        )
        # With heavy tails the standard error in `allowed` is not reliable.
        has_heavy_tails = of_control.r > _HEAVY_CONTROL
        is_kept = (np.abs(mean.control) <= allowed) | has_heavy_tails
        # A control variate is kept for all combinations of levels or for none.
        is_kept_for_all = np.all(is_kept & np.isfinite(mean.value), axis=0)
        dropped = np.broadcast_to(~is_kept_for_all, plain_mean.shape)
    best_mean = np.where(dropped, plain_mean, mean.value)
    return Results(
        mean=best_mean if n > 0 else np.full_like(plain_mean, np.nan),
        std_error=np.where(dropped, of_plain.std_error, of_value.std_error),
        plain_std_error=of_plain.std_error,
        plain_s=of_plain.s,
        variance=np.where(dropped, of_plain.s, of_value.s) ** 2,
        heaviness=np.where(dropped, of_plain.r, of_value.r),
        dropped=dropped,
        spread=largest.without_control if mean.largest is None else mean.largest,
    )


class _Spread(NamedTuple):
    """How values spread.

    - `s`: their standard deviation.
    - `r`: their `heaviness`.
    - `std_error`: the standard error of their mean.
    """

    s: np.ndarray
    r: np.ndarray
    std_error: np.ndarray


def _spread_of(
    n: int,
    rounding: np.ndarray,
    norm: np.ndarray,
    largest: np.ndarray,
    r_of_paths: np.ndarray | None = None,
) -> _Spread:
    """The spread of `n` values, from their moments, by the formula of
    `Expectation.std_error`. If each value is a mean over paths, which hides the tails of
    these, `r_of_paths` is the `heaviness` of the paths."""
    s = norm / np.sqrt(n - 1) if n > 1 else np.full_like(norm, np.nan)
    # Deviations that are rounding errors can have heavy tails, too, which do not count.
    is_random = (s > 0) & (largest > ROUNDING * rounding)
    r_of_values = np.where(is_random, heaviness(largest, s, n), 0)
    larger_r = r_of_values if r_of_paths is None else np.fmax(r_of_values, r_of_paths)
    r = np.minimum(larger_r, _LARGEST_HEAVINESS)
    std_error = s / np.sqrt(n) * np.sqrt(1 + 4 * r**2 / (1 - r**2) ** 4)
    return _Spread(s, r, np.maximum(std_error, rounding))


@np.errstate(invalid="ignore")
def discretization_error(
    results: Results, levels: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """The results `discretization_error` and `off_order` of an `Expectation` with two
    levels or more."""
    mean = results.mean
    error = np.abs(mean[Combination.EXTRAPOLATION])
    if levels == 2:
        return error, None
    # The error is the larger of two changes by the coarsest level: by the extrapolation
    # itself (`EXTRAPOLATION`), and by one whose last step eliminates the first power of the
    # step size only (`BY_FIRST_POWER`). With the first alone, 5 to 12% of the means of
    # harmonic oscillators over long times, by four and five levels, were more than two
    # error bars off. With both it is 0 to 2%.
    by_first_power = np.abs(mean[Combination.BY_FIRST_POWER])
    noise = _STD_ERRORS_BY_CHANCE * results.std_error[Combination.BY_FIRST_POWER]
    error = np.maximum(error, by_first_power - noise)
    # `MISS` is `LAST` minus what the order predicts from `BEFORE`.
    last_change = mean[Combination.LAST]
    prediction = last_change - mean[Combination.MISS]
    # The ends of the range of changes that fit the order. The second is the lower one where
    # the prediction is negative.
    ends = np.stack([_LEAST_RATIO * prediction, _LARGEST_RATIO * prediction])
    allowance = _STD_ERRORS_BY_CHANCE * results.std_error[Combination.MISS]
    is_less = last_change < np.min(ends, axis=0) - allowance
    off_order = is_less | (last_change > np.max(ends, axis=0) + allowance)
    change_before = mean[Combination.BEFORE]
    largest_change = np.maximum(np.abs(last_change), np.abs(change_before))
    return np.where(off_order, np.maximum(error, largest_change), error), off_order
