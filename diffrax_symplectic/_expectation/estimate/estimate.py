"""`Expectation`: an estimate with error bars, from the moments of its samples."""

import dataclasses
import math
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import equinox as eqx
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..._arguments import is_real_number
from ..._simulation import Combination, Layout
from .error_bars import discretization_error, Results, results_of
from .moments import combined_in_halves, Moments, total
from .saved import contents_of, fields_from, OtherVersion, read, write


# NumPy operations on zero-dimensional arrays return scalars.
_Host = PyTree[np.ndarray | np.floating]


class Expectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as returned by
    [`diffrax_symplectic.expectation`][] and [`diffrax_symplectic.monte_carlo`][]. Printed,
    it is a short summary.

    - `levels`: the number of step sizes, each half the one before.
    - `num_paths`: the number of paths in the estimate, on each level.
    - `num_failed`: the number of failed paths, which are excluded from the estimate. A path
        that fails on several levels counts once.
    - `num_samples`: the number of independent samples: paths, or replicates of
        [`diffrax_symplectic.ArrayRQMC`][].
    - `samples`: the ranges of sample numbers, as pairs of the first number and one past the
        last: a single pair, unless merged parts leave gaps.
    - `sampling`: the sampling.
    - `reason`: why this sampling was chosen, or empty if there was no choice.
    - `tol_reached`: whether the `error` of every mean is at most `tol` and the changes from
        step to step fit the order; `None` without `tol`.
    - `key_data`: the data of the random key.
    - `ts`: the times of the leading axis of `mean`, or `None` without this axis. (Also for
        estimates from files of earlier versions.)

    The other fields are what `save` stores beside these, and may change: `moments`,
    `layout`, `dtype`, `paths_per_sample`, `rounding_floor`, `digests` and `caveat`.
    """

    # The moments of batches, after `combined_in_halves`.
    moments: tuple[Moments, ...]
    key_data: np.ndarray
    # How the numbers of the moments make PyTrees like `phi`.
    layout: Layout = eqx.field(static=True)
    levels: int
    # The dtype in which samples were computed. (Moments are in float64.)
    dtype: str
    paths_per_sample: int = 1
    # The smallest standard error, in units of the rounding of the mean.
    rounding_floor: int = 1
    sampling: Any = None
    reason: str = ""
    tol_reached: bool | None = None
    # What the checks of the step size could not see, in words.
    caveat: str = ""
    # A hash of each argument, by its name, so that `check_same` can tell estimates from
    # other arguments. `None` if there are none, as in files of earlier versions.
    digests: dict[str, str] | None = None
    ts: np.ndarray | None = None

    @property
    def num_samples(self) -> int:
        return sum(part.num_good for part in self.moments)

    @property
    def num_paths(self) -> int:
        return self.num_samples * self.paths_per_sample

    @property
    def num_failed(self) -> int:
        return sum(part.num_failed for part in self.moments)

    @property
    def failed_on(self) -> tuple[int, ...]:
        """The number of paths that failed on each level, the coarsest level first."""
        return total(self.moments).failed_on

    @property
    def samples(self) -> list[tuple[int, int]]:
        ranges: list[tuple[int, int]] = []
        for part in self.moments:
            begin = part.begin
            # A part that begins where the last range ends makes that range longer.
            if ranges and ranges[-1][1] == begin:
                begin, _ = ranges.pop()
            ranges.append((begin, part.end))
        return ranges

    @property
    def mean(self) -> _Host:
        r"""The estimate, in the structure of $\phi$ and in float64: the mean over the
        samples, extrapolated to step size zero if there are several levels. With `ts` there
        is a leading axis of times. NaN without samples."""
        return self._tree(self.vectors.mean)

    @property
    def std_error(self) -> _Host:
        r"""The standard error of `mean`, from the standard deviation $s$ of the $n$ samples
        and an allowance for values too rare to be among them. It is

        $$ \sqrt{\frac{s^2}{n} \Bigl(1 + \frac{4 r^2}{(1 - r^2)^4}\Bigr)}, \qquad
        r = \frac{(M - s \sqrt{4.5 \log n})_+}{s \sqrt n}, $$

        where $M$ is the largest deviation from the mean. $M$ exceeds
        $s \sqrt{4.5 \log n}$ only for heavy tails, and $r$ is near 1 if a single sample
        accounts for all of the variance. (For sorted paths, $r$ is also computed for the
        paths within a replicate, and the larger value is used.) The standard error is never
        less than the rounding of the mean."""
        return self._tree(self.vectors.std_error)

    @property
    def variance(self) -> _Host:
        """The variance of a sample."""
        return self._tree(self.vectors.variance)

    @property
    def bias(self) -> _Host | None:
        r"""The discretization error of the finest level, $\mathbb E[\phi_h] - \mathbb
        E[\phi]$, as estimated by extrapolation; `None` with a single level. It has already
        been removed from `mean`: `mean + bias` is the mean of the finest level."""
        return self._tree(self.vectors.bias)

    @property
    def bias_std_error(self) -> _Host | None:
        """The standard error of `bias`."""
        return self._tree(self.vectors.bias_std_error)

    @property
    def error(self) -> _Host:
        """The error of `mean`, which is printed after it: the root of the sum of squares of
        `std_error`, `failed_error` and `discretization_error`. (With one level the
        discretization error is unknown, and not included.)"""
        return self._tree(self.vectors.error)

    @property
    def discretization_error(self) -> _Host | None:
        r"""What remains of the discretization error in `mean`: the change by the last
        extrapolation; `None` with one level.

        With two levels the change is the bias that the extrapolation removed from the finer
        level. The change is more than what remains wherever the error decreases by the
        order of the solver. With steps that are too long it may be less, and two levels
        cannot tell.

        With three levels, the changes of the mean by the two halvings of the step are
        compared: for a method of order $p$ the second change should be $2^{-p}$ of the
        first. It does not fit the order if it is less than a quarter of this prediction, or
        more than four thirds, by more than two standard errors. Then the larger of the two
        changes is taken instead, and the printed estimate says so.

        With $L > 3$ levels the same holds for the extrapolations from $L - 2$ neighbouring
        levels, of order $p + L - 3$, in place of the means on single levels. (For order 1/2
        the powers of the step size rise by 1/2: here it is of order $(L - 2) / 2$.)

        With three levels or more, the order $p + L - 2$ of the last extrapolation is not
        checked. So its change is taken for at least as large as if the extrapolation were
        of order $p$, less two standard errors."""
        return self._tree(self.vectors.discretization_error)

    @property
    def failed_error(self) -> _Host:
        """What failed paths could change in `mean`: their fraction of all paths, times the
        largest deviation of another path's value from the mean. (For sorted paths, this
        deviation is averaged over the replicates.) `failed_error` does not decrease with
        more paths, and is NaN if all paths failed."""
        return self._tree(self.vectors.failed_error)

    @property
    def off_order(self) -> PyTree[np.ndarray] | None:
        """Whether the changes of the mean by halved steps do not fit the order of the
        solver, as `discretization_error` explains; `None` with fewer than three levels."""
        return self._tree(self.vectors.off_order)

    def interval(self, confidence: float = 0.95) -> tuple[_Host, _Host]:
        """The ends of a confidence interval: `mean` plus and minus `error` times the
        quantile of Student's $t$ with `num_samples - 1` degrees of freedom. (For 95% the
        quantile is 2.13 with 16 samples, and 1.96 with very many.) If the standard error is
        a small part of `error`, the interval holds the expectation more often than
        `confidence` says.

        **Raises:** a `ValueError` unless `confidence` is a number between 0 and 1.
        """
        is_number = is_real_number(confidence) and np.ndim(confidence) == 0
        if not (is_number and 0 < confidence < 1):
            raise ValueError(
                "`confidence` must be a number between 0 and 1, such as 0.95; got "
                f"{confidence!r}."
            )
        # SciPy is imported here, since it would double the time to import this package.
        from scipy.special import stdtrit

        factor = stdtrit(max(self.num_samples - 1, 1), (1 + confidence) / 2)
        mean = self.vectors.mean
        reach = factor * self.vectors.error
        return self._tree(mean - reach), self._tree(mean + reach)

    def merge(self, *others: "Expectation") -> "Expectation":
        """Combines this estimate with others from the same `key` and arguments, but with
        different samples (see `first` of `expectation`).

        If the parts start at multiples of the batch size, the result is bitwise equal to a
        single estimate from all samples, for any order of merging.

        **Raises:** a `ValueError` for parts with other arguments or another key, by another
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
            check_same(self, other, "An estimate to merge")
        parts = [part for estimate in (self, *others) for part in estimate.moments]
        # In the order of samples, two parts with samples in common are neighbours.
        parts.sort(key=lambda part: part.begin)
        for before, after in zip(parts, parts[1:]):
            if after.begin < before.end:
                last_in_both = min(before.end, after.end) - 1
                raise ValueError(
                    f"Samples {after.begin:,} to {last_in_both:,} are in two "
                    "of the estimates to merge. Pass a different `first` for each part."
                )
        return dataclasses.replace(
            self, moments=combined_in_halves(parts), tol_reached=None, caveat=""
        )

    def save(self, file: str | Path | BinaryIO) -> None:
        """Writes the estimate to a NumPy `.npz` file, which `Expectation.load` reads. An
        older file at the same path is replaced only by a complete new one: if anything
        fails, the older file is kept. $\\phi$ must be made of dictionaries, lists, tuples
        and arrays. Functions in `sampling`, such as `sort_by`, are not saved."""
        _check_file(file, "write")
        write(file, *contents_of(self))

    @staticmethod
    def load(file: str | Path | BinaryIO) -> "Expectation":
        """Reads an estimate written by `save`. No code from the file is executed.

        **Raises:** a `ValueError` for a file that is damaged or not from `save`, and for a
        sampling that this version does not have. Warns of a file without the digests by
        which `merge` and `start=` tell the arguments of estimates.
        """
        _check_file(file, "read")
        if isinstance(file, str | Path):
            with open(file, "rb") as opened:
                return Expectation.load(opened)
        try:
            return Expectation(**fields_from(*read(file)))
        except OtherVersion:
            raise
        except Exception:
            # Damage may show as any kind of error.
            raise ValueError(
                f"{getattr(file, 'name', 'The file')} is damaged, or was not written by "
                "`Expectation.save`."
            ) from None

    def __str__(self) -> str:
        lines = self._lines_of_means()
        if self.levels == 1:
            lines.append("not included: the discretization error (see `levels`)")
        if self.vectors.is_off_order:
            lines.append(
                "the changes from step to step do not fit the order: the largest of them "
                "is taken for the error (take smaller steps)"
            )
        plural = "" if self.levels == 1 else "s"
        sampling = self.sampling
        # With `tol` the number of paths in the sampling is an upper limit, which does not
        # say how many were taken.
        if self.tol_reached is not None:
            sampling = f"{type(self.sampling).__name__} until `tol`"
        lines.append(
            f"{self.num_paths:,} paths on {self.levels} level{plural}, "
            f"{self.num_failed:,} failed, {sampling}"
        )
        # Either may be empty.
        lines += filter(None, [self.reason, self.caveat])
        if self.tol_reached is False:
            lines.append("`tol` was not reached")
        return "\n".join(lines)

    __repr__ = __str__

    def _lines_of_means(self) -> list[str]:
        """A line for each number of the mean, such as `t=2, ['energy'][0]: 0.364083 ±
        8.6e-05 (sampling 5.1e-05, discretization 6.9e-05)`: the label of the number (see
        `Layout.labels`) unless it is empty, the number, its error, and in brackets the
        parts of the error if there are several."""
        vectors = self.vectors
        errors_by_source = {"sampling": vectors.std_error}
        if vectors.discretization_error is not None:
            errors_by_source["discretization"] = vectors.discretization_error
        if self.num_failed > 0:
            errors_by_source["failed paths"] = vectors.failed_error
        errors = vectors.error
        lines = []
        for k, label in enumerate(self.layout.labels(self.ts)):
            line = f"{_rounded(vectors.mean[k], errors[k])} ± {errors[k]:.1e}"
            if len(errors_by_source) > 1:
                sources = [f"{name} {x[k]:.1e}" for name, x in errors_by_source.items()]
                line += f" ({', '.join(sources)})"
            lines.append(f"{label}: {line}" if label else line)
        return lines

    @property
    def vectors(self) -> "Vectors":
        """The results that users see as properties, as vectors of all numbers of `phi`."""
        results = _results_of(self)
        best = results.of_combination(Combination.BEST)
        failed_error = self._failed_fraction * best.max_deviation
        vectors = Vectors(best.mean, best.std_error, best.variance, failed_error)
        if self.levels == 1:
            return vectors
        error, off_order = discretization_error(results, self.levels)
        return vectors._replace(
            bias=results.mean[Combination.BIAS],
            bias_std_error=results.std_error[Combination.BIAS],
            discretization_error=error,
            off_order=off_order,
        )

    @property
    def _failed_fraction(self) -> float:
        """The fraction of all samples that failed; NaN without good samples."""
        if self.num_samples == 0:
            return np.nan
        num_drawn = sum(part.end - part.begin for part in self.moments)
        # Samples that are not good have failed as a whole. In a good sample of many paths
        # some may have failed: each counts as a fraction of a sample.
        num_not_good = num_drawn - self.num_samples
        return max(num_not_good, self.num_failed / self.paths_per_sample) / num_drawn

    def _tree(self, x: np.ndarray | None) -> Any:
        """The numbers of a vector in the structure of `phi`; `None` for `None`."""
        if x is None:
            return None
        # The index `()` turns an array without axes into a number.
        return jtu.tree_map(lambda leaf: leaf[()], self.layout.unravel(x))


