"""An error bar is never too small without a word, which says what, where and when: in any
units and either precision, for rare paths, for fits that are not good, for what remains of
the discretization error, and for what failed paths could change."""

import re
import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from scipy import stats

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.estimate.cautions import cautions
from diffrax_symplectic._expectation.estimate.estimate import _rounded, combined_results
from diffrax_symplectic._expectation.out_of_range import out_of_range
from diffrax_symplectic._expectation.run import run
from diffrax_symplectic._expectation.sampling import (
    Averaged,
    Outputs,
    Samples,
    SamplingPlan,
)
from diffrax_symplectic._simulation import advice_on_failures, Layout
from diffrax_symplectic._simulation.levels import Combination, level_weights
from diffrax_symplectic._simulation.problem import Problem

from ..families import slow_except
from .cells import arguments, Cell, exact
from .steps import problem_of, sampled


KEY = jr.key(0)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    "dtype, sizes", [("f4", [1e-21, 1e-19, 1e15, 1e30]), ("f8", [1e-200, 1e200])]
)
def test_the_spread_of_small_and_large_numbers_is_known(dtype, sizes):
    """Though their squares underflow or overflow."""
    sizes = np.array([1.0, *sizes], dtype)
    run = lambda size, **kwargs: ds.monte_carlo(
        lambda key: size * (1 + jr.normal(key, (), dtype)),
        key=KEY, num_paths=4000, batch_size=1000, **kwargs,
    )  # fmt: skip
    got, rtol = run(jnp.asarray(sizes)), 1e-5 if dtype == "f4" else 1e-12
    np.testing.assert_allclose(got.std_error / sizes, got.std_error[0], rtol=rtol)
    np.testing.assert_allclose(got.mean / sizes, got.mean[0], rtol=rtol)
    with pytest.warns(UserWarning, match="was not reached"):
        few = run(jnp.asarray(sizes[1:2]), tol=0.01 * float(sizes[1]))
    assert few.num_paths == 4000


def test_values_that_overflow_or_are_zero_or_underflow_on_all_paths_are_told():
    run = lambda fn: ds.monte_carlo(fn, key=KEY, num_paths=100)
    with pytest.warns(UserWarning, match="or its standard error is not finite"):
        run(lambda key: 1e308 * jr.rademacher(key, dtype=float))
    with pytest.warns(UserWarning, match="indicator of a rare event"):
        run(lambda key: jr.normal(key) > 9)
    with pytest.warns(UserWarning, match="underflows float32"):
        run(lambda key: jnp.float32(1e-36) * jr.normal(key, (), "f4"))


def test_few_samples_that_make_up_for_the_spread_widen_it_and_are_told():
    light_and_heavy = lambda key: jnp.exp(jnp.array([0.1, 5]) * jr.normal(key))
    with pytest.warns(
        UserWarning, match=r"One path in 2,000 accounts for .* \(\[1\]\)"
    ):
        got = ds.monte_carlo(light_and_heavy, key=KEY, num_paths=2000)
    plain = np.sqrt(got.variance / 2000)
    np.testing.assert_allclose(got.std_error[0], plain[0])
    assert got.std_error[1] > 1.3 * plain[1]


def _controlled(shift, spread, keys):
    """Standard normal numbers, less a control that has the mean `shift`."""
    x = jax.vmap(jr.normal)(keys)
    control = spread * x + shift
    own, plain, control = (value[None, :, None] for value in (x - control, x, control))
    averaged = Averaged(own, plain=plain, control=control)
    return Samples(averaged, jnp.ones(len(keys), bool), jnp.zeros((1, len(keys))))


def test_a_control_whose_mean_is_not_zero_is_dropped():
    def with_control(shift):
        # What is left is an eighth of the noise, and the whole mean of the control.
        sampler = jax.tree_util.Partial(_controlled, jnp.array(shift), jnp.array(0.875))
        outputs = Outputs(Layout.of(0.0), levels=1, dtype="float64")
        plan = SamplingPlan(sampler, outputs, num_samples=1000, batch_size=250)
        return run(plan, KEY, tuple(jax.devices()[:1]))

    fine, biased = with_control(0.0), with_control(0.5)
    plain = ds.monte_carlo(jr.normal, key=KEY, num_paths=1000)
    assert not combined_results(fine, Combination.BEST).dropped
    assert combined_results(biased, Combination.BEST).dropped
    np.testing.assert_allclose(fine.std_error, plain.std_error / 8, rtol=1e-12)
    np.testing.assert_allclose(biased.mean, plain.mean, rtol=1e-12)
    np.testing.assert_allclose(biased.std_error, plain.std_error, rtol=1e-12)
    assert with_control(np.nan).mean == biased.mean
    assert "A control variate was dropped" in " ".join(cautions(biased, None, ""))
    assert not list(cautions(fine, None, ""))


