"""Where methods fail and where they hold: the claims of `docs/stability.md`."""

import jax
import numpy as np
import pytest

import diffrax_symplectic as ds
from examples.stability import _models, rounding, solvability, stiff


pytestmark = pytest.mark.slow


HS, STRENGTHS = np.array([0.02, 0.2, 2.0]), np.array([0.05, 0.5, 2.0])


def test_heuns_method_grows_as_in_closed_form():
    h, s = HS[:, None], STRENGTHS
    maps = _models.moment_maps(_models.EXPLICIT["Heun"], HS, STRENGTHS)
    factors = {model: _models.growth_factors(K) for model, K in maps.items()}
    # |1 - ix - x^2 / 2|^2 = 1 + x^4 / 4 with x = h + s I.
    on_kubo = 1 + (h**4 + 6 * h**3 * s**2 + 3 * h**2 * s**4) / 4
    np.testing.assert_allclose(factors["linear"], 1 + (h + 0 * s) ** 4 / 4, rtol=1e-12)
    np.testing.assert_allclose(factors["kubo"], on_kubo, rtol=1e-12)
    assert np.all(factors["kubo"] > 1)
    # Where the noise is weak, the growth on the noisy spring is the method's own: more
    # than three times the exact rate at h = 2.
    exact = _models.spring_growth_rate(STRENGTHS)
    assert np.log(factors["spring"][2, 0]) / HS[2] > 3 * exact[0]


# At the first of each, bounded increments leave all three models solvable; elsewhere not.
SOLVE_HS, SOLVE_STRENGTHS, SOLVE_STEPS = (
    np.array([0.05, 0.4]),
    np.array([0.6, 3.0]),
    512,
)


@pytest.mark.parametrize("name", solvability.MODELS)
def test_steps_fail_where_they_have_no_solution(name):
    r = solvability.shares(
        solvability.MODELS[name],
        ds.ImplicitMidpoint(),
        SOLVE_HS,
        SOLVE_STRENGTHS,
        SOLVE_STEPS,
    )
    assert not np.any(r.impossible)
    # Moderate steps: nothing is given up, and bounded increments never fail.
    assert np.all(r.given_up[:, 0, 0] == 0)
    assert np.all(r.failed[2:, 0, 0] == 0)
    if name == "escape":
        _check_against_the_exact_share(r)
    if name == "cubic":
        assert np.all(r.given_up == 0)
        assert np.all(r.unsolvable[[0, -1], 1, 1] > 0)
    if name == "rotation":
        assert not np.any(r.unsolvable)


def _check_against_the_exact_share(r):
    """Of increments with s I cos(a) > 1/2, for an angle a spread evenly."""
    cos = np.cos(2 * np.pi * (np.arange(4000) + 0.5) / 4000)
    for i, h in enumerate(SOLVE_HS):
        for j, s in enumerate(SOLVE_STRENGTHS):
            needed = 1 / (2 * s * np.sqrt(h) * np.abs(cos))
            gaussian = np.mean(jax.scipy.stats.norm.sf(needed))
            three = np.mean(needed < np.sqrt(3)) / 6
            # The sign of cos(a) does not matter: both laws are symmetric.
            for law, exact in ((0, gaussian), (-1, three)):
                error = np.sqrt(exact * (1 - exact) / SOLVE_STEPS)
                assert abs(r.unsolvable[law, i, j] - exact) <= 4 * error + 1e-3 * exact


@pytest.mark.parametrize(
    "name, limit",
    [("StormerVerlet", 2), ("PlateauVerlet", 4), ("ImplicitMidpoint", None)],
)
def test_explicit_steps_are_stable_up_to_their_limit_and_implicit_ones_always(
    name, limit
):
    # h times the fastest frequency.
    omegas = np.array([0.1, 1.0, 1.99, 2.01, 3.99, 4.01, 10.0])
    radii = stiff.spectral_radii(stiff.CASES[name], omegas / stiff.fastest())
    holds = np.full(len(omegas), True) if limit is None else omegas < limit
    np.testing.assert_allclose(radii[holds], 1, rtol=0, atol=1e-12)
    assert np.all(radii[~holds] > 1.01)


def test_nonlinear_energies_are_kept_up_to_the_linear_limit():
    hs = np.array([0.5, 1.8, 2.2]) / stiff.fastest()
    midpoint = stiff.energies(stiff.CASES["ImplicitMidpoint"], hs, 2.0, 256)
    verlet = stiff.energies(stiff.CASES["StormerVerlet"], hs, 2.0, 256)
    for e in (*midpoint, verlet[0]):
        assert e.failed == 0
        assert abs(e.excess) <= 4 * e.excess_error
        # Of the fast oscillator, 1/2 at the start.
        assert abs(e.fast - 0.5) <= 0.1
    assert not np.isfinite(verlet[2].excess)


@pytest.mark.parametrize(
    "system, dtype",
    [
        pytest.param(rounding.KUBO, np.float64, marks=pytest.mark.core),
        (rounding.KUBO, np.float32),
        (rounding.RIGID_BODY, np.float64),
    ],
    ids=["Kubo, float64", "Kubo, float32", "rigid body, float64"],
)
def test_rounding_errors_grow_like_the_root_of_the_number_of_steps(system, dtype):
    g = rounding.growth(system, ds.ImplicitMidpoint(), 10_000, 64, dtype)
    eps = np.finfo(dtype).eps
    exponent, error = g.exponent()
    assert error <= 0.1
    assert abs(exponent - 0.5) <= 0.12
    # A random walk of about half a unit in the last place each step.
    assert 0.05 * eps <= g.rms[-1] / np.sqrt(g.steps[-1]) <= eps


def test_a_tighter_root_finder_removes_the_bias_of_srkw2():
    tight = ds.SRKw2(root_finder=ds.PicardNewton(rtol=1e-17))
    mean, error = rounding.growth(rounding.KUBO, tight, 10_000, 32).bias
    eps = np.finfo(np.float64).eps
    # It is 0.04 eps in each step otherwise.
    assert error <= 2e-3 * eps
    assert abs(mean) <= 4 * error
