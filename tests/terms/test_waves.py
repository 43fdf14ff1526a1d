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


X = np.array([[0, 1], [1, 0]], complex)
Z = np.array([[1, 0], [0, -1]], complex)


def _random(key, shape=(3,), dtype=jnp.complex128):
    return jr.normal(key, shape, dtype)


def _lattice(t, psi, args):
    hops = jnp.sum(jnp.abs(jnp.roll(psi, 1) - args * psi) ** 2)
    return hops - jnp.sum(jnp.abs(psi) ** 4) / 2 + jnp.sum(jnp.cos(t + psi.real))


def _site_noise(t, psi, args):
    return jnp.stack([jnp.sum(jnp.abs(psi) ** 4), jnp.sum(psi.real * psi.imag)])


@pytest.mark.core
def test_solutions_push_forward_to_the_equation_of_amplitudes():
    args, W = 1.2 - 0.4j, jnp.array([0.3, -0.7])
    drift, diffusion = ds.wave_terms(_lattice, _site_noise, weak_path(2)).terms

    @jax.jit
    def both_sides(psi):
        y = ds.to_pair(psi)
        sides = []
        for dy, H in (
            (drift.vf(0.4, y, args), lambda psi: _lattice(0.4, psi, args)),
            (
                diffusion.vf_prod(0.4, y, args, W),
                lambda psi: _site_noise(0.4, psi, args) @ W,
            ),
        ):
            _, velocity = jax.jvp(ds.from_pair, (y,), (dy,))
            sides.append((1j * velocity, _by_conjugate(H, psi)))
        return sides

    for velocity, expected in both_sides(_random(jr.key(0))):
        np.testing.assert_allclose(velocity, expected, atol=1e-14)


def _by_conjugate(H, psi):
    """The derivative by psi*: half of the one by Re psi plus i times that by Im psi."""
    by_parts = jax.grad(lambda x, y: H(x + 1j * y), argnums=(0, 1))
    dx, dy = by_parts(psi.real, psi.imag)
    return (dx + 1j * dy) / 2


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
    p, q, psi = (jax.tree.map(np.asarray, x) for x in (p, q, psi))
    energy = jax.tree.map(lambda p, q: np.sum(p**2 + q**2) / 2, p, q)
    jax.tree.map(lambda e, x: same(e, np.sum(np.abs(x) ** 2)), energy, psi)


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


# A noisy qubit: i dpsi = H psi dt + A psi o dw. The mean of psi psi^dagger follows
# d rho / dt = -i [H, rho] - [A, [A, rho]] / 2.
H = X / 2 + 0.3 * Z
A = 0.3 * (Z + X / 2)
QUBIT = np.array([np.sqrt(0.9), np.sqrt(0.1) * 1j])


def _mean(matrix, psi):
    return jnp.real(jnp.conj(psi) @ matrix @ psi)


def _qubit(path):
    return ds.wave_terms(
        lambda t, psi, args: _mean(H, psi), lambda t, psi, args: _mean(A, psi), path
    )


def _lindblad(t):
    """The density matrix."""
    commutator = lambda M: np.kron(M, np.eye(2)) - np.kron(np.eye(2), M.T)
    L = -1j * commutator(H) - commutator(A) @ commutator(A) / 2
    rho = np.outer(QUBIT, np.conj(QUBIT)).ravel()
    return (scipy.linalg.expm(t * L) @ rho).reshape(2, 2)


def _densities(solver, t: float, numbers):
    """The density matrix by so many steps, without sampling: of the mean of p, q and their
    products."""
    y0 = ds.to_pair(jnp.asarray(QUBIT))
    terms = _qubit(ds.WeakBrownianPath((), jr.key(0)))
    one_step = jax.jit(lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0))
    flat = np.concatenate([np.ones(1), *y0])
    for steps in numbers:
        K = np.asarray(one_step(t / steps))
        moments = np.linalg.matrix_power(K, steps) @ np.kron(flat, flat)
        m = moments.reshape(5, 5)[1:, 1:]  # of p1, p2, q1, q2
        pp, pq, qp, qq = m[:2, :2], m[:2, 2:], m[2:, :2], m[2:, 2:]
        yield (qq + pp + 1j * (pq - qp)) / 2


