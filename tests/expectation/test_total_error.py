"""The total error of an estimate contains what remains of the discretization error, and
what failed paths could change."""

import re
import warnings

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.estimate.cautions import cautions
from diffrax_symplectic._simulation import advice_on_failures
from diffrax_symplectic._simulation.levels import Combination, level_weights

from ..families import slow_except
from .steps import problem_of, sampled


KEY = jr.key(0)
# The number of paths is that of a batch, and numbers are arrays: programs are shared.
PATHS = 256


def _from_means(means: np.ndarray, noise: float):
    """An estimate, for a method of order 2, whose levels have these means."""
    means, noise = jnp.asarray(means), jnp.array(noise)

    def fn(key, level):
        # Levels that are not coupled.
        own, common = jr.normal(jr.fold_in(key, level)), jr.normal(key)
        return means[level] + noise * (common + own)

    return ds.monte_carlo(fn, key=KEY, num_paths=PATHS, levels=len(means), order=2)


def _far_mean(h: float) -> float:
    """<p q> of an oscillator with friction 0.01 at temperature 1, at t = 500 from (0, 2),
    by steps of `BAOAB`."""
    kick, drift = np.eye(2), np.eye(2)
    kick[0, 1], drift[1, 0] = -h / 2, h / 2
    decay = np.exp(-0.01 * h)
    M = kick @ drift @ np.diag([decay, 1]) @ drift @ kick
    force = kick @ drift @ [np.sqrt(1 - decay**2), 0]
    # The second moments and 1 after a step.
    step = np.block([[np.kron(M, M), np.kron(force, force)[:, None]], [np.eye(5)[4:]]])
    return (np.linalg.matrix_power(step, round(500 / h)) @ [0, 0, 0, 4, 1])[1]


def test_three_levels_know_that_the_steps_are_too_long_and_two_promise_nothing():
    exact = -0.01106188
    means = np.array([_far_mean(h) for h in (0.2, 0.1, 0.05)])
    two, three = _from_means(means[:2], 1e-9), _from_means(means, 1e-9)
    # The change by the extrapolation is half of what remains.
    assert two.error < abs(two.mean - exact) / 1.9
    assert two.off_order is None and "order" not in str(two)
    assert three.off_order and "do not fit the order" in str(three)
    np.testing.assert_allclose(three.error, np.max(np.abs(np.diff(means))), rtol=1e-5)


@pytest.mark.parametrize("size", [1e-12, 1e-4])
def test_heavy_tails_are_told_only_where_they_matter_beside_the_whole_error(size):
    factor = jnp.array(size)

    def fn(key, level):
        # The mean of each level, and a variable whose mean is made by rare samples.
        return jnp.array([1.3, 1.0])[level] + factor * jnp.exp(5 * jr.normal(key))

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        ds.monte_carlo(fn, key=KEY, num_paths=400, levels=2, order=2)
    heavy = [x for x in told if "of the variance" in str(x.message)]
    assert len(heavy) == (size > 1e-6)


@pytest.mark.parametrize("noise", [1e-9, 10.0])
def test_changes_fit_the_order_unless_sampling_shows_that_they_do_not(noise):
    h = 0.5 ** np.arange(3)
    # Half an order less, the order, one with a term of higher order, two orders more, no
    # change at all, one that comes late, and one that turns.
    rows = [h**1.5, h**2, h**2 - 0.1 * h**3, h**4, 0 * h, [0, 0, 1], [0, 1, 0.75]]
    got = _from_means(np.transpose(rows), noise)
    off = np.array([True, False, False, False, False, True, True])
    np.testing.assert_array_equal(got.off_order, off & (noise < 1))
    last, before = np.diff(rows)[:, 1], np.diff(rows)[:, 0]
    if noise < 1:
        whole = np.maximum(np.abs(last), np.abs(before))
        np.testing.assert_allclose(got.error[off], whole[off], rtol=1e-6)
        # By the order of the solver, the change of what two levels extrapolate.
        coarse, middle, fine = np.transpose(rows)
        change = (4 * fine - middle) / 3 - (4 * middle - coarse) / 3
        np.testing.assert_allclose(got.error[~off], np.abs(change / 3)[~off], atol=1e-9)


