"""Spins with damping: at a temperature they have the law of Gibbs."""

from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import Given, local_weak_orders, slope, weak_path
from .test_spins import _problem, H0, noise


def test_solutions_push_forward_to_the_landau_lifshitz_equation():
    s, args = _problem(jr.key(0), 40, 3)
    alpha = jr.uniform(jr.key(1), (40,))
    y = ds.to_spinors(s)
    gradient = jax.grad(lambda s: H0(0.4, s, args))(s)
    for damping in (alpha, 0.3, 0.0):
        drift, _ = ds.spin_terms(H0, noise, weak_path(3), damping).terms
        _, velocity = jax.jvp(ds.from_spinors, (y,), (drift.vf(0.4, y, args),))
        turn = jnp.cross(s, gradient)
        rate = jnp.reshape(jnp.broadcast_to(damping, 40), (40, 1))
        expected = turn + rate * jnp.cross(s, turn)
        np.testing.assert_allclose(velocity, expected, atol=1e-14)
        # The energy falls at this rate.
        power = jnp.sum(gradient * velocity)
        np.testing.assert_allclose(
            power, -jnp.sum(rate * turn**2), rtol=1e-12, atol=1e-15
        )


def test_gilberts_form_is_the_same_equation_in_another_time():
    s0, args = _problem(jr.key(0), 1, 3)
    s, damping = s0 / jnp.linalg.norm(s0), 0.3
    y = ds.to_spinors(s)
    drift, _ = ds.spin_terms(H0, noise, weak_path(3), damping).terms
    _, velocity = jax.jvp(ds.from_spinors, (y,), (drift.vf(0.4, y, args),))
    velocity = velocity / (1 + damping**2)
    turn = jnp.cross(s, jax.grad(H0, 1)(0.4, s, args))
    expected = turn + damping * jnp.cross(s, velocity)
    np.testing.assert_allclose(velocity, expected, atol=1e-14)


def test_dampings_fit_lattices_of_spins_and_take_their_precision():
    s = _problem(jr.key(0), 6, 3, jnp.float32)[0]
    alpha = np.linspace(0.0, 1.0, 6)
    args = _problem(jr.key(0), 6, 3, jnp.float32)[1]

    def velocity(*lattice):
        y = ds.to_spinors(s.reshape(*lattice, 3))
        terms = ds.spin_terms(H0, noise, weak_path(3), alpha.reshape(lattice))
        return terms.terms[0].vf(jnp.float32(0.4), y, args)

    for flat, shaped in zip(velocity(6), velocity(2, 3)):
        assert shaped.dtype == jnp.float32
        np.testing.assert_array_equal(shaped.reshape(6, 2), flat)


# One solver for each kind of step: one system of equations, several, and those that make
# vector fields of brackets.
@pytest.mark.parametrize(
    "solver, dtype, bound",
    [
        (ds.ImplicitMidpoint(), jnp.float64, 1e-13),
        pytest.param(ds.ImplicitMidpoint(), jnp.float32, 1e-5, marks=pytest.mark.slow),
        pytest.param(ds.NinomiyaVictoir(), jnp.float64, 1e-13, marks=pytest.mark.slow),
        pytest.param(ds.PlateauGauss(), jnp.float64, 1e-13, marks=pytest.mark.slow),
    ],
    ids=[
        "ImplicitMidpoint",
        "float32",
        "NinomiyaVictoir",
        "PlateauGauss",
    ],
)
def test_length_is_kept_for_a_thousand_random_systems(solver, dtype, bound):
    def change(key):
        k_problem, k_h, k_W, k_A, k_alpha = jr.split(key, 5)
        s0, args = _problem(k_problem, 2, 3, dtype)
        h = jnp.exp(jr.uniform(k_h, (), dtype, jnp.log(1e-3), jnp.log(0.2)))
        W = jnp.sqrt(h) * jnp.clip(jr.normal(k_W, (3,), dtype), -2.5, 2.5)
        A = h / 2 * jr.normal(k_A, (3, 3), dtype)
        given = Given(W, H=W[::-1] / 4, A=A - A.T, two_point=jnp.sign(W))
        alpha = jr.uniform(k_alpha, (2,), dtype)
        terms = ds.spin_terms(H0, noise, given, damping=alpha)
        y0 = ds.to_spinors(s0)
        y1, *_ = solver.step(terms, 0 * h, h, y0, args, None, False)
        before, after = (jnp.linalg.norm(ds.from_spinors(y), axis=-1) for y in (y0, y1))
        return jnp.max(jnp.abs(after / before - 1))

    changes = jax.jit(jax.vmap(change))(jr.split(jr.key(0), 1000))
    assert changes.dtype == dtype
    assert jnp.max(changes) <= bound


