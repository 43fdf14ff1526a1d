"""Gaussian increments for fixed steps: their law, and that they are those of one motion."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from scipy import special

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import random as words
from diffrax_symplectic._brownian.random import normal_from_words
from diffrax_symplectic._solver import common_path


AREA = diffrax.SpaceTimeLevyArea


def _words():
    """The ends of all octaves of words, and many between them."""
    ends = 2.0 ** np.arange(32)[:, None] * np.linspace(1, 2, 64, endpoint=False)
    low = np.unique(np.concatenate([[0], ends.ravel()]).astype(np.uint64))
    low = low[low < 2**31]
    return np.unique(np.concatenate([low, 2**32 - 1 - low])).astype(np.uint32)


@pytest.mark.parametrize("dtype, rtol", [(jnp.float64, 1e-8), (jnp.float32, 1e-6)])
def test_each_word_has_its_quantile(dtype, rtol):
    words = _words()
    got = np.asarray(normal_from_words(jnp.asarray(words), dtype))
    assert got.dtype == dtype
    # XLA rounds the logarithms of full vectors and of the rest differently.
    np.testing.assert_allclose(got, -got[::-1], rtol=4 * jnp.finfo(dtype).eps)
    # By the smaller of the two probabilities, which has all digits.
    low = np.minimum(words, ~words).astype(float)
    tail = -special.ndtri((low + 0.5) / 2**32)
    middle = np.sqrt(2) * special.erfinv((2**31 - low - 0.5) / 2**31)
    exact = np.where(low > 2**30, middle, tail) * np.where(words < 2**31, -1, 1)
    np.testing.assert_allclose(got, exact, rtol=rtol)
    # Neighbours, too, are in order.
    near = np.unique((words[:, None] + np.arange(3, dtype=np.uint32)).ravel())
    steps = np.diff(np.asarray(normal_from_words(jnp.asarray(near), jnp.float64)))
    assert np.all(steps > 0)


def test_sampled_steps_and_noises_are_independent_with_the_right_variance():
    # Each word has its quantile, so that all of the law is right if two moments are.
    n, h = 100_000, 0.3
    path = ds.FixedStepBrownianPath((2,), jr.key(5), AREA)
    t = h * jnp.arange(n)
    inc = jax.vmap(lambda t: path.evaluate(t, t + h, use_levy=True))(t)
    x = np.concatenate([inc.W, np.sqrt(12) * inc.H], axis=1) / np.sqrt(h)
    products = [x[:, i] * x[:, j] for i in range(4) for j in range(i)]
    products += [x[1:, i] * x[:-1, j] for i in range(4) for j in range(4)]
    for sample in (x, *products):
        assert np.all(np.abs(sample.mean(axis=0)) <= 4 / np.sqrt(n))
    assert np.all(np.abs((x**2).mean(axis=0) - 1) <= 4 * np.sqrt(2 / n))
    plain = ds.FixedStepBrownianPath((2,), jr.key(5))
    np.testing.assert_array_equal(plain.evaluate(t[7], t[7] + h), inc.W[7])


def test_steps_of_cells_are_sums_and_areas_of_one_motion():
    cell = 2.0**-4
    dtype = np.float32
    shape = {
        "a": jax.ShapeDtypeStruct((2,), dtype),
        "b": jax.ShapeDtypeStruct((), dtype),
    }
    path = ds.FixedStepBrownianPath(shape, jr.key(0), AREA, cell=cell)
    evaluate = jax.jit(lambda t0, t1: path.evaluate(t0, t1, use_levy=True))
    flat = lambda x: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(x)])
    t = dtype(-0.25) + cell * np.arange(9, dtype=dtype)
    cells = [evaluate(a, b) for a, b in zip(t[:-1], t[1:])]
    w = np.array([flat(c.W) for c in cells])
    mean = np.array([flat(c.H) for c in cells]) + w / 2
    assert np.std(w) > 0.1
    whole = evaluate(t[0], t[-1])
    # The mean of the path over the step is that of its means over the cells.
    before = np.concatenate([np.zeros((1, 3)), np.cumsum(w, axis=0)[:-1]])
    area = np.mean(before + mean, axis=0) - w.sum(axis=0) / 2
    np.testing.assert_allclose(flat(whole.W), w.sum(axis=0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(flat(whole.H), area, rtol=1e-5, atol=1e-7)
    assert whole.W["b"].dtype == whole.H["a"].dtype == whole.dt["a"].dtype == dtype
    np.testing.assert_array_equal(flat(path.evaluate(t[0], t[-1])), flat(whole.W))
    assert not np.any(flat(evaluate(t[2], t[2])))
    with pytest.raises(Exception, match="`FixedStepBrownianPath` with `cell` must beg"):
        jax.block_until_ready(evaluate(t[0], t[0] + dtype(1.5 * cell)))


def test_wrappers_make_the_same_step_from_words_as_from_keys():
    t0, t1, key = jnp.array(0.5), jnp.array(0.75), jr.key(7)
    at = words.place_of(t0, t1)
    path = ds.FixedStepBrownianPath((2,), key, AREA)
    own = words.random_words(key, at, 2, 2).reshape(-1)
    more = lambda n, begin: words.random_words(key, at, 1, n, begin)[0]
    areas = ds.LevyAreaBrownianPath(path, key, num_terms=1)
    plateaus = ds.PlateauBrownianPath(path, key)
    # The signs are the first bits: those of the words that the path takes are others.
    assert np.all(more(2, 0) >> 31 != more(2, words.PLATEAU_WORDS) >> 31)
    for wrapped, given in (
        (ds.TruncatedBrownianPath(path, k=1), own),
        (plateaus, jnp.append(own, more(2, words.PLATEAU_WORDS))),
        (ds.TruncatedBrownianPath(areas), jnp.append(own, more(9, words.AREA_WORDS))),
    ):
        assert wrapped.num_words(use_levy=True) == len(given)
        assert wrapped.num_words() == 2
        expected, got, W, evaluated, back = jax.jit(
            lambda given, t0, t1, wrapped=wrapped: (
                wrapped.evaluate(t0, t1, use_levy=True),
                wrapped.increment(given, t0, t1, use_levy=True),
                wrapped.increment(given[:2], t0, t1),
                wrapped.evaluate(t0, t1),
                wrapped.evaluate(t1, t0, use_levy=True),
            )
        )(given, t0, t1)
        assert type(got) is type(expected) is wrapped.levy_area
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected)):
            np.testing.assert_allclose(a, b, rtol=1e-14)
        np.testing.assert_allclose(W, evaluated, rtol=1e-14)
        # From its end to its start it is the same step.
        assert (expected.dt, back.dt) == (t1 - t0, t0 - t1)
        for name in {"W", "H", "sign", "C", "A"} & {*dir(back)}:
            a, b = getattr(back, name), getattr(expected, name)
            np.testing.assert_allclose(a, b, rtol=1e-12)


def test_bad_arguments_are_refused():
    make = ds.FixedStepBrownianPath
    with pytest.raises(ValueError, match="`levy_area` must be"):
        make((), jr.key(0), diffrax.SpaceTimeTimeLevyArea)  # pyright: ignore
    assert type(make((), jr.key(0), cell=jnp.array(0.5)).cell) is float
    for wrong in (0.0, np.nan, np.inf, jnp.ones(1), "1"):
        with pytest.raises(ValueError, match="`cell` must be a positive number"):
            make((), jr.key(0), cell=wrong)  # pyright: ignore
    with pytest.raises(ValueError, match="that is not traced"):
        jax.eval_shape(lambda cell: make((), jr.key(0), cell=cell), 0.5)
    with pytest.raises(ValueError, match="real floating-point"):
        make(jax.ShapeDtypeStruct((), jnp.int32), jr.key(0))


def test_steps_shorter_than_the_tolerance_of_a_tree_are_an_error():
    # The tree would interpolate, and the noise have a fraction of its variance.
    tree = diffrax.VirtualBrownianTree(0.0, 4.0, 0.1, (), jr.key(0))
    terms = ds.noise_terms(lambda t, p, q, args: q, ds.TruncatedBrownianPath(tree))

    @eqx.filter_jit
    def step(h):
        given = terms, 1.0, 1.0 + h, (0.0, 1.0), None, None, False
        return ds.StormerVerlet().step(*given)[0]

    assert jnp.isfinite(step(jnp.array(0.1))[0])
    with pytest.raises(Exception, match="Pass a smaller `tol`"):
        jax.block_until_ready(step(jnp.array(0.09)))


@pytest.mark.parametrize(
    "solver", [ds.PlateauVerlet(), ds.LevyAreaMidpoint()], ids=repr
)
def test_a_cell_that_is_an_array_gives_the_same_motion(solver):
    cell, key = 0.125, jr.key(4)
    paths = [common_path(solver, x, (3,), key) for x in (cell, np.asarray(cell))]

    @jax.jit
    def both(t0, t1):
        return [path.evaluate(t0, t1, use_levy=True) for path in paths]

    exact, got = map(jax.tree.leaves, both(0.5, 0.5 + 4 * cell))
    for x, y in zip(got, exact, strict=True):
        np.testing.assert_array_equal(x, y)
