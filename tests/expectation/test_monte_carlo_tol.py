"""How far an expectation goes: tolerances, levels, progress, and numbers of paths
beyond 32 bits."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import RecordingMeter


def _number(key):
    """Which word the key has: no two paths share it."""
    return jr.bits(key, (), jnp.uint32).astype(float)


def test_keys_of_paths_beyond_32_bits_carry_into_the_second_word():
    key, n, first = jr.key(7), 10, 2**33 - 4
    got = ds.monte_carlo(_number, key=key, num_paths=n, batch_size=n, first=first)
    words = [divmod(i, 2**32) for i in range(first, first + n)]
    keys = [jr.fold_in(jr.fold_in(key, hi), np.uint32(lo)) for hi, lo in words]
    x = np.array([_number(k) for k in keys])
    assert {hi for hi, _ in words} == {1, 2}
    assert (got.num_paths, got.num_failed) == (n, 0)
    np.testing.assert_allclose(got.mean, x.mean(), rtol=1e-14)
    np.testing.assert_allclose(got.variance, x.var(ddof=1), rtol=1e-12)


def test_progress_is_shown_after_each_batch_and_closed_in_any_case():
    calls = []
    run = lambda meter: ds.monte_carlo(
        jr.normal, key=jr.key(0), num_paths=10, batch_size=4, progress_meter=meter
    )
    run(RecordingMeter(calls))
    assert calls == ["init", 0.4, 0.8, 1.0, ("closed after", 3)]
    calls.clear()
    with pytest.raises(RuntimeError, match="stop here"):
        run(RecordingMeter(calls, fails_at=1))
    assert calls == ["init", 0.4, 0.8, ("closed after", 1)]


def _two(key):
    x = jr.normal(key, (2,))
    return {"small": 1e-3 * x[0], "large": x}


def test_paths_are_added_until_every_standard_error_is_below_tol():
    def two(key):
        x = jr.normal(key, (2,))
        return {"small": 1e-3 * x[0], "large": x}

    run = lambda n, **kwargs: ds.monte_carlo(
        two, key=jr.key(3), num_paths=n, batch_size=500, **kwargs
    )
    tol = 0.02
    got = run(100_000, tol=tol)
    # 2,500 paths are about enough for a deviation of 1; one batch more is under way.
    assert 2_000 <= got.num_paths <= 4_000 and got.num_paths % 500 == 0
    assert got.tol_reached and np.all(got.std_error["large"] <= tol)
    before = run(got.num_paths - 1_000)
    assert before.tol_reached is None and np.any(before.std_error["large"] > tol)
    whole = run(got.num_paths)
    np.testing.assert_array_equal(got.mean["large"], whole.mean["large"])
    with pytest.warns(
        UserWarning, match="`tol=0.02` was not reached: .* 1,000 p"
    ) as told:
        short = run(1_000, tol=tol)
    needed = 1_000 * (np.max(short.std_error["large"]) / tol) ** 2
    assert f"takes about {needed:.1e} paths" in str(told[0].message)
    assert short.tol_reached is False and "`tol` was not reached" in str(short)
    assert short.num_paths == 1_000
    # It goes on from there, and not at all where nothing is left to do.
    on = run(100_000, tol=tol, start=short)
    assert on.tol_reached and on.num_paths == got.num_paths
    assert run(100_000, tol=tol, start=on).num_paths == on.num_paths


def test_levels_of_a_sample_share_its_key_and_go_on_where_they_stopped():
    def fn(key, level):
        return (1 + 0.1 * 0.5**level) * jr.normal(key)

    run = lambda n, start=None: ds.monte_carlo(
        fn, key=jr.key(0), num_paths=n, levels=2, order=1, start=start
    )
    got = run(1000)
    one = ds.monte_carlo(jr.normal, key=jr.key(0), num_paths=1000)
    np.testing.assert_allclose(got.mean, one.mean, rtol=1e-12)
    # The mean of the finer level less the extrapolated one.
    np.testing.assert_allclose(got.bias, 0.05 * one.mean, rtol=1e-12)
    np.testing.assert_allclose(got.bias_std_error, 0.05 * one.std_error, rtol=1e-12)
    np.testing.assert_allclose(got.error, np.hypot(got.std_error, got.bias))
    parts = (
        f"sampling {got.std_error:.1e}, discretization {got.discretization_error:.1e}"
    )
    assert f"± {got.error:.1e} ({parts})" in str(got)
    low, high = got.interval(0.5)
    assert high - low > got.error
    rest = run(1000, start=run(300))
    np.testing.assert_allclose(rest.mean, got.mean, rtol=1e-12)
    np.testing.assert_allclose(rest.bias, got.bias, rtol=1e-11)
    assert one.bias is None and one.bias_std_error is None
    np.testing.assert_array_equal(one.error, one.std_error)


def test_a_path_fails_if_it_does_on_one_of_the_levels():
    def phi(key, level):
        x = jr.uniform(key)
        return jnp.where((level == 1) & (x < 0.5), jnp.nan, x * (1 + level))

    got = ds.monte_carlo(phi, key=jr.key(1), num_paths=64, levels=2, order=2)
    x = np.array(
        [jr.uniform(jr.fold_in(jr.fold_in(jr.key(1), 0), i)) for i in range(64)]
    )
    assert got.num_failed == np.sum(x < 0.5) and got.num_paths == np.sum(x >= 0.5)
    # 4/3 of the finer level less 1/3 of the coarser one.
    np.testing.assert_allclose(got.mean, np.mean(x[x >= 0.5]) * 7 / 3, rtol=1e-12)


def test_an_order_of_one_half_removes_powers_of_the_root_of_the_step():
    def phi(key, level):
        h = 0.5**level
        return jr.uniform(key) + 3 * jnp.sqrt(h) - 2 * h

    got = ds.monte_carlo(phi, key=jr.key(1), num_paths=64, levels=3, order=0.5)
    exact = ds.monte_carlo(jr.uniform, key=jr.key(1), num_paths=64)
    np.testing.assert_allclose(got.mean, exact.mean, rtol=1e-12)
    np.testing.assert_allclose(got.bias, 3 * 0.5 - 2 * 0.25, rtol=1e-12)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(tol=0.0), "`tol` must be a positive number"),
        (dict(tol=float("nan")), "`tol` must be a positive number"),
        (dict(levels=2), "the weak order of the solver"),
        (dict(levels=2, order=0), "`order` must be a positive integer"),
        (dict(levels=2, order=1.5), "`order` must be a positive integer, or 1/2"),
    ],
)
def test_bad_tolerances_and_levels_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ds.monte_carlo(jr.normal, key=jr.key(0), num_paths=10, **kwargs)
