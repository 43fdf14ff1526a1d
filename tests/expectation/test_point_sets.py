"""Quasi-random points, and the order in which paths receive them."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from diffrax_symplectic._expectation.sorted.hilbert import (
    _places_on_curve,
    hilbert_order,
)
from diffrax_symplectic._expectation.sorted.points import (
    _JOE_AND_KUO,
    _sobol_points_of_scipy,
    balanced_in_sixths,
    num_seeds,
    scrambled,
    sobol_points,
)


@pytest.mark.parametrize("n", [2, 2**14])
def test_direction_numbers_are_those_of_scipy(n):
    for d in (1, len(_JOE_AND_KUO), len(_JOE_AND_KUO) + 1):
        points = _sobol_points_of_scipy(n, d)
        np.testing.assert_array_equal(sobol_points(n, d), points)


def test_points_are_a_digital_net_after_scrambling():
    n, d = 256, 2
    seeds = jr.bits(jr.key(0), (50, num_seeds(d)), jnp.uint32)
    points = jnp.asarray(sobol_points(n, d))
    words = np.asarray(jax.jit(jax.vmap(lambda s: scrambled(points, s)))(seeds))
    for k in range(1, 9):
        # 2^k consecutive points, and 2^k intervals for each coordinate.
        cells = (words >> np.uint32(32 - k)).reshape(50, -1, 2**k, d)
        cells = np.sort(cells, axis=2)
        assert np.all(cells == np.arange(2**k)[:, None])
    # The two coordinates together are one, too: 16 boxes by 16.
    boxes = (words[..., 0] >> np.uint32(28)) * 16 + (words[..., 1] >> np.uint32(28))
    assert np.all(np.sort(boxes, axis=1) == np.arange(n))
    assert len(np.unique(words[:, 0, 0])) == 50


def test_one_three_point_variable_is_balanced_among_any_six():
    n = 256
    seeds = jr.bits(jr.key(0), (4000, num_seeds(1)), jnp.uint32)
    points = jnp.asarray(sobol_points(n, 1))
    sixths = jax.jit(jax.vmap(lambda s: balanced_in_sixths(points, s)))
    words = np.asarray(sixths(seeds))[..., 0].astype(np.int64)
    signs = (words >= 2**32 - 2**32 // 6).astype(int) - (words < 2**32 // 6)
    for sign in (-1, 1):
        # Only the blocks that are cut off at the ends are not balanced.
        count = np.cumsum(signs == sign, axis=1)
        excess = np.abs(count - np.arange(1, n + 1) / 6)
        assert excess.max() <= 2
        # At each place the probability is a sixth: 4.5 standard errors of 4,000.
        at_place = np.mean(signs == sign, axis=0)
        assert np.abs(at_place - 1 / 6).max() <= 4.5 * np.sqrt(5 / 36 / 4000)
    # The seeds give different arrangements.
    assert len(np.unique(signs, axis=0)) > 3990


@pytest.mark.parametrize("d, bits", [(2, 4), (3, 3), (5, 2)])
def test_the_curve_meets_each_cell_once_and_goes_on_to_its_neighbour(d, bits):
    axes = np.meshgrid(*[np.arange(2**bits)] * d, indexing="ij")
    cells = np.stack(axes, -1).reshape(-1, d).astype(np.uint32)
    place = np.asarray(_places_on_curve([*jnp.asarray(cells).T], bits, jnp.uint64))
    np.testing.assert_array_equal(np.sort(place), np.arange(len(cells)))
    moves = np.diff(cells[np.argsort(place)].astype(int), axis=0)
    assert np.all(np.abs(moves).sum(axis=1) == 1)


@pytest.mark.parametrize("x64", [True, False])
def test_sorting_is_a_permutation_by_place_with_the_failed_ones_last(x64):
    jax.config.update("jax_enable_x64", x64)
    try:
        z = jr.normal(jr.key(0), (1000, 1), float)
        # Neither what is far away nor what is no number disturbs the others.
        z = z.at[3].set(1e30).at[5].set(jnp.nan)
        last = jnp.zeros(1000, bool).at[jnp.array([3, 5, 77])].set(True)
        order = np.asarray(jax.jit(hilbert_order)(z, last))
    finally:
        jax.config.update("jax_enable_x64", True)
    np.testing.assert_array_equal(np.sort(order), np.arange(1000))
    assert set(order[-3:]) == {3, 5, 77}
    good = np.clip(np.asarray(z)[order[:-3], 0], -2, 2)
    assert np.all(np.diff(good) > -1e-3)
