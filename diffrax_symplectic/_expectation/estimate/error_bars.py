"""Means, standard errors and what else follows from the moments of samples."""

import functools as ft
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float, PyTree

from ..._simulation import Combination
from ..sampling import Averaged, ROUNDING
from .moments import Moments


# A control variate is dropped if its mean is this many standard errors from zero: by chance
# that happens less than once in a million times.
_SURE_OF_CONTROL = 5
# Unless its own `r` exceeds this value: its tails are then so heavy that its standard error
# is not reliable.
_HEAVY_CONTROL = 0.1
# The largest deviation of n normal samples exceeds the root of this number times log(n), in
# standard deviations, with a probability of less than n^(-5/4).
_OUTLYING = 4.5
# A single sample that accounts for all of the variance has r = 1, where the standard error
# would be infinite.
_MOST_HEAVY = 1 - 1e-6
# The last change by a smaller step, over what the order foretells from the change before.
# In between, the steps are taken to be in the asymptotic range. (Of half an order less it
# would be 1.41, of two orders more 0.25.)
_FASTEST = 0.25
_SLOWEST = 1.33
# The standard errors by which it may miss them.
_BY_CHANCE = 2


def heaviness(largest: Any, s: Any, n: Any, numpy: Any = np) -> Any:
    """The `r` of `Expectation.std_error`, from the largest deviation and the standard
    deviation `s` of `n` values, by NumPy or `jax.numpy`. (Not finite if `s` is zero.)"""
    usual = s * numpy.sqrt(_OUTLYING * numpy.log(numpy.maximum(n, 2)))
    return numpy.maximum(largest - usual, 0) / (s * numpy.sqrt(n))


class Results(NamedTuple):
    """What follows from the moments of samples, for one combination of levels. Each field
    has the structure of `phi`, with a leading axis of times, if any.

    - `mean`, `std_error`, `variance`: as in `Expectation`.
    - `plain_std_error`: the standard error without a control variate.
    - `heaviness`: the `r` of `Expectation.std_error`.
    - `dropped`: whether a control variate was dropped because its mean is not zero.
    - `spread`: the largest deviation of a path's value from the mean, without control. (For
        replicates, that is the mean over the replicates.)
    """

    mean: PyTree[np.ndarray]
    std_error: PyTree[np.ndarray]
    plain_std_error: PyTree[np.ndarray]
    variance: PyTree[np.ndarray]
    heaviness: PyTree[np.ndarray]
    dropped: PyTree[np.ndarray]
    spread: PyTree[np.ndarray]


def results_of(
    moments: Moments,
    rounding_floor: int,
    tails: PyTree[np.ndarray] | None,
    combination: Combination,
) -> Results:
    """The results for one combination of levels.

    Each array of `moments.mean` has the shape `(combinations, ...)`, where the dots are the
    axes of one component of the mean; so has each array of `tails`. `rounding_floor`
    and `tails` are those of `Expectation`.
    """
    treedef = jtu.tree_structure(moments.mean.value)
    # Only fits of value functions estimate tails by paths of their own. Deviations of zero
    # there add nothing to the standard errors.
    if tails is None:
        tails = jtu.tree_map(np.zeros_like, moments.mean.value)
    each = [
        _results_of_array(moments.good, rounding_floor, *parts)
        for parts in zip(
            _by_array(moments.mean),
            _by_array(moments.norm),
            _by_array(moments.largest),
            jtu.tree_leaves(moments.dtypes),
            jtu.tree_leaves(tails),
        )
    ]
    # `each` has all fields of one array after another, each with an axis of combinations.
    # PyTrees need all arrays of one field after another, at this combination.
    fields = [[array[combination] for array in arrays] for arrays in zip(*each)]
    return Results(*map(treedef.unflatten, fields))


def _by_array(averaged: Averaged) -> list[Averaged]:
    """For each array of `phi` what is averaged of it."""
    fields = averaged.fields
    by_field = zip(*map(jtu.tree_leaves, fields.values()))
    return [Averaged(**dict(zip(fields, parts))) for parts in by_field]


