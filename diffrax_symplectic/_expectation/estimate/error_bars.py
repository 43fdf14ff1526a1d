"""Means and their errors, from the moments of samples."""

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
# No one of n normal samples deviates from the mean by more than sqrt(4.5 log(n)) standard
# deviations, except with a probability of less than n^(-5/4).
_SQUARE_PER_LOG = 4.5
# The largest `heaviness` that enters a standard error, which for r = 1 would be infinite.
_LARGEST_HEAVINESS = 1 - 1e-6
# Each halving of the step changes the mean, and from the change by one halving the order of
# the solver predicts the next. The last change fits the order if its ratio to the predicted
# one is between these. (The ratio is 1.41 for an order that is less by a half, and 0.25 for
# an order that is more by two.)
_LEAST_RATIO = 0.25
_LARGEST_RATIO = 1.33
# Noise of this many standard errors is subtracted from a change before it counts.
_STD_ERRORS_BY_CHANCE = 2


def heaviness(largest: Any, s: Any, n: Any, numpy: Any = np) -> Any:
    """How heavy the tails of `n` values are: the `r` of `Expectation.std_error`,

        max(largest - s sqrt(4.5 log(n)), 0) / (s sqrt(n)).

    It is zero for tails like those of a normal variable, and near one if a single value
    accounts for all of the variance.

    - `largest`: the largest deviation of a value from the mean.
    - `s`: the standard deviation. If it is zero, the result is not finite.
    - `numpy`: the module to compute with, NumPy or `jax.numpy`.
    """
    largest_of_normal = s * numpy.sqrt(_SQUARE_PER_LOG * numpy.log(numpy.maximum(n, 2)))
    return numpy.maximum(largest - largest_of_normal, 0) / (s * numpy.sqrt(n))


def share_of_largest(r: Any, n: int) -> Any:
    """The share of the value that deviates most in the sum of squared deviations of `n`
    values, `largest^2 / (n s^2)`, from their `heaviness` `r`, which must be positive. (For
    `r = 0` the largest deviation is not known.)"""
    # By the formula of `heaviness`, `largest = s (r sqrt(n) + sqrt(4.5 log(n)))`.
    return np.minimum((r + np.sqrt(_SQUARE_PER_LOG * np.log(max(n, 2)) / n)) ** 2, 1)


def least_deviation(largest: Any, r: Any, n: int) -> Any:
    """The standard deviation of `n` values, from their largest deviation and their
    `heaviness` `r`. Where `r` is zero, the result is a lower bound of the standard
    deviation."""
    # By the formula of `heaviness`, `largest = s (r sqrt(n) + sqrt(4.5 log(n)))`.
    return largest / (r * np.sqrt(n) + np.sqrt(_SQUARE_PER_LOG * np.log(max(n, 2))))


class Results(NamedTuple):
    """What follows from the moments of samples. Arrays have axes for combinations of levels
    and for all numbers of `phi`. (In the result of `of_combination` the first axis is
    gone.)

    - `mean`, `std_error`, `variance`: as in `Expectation`.
    - `plain_std_error`: the standard error without a control variate.
    - `plain_s`: the standard deviation of a sample without a control variate.
    - `heaviness`: the `r` of `Expectation.std_error`.
    - `dropped`: whether a control variate was dropped because its mean is not zero.
    - `max_deviation`: the largest deviation of a path's value from the mean, without a
        control variate. For replicates of many paths it is the mean over the replicates of
        the largest deviation in each.
    """

    mean: np.ndarray
    std_error: np.ndarray
    plain_std_error: np.ndarray
    plain_s: np.ndarray
    variance: np.ndarray
    heaviness: np.ndarray
    dropped: np.ndarray
    max_deviation: np.ndarray

    def of_combination(self, combination: Combination) -> "Results":
        """The results for one combination of levels."""
        return Results(*[x[combination] for x in self])


