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

from .cells import arguments, Cell, exact
from .steps import sampled


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
