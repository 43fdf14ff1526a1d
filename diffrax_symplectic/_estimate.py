"""Estimates of expectations, and how they are combined."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree


# NumPy returns scalars, which are not arrays, from operations on arrays without axes.
_Host = PyTree[np.ndarray | np.floating]


class Expectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as [`diffrax_symplectic.expectation`][] returns.

    - `mean`: the mean over the paths that succeeded, in the structure of $\phi$, in
        float64; NaN if none did.
    - `sum_of_squares`: the sum of the squared deviations from `mean`.
    - `num_paths`: how many paths succeeded.
    - `num_failed`: how many paths failed. They have no part in the rest.
    - `key_data`: the random key that the paths came from.
    - `tol_reached`: whether all standard errors are at most `tol`; `None` without `tol`.
    - `difference`: with two levels, the estimate of $\mathbb E[\phi_{h/2} - \phi_h]$ from
        coupled paths.
    - `order`: with two levels, the weak order of the solver that was passed.
    """

    mean: _Host
    sum_of_squares: _Host
    num_paths: int
    num_failed: int
    key_data: np.ndarray
    tol_reached: bool | None = None
    difference: "Expectation | None" = None
    order: int | None = None

    @property
    def variance(self) -> _Host:
        r"""The variance of $\phi$ over the paths."""
        n = self.num_paths - 1
        share = lambda m2: m2 / n if n > 0 else np.full_like(m2, np.nan)
        return jtu.tree_map(share, self.sum_of_squares)

    @property
    def std_error(self) -> _Host:
        """The standard error of `mean`."""
        n = max(self.num_paths, 1)
        return jtu.tree_map(lambda v: np.sqrt(v / n), self.variance)

    @property
    def bias(self) -> _Host | None:
        r"""With two levels, the error of discretization $\mathbb E[\phi_h] - \mathbb
        E[\phi]$ of `mean`, as far as it is of the order $h^p$: $2^p / (2^p - 1)$ times the
        difference of the levels. `mean - bias` is the extrapolated estimate."""
        if self.difference is None:
            return None
        return jtu.tree_map(lambda d: -self._factor * d, self.difference.mean)

    @property
    def bias_std_error(self) -> _Host | None:
        """The standard error of `bias`, which is independent of that of `mean`."""
        if self.difference is None:
            return None
        error = self.difference.std_error
        return jtu.tree_map(lambda e: self._factor * e, error)

    @property
    def _factor(self) -> float:
        assert self.order is not None
        return 1 / (1 - 2.0**-self.order)


class ExpectationInterrupted(KeyboardInterrupt):
    """Raised by [`diffrax_symplectic.expectation`][] in place of a `KeyboardInterrupt`.
    Its attribute `estimate` holds what was done until then, to go on from with
    `start=`."""

    def __init__(self, estimate: Expectation):
        super().__init__(
            f"Interrupted after {estimate.num_paths + estimate.num_failed} paths. Catch "
            "`ExpectationInterrupted` and pass its `estimate` as `start` to go on."
        )
        self.estimate = estimate


def reached(estimate: Expectation, tol: float | None) -> bool:
    """Whether all standard errors are at most `tol`. A single path has none."""
    if tol is None or estimate.num_paths < 2:
        return False
    return all(np.all(x <= tol) for x in jtu.tree_leaves(estimate.std_error))


def finished(estimate: Expectation, tol: float | None) -> Expectation:
    """The estimate with `tol_reached`, and with NaN for the mean if no path succeeded."""
    said = None if tol is None else reached(estimate, tol)
    estimate = dataclasses.replace(estimate, tol_reached=said)
    if estimate.num_paths > 0:
        return estimate
    nothing = jtu.tree_map(lambda x: np.full_like(x, np.nan), estimate.mean)
    return dataclasses.replace(estimate, mean=nothing)


def initial(
    mean: PyTree[jax.ShapeDtypeStruct],
    key_data: np.ndarray,
    start: Expectation | None,
    num_paths: int,
) -> Expectation:
    """The estimate without any path, or the one to go on from."""
    for leaf in jtu.tree_leaves(mean):
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            raise ValueError(
                "`fn` must return real arrays; got one of dtype "
                f"{leaf.dtype}. Return real and imaginary parts."
            )
    zeros = jtu.tree_map(lambda s: np.zeros(s.shape), mean)
    if start is None:
        return Expectation(zeros, zeros, 0, 0, key_data)
    if not np.array_equal(start.key_data, key_data):
        raise ValueError(
            "`start` is an estimate with another `key`. Pass the one that it came from, "
            "so that no path is taken twice."
        )
    if jtu.tree_structure(start.mean) != jtu.tree_structure(zeros) or any(
        np.shape(a) != b.shape
        for a, b in zip(jtu.tree_leaves(start.mean), jtu.tree_leaves(zeros))
    ):
        raise ValueError(
            "`start` is an estimate of something of another structure or other shapes. "
            "Pass one that came from the same `fn`."
        )
    if start.num_paths + start.num_failed > num_paths:
        raise ValueError(
            "`num_paths` counts all paths, those of `start` included, of which there are "
            f"{start.num_paths + start.num_failed} already; got {num_paths}."
        )
    return start if start.num_paths > 0 else dataclasses.replace(start, mean=zeros)


def merge(estimate: Expectation, batch) -> Expectation:
    """The estimate from its own paths and those of the batch."""
    count, failed, mean, squares = jax.device_get(batch)
    a, b = estimate.num_paths, int(count)
    n = max(a + b, 1)
    delta = jtu.tree_map(lambda x, y: y.astype(float) - x, estimate.mean, mean)
    return dataclasses.replace(
        estimate,
        mean=jtu.tree_map(lambda x, d: x + d * (b / n), estimate.mean, delta),
        sum_of_squares=jtu.tree_map(
            lambda x, y, d: x + y.astype(float) + d**2 * (a * b / n),
            estimate.sum_of_squares,
            squares,
            delta,
        ),
        num_paths=a + b,
        num_failed=estimate.num_failed + int(failed),
    )