# Fewer paths, steps and fits than there, for less time.
_FEW = {
    "IndependentPaths": ds.IndependentPaths(1024),
    "ArrayRQMC": ds.ArrayRQMC(256, 16),
    "ValueFunctions": ds.ValueFunctions(num_paths=1024, batch_size=256),
}


# Additive and strong; multiplicative and strong, for heavy tails.
@pytest.mark.parametrize("name", _FEW)
@pytest.mark.parametrize("noise", ["additive", "multiplicative"])
@pytest.mark.slow
def test_intervals_cover_as_often_as_they_say(name, noise):
    cell, devices = Cell(noise, 1.0, 1.0, steps=10), tuple(jax.devices()[:1])
    problem = Problem.of(*arguments(cell), None, 1)
    # One fit: its paths have nothing to do with those that are averaged.
    plan = _FEW[name].prepare(problem, jr.key(1), devices)
    run_of = lambda seed: run(plan, jr.key(seed), devices, rounding_floor=10)
    ends = [run_of(seed).interval() for seed in range(40)]
    low, high = np.array(ends).swapaxes(0, 1)
    means, errors = exact(cell, 2**12)
    hits = np.sum((low <= means + errors) & (means - errors <= high), axis=0)
    # So few hits have the probability of four standard errors of a normal variable.
    assert np.all(stats.binom.cdf(hits, 40, 0.95) > stats.norm.cdf(-4)), hits


def test_heavy_tails_within_replicates_widen_the_standard_error_and_are_told():
    # A batch is one replicate, the spread of which is zero.
    phi, *given, y0, s = arguments(Cell("multiplicative", 1.0, 5.0, steps=10))
    terms, solver, _, _, h = given
    sampling = ds.ArrayRQMC(256, 16)
    got = sampled(sampling, terms, solver, h, y0, s, num_steps=10, levels=1, phi=phi)
    assert "One path in 256 accounts for" in " ".join(cautions(got, None, ""))
    assert got.std_error[1] > 1.3 * np.sqrt(got.variance[1] / 16)
    np.testing.assert_allclose(got.std_error[2], np.sqrt(got.variance[2] / 16))


def _told(call) -> list[str]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        call()
    return [str(warning.message) for warning in told]


@pytest.mark.parametrize(
    "mean, error, printed",
    [
        (0.36408312, 8.6e-5, "0.364083"),
        (28.312, 1.3, "28.3"),
        (12345.678, 1300.0, "12300"),
        (-0.0, 1e-3, "0.0000"),
        (4.37215e-44, 1.2e-46, "4.372e-44"),
        (1.0000000123e12, 1.2e3, "1.0000000123e+12"),
        (-2.846498041231e-11, 4.6e-11, "-2.8e-11"),
        (1e-50, 3.2e-45, "0"),
        (9.9999e-5, 1e-6, "1.000e-04"),
        (2 / 3, 1e-20, "0.6666666666666666"),
        (np.nan, np.nan, "nan"),
    ],
)
def test_a_mean_has_as_many_digits_as_its_bar_allows(mean, error, printed):
    assert _rounded(mean, error) == printed


def _at_two_times(first=0):
    path = ds.WeakBrownianPath((), KEY)
    terms = diffrax.ControlTerm(lambda t, y, args: y, path)
    phi = lambda t, y, args: {"both": jnp.stack([y, y**2])}
    return ds.expectation(
        phi, terms, diffrax.Heun(), 0, 1, 0.1, jnp.array(1.0), key=KEY, ts=[0.3, 1],
        levels=1, sampling=ds.IndependentPaths(16), first=first,
    )  # fmt: skip


def test_times_stand_beside_rows_also_from_files_and_merged(tmp_path):
    one, other = _at_two_times(), _at_two_times(first=16)
    one.save(tmp_path / "one.npz")
    loaded = ds.Expectation.load(tmp_path / "one.npz")
    for estimate in (one, loaded, loaded.merge(other)):
        lines = str(estimate).splitlines()
        names = [line.split(":")[0] for line in lines[:4]]
        assert lines[4] == "not included: the discretization error (see `levels`)"
        assert names == [f"t={t}, ['both'][{k}]" for t in ("0.3", "1") for k in (0, 1)]
        assert f"{estimate.num_paths} paths on 1 level, 0 failed" in lines[-1]
    # A file of an earlier version has no times.
    with np.load(tmp_path / "one.npz") as arrays:
        np.savez(tmp_path / "old.npz", **{k: x for k, x in arrays.items() if k != "ts"})
    old = ds.Expectation.load(tmp_path / "old.npz")
    assert str(old).startswith("['both'][0, 0]: ")


