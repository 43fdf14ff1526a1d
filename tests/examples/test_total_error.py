"""The chart of total errors against time: what it extrapolates and what it calls exact."""

import numpy as np
import pytest
from scipy.linalg import expm

import diffrax_symplectic as ds
from examples import rigid_body
from examples._gallery import weak
from examples._transfer import transfer_expectations
from examples.benchmarks import _exact, total_error
from examples.hard_cases import chain


pytestmark = pytest.mark.slow


def test_independent_paths_take_the_step_that_is_cheapest_for_an_error():
    variance, cost, error = 2.0, 1e-7, np.array([1e-2, 1e-4])
    n = np.array([8, 16])
    biases = [[k, 1 / k**2, 0.0] for k in n.tolist()]
    got = total_error.extrapolated(biases, variance, cost, error)
    steps = 8.0 * 2.0 ** np.arange(20)[:, None]
    left = error**2 - steps**-4.0
    seconds = np.where(left > 0, cost * steps * variance / np.abs(left), np.inf)
    np.testing.assert_allclose(got, seconds.min(axis=0), rtol=1e-10)
    # A bias that is not clear of its uncertainty is none: the largest step will do.
    unclear = [[8, 1e-3, 1e-3], [16, 1e-3, 1e-3]]
    got = total_error.extrapolated(unclear, variance, cost, error)
    np.testing.assert_allclose(got, cost * 8 * variance / error**2, rtol=1e-6)


def test_replicates_divide_the_variance_and_leave_the_bias():
    row = lambda error, systematic: {"error": error, "systematic": systematic}
    # (5^2 - 3^2) / (4^2 - 3^2) times as many; the other never gets there.
    rows = [row(5.0, 3.0), row(6.0, 5.0)]
    assert total_error.to_target(rows, [7.0, 1.0], 4.0) == 7 * 16 / 7
    assert total_error.to_target([row(3.0, 1.0)], [2.0], 4.0) == 2
    assert total_error.to_target(rows[1:], [1.0], 4.0) == np.inf


def test_the_rigid_body_by_spherical_harmonics_is_that_by_steps():
    make_terms = lambda path: rigid_body.make_terms(path, 0.5)
    coarse, fine = transfer_expectations(
        make_terms, weak(), ds.StrangGauss(), rigid_body.X0, lambda X: X[0] ** 2,
        [1 / 16, 1 / 32], (1.0,) * 3, 6, 0.25,
    )  # fmt: skip
    got = _exact.rigid_body_square(0.5, 0.25, degree=30)
    # Without noise it would differ by 1e-3.
    np.testing.assert_allclose(got, fine + (fine - coarse) / 3, atol=2e-7)


def test_the_study_runs_at_small_sizes(capsys):
    total_error.quick()
    tables = capsys.readouterr().out
    assert "| linear oscillator | 64 |" in tables and "nan" not in tables


def test_the_mean_square_of_the_harmonic_chain_is_that_of_its_moment_equations():
    n, s, t = chain.N, 0.3, 1.7
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    zero, one = np.zeros((n, n)), np.eye(n)
    A = np.block([[zero, -stiffness], [one, zero]])
    noise = np.block([[s**2 * one, zero], [zero, zero]])
    # Of Van Loan (1978): the integral of exp(At) Q exp(At)^T, by one exponential.
    both = expm(np.block([[-A, noise], [np.zeros_like(A), A.T]]) * t)
    covariance = both[2 * n :, 2 * n :].T @ both[: 2 * n, 2 * n :]
    mean = (expm(A * t) @ np.concatenate(chain.start(1.0)))[n:]
    expected = (np.sum(mean**2) + np.trace(covariance[n:, n:])) / n
    np.testing.assert_allclose(
        _exact._harmonic_chain_square(s, t), expected, rtol=1e-12
    )
