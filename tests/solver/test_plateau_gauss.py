"""Strong order 3/2 for any Hamiltonians, by brackets of noise and drift."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import (
    FineSample,
    Given,
    weak_path,
)


solver = ds.PlateauGauss()


def _linear_terms(path, *matrices):
    A, Bs = matrices[0], jnp.stack(matrices[1:])
    diffusion = lambda t, y, args: jnp.einsum("kij,j->ik", Bs, y)
    return diffrax.MultiTerm(
        diffrax.ODETerm(lambda t, y, args: A @ y), diffrax.ControlTerm(diffusion, path)
    )


@pytest.mark.parametrize("with_K", [False, True])
def test_step_is_the_gauss_method_on_the_field_of_the_docstring(with_K):
    rng = np.random.default_rng(0)
    A, B, C = rng.normal(size=(3, 3, 3))
    W, H, K = 0.3 * rng.normal(size=(3, 2))
    h = 0.3
    bracket = lambda B, A: A @ B - B @ A
    L = 3 / 5 * h * np.outer(H, H)
    if with_K:
        L += 60 / 7 * h * np.outer(K, K) - h * (np.outer(W, K) + np.outer(K, W)) / 2
        L += 3 / 140 * h**2 * np.eye(2)
    else:
        L += h**2 / 30 * np.eye(2)
    omega = h * A
    for k, X in enumerate((B, C)):
        omega += W[k] * X + h * H[k] * bracket(X, A)
        for j, Y in enumerate((B, C)):
            omega += L[k, j] * bracket(X, bracket(Y, A))
    # The stability function of the Gauss method with two stages.
    even, odd = np.eye(3) + omega @ omega / 12, omega / 2
    y0 = rng.normal(size=3)
    expected = np.linalg.solve(even - odd, (even + odd) @ y0)

    path = Given(*map(jnp.asarray, (W, H)), K=jnp.asarray(K) if with_K else None)
    step = lambda terms: eqx.filter_jit(
        lambda y: solver.step(terms, 0.0, h, y, None, None, False)[0]
    )(jnp.asarray(y0))
    actual = step(_linear_terms(path, A, B, C))
    np.testing.assert_allclose(actual, expected, rtol=1e-12)

    # Each noise in a term of its own.
    def one(k):
        K_k = path.K[k : k + 1] if path.K is not None else None
        return Given(path.W[k : k + 1], H=path.H[k : k + 1], K=K_k)

    drift, first = _linear_terms(one(0), A, B).terms
    second = _linear_terms(one(1), A, C).terms[1]
    apart = step(diffrax.MultiTerm(drift, first, second))
    np.testing.assert_allclose(apart, expected, rtol=1e-12)


def _drift(t, p, q, args):
    return p**2 / 4 + q**4 / 8 + 0.15 * (1 + jnp.sin(3 * t)) * p * q**2


def _one(t, p, q, args):
    return jnp.stack([jnp.sin(q + 3 * t) / 2 + 0.4 * p * q + jnp.cos(p) / 5])


def _two_that_commute(t, p, q, args):
    """Two functions of one function."""
    f = p**2 / 2 + jnp.cos(q) + p * q / 2
    return jnp.stack([0.4 * jnp.sin(f), 0.3 * f])


@pytest.mark.slow
def test_backward_in_time_it_undoes_its_steps():
    """The Gauss method is its own inverse, and the field of the path run backward is the
    negative of that forward."""
    terms = ds.hamiltonian_terms(_drift, _one, FineSample.draw(jr.key(0), 8, 1))
    y0 = jnp.array(0.3), jnp.array(0.8)

    @jax.jit
    def step(direction, t0, t1, y0):
        # As a solve that goes backward wraps them.
        wrapped = [diffrax._term.WrapTerm(term, direction) for term in terms.terms]
        both = diffrax.MultiTerm(*wrapped)
        return solver.step(both, t0, t1, y0, None, None, False)[0]

    y1 = step(1, 0.25, 0.5, y0)
    np.testing.assert_allclose(step(-1, -0.5, -0.25, y1), y0, atol=1e-12)
    assert abs(y1[0] - y0[0]) > 0.02


def test_drift_or_noise_alone_will_do_but_not_a_path_without_area():
    y0 = jnp.array(0.3), jnp.array(0.8)
    levy = diffrax.SpaceTimeLevyArea
    path = diffrax.UnsafeBrownianPath((1,), jr.key(0), levy)
    for term in ds.hamiltonian_terms(_drift, _one, path).terms:
        terms = diffrax.MultiTerm(term) if term.is_vf_expensive else term
        step = solver.step(terms, 0.0, 0.1, y0, None, None, False)
        assert all(jnp.isfinite(y) for y in step[0])
    terms = ds.hamiltonian_terms(_drift, _one, weak_path(1))
    with pytest.raises(ValueError, match="`PlateauGauss` needs space-time Lévy area"):
        diffrax.diffeqsolve(terms, solver, 0.0, 0.2, 0.1, y0)
    two = ds.hamiltonian_terms(_drift, _two_that_commute, weak_path(2))
    assert solver.strong_order(two) == 0.5 and solver.weak_order(two) == 1
