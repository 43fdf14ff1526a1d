"""Estimates of expectations, with error bars from the moments of the samples."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, BinaryIO

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .moments import Combination, joined, Moments, total
from .sampling import KINDS_OF_REPLICATES, KINDS_WITH_CONTROL, ROUNDING
from .saved import arrays_of, described, rebuilt


# A control variate is dropped if its mean is this many standard errors from zero, unless
# its own `r` exceeds this value.
_SURE, _HEAVY_CONTROL = 5, 0.1
# The last change by a smaller step, over what the order foretells from the change before.
# In between, the steps are taken to be in the asymptotic range. (Of half an order less it
# would be 1.41, of two orders more 0.25.)
_FASTEST, _SLOWEST = 0.25, 1.33
# The standard errors by which it may be off.
_BY_CHANCE = 2
# NumPy operations on zero-dimensional arrays return scalars.
_Host = PyTree[np.ndarray | np.floating]


class Expectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as returned by
    [`diffrax_symplectic.expectation`][] and [`diffrax_symplectic.monte_carlo`][]. Printed,
    it is a short summary.

    - `num_paths`: the number of paths in the estimate, on each level.
    - `num_failed`: the number of failed paths, which are excluded from the estimate.
    - `num_samples`: the number of independent samples: paths, or replicates of
        [`diffrax_symplectic.ArrayRQMC`][].
    - `samples`: the ranges of sample numbers, as pairs of the first number and one past the
        last: a single pair, unless merged parts leave gaps.
    - `sampling`: the sampling.
    - `reason`: why this sampling was chosen, or empty if there was no choice.
    - `tol_reached`: whether all standard errors are at most `tol`; `None` without `tol`.
    - `key_data`: the data of the random key.
    """

    # The moments of batches, with neighbours combined.
    moments: tuple[Moments, ...]
    key_data: np.ndarray
    paths_per_sample: int = 1
    # The smallest standard error, in roundings of the mean.
    roundings: int = 1
    sampling: Any = None
    reason: str = ""
    tol_reached: bool | None = None
    # For value functions: the mean absolute deviation from the fitted mean in the tails, as
    # estimated by paths whose noise is wider or pushed to one side.
    far: PyTree[np.ndarray] | None = None

    @property
    def num_samples(self) -> int:
        return sum(x.good for x in self.moments)

    @property
    def num_paths(self) -> int:
        return self.num_samples * self.paths_per_sample

    @property
    def num_failed(self) -> int:
        return sum(x.failed for x in self.moments)

    @property
    def samples(self) -> list[tuple[int, int]]:
        ranges: list[tuple[int, int]] = []
        for x in self.moments:
            begin = ranges.pop()[0] if ranges and ranges[-1][1] == x.begin else x.begin
            ranges.append((begin, x.end))
        return ranges

    @property
    def mean(self) -> _Host:
        r"""The estimate, in the structure of $\phi$ and in float64: the mean over the
        samples, extrapolated to step size zero if there are several levels. With `ts` there
        is a leading axis of times. NaN without samples."""
        return self._each("mean", Combination.BEST)

    @property
    def std_error(self) -> _Host:
        r"""The standard error of `mean`, from the standard deviation $s$ of the $n$ samples
        and an allowance for values too rare to be among them. It is

        $$ \sqrt{\frac{s^2}{n} \Bigl(1 + \frac{4 r^2}{(1 - r^2)^4}\Bigr) + b^2}, \qquad
        r = \frac{(M - s \sqrt{4.5 \log n})_+}{s \sqrt n}, $$

        where $M$ is the largest deviation from the mean. $M$ exceeds
        $s \sqrt{4.5 \log n}$ only for heavy tails, and $r = 1$ if a single sample accounts
        for all of the variance. (For sorted paths, $r$ is also computed for the paths
        within a replicate, and the larger value is used.) For value functions, $b$ is the
        part of the mean absolute deviation that only paths show whose noise is wider or
        pushed to one side; otherwise it is zero. The standard error is never less than the
        rounding of the mean."""
        return self._each("std_error", Combination.BEST)

    @property
    def variance(self) -> _Host:
        """The variance of a sample."""
        return self._each("variance", Combination.BEST)

    @property
    def bias(self) -> _Host | None:
        r"""The discretization error of the finest level, $\mathbb E[\phi_h] - \mathbb
        E[\phi]$, as estimated by extrapolation; `None` with a single level. It has already
        been removed from `mean`: `mean + bias` is the mean of the finest level."""
        return self._each("mean", Combination.BIAS)

    @property
    def bias_std_error(self) -> _Host | None:
        """The standard error of `bias`."""
        return self._each("std_error", Combination.BIAS)

    @property
    def error(self) -> _Host:
        r"""The total error of `mean`: the root of the sum of squares of `std_error`,
        `failed_error` and, with several levels, an estimate of the remaining discretization
        error.

        That is the change by the last extrapolation. With two levels it is unchecked, and
        may be far too small where the steps are too long. With three levels, the changes of
        the mean by the two halvings of the step are compared: for a method of order $p$ the
        last one should be $2^{-p}$ of the one before. If it is less than a quarter of that,
        or more than four thirds, by more than two standard errors, then the larger of these
        changes is taken instead, and the printed estimate says so. With $L > 3$ levels the
        same holds for the extrapolations from $L - 2$ neighbouring levels, of order
        $p + L - 3$.

        With one level the discretization error is unknown, and not included."""
        error = jtu.tree_map(np.hypot, self.std_error, self.failed_error)
        remaining = self._each("mean", Combination.EXTRAPOLATION)
        if remaining is None:
            return error
        if self.off_order is not None:
            last = self._each("mean", Combination.LAST)
            before = self._each("mean", Combination.BEFORE)
            trees = self.off_order, remaining, last, before
            remaining = jtu.tree_map(_remaining, *trees)
        return jtu.tree_map(np.hypot, error, remaining)

    @property
    def failed_error(self) -> _Host:
        """What failed paths could change in `mean`: their fraction of all paths, times the
        largest deviation of another path's value from the mean. (For sorted paths, that is
        the mean over the replicates.) It does not decrease with more paths."""
        lost = self.num_failed
        # Replicates count the paths that failed in them, too.
        whole = self.num_paths + (lost if self.paths_per_sample == 1 else 0)
        fraction = lost / max(whole, 1)
        spread = self._each("spread", Combination.BEST)
        return jtu.tree_map(lambda x: fraction * x, spread)

    @property
    def off_order(self) -> PyTree[np.ndarray] | None:
        """Whether the changes of the mean from step to step do not fit the order, as in
        `error`; `None` with fewer than three levels."""
        last = self._each("mean", Combination.LAST)
        if last is None:
            return None
        miss = self._each("mean", Combination.MISS)
        miss_error = self._each("std_error", Combination.MISS)
        return jtu.tree_map(_is_off_order, last, miss, miss_error)

    def interval(self, confidence: float = 0.95) -> tuple[_Host, _Host]:
        r"""The ends of a confidence interval for the mean of infinitely many samples:
        `mean` plus and minus `std_error` times the quantile of Student's $t$ with
        `num_samples - 1` degrees of freedom. (For 95% this is 2.13 standard errors with 16
        samples, and 1.96 with very many.) The remaining discretization error is not
        included, nor are failed paths: see `error`."""
        # Imported here: it would double the time to import this package.
        from scipy.special import stdtrit

        factor = stdtrit(max(self.num_samples - 1, 1), (1 + confidence) / 2)
        side = lambda sign: jtu.tree_map(
            lambda m, s: m + sign * factor * s, self.mean, self.std_error
        )
        return side(-1), side(1)

    def merge(self, *others: "Expectation") -> "Expectation":
        """Combines this estimate with others from the same `key` and arguments, but with
        different samples (see `first` of `expectation`).

        If the parts start at multiples of the batch size, the result is bitwise equal to a
        single estimate from all samples, for any order of merging.

        **Raises:** a `ValueError` for parts with another key, of other shapes, by another
        `sampling`, or with samples in common.

        **Source:** [Chan, Golub and LeVeque
        (1983)](https://doi.org/10.1080/00031305.1983.10483115).
        """
        for other in others:
            if not isinstance(other, Expectation):
                raise ValueError(f"`merge` takes estimates; got {other!r}.")
            if type(other.sampling) is not type(self.sampling):
                raise ValueError(
                    f"Estimates to merge were sampled by {self.sampling} and by "
                    f"{other.sampling}."
                )
            self.check_same(other, "An estimate to merge")
        parts = sorted(
            (x for e in (self, *others) for x in e.moments), key=lambda x: x.begin
        )
        for one, after in zip(parts, parts[1:]):
            if after.begin < one.end:
                raise ValueError(
                    f"Samples {after.begin:,} to {min(one.end, after.end) - 1:,} are in "
                    "two of the estimates to merge. Pass a different `first` for each part."
                )
        return dataclasses.replace(self, moments=joined(parts), tol_reached=None)

    def check_same(self, other: "Expectation", name: str) -> None:
        """Raises a `ValueError` if the estimates have different keys, shapes or numbers of
        paths in a sample."""
        if not np.array_equal(self.key_data, other.key_data):
            raise ValueError(
                f"{name} has another `key`. Pass the same `key` for all parts of an "
                "estimate."
            )
        shapes = lambda e: jtu.tree_map(np.shape, e.moments[0].mean)
        if not eqx.tree_equal(shapes(self), shapes(other)):
            raise ValueError(
                f"{name} has another structure or other shapes. Pass one from the same "
                "function, times and levels."
            )
        sizes = self.paths_per_sample, other.paths_per_sample
        if sizes[0] != sizes[1]:
            raise ValueError(
                f"{name} was sampled otherwise: a sample is a mean over {sizes[0]:,} paths "
                f"in one of the estimates, and over {sizes[1]:,} in the other. Pass the "
                "same `sampling` for all parts of an estimate."
            )

    def save(self, file: str | Path | BinaryIO) -> None:
        """Writes the estimate to a NumPy `.npz` file, which `Expectation.load` reads.
        $\\phi$ must be made of dictionaries, lists, tuples and arrays. Functions in
        `sampling`, such as `sort_by`, are not saved."""
        header, arrays = described(self), arrays_of(self)
        arrays["header"] = np.array(json.dumps(header))
        if isinstance(file, str | Path):
            with open(file, "wb") as opened:
                np.savez(opened, **arrays)  # pyright: ignore
        else:
            np.savez(file, **arrays)  # pyright: ignore

    @staticmethod
    def load(file: str | Path | BinaryIO) -> "Expectation":
        """Reads an estimate written by `save`. No code from the file is executed."""
        with np.load(file, allow_pickle=False) as arrays:
            if "header" not in arrays:
                raise ValueError(f"{file} was not written by `Expectation.save`.")
            return rebuilt(Expectation, json.loads(str(arrays["header"])), arrays)

    def __str__(self) -> str:
        leaves = jtu.tree_leaves_with_path(self.mean)
        several = self.bias is not None
        trees = [self.mean, self.std_error, self.error]
        if several:
            trees += [self.bias, self.bias_std_error]
        lines, biases = [], []
        for (path, _), *row in zip(leaves[:6], *map(jtu.tree_leaves, trees)):
            mean, error, whole, *bias = row
            line = f"{_with_digits(mean, error)} ± {_brief(error)}"
            if several or self.num_failed > 0:
                line += f" (sampling), {_brief(whole)} (total)"
            if several:
                biases.append(" ± ".join(map(_brief, bias)))
            lines.append(f"{jtu.keystr(path)}: {line}" if len(leaves) > 1 else line)
        lines += ["..."] * (len(leaves) > 6)
        if biases:
            lines.append(f"bias of the finest step (removed): {', '.join(biases)}")
            lines += self._said_of_levels()
        elif self.sampling is not None:
            lines.append("not included: the discretization error (see `levels`)")
        how = "" if self.sampling is None else f", {self.sampling}"
        lines.append(f"{self.num_paths:,} paths, {self.num_failed:,} failed{how}")
        if self.num_failed > 0:
            each = map(_brief, jtu.tree_leaves(self.failed_error)[:6])
            lines.append(f"failed paths could change the mean by {', '.join(each)}")
        lines += [self.reason] if self.reason else []
        lines += ["`tol` was not reached"] if self.tol_reached is False else []
        return "\n".join(lines)

    __repr__ = __str__

    def _said_of_levels(self) -> list[str]:
        """What the printed estimate says of the discretization error that remains."""
        if self.off_order is None:
            return [
                "unchecked: what remains of the discretization error (pass `levels=3`)"
            ]
        if any(np.any(x) for x in jtu.tree_leaves(self.off_order)):
            return [
                "the changes from step to step do not fit the order: the total error is "
                "the larger one (take smaller steps)"
            ]
        return []

    def _each(self, name: str, combination: int) -> Any:
        """A result for each leaf, or `None` if there is no such combination of levels."""
        whole, far = total(self.moments), self.far
        if any(x.shape[1] <= combination for x in jtu.tree_leaves(whole.mean)):
            return None
        if far is None:
            far = jtu.tree_map(lambda x: np.zeros(x.shape[1:]), whole.mean)
        one = lambda *leaves: _results(whole.good, self.roundings, *leaves)[name]
        trees = whole.mean, whole.norm, whole.largest, whole.dtypes, far
        return jtu.tree_map(lambda *leaves: one(*leaves)[combination], *trees)

    @property
    def plain_std_error(self) -> _Host:
        """The standard error without a control variate."""
        return self._each("plain_std_error", Combination.BEST)

    @property
    def heaviest(self) -> float:
        """The largest `r` of `std_error`."""
        return self._largest("weight")

    @property
    def dropped(self) -> bool:
        """Whether a control variate was dropped because its mean is not zero."""
        return self._largest("dropped") > 0

    def _largest(self, name: str) -> float:
        each = jtu.tree_leaves(self._each(name, Combination.BEST))
        return max((float(np.max(x, initial=0.0)) for x in each), default=0.0)


