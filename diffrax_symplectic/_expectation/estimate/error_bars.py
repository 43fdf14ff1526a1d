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
# The last change may be outside that range by this many standard errors.
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
    value_spread = _spread_of(
        n, rounding, moments.norm.value, moments.largest.value, mean.heaviness
    )
    largest_of_paths = mean.largest
    if largest_of_paths is None:
        largest_of_paths = moments.largest.without_control
    results = Results(
        mean=mean.value,
        std_error=value_spread.std_error,
        plain_std_error=value_spread.std_error,
        plain_s=value_spread.s,
        variance=value_spread.s**2,
        heaviness=value_spread.r,
        dropped=np.zeros(plain_mean.shape, bool),
        spread=largest_of_paths,
    )
    if mean.control is not None:
        results = _results_with_control(results, n, rounding, moments)
    if n == 0:
        return results._replace(mean=np.full_like(plain_mean, np.nan))
    return results


def _results_with_control(
    results: Results, n: int, rounding: np.ndarray, moments: Moments
) -> Results:
    """The results for values with a control variate, without it where it is dropped."""
    mean = moments.mean
    control_spread = _spread_of(
        n, rounding, moments.norm.control, moments.largest.control
    )
    plain_spread = _spread_of(n, rounding, moments.norm.plain, moments.largest.plain)
    allowed = np.fmax(
        _STD_ERRORS_TO_DROP * control_spread.std_error, ROUNDING * rounding
    )
    mean_may_be_zero = np.abs(mean.control) <= allowed
    # With heavy tails the standard error in `allowed` is not reliable.
    has_heavy_tails = control_spread.r > _HEAVY_CONTROL
    is_kept = (mean_may_be_zero | has_heavy_tails) & np.isfinite(mean.value)
    # A control variate is kept for all combinations of levels or for none.
    dropped = np.broadcast_to(~np.all(is_kept, axis=0), mean.plain.shape)
    return results._replace(
        mean=np.where(dropped, mean.plain, mean.value),
        std_error=np.where(dropped, plain_spread.std_error, results.std_error),
        plain_std_error=plain_spread.std_error,
        plain_s=plain_spread.s,
        variance=np.where(dropped, plain_spread.s**2, results.variance),
        heaviness=np.where(dropped, plain_spread.r, results.heaviness),
        dropped=dropped,
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
def is_off_order(last: Any, miss: Any, miss_error: Any) -> np.ndarray:
    """Whether the `last` change by a smaller step does not fit the order of the solver.
    `miss` is this change minus what the order foretells from the change before, and
    `miss_error` its standard error."""
    prediction = last - miss
    # The ends of the range of changes that fit. The second is the lower one where the
    # prediction is negative.
    ends = np.stack([_LEAST_RATIO * prediction, _LARGEST_RATIO * prediction])
    allowance = _STD_ERRORS_BY_CHANCE * miss_error
    low = np.min(ends, axis=0) - allowance
    high = np.max(ends, axis=0) + allowance
    return (last < low) | (last > high)


def remaining_error(
    change: Any, change_by_first_power: Any, std_error: Any
) -> np.ndarray | np.floating:
    """An estimate of the discretization error that remains after the last extrapolation.

    It is the larger of two numbers: the size of the `change` by this extrapolation, and
    that of the change that it would make if it eliminated the first power of the step size
    only, less two standard errors, `std_error`, of this second change."""
    # With `change` alone, 5 to 12% of the means of harmonic oscillators over long times, by
    # four and five levels, were more than two error bars off. With both it is 0 to 2%.
    least_change = np.abs(change_by_first_power) - _STD_ERRORS_BY_CHANCE * std_error
    return np.maximum(np.abs(change), least_change)


def largest_if_off_order(
    off_order: Any, size: Any, last: Any, before: Any
) -> np.ndarray:
    """The `size` of the error that remains; or where the changes do not fit the order, the
    largest of this size and those of the `last` change by a smaller step and of the change
    `before` that one."""
    largest_change = np.maximum(np.abs(last), np.abs(before))
    return np.where(off_order, np.maximum(size, largest_change), size)
