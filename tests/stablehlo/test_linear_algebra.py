"""Small dense linear algebra, replayed for many paths, gives what JAX gives for each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy import linalg

from diffrax_symplectic._stablehlo import NotReplayed

from ..drjit_here import needs_drjit
from ..families import slow_except
from .replayed import replayed, replayed_and_by_jax
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
    "solve, a batch": lambda a, b: jax.vmap(jnp.linalg.solve, (0, None))(
        jnp.stack([a, a.T]), b
    ),
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


def problems(n: int, dtype=float):
    rng = np.random.default_rng(0)
    a = rng.normal(size=(LANES, n, n)).astype(dtype)
    return a, rng.normal(size=(LANES, n)).astype(dtype)


@pytest.mark.parametrize(
    "dtype", slow_except([np.float64], [np.float32, np.float64]), ids=["f32", "f64"]
)
def test_functions_give_what_jax_gives_up_to_rounding(dtype):
    a, b = problems(4, dtype)
    # Both have the condition number of what is solved as the factor of rounding errors.
    condition = np.linalg.cond(a.astype(float))
    for name, x, y in replayed_and_by_jax(CASES, a, b):
        each = tuple(range(1, y.ndim))
        squared = "cho" in name or "triangular" in name
        bound = condition ** (2 if squared else 1) * np.max(np.abs(y), each)
        error = np.max(np.abs(x - y), each)
        assert np.all(error <= 8 * np.finfo(dtype).eps * bound), name


def test_rows_are_exchanged_as_by_lapack_beyond_eight_unknowns():
    a, b = problems(9)
    a[:, 0, 0] = 0
    (actual,) = replayed(jnp.linalg.solve, a, b)
    residual = np.einsum("kij,kj->ki", a, actual) - b
    assert np.max(np.abs(residual) / np.linalg.norm(actual, axis=1)[:, None]) < 1e-14
    (order,) = replayed(lambda a, b: linalg.lu(a, permute_l=False)[0], a, b)
    exact = jax.jit(jax.vmap(lambda a: linalg.lu(a)[0]))(a)
    np.testing.assert_array_equal(order, exact)


def test_a_matrix_that_is_singular_or_not_definite_spoils_its_own_path_only():
    a, b = problems(3)
    a[5] = np.ones((3, 3))
    a[6, 1] = 0
    a[7] = np.nan
    cholesky = lambda a: jnp.linalg.cholesky(a)
    solution, root = replayed(lambda a, b: (jnp.linalg.solve(a, b), cholesky(a)), a, b)
    bad = [5, 6, 7]
    assert not np.any(np.all(np.isfinite(solution[bad]), axis=1))
    assert np.all(np.isfinite(np.delete(solution, bad, axis=0)))
    # As in JAX, where another matrix is no square of a root.
    failed = np.isnan(jax.jit(jax.vmap(cholesky))(a))
    assert 0 < failed.any((1, 2)).sum() < LANES
    np.testing.assert_array_equal(np.isnan(root), failed)


def test_seventeen_unknowns_and_other_calls_are_refused_by_name():
    a, b = problems(17)
    with pytest.raises(NotReplayed, match="`lapack_dgetrf_ffi` with more than 16"):
        replayed(jnp.linalg.solve, a, b)
    with pytest.raises(NotReplayed, match="a call of `lapack_dsyevd_ffi`"):
        replayed(lambda a, b: jnp.linalg.eigh(a)[0], a[:, :2, :2], b)
