"""Systems that people bring, by what is known of them exactly: `docs/hard_cases.md`."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from examples.hard_cases import double_well, learning, rods, two_body
from examples.hard_cases._ensemble import ensemble, Mean, truncated


pytestmark = pytest.mark.slow


def test_two_bodies_keep_their_angular_momentum_and_gain_energy_as_they_should():
    s, per_orbit = 0.03, 400
    r = two_body.orbits(*two_body.SOLVERS["ImplicitMidpoint"], per_orbit, 4, s, 64)
    assert r.failed_share == 0
    assert r.momentum_error <= 5e-14
    balance = r.balance(two_body.PERIOD / per_orbit, s)
    assert abs(balance.sigmas) <= 4


def test_two_body_steps_fail_exactly_where_they_have_no_solution():
    def step(key):
        k_p, k_q, k_h = jr.split(key, 3)
        p, q = jr.normal(k_p, (2,)), jr.normal(k_q, (2,))
        h = jnp.exp(jr.uniform(k_h, (), minval=jnp.log(0.02), maxval=jnp.log(0.5)))
        # Without noise: the path is not used.
        drift = two_body.make_terms(diffrax.UnsafeBrownianPath((), key)).terms[0]
        *_, result = ds.ImplicitMidpoint().step(drift, 0.0, h, (p, q), 0.0, None, False)
        solved = result == diffrax.RESULTS.successful
        return solved, two_body.midpoint_solvable(p, q, h)

    solved, solvable = map(np.asarray, jax.vmap(step)(jr.split(jr.key(0), 4096)))
    assert not np.any(solved & ~solvable)
    assert np.mean(~solvable) > 0.01
    # Next to the fold some that exist are given up.
    assert np.mean(solvable & ~solved) <= 0.01
    # The first step at 25 and at 50 to an orbit.
    h = two_body.PERIOD / np.array([25, 50])
    start = two_body.start()
    np.testing.assert_array_equal(
        jax.vmap(lambda h: two_body.midpoint_solvable(*start, h))(h), [False, True]
    )


def test_escape_from_a_double_well_costs_the_energy_that_noise_brings():
    # H0 when it first is above the barrier, at 0, or at the end, less its start, less
    # s^2 / 2 times that time, is zero on average (optional stopping).
    s, bottom, start = 0.2, -0.25, double_well.Y0
    make_terms = lambda path: ds.hamiltonian_terms(
        lambda t, p, q, s: double_well.energy(p, q), lambda t, p, q, s: -s * q, path
    )
    ts, (p, q), failed = ensemble(
        make_terms, truncated(), ds.ImplicitMidpoint(), start, 0.1, 100, 10_000, args=s,
        event=diffrax.Event(lambda t, y, args, **kwargs: double_well.energy(*y) > 0),
    )  # fmt: skip
    assert not np.any(failed)
    end = double_well.energy(p[:, -1], q[:, -1])
    assert 0.2 < np.mean(end > 0) < 0.8
    balance = Mean.of(end - bottom - s**2 / 2 * ts[:, -1])
    assert abs(balance.sigmas) <= 4
    # It could be seen if it were not so.
    assert balance.std_error <= 0.02 * -bottom


def test_the_law_of_rods_is_the_volume_of_the_momenta_that_they_allow():
    # The root of det(J J^T), with the gradients J of the constraints, by definition.
    for key in jr.split(jr.key(0), 5):
        directions = jr.normal(key, (rods.RODS, 3))
        directions /= jnp.linalg.norm(directions, axis=1, keepdims=True)
        q = jnp.cumsum(jnp.concatenate([jnp.zeros((1, 3)), directions]), axis=0)
        J = jax.jacobian(lambda q: jnp.sum(rods.bonds(q) ** 2, axis=1) / 2)(q)
        J = J.reshape(rods.RODS, -1)
        volume = jnp.sqrt(jnp.linalg.det(J @ J.T))
        np.testing.assert_allclose(rods.weight(rods.cosines(q)), volume, rtol=1e-12)
    np.testing.assert_allclose(rods.exact_square(8), rods.exact_square(16), rtol=1e-7)
    c, w = np.polynomial.legendre.leggauss(8)
    np.testing.assert_allclose(w @ rods.density_of_one(c, 8), 1, rtol=1e-12)


def test_rods_have_their_angles_and_momenta_and_springs_have_others():
    t1, paths = 5.0, 4_000
    rigid = rods.angles(rods.rigid, ds.BAOAB(), 0.1, t1, paths)
    soft = rods.angles(rods.springs, ds.BAOAB(), 0.02, t1, paths)
    assert rigid.stretched <= 1e-13
    for mean, exact in (
        (rigid.square, rods.exact_square(12)),
        (rigid.kinetic, 11 * rods.T / 2),
        (soft.square, 1 / 3),
    ):
        assert abs(mean.value - exact) <= 4 * mean.std_error
    # By a factor that is known for one spring, 1 - (omega h)^2 / 4.
    assert soft.kinetic.value < 15 * rods.T / 2 - 4 * soft.kinetic.std_error


class Known(eqx.Module):
    log_s: jax.Array

    def __call__(self, q):
        return q**2 / 2


def test_noise_strength_is_found_if_steps_are_small_and_heun_is_farther_from_it():
    observed = learning.observe(jr.key(2), 64, 9)
    now, then = (
        jnp.moveaxis(x, 1, 0).reshape(2, -1) for x in (observed[:-1], observed[1:])
    )

    class True_(Known):
        def __call__(self, q):
            return learning.true_potential(q)

    def found(name, steps):
        def loss(log_s):
            each = lambda now, then: learning.negative_log_likelihood(
                True_(log_s), learning.SOLVERS[name], steps, now, then
            )
            return jnp.mean(jax.vmap(each, (1, 1))(now, then))

        # The loss is fit exp(-2 log s) / 2 + 2 log s, up to a constant.
        fit = 2 - jax.jit(jax.grad(loss))(0.0)
        return float(jnp.sqrt(fit / 2))

    std_error = learning.S / np.sqrt(4 * now.shape[1])
    assert abs(found("StormerVerlet", 4) - learning.S) <= 4 * std_error
    # Two steps are not enough for either of them.
    ours, heun = (found(name, 2) - learning.S for name in ("StormerVerlet", "Heun"))
    assert heun > 1.5 * ours
