"""Where methods fail and where they hold: the claims of `docs/stability.md`."""

import jax
import numpy as np
import pytest

import diffrax_symplectic as ds
from examples import rigid_body
from examples._gallery import weak
from examples._transfer import transfer_expectations
from examples.benchmarks import _exact
from examples.stability import _models, rounding, solvability, stiff


pytestmark = pytest.mark.slow


def test_heuns_method_grows_three_times_as_fast_as_a_noisy_spring_does():
    # Where the noise is weak, the growth is the method's own. (On the other models it is
    # known in closed form by `test_moments`.)
    h, strength = np.array([2.0]), np.array([0.05])
    maps = _models.moment_maps(_models.EXPLICIT["Heun"], h, strength)
    rates = np.log(_models.growth_factors(maps["spring"])) / h
    assert rates.item() > 3 * _models.spring_growth_rate(strength).item()


# At the first of each, bounded increments leave all three models solvable; elsewhere not.
SOLVE_HS = np.array([0.05, 0.4])
SOLVE_STRENGTHS = np.array([0.6, 3.0])
SOLVE_STEPS = 512


@pytest.mark.parametrize("name", solvability.MODELS)
def test_steps_fail_where_they_have_no_solution(name):
    given = ds.ImplicitMidpoint(), SOLVE_HS, SOLVE_STRENGTHS, SOLVE_STEPS
    r = solvability.shares(solvability.MODELS[name], *given)
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


def test_the_rigid_body_by_spherical_harmonics_is_that_by_steps():
    make_terms = lambda path: rigid_body.make_terms(path, 0.5)
    coarse, fine = transfer_expectations(
        make_terms, weak(), ds.StrangGauss(), rigid_body.X0, lambda X: X[0] ** 2,
        [1 / 16, 1 / 32], (1.0,) * 3, 6, 0.25,
    )  # fmt: skip
    got = _exact.rigid_body_square(0.5, 0.25, degree=30)
    # Without noise it would differ by 1e-3.
    np.testing.assert_allclose(got, fine + (fine - coarse) / 3, atol=2e-7)
