"""Polynomials of the state, fitted by least squares."""

import functools as ft
import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


# Deviations along the axes of the covariance are taken for no smaller than this share of
# the largest. Along shorter ones the points of a fit say too little.
_FLOOR = 0.1


class Frame(eqx.Module):
    """Coordinates in which points have mean zero and deviations of about one: the axes of
    their covariance."""

    mean: Float[Array, " d"]
    to: Float[Array, "d d"]
    back: Float[Array, "d d"]

    @staticmethod
    def of(
        points: Float[Array, "n d"], good: Bool[Array, " n"], unit: Float[Array, " d"]
    ) -> "Frame":
        """Of the points that are good; in units of `unit` coordinates are comparable."""
        share = good.astype(points.dtype) / jnp.maximum(jnp.sum(good), 1)
        unit = jnp.where(unit > 0, unit, 1)
        mean = share @ points
        off = (points - mean) / unit
        variances, axes = jnp.linalg.eigh((off.T * share) @ off)
        tiny = jnp.finfo(points.dtype).eps ** 2
        size = jnp.sqrt(jnp.maximum(variances, _FLOOR**2 * variances[-1]) + tiny)
        return Frame(mean, axes.T / size[:, None] / unit, unit[:, None] * axes * size)


@ft.lru_cache(maxsize=64)
def exponents(d: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Of all products of powers of `d` variables up to the total degree, lower degrees
    first."""
    rows = []
    for total in range(degree + 1):
        for chosen in itertools.combinations_with_replacement(range(d), total):
            rows.append(tuple(chosen.count(j) for j in range(d)))
    return tuple(rows)


def num_polynomials(d: int, degree: int) -> int:
    return math.comb(d + degree, degree)


def hermite(x: Float[Array, " d"], degree: int) -> list[Float[Array, ""]]:
    """Products of normalized Hermite polynomials, in the order of `exponents`. Each is one
    product of two that are known, so that a sum over them is one loop without memory."""
    tables = []
    for variable in x:
        table = [jnp.ones_like(variable), variable]
        for k in range(1, degree):
            last = variable * table[-1] - math.sqrt(k) * table[-2]
            table.append(last / math.sqrt(k + 1))
        tables.append(table)
    known = {(0,) * len(x): jnp.ones_like(x[0])}
    for powers in exponents(len(x), degree)[1:]:
        j = max(j for j, power in enumerate(powers) if power > 0)
        rest = (*powers[:j], 0, *powers[j + 1 :])
        known[powers] = known[rest] * tables[j][powers[j]]
    return [*known.values()]


def least_squares(
    B: Float[Array, "n P"], values: Float[Array, "n C m"], sizes: tuple[int, ...]
) -> Float[Array, "P C m"]:
    """For each of `C` fits the coefficients of the first so many polynomials of `sizes`;
    the others are zero.

    The normal equations are regularized and the solution is refined. For polynomials that
    are independent at the points this leaves rounding errors alone. Where they depend on
    each other the solution stays small.
    """
    scale = jnp.sqrt(jnp.sum(B**2, axis=0))
    B = B / jnp.where(scale > 0, scale, 1)
    n = B.shape[1]
    ridge = 1e4 * jnp.finfo(B.dtype).eps * jnp.eye(n, dtype=B.dtype)
    L = jnp.linalg.cholesky(_dot(B.T, B) + ridge)

    def fit(size, values):
        used = jnp.arange(n) < size
        # A leading block of the factor is the factor of that block.
        own = jnp.where(used[:, None] & used, L, jnp.eye(n, dtype=L.dtype))
        solve = lambda r: jax.scipy.linalg.cho_solve((own, True), r)
        c = jnp.zeros((n, values.shape[1]), values.dtype)
        for _ in range(3):
            c = c + solve(jnp.where(used[:, None], _dot(B.T, values - _dot(B, c)), 0))
        return c

    out = [fit(size, values[:, k]) for k, size in enumerate(sizes)]
    return jnp.stack(out, axis=1) / jnp.where(scale > 0, scale, 1)[:, None, None]


_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
