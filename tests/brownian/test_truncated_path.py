"""Increments that are cut off: their bound, their error, and bad input."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import Given


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("h", [0.2, 0.01, 1e-4])
def test_truncation_error_is_below_its_bound(k, h):
    # E[(xi - clip xi)^2] by quadrature over the tail.
    bound = np.sqrt(2 * k * abs(np.log(h)))
    x = np.linspace(bound, bound + 20, 200_001)
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    assert 2 * np.trapezoid((x - bound) ** 2 * density, x) <= h**k


def test_truncated_path_clips_and_keeps_the_levy_area():
    h = 0.5
    plain = diffrax.UnsafeBrownianPath(
        (3,), jr.key(0), levy_area=diffrax.SpaceTimeLevyArea
    )
    path = ds.TruncatedBrownianPath(plain, k=1)
    bound = np.sqrt(h) * np.sqrt(2 * abs(np.log(h)))
    t = h * jnp.arange(1000)
    get = lambda p: jax.vmap(lambda t: p.evaluate(t, t + h, use_levy=True))(t)
    raw, cut = get(plain), get(path)
    assert isinstance(cut, diffrax.SpaceTimeLevyArea)
    np.testing.assert_array_equal(raw.H, cut.H)
    np.testing.assert_allclose(cut.W, np.clip(raw.W, -bound, bound), rtol=1e-12)
    assert np.any(raw.W != cut.W)
    np.testing.assert_allclose(
        jax.vmap(lambda t: path.evaluate(t, t + h))(t), cut.W, rtol=1e-12
    )
    assert path.levy_area is diffrax.SpaceTimeLevyArea
    np.testing.assert_array_equal(path.evaluate(0.3, 0.3), np.zeros(3))


@pytest.mark.parametrize("k", [1, 2, 4])
def test_truncation_bound_is_that_of_the_docstring(k):
    path = ds.TruncatedBrownianPath(ds.FixedStepBrownianPath((3,), jr.key(0)), k=k)
    # The words of the smallest, of nearly the middle, and of the largest increment.
    words, h = jnp.array([0, 2**31, 2**32 - 1], jnp.uint32), 0.5
    bound = np.sqrt(2 * k * h * np.log(2))
    W = path.increment(words, 1.0, 1.0 + h)
    np.testing.assert_allclose(W, [-bound, 0, bound], rtol=1e-14, atol=1e-9)


@pytest.mark.parametrize("unit", [2.0, 1e6, jnp.array(3e-4)])
def test_a_change_of_the_unit_of_time_scales_increments(unit):
    gaussian = ds.FixedStepBrownianPath((3,), jr.key(0))
    words = jnp.array([0, 2**30, 2**32 - 1], jnp.uint32)
    cut = ds.TruncatedBrownianPath(gaussian, k=1).increment(words, 0.0, 0.5)
    path = ds.TruncatedBrownianPath(gaussian, k=1, unit=unit)
    same = jax.jit(lambda unit: path.increment(words, 0.0, 0.5 * unit))(unit)
    np.testing.assert_allclose(same, cut * np.sqrt(unit), rtol=1e-14)


@pytest.mark.parametrize("k", [1, 2, 4])
def test_the_error_in_any_unit_converges_at_the_order_of_the_paper(k):
    unit = 7.0
    for h in (1.0, 0.3, 0.1):
        path = ds.TruncatedBrownianPath(
            ds.FixedStepBrownianPath((2,), jr.key(0)), k=k, unit=unit
        )
        words = jnp.array([0, 2**32 - 1], jnp.uint32)
        bound = path.increment(words, 0.0, h)[1] / np.sqrt(h)
        x = np.linspace(bound, bound + 20, 200_001)
        density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        assert 2 * np.trapezoid((x - bound) ** 2 * density, x) <= (h / unit) ** k


@pytest.mark.parametrize("unit", [0.0, -1.0, np.inf, np.nan, jnp.ones(2), "s"])
def test_the_unit_must_be_a_positive_number(unit):
    with pytest.raises(ValueError, match="`unit` must be a positive number"):
        ds.TruncatedBrownianPath(ds.FixedStepBrownianPath((), jr.key(0)), unit=unit)


@pytest.mark.parametrize("k", [0, -1, 1.5, True, None])
def test_truncation_needs_a_positive_integer(k):
    with pytest.raises(ValueError, match="`k` must be a positive integer"):
        ds.TruncatedBrownianPath(diffrax.UnsafeBrownianPath((), jr.key(0)), k=k)


def test_truncation_needs_a_path():
    with pytest.raises(ValueError, match="wraps a Brownian path"):
        ds.TruncatedBrownianPath(lambda t0, t1: 0.0)  # pyright: ignore
    with pytest.raises(ValueError, match="already bounded"):
        ds.TruncatedBrownianPath(ds.WeakBrownianPath((), jr.key(0)))


def test_nothing_is_left_of_increments_over_long_steps():
    path = ds.TruncatedBrownianPath(diffrax.UnsafeBrownianPath((), jr.key(0)))
    with pytest.raises(Exception, match="as long as its `unit`"):
        jax.block_until_ready(jax.jit(lambda t: path.evaluate(0.0, t))(1.0))


def test_an_empty_step_has_no_increment():
    # In a batch, paths that have ended take empty steps until all have.
    path = ds.TruncatedBrownianPath(Given(jnp.array([5.0, -5.0])), k=1)
    np.testing.assert_array_equal(path.evaluate(0.5, 0.5), [0.0, 0.0])
