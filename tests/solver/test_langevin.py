"""Positions, momenta and transport of Langevin dynamics, and the noise of a temperature."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.linalg

import diffrax_symplectic as ds

from ..problems import Given, weak_path


GAMMA, MASS, T, STIFFNESS = 0.7, 2.0, 0.5, 1.6
# A tensor of friction between unequal masses, of which the rates are not symmetric.
TENSOR = jnp.array([[1.0, 0.3, 0.0], [0.3, 0.5, -0.2], [0.0, -0.2, 0.7]])
MASSES = jnp.array([1.0, 4.0, 0.5])


def _path(shape):
    return ds.FixedStepBrownianPath(shape, jr.key(0))


def stationary_moments(terms, solver, h, y0):
    """Second moments of (p, q), exactly."""
    of = lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0)
    K = np.asarray(jax.jit(of)(h))
    n = round(len(K) ** 0.5)
    A = np.eye(n * n - 1) - K[1:, 1:]
    moments = np.append(1.0, np.linalg.solve(A, K[1:, 0]))
    return moments.reshape(n, n)[1:, 1:]


def well(gamma):
    H0 = lambda t, p, q, args: p**2 / (2 * MASS) + STIFFNESS * q**2 / 2
    return ds.hamiltonian_terms(H0, ds.thermal_noise(gamma, MASS, T), _path(()))


ORIGIN = jnp.zeros(()), jnp.zeros(())


@pytest.mark.parametrize("h", [0.2, 0.5, 1.0])
def test_positions_and_momenta_in_a_harmonic_well_have_the_law_of_gibbs(h):
    moments = stationary_moments(well(GAMMA), ds.LangevinMiddle(GAMMA), h, ORIGIN)
    exact = np.array([[MASS * T, h * T / 2], [h * T / 2, T / STIFFNESS]])
    np.testing.assert_allclose(moments, exact, rtol=1e-14)


@pytest.mark.parametrize("h", [0.2, 0.5, 1.0])
def test_momenta_of_baoab_are_too_cold_by_a_known_factor(h):
    moments = stationary_moments(well(GAMMA), ds.BAOAB(GAMMA), h, ORIGIN)
    cold = 1 - STIFFNESS / MASS * h**2 / 4
    exact = np.diag([MASS * T * cold, T / STIFFNESS])
    np.testing.assert_allclose(moments, exact, rtol=1e-14, atol=1e-15)


LANGEVIN = pytest.mark.parametrize("make", [ds.BAOAB, ds.LangevinMiddle])


def _transport(make, gamma, h):
    """Mobility and diffusion of a free particle."""
    force = 0.3
    H0 = lambda t, p, q, args: p**2 / (2 * MASS) - force * q
    still = ds.hamiltonian_terms(
        H0, ds.thermal_noise(gamma, MASS, T), Given(0.0 * ORIGIN[0])
    )
    solver = make(gamma)

    def step(p):
        state = solver.init(still, 0.0, h, (p, 0 * p), None)
        return solver.step(still, 0.0, h, (p, 0 * p), None, state, False)[0]

    at_rest, at_one = step(jnp.array(0.0)), step(jnp.array(1.0))
    p = at_rest[0] / (1 - at_one[0] + at_rest[0])  # the momentum that stays
    mobility = step(p)[1] / h / force
    free = lambda t, p, q, args: p**2 / (2 * MASS)
    terms = ds.hamiltonian_terms(free, ds.thermal_noise(gamma, MASS, T), _path(()))
    K = np.asarray(ds.second_moment_map(terms, solver, 0.0, h, ORIGIN))
    # What the start has left decays by exp(-gamma h) in each step.
    before = np.linalg.matrix_power(K, round(40 / gamma / h))
    return mobility, ((K @ before)[-1, 0] - before[-1, 0]) / (2 * h)


@LANGEVIN
@pytest.mark.parametrize("h", [0.3, 1.5])
def test_transport_is_too_fast_by_a_known_factor_and_exact_at_another_friction(make, h):
    x = GAMMA * h / 2
    exact = np.array([1, T]) / (GAMMA * MASS)
    np.testing.assert_allclose(
        _transport(make, GAMMA, h), exact * x / np.tanh(x), 1e-12
    )
    other = 2 / h * np.arctanh(x)
    np.testing.assert_allclose(_transport(make, other, h), exact, 1e-12)


def _pendula(t, p, q, args):
    return jnp.sum(p**2 / MASSES) / 2 + jnp.sum(jnp.sin(q)) * jnp.cos(t) + jnp.prod(q)


def _solved(solver, terms, y0, t1=1.0):
    sol = diffrax.diffeqsolve(terms, solver, 0.0, t1, t1 / 4, y0, max_steps=4)
    return jnp.stack([x[-1] for x in sol.ys])


def test_both_take_the_same_steps_in_other_variables():
    noise = lambda t, p, q, args: -0.4 * q
    terms = ds.hamiltonian_terms(_pendula, noise, weak_path(3))
    y0 = jnp.ones(3), jnp.array([0.3, -0.2, 0.5])
    half_kick = lambda t, p, q: (p - 0.125 * jax.grad(_pendula, 2)(t, p, q, None), q)
    middle = _solved(ds.LangevinMiddle(GAMMA), terms, y0)
    baoab = _solved(ds.BAOAB(GAMMA), terms, half_kick(0.0, *y0))
    np.testing.assert_allclose(half_kick(1.0, *middle), baoab, atol=1e-14)


@LANGEVIN
def test_a_friction_tensor_between_unequal_masses_keeps_the_temperature(make):
    springs = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.0], [0.1, 0.0, 1.5]])
    H0 = lambda t, p, q, args: jnp.sum(p**2 / (2 * MASSES)) + q @ springs @ q / 2
    gamma, h = TENSOR / MASSES, 0.4
    terms = ds.hamiltonian_terms(H0, ds.thermal_noise(gamma, MASSES, T), _path((3,)))
    moments = stationary_moments(terms, make(gamma), h, (jnp.zeros(3),) * 2)
    np.testing.assert_allclose(moments[3:, 3:] @ springs, T * np.eye(3), atol=1e-13)
    momenta = T * np.diag(MASSES)
    if make is ds.BAOAB:
        momenta = momenta - T * springs * h**2 / 4
    np.testing.assert_allclose(moments[:3, :3], momenta, atol=1e-13)


@pytest.mark.parametrize(
    "wrap", [ds.LangevinMiddle, lambda g: ds.Damped(ds.StormerVerlet(), g)]
)
def test_momenta_fall_as_the_exponential_of_a_friction_tensor_says(wrap):
    free = lambda t, p, q, args: jnp.sum(p**2 / (2 * MASSES))
    nothing = lambda t, p, q, args: 0 * q
    terms = ds.hamiltonian_terms(free, nothing, Given(jnp.zeros(3)))
    p, q = jnp.array([1.0, 2.0, -0.5]), jnp.zeros(3)
    for t1 in (0.8, -0.8):
        end = _solved(wrap(TENSOR / MASSES), terms, (p, q), t1)[0]
        exact = scipy.linalg.expm(-t1 * np.asarray(TENSOR / MASSES)) @ p
        np.testing.assert_allclose(end, exact, rtol=1e-13)


def test_gradients_with_respect_to_a_friction_tensor_and_its_temperature():
    y0 = jnp.ones(3), jnp.array([0.3, -0.2, 0.5])

    def end(tensor, T):
        gamma = tensor / MASSES
        noise = ds.thermal_noise(gamma, MASSES, T)
        terms = ds.hamiltonian_terms(_pendula, noise, weak_path(3))
        return jnp.sum(_solved(ds.LangevinMiddle(gamma), terms, y0) ** 2)

    change, k = jnp.array([[0.3, -0.2, 0.1], [-0.2, 0.5, 0.0], [0.1, 0.0, -0.4]]), 1e-5
    both = jax.jit(jax.value_and_grad(end, (0, 1)))
    slope = lambda dT, dG: (
        (both(TENSOR + k * dG, T + k * dT)[0] - both(TENSOR - k * dG, T - k * dT)[0])
        / (2 * k)
    )
    _, (by_tensor, by_T) = both(TENSOR, T)
    np.testing.assert_allclose(jnp.sum(by_tensor * change), slope(0, change), rtol=1e-7)
    np.testing.assert_allclose(by_T, slope(1, 0 * change), rtol=1e-7)


def test_rates_that_no_masses_make_symmetric_are_refused_and_traced_fail_alone():
    terms = ds.hamiltonian_terms(_pendula, lambda t, p, q, args: 0.1 * q, weak_path(3))
    y0 = jnp.ones(3), jnp.ones(3)
    for make in (ds.BAOAB, lambda g: ds.Damped(ds.StormerVerlet(), g)):
        # Divided along the wrong axis.
        solver = make(TENSOR / MASSES[:, None])
        with pytest.raises(ValueError, match="masses of H0, but it is not symmetric"):
            solver.init(terms, 0.0, 0.1, y0, None)
    # In a solve the masses are traced, and the numbers of the friction are not.
    with pytest.raises(RuntimeError, match="masses of H0, but it is not symmetric"):
        jax.jit(lambda y0: solver.init(terms, 0.0, 0.1, y0, None))(y0)

    @eqx.filter_jit
    @jax.vmap
    def run(gamma):
        solver = ds.LangevinMiddle(gamma)
        sol = diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, throw=False)
        says = sol.result == diffrax.RESULTS.nonfinite
        return sol.result == diffrax.RESULTS.successful, says

    good = TENSOR / MASSES
    # A symmetric one is taken as it is, whatever the masses are.
    succeeded, says = run(jnp.stack([good, TENSOR / MASSES[:, None], TENSOR, -good]))
    np.testing.assert_array_equal(succeeded, [True, False, True, False])
    np.testing.assert_array_equal(says, ~succeeded)


@pytest.mark.parametrize("omega_h", [0.1, 3.0])
def test_friction_and_noise_are_exact_beside_an_exact_flow(omega_h):
    # The step of a solver for momenta at gamma h = 1, and the flow of a harmonic well.
    h, gamma = 1.0, 1.0

    def flow(time, y, args):
        c, s = jnp.cos(omega_h * time), jnp.sin(omega_h * time)
        return c * y[0] - omega_h * s * y[1], s / omega_h * y[0] + c * y[1]

    nothing = lambda t, p, q, args: 0.0 * q
    terms = ds.hamiltonian_terms(nothing, ds.thermal_noise(gamma, 1.0, T), _path(()))
    exact = np.diag([T, T / omega_h**2])
    inner = ds.BAOAB(gamma)
    moments = stationary_moments(terms, ds.LinearFlow(inner, flow), h, ORIGIN)
    np.testing.assert_allclose(moments, exact, rtol=1e-13, atol=1e-14)
    # As the documentation says of another one.
    inner = ds.Damped(ds.StormerVerlet(), gamma)
    moments = stationary_moments(terms, ds.LinearFlow(inner, flow), h, ORIGIN)
    np.testing.assert_allclose(moments, exact / np.sinh(1.0), rtol=1e-13, atol=1e-14)


def _amplitudes(gamma, mass, T, q):
    """How the forces of the noises depend on their increments."""
    noise = ds.thermal_noise(gamma, mass, T)
    return jax.jacobian(lambda q: noise(0.0, q, q, None))(q)


def test_thermal_noise_is_that_of_numbers_arrays_matrices_and_trees():
    q = jnp.zeros(3)
    rates = jnp.array([0.5, 0.0, 2.0])
    for gamma, mass, at in (
        (0.7, 2.0, T),
        (rates, 2.0, T),
        (0.7, MASSES, jnp.array([T, 2 * T, 0])),
    ):
        expected = -np.diag(np.sqrt(2 * gamma * mass * at * np.ones(3)))
        np.testing.assert_allclose(
            _amplitudes(gamma, mass, at, q), expected, rtol=1e-15
        )
    for gamma, mass in ((TENSOR, 2.0), (TENSOR / MASSES, MASSES)):
        sigma = _amplitudes(gamma, mass, T, q)
        variance = 2 * T * gamma * mass
        np.testing.assert_allclose(sigma @ sigma.T, variance, atol=1e-15)
    integers = np.array([[2, 1], [1, 2]])
    sigma = _amplitudes(integers, 1, 1, jnp.zeros(2))
    np.testing.assert_allclose(sigma @ sigma.T, 2 * integers, rtol=1e-14)
    # Momenta of an array of two axes have rates of its shape, and matrices of twice it.
    flat = _amplitudes(TENSOR / MASSES, MASSES, T, q)
    matrix = (TENSOR / MASSES).reshape(3, 1, 3, 1)
    shaped = _amplitudes(matrix, MASSES[:, None], T, q[:, None])
    np.testing.assert_allclose(shaped.reshape(3, 3), flat, atol=1e-15)
    square = jnp.arange(4.0).reshape(2, 2)
    each = ds.thermal_noise(square, 1.0, 1.0)(0.0, square, square, None)
    np.testing.assert_allclose(each, -jnp.sqrt(2 * square) * square)
    # In the precision of the state.
    tree = {"a": jnp.ones(3, jnp.float32), "b": jnp.ones((), jnp.float32)}
    given = ds.thermal_noise({"a": TENSOR, "b": 0.5}, 2.0, T)(0.0, tree, tree, None)
    both = ds.thermal_noise(0.5, {"a": 1.0, "b": 2.0}, T)(0.0, tree, tree, None)
    assert {x.dtype for x in jax.tree.leaves((given, both))} == {jnp.dtype("float32")}
    np.testing.assert_allclose([given["b"], both["b"]], -1.0)
    np.testing.assert_allclose(both["a"], -np.sqrt(0.5) * np.ones(3), rtol=1e-6)


def test_thermal_noises_that_fit_nothing_are_refused_with_advice():
    q = jnp.ones(3)
    for arguments, match in (
        ((1.0, -1.0, T), "`mass` must be a real number.*finite and positive"),
        ((1.0, 1.0, jnp.inf), "`T` must be a real number.*finite and not negative"),
        ((1.0, 1.0, "hot"), "`T` must be"),
        ((-1.0, 1.0, T), "`gamma` must not be negative"),
        ((jnp.ones(2), jnp.ones(3), T), "shapes that broadcast"),
        (({"a": 1.0}, [1.0], T), "structure of `q`"),
    ):
        with pytest.raises(ValueError, match=match):
            ds.thermal_noise(*arguments)
    for arguments, match in (
        ((jnp.ones(2), 1.0, T), "shape of `q`"),
        ((TENSOR, MASSES, T), "but it is not symmetric.*gamma=Gamma / mass"),
        (({"a": 1.0}, 1.0, T), "structure of `q`"),
    ):
        with pytest.raises(ValueError, match=match):
            ds.thermal_noise(*arguments)(0.0, q, q, None)
    # Values that are not known fail when they are.
    nan = jax.jit(lambda g: ds.thermal_noise(g, MASSES, T)(0.0, q, q, None))(TENSOR)
    assert np.all(np.isnan(nan))
