"""Means, standard errors and what else follows from the moments of samples."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float, PyTree

from ..._simulation import Combination
from ..sampling import KindsOfReplicates, KindsWithControl, ROUNDING
from .moments import Moments


# A control variate is dropped if its mean is this many standard errors from zero: by chance
# that happens less than once in a million times.
_SURE = 5
# Unless its own `r` exceeds this value: its standard error is then not reliable.
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
# The standard errors by which it may be off.
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
    roundings: int,
    far: PyTree[np.ndarray] | None,
    combination: Combination,
) -> Results:
    """The results for one combination of levels.

    Each array of `moments.mean` has the shape `(kinds, combinations, ...)`, where the dots
    are the axes of one component of the mean. `roundings` and `far` are those of
    `Expectation`; an array of `far` has the shape `(combinations, ...)`.
    """
    means, treedef = jtu.tree_flatten(moments.mean)
    # Only fits of value functions estimate tails by paths of their own. Deviations of zero
    # there add nothing to the standard errors.
    if far is None:
        tails = [np.zeros(mean.shape[1:]) for mean in means]
    else:
        tails = jtu.tree_leaves(far)
    each = [
        _results_of_array(moments.good, roundings, *parts)
        for parts in zip(
            means,
            jtu.tree_leaves(moments.norm),
            jtu.tree_leaves(moments.largest),
            jtu.tree_leaves(moments.dtypes),
            tails,
        )
    ]
    # `each` has all fields of one array after another, each with an axis of combinations.
    # PyTrees need all arrays of one field after another, at this combination.
    fields = [[array[combination] for array in arrays] for arrays in zip(*each)]
    return Results(*map(treedef.unflatten, fields))


@np.errstate(all="ignore")
def _results_of_array(
    n: int,
    roundings: int,
    mean: Float[np.ndarray, "kinds combinations ..."],
    norm: Float[np.ndarray, "kinds combinations ..."],
    largest: Float[np.ndarray, "kinds combinations ..."],
    dtype: str,
    tails: Float[np.ndarray, "combinations ..."],
) -> Results:
    """The results for an array and each combination of levels, from its moments over `n`
    samples. The kinds are those of `Samples`. `tails` is the mean absolute deviation in the
    tails, as paths with wider noise estimate it."""
    has_control = len(mean) == len(KindsWithControl)
    is_replicate = len(mean) == len(KindsOfReplicates)
    # Where the values without control are.
    plain = KindsWithControl.PLAIN if has_control else 0
    spread = mean[KindsOfReplicates.LARGEST] if is_replicate else largest[plain]

    # Combinations of levels are differences of values as large as the mean.
    size = np.fmax.reduce(np.abs(mean[: plain + 1, :1]))
    rounding = roundings * float(jnp.finfo(dtype).eps) * size

    s = norm / np.sqrt(n - 1) if n > 1 else np.full_like(norm, np.nan)
    r = np.where(s > 0, heaviness(largest, s, n), 0)
    # Rounding errors can have heavy tails, too.
    r = np.where(largest > ROUNDING * rounding, r, 0)
    if is_replicate:
        # The mean over many paths hides their tails.
        r[0] = np.fmax(r[0], mean[KindsOfReplicates.HEAVINESS])
    r = np.minimum(r, _MOST_HEAVY)
    error = s / np.sqrt(n) * np.sqrt(1 + 4 * r**2 / (1 - r**2) ** 4)
    error = np.maximum(error, rounding)

    dropped = np.zeros(mean.shape[1:], bool)
    if has_control:
        control = KindsWithControl.CONTROL
        allowed = np.fmax(_SURE * error[control], ROUNDING * rounding)
        is_fine = np.abs(mean[control]) <= allowed
        is_fine |= r[control] > _HEAVY_CONTROL
        is_fine &= np.isfinite(mean[KindsWithControl.CONTROLLED])
        # Combinations of levels belong together: for all or for none.
        dropped |= ~np.all(is_fine, axis=0)
        # Tails that the samples show are in their variance already. (NaN, from a trial
        # without a value, is ignored.)
        shown = mean[KindsWithControl.TAILS]
        unseen = np.where(tails > shown, tails - shown, 0)
        error[0] = np.hypot(error[0], unseen)

    def best(x: np.ndarray) -> np.ndarray:
        return np.where(dropped, x[plain], x[0]) if has_control else x[0]

    return Results(
        mean=best(mean) if n > 0 else np.full_like(mean[0], np.nan),
        std_error=best(error),
        plain_std_error=error[plain],
        variance=best(s) ** 2,
        heaviness=best(r),
        dropped=dropped,
        spread=spread,
    )


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