def test_the_share_of_the_largest_path_is_told_with_its_place():
    def rare(key):
        return jnp.stack([jr.normal(key), 1.0 * (jr.uniform(key) < 0.005)])

    with pytest.warns(UserWarning) as told:
        hits = 400 * ds.monte_carlo(rare, key=KEY, num_paths=400).mean[1]
    (message,) = [str(x.message) for x in told]
    share, place = re.findall(r"for (\d+)% of the variance \((.*?)\)", message)[0]
    # Each hit has the same deviation.
    assert 1 <= hits < 8 and abs(int(share) - 100 / hits) <= 1
    assert place == "[1]" and message.startswith("One path in 400 accounts")


def test_steps_that_do_not_agree_are_told_with_their_place():
    def told(means, noise):
        """Of levels with these means, and one noise for all of them."""
        means, noise = jnp.array(means), jnp.array(noise)
        fn = lambda key, level: means[level] + noise * jr.normal(key)
        few = dict(key=KEY, num_paths=4096)
        return _told(lambda: ds.monte_carlo(fn, **few, levels=2, order=2))

    (message,) = told([[1.0, 4.0], [1.0, 1.0]], [0.1, 0.1])
    assert "do not agree ([1]): extrapolation" in message
    assert re.search(r"the mean from (0\.99|1)\S* to -?0\.00", message)
    # A mean that is zero within its spread is no disagreement.
    zero = [[0.09, 0.09], [0.0, 0.0]]
    assert not told(zero, [1.0, 1.0])
    assert told(zero, [1.0, 0.01])


def test_numbers_that_single_precision_loses_are_named():
    def said(mass=1.0, T=1.0, args=None, all_fail=False):
        single = jax.ShapeDtypeStruct((), jnp.float32)
        H0 = lambda t, p, q, args: p**2 / (2 * jnp.float32(mass)) - jnp.cos(q)
        terms = ds.langevin_terms(H0, jnp.float32(1), jnp.float32(T), single)
        y0 = jnp.float32(0), jnp.float32(1)
        problem = problem_of(terms, ds.BAOAB(), 0.25, y0, args)
        return out_of_range(problem, all_fail)

    assert said() is None
    advice = "Pass `y0` and what goes with it in float64, or choose units"
    lost = said(mass=1.1e-44, all_fail=True)
    assert lost.startswith("In float32, 2 * 1.1e")
    assert f"is 0. {advice}" in lost
    cold = said(T=1e-42)
    assert cold.startswith("In float32, `temperature` of 1e-42 counts as zero.")
    long = said(args={"length": 1e60, "fn": jnp.sin})
    assert long.startswith("In float32, `args` of 1e+60 counts as infinite.")


# The number of paths is that of a batch, and numbers are arrays: programs are shared.
PATHS_OF_LEVELS = 256


def _from_means(means: np.ndarray, noise: float):
    """An estimate, for a method of order 2, whose levels have these means."""
    means, noise = jnp.asarray(means), jnp.array(noise)

    def fn(key, level):
        # Levels that are not coupled.
        own, common = jr.normal(jr.fold_in(key, level)), jr.normal(key)
        return means[level] + noise * (common + own)

    return ds.monte_carlo(
        fn, key=KEY, num_paths=PATHS_OF_LEVELS, levels=len(means), order=2
    )


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
    "order, levels",
    [(1, 1), (2, 2), (3, 2), (1, 3), (2, 3), (1, 4), (2, 4), (0.5, 3), (0.5, 4)],
)
def test_weights_of_levels_cancel_powers_of_the_step_size(order, levels):
    weights = level_weights(order, levels)
    h = 0.5 ** np.arange(levels)
    best = weights[Combination.BEST]
    np.testing.assert_allclose(best.sum(), 1)
    # For order 1/2 the error has powers of the root of the step size.
    powers = [order + min(order, 1) * k for k in range(levels - 1)]
    for power in powers:
        assert abs(best @ h**power) < 1e-13
    if levels == 1:
        return
    # The finest level is the best estimate and its bias. What the last power but one
    # leaves is what the last extrapolation takes away.
    np.testing.assert_allclose(best + weights[1], np.eye(levels)[-1], atol=1e-13)
    last_power = powers[-1]
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
    power = powers[-2]
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
