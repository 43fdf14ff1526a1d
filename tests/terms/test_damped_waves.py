"""Amplitudes with damping: at a temperature they have the law of Gibbs on the sphere."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import Given


ALPHA = 0.7
# Spin 1.
S_Z = jnp.diag(jnp.array([1.0, 0.0, -1.0]))
S_X = jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]) / jnp.sqrt(2)


def _mean(A, psi):
    return jnp.real(jnp.einsum("...i,ij,...j", jnp.conj(psi), A, psi))


def _anisotropy(t, psi, args):
    return jnp.sum(_mean(S_Z @ S_Z, psi))


def _field_and_square(t, psi, args):
    """A field along x, and the square of a mean, which is no matrix element."""
    return jnp.sum(0.8 * _mean(S_Z, psi) ** 2 - 0.5 * _mean(S_X, psi))


def _phases(t, psi, args):
    """An energy that depends on the phase of the vector, too."""
    return _field_and_square(t, psi, args) + jnp.sum(jnp.sin(t + psi.real))


def _thermal(t, psi, T):
    """The Hamiltonians of the noise that belongs to the damping `ALPHA`."""
    M = jnp.conj(psi)[..., :, None] * psi[..., None, :]
    return jnp.sqrt(2 * ALPHA * T) * (M.real + M.imag)


def _random(key, *shape, dtype=jnp.complex128):
    return jr.normal(key, shape, dtype)


def _path(*shape):
    return ds.WeakBrownianPath((*shape, shape[-1]), jr.key(0))


def test_solutions_push_forward_to_the_damped_equation_of_amplitudes():
    psi = _random(jr.key(0), 40, 3) / 3
    y = ds.to_pair(psi)
    by_parts = jax.grad(lambda x, y: _phases(0.4, x + 1j * y, None), argnums=(0, 1))
    dx, dy = by_parts(psi.real, psi.imag)
    g = (dx + 1j * dy) / 2
    dot = lambda a, b: jnp.sum(jnp.conj(a) * b, axis=-1, keepdims=True)
    for damping in (jr.uniform(jr.key(1), (40,)), 0.3, 0.0):
        terms = ds.wave_terms(_phases, _thermal, _path(40, 3), damping)
        velocity = jax.jvp(ds.from_pair, (y,), (terms.terms[0].vf(0.4, y, None),))[1]
        rate = jnp.reshape(jnp.broadcast_to(damping, 40), (40, 1))
        expected = -1j * g + rate * (psi * dot(g, psi) - g * dot(psi, psi))
        np.testing.assert_allclose(velocity, expected, atol=1e-13)
        # The damping changes no length, and takes energy from each vector.
        damped = velocity + 1j * g
        np.testing.assert_allclose(dot(psi, damped).real, 0, atol=1e-13)
        assert np.all(dot(g, velocity).real <= 1e-13)


def test_two_amplitudes_are_a_spin_with_twice_the_damping():
    H0 = lambda t, s, args: jnp.sum(s[..., 2] + 0.3 * s[..., 0] ** 2)
    as_waves = lambda t, psi, args: H0(t, ds.from_spinors(ds.to_pair(psi)), args)
    s = jr.normal(jr.key(0), (5, 3))
    y = ds.to_spinors(s)
    spin = ds.spin_terms(H0, damping=2 * ALPHA).terms[0].vf(0.0, y, None)
    wave = ds.wave_terms(as_waves, damping=ALPHA).terms[0].vf(0.0, y, None)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-14), spin, wave)


def test_density_of_gibbs_solves_the_equation_of_fokker_and_planck():
    # div(a rho) = 1/2 sum_k div(b_k div(b_k rho)) for the Stratonovich fields a and b_k.
    T = 0.6
    terms = ds.wave_terms(_phases, _thermal, _path(3), ALPHA)

    def field(control):
        def velocity(x):
            y = x[:3], x[3:]
            if control is None:
                return jnp.concatenate(terms.terms[0].vf(0.4, y, T))
            return jnp.concatenate(terms.terms[1].vf_prod(0.4, y, T, control))

        return velocity

    def divergence(vf, rho):
        flow = lambda x: vf(x) * rho(x)
        return lambda x: jnp.trace(jax.jacfwd(flow)(x))

    def rho(x):
        return jnp.exp(-_phases(0.4, ds.from_pair((x[:3], x[3:])), T) / T)

    def both(x):
        drift = divergence(field(None), rho)(x)

        def diffusion(unit):
            b = field(unit.reshape(3, 3))
            return divergence(b, divergence(b, rho))(x) / 2

        return drift, jnp.sum(jax.vmap(diffusion)(jnp.eye(9)))

    drift, diffusion = jax.jit(jax.vmap(both))(0.7 * jr.normal(jr.key(0), (50, 6)))
    assert np.min(np.abs(drift)) > 1e-5
    np.testing.assert_allclose(drift, diffusion, rtol=1e-10, atol=1e-12)


def test_length_is_kept_in_five_hundred_random_steps():
    def change(key):
        k_psi, k_h, k_W = jr.split(key, 3)
        h = jnp.exp(jr.uniform(k_h, (), float, jnp.log(1e-3), jnp.log(0.1)))
        W = jnp.sqrt(h) * jnp.clip(jr.normal(k_W, (2, 3, 3)), -2.5, 2.5)
        alpha, y0 = jnp.array([0.2, 0.5]), ds.to_pair(_random(k_psi, 2, 3))
        terms = ds.wave_terms(_field_and_square, _thermal, Given(W), alpha)
        y1, *_ = ds.ImplicitMidpoint().step(terms, 0.0, h, y0, 0.2, None, False)
        lengths = [jnp.linalg.norm(ds.from_pair(y), axis=-1) for y in (y0, y1)]
        return jnp.max(jnp.abs(lengths[1] / lengths[0] - 1))

    changes = jax.jit(jax.vmap(change))(jr.split(jr.key(0), 500))
    assert jnp.max(changes) <= 1e-13


def test_dampings_that_are_none_are_refused():
    path = _path(2, 3)
    for wrong in (-0.1, jnp.nan, jnp.inf, 1j, "much", jnp.array([0.1, -0.1])):
        with pytest.raises(ValueError, match="`damping` must be a number"):
            ds.wave_terms(_anisotropy, _thermal, path, damping=wrong)  # pyright: ignore
    y0 = ds.to_pair(jnp.ones((2, 3)))
    for shape in ((3,), (1,), (2, 1)):
        terms = ds.wave_terms(_anisotropy, _thermal, path, damping=jnp.ones(shape))
        with pytest.raises(ValueError, match=r"one for each vector.*\(2,\)"):
            terms.terms[0].vf(0.0, y0, None)
    sum_of_all = lambda t, psi, args: sum(
        jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(psi)
    )
    damped = ds.wave_terms(sum_of_all, damping=1.0)
    for psi in ({"a": jnp.ones(2)}, jnp.array(1.0)):
        with pytest.raises(ValueError, match="in one array"):
            damped.terms[0].vf(0.0, ds.to_pair(psi), None)
    with pytest.raises(ValueError, match="complex amplitudes `y0=to_pair"):
        damped.terms[0].vf(0.0, jnp.ones(2), None)
    for solver in (ds.StormerVerlet(), ds.SRKw5(), ds.BAOAB()):
        terms = ds.wave_terms(_anisotropy, _thermal, path, damping=1.0)
        with pytest.raises(ValueError, match="use a solver for general systems"):
            solver.init(terms, 0.0, 0.1, y0, 1.0)

    @jax.jit
    @jax.vmap
    def run(alpha):
        terms = ds.wave_terms(_anisotropy, _thermal, path, damping=alpha)
        at = terms, 0.0, 0.1, y0, 0.1, None, False
        return ds.ImplicitMidpoint().step(*at)[-1] == diffrax.RESULTS.successful

    np.testing.assert_array_equal(
        run(jnp.array([0.5, -0.5, jnp.nan, jnp.inf])), [True, False, False, False]
    )
