"""Estimates of expectations, and how they are combined."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float, PyTree
from scipy.special import stdtrit


# NumPy returns scalars, which are not arrays, from operations on arrays without axes.
_Host = PyTree[np.ndarray | np.floating]


class Expectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as [`diffrax_symplectic.expectation`][] and
    [`diffrax_symplectic.monte_carlo`][] return. To print it gives a few lines.

    - `num_paths`: how many paths the estimate is made of, on each level.
    - `num_failed`: how many paths failed, on all levels. They have no part in the rest.
    - `num_samples`: how many independent samples the mean is taken over: paths, or
        replicates of [`diffrax_symplectic.ArrayRQMC`][].
    - `sampling`: how the samples were made.
    - `reason`: with `sampling=None`, why this one was chosen; otherwise empty.
    - `tol_reached`: whether all standard errors are at most `tol`; `None` without `tol`.
    - `combinations`, `sums_of_squares`: means over the samples, and sums of squared
        deviations from them, along an axis in front: of the estimate, and with two levels
        or more of its `bias` and of what the last extrapolation changed.
    - `key_data`: the random key that the samples came from.
    """

    num_paths: int
    num_failed: int
    num_samples: int
    combinations: _Host
    sums_of_squares: _Host
    key_data: np.ndarray
    sampling: Any = None
    reason: str = ""
    tol_reached: bool | None = None

    @property
    def mean(self) -> _Host:
        r"""The best estimate, in the structure of $\phi$ and in float64: the mean over the
        samples, extrapolated to steps of size zero if there are two levels or more. With
        `ts` there is an axis in front, one place for each of them. NaN without samples."""
        return self._of(0, self.combinations)

    @property
    def variance(self) -> _Host:
        """The variance of a sample."""
        return self._of(0, self._variances)

    @property
    def std_error(self) -> _Host:
        """The standard error of `mean`, from the spread of the samples."""
        return self._of(0, self._std_errors)

    @property
    def bias(self) -> _Host | None:
        r"""With two levels or more the error of discretization of the finest one,
        $\mathbb E[\phi_h] - \mathbb E[\phi]$, as extrapolation knows it; otherwise `None`.
        `mean + bias` is the mean of that level. It is no part of `mean`."""
        return self._of(1, self.combinations)

    @property
    def bias_std_error(self) -> _Host | None:
        """The standard error of `bias`."""
        return self._of(1, self._std_errors)

    @property
    def error(self) -> _Host:
        """The error of `mean` all together: the root of the sum of the squares of
        `std_error` and, with two levels or more, of what the last extrapolation has
        changed. What discretization leaves after that is of a higher order in the step
        size, and smaller as a rule. With one level nothing is known of it, and this is
        `std_error`."""
        change = self._of(2, self.combinations)
        if change is None:
            return self.std_error
        return jtu.tree_map(np.hypot, self.std_error, change)

    def interval(self, confidence: float = 0.95) -> tuple[_Host, _Host]:
        r"""The ends of an interval that covers the mean of infinitely many samples with
        this probability: Student's $t$ with one degree of freedom less than there are
        samples, times `std_error`, to either side of `mean`. (For 16 samples and 95% that
        is 2.13 standard errors, for very many 1.96.) What is left of the error of
        discretization is not part of it: see `error`."""
        factor = stdtrit(max(self.num_samples - 1, 1), (1 + confidence) / 2)
        side = lambda sign: jtu.tree_map(
            lambda m, s: m + sign * factor * s, self.mean, self.std_error
        )
        return side(-1), side(1)

    def __str__(self) -> str:
        shown = lambda x: np.array2string(np.asarray(x), precision=12, threshold=6)
        short: Any = {"float_kind": "{:.1e}".format}
        brief = lambda x: np.array2string(np.asarray(x), formatter=short, threshold=6)
        mean, error = jtu.tree_leaves(self.mean), jtu.tree_leaves(self.std_error)
        lines = [f"{shown(m)} ± {brief(e)}" for m, e in zip(mean[:6], error)]
        lines += ["..."] * (len(mean) > 6)
        if self.bias is not None:
            biases = ", ".join(map(brief, jtu.tree_leaves(self.bias)[:6]))
            lines.append(f"bias of the finest step, not in the mean: {biases}")
        how = "" if self.sampling is None else f", {self.sampling}"
        lines.append(f"{self.num_paths:,} paths, {self.num_failed:,} failed{how}")
        if self.reason:
            lines.append(self.reason)
        if self.tol_reached is False:
            lines.append("`tol` was not reached")
        return "\n".join(lines)

    __repr__ = __str__

    @property
    def _variances(self) -> _Host:
        n = self.num_samples - 1
        share = lambda m2: m2 / n if n > 0 else np.full_like(m2, np.nan)
        return jtu.tree_map(share, self.sums_of_squares)

    @property
    def _std_errors(self) -> _Host:
        n = max(self.num_samples, 1)
        return jtu.tree_map(lambda v: np.sqrt(v / n), self._variances)

    def _of(self, combination: int, tree: _Host) -> Any:
        leaves = jtu.tree_leaves(tree)
        if leaves and len(leaves[0]) <= combination:
            return None
        return jtu.tree_map(lambda x: x[combination], tree)


