"""Means and variances of batches of samples, their combination, and their weights in
extrapolation."""

import enum
from collections.abc import Iterable
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float, PyTree


class Moments(NamedTuple):
    """Statistics of samples `begin` to `end - 1`, on the host and in float64.

    - `good`: the number of good samples; `failed`: the number of failed paths.
    - `mean`: the mean of the good samples, with two leading axes for kinds and for
        combinations of levels.
    - `norm`: the root of the sum of squared deviations from the mean. (The sum itself would
        overflow or underflow sooner.)
    - `largest`: the largest deviation within a batch.
    - `size`: the largest absolute value.
    - `dtypes`: the dtype in which each array was computed.
    """

    begin: int
    end: int
    good: int
    failed: int
    mean: PyTree[np.ndarray]
    norm: PyTree[np.ndarray]
    largest: PyTree[np.ndarray]
    size: PyTree[np.ndarray]
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
    length = a.end - a.begin
    if a.end != b.begin or length == 0:
        return a.end == b.begin
    return b.end - b.begin == length and (a.begin // length) % 2 == 0


@np.errstate(over="ignore", invalid="ignore", under="ignore")
def _both(a: Moments, b: Moments) -> Moments:
    """The pairwise formula of Chan, Golub and LeVeque."""
    n, trees = max(a.good + b.good, 1), jtu.tree_map
    share, part = np.sqrt(a.good / n * b.good), b.good / n
    delta = trees(lambda x, y: y - x, a.mean, b.mean)
    norm = lambda x, y, d: np.hypot(np.hypot(x, y), share * d)
    # Without samples `a` has no mean.
    mean = lambda x, y, d: y if a.good == 0 else x + d * part
    return Moments(
        a.begin, b.end, a.good + b.good, a.failed + b.failed,
        trees(mean, a.mean, b.mean, delta),
        trees(norm, a.norm, b.norm, delta),
        trees(np.maximum, a.largest, b.largest),
        trees(np.maximum, a.size, b.size),
        b.dtypes,
    )  # fmt: skip


class Combination(enum.IntEnum):
    """The rows of `level_weights`."""

    # Extrapolated to step size zero.
    BEST = 0
    # With two levels or more: the finest level's mean minus the best, and the change by the
    # last extrapolation.
    BIAS = 1
    EXTRAPOLATION = 2
    # With three levels or more, for the extrapolations from all but two neighbouring levels
    # (from one level of three): the change to the last of these three and to the one
    # before, and the former minus what the order foretells from the latter.
    LAST = 3
    BEFORE = 4
    MISS = 5


def level_weights(
    order: float, levels: int
) -> Float[np.ndarray, "combinations levels"]:
    r"""The combinations of the means with steps $h, h/2, h/4, \ldots$ that an
    [`diffrax_symplectic.Expectation`][] holds, for a method of weak order $p$: the rows of
    `Combination`, as far as $L$ levels have them. The first eliminates the error terms in
    $h^p, \ldots, h^{p + L - 2}$, or for $p = 1/2$ the terms in
    $h^{1/2}, \ldots, h^{(L - 1)/2}$.

    [Talay and Tubaro (1990)](https://doi.org/10.1080/07362999008809220) show that the error
    has an expansion in powers of $h$.
    """
    best = _extrapolated(order, levels)
    if levels == 1:
        return best[None]
    # The finer levels alone, which eliminate one power of the step size less.
    before = np.append(0.0, _extrapolated(order, levels - 1))
    rows = [best, np.eye(levels)[-1] - best, best - before]
    if levels > 2:
        of_some = _extrapolated(order, levels - 2)
        coarse, middle, fine = (np.pad(of_some, (k, 2 - k)) for k in range(3))
        last = fine - middle
        change_before = middle - coarse
        # The first power of the step size that is left in these.
        power = order + levels - 3
        rows += [last, change_before, last - 2.0**-power * change_before]
    return np.stack(rows)


def _extrapolated(order: float, levels: int) -> Float[np.ndarray, " levels"]:
    powers = np.append(0.0, order + min(order, 1) * np.arange(levels - 1))
    system = 2.0 ** -np.outer(powers, np.arange(levels))
    return np.linalg.solve(system, np.eye(levels)[0])
