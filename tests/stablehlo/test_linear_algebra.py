"""Small dense linear algebra, replayed for many paths, gives what JAX gives for each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy import linalg

from ..drjit_here import needs_drjit
from ..families import slow_except
from .replayed import replayed
from .test_operations import LANES


pytestmark = needs_drjit


def definite(a):
    return a @ a.T + jnp.eye(len(a), dtype=a.dtype)


def solve_from_the_right(a, b):
    return jax.lax.linalg.triangular_solve(
        a, b[None], left_side=False, lower=True, transpose_a=True, unit_diagonal=True
    )


def derivative_of_solve(a, b):
    return jax.grad(lambda a: b @ jnp.linalg.solve(a, b))(a)


# Functions of a matrix and a vector.
CASES = {
    "solve": jnp.linalg.solve,
    "solve, differentiated": derivative_of_solve,
    "solve, a batch": jax.vmap(jnp.linalg.solve, (0, None)),
    "inv": lambda a, b: jnp.linalg.inv(a),
    "slogdet": lambda a, b: jnp.stack(jnp.linalg.slogdet(a)),
    "det": lambda a, b: jnp.linalg.det(a),
    "lu": lambda a, b: jnp.stack(linalg.lu(a)),
    "cholesky": lambda a, b: jnp.linalg.cholesky(definite(a)),
    "cholesky, upper": lambda a, b: jnp.linalg.cholesky(definite(a), upper=True),
    "cho_solve": lambda a, b: linalg.cho_solve(linalg.cho_factor(definite(a)), b),
    "solve_triangular": lambda a, b: linalg.solve_triangular(definite(a), b),
    "solve_triangular, transposed": lambda a, b: linalg.solve_triangular(
        definite(a), b, trans=1, lower=True
    ),
    "solve_triangular from the right": solve_from_the_right,
}


def problems(n: int, dtype, seed: int = 0, batch: tuple[int, ...] = ()):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(LANES, *batch, n, n)).astype(dtype)
    return a, rng.normal(size=(LANES, n)).astype(dtype)


@pytest.mark.parametrize(
    "dtype", slow_except([np.float64], [np.float32, np.float64]), ids=["f32", "f64"]
)
@pytest.mark.parametrize("name", CASES)
def test_it_gives_what_jax_gives_up_to_rounding(name, dtype):
    batch = (2,) if "batch" in name else ()
    a, b = problems(4, dtype, batch=batch)
    fn = CASES[name]
    (actual,) = replayed(fn, a, b)
    exact = np.asarray(jax.jit(jax.vmap(fn))(a, b))
    assert actual.dtype == dtype and actual.shape == exact.shape
    every = tuple(range(1, exact.ndim))
    error = np.max(np.abs(actual - exact), every)
    # Both have the condition number of what is solved as the factor of rounding errors.
    condition = np.linalg.cond(a.astype(float)).reshape(LANES, -1).max(1)
    factor = condition**2 if "cho" in name or "triangular" in name else condition
    size = np.max(np.abs(exact), every)
    assert np.max(error / (factor * size)) <= 8 * np.finfo(dtype).eps


def test_rows_are_exchanged_as_by_lapack_beyond_eight_unknowns():
    a, b = problems(9, float)
    a[:, 0, 0] = 0
    (actual,) = replayed(jnp.linalg.solve, a, b)
    residual = np.einsum("kij,kj->ki", a, actual) - b
    assert np.max(np.abs(residual) / np.linalg.norm(actual, axis=1)[:, None]) < 1e-14
    (order,) = replayed(lambda a, b: linalg.lu(a, permute_l=False)[0], a, b)
    exact = jax.jit(jax.vmap(lambda a: linalg.lu(a)[0]))(a)
    np.testing.assert_array_equal(order, exact)


def test_a_singular_matrix_spoils_its_own_path_only():
    a, b = problems(3, float)
    a[5] = np.ones((3, 3))
    a[6, 1] = 0
    a[7] = np.nan
    (actual,) = replayed(jnp.linalg.solve, a, b)
    bad = [5, 6, 7]
    assert not np.any(np.all(np.isfinite(actual[bad]), axis=1))
    assert np.all(np.isfinite(np.delete(actual, bad, axis=0)))


def test_a_matrix_that_is_not_positive_definite_gives_nan_as_in_jax():
    a, b = problems(3, float)
    cholesky = lambda a, b: jnp.linalg.cholesky(a)
    (actual,) = replayed(cholesky, a, b)
    exact = np.asarray(jax.jit(jax.vmap(cholesky))(a, b))
    failed = np.isnan(exact).any((1, 2))
    assert 0 < failed.sum() < LANES
    np.testing.assert_array_equal(np.isnan(actual), np.isnan(exact))


def test_seventeen_unknowns_and_other_calls_are_refused_by_name():
    from diffrax_symplectic._stablehlo.operation import NotReplayed

    a, b = problems(17, float)
    with pytest.raises(NotReplayed, match="`lapack_dgetrf_ffi` with more than 16"):
        replayed(jnp.linalg.solve, a, b)
    with pytest.raises(NotReplayed, match="a call of `lapack_dsyevd_ffi`"):
        replayed(lambda a, b: jnp.linalg.eigh(a)[0], a[:, :2, :2], b)
