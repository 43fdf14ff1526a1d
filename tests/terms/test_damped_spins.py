"""Spins with damping: at a temperature they have the law of Gibbs."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from examples import warm_spins

from ..problems import Given, slope, weak_path
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


# The last makes vector fields of brackets.
@pytest.mark.parametrize(
    "solver",
    [
        ds.ImplicitMidpoint(),
        pytest.param(ds.PlateauGauss(), marks=pytest.mark.slow),
    ],
    ids=repr,
)
def test_length_is_kept_for_a_thousand_random_systems(solver):
    def change(key):
        k_problem, k_h, k_W, k_alpha = jr.split(key, 4)
        s0, args = _problem(k_problem, 2, 3)
        h = jnp.exp(jr.uniform(k_h, (), float, jnp.log(1e-3), jnp.log(0.2)))
        W = jnp.sqrt(h) * jnp.clip(jr.normal(k_W, (3,)), -2.5, 2.5)
        given, alpha = Given(W, H=W[::-1] / 4), jr.uniform(k_alpha, (2,))
        terms = ds.spin_terms(H0, noise, given, damping=alpha)
        y0 = ds.to_spinors(s0)
        y1, *_ = solver.step(terms, 0.0, h, y0, args, None, False)
        before, after = (jnp.linalg.norm(ds.from_spinors(y), axis=-1) for y in (y0, y1))
        return jnp.max(jnp.abs(after / before - 1))

    changes = jax.jit(jax.vmap(change))(jr.split(jr.key(0), 1000))
    assert jnp.max(changes) <= 1e-13


@pytest.mark.slow
def test_stationary_law_of_one_spin_is_that_of_gibbs_up_to_the_square_of_the_step():
    # In a field, with an easy axis beside it.
    H = lambda s: -0.5 * s[2] - 0.4 * s[0] ** 2
    what = lambda s: jnp.stack([s[2], s[0] ** 2])
    hs = np.array([0.4, 0.2, 0.1])
    solver = ds.NinomiyaVictoir()
    # Beyond this degree the biases change in their fourth digit.
    bias = warm_spins.stationary_bias(H, what, solver, hs, alpha=0.5, T=0.6, degree=5)
    assert np.max(np.abs(bias[-1])) <= 1e-3
    for column in bias.T:
        assert abs(slope(hs, column) - 2) <= 0.15


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
        at = terms, 0.0, 0.1, y0, args, None, False
        return ds.ImplicitMidpoint().step(*at)[-1] == diffrax.RESULTS.successful

    np.testing.assert_array_equal(
        run(jnp.array([0.5, -0.5, jnp.nan, jnp.inf])), [True, False, False, False]
    )