PENDULUM = ds.hamiltonian_terms(
    lambda t, p, q, args: p**2 / 2 - jnp.cos(q),
    lambda t, p, q, args: 0.2 * jnp.sin(q),
    (),
)
START = jnp.array(0.0), jnp.array(1.0)


def _of_pendulum(**kwargs):
    square = lambda t, y, args: y[1] ** 2
    given = square, PENDULUM, ds.StormerVerlet(), 0, 1, 0.125, START
    return ds.expectation(*given, key=KEY, **kwargs)


@pytest.mark.slow
def test_levels_are_added_until_the_tolerance_holds_for_the_whole_error():
    levels = []
    for tol in (1e-3, 1e-6, 1e-9):
        got = _of_pendulum(tol=tol)
        assert got.tol_reached and got.error <= tol
        # By four levels with steps half as long.
        assert abs(got.mean - 0.3640833476) <= tol + 1e-10
        levels.append(got.levels)
    assert levels == [2, 3, 5]
    # The number of levels is the user's, if it is given, and that of `start`.
    with pytest.warns(
        UserWarning, match="not reached: .* remains of the discretization"
    ):
        two = _of_pendulum(tol=1e-6, levels=2)
    assert two.levels == 2 and two.tol_reached is False
    with pytest.warns(UserWarning, match="not reached"):
        assert _of_pendulum(tol=1e-6, start=two).levels == 2


def test_samples_end_where_more_of_them_do_not_reach_the_tolerance():
    def with_levels(*means, noise=1e-6, **kwargs):
        noise, means = jnp.array(noise), jnp.array(means)
        fn = lambda key, level: means[level] + noise * jr.normal(key)
        kwargs = dict(key=KEY, num_paths=10**6, batch_size=64, order=2) | kwargs
        return ds.monte_carlo(fn, levels=len(means), **kwargs)

    with pytest.warns(UserWarning, match="1.0e-01 remains of the discretization error"):
        got = with_levels(0.0, 0.3, tol=1e-3)
    assert got.tol_reached is False and got.num_paths <= 256
    # The changes do not fit the order, however small the tolerance makes them.
    with pytest.warns(UserWarning, match="do not fit the order of the solver, so"):
        got = with_levels(0.0, 0.3, 0.0, tol=0.5)
    assert got.tol_reached is False and got.num_paths <= 256
    with pytest.warns(UserWarning, match="sampling error is .* takes about"):
        got = with_levels(0.0, 0.0, noise=1.0, tol=0.01, num_paths=256)
    assert got.tol_reached is False and got.num_paths == 256


def test_paths_that_fail_with_longer_steps_alone_are_told():
    # The steps of 1/8 are beyond the limit of stability, those of half of it are not.
    H0 = lambda t, p, q, args: (p**2 + 18**2 * q**2) / 2
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * q, ())
    lost = lambda t, y, args: jnp.where(jnp.abs(y[1]) > 10, jnp.nan, y[1])
    given = ds.IndependentPaths(64), terms, ds.StormerVerlet(), 0.125, START
    none = sampled(*given, num_steps=16, phi=lost)
    assert none.failed_on == (64, 0) and none.num_failed == 64
    said = r"do not agree, since 64 paths fail.* and 0 with"
    assert re.search(said, " ".join(cautions(none, None, "")))


@pytest.mark.parametrize(
    "order, levels", [(1, 1), (2, 2), (3, 2), (1, 3), (2, 3), (1, 4), (2, 4)]
)
def test_weights_of_levels_cancel_powers_of_the_step_size(order, levels):
    weights = level_weights(order, levels)
    h = 0.5 ** np.arange(levels)
    best = weights[Combination.BEST]
    np.testing.assert_allclose(best.sum(), 1)
    for power in range(order, order + levels - 1):
        assert abs(best @ h**power) < 1e-13
    if levels == 1:
        return
    # The finest level is the best estimate and its bias. What the last power but one
    # leaves is what the last extrapolation takes away.
    np.testing.assert_allclose(best + weights[1], np.eye(levels)[-1], atol=1e-13)
    last_power = order + levels - 2
    extrapolation = weights[Combination.EXTRAPOLATION]
    np.testing.assert_allclose(extrapolation.sum(), 0, atol=1e-13)
    before = best - extrapolation
    assert before[0] == 0 and abs(before @ h**last_power) > 1e-4
    # It counts as one of the first power.
    factor = (2.0**last_power - 1) / (2.0**order - 1)
    by_first_power = weights[Combination.BY_FIRST_POWER]
    np.testing.assert_allclose(by_first_power, factor * extrapolation, atol=1e-13)
    if levels == 2:
        return
    # Changes are compared after all but one power is eliminated. Lower powers come with a
    # sign that would turn the changes of the means.
    last, before, miss = weights[Combination.LAST :]
    power = last_power - 1
    means = 1 + h**power - 0.6 * (power > order) * h**order
    assert last @ means == pytest.approx(2.0**-power * (before @ means), rel=1e-12)
    assert abs(before @ means) > 1e-3 and abs(miss @ means) < 1e-14


