"""Terms and states that do not fit get an error that says what to pass instead."""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds

from .problems import H0, noise, random_problem, weak_path


def _solve(terms, y0, solver=None):
    solver = ds.ImplicitMidpoint() if solver is None else solver
    return diffrax.diffeqsolve(terms, solver, 0.0, 0.2, 0.1, y0)


@pytest.mark.parametrize(
    "y0",
    [
        jnp.ones(2),
        [jnp.ones(2), jnp.ones(2)],
        (jnp.ones(2),) * 3,
        (jnp.ones(2), jnp.ones(3)),
        (jnp.ones(2), {"q": jnp.ones(2)}),
        {"p": jnp.ones(2), "q": jnp.ones(2)},
    ],
)
def test_state_that_is_not_a_pair_is_refused(y0):
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p), lambda t, p, q, args: q[:1], weak_path(1)
    )
    for solver in (ds.ImplicitMidpoint(), diffrax.Heun()):
        with pytest.raises(ValueError, match=r"pass `y0=\(p0, q0\)`"):
            _solve(terms, y0, solver)


@pytest.mark.parametrize(
    "H",
    [
        lambda t, p, q, args: q,
        lambda t, p, q, args: jnp.outer(q, q),
        lambda t, p, q, args: jnp.sum(q),
        lambda t, p, q, args: (jnp.sum(q),) * 2,
    ],
    ids=["longer", "matrix", "scalar", "tuple"],
)
def test_noise_that_does_not_match_the_path_is_refused(H):
    terms = ds.hamiltonian_terms(lambda t, p, q, args: jnp.sum(p), H, weak_path(2))
    with pytest.raises(ValueError, match="one Hamiltonian for each noise of the path"):
        _solve(terms, (jnp.ones(3), jnp.ones(3)))


def test_drift_hamiltonian_that_is_not_a_scalar_is_refused():
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: p, lambda t, p, q, args: q[:1], weak_path(1)
    )
    with pytest.raises(ValueError, match="must return a scalar"):
        _solve(terms, (jnp.ones(2), jnp.ones(2)))


def test_malformed_terms_are_refused():
    H = lambda t, p, q, args: jnp.sum(p)
    with pytest.raises(ValueError, match="`path` must be a Brownian path"):
        ds.hamiltonian_terms(H, H, lambda t0, t1: 0.0)  # pyright: ignore
    with pytest.raises(ValueError, match="`H0` must be a function"):
        ds.hamiltonian_terms(1.0, H, weak_path(1))  # pyright: ignore
    with pytest.raises(ValueError, match="`noise` must be a function"):
        ds.hamiltonian_terms(H, None, weak_path(1))  # pyright: ignore
    with pytest.raises(ValueError, match=r"called as `H0\(t, p, q, args\)`; got a fun"):
        ds.hamiltonian_terms(lambda p, q: p * q, H, weak_path(1))  # pyright: ignore


@pytest.mark.filterwarnings("ignore:Complex")
def test_a_matrix_of_noises_for_a_state_of_several_arrays_is_refused_with_advice():
    field = lambda t, y, args: {"a": jnp.ones((3, 2))}
    terms = diffrax.ControlTerm(field, weak_path(2))
    drift = diffrax.ODETerm(lambda t, y, args: y)
    with pytest.raises(ValueError, match="as a Lineax operator"):
        diffrax.diffeqsolve(
            diffrax.MultiTerm(drift, terms),
            ds.ImplicitMidpoint(),
            0.0,
            0.1,
            0.1,
            {"a": jnp.ones(3)},
        )


def test_states_that_are_not_real_floats_are_refused():
    terms = diffrax.ODETerm(lambda t, y, args: y)
    with pytest.raises(ValueError, match="real floating-point arrays; got.*complex"):
        _solve(terms, jnp.ones(2, complex))
    with pytest.raises(ValueError, match="real floating-point arrays; got.*int"):
        ds.ImplicitMidpoint().init(terms, 0.0, 0.1, jnp.ones(2, int), None)
    with pytest.raises(ValueError, match="at least one array"):
        _solve(terms, ())
    # Diffrax itself turns an integer state into a floating-point one.
    assert jnp.issubdtype(_solve(terms, jnp.ones(2, int)).ys.dtype, jnp.floating)


def test_mixed_dtypes_are_refused():
    field = lambda t, y, args: jnp.ones((2, 1))
    terms = diffrax.MultiTerm(
        diffrax.ODETerm(lambda t, y, args: y), diffrax.ControlTerm(field, weak_path(1))
    )
    f = jnp.float32
    y0 = jnp.ones(2, f)
    with pytest.raises(ValueError, match="the same dtype"):
        diffrax.diffeqsolve(terms, ds.ImplicitMidpoint(), f(0), f(0.2), f(0.1), y0)


def test_missing_levy_area_is_refused_by_diffrax_solvers():
    terms = ds.hamiltonian_terms(H0, noise, weak_path(1))
    y0, args = random_problem(jr.key(0), 1, 1)
    with pytest.raises(ValueError, match="not compatible"):
        diffrax.diffeqsolve(terms, diffrax.SPaRK(), 0.0, 0.2, 0.1, y0, args)


def test_named_pairs_and_half_precision_are_refused():
    class Pair(NamedTuple):
        p: jax.Array
        q: jax.Array

    y0, args = random_problem(jr.key(0), 1, 1)
    terms = ds.hamiltonian_terms(H0, noise, weak_path(1))
    with pytest.raises(ValueError, match=r"is a pair `\(p, q\)`"):
        diffrax.diffeqsolve(
            terms, ds.ImplicitMidpoint(), 0.0, 0.2, 0.1, Pair(*y0), args
        )
    half = jax.tree.map(lambda x: x.astype(jnp.float16), y0)
    with pytest.raises(ValueError, match="float32 or float64"):
        ds.ImplicitMidpoint().init(terms, 0.0, 0.1, half, args)


def test_implicit_tableaus_need_an_implicit_solver():
    class Mine(ds.AbstractSymplecticRungeKutta):
        tableau = ds.ImplicitMidpoint().tableau

        def order(self, terms):
            return 2

    y0, args = random_problem(jr.key(0), 1, 1)
    terms = ds.hamiltonian_terms(H0, noise, weak_path(1))
    with pytest.raises(
        ValueError, match="also subclass `diffrax_symplectic.AbstractImplicitStages`"
    ):
        diffrax.diffeqsolve(terms, Mine(), 0.0, 0.2, 0.1, y0, args)
