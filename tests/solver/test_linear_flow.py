"""The exact flow of the linear part around a step for the rest."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._adjoint import _undoes_its_steps
from diffrax_symplectic._solver import LANGEVIN

from ..problems import Given, one_step, weak_path


def _rest(t, p, q, args):
    return jnp.sum(q**4) / 4 + jnp.sum(jnp.sin(q + t))


def _kicks(t, p, q, args):
    return jnp.stack([0.5 * jnp.sum(jnp.sin(q)), 0.3 * jnp.sum(q**2)])


def modes(omega):
    """The exact flow of H0 = sum_k (p_k^2 + omega_k^2 q_k^2) / 2, without a case for the
    frequency zero."""

    def flow(time, y, args):
        p, q = y
        c, s = jnp.cos(omega * time), jnp.sin(omega * time)
        return c * p - omega * s * q, c * q + s / omega * p

    return flow


FLOW = modes(jnp.arange(1.0, 9.0))


class _Own(ds.AbstractSymplecticSolver):
    """A solver that states its orders by methods, and moves by what it remembers of the
    end of its last step, if nothing jumped."""

    structure = "any"
    variables = ("W",)
    order = lambda self, terms: 3
    weak_order = lambda self, terms: 1
    strong_order = lambda self, terms: 0.5
    stage_vectors = lambda self, num_noises: ()
    init = lambda self, terms, t0, t1, y0, args: y0

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        p, q = y0 if made_jump else solver_state
        y1 = (y0[0] - (t1 - t0) * q, y0[1])
        return y1, None, dict(y0=y0, y1=y1), y1, diffrax.RESULTS.successful


def test_orders_are_those_of_the_splitting_where_the_solver_has_higher_ones():
    one_noise = lambda *a: _kicks(*a)[:1]
    terms = ds.hamiltonian_terms(_rest, one_noise, weak_path(1))
    wrap = lambda solver: ds.LinearFlow(solver, FLOW)
    orders = lambda solver: [
        getattr(wrap(solver), name)(terms)
        for name in ("order", "weak_order", "strong_order")
    ]
    assert orders(ds.NinomiyaVictoir()) == [2, 2, None]
    assert orders(ds.AdditiveGauss())[1] == 2
    assert orders(ds.PlateauVerlet())[2] == 1.0
    assert wrap(ds.PlateauGauss()).record.strong == (1, 0.5)
    # Those of the solver bound them.
    assert orders(ds.SRKs1()) == [2, 1, 1.0]
    assert orders(_Own()) == [2, 1, 0.5]
    assert orders(ds.SRKw2())[1:] == [2, None]
    # It is implicit if its solver is.
    implicit, explicit = wrap(ds.ImplicitMidpoint()), wrap(ds.StormerVerlet())
    assert isinstance(implicit, diffrax.AbstractImplicitSolver)
    assert not isinstance(explicit, diffrax.AbstractImplicitSolver)


def test_linear_systems_without_a_rest_are_solved_exactly():
    y0 = tuple(jr.normal(jr.key(0), (2, 8)))
    nothing = lambda t, p, q, args: 0 * jnp.sum(q)
    terms = ds.hamiltonian_terms(nothing, nothing, Given(jnp.zeros(())))
    solver = ds.LinearFlow(ds.StormerVerlet(), FLOW)

    @jax.jit
    def solved_and_exact(end):
        at = terms, solver, 0.0, end, end / 7, y0
        sol = diffrax.diffeqsolve(*at, max_steps=8)
        return [x[-1] for x in sol.ys], FLOW(end, y0, None)

    for end in (5.0, -5.0):
        np.testing.assert_allclose(*solved_and_exact(end), atol=1e-12)


def test_what_a_solver_remembers_is_not_taken_for_where_the_flow_leads():
    # The solver keeps the end of its step, and the flow goes on from there.
    terms = ds.hamiltonian_terms(_rest)
    inner, y = _Own(), tuple(jr.normal(jr.key(0), (2, 8)))
    sol = diffrax.diffeqsolve(
        terms, ds.LinearFlow(inner, FLOW), 0, 0.6, 0.2, y, max_steps=4
    )

    @jax.jit
    def split_step(t, y):
        return FLOW(0.1, one_step(inner, terms, 0.2, FLOW(0.1, y, None), t), None)

    for i in range(3):
        y = split_step(0.2 * i, y)
    np.testing.assert_allclose([x[-1] for x in sol.ys], y, atol=1e-13)


@pytest.mark.core
def test_steps_of_a_reversible_solver_are_undone():
    solver = ds.LinearFlow(ds.StormerVerlet(), FLOW)
    assert _undoes_its_steps(solver)
    terms, y0 = ds.hamiltonian_terms(_rest), tuple(jr.normal(jr.key(0), (2, 8)))
    there = one_step(solver, terms, 0.2, y0, 0.1)
    back = one_step(solver, terms, -0.2, there, 0.3)
    np.testing.assert_allclose(back, y0, atol=1e-13)
    assert not _undoes_its_steps(ds.LinearFlow(ds.SRKw4(), FLOW))


def test_flows_that_are_none_are_refused():
    terms = ds.hamiltonian_terms(_rest, _kicks, weak_path(2))
    y0 = jnp.ones(8), jnp.ones(8)
    inner = ds.StormerVerlet()
    with pytest.raises(ValueError, match=r"called as `flow\(time, y, args\)`"):
        ds.LinearFlow(inner, lambda y: y)  # pyright: ignore
    # Diffrax's wrappers count as what they wrap, by `isinstance`.
    for other in (diffrax.Heun(), diffrax.HalfSolver(ds.ImplicitMidpoint())):
        with pytest.raises(ValueError, match="wraps a solver of this package"):
            ds.LinearFlow(other, FLOW)
    init = lambda flow, y0=y0: ds.LinearFlow(inner, flow).init(
        terms, 0.0, 0.1, y0, None
    )
    with pytest.raises(ValueError, match="must return a pair like the state"):
        init(lambda time, y, args: (y[0], y[1][:4]))
    with pytest.raises(ValueError, match="is a pair"):
        init(FLOW, jnp.ones(8))
    # The flow would follow what the solver follows, too.
    slow = lambda t, q, args: _rest(t, q, q, args)
    whole = ds.hamiltonian_terms(lambda t, p, q, args: p @ p, slow=slow)
    with pytest.raises(ValueError, match="contain the rest alone"):
        ds.LinearFlow(inner, FLOW).init(whole, 0.0, 0.1, y0, None)
    # One propagator for all steps.
    with pytest.raises(ValueError, match="does not depend on `time`"):
        init(lambda time, y, args: FLOW(0.05, y, args))


BATH = r"`BAOAB\(linear_flow\(\.\.\.\)\)`.*`langevin_terms\(.*slow="


def test_heat_baths_are_refused_in_favour_of_baoab():
    y0 = jnp.ones(8), jnp.ones(8)
    baths = [*(kind() for kind in LANGEVIN), ds.BAOAB(ds.StormerVerlet())]
    for langevin in baths:
        with pytest.raises(ValueError, match=BATH):
            ds.LinearFlow(langevin, FLOW)
    kinetic = lambda t, p, q, args: jnp.sum(p**2) / 2
    path = ds.WeakBrownianPath((8,), jr.key(0))
    bath = ds.bath_terms(kinetic, 0.5, 1.0, path).terms
    rate, one = 0.5, jnp.ones(8)
    for terms in (
        ds.langevin_terms(_rest, 0.5, 1.0, path),
        ds.langevin_terms(_rest, 0.5),
        diffrax.MultiTerm(*ds.hamiltonian_terms(_rest).terms, *bath),
        diffrax.MultiTerm(
            diffrax.UnderdampedLangevinDriftTerm(rate, one, lambda x, args: x**3),
            diffrax.UnderdampedLangevinDiffusionTerm(rate, one, path),
        ),
    ):
        for inner in (ds.StormerVerlet(), ds.ImplicitMidpoint()):
            with pytest.raises(ValueError, match=f"no terms with friction.*{BATH}"):
                ds.LinearFlow(inner, FLOW).init(terms, 0.0, 0.1, y0, None)


def test_a_flow_that_returns_nan_is_named_and_in_a_batch_fails_its_path_alone():
    y0 = jnp.ones(2), jnp.ones(2)
    terms = ds.hamiltonian_terms(_rest)
    named = r"`flow\(time, y, args\)` returned NaN.*jnp.sinc"
    solver = ds.LinearFlow(ds.StormerVerlet(), modes(jnp.array([1.0, 0.0])))
    with pytest.raises(ValueError, match=named):
        solver.init(terms, 0.0, 0.1, y0, None)
    # Also from within a program.
    with pytest.raises(Exception, match=named):
        jax.jit(lambda y0: solver.init(terms, 0.0, 0.1, y0, None))(y0)

    @jax.jit
    @jax.vmap
    def run(omega):
        solver = ds.LinearFlow(ds.StormerVerlet(), modes(omega))
        y0 = jnp.ones(()), jnp.ones(())
        sol = diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.1, y0, throw=False)
        return sol.result == diffrax.RESULTS.nonfinite, sol.ys[1][-1]

    broken, ends = run(jnp.array([1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(broken, [False, True, False])
    np.testing.assert_array_equal(np.isfinite(ends), [True, False, True])
