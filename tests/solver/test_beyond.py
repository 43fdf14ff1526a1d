"""Methods past the paper: weak order 3 for additive noise, explicit methods."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import laws_of

from ..problems import (
    Given,
    separable_H0 as H0,
    separable_noise as noise,
    separable_problem,
    weak_path,
)


def test_four_point_variables_have_seven_moments():
    # Whose words have their values and weights by `test_laws`.
    values, weights = laws_of(weak_path(1, order=3))["W"].outcomes(5)
    for n, exact in enumerate((1, 0, 1, 0, 3, 0, 15, 0)):
        np.testing.assert_allclose(weights @ values**n, exact, rtol=1e-14, atol=1e-14)
    with pytest.raises(ValueError, match="`order` must be 2 or 3"):
        weak_path(1, order=4)


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


def test_explicit_methods_have_no_equation_to_solve():
    y0, args = separable_problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, ds.PlateauVerlet().path((2,), jr.key(0)))
    for solver in (ds.PlateauVerlet(), ds.StormerVerlet()):
        assert not isinstance(solver, diffrax.AbstractImplicitSolver)
        step = lambda y0, s=solver: s.step(terms, 0.0, 0.1, y0, args, None, False)[0]
        text = str(jax.make_jaxpr(step)(y0))
        assert "root_find" not in text and "triangular_solve" not in text


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
