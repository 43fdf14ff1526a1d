"""Complex amplitudes: the pair (p, q) stands for psi."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.linalg

import diffrax_symplectic as ds

from ..picard import by_picard
from ..problems import Given, slope, weak_path


def _random(shape, seed=0, dtype=complex):
    re, im = np.random.default_rng(seed).normal(size=(2, *shape))
    return ((re + 1j * im) / np.sqrt(2)).astype(dtype)


def _mean(matrix, psi):
    return jnp.real(jnp.einsum("...i,ij,...j", jnp.conj(psi), matrix, psi))


# Spin 1.
S_Z = np.diag([1.0, 0.0, -1.0])
S_X = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]) / np.sqrt(2)
ALPHA = 0.7


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


def _path(*shape):
    return ds.WeakBrownianPath((*shape, shape[-1]), jr.key(0))


def _by_conjugate(H, psi):
    """The derivative by psi*: half of the one by Re psi plus i times that by Im psi."""
    by_parts = jax.grad(lambda x, y: H(x + 1j * y), argnums=(0, 1))
    dx, dy = by_parts(psi.real, psi.imag)
    return (dx + 1j * dy) / 2


@pytest.mark.core
def test_solutions_push_forward_to_the_equation_of_amplitudes_with_and_without_damping():
    psi = _random((40, 3)) / 3
    rng = np.random.default_rng(1)
    dampings = [None, rng.uniform(size=40), 0.3]
    W = jnp.array(rng.normal(size=(40, 3, 3)))
    T = 0.6
    terms = [ds.wave_terms(_phases, _thermal, _path(40, 3), x).terms for x in dampings]

    @jax.jit
    def fields(psi):
        y = ds.to_pair(psi)
        push = lambda vf: jax.jvp(ds.from_pair, (y,), (vf,))[1]
        velocities = [push(drift.vf(0.4, y, T)) for drift, _ in terms]
        kick = push(terms[0][1].vf_prod(0.4, y, T, W))
        g = _by_conjugate(lambda psi: _phases(0.4, psi, T), psi)
        of_noise = lambda psi: jnp.sum(W * _thermal(0.4, psi, T))
        return velocities, g, kick, _by_conjugate(of_noise, psi)

    velocities, g, kick, of_noise = jax.tree.map(np.asarray, fields(psi))
    np.testing.assert_allclose(1j * kick, of_noise, atol=1e-13)
    dot = lambda a, b: np.sum(np.conj(a) * b, axis=-1, keepdims=True)
    for damping, velocity in zip(dampings, velocities):
        rate = np.multiply(0 if damping is None else damping, np.ones(40))[:, None]
        expected = -1j * g + rate * (psi * dot(g, psi) - g * dot(psi, psi))
        np.testing.assert_allclose(velocity, expected, atol=1e-13)


def test_amplitudes_of_pairs_give_them_back():
    eps = 4 * np.finfo(np.float32).eps
    psi = {"a": _random((2, 3), 0, np.complex64), "b": (_random((), 1, np.complex64),)}
    p, q = y = ds.to_pair(psi)
    assert {x.dtype.name for x in jax.tree.leaves(y)} == {"float32"}
    back = ds.from_pair(y)
    assert {x.dtype.name for x in jax.tree.leaves(back)} == {"complex64"}
    same = ft.partial(np.testing.assert_allclose, rtol=eps)
    jax.tree.map(same, back, psi)
    # The pair of unit square is an amplitude of half of that.
    jax.tree.map(lambda p, x: same(p, np.sqrt(2) * x.imag), p, psi)
    jax.tree.map(lambda q, x: same(q, np.sqrt(2) * x.real), q, psi)
    # Real amplitudes have no momentum.
    p, q = ds.to_pair(np.array([0.6, -0.8], np.float32))
    assert p.dtype == q.dtype == np.float32
    np.testing.assert_array_equal(p, 0)


# A noisy qubit: i dpsi = H psi dt + A psi o dw. The mean of psi psi^dagger follows
# d rho / dt = -i [H, rho] - [A, [A, rho]] / 2.
H = np.array([[0.3, 0.5], [0.5, -0.3]], complex)
A = np.array([[0.3, 0.15], [0.15, -0.3]], complex)
QUBIT = np.array([np.sqrt(0.9), np.sqrt(0.1) * 1j])


def test_noisy_qubit_has_the_density_matrix_of_lindblad_without_sampling():
    commutator = lambda M: np.kron(M, np.eye(2)) - np.kron(np.eye(2), M.T)
    L = -1j * commutator(H) - commutator(A) @ commutator(A) / 2
    rho = np.outer(QUBIT, np.conj(QUBIT)).ravel()
    exact = (scipy.linalg.expm(2 * L) @ rho).reshape(2, 2)

    # By the mean of p, q and their products.
    y0 = ds.to_pair(QUBIT)
    terms = ds.wave_terms(
        lambda t, psi, args: _mean(H, psi),
        lambda t, psi, args: _mean(A, psi),
        ds.WeakBrownianPath((), jr.key(0)),
    )
    solver = by_picard(ds.StrangGauss())
    one_step = jax.jit(lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0))
    flat = np.concatenate([np.ones(1), *y0])
    numbers, errors = np.array([16, 32, 64]), []
    for steps in numbers:
        K = np.asarray(one_step(2.0 / steps))
        moments = np.linalg.matrix_power(K, steps) @ np.kron(flat, flat)
        m = moments.reshape(5, 5)[1:, 1:]  # of p1, p2, q1, q2
        pp, pq, qp, qq = m[:2, :2], m[:2, 2:], m[2:, :2], m[2:, 2:]
        found = (qq + pp + 1j * (pq - qp)) / 2
        np.testing.assert_allclose(np.trace(found), 1.0, rtol=1e-12)
        errors.append(np.max(np.abs(found - exact)))
    assert abs(slope(1 / numbers, errors) - 2) <= 0.1
    assert errors[-1] <= 1e-4


def test_gradients_with_respect_to_complex_parameters_are_those_of_jax():
    H0 = lambda t, psi, z: jnp.real(z * jnp.conj(psi[0]) * psi[1])
    noise = lambda t, psi, z: jnp.abs(z * psi[0]) ** 2
    terms = ds.wave_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    start = np.array([0.6, 0.8j])

    @jax.jit
    @ft.partial(jax.value_and_grad, argnums=(0, 1))
    def both(z, psi0):
        at = terms, 0.0, 0.5, ds.to_pair(psi0), z, None, False
        y1, *_ = by_picard(ds.ImplicitMidpoint()).step(*at)
        return jnp.abs(ds.from_pair(y1)[0]) ** 2

    z, k = 0.7 - 0.2j, 1e-6
    gradient, by_start = both(z, start)[1]
    # One program for the gradient and for the values that are compared to it.
    loss = lambda z, psi0: both(z, psi0)[0]
    along = lambda d: (loss(z + k * d, start) - loss(z - k * d, start)) / (2 * k)
    np.testing.assert_allclose(gradient, along(1) - 1j * along(1j), rtol=1e-7)
    unit = np.array([0, 1j])
    difference = (loss(z, start + k * unit) - loss(z, start - k * unit)) / (2 * k)
    np.testing.assert_allclose(-by_start[1].imag, difference, rtol=1e-7)


def test_noises_of_waves_may_be_indexed():
    y = ds.to_pair(_random((3,)))
    both = lambda t, psi, args: jnp.stack([_phases(t, psi, args), jnp.sum(psi.real**2)])
    indexed = ds.IndexedNoise(lambda k, t, psi, args: both(t, psi, args)[k], 2)
    terms = [ds.wave_terms(_phases, x, weak_path(2)) for x in (both, indexed)]
    fields = jax.jit(lambda y: [x.terms[1].vf(0.4, y, None) for x in terms])(y)
    np.testing.assert_allclose(*fields, atol=1e-15)


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

    x = 0.7 * np.random.default_rng(0).normal(size=(50, 6))
    drift, diffusion = jax.jit(jax.vmap(both))(x)
    assert np.min(np.abs(drift)) > 1e-5
    np.testing.assert_allclose(drift, diffusion, rtol=1e-10, atol=1e-12)


def test_length_is_kept_in_five_hundred_random_steps():
    solver = by_picard(ds.ImplicitMidpoint())
    rng = np.random.default_rng(0)
    psi = 0.6 * _random((500, 2, 3))
    h = np.exp(rng.uniform(np.log(1e-3), np.log(0.1), 500))
    kicks = np.clip(rng.normal(size=(500, 2, 3, 3)), -2.5, 2.5)

    def change(psi, h, kicks):
        given, y0 = Given(jnp.sqrt(h) * kicks), ds.to_pair(psi)
        alpha = jnp.array([0.2, 0.5])
        terms = ds.wave_terms(_field_and_square, _thermal, given, alpha)
        y1, *_ = solver.step(terms, 0.0, h, y0, 0.2, None, False)
        lengths = [jnp.linalg.norm(ds.from_pair(y), axis=-1) for y in (y0, y1)]
        return jnp.max(jnp.abs(lengths[1] / lengths[0] - 1))

    assert jnp.max(jax.jit(jax.vmap(change))(psi, h, kicks)) <= 1e-13


def test_what_are_no_waves_is_told():
    path, psi = weak_path(3), _random((3,))
    y0, x = ds.to_pair(psi), np.ones(2)
    for wrong in (psi, (psi, psi), x, [x, x], (x, np.ones(4)), (x, {"a": x})):
        with pytest.raises(ValueError, match=r"for complex amplitudes `y0=to_pair"):
            ds.from_pair(wrong)  # pyright: ignore
    # Complex states are told of `wave_terms`.
    holomorphic = lambda t, p, q, args: jnp.sum(jnp.abs(p * q))
    plain = diffrax.ODETerm(lambda t, y, args: 1j * y)
    each = lambda t, psi, args: jnp.abs(psi)
    waves = ds.wave_terms(_phases, each, path)
    for terms, y, says in (
        (waves, psi, r"complex amplitudes `y0=to_pair\(psi0\)`"),
        (ds.hamiltonian_terms(holomorphic), (psi, psi), "wave_terms"),
        (plain, psi, "`wave_terms.*real and imaginary parts"),
    ):
        with pytest.raises(ValueError, match=says):
            diffrax.diffeqsolve(terms, ds.ImplicitMidpoint(), 0, 1, 0.1, y)
    # Hamiltonians that return complex numbers or take other arguments.
    wrong = lambda t, psi, args: jnp.conj(psi) @ psi
    with pytest.raises(ValueError, match="`H0` must return real numbers.*jnp.real"):
        ds.wave_terms(wrong).terms[0].vf(0.0, y0, None)
    complex_noise = ds.wave_terms(wrong, lambda t, psi, args: psi, path).terms[1]
    with pytest.raises(ValueError, match="`noise` must return real numbers"):
        complex_noise.vf(0.0, y0, None)
    swapped = lambda t, p, q, args: 0.0
    with pytest.raises(ValueError, match=r"called as `noise\(t, psi, args\)`"):
        ds.wave_terms(wrong, swapped, path)  # pyright: ignore
    with pytest.raises(
        ValueError, match=r"called as `noise\(t, psi, args\)`; got None"
    ):
        ds.wave_terms(wrong, None, path)
    with pytest.raises(ValueError, match="use a solver for general systems"):
        ds.StormerVerlet().init(waves, 0.0, 0.1, y0, 1.0)


def test_dampings_of_waves_that_are_none_are_refused():
    with pytest.raises(ValueError, match="`damping` must be a number"):
        ds.wave_terms(_field_and_square, damping=-0.1)
    y0 = ds.to_pair(np.ones((2, 3)))
    for shape in ((3,), (1,), (2, 1)):
        terms = ds.wave_terms(_field_and_square, damping=np.ones(shape))
        with pytest.raises(ValueError, match=r"one for each vector.*\(2,\)"):
            terms.terms[0].vf(0.0, y0, None)
    damped = ds.wave_terms(lambda t, psi, args: 0.0, damping=1.0)
    for psi in ({"a": np.ones(2)}, np.array(1.0)):
        with pytest.raises(ValueError, match="in one array"):
            damped.terms[0].vf(0.0, ds.to_pair(psi), None)
    with pytest.raises(ValueError, match="complex amplitudes `y0=to_pair"):
        damped.terms[0].vf(0.0, np.ones(2), None)  # pyright: ignore
