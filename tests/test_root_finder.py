"""The solver of stage equations, on its own."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

import diffrax_symplectic as ds


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_small_lu_solves_with_pivoting(n, dtype):
    matrices = jr.normal(jr.key(n), (50, n, n), dtype)
    # A vanishing corner: no elimination without exchanging rows.
    matrices = matrices.at[:, 0, 0].set(0 if n > 1 else 1)
    rhs = jr.normal(jr.key(0), (50, n), dtype)

    def solve(a, b):
        return lx.linear_solve(lx.MatrixLinearOperator(a), b, ds.SmallLU()).value

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
        ds.SmallLU().init(lx.MatrixLinearOperator(jnp.ones((2, 3))), {})


@pytest.mark.parametrize("direct", [0, 4], ids=["picard", "newton"])
@pytest.mark.parametrize("frequency", [0.1, 1.0, 10.0, 1000.0])
@pytest.mark.core
def test_stiff_steps_are_solved_where_fixed_points_diverge(frequency, direct):
    # A midpoint step of a rotation: the fixed-point map has slope `frequency / 2`.
    turn = frequency * jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    y0 = jnp.array([0.6, 0.8])
    solver = ds.Midpoint(root_finder=ds.PicardNewton(direct=direct))
    term = diffrax.ODETerm(lambda t, y, args: turn @ y)
    y1, *_, result = solver.step(term, 0.0, 1.0, y0, None, None, False)
    assert result == diffrax.RESULTS.successful
    exact = np.linalg.solve(np.eye(2) - turn / 2, (np.eye(2) + turn / 2) @ y0)
    np.testing.assert_allclose(y1, exact, atol=1e-13)


@pytest.mark.parametrize("start", [1.0, 3.0, 30.0])
@pytest.mark.core
def test_overshooting_corrections_are_shortened(start):
    # Newton's method alone diverges on arctan from beyond 1.39.
    sol = optx.root_find(
        lambda x, _: jnp.arctan(x),
        ds.PicardNewton(atol=1e-12),
        jnp.array(start),
        max_steps=50,
        throw=False,
    )
    assert sol.result == optx.RESULTS.successful
    assert abs(sol.value) <= 1e-12


@pytest.mark.core
def test_equations_without_a_solution_are_reported():
    for finder in (ds.PicardNewton(), ds.PicardNewton(direct=0)):
        sol = optx.root_find(
            lambda x, _: x**2 + 1, finder, jnp.array(0.3), max_steps=20, throw=False
        )
        assert sol.result != optx.RESULTS.successful


@pytest.mark.core
def test_leaves_that_vanish_do_not_keep_it_from_finishing():
    # One leaf has its root at exactly 0, where no relative tolerance can be met.
    def residual(x, _):
        a, b = x
        return a - 1 + 1e-3 * jnp.sin(b), b - 1e-3 * (a - 1) ** 2 * b

    for finder in (ds.PicardNewton(), ds.PicardNewton(direct=0)):
        start = (jnp.array(0.5), jnp.array(0.1))
        sol = optx.root_find(residual, finder, start, max_steps=20, throw=False)
        assert sol.result == optx.RESULTS.successful
        np.testing.assert_allclose(sol.value, (1, 0), atol=1e-13)


@pytest.mark.parametrize("direct", [0, 4], ids=["picard", "newton"])
def test_a_leaf_that_rounding_errors_keep_moving_does_not_keep_it_from_finishing(
    direct,
):
    # The second leaf is small, and moves by 1e-15 in each evaluation, as if it were a
    # difference of numbers like the first: far more than its own tolerance.
    def residual(x, _):
        a, b = x
        moving = 1e-15 * jnp.sin(1e17 * b)
        return a - 1 - 0.01 * jnp.sin(a), b - 1e-8 - jax.lax.stop_gradient(moving)

    finder, start = ds.PicardNewton(direct=direct), (jnp.array(0.5), jnp.array(0.0))
    sol = optx.root_find(residual, finder, start, max_steps=0, throw=False)
    assert sol.result == optx.RESULTS.successful
    np.testing.assert_allclose(sol.value[1], 1e-8, atol=1e-14)


@pytest.mark.parametrize("direct", [0, 6], ids=["picard", "newton"])
def test_a_solution_of_zero_is_found_from_zero(direct):
    # No correction at all, next to an iterate without size.
    finder = ds.PicardNewton(direct=direct)
    sol = optx.root_find(
        lambda x, _: 2 * x, finder, jnp.zeros(6), max_steps=3, throw=False
    )
    assert sol.result == optx.RESULTS.successful
    np.testing.assert_array_equal(sol.value, np.zeros(6))


@pytest.mark.parametrize("direct", [0, 4], ids=["picard", "newton"])
@pytest.mark.core
def test_leaving_the_domain_on_the_way_is_no_failure(direct):
    # From 3 the first fixed-point iteration leads to where the logarithm has no value.
    sol = optx.root_find(
        lambda x, _: 10 * jnp.log(x),
        ds.PicardNewton(direct=direct, atol=1e-13),
        jnp.array(3.0),
        max_steps=50,
        throw=False,
    )
    assert sol.result == optx.RESULTS.successful
    np.testing.assert_allclose(sol.value, 1, atol=1e-13)


# Where the cheap iterations of either kind have to do it alone, and where they diverge.
@pytest.mark.parametrize(
    "direct, slope, most", [(0, 0.1, 0), (6, 0.1, 0), (0, 30.0, 20)]
)
def test_corrections_are_measured_by_the_scale_that_is_passed(direct, slope, most):
    # Errors of 1e-6 in each evaluation, as if from a state of size 1e10 to which the
    # unknowns are added. No tolerance relative to the unknowns themselves can be met.
    noise = lambda k: jax.lax.stop_gradient(1e-6 * jnp.sin(1e12 * k))

    def solved(**options):
        sol = optx.root_find(
            lambda k, _: (1 + slope) * k + noise(k) - jnp.arange(1.0, 7.0),
            ds.PicardNewton(direct=direct),
            jnp.zeros(6),
            options=options,
            max_steps=most,
            throw=False,
        )
        exact = np.arange(1, 7) / (1 + slope)
        return sol.result == optx.RESULTS.successful, jnp.max(
            jnp.abs(sol.value - exact)
        )

    success, error = solved(scale=lambda k: 1e10 + jnp.abs(k))
    assert success and error <= 1e-5
    assert not solved()[0]


def test_numbers_of_iterations_that_mean_nothing_are_refused():
    for change in (dict(sweeps=1), dict(warmup=-1), dict(more_sweeps=0)):
        with pytest.raises(ValueError, match="must be at least"):
            ds.PicardNewton(**change)