def _with_digits(mean, error) -> str:
    """The mean, with two digits beyond the smallest error."""
    least = np.clip(np.min(np.nan_to_num(error), initial=1), 1e-10, 1)
    digits = 2 - math.floor(math.log10(least))
    mode = "fixed" if digits < 12 else "maxprec"
    mean = np.asarray(mean)
    return np.array2string(mean, precision=digits, threshold=6, floatmode=mode)


def _brief(x) -> str:
    short: Any = {"float_kind": "{:.1e}".format}
    return np.array2string(np.asarray(x), formatter=short, threshold=6)


@np.errstate(invalid="ignore")
def _is_off_order(last, miss, miss_error) -> np.ndarray:
    """Whether the last change is not what the order makes of the change before."""
    foretold = last - miss
    ends = np.stack([_FASTEST * foretold, _SLOWEST * foretold])
    allowed = _BY_CHANCE * miss_error
    low = np.min(ends, axis=0) - allowed
    high = np.max(ends, axis=0) + allowed
    return (last < low) | (last > high)


def _remaining(off_order, extrapolation, last, before) -> np.ndarray:
    """An estimate of the discretization error that remains."""
    size = np.abs(extrapolation)
    largest = np.maximum(np.abs(last), np.abs(before))
    return np.where(off_order, np.maximum(size, largest), size)


