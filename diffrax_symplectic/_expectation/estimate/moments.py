"""Means and deviations of batches of samples, and how batches are combined."""

from collections.abc import Iterable
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np

from ..sampling import Averaged


class Moments(NamedTuple):
    """Statistics of the samples with numbers from `begin` to `end - 1`, on the host.

    - `num_good`: the number of good samples. The sample of a path is good if the path did
        not fail; a replicate of many paths is good unless on some level all of them failed.
    - `num_failed`: the number of failed paths. A path that fails on several levels counts
        once.
    - `failed_on`: the number of paths that failed on each level.

    The other fields are statistics of the good samples, as arrays in float64 with axes for
    combinations of levels and for all numbers of `phi`:

    - `mean`: the mean.
    - `norm`: the root of the sum of squared deviations from the mean. (The sum itself would
        overflow or underflow sooner.)
    - `largest`: the largest deviation of a sample from the mean of its batch.
    - `size`: the largest absolute value.
    """

    begin: int
    end: int
    num_good: int
    num_failed: int
    failed_on: tuple[int, ...]
    mean: Averaged
    norm: Averaged
    largest: Averaged
    size: Averaged


def combined_in_halves(parts: Iterable[Moments]) -> tuple[Moments, ...]:
    """The moments of the same samples in fewer parts, since an estimate of many batches
    should keep a few parts only. `parts` are in the order of their samples.

    Two neighbours that are the halves of one range become one part, again and again, in the
    way a binary counter carries. So samples are always combined in the same pairs, and the
    result is bitwise the same in whatever order batches were computed and combined before.
    """
    combined_parts: list[Moments] = []
    for part in parts:
        combined_parts.append(part)
        while len(combined_parts) > 1 and _are_halves(*combined_parts[-2:]):
            second_half = combined_parts.pop()
            first_half = combined_parts.pop()
            combined_parts.append(_moments_of_both(first_half, second_half))
    return tuple(combined_parts)


def total(parts: tuple[Moments, ...]) -> Moments:
    """The moments of the samples of all parts together."""
    whole, *rest = parts
    for part in rest:
        whole = _moments_of_both(whole, part)
    return whole


def _are_halves(a: Moments, b: Moments) -> bool:
    """Whether `a` and then `b` are the halves of a range that begins at a multiple of its
    length, as samples 8 to 11 and 12 to 15 are."""
    length = a.end - a.begin
    is_next = a.end == b.begin and b.end - b.begin == length
    return is_next and (a.begin // length) % 2 == 0


@np.errstate(over="ignore", invalid="ignore", under="ignore")
def _moments_of_both(a: Moments, b: Moments) -> Moments:
    """The moments of all samples of `a` and `b`, by the pairwise formulas of
    [Chan, Golub and LeVeque (1983)](https://doi.org/10.1080/00031305.1983.10483115). With
    n = n_a + n_b good samples,

        mean   = mean_a + (n_b / n) (mean_b - mean_a),
        norm^2 = norm_a^2 + norm_b^2 + (n_a n_b / n) (mean_b - mean_a)^2."""
    n = max(a.num_good + b.num_good, 1)
    share_of_b = b.num_good / n
    # The root of n_a n_b / n.
    weight = np.sqrt(a.num_good / n * b.num_good)
    differences = jtu.tree_map(np.subtract, b.mean, a.mean)

    def mean_of_both(mean_of_a, mean_of_b, difference):
        # Without good samples the mean of `a` is a placeholder.
        return mean_of_b if a.num_good == 0 else mean_of_a + difference * share_of_b

    def norm_of_both(norm_of_a, norm_of_b, difference):
        return np.hypot(np.hypot(norm_of_a, norm_of_b), weight * difference)

    return Moments(
        begin=a.begin,
        end=b.end,
        num_good=a.num_good + b.num_good,
        num_failed=a.num_failed + b.num_failed,
        failed_on=tuple(map(sum, zip(a.failed_on, b.failed_on))),
        mean=jtu.tree_map(mean_of_both, a.mean, b.mean, differences),
        norm=jtu.tree_map(norm_of_both, a.norm, b.norm, differences),
        largest=jtu.tree_map(np.maximum, a.largest, b.largest),
        size=jtu.tree_map(np.maximum, a.size, b.size),
    )