@pytest.mark.parametrize(
    "solver, order",
    [(by_picard(ds.SRKw1()), 1), (by_picard(ds.StrangGauss()), 2)],
    ids=["SRKw1", "StrangGauss"],
)
def test_noisy_qubit_has_the_density_matrix_of_lindblad_without_sampling(solver, order):
    steps = np.array([16, 32, 64])
    found = np.stack([*_densities(solver, 2.0, steps)])
    np.testing.assert_allclose(np.trace(found, axis1=1, axis2=2), 1.0, rtol=1e-12)
    errors = np.max(np.abs(found - _lindblad(2.0)), axis=(1, 2))
    assert abs(slope(1 / steps, errors) - order) <= 0.1
    assert errors[-1] <= (1e-2 if order == 1 else 1e-4)


PSI0 = jnp.array([0.6, 0.8j])


def test_gradients_with_respect_to_complex_parameters_are_those_of_jax():
    H0 = lambda t, psi, z: jnp.real(z * jnp.conj(psi[0]) * psi[1])
    noise = lambda t, psi, z: jnp.abs(z * psi[0]) ** 2
    terms = ds.wave_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))

    @jax.jit
    @ft.partial(jax.value_and_grad, argnums=(0, 1))
    def both(z, psi0):
        at = terms, 0.0, 0.5, ds.to_pair(psi0), z, None, False
        y1, *_ = by_picard(ds.ImplicitMidpoint()).step(*at)
        return jnp.abs(ds.from_pair(y1)[0]) ** 2

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
    both = [ds.wave_terms(_lattice, x, weak_path(2)) for x in (_site_noise, indexed)]
    fields = jax.jit(lambda y: [terms.terms[1].vf(0.4, y, 1.1) for terms in both])(y)
    np.testing.assert_allclose(*fields, atol=1e-15)


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


def _path(*shape):
    return ds.WeakBrownianPath((*shape, shape[-1]), jr.key(0))


def test_solutions_push_forward_to_the_damped_equation_of_amplitudes():
    psi = _random(jr.key(0), (40, 3)) / 3
    dampings = jr.uniform(jr.key(1), (40,)), 0.3, 0.0

    @jax.jit
    def slope_and_velocities(psi):
        y = ds.to_pair(psi)
        push = lambda vf: jax.jvp(ds.from_pair, (y,), (vf,))[1]
        terms = [ds.wave_terms(_phases, _thermal, _path(40, 3), x) for x in dampings]
        velocities = [push(x.terms[0].vf(0.4, y, None)) for x in terms]
        return _by_conjugate(lambda psi: _phases(0.4, psi, None), psi), velocities

    g, velocities = jax.tree.map(np.asarray, slope_and_velocities(psi))
    psi = np.asarray(psi)
    dot = lambda a, b: np.sum(np.conj(a) * b, axis=-1, keepdims=True)
    for damping, velocity in zip(dampings, velocities):
        rate = np.reshape(np.broadcast_to(damping, 40), (40, 1))
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
    both = ds.spin_terms(H0, damping=2 * ALPHA), ds.wave_terms(as_waves, damping=ALPHA)
    field = lambda s, terms: terms.terms[0].vf(0.0, ds.to_spinors(s), None)
    fields = jax.jit(lambda s: [field(s, terms) for terms in both])(s)
    np.testing.assert_allclose(*fields, atol=1e-14)


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
        alpha, y0 = jnp.array([0.2, 0.5]), ds.to_pair(_random(k_psi, (2, 3)))
        terms = ds.wave_terms(_field_and_square, _thermal, Given(W), alpha)
        y1, *_ = ds.ImplicitMidpoint().step(terms, 0.0, h, y0, 0.2, None, False)
        lengths = [jnp.linalg.norm(ds.from_pair(y), axis=-1) for y in (y0, y1)]
        return jnp.max(jnp.abs(lengths[1] / lengths[0] - 1))

    changes = jax.jit(jax.vmap(change))(jr.split(jr.key(0), 500))
    assert jnp.max(changes) <= 1e-13


def test_dampings_of_waves_that_are_none_are_refused():
    path = _path(2, 3)
    with pytest.raises(ValueError, match="`damping` must be a number"):
        ds.wave_terms(_anisotropy, _thermal, path, damping=-0.1)
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