@np.errstate(all="ignore")
def _results(
    n: int, roundings: int, mean, norm, largest, dtype: str, far
) -> dict[str, np.ndarray]:
    """The results for an array, for each combination of levels, from its moments. Their
    first axis is for the kinds of `Samples`."""
    s = norm / np.sqrt(n - 1) if n > 1 else np.full_like(norm, np.nan)
    outlying = np.maximum(largest - s * np.sqrt(4.5 * np.log(max(n, 2))), 0)
    r = np.where(s > 0, outlying / (s * np.sqrt(n)), 0)
    controlled = len(mean) == KINDS_WITH_CONTROL
    # The largest deviation of a path without control.
    spread = largest[int(controlled)]
    # Combinations of levels are differences of values as large as the mean.
    size = np.fmax.reduce(np.abs(mean[: 1 + controlled, :1]))
    rounding = roundings * float(jnp.finfo(dtype).eps) * size
    # Rounding errors can have heavy tails, too.
    r = np.where(largest > ROUNDING * rounding, r, 0)
    if len(mean) == KINDS_OF_REPLICATES:
        r[0] = np.fmax(r[0], mean[1])
        spread = mean[2]
    r = np.minimum(r, 1 - 1e-6)
    error = s / np.sqrt(n) * np.sqrt(1 + 4 * r**2 / (1 - r**2) ** 4)
    error = np.maximum(error, rounding)
    dropped = np.zeros(mean.shape[1:], bool)
    if controlled:
        # For a control with heavy tails its standard error is not reliable.
        fine = np.abs(mean[2]) <= np.fmax(_SURE * error[2], ROUNDING * rounding)
        fine |= r[2] > _HEAVY_CONTROL
        dropped |= ~np.all(fine & np.isfinite(mean[0]), axis=0)
        # Tails that the samples show are in their variance already. (NaN, from a trial
        # without a value, is ignored.)
        unseen = np.where(far > mean[3], far - mean[3], 0)
        error[0] = np.hypot(error[0], unseen)
    best = lambda x: np.where(dropped, x[1], x[0]) if controlled else x[0]
    return {
        "mean": best(mean) if n > 0 else np.full_like(mean[0], np.nan),
        "std_error": best(error),
        "plain_std_error": error[int(controlled)],
        "variance": best(s) ** 2,
        "weight": best(r),
        "dropped": dropped,
        "spread": spread,
    }


class ExpectationInterrupted(KeyboardInterrupt):
    """Raised by [`diffrax_symplectic.expectation`][] and
    [`diffrax_symplectic.monte_carlo`][] in place of a `KeyboardInterrupt`. Its attribute
    `estimate` holds the estimate so far, which `start=` continues."""

    def __init__(self, estimate: Expectation):
        super().__init__(
            f"Interrupted after {estimate.num_paths + estimate.num_failed} paths. Catch "
            "`ExpectationInterrupted` and pass its `estimate` as `start` to continue."
        )
        self.estimate = estimate
