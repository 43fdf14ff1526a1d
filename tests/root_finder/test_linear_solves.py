"""Linear systems: elimination for a few unknowns, GMRES for many, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_symplectic._root_finder import differentiate
from diffrax_symplectic._root_finder.linear import solve


def _solved(apply, rhs, *options):
    """Solutions for a batch of right-hand sides, and which are found."""
    return jax.jit(jax.vmap(lambda b: solve(apply, b, None, *options)))(rhs)


# The first one is written out.
@pytest.mark.parametrize("n, dtype", [(4, jnp.float32), (7, jnp.float64)])
def test_elimination_exchanges_rows(n, dtype):
    rng = np.random.default_rng(n)
    matrices = rng.normal(size=(50, n, n)).astype(dtype)
    # A vanishing corner: no elimination without exchanging rows.
    matrices[:, 0, 0] = 0
    rhs = rng.normal(size=(50, n)).astype(dtype)
    got, _ = jax.jit(jax.vmap(lambda a, b: solve(lambda x: a @ x, b, None)))(
        matrices, rhs
    )
    assert got.dtype == dtype
    residual = np.einsum("bij,bj->bi", matrices, got) - rhs
    size = np.linalg.norm(matrices, axis=(1, 2)) * np.linalg.norm(got, axis=1)
    eps = np.finfo(dtype).eps
    assert np.all(np.linalg.norm(residual, axis=1) <= 8 * n * eps * size)


# By default, and to about rounding error.
@pytest.mark.parametrize(
    "dtype, reduction", [(np.float64, 1e-3), (np.float64, 2e-14), (np.float32, 1e-5)]
)
def test_gmres_reduces_the_residual_as_far_as_is_asked(dtype, reduction):
    rng = np.random.default_rng(0)
    A = (np.eye(60) + 0.1 * rng.normal(size=(60, 60))).astype(dtype)
    b = rng.normal(size=(5, 60)).astype(dtype)
    x, found = _solved(lambda x: A @ x, b, reduction)
    assert x.dtype == dtype and np.all(found)
    residuals = np.max(np.abs(x @ A.T - b), 1)
    assert np.all(residuals <= 2 * reduction * np.max(np.abs(b), 1))


@pytest.mark.parametrize("n", [2, 12, 40])
def test_systems_in_any_units_are_solved_and_those_without_numbers_are_not(n):
    # Squares of the first two are zero, or infinite, in single precision. If a solution of
    # the others were zero, a step without finite numbers would pass for solved.
    rhs = np.outer([1e-30, 1e30, 1, 1], np.arange(1, n + 1)).astype(np.float32)
    rhs[2:, 0] = np.nan, np.inf
    got, found = _solved(lambda x: 2 * x, rhs)
    assert np.all(found[:2])
    np.testing.assert_allclose(got[:2], rhs[:2] / 2, rtol=1e-2)
    assert not np.any(found[2:] & np.all(np.isfinite(got[2:]), axis=1))


@pytest.mark.parametrize("n", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_derivatives_are_solved_whether_iteration_converges_or_not(n):
    # Symmetric and antisymmetric matrices, of spectral radii on both sides of one and of
    # what is accelerated, side by side in one batch.
    random = np.random.default_rng(n).normal(size=(2, n, n))
    parts = [random[0] + random[0].T, random[1] - random[1].T]
    parts = [x / np.max(np.abs(np.linalg.eigvals(x))) for x in parts]
    L = np.array([r * x for r in (0.01, 0.7, 2.5, 6.5) for x in parts])
    b = np.random.default_rng(0).normal(size=(len(L), n))

    @jax.vmap
    def tangent(L, b):
        return differentiate(None, lambda x: [L @ x[0]], [b])[0]

    @jax.jit
    def value_and_adjoint(L, b):
        value, transpose = jax.vjp(lambda b: tangent(L, b), b)
        return value, *transpose(b)

    value, adjoint = value_and_adjoint(L, b)
    one = np.eye(n)
    for x, A in ((value, one - L), (adjoint, one - np.swapaxes(L, 1, 2))):
        residual = np.linalg.norm(np.einsum("bij,bj->bi", A, x) - b, axis=1)
        size = np.linalg.norm(A, axis=(1, 2)) * np.linalg.norm(x, axis=1)
        # At most 2 are measured, over sixty right-hand sides.
        assert np.all(residual <= 4 * np.finfo(float).eps * size)