class Vectors(NamedTuple):
    """The properties of an `Expectation` with the same names, each as a vector of all
    numbers of `phi`. The fields from `bias` to `discretization_error` are `None` with one
    level, and `off_order` is `None` with fewer than three."""

    mean: np.ndarray
    std_error: np.ndarray
    variance: np.ndarray
    failed_error: np.ndarray
    bias: np.ndarray | None = None
    bias_std_error: np.ndarray | None = None
    discretization_error: np.ndarray | None = None
    off_order: np.ndarray | None = None

    @property
    def error(self) -> np.ndarray:
        error = np.hypot(self.std_error, self.failed_error)
        if self.discretization_error is None:
            return error
        return np.hypot(error, self.discretization_error)

    @property
    def is_off_order(self) -> bool:
        """Whether the changes of any mean do not fit the order of the solver."""
        return self.off_order is not None and bool(np.any(self.off_order))


def _results_of(estimate: Expectation) -> Results:
    """The results of an estimate for all combinations of levels."""
    return results_of(total(estimate.moments), estimate.dtype, estimate.rounding_floor)


def _check_file(file: Any, method: str) -> None:
    """Raises a `ValueError` unless `file` is a path, or an open file with this method,
    `"read"` or `"write"`."""
    if not isinstance(file, str | Path) and not hasattr(file, method):
        raise ValueError(
            f"`file` must be a path, or a file that is open in binary mode; got {file!r}."
        )


