"""Weak orders and exact moments, from the finitely many outcomes of one step."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import (
    H0,
    kubo_terms,
    local_weak_orders,
    noise,
    random_problem,
    weak_path,
)


def test_defect_sees_a_method_of_lower_order():
    terms = ds.hamiltonian_terms(H0, noise, weak_path(1))
    y0, args = jax.vmap(lambda key: random_problem(key, 1, 1))(jr.split(jr.key(0), 4))
    hs = np.array([0.02, 0.005])
    slopes = local_weak_orders(terms, ds.ImplicitMidpoint(), y0, args, hs, order=2)
    assert np.median(slopes) < 2.5


def test_defect_knows_ito_from_stratonovich():
    # dy = y dw: Euler's E[y^2] = (1 + h) y^2 is Itô's to first order.
    path = weak_path(1)
    drift = diffrax.ODETerm(lambda t, y, args: jnp.zeros_like(y))
    diffusion = diffrax.ControlTerm(lambda t, y, args: y[:, None], path)
    terms = diffrax.MultiTerm(drift, diffusion)
    kwargs = dict(fn=lambda t, y, args: y[0] ** 2, order=1)
    y0 = jnp.array([1.0])
    defect = ds.weak_order_defect(terms, diffrax.Euler(), 0.0, 0.1, y0, **kwargs)
    np.testing.assert_allclose(defect, 0, atol=1e-15)
    defect = ds.weak_order_defect(terms, diffrax.Heun(), 0.0, 0.1, y0, **kwargs)
    # Heun: y1 = (1 + I + I^2 / 2) y, so E[y1^2] = 1 + 2 h + 3 h^2 / 4.
    np.testing.assert_allclose(defect, 0.75 * 0.1**2, atol=1e-15)


def test_expectation_enumerates_second_and_two_point_variables():
    class Read(diffrax.AbstractPath):
        """Shows the extra variables to the vector field as if they were increments."""

        path: ds.WeakBrownianPath
        t0 = 0
        t1 = 1

        def evaluate(self, t0, t1=None, left=True):
            inc = self.path.evaluate(t0, t1, use_levy=True)
            return jnp.concatenate([inc.W, inc.second, inc.two_point])

    path = weak_path(1, second=True, two_point=True)
    identity = lambda t, y, args: jnp.eye(3)
    terms = diffrax.MultiTerm(
        diffrax.ODETerm(lambda t, y, args: jnp.zeros_like(y)),
        diffrax.ControlTerm(identity, Read(path)),
    )
    h = 0.3
    powers = lambda t, y, args: jnp.stack([jnp.outer(y, y), jnp.outer(y**2, y**2)])
    second, fourth = ds.step_expectation(
        terms, diffrax.Euler(), 0.0, h, jnp.zeros(3), fn=powers
    )
    np.testing.assert_allclose(second, h * np.eye(3), atol=1e-15)
    expected = h**2 * np.array([[3, 1, 1], [1, 3, 1], [1, 1, 1]])
    np.testing.assert_allclose(fourth, expected, atol=1e-15)


def test_kubo_moments_match_the_matrix_recursion():
    # A midpoint step of the Kubo oscillator turns the plane by 2 atan((h + s I) / 2).
    h, s = 0.1, 0.7
    terms = kubo_terms(ds.WeakBrownianPath((), jr.key(0)), s)
    got = ds.step_expectation(
        terms,
        ds.ImplicitMidpoint(),
        0.0,
        h,
        (jnp.array(0.0), jnp.array(1.0)),
        fn=lambda t, y, args: jnp.stack([*y]),
    )
    increments = np.sqrt(3 * h) * np.array([-1, 0, 1])
    angles = 2 * np.arctan((h + s * increments) / 2)
    weights = np.array([1, 4, 1]) / 6
    expected = [-weights @ np.sin(angles), weights @ np.cos(angles)]
    np.testing.assert_allclose(got, expected, atol=1e-15)


def test_shapes_of_paths_are_told_to_be_shapes():
    field = lambda t, y, args: jax.tree.map(lambda x: x[..., None], y)
    control = diffrax.ControlTerm(field, (1,))  # pyright: ignore
    drift, noise = kubo_terms(()).terms
    says = r"pass `path=solver.path\(shape, key\)`"
    for term in (noise, control):
        terms = diffrax.MultiTerm(drift, term)
        at = terms, ds.ImplicitMidpoint(), 0.0, 0.1, (jnp.array(0.0), jnp.array(1.0))
        with pytest.raises(ValueError, match=says):
            ds.second_moment_map(*at)
        with pytest.raises(ValueError, match=says):
            ds.step_expectation(*at, fn=lambda t, y, args: y[0])


def test_expectation_needs_paths_of_known_laws():
    y0 = (jnp.array(0.0), jnp.array(1.0))
    area = diffrax.SpaceTimeLevyArea
    cut = ds.TruncatedBrownianPath(diffrax.UnsafeBrownianPath((), jr.key(0), area))
    known = kubo_terms(ds.WeakBrownianPath((), jr.key(0)))
    for terms in (
        kubo_terms(cut),
        kubo_terms(ds.PlateauBrownianPath(cut, jr.key(1))),
        diffrax.MultiTerm(known, kubo_terms(cut).terms[1]),
        diffrax.MultiTerm(known.terms[0]),
    ):
        with pytest.raises(ValueError, match="must hold Brownian paths whose laws"):
            ds.step_expectation(
                terms, ds.ImplicitMidpoint(), 0.0, 0.1, y0, fn=lambda t, y, a: y[0]
            )