@pytest.mark.slow
def test_ninomiya_victoir_keeps_weak_order_two_with_damping():
    path = weak_path(2, two_point=True)
    terms = ds.spin_terms(H0, noise, path, damping=0.6)
    s0, args = jax.vmap(lambda key: _problem(key, 1, 2))(jr.split(jr.key(5), 2))

    def fn(t, y, args):
        s = ds.from_spinors(y)[0]
        return jnp.stack([s[2], s[0] * s[1], jnp.exp(s[1] / 2)])

    hs = np.array([0.008, 0.004, 0.002, 0.001])
    y0 = ds.to_spinors(s0)
    solver = ds.NinomiyaVictoir()
    slopes = local_weak_orders(terms, solver, y0, args, hs, order=2, fn=fn)
    np.testing.assert_allclose(slopes, 3.0, atol=0.1)


def _warm_terms(H: Callable, path, alpha: float, T: float) -> diffrax.MultiTerm:
    """The Landau-Lifshitz equation whose stationary density is exp(-H / T)."""
    noise = lambda t, s, args: jnp.sqrt(2 * alpha * T) * s
    return ds.spin_terms(lambda t, s, args: H(s), noise, path, damping=alpha)


def _stationary_bias(
    H: Callable, what: Callable, solver, hs, alpha: float, T: float, degree: int = 7
) -> np.ndarray:
    """What is too much in the means of `what(s)`, polynomials of one spin of length 1, in
    the stationary law of steps of each size `hs`. Without sampling.

    On the polynomials of the sphere up to `degree` (that is, its spherical harmonics),
    made orthonormal in the density of Gibbs, a step is a matrix M of the means of
    f_i(s0) f_j(s1). The moments c_j = E f_j of the stationary law solve c = c M, c_0 = 1.
    """
    n = 2 * degree + 4
    z, weights = np.polynomial.legendre.leggauss(n)
    phi = 2 * np.pi * np.arange(2 * n) / (2 * n)
    z, phi = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - z**2)
    s = jnp.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    weights = np.repeat(weights, 2 * n) * np.exp(-np.asarray(jax.vmap(H)(s)) / T)
    weights /= np.sum(weights)

    def powers(s):
        w = s[0] + 1j * s[1]
        values = [
            part * s[2] ** k
            for m in range(degree + 1)
            for part in ([(w**m).real, (w**m).imag][: 1 + (m > 0)])
            for k in range(degree - m + 1)
        ]
        return jnp.stack(values)

    weighted = lambda fn: np.sqrt(weights)[:, None] * np.asarray(jax.vmap(fn)(s))
    Q, R = np.linalg.qr(weighted(powers))
    # The first polynomial is 1, and not -1.
    Q, R = Q * np.sign(R[0, 0]), R * np.sign(R[0, 0])
    terms = _warm_terms(H, solver.path((3,), jr.key(0), want="weak"), alpha, T)

    @jax.jit
    def after(h):
        fn = lambda t, y, args: powers(ds.from_spinors(y))
        mean = lambda s: ds.step_expectation(
            terms, solver, 0.0, h, ds.to_spinors(s), fn=fn
        )
        return jax.lax.map(mean, s, batch_size=16)

    seen = Q.T @ weighted(what)
    biases = []
    for h in hs:
        f1 = np.linalg.solve(R.T, np.asarray(after(h)).T).T
        M = Q.T @ (np.sqrt(weights)[:, None] * f1)
        c = np.linalg.solve((np.eye(len(M)) - M)[1:, 1:].T, M[0, 1:])
        biases.append(c @ seen[1:])
    return np.array(biases)


