"""Hermite polynomials of several variables, and least-squares fits."""

import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._products import dot


# The normal equations have the squared condition number of a fit. This many roundings are
# added to their diagonal, so that they have a Cholesky factor. Along an axis with the
# eigenvalue s, each refinement multiplies what this changes in the solution by r / (s + r),
# with r what was added.
_RIDGE = 1e4
_REFINEMENTS = 3


def exponents(d: int, degree: int) -> list[tuple[int, ...]]:
    """The exponents of all monomials in `d` variables up to the total degree, lower degrees
    first."""
    monomials = []
    for total in range(degree + 1):
        # The variables of each factor: `(0, 0, 2)` for `x**2 * z`.
        for factors in itertools.combinations_with_replacement(range(d), total):
            monomials.append(tuple(factors.count(j) for j in range(d)))
    return monomials


def num_polynomials(d: int, degree: int) -> int:
    """The number of monomials in `d` variables up to the total degree."""
    return math.comb(d + degree, degree)


def hermite(x: Float[Array, " d"], degree: int) -> list[Float[Array, ""]]:
    """Products of normalized Hermite polynomials, in the order of `exponents`. Each is a
    product of two known factors, so that a sum over them compiles to one loop without
    temporary arrays."""
    # Polynomials of one variable, by their recurrence.
    tables = []
    for variable in x:
        table = [jnp.ones_like(variable), variable]
        for k in range(1, degree):
            last = variable * table[-1] - math.sqrt(k) * table[-2]
            table.append(last / math.sqrt(k + 1))
        tables.append(table)
    # Products of several variables, by their exponents. Lower degrees come first, so the
    # product without its last variable is known.
    known = {(0,) * len(x): jnp.ones_like(x[0])}
    for powers in exponents(len(x), degree)[1:]:
        last_variable = max(j for j, power in enumerate(powers) if power > 0)
        others = (*powers[:last_variable], 0, *powers[last_variable + 1 :])
        factor = tables[last_variable][powers[last_variable]]
        known[powers] = known[others] * factor
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
    # Columns of length one, so that one ridge fits all.
    scale = jnp.sqrt(jnp.sum(B**2, axis=0))
    B = B / jnp.where(scale > 0, scale, 1)
    n = B.shape[1]
    ridge = _RIDGE * jnp.finfo(B.dtype).eps * jnp.eye(n, dtype=B.dtype)
    L = jnp.linalg.cholesky(dot(B.T, B) + ridge)

    # A leading block of the factor is the factor of that block. One factorization serves
    # all fits: the rest of each is the identity.
    is_used = np.arange(n) < np.array(sizes)[:, None]
    in_block = is_used[:, :, None] & is_used[:, None]
    factors = jnp.where(in_block, L, jnp.eye(n, dtype=L.dtype))

    def solution(
        L: Float[Array, "P P"], rhs: Float[Array, "P m"]
    ) -> Float[Array, "P m"]:
        return jax.scipy.linalg.cho_solve((L, True), rhs)

    def refined(_, c: Float[Array, "C P m"]) -> Float[Array, "C P m"]:
        residual = jnp.moveaxis(values, 1, 0) - dot(B, c)
        rhs = jnp.where(is_used[:, :, None], dot(B.T, residual), 0)
        return c + jax.vmap(solution)(factors, rhs)

    c = jnp.zeros((len(sizes), n, values.shape[2]), values.dtype)
    # From zero: the first time is the solution itself.
    c = jax.lax.fori_loop(0, _REFINEMENTS, refined, c)
    c = jnp.moveaxis(c, 0, 1)
    return c / jnp.where(scale > 0, scale, 1)[:, None, None]
