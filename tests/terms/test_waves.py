"""Complex amplitudes: the pair (p, q) stands for psi."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from examples import qubit

from ..problems import slope, weak_path


X = jnp.array([[0, 1], [1, 0]], complex)


def _random(key, shape=(3,), dtype=jnp.complex128):
    return jr.normal(key, shape, dtype)


def _lattice(t, psi, args):
    hops = jnp.sum(jnp.abs(jnp.roll(psi, 1) - args * psi) ** 2)
    return hops - jnp.sum(jnp.abs(psi) ** 4) / 2 + jnp.sum(jnp.cos(t + psi.real))


def _site_noise(t, psi, args):
    return jnp.stack([jnp.sum(jnp.abs(psi) ** 4), jnp.sum(psi.real * psi.imag)])


def test_solutions_push_forward_to_the_equation_of_amplitudes():
    psi, args, W = _random(jr.key(0)), 1.2 - 0.4j, jnp.array([0.3, -0.7])
    drift, diffusion = ds.wave_terms(_lattice, _site_noise, weak_path(2)).terms
    y = ds.to_pair(psi)
    for dy, H in (
        (drift.vf(0.4, y, args), lambda psi: _lattice(0.4, psi, args)),
        (
            diffusion.vf_prod(0.4, y, args, W),
            lambda psi: _site_noise(0.4, psi, args) @ W,
        ),
    ):
        _, velocity = jax.jvp(ds.from_pair, (y,), (dy,))
        # The derivative by psi*: half of the one by Re psi plus i times that by Im psi.
        by_parts = jax.grad(lambda x, y: H(x + 1j * y), argnums=(0, 1))
        dx, dy = by_parts(psi.real, psi.imag)
        np.testing.assert_allclose(1j * velocity, (dx + 1j * dy) / 2, atol=1e-14)


def test_amplitudes_of_pairs_give_them_back():
    dtype = jnp.complex64
    psi = {
        "a": _random(jr.key(0), (2, 3), dtype),
        "b": (_random(jr.key(1), (), dtype),),
    }
    p, q = ds.to_pair(psi)
    real = jnp.finfo(dtype).dtype
    assert all(x.dtype == real for x in jax.tree.leaves((p, q)))
    back = ds.from_pair((p, q))
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=4 * jnp.finfo(dtype).eps)
    jax.tree.map(same, back, psi)
    assert all(x.dtype == dtype for x in jax.tree.leaves(back))
    energy = jax.tree.map(lambda p, q: jnp.sum(p**2 + q**2) / 2, p, q)
    jax.tree.map(lambda e, x: same(e, jnp.sum(jnp.abs(x) ** 2)), energy, psi)


def test_real_amplitudes_have_no_momentum():
    p, q = ds.to_pair(jnp.array([0.6, -0.8], jnp.float32))
    assert p.dtype == q.dtype == jnp.float32
    np.testing.assert_array_equal(p, 0)
    np.testing.assert_allclose(q, np.sqrt(2) * np.array([0.6, -0.8]), rtol=1e-6)


def test_what_are_no_pairs_of_real_arrays_is_refused():
    x, psi = jnp.ones(2), _random(jr.key(0), (2,))
    for wrong in (psi, (psi, psi), x, [x, x], (x, jnp.ones(3)), (x, {"a": x})):
        with pytest.raises(ValueError, match=r"for complex amplitudes `y0=to_pair"):
            ds.from_pair(wrong)  # pyright: ignore


@pytest.mark.slow
def test_noisy_qubit_has_the_density_matrix_of_lindblad_without_sampling():
    steps = np.array([16, 32, 64])
    found = jnp.stack([qubit.density(ds.StrangGauss(), 2.0, int(n)) for n in steps])
    np.testing.assert_allclose(jnp.trace(found, axis1=1, axis2=2), 1.0, rtol=1e-12)
    errors = jnp.max(jnp.abs(found - qubit.lindblad(2.0)), axis=(1, 2))
    assert abs(slope(1 / steps, errors) - 2) <= 0.1
    assert errors[-1] <= 1e-4


PSI0 = qubit.PSI0


def test_gradients_with_respect_to_complex_parameters_are_those_of_jax():
    H0 = lambda t, psi, z: jnp.real(z * jnp.conj(psi[0]) * psi[1])
    noise = lambda t, psi, z: jnp.abs(z * psi[0]) ** 2
    terms = ds.wave_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))

    @jax.jit
    @ft.partial(jax.value_and_grad, argnums=(0, 1))
    def both(z, psi0):
        at = terms, 0.0, 0.5, ds.to_pair(psi0), z, None, False
        return jnp.abs(ds.from_pair(ds.ImplicitMidpoint().step(*at)[0])[0]) ** 2

    z, k = 0.7 - 0.2j, 1e-6
    gradient, by_start = both(z, PSI0)[1]
    # One program for the gradient and for the values that are compared to it.
    loss = lambda z, psi0: both(z, psi0)[0]
    along = lambda d: (loss(z + k * d, PSI0) - loss(z - k * d, PSI0)) / (2 * k)
    np.testing.assert_allclose(gradient, along(1) - 1j * along(1j), rtol=1e-7)
    unit = np.array([0, 1j])
    difference = (loss(z, PSI0 + k * unit) - loss(z, PSI0 - k * unit)) / (2 * k)
    np.testing.assert_allclose(-by_start[1].imag, difference, rtol=1e-7)


def test_noises_of_waves_may_be_indexed():
    y = ds.to_pair(_random(jr.key(0)))
    indexed = ds.IndexedNoise(lambda k, t, psi, args: _site_noise(t, psi, args)[k], 2)
    all_at_once, one_by_one = (
        ds.wave_terms(_lattice, fields, weak_path(2)).terms[1].vf(0.4, y, 1.1)
        for fields in (_site_noise, indexed)
    )
    for a, b in zip(one_by_one, all_at_once):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_complex_states_are_told_of_wave_terms():
    path, psi = weak_path(2), _random(jr.key(0))
    solve = lambda terms, y0: diffrax.diffeqsolve(
        terms, ds.ImplicitMidpoint(), 0, 1, 0.1, y0, 1.0
    )
    with pytest.raises(ValueError, match=r"complex amplitudes `y0=to_pair\(psi0\)`"):
        solve(ds.wave_terms(_lattice, _site_noise, path), psi)
    holomorphic = ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(jnp.abs(p * q)), lambda *_: jnp.zeros(2), path
    )
    with pytest.raises(ValueError, match="wave_terms"):
        solve(holomorphic, (psi, psi))
    plain = diffrax.ODETerm(lambda t, y, args: 1j * y)
    with pytest.raises(ValueError, match="`wave_terms.*real and imaginary parts"):
        solve(plain, psi)


def test_hamiltonians_that_return_complex_numbers_are_refused():
    path, y0 = weak_path(2), ds.to_pair(_random(jr.key(0), (2,)))
    wrong = lambda t, psi, args: jnp.conj(psi) @ X @ psi
    with pytest.raises(ValueError, match="`H0` must return real numbers.*jnp.real"):
        ds.wave_terms(wrong, _site_noise, path).terms[0].vf(0.0, y0, None)
    each = lambda t, psi, args: psi
    with pytest.raises(ValueError, match="`noise` must return real numbers"):
        ds.wave_terms(wrong, each, path).terms[1].vf(0.0, y0, None)
    with pytest.raises(ValueError, match=r"called as `H0\(t, psi, args\)`"):
        ds.wave_terms(lambda t, p, q, args: 0.0, each, path)
    with pytest.raises(ValueError, match=r"called as `noise\(t, psi, args\)`"):
        ds.wave_terms(wrong, lambda t, p, q, args: 0.0, path)
    with pytest.raises(
        ValueError, match=r"called as `noise\(t, psi, args\)`; got None"
    ):
        ds.wave_terms(wrong, None, path)
    with pytest.raises(ValueError, match="use a solver for general systems"):
        terms = ds.wave_terms(_lattice, _site_noise, path)
        ds.StormerVerlet().init(terms, 0.0, 0.1, y0, 1.0)
