"""Friction around a solver."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import Given, weak_path


_oscillator = lambda t, p, q, args: jnp.sum(p**2 / 2 + jnp.cos(q + t))
_force = lambda t, p, q, args: jnp.stack([jnp.sum(jnp.sin(q))])


def test_momentum_alone_decays_exactly_forward_and_backward():
    free = lambda t, p, q, args: 0 * jnp.sum(p * q)
    term = ds.hamiltonian_terms(free, _force, Given(jnp.zeros(1))).terms[0]
    y0 = jnp.array([1.0, 2.0]), jnp.zeros(2)
    solver = ds.Damped(ds.ImplicitMidpoint(), jnp.array([0.5, 0.0]))
    for end in (1.0, -1.0):
        sol = diffrax.diffeqsolve(term, solver, 0.0, end, end / 4, y0)
        expected = y0[0] * np.exp(-np.array([0.5, 0.0]) * end)
        np.testing.assert_allclose(sol.ys[0][-1], expected, rtol=1e-14)


@pytest.mark.parametrize("wrap", [ds.BAOAB, lambda gamma: ds.Damped(ds.SRKs1(), gamma)])
def test_one_number_serves_all_momenta_in_their_precision(wrap):
    # Without noise, too.
    free = lambda t, p, q, args: 0 * jnp.sum(p["a"])
    none = lambda t, p, q, args: 0 * q["a"]
    term = ds.hamiltonian_terms(free, none, Given(jnp.zeros(2))).terms[0]
    p = {"a": jnp.ones(2, jnp.float32), "b": jnp.full((3, 1), 2, jnp.float32)}
    t0, t1 = jnp.float32(0), jnp.float32(0.5)
    solver = wrap(np.float64(0.8))
    state = solver.init(term, t0, t1, (p, p), None)
    p1, _ = solver.step(term, t0, t1, (p, p), None, state, False)[0]
    for name in p:
        assert p1[name].dtype == jnp.float32
        np.testing.assert_allclose(p1[name], p[name] * np.exp(-0.4), rtol=1e-6)


@pytest.mark.parametrize("wrap", [ds.BAOAB, lambda gamma: ds.Damped(ds.SRKs1(), gamma)])
def test_momenta_fall_at_the_rate_of_a_matrix_when_the_step_is_prolonged(wrap):
    free = lambda t, p, q, args: 0 * jnp.sum(p)
    none = lambda t, p, q, args: jnp.stack([0 * jnp.sum(q)])
    term = ds.hamiltonian_terms(free, none, Given(jnp.zeros(1))).terms[0]
    matrix = jnp.array([[1.0, 0.4], [0.4, 0.7]])
    y0, solver = (jnp.array([1.0, 2.0]), jnp.zeros(2)), wrap(matrix)

    def after(h):
        state = solver.init(term, 0.0, h, y0, None)
        return solver.step(term, 0.0, h, y0, None, state, False)[0][0]

    p1, rate = jax.jvp(after, (0.3,), (1.0,))
    np.testing.assert_allclose(rate, -matrix @ p1, atol=1e-14)


@pytest.mark.parametrize(
    "gamma, match",
    [
        (-1.0, "must not be negative: .*; got -1.0"),
        (np.nan, "must be finite; got nan"),
        (np.array([1.0, np.inf]), "must be finite"),
        (1j, "must be a real number"),
        ("much", "must be a real number"),
    ],
)
def test_friction_must_be_finite_and_not_negative(gamma, match):
    with pytest.raises(ValueError, match=f"`gamma` {match}"):
        ds.Damped(ds.ImplicitMidpoint(), gamma)


def test_misfits_are_refused_with_advice():
    terms = ds.hamiltonian_terms(_oscillator, _force, Given(jnp.array([0.3])))
    y0 = jnp.ones(2), jnp.ones(2)
    for gamma, match in ((jnp.ones(3), "shape of its momenta"), ([1.0], "structure")):
        with pytest.raises(ValueError, match=match):
            ds.Damped(ds.ImplicitMidpoint(), gamma).init(terms, 0.0, 0.1, y0, None)
    # Diffrax's wrappers count as what they wrap, by `isinstance`.
    for other in (diffrax.Heun(), diffrax.HalfSolver(ds.ImplicitMidpoint())):
        with pytest.raises(ValueError, match="wraps a solver of this package"):
            ds.Damped(other, 1.0)
    assert isinstance(
        ds.Damped(ds.ImplicitMidpoint(), 1.0), diffrax.AbstractImplicitSolver
    )
    explicit = ds.Damped(ds.StormerVerlet(), 1.0)
    assert not isinstance(explicit, diffrax.AbstractImplicitSolver)


def test_what_has_no_canonical_momentum_is_refused():
    solver = ds.Damped(ds.ImplicitMidpoint(), 0.1)
    spins = ds.spin_terms(
        lambda t, s, args: s[2],
        lambda t, s, args: s[0],
        ds.WeakBrownianPath((), jr.key(0)),
    )
    y0 = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    with pytest.raises(ValueError, match="friction to a canonical momentum"):
        diffrax.diffeqsolve(spins, solver, 0.0, 1.0, 0.1, y0)
    # A state (x, v), of which the first half is no momentum.
    drift = diffrax.ODETerm(lambda t, y, args: (y[1], -y[0]))
    kick = diffrax.ControlTerm(lambda t, y, args: (y[0], y[1]), weak_path(1))
    y0 = (jnp.ones(1), jnp.ones(1))
    for plain in (drift, diffrax.MultiTerm(drift, kick)):
        with pytest.raises(ValueError, match="`hamiltonian_terms`; or use `BAOAB"):
            diffrax.diffeqsolve(plain, solver, 0.0, 1.0, 0.1, y0)
    # The drift of Hamiltonians tells which half is the momentum.
    terms = ds.hamiltonian_terms(_oscillator, _force, weak_path(1))
    force = diffrax.ODETerm(lambda t, y, args: (jnp.ones(1), jnp.zeros(1)))
    solver.init(diffrax.MultiTerm(terms, force), 0.0, 0.1, y0, None)
    solver.init(terms.terms[0], 0.0, 0.1, y0, None)


def test_a_traced_friction_that_is_negative_fails_its_path_alone():
    terms = ds.hamiltonian_terms(_oscillator, _force, Given(jnp.array([0.3])))
    y0 = jnp.ones(2), jnp.ones(2)

    @eqx.filter_jit
    @jax.vmap
    def run(gamma):
        solver = ds.Damped(ds.StormerVerlet(), gamma)
        sol = diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, throw=False)
        return sol.result == diffrax.RESULTS.successful

    gammas = jnp.array([0.5, -0.5, jnp.inf, jnp.nan])
    np.testing.assert_array_equal(run(gammas), [True, False, False, False])
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        solver = ds.Damped(ds.ImplicitMidpoint(), jnp.array(0.1))
        solver = eqx.tree_at(lambda s: s.gamma, solver, jnp.array(-0.1))
        diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0)


class _OwnGamma(ds.AbstractSymplecticRungeKutta):
    """A tableau with a parameter `gamma` that is no friction."""

    gamma: float = 0.25
    tableau = ds.StormerVerlet.tableau


def test_there_is_one_friction_only():
    split = ds.LinearFlow(ds.BAOAB(1.0), lambda time, y, args: y)
    for solver in (ds.BAOAB(1.0), ds.Damped(ds.StormerVerlet(), 1.0), split):
        with pytest.raises(ValueError, match="already includes friction"):
            ds.Damped(solver, 1.0)
    assert ds.Damped(_OwnGamma(), 1.0).solver == _OwnGamma()


def test_orders_are_those_of_the_splitting_where_the_solver_has_higher_ones():
    terms = ds.hamiltonian_terms(_oscillator, _force, weak_path(1))
    orders = lambda solver: [
        getattr(ds.Damped(solver, 1.0), name)(terms)
        for name in ("order", "weak_order", "strong_order")
    ]
    assert orders(ds.NinomiyaVictoir()) == [2, 2, None]
    assert orders(ds.AdditiveGauss())[1] == 2
    assert orders(ds.PlateauVerlet())[2] == 1.0
    assert orders(ds.SRKs1()) == [2, 1, 1.0]
    assert ds.Damped(ds.PlateauGauss(), 1.0).record.strong == (1, 0.5)


@pytest.mark.parametrize("solver", [ds.Damped(ds.StormerVerlet(), 1.0), ds.BAOAB(1.0)])
def test_between_steps_a_solution_is_interpolated_between_their_ends(solver):
    push = lambda t, p, q, args: jnp.stack([jnp.sum(q)])
    terms = ds.hamiltonian_terms(_oscillator, push, Given(jnp.array([0.3])))
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
        lambda solver: ds.Damped(solver, 0.5),
        lambda solver: ds.LinearFlow(solver, lambda time, y, args: y),
    ):
        own = wrap(_OwnOrders())
        assert (own.weak_order(terms), own.strong_order(terms)) == (1, 0.5)
        assert own.order(terms) == 2
        weak_only = wrap(ds.SRKw2())
        assert (weak_only.weak_order(terms), weak_only.strong_order(terms)) == (2, None)
