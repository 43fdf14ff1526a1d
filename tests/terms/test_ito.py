"""With `ito_drift`, Stratonovich solvers solve Ito equations."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._terms import split_terms
from diffrax_symplectic._terms.symplectic_gradients import is_hamiltonian

from ..problems import Given


Y = jnp.array(1.3)
ONE = ds.WeakBrownianPath((), jr.key(0))
OTHER = ds.WeakBrownianPath((), jr.key(7))


def _geometric(sigma, path: Any = ONE):
    return diffrax.ControlTerm(lambda t, y, args: sigma * y, path)


def _correction(*noise, y: Any = Y, args=None):
    return ds.ito_drift(*noise).vf(0.0, y, args)


def test_noises_of_one_path_are_one_noise():
    one, other = _geometric(0.3), _geometric(0.4)
    # Each shape is a Brownian motion of its own.
    shapes = (_geometric(s, jax.ShapeDtypeStruct((), float)) for s in (0.3, 0.4))
    for noises, sigma in (
        ([one], 0.3),
        ([one, other], 0.7),
        ([one, _geometric(0.4, OTHER)], 0.5),
        ([diffrax.MultiTerm(*shapes)], 0.5),
    ):
        np.testing.assert_allclose(_correction(*noises), -(sigma**2) * Y / 2)


def test_hamiltonian_noise_and_operators_on_any_state_have_their_correction():
    y = (jnp.array([0.2, -0.5]), jnp.array([1.1, 0.4]))
    # H_k = s_k (p_k^2 + q_k^2) / 2 turns the pair k: b_k' b_k = -s_k^2 y_k.
    strengths = jnp.array([0.3, 0.8])
    circles = ds.noise_terms(lambda t, p, q, s: s * (p**2 + q**2) / 2, (2,))

    def turn(t, y, s):
        p, q = y
        operator = lambda w: (-s * q * w["a"], s * p * w["a"])
        return lx.FunctionLinearOperator(operator, struct)

    struct = {"a": jax.ShapeDtypeStruct((2,), float)}
    plain = diffrax.ControlTerm(turn, ds.WeakBrownianPath(struct, jr.key(0)))
    expected = jax.tree.map(lambda x: strengths**2 * x / 2, y)
    for noise in (circles, plain):
        found = _correction(noise, y=y, args=strengths)
        jax.tree.map(np.testing.assert_allclose, found, expected)


def test_a_drift_of_correction_holds_no_noise_and_no_structure():
    noise = ds.noise_terms(lambda t, p, q, args: p * q, (), structure="separable")
    correction = ds.ito_drift(noise)
    assert split_terms(correction) == ((correction,), ())
    assert not is_hamiltonian(correction)


@pytest.mark.core
def test_steps_are_those_of_an_ito_solver():
    # Milstein's two schemes differ by the correction alone.
    drift = lambda t, y, args: jnp.sin(y)
    noise = diffrax.ControlTerm(
        lambda t, y, args: args * jnp.cos(y), Given(jnp.array(0.3))
    )
    correction = ds.ito_drift(noise)
    both = lambda t, y, args: drift(t, y, args) + correction.vf(t, y, args)

    def end(field, solver):
        terms = diffrax.MultiTerm(diffrax.ODETerm(field), noise)
        given = terms, 0.0, 0.125, Y, 0.4
        return solver.step(*given, solver.init(*given), False)[0]

    ito = end(drift, diffrax.ItoMilstein())
    stratonovich = end(both, diffrax.StratonovichMilstein())
    np.testing.assert_allclose(stratonovich, ito, rtol=1e-13)
    assert abs(ito - end(drift, diffrax.StratonovichMilstein())) > 1e-4


def test_what_is_no_noise_is_refused():
    drift = diffrax.ODETerm(lambda t, y, args: y)
    for wrong in ((), (drift,), (diffrax.MultiTerm(drift, _geometric(0.3)),)):
        with pytest.raises(ValueError, match="takes noise terms, each with a Brownian"):
            ds.ito_drift(*wrong)
