"""Means and variances of batches of samples, and how they are combined."""

from collections.abc import Iterable
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..sampling import Averaged


class Moments(NamedTuple):
    """Statistics of samples `begin` to `end - 1`, on the host and in float64.

    - `good`: the number of good samples.
    - `failed`: the number of failed paths, each counted once.
    - `failed_on`: the number of paths that failed on each level.
    - `mean`: the mean of the good samples. Arrays have a leading axis for combinations of
        levels.
    - `norm`: the root of the sum of squared deviations from the mean. (The sum itself would
        overflow or underflow sooner.)
    - `largest`: the largest deviation within a batch.
    - `size`: the largest absolute value.
    - `dtypes`: the dtype in which each array of `phi` was computed.
    """

    begin: int
    end: int
    good: int
    failed: int
    failed_on: tuple[int, ...]
    mean: Averaged
    norm: Averaged
    largest: Averaged
    size: Averaged
    dtypes: PyTree[str]


def joined(parts: Iterable[Moments]) -> tuple[Moments, ...]:
    """The moments in order, with neighbours combined in the way a binary counter carries.
    The result depends on the batches but not on the order of their arrival, and only a few
    entries remain."""
    out: list[Moments] = []
    for one in parts:
        out.append(one)
        while len(out) > 1 and _are_halves(out[-2], out[-1]):
            last = out.pop()
            out.append(_both(out.pop(), last))
    return tuple(out)


def total(parts: tuple[Moments, ...]) -> Moments:
    """The moments of all samples."""
    whole, *rest = parts
    for one in rest:
        whole = _both(whole, one)
    return whole


def _are_halves(a: Moments, b: Moments) -> bool:
    """Whether `a` and `b` are neighbours of one length, with `a` at an even place among all
    ranges of this length. (Without samples `a` joins any neighbour.)"""
    length = a.end - a.begin
    if a.end != b.begin:
        return False
    if length == 0:
        return True
    return b.end - b.begin == length and (a.begin // length) % 2 == 0


@np.errstate(over="ignore", invalid="ignore", under="ignore")
def _both(a: Moments, b: Moments) -> Moments:
    """The moments of both, by the pairwise formula of Chan, Golub and LeVeque."""
    n = max(a.good + b.good, 1)
    share_of_b = b.good / n
    # Times the difference of the means, squared, this adds to the squared deviations.
    weight = np.sqrt(a.good / n * b.good)
    change = jtu.tree_map(np.subtract, b.mean, a.mean)

    def mean(of_a, of_b, change):
        # Without samples `a` has no mean.
        return of_b if a.good == 0 else of_a + change * share_of_b

    def norm(of_a, of_b, change):
        return np.hypot(np.hypot(of_a, of_b), weight * change)

    return Moments(
        begin=a.begin,
        end=b.end,
        good=a.good + b.good,
        failed=a.failed + b.failed,
        failed_on=tuple(map(sum, zip(a.failed_on, b.failed_on))),
        mean=jtu.tree_map(mean, a.mean, b.mean, change),
        norm=jtu.tree_map(norm, a.norm, b.norm, change),
        largest=jtu.tree_map(np.maximum, a.largest, b.largest),
        size=jtu.tree_map(np.maximum, a.size, b.size),
        dtypes=b.dtypes,
    )
