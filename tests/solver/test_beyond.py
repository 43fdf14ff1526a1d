"""Methods past the paper: weak order 3 for additive noise, explicit methods."""

import dataclasses
import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._tableau import make_plan

from ..problems import (
    FineSample,
    Given,
    separable_H0 as H0,
    separable_noise as noise,
    separable_problem,
    slope,
    weak_path,
)


explicit = pytest.mark.parametrize(
    "solver", [ds.PlateauVerlet(), ds.StormerVerlet()], ids=repr
)


@explicit
def test_every_perturbed_coefficient_is_caught(solver):
    tableau = solver.tableau
    strong = ds.strong_order_residuals(tableau)
    assert max(map(abs, strong.values())) <= 1e-15
    for field in ("alpha", "alpha_hat", "beta", "A", "A_hat", "B0", "A1"):
        value = getattr(tableau, field)
        for path, array in jax.tree_util.tree_leaves_with_path(value):
            for index in np.argwhere(array != 0):
                moved = array.copy()
                moved[tuple(index)] += 1e-6
                changed = moved if path == () else value | {path[0].key: moved}
                perturbed = dataclasses.replace(tableau, **{field: changed})
                residuals = [*ds.weak_order_residuals(perturbed, 2).values()]
                residuals.append(np.max(np.abs(ds.symplectic_residuals(perturbed))))
                assert np.max(np.abs(residuals)) >= 1e-9


def test_four_point_variables_have_seven_moments():
    h = 0.3
    path = weak_path(200_000, jr.key(1), order=3)
    increment = path.evaluate(0.0, h, use_levy=True)
    values = np.unique(np.asarray(increment.W) / np.sqrt(h))
    expected = np.sqrt(3 + np.array([1, -1]) * np.sqrt(6))
    np.testing.assert_allclose(values, [*-expected, *expected[::-1]], rtol=1e-12)
    # Exactly, with the weights; and the frequencies within 4 standard errors.
    weights = (3 - np.array([1, -1]) * np.sqrt(6)) / 12
    for n, exact in ((2, 1), (4, 3), (6, 15)):
        np.testing.assert_allclose(2 * weights @ expected**n, exact, rtol=1e-14)
    frequency = np.mean(np.abs(increment.W) > 2 * np.sqrt(h))
    p = 2 * weights[0]
    assert abs(frequency - p) <= 4 * np.sqrt(p * (1 - p) / 200_000)
    for a, b in ((increment.W, increment.second), (increment.second, increment.third)):
        assert abs(np.mean(a * b)) <= 4 * h / np.sqrt(200_000)
    with pytest.raises(ValueError, match="`order` must be 2 or 3"):
        weak_path(1, order=4)


class _Plateaus(diffrax.AbstractBrownianPath):
    """A fine sample with signs drawn beforehand for every step of the finest grid."""

    sample: FineSample
    key: jax.Array
    t0 = 0
    t1 = 1
    levy_area = ds.PlateauIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        if not use_levy:
            return self.sample.evaluate(t0, t1)
        path = ds.PlateauBrownianPath(self.sample, self.key)
        return path.evaluate(t0, t1, use_levy=True)


def _strong_errors(solver, strength, m=2, fine=2**11, samples=200):
    y0, args = separable_problem(jr.key(3), 1, m)
    a, v, phi = args["noise"]
    args["noise"] = strength * a, v, phi

    @ft.partial(jax.jit, static_argnums=2)
    @ft.partial(jax.vmap, in_axes=(0, None, None))
    def end(key, number, solver):
        k_sample, k_sign = jr.split(key)
        path = _Plateaus(FineSample.draw(k_sample, fine, m), k_sign)
        terms, h = ds.hamiltonian_terms(H0, noise, path), 1 / number
        step = lambda i, y: solver.step(
            terms, i * h, (i + 1) * h, y, args, None, False
        )[0]
        return jnp.concatenate(jax.lax.fori_loop(0, number, step, y0))

    keys, numbers = jr.split(jr.key(0), samples), np.array([8, 16, 32, 64])
    exact = end(keys, np.array(fine), ds.PlateauVerlet())
    errors = np.stack([end(keys, n, solver) - exact for n in numbers])
    return 1 / numbers, np.sqrt(np.mean(np.sum(errors**2, axis=-1), axis=1))


@pytest.mark.slow
def test_plateau_verlet_is_strong_order_three_halves():
    steps, errors = _strong_errors(ds.PlateauVerlet(), 6.0)
    assert ds.PlateauVerlet().strong_order(None) == 1.5
    assert slope(steps, errors) >= 1.45


