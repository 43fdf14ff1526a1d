"""Hermite polynomials of several variables, and least-squares fits."""

import functools as ft
import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


_EXACT = jax.lax.Precision.HIGHEST
dot = ft.partial(jnp.matmul, precision=_EXACT)
tensordot = ft.partial(jnp.tensordot, precision=_EXACT)


def exponents(d: int, degree: int) -> list[tuple[int, ...]]:
    """The exponents of all monomials in `d` variables up to the total degree, lower degrees
    first."""
    choices = itertools.combinations_with_replacement
    chosen = [c for total in range(degree + 1) for c in choices(range(d), total)]
    return [tuple(c.count(j) for j in range(d)) for c in chosen]


def num_polynomials(d: int, degree: int) -> int:
    return math.comb(d + degree, degree)


def hermite(x: Float[Array, " d"], degree: int) -> list[Float[Array, ""]]:
    """Products of normalized Hermite polynomials, in the order of `exponents`. Each is a
    product of two known factors, so that a sum over them compiles to one loop without
    temporary arrays."""
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
    B: Float[Array, "n P"], values: Float[Array, "n C m"], sizes: Sequence[int]
) -> Float[Array, "P C m"]:
    """The coefficients of `C` fits, of which fit `k` uses the first `sizes[k]` polynomials
    and has zeros for the others.

    The normal equations are regularized, and the solution is refined. If the polynomials
    are linearly independent at the points, only rounding errors remain; if not, the
    solution stays small.
    """
    scale = jnp.sqrt(jnp.sum(B**2, axis=0))
    B = B / jnp.where(scale > 0, scale, 1)
    n = B.shape[1]
    ridge = 1e4 * jnp.finfo(B.dtype).eps * jnp.eye(n, dtype=B.dtype)
    L = jnp.linalg.cholesky(dot(B.T, B) + ridge)

    # A leading block of the factor is the factor of that block.
    used = np.arange(n) < np.array(sizes)[:, None]
    own = jnp.where(used[:, :, None] & used[:, None], L, jnp.eye(n, dtype=L.dtype))
    solve = jax.vmap(lambda L, r: jax.scipy.linalg.cho_solve((L, True), r))

    def refined(_, c):
        left = jnp.moveaxis(values, 1, 0) - dot(B, c)
        return c + solve(own, jnp.where(used[:, :, None], dot(B.T, left), 0))

    zero = jnp.zeros((len(sizes), n, values.shape[2]), values.dtype)
    c = jnp.moveaxis(jax.lax.fori_loop(0, 3, refined, zero), 0, 1)
    return c / jnp.where(scale > 0, scale, 1)[:, None, None]