def combined_results(estimate: Expectation, combination: Combination) -> Results:
    """The results of an estimate for one combination of levels."""
    return _results_of(estimate).of_combination(combination)


def check_same(one: Expectation, other: Expectation, name: str) -> None:
    """Raises a `ValueError` unless two estimates may be parts of one estimate: they must
    have the same arguments, key, shapes, levels, and number of paths in a sample. `name` is
    what messages call one of the two, such as "`start`"."""
    # Estimates from some files have no digests. Only arguments that both have are compared.
    digests = one.digests or {}
    other_digests = other.digests or {}
    different = [
        f"`{argument}`"
        for argument in digests
        if argument in other_digests and digests[argument] != other_digests[argument]
    ]
    if different:
        raise ValueError(
            f"{name} was computed with another {' and another '.join(different)}. Parts of "
            "an estimate have the same arguments. (A function is another one if it "
            "computes something else, and with another version of JAX.)"
        )
    if not np.array_equal(one.key_data, other.key_data):
        raise ValueError(
            f"{name} has another `key`. Pass the same `key` for all parts of an "
            "estimate."
        )
    if one.layout != other.layout or one.levels != other.levels:
        raise ValueError(
            f"{name} has another structure or other shapes. Pass one from the same "
            "function, times and levels."
        )
    if one.paths_per_sample != other.paths_per_sample:
        raise ValueError(
            f"{name} was sampled otherwise: a sample is a mean over "
            f"{one.paths_per_sample:,} paths in one of the estimates, and over "
            f"{other.paths_per_sample:,} in the other. Pass the same `sampling` for all "
            "parts of an estimate."
        )


