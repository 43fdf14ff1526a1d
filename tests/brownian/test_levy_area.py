"""The law of Lévy areas, exact moments first, and areas over cells."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import FineSample, Given


N = 200_000


@pytest.mark.parametrize("terms", [0, 8])
def test_areas_have_the_covariances_and_kurtosis_of_the_law(terms):
    h = 0.5

    def draw(key):
        k_path, k_area = jr.split(key)
        path = ds.FixedStepBrownianPath((3,), k_path, diffrax.SpaceTimeLevyArea)
        path = ds.LevyAreaBrownianPath(path, k_area, num_terms=terms)
        return path.evaluate(0.0, h, use_levy=True)

    # Of a step for which `W` has the variance 1.
    of_step = jax.jit(jax.vmap(draw))(jr.split(jr.key(1), N))
    W = of_step.W / np.sqrt(h)
    H = of_step.H / np.sqrt(h)
    A = of_step.A / h
    np.testing.assert_allclose(A, -np.swapaxes(A, 1, 2), atol=1e-14)
    a, b = A[:, 0, 1], A[:, 0, 2]
    bridge = H[:, 0] * W[:, 1] - H[:, 1] * W[:, 0]
    # Lévy's area has the characteristic function 1 / cosh(u / 2): E A^4 = 5 / 16. Given W,
    # E(A_01^2) = 1 / 12 + (W_0^2 + W_1^2) / 12 and E(A_01 A_02) = W_1 W_2 / 12.
    for sample, exact in (
        (a, 0),
        (a**2, 1 / 4),
        (a * b, 0),
        (a**4, 5 / 16),
        (a**2 * W[:, 0] ** 2, 1 / 12 + (3 + 1) / 12),
        (a * b * W[:, 1] * W[:, 2], 1 / 12),
        (a * W[:, 0] * W[:, 1], 0),
        (a * bridge, 2 / 12),
        (H[:, 0] ** 2, 1 / 12),
        (H[:, 0] * W[:, 0], 0),
    ):
        assert abs(np.mean(sample) - exact) <= 4 * np.std(sample) / np.sqrt(N)


def test_bridge_areas_have_their_moments_given_the_integral():
    # Given W and H the area A_01 has the mean H_0 W_1 - H_1 W_0 and the variance
    # 1 / 20 + (H_0^2 + H_1^2) / 5, and Cov(A_01, A_02) = H_1 H_2 / 5 (Davie; Foster).
    n = 100_000
    W, H = jnp.array([0.7, -1.0, 0.4]), jnp.array([0.3, -0.5, 0.2])

    def draw(key):
        path = ds.LevyAreaBrownianPath(Given(W, H), key, num_terms=3)
        return path.evaluate(0.0, 1.0, use_levy=True).A

    A = jax.jit(jax.vmap(draw))(jr.split(jr.key(0), n))
    mean = np.outer(H, W) - np.outer(W, H)
    a, b = (A[:, 0, k] - mean[0, k] for k in (1, 2))
    for sample, exact in (
        (a, 0),
        (a**2, 1 / 20 + (H[0] ** 2 + H[1] ** 2) / 5),
        (a * b, H[1] * H[2] / 5),
    ):
        assert abs(np.mean(sample) - exact) <= 4 * np.std(sample) / np.sqrt(n)


def test_areas_over_cells_follow_chens_rule():
    sample = FineSample.draw(jr.key(0), 32, 3)
    path = ds.LevyAreaBrownianPath(sample, jr.key(1), num_terms=2, cell=1 / 16)
    evaluate = jax.jit(lambda a, b: path.evaluate(a, b, use_levy=True))
    whole = evaluate(0.25, 0.75)
    left, right = evaluate(0.25, 0.5), evaluate(0.5, 0.75 + 1e-12)
    outer = np.outer(left.W, right.W)
    expected = left.A + right.A + (outer - outer.T) / 2
    np.testing.assert_allclose(whole.A, expected, atol=1e-14)
    np.testing.assert_allclose(whole.W, left.W + right.W, atol=1e-14)
    # Increments and space-time areas are those of the path inside.
    direct = sample.evaluate(0.25, 0.75, use_levy=True)
    np.testing.assert_allclose(whole.W, direct.W, atol=1e-14)
    np.testing.assert_allclose(whole.H, direct.H, atol=1e-14)
    # The start, the end, the end by a little, and the order of the two.
    for t0, t1 in ((0.2, 0.75), (0.25, 0.7), (0.25, 0.7505), (0.75, 0.25)):
        with pytest.raises(Exception, match="multiples of `cell`"):
            evaluate(t0, t1)


def test_one_noise_has_no_area():
    inside = Given(jnp.array([0.7]), jnp.array([0.3]))
    path = ds.LevyAreaBrownianPath(inside, jr.key(0), num_terms=1)
    np.testing.assert_array_equal(path.evaluate(0.0, 1.0, use_levy=True).A, [[0.0]])
