"""The bases of value functions: polynomials, grids and their coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_symplectic._expectation.fitted.bases import CovarianceFrame, Hermite
from diffrax_symplectic._expectation.fitted.grid import Grid
from diffrax_symplectic._expectation.fitted.polynomials import (
    exponents,
    hermite,
    least_squares,
)


def test_polynomials_are_orthonormal_and_fits_nested():
    x, w = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    weights = np.outer(w, w).ravel() / (2 * np.pi)
    B = np.asarray(jax.jit(jax.vmap(lambda z: jnp.stack(hermite(z, 4))))(grid))
    assert B.shape[1] == len(exponents(2, 4)) == 15
    np.testing.assert_allclose((B.T * weights) @ B, np.eye(15), atol=1e-12)
    values = np.random.default_rng(0).normal(size=(144, 2))
    values[:, 1] = B[:, :6] @ np.ones(6)
    fit = jax.jit(least_squares, static_argnums=2)
    got = fit(B, values, (3, 6))
    expected = np.linalg.lstsq(B[:, :3], values, rcond=None)[0]
    np.testing.assert_allclose(got[:3, 0], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got[:, 1, 1], [1] * 6 + [0] * 9, atol=1e-9)
    # Of two columns that are one, none explodes.
    twice = np.concatenate([B[:, :3], B[:, 2:3]], axis=1)
    got = fit(twice, values[:, 1:], (4,))
    smallest = np.linalg.lstsq(twice, values[:, 1:], rcond=None)[0]
    np.testing.assert_allclose(got[:, 0], smallest, atol=1e-3)


def test_points_whose_values_overflow_are_left_out_of_a_fit():
    basis, good = Hermite(2, 2), jnp.ones(200, bool)
    points = np.random.default_rng(0).normal(size=(200, 2))
    values = (points[:, 0] ** 2 - points[:, 1])[:, None, None]
    spoiled = values.copy()
    spoiled[:5], spoiled[5] = np.inf, np.nan

    @jax.jit
    def fitted(values):
        frame = CovarianceFrame.of(points, good, jnp.ones(2))
        return basis.least_squares_fits(values, frame, points, good, [2])

    np.testing.assert_allclose(fitted(spoiled), fitted(values), atol=1e-9)


def test_a_grid_interpolates_with_degree_five_and_is_zero_beyond():
    grid, axis = Grid(2, 12), np.linspace(-1, 1, 12)
    fn = lambda x, y: (x**5 - x) * (y**5 + y**2)
    c = jnp.asarray(fn(*np.meshgrid(axis, axis, indexing="ij"))).reshape(-1, 1)
    # Two points at least are to lie on either side.
    inner = axis[9]
    x = np.random.default_rng(0).uniform(-inner, inner, size=(50, 2))
    at = jax.jit(jax.vmap(lambda x: grid.interpolate(x, c)[0]))
    np.testing.assert_allclose(at(x), fn(*x.T), atol=1e-13)
    assert not np.any(at(np.where(np.abs(x) < inner / 2, x + np.sign(x), 2 * x)))


def test_what_a_grid_corrects_is_exact_at_its_points_and_falls_to_zero_at_its_edge():
    grid, good = Grid(2, 16), jnp.ones(1000, bool)
    points = np.random.default_rng(0).normal(size=(1000, 2))
    axis = np.linspace(-1, 1, 16)
    fn = lambda y: jnp.exp(y[0] - y[1] / 2)
    inner = np.stack(np.meshgrid(axis[3:-3], axis[3:-3]), -1).reshape(-1, 2)

    @jax.jit
    def fitted(points):
        frame = grid.frame(points, good, jnp.ones(2))
        value = lambda y: fn(y)[None, None]
        c = grid.coefficients(value, frame, points, good, None)
        nodes = frame.states(inner)
        at_nodes = jax.vmap(lambda y: grid.value_at(frame, y, c)[0, 0])(nodes)
        return c[-(16**2) :].reshape(16, 16), at_nodes, jax.vmap(fn)(nodes)

    correction, got, expected = fitted(points)
    np.testing.assert_allclose(got, expected, rtol=1e-9)
    rim = np.pad(np.zeros((14, 14), bool), 1, constant_values=True)
    assert np.all(correction[rim] == 0) and np.all(correction[~rim] != 0)


@pytest.mark.parametrize("heavy", [False, True])
def test_a_grid_is_even_where_most_states_are_and_holds_all(heavy):
    points = np.random.default_rng(0).normal(size=(2000, 2))
    points = np.sign(points) * np.expm1(3 * np.abs(points)) if heavy else points
    points = points @ np.array([[1.0, 2.0], [0.0, 0.1]])

    @jax.jit
    def there_and_back(points):
        grid = Grid(2, 64).frame(points, jnp.ones(2000, bool), jnp.ones(2))
        x = grid.coordinates(points)
        return x, grid.states(x)

    x, back = there_and_back(points)
    assert 0.5 < np.abs(x).max() < (1 if heavy else 0.75)
    np.testing.assert_allclose(back, points, rtol=1e-9, atol=1e-9)
    # Between the quartiles there are ten points, at least.
    between = np.diff(np.quantile(x, [0.25, 0.75], axis=0), axis=0)
    assert np.all(between > 3 * 2 / 63), between * 63 / 2


def test_frames_do_not_depend_on_units_and_leave_out_what_does_not_move():
    mixed = np.array([[3.0, 1, 0], [0, 2, 0], [1, 0, 1]])
    points = np.random.default_rng(0).normal(size=(500, 3)) @ mixed

    @jax.jit
    def in_frame(points, scale):
        frame = CovarianceFrame.of(points, jnp.ones(500, bool), scale)
        z = frame.coordinates(points)
        return z, frame.states(z), frame.perturbed(points)

    z, back, _ = map(np.asarray, in_frame(points, np.ones(3)))
    np.testing.assert_allclose(z.T @ z / 500, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(back, points, atol=1e-12)
    scale = np.array([1.0, 2.0**90, 2.0**-90])
    np.testing.assert_array_equal(in_frame(points * scale, scale)[0], z)
    still = np.append(points, np.full((500, 1), 7e-30), axis=1)
    z, _, perturbed = in_frame(still, np.array([1.0, 1, 1, 0]))
    np.testing.assert_array_equal(perturbed[:, 3], still[:, 3])
    assert np.all(np.isfinite(z))