def label_of(estimate: Expectation, place: int) -> str:
    """The label of the number of the mean with index `place`, for messages: in brackets
    after a blank, such as ` (t=2, [0])`. It is empty if the mean is a single number."""
    label = estimate.layout.labels(estimate.ts)[place]
    return f" ({label})" if label else ""


def _rounded(mean: float, error: float) -> str:
    """The mean, rounded to two digits of its error: `0.364083` for an error of 8.6e-05, and
    in scientific notation, `4.372e-44`, for an error of 1.2e-46."""
    if not (np.isfinite(mean) and 0 < error < np.inf):
        return f"{mean:.6g}"
    exponent = _exponent(max(abs(mean), error))
    # The power of ten of the last digit: of the second digit of the error, unless float64
    # has no such digit of the mean.
    last_exponent = max(_exponent(error) - 1, exponent - 15)
    # Adding zero makes a negative zero positive.
    rounded = round(mean, -last_exponent) + 0.0
    if -5 < exponent < 7:
        return f"{rounded:.{max(-last_exponent, 0)}f}"
    if rounded == 0:
        return "0"
    return f"{rounded:.{max(_exponent(abs(rounded)) - last_exponent, 0)}e}"


def _exponent(size: float) -> int:
    """The power of ten of the first digit of a positive number."""
    return math.floor(math.log10(size))


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