@pytest.mark.slow
def test_stationary_law_of_one_spin_is_that_of_gibbs_up_to_the_square_of_the_step():
    # In a field, with an easy axis beside it.
    H = lambda s: -0.5 * s[2] - 0.4 * s[0] ** 2
    what = lambda s: jnp.stack([s[2], s[0] ** 2])
    hs = np.array([0.4, 0.2, 0.1])
    solver = ds.NinomiyaVictoir()
    # Beyond this degree the biases change in their fourth digit.
    bias = _stationary_bias(H, what, solver, hs, alpha=0.5, T=0.6, degree=5)
    assert np.max(np.abs(bias[-1])) <= 1e-3
    for column in bias.T:
        assert abs(slope(hs, column) - 2) <= 0.15


def test_without_noise_spins_come_to_rest_along_their_field():
    field = lambda t, s, args: -jnp.sum(s @ jnp.array([0.0, 0.6, 0.8]))
    still = lambda t, s, args: 0 * s
    s0 = jnp.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.5]])
    terms = ds.spin_terms(
        field, still, ds.WeakBrownianPath((2, 3), jr.key(0)), damping=0.5
    )
    end = diffrax.diffeqsolve(
        terms, ds.ImplicitMidpoint(), 0, 60, 0.2, ds.to_spinors(s0)
    ).ys
    s1 = ds.from_spinors(end)[-1]
    expected = jnp.linalg.norm(s0, axis=-1)[:, None] * jnp.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(s1, expected, atol=1e-10)


@pytest.mark.slow
def test_gradients_with_respect_to_damping_and_parameters():
    H = lambda t, s, args: -jnp.sum(args * s[..., 2]) - jnp.sum(s[1:] * s[:-1])
    s0, _ = _problem(jr.key(0), 4, 1)
    path = ds.WeakBrownianPath((4, 3), jr.key(0))
    weights = np.random.default_rng(1).normal(size=(4, 3))

    def end(alpha, args):
        terms = ds.spin_terms(H, lambda t, s, args: 0.3 * s, path, damping=alpha)
        solver = ds.ImplicitMidpoint()
        sol = diffrax.diffeqsolve(terms, solver, 0, 1, 0.25, ds.to_spinors(s0), args)
        return jnp.sum(ds.from_spinors(sol.ys)[-1] * weights)

    # One program for the gradient and for the values that are compared to it.
    both = jax.jit(jax.value_and_grad(end, argnums=(0, 1)))
    k = 1e-5
    gradients = both(0.4, 0.7)[1]
    slopes = [
        (both(0.4 + k, 0.7)[0] - both(0.4 - k, 0.7)[0]) / (2 * k),
        (both(0.4, 0.7 + k)[0] - both(0.4, 0.7 - k)[0]) / (2 * k),
    ]
    np.testing.assert_allclose(gradients, slopes, rtol=1e-8)


def test_dampings_that_are_none_are_refused():
    path = weak_path(3)
    array = jnp.array([0.1, -0.1])
    for wrong in (-0.1, jnp.nan, jnp.inf, 1j, "much", array, array > -1, 1j * array):
        with pytest.raises(ValueError, match="`damping` must be a number"):
            ds.spin_terms(H0, noise, path, damping=wrong)  # pyright: ignore
    y0 = ds.to_spinors(jnp.ones((2, 3)))
    args = _problem(jr.key(0), 2, 3)[1]
    for shape in ((3,), (1,), (2, 1)):
        terms = ds.spin_terms(H0, noise, path, damping=jnp.ones(shape))
        with pytest.raises(ValueError, match=r"one for each spin, of shape \(2,\)"):
            terms.terms[0].vf(0.0, y0, args)
    each = ds.spin_terms(lambda t, s, args: s, noise, path, damping=1.0)
    with pytest.raises(ValueError, match="`H0` must return a scalar"):
        each.terms[0].vf(0.0, y0, args)
    for solver in (ds.StormerVerlet(), ds.SRKw5(), ds.BAOAB()):
        damped = ds.spin_terms(H0, noise, path, damping=1.0)
        with pytest.raises(ValueError, match="use a solver for general systems"):
            solver.init(damped, 0.0, 0.1, y0, args)

    @jax.jit
    @jax.vmap
    def run(alpha):
        terms = ds.spin_terms(H0, noise, path, damping=alpha)
        sol = diffrax.diffeqsolve(
            terms, ds.ImplicitMidpoint(), 0, 0.2, 0.1, y0, args, throw=False
        )
        return sol.result == diffrax.RESULTS.successful

    np.testing.assert_array_equal(
        run(jnp.array([0.5, -0.5, jnp.nan, jnp.inf])), [True, False, False, False]
    )