def _uniform_unless(lost: float):
    """Uniform numbers, of which those above `1 - lost` fail."""

    def fn(key):
        x = jr.uniform(key)
        return jnp.where(x > 1 - lost, jnp.nan, x)

    return fn


def test_few_failed_paths_are_told_if_they_could_change_more_than_the_standard_error():
    # Of one path in two hundred, 1 / 400 of the mean is missing.
    run = lambda n: ds.monte_carlo(_uniform_unless(0.005), key=KEY, num_paths=n)
    with pytest.warns(UserWarning, match="paths failed: they are left out"):
        many = run(100_000)
    assert many.std_error < abs(many.mean - 0.5) < many.failed_error < 0.003
    np.testing.assert_allclose(many.error, np.hypot(many.std_error, many.failed_error))
    # The largest deviation is a half.
    share = many.num_failed / 100_000
    np.testing.assert_allclose(many.failed_error, share / 2, rtol=0.02)
    assert f"failed paths {many.failed_error:.1e})" in str(many)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        few = run(400)
    assert few.num_failed > 0 and few.failed_error < few.std_error


def _added(path):
    """The noise itself, of which what is above 1.5 fails in the next step."""
    lost = lambda t, y, args: jnp.where(y > 1.5, jnp.nan, 0.0)
    kick = diffrax.ControlTerm(lambda t, y, args: jnp.ones(()), path)
    return diffrax.MultiTerm(diffrax.ODETerm(lost), kick)


SAMPLINGS = ds.IndependentPaths(4000), ds.ArrayRQMC(256, 16), ds.ValueFunctions(1, 2000)


@pytest.mark.core
@pytest.mark.parametrize(
    "sampling",
    slow_except(SAMPLINGS[:2], SAMPLINGS),
    ids=lambda sampling: type(sampling).__name__,
)
def test_failed_paths_count_by_the_spread_of_paths_in_every_sampling(sampling):
    with pytest.warns(UserWarning, match="paths failed") as told:
        got = ds.expectation(
            lambda t, y, args: y, _added(ds.WeakBrownianPath((), KEY)),
            diffrax.EulerHeun(), 0, 1, 0.25, jnp.zeros(()), key=KEY, sampling=sampling,
            levels=1,
        )  # fmt: skip
    assert not any("WeakBrownianPath" in str(x.message) for x in told)
    # Replicates count the paths that failed among theirs.
    replicates = isinstance(sampling, ds.ArrayRQMC)
    count = got.num_paths + (0 if replicates else got.num_failed)
    # The lowest value is four kicks of sqrt(3 / 4).
    assert 2.5 < got.failed_error * count / got.num_failed < 4
    assert got.std_error < abs(got.mean) < got.error


def test_advice_on_failures_fits_the_path_and_the_solver():
    def advice(terms, solver, y0):
        return advice_on_failures(problem_of(terms, solver, 0.25, y0))

    gaussian = ds.FixedStepBrownianPath((), KEY)
    truncated = ds.TruncatedBrownianPath(gaussian)
    for path in (gaussian, ds.WeakBrownianPath((), KEY), truncated):
        said = advice(_added(path), diffrax.EulerHeun(), jnp.zeros(()))
        assert ("bounded increments" in said) == (path is gaussian)
    said = advice(PENDULUM, ds.ImplicitMidpoint(), START)
    assert "meet: pass a smaller `dt0`, or an explicit solver" in said