@np.errstate(all="ignore")
def results_of(moments: Moments, dtype: str, rounding_floor: int) -> Results:
    """The results for all combinations of levels, from the moments of all samples. `dtype`
    and `rounding_floor` are fields of `Expectation`.

    With a control variate, results are computed from values less the control variate, and
    again from plain values, without it. Plain values count where the control variate is
    dropped, because its mean is not zero as it should be, or is not finite.
    """
    n = moments.num_good
    mean = moments.mean
    norm = moments.norm
    largest = moments.largest
    plain_mean = mean.without_control
    # The first combination of levels is the best one. The others are differences of numbers
    # of its size, so all have rounding errors of the same size.
    size = np.fmax(np.abs(mean.value[:1]), np.abs(plain_mean[:1]))
    rounding = rounding_floor * float(jnp.finfo(dtype).eps) * size
    of_value = _spread_of(n, rounding, norm.value, largest.value, mean.heaviness)
    # Without a control variate, plain values are the values themselves.
    of_plain = of_value
    dropped = np.zeros(plain_mean.shape, bool)
    if mean.control is not None:
        of_plain = _spread_of(n, rounding, norm.plain, largest.plain)
        of_control = _spread_of(n, rounding, norm.control, largest.control)
        noise = _STD_ERRORS_TO_DROP * of_control.std_error
        is_zero = np.abs(mean.control) <= np.fmax(noise, ROUNDING * rounding)
        # With heavy tails the standard error in `noise` is not reliable.
        is_kept = is_zero | (of_control.r > _HEAVY_CONTROL)
        # A control variate is kept for all combinations of levels or for none.
        is_kept_for_all = np.all(is_kept & np.isfinite(mean.value), axis=0)
        dropped = np.broadcast_to(~is_kept_for_all, plain_mean.shape)
    used_mean = np.where(dropped, plain_mean, mean.value)
    used = _Spread(*[np.where(dropped, *pair) for pair in zip(of_plain, of_value)])
    # Replicates average the largest deviations of their paths. Otherwise a sample is a
    # single path.
    max_deviation = largest.without_control if mean.largest is None else mean.largest
    return Results(
        mean=used_mean if n > 0 else np.full_like(plain_mean, np.nan),
        std_error=used.std_error,
        plain_std_error=of_plain.std_error,
        plain_s=of_plain.s,
        variance=used.s**2,
        heaviness=used.r,
        dropped=dropped,
        max_deviation=max_deviation,
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
    """The spread of `n` values. The standard error of their mean is that of
    `Expectation.std_error`, `sqrt(s^2 / n (1 + 4 r^2 / (1 - r^2)^4))`.

    - `rounding`: the rounding error of the mean. The standard error is at least this.
    - `norm`, `largest`: as in `Moments`.
    - `r_of_paths`: if each value is a mean over many paths, the `heaviness` of the paths,
        since the mean hides their tails.
    """
    s = norm / np.sqrt(n - 1) if n > 1 else np.full_like(norm, np.nan)
    # Rounding errors can have heavy tails, which do not count.
    is_random = (s > 0) & (largest > ROUNDING * rounding)
    r_of_values = np.where(is_random, heaviness(largest, s=s, n=n), 0)
    larger_r = r_of_values if r_of_paths is None else np.fmax(r_of_values, r_of_paths)
    r = np.minimum(larger_r, _LARGEST_HEAVINESS)
    std_error = s / np.sqrt(n) * np.sqrt(1 + 4 * r**2 / (1 - r**2) ** 4)
    return _Spread(s, r, np.maximum(std_error, rounding))


@np.errstate(invalid="ignore")
def discretization_error(
    results: Results, levels: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """What remains of the discretization error in each mean, and whether the changes by
    smaller steps do not fit the order of the solver (`None` for two levels): the properties
    `discretization_error` and `off_order` of an `Expectation`, as vectors. There are two
    levels or more."""
    changes = np.abs(results.mean)
    error = changes[Combination.EXTRAPOLATION]
    if levels == 2:
        return error, None
    # The error is at least `BY_FIRST_POWER`, less its noise. With `EXTRAPOLATION` alone, 5
    # to 12% of the means of harmonic oscillators over long times, by four and five levels,
    # were more than two error bars off. With the larger of both changes it is 0 to 2%.
    noise = _STD_ERRORS_BY_CHANCE * results.std_error[Combination.BY_FIRST_POWER]
    error = np.maximum(error, changes[Combination.BY_FIRST_POWER] - noise)
    # Where changes do not fit the order, the error is at least the largest of them.
    off_order = _is_off_order(results)
    largest_change = np.maximum(changes[Combination.LAST], changes[Combination.BEFORE])
    return np.where(off_order, np.maximum(error, largest_change), error), off_order


def _is_off_order(results: Results) -> np.ndarray:
    """Whether the last change of each mean by a smaller step (`LAST`) is not what the order
    of the solver predicts from the change before (`BEFORE`)."""
    last_change = results.mean[Combination.LAST]
    # `MISS` is `LAST` minus the prediction.
    prediction = last_change - results.mean[Combination.MISS]
    # The ends of the range of changes that fit the order. They are in descending order
    # where the prediction is negative.
    ends = np.stack([_LEAST_RATIO * prediction, _LARGEST_RATIO * prediction])
    noise = _STD_ERRORS_BY_CHANCE * results.std_error[Combination.MISS]
    is_below = last_change < np.min(ends, axis=0) - noise
    is_above = last_change > np.max(ends, axis=0) + noise
    return is_below | is_above
