"""Friction around a solver."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import damped_terms, Given, weak_path


_oscillator = lambda t, p, q, args: jnp.sum(p**2 / 2 + jnp.cos(q + t))
_force = lambda t, p, q, args: jnp.stack([jnp.sum(jnp.sin(q))])
# Masses 1 and 4.
_free = lambda t, p, q, args: jnp.sum(p**2 / jnp.array([1.0, 4.0])) / 2
MATRIX = jnp.array([[1.0, 0.4], [0.4, 0.7]])


@pytest.mark.parametrize("friction", [0.5, jnp.array([0.5, 0.0]), MATRIX])
def test_momenta_fall_by_the_midpoint_rule_and_rise_again_backward(friction):
    terms = damped_terms(_free, friction)
    y0 = jnp.array([1.0, 2.0]), jnp.zeros(2)
    rates = np.eye(2) * friction if jnp.ndim(friction) < 2 else np.asarray(friction)
    half = rates / np.array([1.0, 4.0]) / 4 / 4
    once = np.linalg.solve(np.eye(2) + half, np.eye(2) - half)
    solver = ds.Damped(ds.ImplicitMidpoint())
    end = diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.25, y0, max_steps=4).ys
    expected = np.linalg.matrix_power(once, 8) @ y0[0]
    np.testing.assert_allclose(end[0][-1], expected, rtol=1e-13)
    back = tuple(x[-1] for x in end)
    back = diffrax.diffeqsolve(terms, solver, 1.0, 0.0, -0.25, back, max_steps=4).ys
    np.testing.assert_allclose([x[-1] for x in back], y0, atol=1e-14)


@pytest.mark.parametrize("solver", [ds.BAOAB(), ds.Damped(ds.SRKs1())])
def test_one_number_serves_all_momenta_in_their_precision(solver):
    # Without noise, too.
    kinetic = lambda p: jnp.sum(p["a"] ** 2) / 2 + jnp.sum(p["b"] ** 2) / 4
    terms = ds.langevin_terms(lambda t, p, q, args: kinetic(p), np.float64(0.8))
    p = {"a": jnp.ones(2, jnp.float32), "b": jnp.full((3, 1), 2, jnp.float32)}
    t0, t1 = jnp.float32(0), jnp.float32(0.5)
    state = solver.init(terms, t0, t1, (p, p), None)
    p1, _ = solver.step(terms, t0, t1, (p, p), None, state, False)[0]
    # The velocities of the second are half as large.
    for name, mass in (("a", 1), ("b", 2)):
        assert p1[name].dtype == jnp.float32
        expected = p[name] * np.exp(-0.4 / mass)
        np.testing.assert_allclose(p1[name], expected, rtol=6e-3)


def test_solvers_of_other_packages_are_refused():
    # Diffrax's wrappers count as what they wrap, by `isinstance`.
    for other in (diffrax.Heun(), diffrax.HalfSolver(ds.ImplicitMidpoint())):
        with pytest.raises(ValueError, match="wraps a solver of this package"):
            ds.Damped(other)
    implicit = ds.Damped(ds.ImplicitMidpoint())
    assert isinstance(implicit, diffrax.AbstractImplicitSolver)
    explicit = ds.Damped(ds.StormerVerlet())
    assert not isinstance(explicit, diffrax.AbstractImplicitSolver)


def test_what_has_no_friction_is_refused():
    y0 = (jnp.ones(1), jnp.ones(1))
    terms = ds.hamiltonian_terms(_oscillator, _force, weak_path(1))
    # A state (x, v), of which the first half is no momentum.
    drift = diffrax.ODETerm(lambda t, y, args: (y[1], -y[0]))
    for without in (terms, drift):
        for solver in (ds.Damped(ds.ImplicitMidpoint()), ds.BAOAB()):
            with pytest.raises(ValueError, match="these have none.*`langevin_terms"):
                diffrax.diffeqsolve(without, solver, 0.0, 1.0, 0.1, y0)
    spins = ds.spin_terms(
        lambda t, s, args: s[2],
        lambda t, s, args: s[0],
        ds.WeakBrownianPath((), jr.key(0)),
    )
    y0 = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    solver = ds.Damped(ds.ImplicitMidpoint())
    with pytest.raises(ValueError, match="friction to a canonical momentum"):
        diffrax.diffeqsolve(spins, solver, 0.0, 1.0, 0.1, y0)


def test_there_is_one_friction_only():
    split = ds.LinearFlow(ds.BAOAB(), lambda time, y, args: y)
    for solver in (ds.BAOAB(), ds.LangevinMiddle(), split):
        with pytest.raises(ValueError, match="takes the friction of the terms itself"):
            ds.Damped(solver)


def test_a_traced_friction_that_is_negative_fails_its_path_alone():
    y0 = jnp.ones(2), jnp.ones(2)

    @eqx.filter_jit
    @jax.vmap
    def run(friction):
        terms = ds.langevin_terms(_oscillator, friction)
        solver = ds.Damped(ds.StormerVerlet())
        sol = diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, throw=False)
        return sol.result == diffrax.RESULTS.successful

    frictions = jnp.array([0.5, -0.5, jnp.inf, jnp.nan])
    np.testing.assert_array_equal(run(frictions), [True, False, False, False])


def test_orders_are_those_of_the_splitting_where_the_solver_has_higher_ones():
    terms = ds.hamiltonian_terms(_oscillator, _force, weak_path(1))
    orders = lambda solver: [
        getattr(ds.Damped(solver), name)(terms)
        for name in ("order", "weak_order", "strong_order")
    ]
    assert orders(ds.NinomiyaVictoir()) == [2, 2, None]
    assert orders(ds.AdditiveGauss())[1] == 2
    assert orders(ds.PlateauVerlet())[2] == 1.0
    assert orders(ds.SRKs1()) == [2, 1, 1.0]
    assert ds.Damped(ds.PlateauGauss()).record.strong == (1, 0.5)


@pytest.mark.parametrize("solver", [ds.Damped(ds.StormerVerlet()), ds.BAOAB()])
def test_between_steps_a_solution_is_interpolated_between_their_ends(solver):
    push = lambda t, p, q, args: jnp.stack([jnp.sum(q)])
    terms = damped_terms(_oscillator, 1.0, push, Given(jnp.array([0.3])))
    y0 = jnp.ones(2), jnp.ones(2)
    state = solver.init(terms, 0.0, 0.1, y0, None)
    y1, _, dense, *_ = solver.step(terms, 0.0, 0.1, y0, None, state, False)
    np.testing.assert_array_equal(dense["y0"], y0)
    np.testing.assert_array_equal(dense["y1"], y1)


class _OwnOrders(ds.AbstractSymplecticSolver):
    """A solver that states its orders by methods."""

    structure = "any"
    variables = ("W",)
    order = lambda self, terms: 3
    weak_order = lambda self, terms: 1
    strong_order = lambda self, terms: 0.5
    stage_vectors = lambda self, num_noises: ()
    init = lambda self, terms, t0, t1, y0, args: None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        return y0, None, dict(y0=y0, y1=y0), None, diffrax.RESULTS.successful


def test_the_orders_of_the_wrapped_solver_bound_those_of_the_splitting():
    terms = ds.hamiltonian_terms(_oscillator, _force, weak_path(1))
    for wrap in (
        ds.Damped,
        lambda solver: ds.LinearFlow(solver, lambda time, y, args: y),
    ):
        own = wrap(_OwnOrders())
        assert (own.weak_order(terms), own.strong_order(terms)) == (1, 0.5)
        assert own.order(terms) == 2
        weak_only = wrap(ds.SRKw2())
        assert (weak_only.weak_order(terms), weak_only.strong_order(terms)) == (2, None)
