"""Linear systems: elimination for a few unknowns, GMRES for many."""

import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

from diffrax_symplectic._root_finder import _krylov, SmallLU


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_small_lu_solves_with_pivoting(n, dtype):
    matrices = jr.normal(jr.key(n), (50, n, n), dtype)
    # A vanishing corner: no elimination without exchanging rows.
    matrices = matrices.at[:, 0, 0].set(0 if n > 1 else 1)
    rhs = jr.normal(jr.key(0), (50, n), dtype)

    def solve(a, b):
        return lx.linear_solve(lx.MatrixLinearOperator(a), b, SmallLU()).value

    got = jax.jit(jax.vmap(solve))(matrices, rhs)
    assert got.dtype == dtype
    residual = jnp.einsum("bij,bj->bi", matrices, got) - rhs
    size = jnp.linalg.norm(matrices, axis=(1, 2)) * jnp.linalg.norm(got, axis=1)
    assert jnp.all(
        jnp.linalg.norm(residual, axis=1) <= 8 * n * jnp.finfo(dtype).eps * size
    )
    # Derivatives go through the transposed system.
    a, b = matrices[0].astype(float), rhs[0].astype(float)
    gradient = jax.grad(lambda b: jnp.sum(solve(a, b) ** 2))(b)
    exact = np.linalg.solve(a.T, 2 * np.linalg.solve(a, b))
    np.testing.assert_allclose(gradient, exact, rtol=1e-9)


def test_small_lu_needs_a_square_matrix():
    with pytest.raises(ValueError, match="square"):
        SmallLU().init(lx.MatrixLinearOperator(jnp.ones((2, 3))), {})


def _random_matrix(rng):
    return np.eye(12) + 0.4 * rng.normal(size=(12, 12)), rng.normal(size=12)


def _shift_and_identity(rng):
    """After the first product it gains nothing in the first cycle of products."""
    A = np.eye(16)
    A[:12, :12] = np.roll(np.eye(12), 1, axis=0)
    return A, np.eye(16)[0] + A[15]


def _before_any_product(b):
    return _krylov.extend(_krylov.empty(b.size, b.dtype), b, fresh=True)


@pytest.mark.parametrize("system", [_random_matrix, _shift_and_identity])
def test_each_product_of_gmres_reduces_the_residual_as_far_as_possible(
    system, monkeypatch
):
    monkeypatch.setattr(_krylov, "_NO_RESTART", 0)
    A, b = system(np.random.default_rng(0))
    cycle = _krylov._IMAGES

    def product(state, _):
        state = _krylov.extend(state, jnp.asarray(A) @ state.p)
        return state, (state.x * state.unit, state.r * state.unit)

    begin = _before_any_product
    scan = jax.jit(lambda b: jax.lax.scan(product, begin(b), None, cycle + 4))
    last, outputs = scan(jnp.asarray(b))
    assert last.left == begin(jnp.asarray(b)).left - (cycle + 4)
    xs, rs = map(np.asarray, outputs)
    # Images are kept in single precision.
    np.testing.assert_allclose(rs, b - xs @ A.T, atol=1e-5)
    for j, r in enumerate(rs):
        # After so many products it begins anew.
        first, number = (rs[cycle - 1], j + 1 - cycle) if j >= cycle else (b, j + 1)
        powers = [np.linalg.matrix_power(A, k) @ first for k in range(1, number + 1)]
        images, _ = np.linalg.qr(np.stack(powers, 1))
        least = first - images @ (images.T @ first)
        np.testing.assert_allclose(r, least, atol=1e-5)


@pytest.mark.parametrize("n", [12, 30])
def test_gmres_of_few_unknowns_needs_no_restart(n):
    # The eigenvalues of a shift surround zero: only the last product reduces the residual.
    b = jnp.eye(n)[0]
    x = jax.jit(lambda b: _krylov.gmres(lambda x: jnp.roll(x, 1), b))(b)
    np.testing.assert_allclose(jnp.roll(x, 1), b, atol=1e-5)


def test_gmres_ends_where_it_gains_nothing_and_not_before():
    @jax.jit
    def solve(A, b):
        def product(carry):
            state, number = carry
            return _krylov.extend(state, A @ state.p), number + 1

        first = _before_any_product(b), 0
        last, number = jax.lax.while_loop(lambda c: ~c[0].done, product, first)
        return last.solution, number

    e = np.eye(8)
    # A shift gains nothing until each direction was tried, and then all there is.
    x, number = solve(np.roll(e, 1, axis=0), e[0])
    assert number == 8
    np.testing.assert_allclose(x, e[7], atol=1e-15)
    # What no product reaches stays, which one more cycle shows.
    x, number = solve(np.diag([0.0, *[2] * 7]), e[0] + e[1])
    assert number == 16
    np.testing.assert_allclose(x[1], 0.5, atol=1e-15)
    # The first product leaves nearly d / 2 of it, and a thousandth may be left.
    for d, most in ((0.0019, 1), (0.0021, 2)):
        assert solve(np.diag([1 + d, *[1] * 7]), e[0] + e[1])[1] == most
    # Nothing is to be done for zero, and nothing can be where there is no number.
    x, number = solve(e, 0 * e[0])
    assert number == 0 and np.all(x == 0)
    assert solve(e, np.nan * e[0])[1] == 0
    assert solve(np.nan * e, e[0])[1] == 1


def test_gmres_forgets_a_system_that_was_not_finite():
    A = jnp.eye(6) + jnp.triu(jnp.ones((6, 6)), 1) / 2
    b = jnp.arange(1.0, 7.0)
    # The residual, or a product, where there are no values.
    nothing = jnp.full(6, jnp.nan)
    first = _krylov.extend(_krylov.empty(6, b.dtype), b, True)
    second = _krylov.extend(first, A @ first.p)
    for state in (
        _krylov.extend(second, nothing, True),
        _krylov.extend(second, nothing),
    ):
        assert state.done and jnp.any(jnp.isnan(state.r))
        state = _krylov.extend(state, b, True)
        for _ in range(6):
            state = _krylov.extend(state, A @ state.p)
        np.testing.assert_allclose(A @ state.solution, b, rtol=1e-5)