@np.errstate(all="ignore")
def _results_of_array(
    n: int,
    rounding_floor: int,
    mean: Averaged,
    norm: Averaged,
    largest: Averaged,
    dtype: str,
    tails: Float[np.ndarray, "combinations ..."],
) -> Results:
    """The results for an array of `phi` and each combination of levels, from its moments
    over `n` samples. `tails` is the mean absolute deviation in the tails, as paths with
    wider noise estimate it."""
    plain_mean = mean.without_control
    # Combinations of levels are differences of values as large as the mean.
    size = np.fmax(np.abs(mean.value[:1]), np.abs(plain_mean[:1]))
    rounding = rounding_floor * float(jnp.finfo(dtype).eps) * size
    spread_of = ft.partial(_spread_of, n, rounding)

    controlled = spread_of(norm.value, largest.value, mean.heaviness)
    results = Results(
        mean=mean.value,
        std_error=controlled.error,
        plain_std_error=controlled.error,
        variance=controlled.s**2,
        heaviness=controlled.r,
        dropped=np.zeros(plain_mean.shape, bool),
        spread=largest.without_control if mean.largest is None else mean.largest,
    )
    if mean.control is not None:
        control = spread_of(norm.control, largest.control)
        allowed = np.fmax(_SURE_OF_CONTROL * control.error, ROUNDING * rounding)
        is_fine = np.abs(mean.control) <= allowed
        is_fine |= control.r > _HEAVY_CONTROL
        is_fine &= np.isfinite(mean.value)
        # Combinations of levels belong together: for all or for none.
        dropped = np.broadcast_to(~np.all(is_fine, axis=0), plain_mean.shape)
        # Tails that the samples show are in their variance already. (NaN, from a trial
        # without a value, is ignored.)
        unseen = np.where(tails > mean.tails, tails - mean.tails, 0)
        plain = spread_of(norm.plain, largest.plain)
        results = results._replace(
            mean=np.where(dropped, plain_mean, mean.value),
            std_error=np.where(
                dropped, plain.error, np.hypot(controlled.error, unseen)
            ),
            plain_std_error=plain.error,
            variance=np.where(dropped, plain.s, controlled.s) ** 2,
            heaviness=np.where(dropped, plain.r, controlled.r),
            dropped=dropped,
        )
    if n == 0:
        return results._replace(mean=np.full_like(plain_mean, np.nan))
    return results


class _Spread(NamedTuple):
    """How values spread: their standard deviation, their `heaviness`, and the standard
    error of their mean."""

    s: np.ndarray
    r: np.ndarray
    error: np.ndarray


def _spread_of(
    n: int,
    rounding: np.ndarray,
    norm: np.ndarray,
    largest: np.ndarray,
    within: np.ndarray | None = None,
) -> _Spread:
    """The spread of `n` values, from their moments. `within` is the `heaviness` of the
    paths that each value is a mean of, which hides their tails."""
    s = norm / np.sqrt(n - 1) if n > 1 else np.full_like(norm, np.nan)
    r = np.where(s > 0, heaviness(largest, s, n), 0)
    # Rounding errors can have heavy tails, too.
    r = np.where(largest > ROUNDING * rounding, r, 0)
    if within is not None:
        r = np.fmax(r, within)
    r = np.minimum(r, _MOST_HEAVY)
    error = s / np.sqrt(n) * np.sqrt(1 + 4 * r**2 / (1 - r**2) ** 4)
    return _Spread(s, r, np.maximum(error, rounding))


@np.errstate(invalid="ignore")
def is_off_order(last: Any, miss: Any, miss_error: Any) -> np.ndarray:
    """Whether the last change is not what the order makes of the change before. `miss` is
    the difference of the two."""
    foretold = last - miss
    ends = np.stack([_FASTEST * foretold, _SLOWEST * foretold])
    allowed = _BY_CHANCE * miss_error
    low = np.min(ends, axis=0) - allowed
    high = np.max(ends, axis=0) + allowed
    return (last < low) | (last > high)


def remaining_error(
    off_order: Any, extrapolation: Any, last: Any, before: Any
) -> np.ndarray:
    """An estimate of the discretization error that remains: the change by the last
    extrapolation, or the largest change where the changes do not fit the order."""
    size = np.abs(extrapolation)
    largest = np.maximum(np.abs(last), np.abs(before))
    return np.where(off_order, np.maximum(size, largest), size)
