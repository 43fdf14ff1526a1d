"""An error bar is never too small without a word, which says what, where and when: in any
units and either precision, for rare paths, and for fits that are not good."""

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
from diffrax_symplectic._simulation import Layout
from diffrax_symplectic._simulation.levels import Combination
from diffrax_symplectic._simulation.problem import Problem

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


def test_what_is_zero_or_underflows_on_all_paths_is_told():
    run = lambda fn: ds.monte_carlo(fn, key=KEY, num_paths=100)
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
    hits = hits[np.isfinite(means)]
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
    np.testing.assert_allclose(got.std_error[3], np.sqrt(got.variance[3] / 16))


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
