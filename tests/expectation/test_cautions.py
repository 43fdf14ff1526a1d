"""What is printed and told of an estimate says what, where and when."""

import re
import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.estimate.estimate import _rounded
from diffrax_symplectic._expectation.out_of_range import out_of_range

from .steps import problem_of


KEY = jr.key(0)


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
