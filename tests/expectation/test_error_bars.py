"""An error bar is never too small without a word: in any units and either precision, for
rare paths, and for fits that are not good."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from scipy import stats

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.estimate.cautions import cautions
from diffrax_symplectic._expectation.estimate.estimate import combined_results
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

from ..problems import kubo_terms
from .cells import arguments, Cell, estimate, exact


KEY = jr.key(0)
Y0 = (jnp.array(0.0), jnp.array(1.0))
WEAK = ds.WeakBrownianPath((), KEY)


def _harmonic(t, p, q, args):
    return (p**2 + q**2) / 2


PARAMETRIC = ds.hamiltonian_terms(_harmonic, lambda t, p, q, args: q**2 / 2, WEAK)
ENERGY = lambda t, y, args: y[0] ** 2 + y[1] ** 2


def _energy(s: float, h: float, steps: int) -> float:
    """The mean of p^2 + q^2 from (0, 1), by second moments."""
    terms = ds.hamiltonian_terms(_harmonic, lambda t, p, q, args: s * q**2 / 2, WEAK)
    one = ds.second_moment_map(terms, ds.StormerVerlet(), 0.0, h, Y0)
    z = np.array([1.0, 0.0, 1.0])
    end = np.linalg.matrix_power(np.asarray(one), steps) @ np.kron(z, z)
    return end[4] + end[8]


@pytest.mark.slow
def test_rare_paths_that_carry_the_mean_are_not_lost():
    got = ds.expectation(
        ENERGY, PARAMETRIC, ds.StormerVerlet(), 0.0, 5.0, 0.05, Y0, key=jr.key(1),
        levels=1,
    )  # fmt: skip
    exact = _energy(1.0, 0.05, 100)
    assert abs(exact - 10.689544) < 1e-6
    assert abs(got.mean - exact) <= 4 * got.std_error < 1e-11


@pytest.mark.parametrize("size", [1e-21, 1e-19, 1e15, 1e30])
def test_single_precision_knows_the_spread_of_small_and_large_numbers(size):
    size = jnp.float32(size)
    fn = lambda scale: lambda key: scale * (1 + jr.normal(key, (), jnp.float32))
    run = lambda scale, **kwargs: ds.monte_carlo(
        fn(scale), key=KEY, num_paths=4000, batch_size=1000, **kwargs
    )
    one, got = run(jnp.float32(1)), run(size)
    np.testing.assert_allclose(got.std_error / float(size), one.std_error, rtol=1e-5)
    np.testing.assert_allclose(got.mean / float(size), one.mean, rtol=1e-5)
    with pytest.warns(UserWarning, match="was not reached"):
        assert run(size, tol=0.01 * float(size)).num_paths == 4000


@pytest.mark.slow
def test_an_expectation_in_single_precision_does_not_know_units():
    f4 = jax.ShapeDtypeStruct((), jnp.float32)
    terms = kubo_terms(ds.WeakBrownianPath(f4, KEY))
    y0 = tuple(x.astype(jnp.float32) for x in Y0)
    energy = lambda t, y, scale: scale * y[1] ** 2
    run = lambda scale: ds.expectation(
        energy, terms, ds.ImplicitMidpoint(), 0.0, 1.0, 0.25, y0, jnp.float32(scale),
        key=KEY, sampling=ds.IndependentPaths(1000),
    )  # fmt: skip
    one, got = run(1.0), run(1e-21)
    np.testing.assert_allclose(got.std_error, 1e-21 * one.std_error, rtol=1e-5)
    with pytest.warns(UserWarning, match="underflows float32"):
        run(1e-36)


def test_an_indicator_that_no_path_meets_is_told():
    with pytest.warns(UserWarning, match="indicator of a rare event"):
        ds.monte_carlo(lambda key: jr.normal(key) > 9, key=KEY, num_paths=100)


def test_few_samples_that_make_up_for_the_spread_widen_it_and_are_told():
    heavy = lambda key: jnp.exp(5 * jr.normal(key))
    with pytest.warns(UserWarning, match="One path in 2,000 accounts for"):
        got = ds.monte_carlo(heavy, key=KEY, num_paths=2000)
    assert got.std_error > 1.3 * np.sqrt(got.variance / 2000)
    light = ds.monte_carlo(jr.normal, key=KEY, num_paths=2000)
    np.testing.assert_allclose(light.std_error, np.sqrt(light.variance / 2000))


def _with_control(shift: float, spread: float = 1.0):
    """Standard normal numbers, less a control that has the mean `shift`."""

    def sampler(keys):
        x = jax.vmap(jr.normal)(keys)
        control = spread * x + shift
        own, plain, control = (
            value[None, :, None] for value in (x - control, x, control)
        )
        averaged = Averaged(own, plain=plain, control=control)
        return Samples(averaged, jnp.ones(len(keys), bool), jnp.zeros((1, len(keys))))

    plan = SamplingPlan(
        jax.tree_util.Partial(sampler),
        Outputs(Layout.of(0.0), levels=1, dtype="float64"),
        num_samples=1000,
        batch_size=250,
    )
    return run(plan, KEY, tuple(jax.devices()[:1]))


def test_a_control_whose_mean_is_not_zero_is_dropped():
    # What is left is an eighth of the noise, and the whole mean of the control.
    fine, biased = _with_control(0.0, 0.875), _with_control(0.5, 0.875)
    plain = ds.monte_carlo(jr.normal, key=KEY, num_paths=1000)
    assert not combined_results(fine, Combination.BEST).dropped
    assert combined_results(biased, Combination.BEST).dropped
    np.testing.assert_allclose(fine.std_error, plain.std_error / 8, rtol=1e-12)
    np.testing.assert_allclose(biased.mean, plain.mean, rtol=1e-12)
    np.testing.assert_allclose(biased.std_error, plain.std_error, rtol=1e-12)
    assert _with_control(np.nan).mean == biased.mean
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
    # Of exp(q) with multiplicative noise the mean is not known.
    hits = hits[[0, 1, 3]] if noise == "multiplicative" else hits
    # So few hits have the probability of four standard errors of a normal variable.
    assert np.all(stats.binom.cdf(hits, 40, 0.95) > stats.norm.cdf(-4)), hits


def test_heavy_tails_within_replicates_widen_the_standard_error_and_are_told():
    # A batch is one replicate, the spread of which is zero.
    cell = Cell("multiplicative", 1.0, 5.0, steps=10)
    with pytest.warns(UserWarning, match="One path in 256 accounts for"):
        got = estimate(cell, ds.ArrayRQMC(256, 16), 0)
    assert got.std_error[1] > 1.3 * np.sqrt(got.variance[1] / 16)
    np.testing.assert_allclose(got.std_error[3], np.sqrt(got.variance[3] / 16))
