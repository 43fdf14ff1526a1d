"""One record says all about a random variable, and steps can be made from given words."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import Discrete, laws_of, VARIABLES
from diffrax_symplectic._solver.driven import drawn_variables
from diffrax_symplectic._terms import outcomes, step_variables

from ..problems import weak_path


def test_outcomes_of_a_step_are_those_of_each_law_for_each_noise():
    shape = jax.ShapeDtypeStruct((2,), jnp.float32)
    path = ds.WeakBrownianPath(shape, jr.key(0), two_point=True)
    terms = diffrax.ControlTerm(lambda t, y, args: y, path)
    # Backward in time.
    laws, terms_with = step_variables(terms, -0.3)
    values, weights = outcomes(laws, 3)
    of = lambda x: terms_with(x).contr(0.0, -0.3, use_levy=True)
    increments = jax.vmap(of)(values)
    assert {x.dtype.name for x in jax.tree.leaves(increments)} == {"float32"}
    np.testing.assert_array_equal(increments.dt, np.float32(-0.3))
    for name, law in (laws_of(path) or {}).items():
        for noise in getattr(increments, name).T:
            for value, weight in zip(*law.outcomes(3), strict=True):
                found = np.isclose(noise, np.sqrt(0.3) * value)
                np.testing.assert_allclose(weights[found].sum(), weight, rtol=1e-14)


def test_laws_have_the_variance_on_record_and_outcomes_of_their_words():
    areas = diffrax.UnsafeBrownianPath((1,), jr.key(0), diffrax.SpaceTimeTimeLevyArea)
    paths = [
        areas,
        weak_path(1, second=True, two_point=True),
        weak_path(1, order=3),
        ds.PlateauBrownianPath(
            diffrax.UnsafeBrownianPath((1,), jr.key(0), diffrax.SpaceTimeLevyArea),
            jr.key(1),
        ),
    ]
    for path in paths:
        laws = laws_of(path)
        assert laws is not None
        for name, law in laws.items():
            # K is Diffrax's: no solver here needs it.
            on_record = 1 / 720 if name == "K" else VARIABLES[name].variance
            assert on_record is not None
            values, weights = law.outcomes(5)
            np.testing.assert_allclose(weights.sum(), 1, rtol=1e-14)
            np.testing.assert_allclose(weights @ values, 0, atol=1e-15)
            np.testing.assert_allclose(weights @ values**2, on_record, rtol=1e-14)
            if isinstance(law, Discrete):
                # As many words have each value as its probability says.
                edges = np.array([0, *law.cuts, 2**32], np.uint64)
                first, last = edges[:-1], edges[1:] - 1
                for words in (first, last):
                    sample = law.from_words(jnp.asarray(words, jnp.uint32), float)
                    np.testing.assert_array_equal(sample, values)
                shares = np.diff(edges.astype(float)) / 2**32
                np.testing.assert_allclose(shares, weights, rtol=0, atol=2**-31)
    names = lambda path: set(laws_of(path) or ())
    assert names(areas) == {"W", "H", "K"}
    assert names(weak_path(1, order=3)) == {"W", "second", "third"}
    # The increments with plateaus hold space-time areas alone.
    assert names(ds.PlateauBrownianPath(areas, jr.key(1))) == {"W", "H", "sign"}


def test_increments_can_be_made_from_words_given_in_place_of_the_random_ones():
    # A step of three-point variables and signs, in the order of the words.
    path = weak_path(2, two_point=True)
    assert (path.num_words(), path.num_words(use_levy=True)) == (2, 4)
    words = jnp.array([0, 2**31, 2**32 - 1, 5], jnp.uint32)
    h = 0.25
    inc = path.increment(words, 1.0, 1.0 + h, use_levy=True)
    assert isinstance(inc, ds.WeakIncrement) and inc.two_point is not None
    np.testing.assert_allclose(inc.W, [-np.sqrt(3 * h), 0], rtol=1e-14)
    np.testing.assert_allclose(inc.two_point, [np.sqrt(h), -np.sqrt(h)], rtol=1e-14)
    np.testing.assert_array_equal(path.increment(words[:2], 1.0, 1.0 + h), inc.W)
    tree = diffrax.UnsafeBrownianPath((2,), jr.key(0), diffrax.SpaceTimeLevyArea)
    for unknown in (
        ds.TruncatedBrownianPath(tree),
        ds.PlateauBrownianPath(tree, jr.key(1)),
        ds.LevyAreaBrownianPath(tree, jr.key(1)),
    ):
        with pytest.raises(ValueError, match="cannot be set from outside"):
            unknown.num_words()


class Directed(diffrax.ControlTerm):
    """A user's own term, with an attribute that Diffrax's wrapper has, too."""

    direction: float = 3.0


def test_areas_keep_their_sign_backward_in_time_and_nobody_else_scales_them():
    path = ds.FixedStepBrownianPath((2,), jr.key(0), diffrax.SpaceTimeLevyArea)
    inc = path.evaluate(0.5, 0.75, use_levy=True)
    noise = Directed(lambda t, y, args: jnp.ones((1, 2)), path)
    back = diffrax._term.WrapTerm(noise, -1)
    for term, t0, t1, sign in ((noise, 0.5, 0.75, 1), (back, -0.75, -0.5, -1)):
        got = drawn_variables((term,), ["W", "H"], t0, t1, "")
        np.testing.assert_array_equal(got["W"][0], sign * inc.W)
        np.testing.assert_array_equal(got["H"][0], inc.H)


def test_four_point_variables_have_seven_moments():
    # Whose words have their values and weights by `test_laws`.
    values, weights = laws_of(weak_path(1, order=3))["W"].outcomes(5)
    for n, exact in enumerate((1, 0, 1, 0, 3, 0, 15, 0)):
        np.testing.assert_allclose(weights @ values**n, exact, rtol=1e-14, atol=1e-14)
    with pytest.raises(ValueError, match="`order` must be 2 or 3"):
        weak_path(1, order=4)
