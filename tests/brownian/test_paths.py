"""The laws of the increments, and that they are the same whenever a step is computed."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.extend.random import threefry_2x32

import diffrax_symplectic as ds
from diffrax_symplectic._brownian.random import (
    _threefry,
    AREA_WORDS,
    place_of,
    PLATEAU_WORDS,
    random_words,
)

from ..problems import FineSample, weak_path


@pytest.mark.core
def test_sampled_moments_are_within_four_standard_errors():
    n, h = 200_000, 0.3
    path = weak_path(2, second=True, two_point=True)
    t = h * jnp.arange(n)
    inc = jax.vmap(lambda t: path.evaluate(t, t + h, use_levy=True))(t)
    x = np.concatenate([inc.W, inc.second, inc.two_point], axis=1) / np.sqrt(h)
    three = lambda k: 0 if k % 2 else 3 ** (k / 2) / 3
    two = lambda k: 0 if k % 2 else 1
    laws = [three] * 4 + [two] * 2

    def check(sample, mean, second):
        error = np.sqrt(max(second - mean**2, 0) / n)
        assert abs(sample.mean() - mean) <= 4 * error + 1e-10

    for i, law in enumerate(laws):
        for k in (1, 2, 3, 4):
            check(x[:, i] ** k, law(k), law(2 * k))
        # Independent of the other variables and of the next step.
        for j in range(i):
            check(x[:, i] * x[:, j], 0, 1)
        shifted = x[1:, i] * x[:-1, i]
        assert abs(shifted.mean()) <= 4 / np.sqrt(n)


def test_asking_for_more_does_not_change_the_increment():
    inc = weak_path(2).evaluate(0.0, 0.1, use_levy=True)
    assert inc.second is None and inc.two_point is None
    more = weak_path(2, second=True, two_point=True)
    for t in (0.0, 0.7):
        np.testing.assert_array_equal(
            weak_path(2).evaluate(t, t + 0.1), more.evaluate(t, t + 0.1)
        )


# The sizes follow the step; which of the three values it is, is what is random.
_signs = jax.jit(jax.vmap(lambda t0, t1: jnp.sign(weak_path(40).evaluate(t0, t1))))


@pytest.mark.parametrize("dtype, share", [(np.float32, 0.99), (np.float64, 1)])
@pytest.mark.core
def test_increments_do_not_depend_on_the_rounding_of_time(dtype, share):
    n = 400
    for start, h in itertools.product(
        (0.0, 0.5, -2.0, 0.005), (0.01, 2**-6, 0.1, 1 / 3)
    ):
        ts = (start + h * np.arange(n + 1)).astype(dtype)
        W = np.asarray(_signs(ts[:-1], ts[1:]))
        nudged = [np.nextafter(ts, end, dtype=dtype) for end in (np.inf, -np.inf)]
        same = [_signs(a[:-1], b[1:]) == W for a in nudged for b in nudged]
        # In single precision, one step in many thousands may sit at the edge of a count.
        assert np.mean(np.all(same, axis=(0, 2))) >= share
        # Two steps share 40 increments with probability 2^-40, if independent.
        assert len(np.unique(W, axis=0)) == n


@pytest.mark.core
def test_steps_of_a_long_solve_all_differ():
    ts = np.linspace(0, 1e4, 10**6 + 1)
    picks = np.concatenate([np.arange(500), 10**6 - 500 + np.arange(500)])
    assert len(np.unique(_signs(ts[picks], ts[picks + 1]), axis=0)) == 1000
    # Even where single precision hardly resolves them.
    for start, h in ((1e5, 0.01), (-1e5, 0.005), (2e4, 0.001)):
        # The sizes of these steps are one or two units in the last place of their times.
        ts = np.unique((start + h * np.arange(500)).astype(np.float32))
        assert np.max(np.diff(ts)) <= 2 * np.spacing(np.float32(abs(start)))
        assert len(np.unique(_signs(ts[:-1], ts[1:]), axis=0)) == len(ts) - 1


def test_path_takes_any_pytree_under_jit_and_vmap():
    shape = {
        "a": jax.ShapeDtypeStruct((2, 3), jnp.float32),
        "b": (jax.ShapeDtypeStruct((), jnp.float64),),
    }

    @jax.jit
    @jax.vmap
    def evaluate(key):
        path = ds.WeakBrownianPath(shape, key, second=True, two_point=True)
        return path.evaluate(0.0, 0.1, use_levy=True)

    inc = evaluate(jr.split(jr.key(0), 5))
    for part in (inc.W, inc.second, inc.two_point):
        assert part["a"].shape == (5, 2, 3) and part["a"].dtype == jnp.float32
        assert part["b"][0].shape == (5,) and part["b"][0].dtype == jnp.float64
    # An increment from 0 can be had by its end alone, as from Diffrax's paths.
    path = ds.WeakBrownianPath(shape, jr.key(0))
    at_end, over_step = path.evaluate(0.1), path.evaluate(0.0, 0.1)
    jax.tree.map(np.testing.assert_array_equal, at_end, over_step)


def test_half_steps_work_where_the_path_can_be_refined():
    H0 = lambda t, p, q, args: p**2 / 2 + q**4 / 4
    noise = lambda t, p, q, args: jnp.stack([jnp.sin(q)])
    terms = ds.hamiltonian_terms(H0, noise, FineSample.draw(jr.key(0), 8, 1))
    half = diffrax.HalfSolver(ds.StormerVerlet())

    @jax.jit
    def steps(*y0):
        given = terms, 0.0, 0.5, y0, None
        y1, error, *_ = half.step(*given, half.init(*given), False)
        return y1, error, ds.StormerVerlet().step(*given, None, False)[0]

    y1, error, once = steps(0.0, 1.0)
    np.testing.assert_allclose(error, np.abs(np.subtract(y1, once)), rtol=1e-12)
    assert np.min(error) > 0


def test_the_same_key_gives_the_same_path_in_every_version():
    # By hand: 1.37 h lies in [2^(e + 1), 2^(e + 2)), and the middle of the step is counted
    # in units of 2^e, shifted by 0.29.
    for step, place in (
        ((0.0, 0.25), (1, -3)),
        # On both sides of a count: 1.70 + 0.29 and 1.72 + 0.29.
        ((0.0875, 0.3375), (1, -3)),
        ((0.09, 0.34), (2, -3)),
        ((7.5, 7.75), (61, -3)),
        ((-3.0, -2.9), (-47, -4)),
        ((100.0, 101.0), (201, -1)),
        # Counts begin again after 2^31.
        ((2.0**31 + 7.5, 2.0**31 + 7.75), (61, -3)),
    ):
        assert tuple(map(int, place_of(*map(jnp.array, step)))) == place
    # The generator is that of Random123. What is recorded is how its counters are used.
    place = jnp.array(5, jnp.int32), jnp.array(-3, jnp.int32)
    first, second = [3384798094, 3537045821], [1887961620, 1291108390]
    key = jr.key(7, impl="threefry2x32")
    np.testing.assert_array_equal(random_words(key, place, 2, 2), [first, second])
    np.testing.assert_array_equal(
        random_words(key, place, 1, 2, AREA_WORDS), [[2750506793, 1201171554]]
    )


def test_random_words_are_those_of_the_generator_of_jax():
    key = np.array([2**31 + 5, 77], np.uint32)
    counters = np.random.default_rng(0).integers(0, 2**32, (2, 100), np.uint32)
    words = jnp.concatenate(_threefry(jnp.asarray(key), *jnp.asarray(counters)))
    np.testing.assert_array_equal(words, threefry_2x32(key, counters.reshape(-1)))
    # The known answer of its authors for a key and counters of zeros.
    zero = jnp.zeros((), jnp.uint32)
    words = [int(w) for w in _threefry(jnp.zeros(2, jnp.uint32), zero, zero)]
    assert words == [0x6B200159, 0x99BA4EFE]


def test_more_sets_of_words_leave_the_first_ones_and_wrappers_have_their_own():
    place = place_of(jnp.array(0.5), jnp.array(0.75))
    words = jax.jit(random_words, static_argnums=(2, 3, 4))
    for impl in ("threefry2x32", "rbg"):
        key = jr.key(3, impl=impl)
        three = words(key, place, 3, 4)
        np.testing.assert_array_equal(words(key, place, 1, 4), three[:1])
        others = words(key, place, 3, 4, PLATEAU_WORDS)
        assert len(np.unique(np.concatenate([three, others]))) == 24
    # So many noises that their pairs would reach the numbers of plateaus; and of areas as
    # many as have numbers, before those of the place that is counted next.
    key, after = jr.key(3), (place[0], place[1] + 1)
    # Of so many random words a few are equal by chance.
    for few, many in (
        (
            words(key, place, 1, 1000, PLATEAU_WORDS),
            words(key, place, 1, 2**19 + 2**11),
        ),
        (words(key, after, 1, 1000), words(key, place, 1, 2**19, AREA_WORDS)),
    ):
        assert np.sum(np.isin(few, many)) <= 10


def test_what_is_no_key_is_refused():
    tree = diffrax.UnsafeBrownianPath((2,), jr.key(0), diffrax.SpaceTimeLevyArea)
    for make in (
        lambda key: ds.WeakBrownianPath((2,), key),
        lambda key: ds.FixedStepBrownianPath((2,), key),
        lambda key: ds.PlateauBrownianPath(tree, key),
        lambda key: ds.LevyAreaBrownianPath(tree, key),
    ):
        with pytest.raises(ValueError, match="needs a random key"):
            make(0)
    with pytest.raises(ValueError, match=r"array of keys of shape \(5,\)"):
        ds.WeakBrownianPath((2,), jr.split(jr.key(0), 5)).evaluate(0.0, 0.1)