def test_stormer_verlet_drifts_half_a_step_kicks_and_drifts_again():
    y0, args = separable_problem(jr.key(0), 2, 2)
    t0, h, W = 0.3, 0.1, jnp.array([0.4, -0.3])
    terms = ds.hamiltonian_terms(H0, noise, Given(W))
    drift, diffusion = terms.terms
    p, q = y0
    q = q + h / 2 * drift.vf(t0, (p, q), args)[1]
    kick = h * drift.vf(t0 + h / 2, (p, q), args)[0]
    p = p + kick + diffusion.vf_prod(t0 + h / 2, (p, q), args, W)[0]
    q = q + h / 2 * drift.vf(t0, (p, q), args)[1]
    y1, *_ = ds.StormerVerlet().step(terms, t0, t0 + h, y0, args, None, False)
    np.testing.assert_allclose(y1, (p, q), rtol=1e-15)


class _OnePlateau(ds.AbstractSymplecticRungeKutta):
    """The same without the signs: kick M, one Verlet step, kick W - M."""

    tableau = ds.PartitionedTableau(
        alpha=[1],
        alpha_hat=[1 / 2, 1 / 2],
        beta={"W": [1 / 2, 1 / 2], "H": [1, -1]},
        A=[[0], [1]],
        A_hat=[[1 / 2, 0]],
        B0={"W": [[1 / 2, 0]] * 2, "H": [[1, 0]] * 2},
        A1=[[0, 0], [1 / 2, 1 / 2]],
    )

    def order(self, terms):
        return 2


@pytest.mark.slow
def test_one_plateau_is_only_order_one_there():
    steps, errors = _strong_errors(_OnePlateau(), 6.0)
    assert slope(steps, errors) <= 1.25


def _plateau_path(m=2):
    return ds.PlateauVerlet().path((m,), jr.key(0))


@explicit
def test_explicit_methods_have_no_equation_to_solve(solver):
    assert make_plan(solver.tableau.flatten()).num_unknown == 0
    assert not isinstance(solver, diffrax.AbstractImplicitSolver)
    y0, args = separable_problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, _plateau_path())
    step = lambda y0: solver.step(terms, 0.0, 0.1, y0, args, None, False)[0]
    text = str(jax.make_jaxpr(step)(y0))
    assert "root_find" not in text and "triangular_solve" not in text
    sol = diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, args)
    assert all(jnp.all(jnp.isfinite(x)) for x in sol.ys)


def test_plateaus_are_fair_and_have_the_mean_square_of_the_path():
    h = 0.25
    tree = diffrax.UnsafeBrownianPath((100_000,), jr.key(0), diffrax.SpaceTimeLevyArea)
    path = ds.PlateauBrownianPath(tree, jr.key(1))
    first = path.evaluate(0.0, h, use_levy=True)
    again = path.evaluate(1e-12, h, use_levy=True)
    np.testing.assert_array_equal(np.sign(first.C), np.sign(again.C))
    # The parabola through what is known of the path, and the mean square of the rest,
    # h / 2 - h (1 / 3 + 1 / 10).
    points, weights = np.polynomial.legendre.leggauss(3)
    u = (1 + points[:, None]) / 2
    parabola = first.W * u + 6 * first.H * u * (1 - u)
    mean, square = (weights / 2 @ x for x in (parabola, parabola**2))
    np.testing.assert_allclose(mean**2 + first.C**2, square + h / 15, rtol=1e-12)
    assert abs(np.mean(first.C**2) - h / 6) <= 4 * np.std(first.C**2) / np.sqrt(100_000)
    bound = 4 * np.sqrt(h / 6) / np.sqrt(100_000)
    assert abs(np.mean(first.C)) <= bound
    later = path.evaluate(h, 2 * h, use_levy=True)
    for other in (first.W, first.H, later.C):
        assert abs(np.mean(first.C * other)) <= bound * np.std(other)
    back = jax.tree.map(lambda x: -x, first)
    np.testing.assert_array_equal(back.C, -first.C)


def test_plateaus_need_a_path_with_areas():
    with pytest.raises(ValueError, match="needs a path with space-time"):
        ds.PlateauBrownianPath(weak_path(2), jr.key(0))
    assert ds.PlateauVerlet().minimal_levy_area is ds.PlateauIncrement
    assert ds.AdditiveGauss().minimal_levy_area is ds.WeakIncrement
