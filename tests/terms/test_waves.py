"""Complex amplitudes: the pair (p, q) stands for psi."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import slope, weak_path


X = jnp.array([[0, 1], [1, 0]], complex)
Z = jnp.array([[1, 0], [0, -1]], complex)


def _mean(A, psi):
    return jnp.real(jnp.conj(psi) @ A @ psi)


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


@pytest.mark.parametrize("dtype", [jnp.complex64, jnp.complex128])
def test_amplitudes_of_pairs_give_them_back(dtype):
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


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_real_amplitudes_have_no_momentum(dtype):
    p, q = ds.to_pair(jnp.array([0.6, -0.8], dtype))
    assert p.dtype == q.dtype == dtype
    np.testing.assert_array_equal(p, 0)
    np.testing.assert_allclose(q, np.sqrt(2) * np.array([0.6, -0.8], dtype))


def test_what_are_no_pairs_of_real_arrays_is_refused():
    x, psi = jnp.ones(2), _random(jr.key(0), (2,))
    for wrong in (psi, (psi, psi), x, [x, x], (x, jnp.ones(3)), (x, {"a": x})):
        with pytest.raises(ValueError, match=r"for complex amplitudes `y0=to_pair"):
            ds.from_pair(wrong)  # pyright: ignore


@pytest.mark.parametrize(
    "solver",
    [ds.ImplicitMidpoint(), ds.SRKw1(), ds.StrangGauss(), ds.NinomiyaVictoir()],
    ids=repr,
)
@pytest.mark.slow
def test_norm_is_kept_over_ten_thousand_steps(solver):
    H0 = lambda t, psi, args: _mean(X, psi) + jnp.sum(jnp.abs(psi) ** 4)
    noise = lambda t, psi, args: 0.5 * _mean(Z, psi) + 0.2 * jnp.abs(psi[0]) ** 4
    terms = ds.wave_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    psi0 = jnp.array([0.6, 0.8j])
    norm = lambda t, y, args: jnp.sum(jnp.abs(ds.from_pair(y)) ** 2)
    sol = diffrax.diffeqsolve(
        terms, solver, 0, 1000, 0.1, ds.to_pair(psi0), max_steps=None,
        adjoint=diffrax.ForwardMode(),
        saveat=diffrax.SaveAt(ts=jnp.arange(0, 1000, 10.0), fn=norm),
    )  # fmt: skip
    # The norm is interpolated between the ends of steps, where it is the same.
    assert sol.stats["num_steps"] >= 10_000
    # One rounding error a step, all of one sign.
    bound = sol.stats["num_steps"] * jnp.finfo(sol.ys.dtype).eps
    assert jnp.max(jnp.abs(sol.ys - 1)) <= bound


# A noisy qubit: i dpsi = H psi dt + A psi o dw. The mean of psi psi^dagger follows
# d rho / dt = -i [H, rho] - [A, [A, rho]] / 2.
H, A = X / 2 + 0.3 * Z, 0.3 * (Z + X / 2)
QUBIT = np.array([np.sqrt(0.9), np.sqrt(0.1) * 1j])


def _qubit(path):
    return ds.wave_terms(
        lambda t, psi, args: _mean(H, psi), lambda t, psi, args: _mean(A, psi), path
    )


def _lindblad(t):
    """The density matrix."""
    commutator = lambda M: np.kron(M, np.eye(2)) - np.kron(np.eye(2), M.T)
    L = -1j * commutator(H) - commutator(A) @ commutator(A) / 2
    rho = np.outer(QUBIT, np.conj(QUBIT)).ravel()
    return (jax.scipy.linalg.expm(t * L) @ rho).reshape(2, 2)


def _density(solver, t: float, steps: int):
    """The density matrix by steps, without sampling: of the mean of p, q and their
    products."""
    y0 = ds.to_pair(jnp.asarray(QUBIT))
    terms = _qubit(ds.WeakBrownianPath((), jr.key(0)))
    K = ds.second_moment_map(terms, solver, 0.0, t / steps, y0)
    flat = jnp.concatenate([jnp.ones(1), *y0])
    moments = jnp.linalg.matrix_power(K, steps) @ jnp.kron(flat, flat)
    m = moments.reshape(5, 5)[1:, 1:]  # of p1, p2, q1, q2
    pp, pq, qp, qq = m[:2, :2], m[:2, 2:], m[2:, :2], m[2:, 2:]
    return (qq + pp + 1j * (pq - qp)) / 2


def _sampled(key, times, h: float):
    """<sigma_x> and <sigma_z> of one path."""
    terms = _qubit(ds.WeakBrownianPath((), key))
    sol = diffrax.diffeqsolve(
        terms, ds.StrangGauss(), 0.0, times[-1], h, ds.to_pair(jnp.asarray(QUBIT)),
        saveat=diffrax.SaveAt(ts=times), adjoint=diffrax.ForwardMode(),
        max_steps=round(times[-1] / h) + 1,
    )  # fmt: skip
    assert sol.ys is not None
    psi = ds.from_pair(sol.ys)
    return jax.vmap(lambda psi: jnp.stack([_mean(M, psi) for M in (X, Z)]))(psi)


@pytest.mark.parametrize(
    "solver, order",
    [(ds.SRKw1(), 1), (ds.StrangGauss(), 2)],
    ids=["SRKw1", "StrangGauss"],
)
def test_noisy_qubit_has_the_density_matrix_of_lindblad_without_sampling(solver, order):
    steps = np.array([16, 32, 64])
    found = jnp.stack([_density(solver, 2.0, int(n)) for n in steps])
    np.testing.assert_allclose(jnp.trace(found, axis1=1, axis2=2), 1.0, rtol=1e-12)
    errors = jnp.max(jnp.abs(found - _lindblad(2.0)), axis=(1, 2))
    assert abs(slope(1 / steps, errors) - order) <= 0.1
    assert errors[-1] <= (1e-2 if order == 1 else 1e-4)


@pytest.mark.slow
def test_noisy_qubit_sampled():
    times = np.array([1.0, 2.0])
    path = lambda key: _sampled(key, times, 0.1)
    values = jax.jit(jax.vmap(path))(jr.split(jr.key(0), 4000))
    rho = jnp.stack([_lindblad(t) for t in times])
    exact = [jnp.trace(rho @ M, axis1=1, axis2=2).real for M in (X, Z)]
    error = jnp.mean(values, axis=0) - jnp.stack(exact, axis=-1)
    standard_error = jnp.std(values, axis=0) / np.sqrt(len(values))
    assert jnp.max(standard_error) <= 0.01
    assert jnp.max(jnp.abs(error) / standard_error) <= 3


def test_gradients_with_respect_to_complex_parameters_are_those_of_jax():
    H0 = lambda t, psi, z: jnp.real(z * jnp.conj(psi[0]) * psi[1])
    noise = lambda t, psi, z: jnp.abs(z * psi[0]) ** 2
    terms = ds.wave_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))

    @jax.jit
    @ft.partial(jax.value_and_grad, argnums=(0, 1))
    def both(z, psi0):
        solver = ds.ImplicitMidpoint()
        sol = diffrax.diffeqsolve(terms, solver, 0, 1, 0.25, ds.to_pair(psi0), z)
        return jnp.abs(ds.from_pair(sol.ys)[-1, 0]) ** 2

    z, k = 0.7 - 0.2j, 1e-6
    gradient, by_start = both(z, QUBIT)[1]
    # One program for the gradient and for the values that are compared to it.
    loss = lambda z, psi0: both(z, psi0)[0]
    along = lambda d: (loss(z + k * d, QUBIT) - loss(z - k * d, QUBIT)) / (2 * k)
    np.testing.assert_allclose(gradient, along(1) - 1j * along(1j), rtol=1e-7)
    unit = np.array([0, 1j])
    difference = (loss(z, QUBIT + k * unit) - loss(z, QUBIT - k * unit)) / (2 * k)
    np.testing.assert_allclose(-by_start[1].imag, difference, rtol=1e-7)


def test_noises_of_waves_may_be_indexed():
    path = weak_path(2, two_point=True)
    y0 = ds.to_pair(_random(jr.key(0)))
    indexed = ds.IndexedNoise(lambda k, t, psi, args: _site_noise(t, psi, args)[k], 2)
    solver = ds.NinomiyaVictoir()

    def end(y0, fields):
        terms = ds.wave_terms(_lattice, fields, path)
        return ds.from_pair(solver.step(terms, 0.0, 0.1, y0, 1.1, None, False)[0])

    ends = jax.jit(lambda y0: [end(y0, fields) for fields in (_site_noise, indexed)])
    np.testing.assert_allclose(*ends(y0), atol=1e-15)


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
