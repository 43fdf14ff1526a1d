"""Friction and temperature as terms: every solver sees them, in every form."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds


TENSOR = jnp.array([[1.0, 0.3, 0.0], [0.3, 0.5, -0.2], [0.0, -0.2, 0.7]])
MASSES = jnp.array([1.0, 4.0, 0.5])
T = 0.6


def _pendula(t, p, q, args):
    return jnp.sum(p**2 / MASSES) / 2 + jnp.sum(jnp.sin(q)) * jnp.cos(t) + jnp.prod(q)


def _at(q):
    return 1 + q**2


# Each with what it is at a position, as a matrix.
FRICTIONS = {
    "number": (0.7, lambda q: 0.7 * np.eye(3)),
    "each": (jnp.array([0.4, 0.0, 2.0]), lambda q: np.diag([0.4, 0.0, 2.0])),
    "matrix": (TENSOR, lambda q: TENSOR),
    "number at q": (lambda t, q, args: _at(q[0]), lambda q: _at(q[0]) * np.eye(3)),
    "each at q": (lambda t, q, args: _at(q), lambda q: np.diag(_at(q))),
    "matrix at q": (
        lambda t, q, args: _at(q[0]) * TENSOR,
        lambda q: _at(q[0]) * TENSOR,
    ),
    "along": (
        ds.FrictionAlong(jnp.array([[1.0, 0.0], [-1.0, 2.0], [0.0, -2.0]])),
        lambda q: np.array([[1.0, -1.0, 0.0], [-1.0, 5.0, -4.0], [0.0, -4.0, 4.0]]),
    ),
    "along at q": (
        ds.FrictionAlong(lambda t, q, args: q[:, None] * jnp.ones(2)),
        lambda q: 2 * np.outer(q, q),
    ),
}


@pytest.mark.parametrize("name", FRICTIONS)
def test_drift_and_noise_are_those_of_the_equation(name):
    friction, matrix = FRICTIONS[name]
    m = 2 if "along" in name else 3
    terms = ds.langevin_terms(_pendula, friction, T, (m,))
    p, q = jr.normal(jr.key(0), (2, 3))
    drift, force, noise = terms.terms
    dp, dq = force.vf(0.3, (p, q), None)
    G = matrix(q)
    np.testing.assert_allclose(dp, -G @ (p / MASSES), rtol=1e-14)
    np.testing.assert_array_equal(dq, 0)
    expected = ds.hamiltonian_terms(_pendula).terms[0].vf(0.3, (p, q), None)
    np.testing.assert_array_equal(drift.vf(0.3, (p, q), None), expected)
    B, still = noise.vf(0.3, (p, q), None)
    np.testing.assert_allclose(B @ B.T, 2 * T * G, atol=1e-14)
    np.testing.assert_array_equal(still, 0)
    control = jnp.arange(1.0, m + 1)
    both = noise.vf_prod(0.3, (p, q), None, control)
    np.testing.assert_allclose(both, noise.prod((B, still), control), atol=1e-14)


def test_momenta_in_trees_have_frictions_and_temperatures_in_trees():
    H0 = lambda t, p, q, args: jnp.sum(p["a"] ** 2) / 4 + p["b"] ** 2 / 2
    shape = jax.eval_shape(lambda: {"a": jnp.ones(3), "b": jnp.ones(())})
    p = {"a": jnp.arange(3.0), "b": jnp.array(2.0)}
    for friction, heat, forces, squares in (
        (0.5, T, (-0.25 * p["a"], -1.0), (T * np.eye(3), T)),
        ({"a": TENSOR, "b": 3.0}, T, (-TENSOR @ p["a"] / 2, -6), (2 * T * TENSOR, 6 * T)),
        (0.5, {"a": jnp.arange(3.0), "b": 0.0}, (-0.25 * p["a"], -1.0),
         (np.diag([0.0, 1.0, 2.0]), 0.0)),
    ):  # fmt: skip
        _, force, noise = ds.langevin_terms(H0, friction, heat, shape).terms
        dp, _ = force.vf(0.0, (p, p), None)
        np.testing.assert_allclose(dp["a"], forces[0])
        np.testing.assert_allclose(dp["b"], forces[1])
        B, _ = noise.vf(0.0, (p, p), None)
        np.testing.assert_allclose(B["a"] @ B["a"].T, squares[0], atol=1e-14)
        np.testing.assert_allclose(B["b"] @ B["b"], squares[1])
    # Directions couple the arrays of a tree.
    along = {"a": jnp.ones((3, 1)), "b": -3 * jnp.ones(1)}
    friction = ds.FrictionAlong(along)
    _, force, noise = ds.langevin_terms(H0, friction, T, (1,)).terms
    dp, _ = force.vf(0.0, (p, p), None)
    # The velocities 0, 0.5, 1 and 2.
    np.testing.assert_allclose([*dp["a"], dp["b"]], 4.5 * np.array([1, 1, 1, -3]))
    y0 = p, p
    with pytest.raises(ValueError, match="besides friction"):
        ds.BAOAB().init(force, 0.0, 0.1, y0, None)
    terms = diffrax.MultiTerm(*ds.hamiltonian_terms(H0).terms, force)
    state = ds.BAOAB().init(terms, 0.0, 0.1, y0, None)
    p1, _ = ds.BAOAB().step(terms, 0.0, 0.1, y0, None, state, False)[0]
    np.testing.assert_allclose(jnp.sum(p1["a"]) + p1["b"], 5.0, rtol=1e-15)


@pytest.mark.parametrize("n", [2, 4, 6, 10])
def test_friction_between_particles_conserves_momentum(n):
    # The root of a rounding error in the singular matrix is no noise.
    G = n * jnp.eye(n) - jnp.ones((n, n))
    H0 = lambda t, p, q, args: jnp.sum(p**2) / 2
    y0 = jnp.arange(n) / n, jnp.zeros(n)
    for friction in (G, lambda t, q, args: G):
        path = ds.WeakBrownianPath((n,), jr.key(0))
        terms = ds.langevin_terms(H0, friction, 1.0, path)
        sol = diffrax.diffeqsolve(
            terms, ds.BAOAB(), 0, 1000, 0.1, y0, max_steps=None,
            adjoint=diffrax.ForwardMode(),
        )  # fmt: skip
        np.testing.assert_allclose(jnp.sum(sol.ys[0]), (n - 1) / 2, atol=1e-13 * n)
        assert np.std(sol.ys[0]) > 0.1
