"""Paths around others: increments that are cut off, and plateaus."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import Given, weak_path


def test_truncated_path_clips_and_keeps_the_levy_area():
    h = 0.5
    plain = ds.FixedStepBrownianPath((3,), jr.key(0), diffrax.SpaceTimeLevyArea)
    path = ds.TruncatedBrownianPath(plain, k=1)
    bound = np.sqrt(h) * np.sqrt(2 * abs(np.log(h)))

    @jax.jit
    @jax.vmap
    def evaluate(t):
        each = [x.evaluate(t, t + h, use_levy=True) for x in (plain, path)]
        return *each, path.evaluate(t, t + h)

    raw, cut, alone = evaluate(h * np.arange(1000))
    assert isinstance(cut, diffrax.SpaceTimeLevyArea)
    np.testing.assert_array_equal(raw.H, cut.H)
    np.testing.assert_allclose(cut.W, np.clip(raw.W, -bound, bound), rtol=1e-12)
    assert np.any(raw.W != cut.W)
    np.testing.assert_allclose(alone, cut.W, rtol=1e-12)
    assert path.levy_area is diffrax.SpaceTimeLevyArea
    # An empty step has none: in a batch, paths that have ended take empty steps until all
    # have. And nothing is left of increments over long steps.
    for inside in (plain, Given(jnp.array([5.0, -5.0, 1.0]))):
        path = ds.TruncatedBrownianPath(inside, k=1)
        np.testing.assert_array_equal(path.evaluate(0.5, 0.5), np.zeros(3))
    with pytest.raises(Exception, match="as long as its `unit`"):
        jax.block_until_ready(jax.jit(lambda t: path.evaluate(0.0, t))(1.0))


def test_the_bound_is_that_of_the_docstring_and_the_error_of_the_order_of_the_paper():
    gaussian = ds.FixedStepBrownianPath((3,), jr.key(0))
    # The words of the smallest, of nearly the middle, and of the largest increment.
    words = jnp.array([0, 2**31, 2**32 - 1], jnp.uint32)
    for k, h, unit in itertools.product((1, 2, 4), (1.0, 0.3), (7.0, jnp.array(20.0))):
        path = ds.TruncatedBrownianPath(gaussian, k=k, unit=unit)
        bound = np.sqrt(2 * k * np.log(unit / h))
        W = path.increment(words, 1.0, 1.0 + h) / np.sqrt(h)
        np.testing.assert_allclose(W, [-bound, 0, bound], rtol=1e-12, atol=1e-9)
        # What lies beyond the bounds, by quadrature.
        x = np.linspace(bound, bound + 20, 200_001)
        density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        assert 2 * np.trapezoid((x - bound) ** 2 * density, x) <= (h / unit) ** k


def test_what_cannot_be_wrapped_is_refused():
    gaussian = ds.FixedStepBrownianPath((), jr.key(0))
    for unit in (0.0, -1.0, np.inf, np.nan, jnp.ones(2), "s"):
        with pytest.raises(ValueError, match="`unit` must be a positive number"):
            ds.TruncatedBrownianPath(gaussian, unit=unit)
    for k in (0, -1, 1.5, True, None):
        with pytest.raises(ValueError, match="`k` must be a positive integer"):
            ds.TruncatedBrownianPath(gaussian, k=k)
    with pytest.raises(ValueError, match="wraps a Brownian path"):
        ds.TruncatedBrownianPath(lambda t0, t1: 0.0)  # pyright: ignore
    with pytest.raises(ValueError, match="already bounded"):
        ds.TruncatedBrownianPath(weak_path(2))
    for wrapper in (ds.PlateauBrownianPath, ds.LevyAreaBrownianPath):
        with pytest.raises(ValueError, match="needs a path with space-time"):
            wrapper(weak_path(2), jr.key(0))
    tree = ds.FixedStepBrownianPath((1,), jr.key(0), diffrax.SpaceTimeLevyArea)
    with pytest.raises(ValueError, match="`num_terms` must be"):
        ds.LevyAreaBrownianPath(tree, jr.key(0), num_terms=-1)
    with pytest.raises(ValueError, match="`cell` must be"):
        ds.LevyAreaBrownianPath(tree, jr.key(0), cell=0.0)


def test_plateaus_are_fair_and_have_the_mean_square_of_the_path():
    h = 0.25
    tree = diffrax.UnsafeBrownianPath((100_000,), jr.key(0), diffrax.SpaceTimeLevyArea)
    path = ds.PlateauBrownianPath(tree, jr.key(1))
    first = path.evaluate(0.0, h, use_levy=True)
    again = path.evaluate(1e-12, h, use_levy=True)
    np.testing.assert_array_equal(np.sign(first.C), np.sign(again.C))
    # The parabola through what is known of the path, and the mean square of the rest,
    # h / 2 - h (1 / 3 + 1 / 10).
    points, weights = np.polynomial.legendre.leggauss(3)
    u = (1 + points[:, None]) / 2
    parabola = first.W * u + 6 * first.H * u * (1 - u)
    mean, square = (weights / 2 @ x for x in (parabola, parabola**2))
    np.testing.assert_allclose(mean**2 + first.C**2, square + h / 15, rtol=1e-12)
    assert abs(np.mean(first.C**2) - h / 6) <= 4 * np.std(first.C**2) / np.sqrt(100_000)
    bound = 4 * np.sqrt(h / 6) / np.sqrt(100_000)
    assert abs(np.mean(first.C)) <= bound
    later = path.evaluate(h, 2 * h, use_levy=True)
    for other in (first.W, first.H, later.C):
        assert abs(np.mean(first.C * other)) <= bound * np.std(other)
