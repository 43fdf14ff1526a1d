"""Hermite polynomials of several variables, and least-squares fits."""

import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._products import dot


# The condition number of the normal equations is the square of that of a fit, and rounding
# might leave them without a Cholesky factor. So a ridge of this many times the rounding
# error of one is added to their diagonal.
_ROUNDINGS_IN_RIDGE = 1e4
# How often the solution is refined. Along an axis with the eigenvalue s, each refinement
# multiplies the error that a ridge of size r causes by r / (s + r).
_REFINEMENTS = 3


def exponents(d: int, degree: int) -> list[tuple[int, ...]]:
    """The exponents of all monomials in `d` variables up to the total degree, lower degrees
    first: `(0, 0), (1, 0), (0, 1)` for two variables and degree 1."""
    monomials = []
    for total in range(degree + 1):
        # The factors of a monomial, by their variables: `(0, 0, 2)` for `x**2 * z`.
        for factors in itertools.combinations_with_replacement(range(d), total):
            monomials.append(tuple(factors.count(j) for j in range(d)))
    return monomials


def num_polynomials(d: int, degree: int) -> int:
    """The number of monomials in `d` variables up to the total degree."""
    return math.comb(d + degree, degree)


def hermite(x: Float[Array, " d"], degree: int) -> list[Float[Array, ""]]:
    """The values at `x` of products of normalized Hermite polynomials, in the order of
    `exponents`. Each is computed as the product of an earlier one and a polynomial in one
    variable. A sum over all of them then compiles to one loop without temporary arrays."""
    factors = [_hermite_of_one_variable(variable, degree) for variable in x]
    # Products by their exponents. Lower degrees come first, so the product without its last
    # variable is known.
    products = {(0,) * len(x): jnp.ones_like(x[0])}
    for powers in exponents(len(x), degree)[1:]:
        last_variable = max(j for j, power in enumerate(powers) if power > 0)
        others = (*powers[:last_variable], 0, *powers[last_variable + 1 :])
        factor = factors[last_variable][powers[last_variable]]
        products[powers] = products[others] * factor
    return [*products.values()]


def _hermite_of_one_variable(
    x: Float[Array, ""], degree: int
) -> list[Float[Array, ""]]:
    """The normalized Hermite polynomials of degrees 0, 1, ... up to `degree` (or to 1 if it
    is 0), by their recurrence `sqrt(k + 1) h[k + 1] = x h[k] - sqrt(k) h[k - 1]`."""
    polynomials = [jnp.ones_like(x), x]
    for k in range(1, degree):
        unscaled = x * polynomials[-1] - math.sqrt(k) * polynomials[-2]
        polynomials.append(unscaled / math.sqrt(k + 1))
    return polynomials


def least_squares(
    B: Float[Array, "n P"], values: Float[Array, "n m"], sizes: Sequence[int]
) -> Float[Array, "P fits m"]:
    """The coefficients of several least-squares fits to `values` at `n` points, where `B`
    has the values of `P` polynomials. Fit `k` uses the first `sizes[k]` polynomials, and
    has zeros for the coefficients of the others.

    The normal equations are regularized, and the solution is refined. If the polynomials
    are linearly independent at the points, only rounding errors remain. If not, the
    solution stays small.
    """
    # Columns are scaled to length one, so that one ridge suits all.
    lengths = jnp.sqrt(jnp.sum(B**2, axis=0))
    lengths = jnp.where(lengths > 0, lengths, 1)
    scaled_B = B / lengths
    _, num_columns = B.shape
    ridge = _ROUNDINGS_IN_RIDGE * jnp.finfo(B.dtype).eps
    ridge_matrix = ridge * jnp.eye(num_columns, dtype=B.dtype)
    L = jnp.linalg.cholesky(dot(scaled_B.T, scaled_B) + ridge_matrix)

    # A fit with fewer polynomials has a leading block of the normal equations. The Cholesky
    # factor of the block is the leading block of `L`, so one factorization serves all fits.
    # The rest of each factor is filled with the identity, so that all have the same shape.
    # (fits, P)
    is_used = np.arange(num_columns) < np.array(sizes)[:, None]
    # (fits, P, P)
    is_in_block = is_used[:, :, None] & is_used[:, None]
    factors = jnp.where(is_in_block, L, jnp.eye(num_columns, dtype=L.dtype))

    def solution(factor, rhs):
        return jax.scipy.linalg.cho_solve((factor, True), rhs)

    def refine(_, c: Float[Array, "fits P m"]) -> Float[Array, "fits P m"]:
        """Adds the solution for what the coefficients leave of the values."""
        # (fits, n, m)
        residual = values - dot(scaled_B, c)
        rhs = jnp.where(is_used[:, :, None], dot(scaled_B.T, residual), 0)
        return c + jax.vmap(solution)(factors, rhs)

    no_fit = jnp.zeros((len(sizes), num_columns, values.shape[1]), values.dtype)
    # The first refinement, which starts from zero, gives the solution itself.
    c = jax.lax.fori_loop(0, _REFINEMENTS, refine, no_fit)
    # (P, fits, m)
    c = jnp.moveaxis(c, 0, 1)
    # From coefficients of the scaled columns to coefficients of the columns of `B`.
    return c / lengths[:, None, None]