class ExpectationInterrupted(KeyboardInterrupt):
    """Raised by [`diffrax_symplectic.expectation`][] and
    [`diffrax_symplectic.monte_carlo`][] in place of a `KeyboardInterrupt`. Its attribute
    `estimate` holds what was done until then, to go on from with `start=`."""

    def __init__(self, estimate: Expectation):
        super().__init__(
            f"Interrupted after {estimate.num_paths + estimate.num_failed} paths. Catch "
            "`ExpectationInterrupted` and pass its `estimate` as `start` to go on."
        )
        self.estimate = estimate


def level_weights(order: int, levels: int) -> Float[np.ndarray, "combinations levels"]:
    r"""The combinations of the means with steps $h, h/2, h/4, \ldots$ that an
    [`diffrax_symplectic.Expectation`][] holds, for a method of weak order $p$. The first
    has no terms in $h^p, \ldots, h^{p + L - 2}$ for $L$ levels, and with $L > 1$ there are
    two more: the mean of the finest level less the first, and what the last extrapolation
    changed.

    [Talay and Tubaro (1990)](https://doi.org/10.1080/07362999008809220) show that the error
    has an expansion in powers of $h$.
    """
    best = _extrapolated(order, levels)
    if levels == 1:
        return best[None]
    # The finer levels alone, with one power of the step size less.
    before = np.append(0.0, _extrapolated(order, levels - 1))
    return np.stack([best, np.eye(levels)[-1] - best, best - before])


def _extrapolated(order: int, levels: int) -> Float[np.ndarray, " levels"]:
    powers = np.array([0, *range(order, order + levels - 1)])
    system = 2.0 ** -np.outer(powers, np.arange(levels))
    return np.linalg.solve(system, np.eye(levels)[0])


def reached(estimate: Expectation, tol: float | None, least: int) -> bool:
    """Whether all standard errors are at most `tol`. Fewer than `least` samples say too
    little about their spread."""
    if tol is None or estimate.num_samples < least:
        return False
    return all(bool(np.all(x <= tol)) for x in jtu.tree_leaves(estimate.std_error))


def finished(estimate: Expectation, tol: float | None, least: int) -> Expectation:
    """The estimate with `tol_reached`, and with NaN for the mean without samples."""
    said = None if tol is None else reached(estimate, tol, least)
    estimate = dataclasses.replace(estimate, tol_reached=said)
    if estimate.num_samples > 0:
        return estimate
    nothing = jtu.tree_map(lambda x: np.full_like(x, np.nan), estimate.combinations)
    return dataclasses.replace(estimate, combinations=nothing)


def warn_of_tol(estimate: Expectation, tol: float | None) -> None:
    if estimate.tol_reached is False:
        largest = max(
            float(np.max(x, initial=0.0)) for x in jtu.tree_leaves(estimate.std_error)
        )
        warnings.warn(
            f"`tol={tol}` was not reached: the largest standard error is {largest:.1e} "
            f"after {estimate.num_paths:,} paths. Take more paths, going on with `start=`, "
            "or another `sampling`.",
            stacklevel=3,
        )


def initial(
    values: PyTree[jax.ShapeDtypeStruct],
    key_data: np.ndarray,
    start: Expectation | None,
    count: Callable[[Expectation], int],
    most: int,
) -> Expectation:
    """The estimate without any sample, or the one to go on from, of which `count` says how
    many samples it has used up, at most `most`."""
    for leaf in jtu.tree_leaves(values):
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            raise ValueError(
                "What is averaged must be real arrays; got one of dtype "
                f"{leaf.dtype}. Return real and imaginary parts."
            )
    zeros = jtu.tree_map(lambda s: np.zeros(s.shape), values)
    if start is None:
        return Expectation(0, 0, 0, zeros, zeros, key_data)
    if not np.array_equal(start.key_data, key_data):
        raise ValueError(
            "`start` is an estimate with another `key`. Pass the one that it came from, "
            "so that no path is taken twice."
        )
    if jtu.tree_structure(start.combinations) != jtu.tree_structure(zeros) or any(
        np.shape(a) != b.shape
        for a, b in zip(jtu.tree_leaves(start.combinations), jtu.tree_leaves(zeros))
    ):
        raise ValueError(
            "`start` is an estimate of something of another structure or other shapes. "
            "Pass one that came from the same function, times and levels."
        )
    if count(start) > most:
        raise ValueError(
            "The number of paths (or of replicates) counts all, those of `start` included, "
            f"of which there are {count(start)} already; got {most}."
        )
    if start.num_samples > 0:
        return start
    return dataclasses.replace(start, combinations=zeros)


def merge(estimate: Expectation, batch, paths: int) -> Expectation:
    """The estimate from its own samples, of so many paths each, and those of the batch, by
    the pairwise formula of Chan, Golub and LeVeque."""
    count, failed, mean, squares, _ = batch
    a, b = estimate.num_samples, int(count)
    n = max(a + b, 1)
    delta = jtu.tree_map(lambda x, y: y.astype(float) - x, estimate.combinations, mean)
    lost = int(failed)
    return dataclasses.replace(
        estimate,
        combinations=jtu.tree_map(
            lambda x, d: x + d * (b / n), estimate.combinations, delta
        ),
        sums_of_squares=jtu.tree_map(
            lambda x, y, d: x + y.astype(float) + d**2 * (a * b / n),
            estimate.sums_of_squares,
            squares,
            delta,
        ),
        num_samples=a + b,
        num_paths=estimate.num_paths + b * paths,
        num_failed=estimate.num_failed + lost,
    )
