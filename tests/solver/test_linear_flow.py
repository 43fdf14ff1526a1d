"""The exact flow of the linear part around a step for the rest."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._adjoint import _undoes_its_steps

from ..problems import Given, orders_of_a_splitting, weak_path
from . import klein_gordon


def _rest(t, p, q, args):
    return jnp.sum(q**4) / 4 + jnp.sum(jnp.sin(q + t))


def _kicks(t, p, q, args):
    return jnp.stack([0.5 * jnp.sum(jnp.sin(q)), 0.3 * jnp.sum(q**2)])


def _mixed(t, p, q, args):
    return jnp.stack([0.5 * jnp.sum(jnp.sin(q + p)), 0.3 * jnp.sum(q**2)])


def _one_step(solver, terms, h, y0, t0=0.1):
    state = solver.init(terms, t0, t0 + h, y0, None)
    return solver.step(terms, t0, t0 + h, y0, None, state, False)[0]


@pytest.mark.parametrize(
    "solver, noise, dtype, bound",
    [
        (ds.StormerVerlet(), _kicks, jnp.float64, 1e-13),
        (ds.ImplicitMidpoint(), _mixed, jnp.float64, 1e-13),
        (ds.ImplicitMidpoint(), _mixed, jnp.float32, 5e-5),
    ],
)
def test_steps_of_stiff_lattices_are_symplectic(solver, noise, dtype, bound):
    # omega h up to 20. The Jacobians have entries up to 40.
    flow = klein_gordon.waves(8, 0.05)
    given = Given(jnp.array([0.3, -0.2], dtype))
    wrapped = ds.LinearFlow(solver, flow)
    terms = ds.hamiltonian_terms(_rest, noise, given)

    def defect(key):
        p, q = jr.normal(key, (2, 8), dtype) * jnp.array([[1.0], [0.1]], dtype)
        h = jnp.asarray(0.5, dtype)
        return ds.symplecticity_defect(terms, wrapped, 0 * h, h, (p, q))

    defects = jax.jit(jax.vmap(defect))(jr.split(jr.key(0), 1000))
    assert defects.dtype == dtype
    assert jnp.max(defects) <= bound


def test_orders_are_those_of_the_splitting_where_the_solver_has_higher_ones():
    one_noise = lambda *a: _kicks(*a)[:1]
    terms = ds.hamiltonian_terms(_rest, one_noise, weak_path(1))
    orders = lambda solver: [
        getattr(ds.LinearFlow(solver, klein_gordon.waves(8, 0.1)), name)(terms)
        for name in ("order", "weak_order", "strong_order")
    ]
    assert orders(ds.NinomiyaVictoir()) == [2, 2, None]
    assert orders(ds.AdditiveGauss())[1] == 2
    assert orders(ds.PlateauVerlet())[2] == 1.0
    assert orders(ds.SRKs1()) == [2, 1, 1.0]


def test_noises_that_do_not_commute_leave_the_splitting_at_weak_order_two():
    # Neither with each other nor with the flow.
    def noise(t, p, q, args):
        return jnp.stack([0.3 * jnp.sum(p * q), 0.15 * jnp.sum(q**2 - p**2)])

    flow = klein_gordon.waves(2, 1.0)
    wave = lambda t, y, args: jax.jvp(lambda s: flow(s, y, args), (0.0,), (1.0,))[1]
    terms = ds.hamiltonian_terms(_rest, noise, weak_path(2, two_point=True))
    solver = ds.LinearFlow(ds.NinomiyaVictoir(), flow)
    y0 = jnp.array([0.3, -0.4]), jnp.array([0.5, 0.1])
    # The frequencies are 1 and 2.2.
    hs = np.array([0.02, 0.01, 0.005])
    slopes = orders_of_a_splitting(solver, terms, wave, y0, hs)
    np.testing.assert_allclose(slopes, 3.0, atol=0.1)


def test_linear_systems_without_a_rest_are_solved_exactly():
    flow, y0 = klein_gordon.waves(16, 0.1), tuple(jr.normal(jr.key(0), (2, 16)))
    nothing = lambda t, p, q, args: 0 * jnp.sum(q)
    terms = ds.hamiltonian_terms(nothing, nothing, Given(jnp.zeros(())))
    solver = ds.LinearFlow(ds.StormerVerlet(), flow)
    for end in (5.0, -5.0):
        sol = diffrax.diffeqsolve(terms, solver, 0, end, end / 7, y0, max_steps=8)
        np.testing.assert_allclose(
            [x[-1] for x in sol.ys], flow(end, y0, None), atol=1e-12
        )


def test_what_a_solver_remembers_is_not_taken_for_where_the_flow_leads():
    # BAOAB keeps the forces of the end of a step, and the flow goes on from there.
    flow = klein_gordon.waves(8, 0.5)
    whole = lambda t, p, q, args: jnp.sum(p**2) / 2 + _rest(t, p, q, args)
    bath = ds.bath_terms(whole, 0.4, 0.1, Given(0.1 * jnp.arange(8.0))).terms
    terms = diffrax.MultiTerm(*ds.hamiltonian_terms(_rest).terms, *bath)
    inner, y = ds.BAOAB(), tuple(jr.normal(jr.key(0), (2, 8)))
    solver = ds.LinearFlow(inner, flow)
    sol = diffrax.diffeqsolve(terms, solver, 0, 0.6, 0.2, y, max_steps=4)
    for i in range(3):
        y = flow(0.1, y, None)
        y = _one_step(inner, terms, 0.2, y, 0.2 * i)
        y = flow(0.1, y, None)
    np.testing.assert_allclose([x[-1] for x in sol.ys], y, atol=1e-13)


def test_gradients_may_walk_back_along_the_solution():
    solver = ds.LinearFlow(ds.StormerVerlet(), klein_gordon.waves(8, 0.1))
    damped = ds.LinearFlow(ds.Damped(ds.StormerVerlet()), klein_gordon.waves(8, 0.1))
    assert _undoes_its_steps(solver) and _undoes_its_steps(damped)
    assert not _undoes_its_steps(ds.LinearFlow(ds.SRKw4(), klein_gordon.waves(8, 0.1)))
    H0 = lambda t, p, q, args: args * _rest(t, p, q, None)
    kinetic = lambda t, p, q, args: jnp.sum(p**2) / 2
    rest = ds.hamiltonian_terms(H0, _kicks, weak_path(2)).terms
    terms = diffrax.MultiTerm(*rest, *ds.bath_terms(kinetic, 0.5).terms)
    y0 = tuple(0.3 * jr.normal(jr.key(0), (2, 8)))

    def end(y0, args, adjoint):
        sol = diffrax.diffeqsolve(
            terms, damped, 0, 2, 0.1, y0, args, adjoint=adjoint, max_steps=32
        )
        return jnp.sum(sol.ys[0][-1] ** 2) + sol.ys[1][-1, 0]

    grad = jax.jit(jax.grad(end, (0, 1)), static_argnums=2)
    ours = grad(y0, 0.7, ds.ReversingAdjoint())
    theirs = grad(y0, 0.7, diffrax.RecursiveCheckpointAdjoint())
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9),
        ours,
        theirs,
    )


def test_a_klein_gordon_chain_takes_ten_times_the_explicit_step():
    # omega h < 2 is h < 0.05 here.
    energies = klein_gordon.energies(0.5, 200)
    error = np.abs(energies / energies[0] - 1)
    assert np.max(error) <= 1e-2
    # It does not grow.
    assert np.max(error[100:]) <= np.max(error[:100])


def test_resonances_are_where_they_should_be():
    # A mode of frequency w with a kick -e q is one matrix a step. Its trace is
    # 2 cos(w h) - (h e / w) sin(w h): beyond 2 in size just below w h = pi.
    e, omega = 0.3, 10.0
    hs = (np.pi + np.array([-0.2, -1e-3, 0.2])) / omega
    traces = jax.vmap(lambda h: klein_gordon.trace(h, omega, e))(hs)
    expected = 2 * np.cos(omega * hs) - hs * e / omega * np.sin(omega * hs)
    np.testing.assert_allclose(traces, expected, atol=1e-12)
    np.testing.assert_array_equal(np.abs(traces) > 2, [False, True, False])


def test_flows_that_are_none_are_refused():
    terms = ds.hamiltonian_terms(_rest, _kicks, weak_path(2))
    y0 = jnp.ones(8), jnp.ones(8)
    inner, flow = ds.StormerVerlet(), klein_gordon.waves(8, 0.1)
    with pytest.raises(ValueError, match=r"called as `flow\(time, y, args\)`"):
        ds.LinearFlow(inner, lambda y: y)  # pyright: ignore
    with pytest.raises(ValueError, match="wraps a solver of this package"):
        ds.LinearFlow(diffrax.Heun(), flow)
    init = lambda flow, y0=y0: ds.LinearFlow(inner, flow).init(
        terms, 0.0, 0.1, y0, None
    )
    with pytest.raises(ValueError, match="must return a pair like the state"):
        init(lambda time, y, args: (y[0], y[1][:4]))
    with pytest.raises(ValueError, match="is a pair"):
        init(flow, jnp.ones(8))
    # One propagator for all steps.
    with pytest.raises(ValueError, match="does not depend on `time`"):
        init(lambda time, y, args: flow(0.05, y, args))
