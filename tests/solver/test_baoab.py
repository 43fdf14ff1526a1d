"""Langevin dynamics by BAOAB, with friction by numbers and matrices."""

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import as_friction, damped_terms, Given, local_weak_orders, weak_path


def _bath(sigma):
    """Constant noise of the matrix `sigma` in the momenta."""
    return lambda t, p, q, args: -q @ sigma


def _pendula(t, p, q, args):
    """With coupling, and masses 1 and 2."""
    forces = jnp.cos(q[0] - 2 * q[-1] + t) - jnp.sum(jnp.sin(q))
    return jnp.sum(p**2 / jnp.arange(1, len(p) + 1)) / 2 + forces


MATRIX = jnp.array([[1.0, 0.4], [0.4, 0.7]])
SIGMA = jnp.array([[0.5, 0.1], [-0.3, 0.8]])


each_flow = pytest.mark.parametrize(
    "solver",
    [ds.BAOAB(), pytest.param(ds.BAOAB(ds.StormerVerlet()), marks=pytest.mark.slow)],
    ids=repr,
)


@each_flow
def test_local_weak_order_is_two_where_friction_depends_on_positions_and_time(solver):
    # The friction does not commute with the covariance of the noise.
    friction = lambda t, q, args: as_friction(MATRIX * jnp.cos(t + q[0] - q[1]))
    noise = lambda t, p, q, args: jnp.stack([q[0], jnp.sin(q[1] + q[0] * t)])
    terms = damped_terms(_pendula, friction, noise, weak_path(2))
    y0 = jnp.array([0.3, -0.4]), jnp.array([0.5, 0.1])
    hs = jnp.array([0.004, 0.002, 0.001])
    batch = jax.tree.map(lambda x: x[None], y0)
    slopes = local_weak_orders(terms, solver, batch, None, hs, order=2)
    np.testing.assert_allclose(slopes, 3.0, atol=0.1)


@pytest.mark.slow
def test_first_and_second_derivatives_by_a_matrix_with_equal_rates():
    y0, weights = (jnp.ones(2), jnp.zeros(2)), jnp.array([[1.0, 2.0], [-1.0, 0.5]])

    def end(friction):
        given = as_friction(friction)
        terms = damped_terms(_pendula, given, _bath(SIGMA), weak_path(2))
        state = ds.BAOAB().init(terms, 0.0, 0.5, y0, None)
        y1, *_ = ds.BAOAB().step(terms, 0.0, 0.5, y0, None, state, False)
        return jnp.sum(jnp.stack(y1) * weights)

    change, k = jnp.array([[0.3, -0.2], [-0.2, 0.5]]), 1e-5
    both = jax.jit(jax.value_and_grad(end))
    second = jax.jit(lambda G: jax.jvp(jax.grad(end), (G,), (change,))[1])
    for friction in (0.6 * jnp.eye(2), MATRIX):
        (above, upper), (below, lower) = (both(friction + e * change) for e in (k, -k))
        slope = jnp.sum(both(friction)[1] * change)
        np.testing.assert_allclose(slope, (above - below) / (2 * k), rtol=1e-8)
        differences = (upper - lower) / (2 * k)
        np.testing.assert_allclose(second(friction), differences, rtol=1e-7, atol=1e-9)


def test_what_has_no_friction_is_refused():
    y0 = (jnp.ones(1), jnp.ones(1))
    noise = lambda t, p, q, args: jnp.stack([jnp.sum(jnp.sin(q))])
    terms = ds.hamiltonian_terms(_pendula, noise, weak_path(1))
    # A state (x, v), of which the first half is no momentum.
    drift = diffrax.ODETerm(lambda t, y, args: (y[1], -y[0]))
    for without in (terms, drift):
        with pytest.raises(ValueError, match="these have none.*`langevin_terms"):
            diffrax.diffeqsolve(without, ds.BAOAB(), 0.0, 1.0, 0.1, y0)


def test_friction_on_spins_is_refused_in_favour_of_their_damping():
    spins = ds.spin_terms(lambda t, s, args: s[2])
    bath = ds.bath_terms(lambda t, p, q, args: jnp.sum(p**2) / 2, 0.3)
    terms = diffrax.MultiTerm(*spins.terms, *bath.terms)
    y0 = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    with pytest.raises(ValueError, match="friction to a canonical.*Pass `damping=`"):
        diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.1, y0)


def test_between_steps_a_solution_is_interpolated_between_their_ends():
    push = lambda t, p, q, args: jnp.stack([jnp.sum(q)])
    terms = damped_terms(_pendula, 1.0, push, Given(jnp.array([0.3])))
    solver, y0 = ds.BAOAB(), (jnp.ones(2), jnp.ones(2))
    state = solver.init(terms, 0.0, 0.1, y0, None)
    y1, _, dense, *_ = solver.step(terms, 0.0, 0.1, y0, None, state, False)
    np.testing.assert_array_equal(dense["y0"], y0)
    np.testing.assert_array_equal(dense["y1"], y1)


def test_systems_without_the_structure_are_refused():
    y0, path = (jnp.ones(2), jnp.ones(2)), weak_path(2)
    mixed = lambda t, p, q, args: jnp.sum(p * q)
    mass = lambda t, p, q, args: p @ jnp.linalg.solve(jnp.diag(1 + q**2), p) / 2
    fast = lambda t, p, q, args: jnp.sum(jnp.sqrt(1 + p**2))
    of_momenta = lambda t, p, q, args: jnp.sin(p)
    for H0, noise, match in (
        (mixed, _bath(SIGMA), r"needs H0 = V.*`BAOAB\(ImplicitMidpoint\(\)\)`"),
        (mass, _bath(SIGMA), r"needs H0 = V.*`BAOAB\(ImplicitMidpoint\(\)\)`"),
        (_pendula, of_momenta, "needs H0 = V"),
        (fast, _bath(SIGMA), "linear in p.*`ImplicitMidpoint` or `StrangGauss`"),
    ):
        with pytest.raises(ValueError, match=f"`BAOAB` .*{match}"):
            terms = damped_terms(H0, 1.0, noise, path)
            ds.BAOAB().init(terms, 0.0, 0.1, y0, None)


def test_states_that_are_not_real_floating_point_are_refused():
    terms = damped_terms(_pendula, 1.0, _bath(SIGMA), weak_path(2))
    for dtype in (int, complex):
        y0 = jnp.ones(2, dtype), jnp.ones(2, dtype)
        with pytest.raises(ValueError, match="`BAOAB` needs a state `y0` of real"):
            ds.BAOAB().init(terms, 0.0, 0.1, y0, None)


def test_after_a_jump_the_forces_are_new():
    terms = ds.langevin_terms(_pendula, 0.5, 0.8, Given(jnp.array([0.3, 0.1])))
    solver, y0 = ds.BAOAB(), (jnp.ones(2), jnp.zeros(2))
    state = solver.init(terms, 0.0, 0.1, (y0[0], y0[1] + 1), None)
    step = lambda state, jump: solver.step(terms, 0.0, 0.1, y0, None, state, jump)[0]
    fresh = step(solver.init(terms, 0.0, 0.1, y0, None), False)
    np.testing.assert_array_equal(jax.jit(step)(state, True), fresh)
    assert np.max(np.abs(np.subtract(step(state, False), fresh))) > 1e-3


def test_backward_in_time_a_step_is_undone():
    terms = ds.langevin_terms(
        _pendula, as_friction(MATRIX), 0.8, Given(jnp.array([0.3, 0.1]))
    )
    y0 = jnp.ones(2), jnp.array([0.2, 0.4])
    solve = lambda t0, t1, y: [
        x[-1]
        for x in diffrax.diffeqsolve(
            terms, ds.BAOAB(), t0, t1, (t1 - t0) / 8, y, max_steps=8
        ).ys
    ]
    there = solve(0.0, 1.0, y0)
    np.testing.assert_allclose(solve(1.0, 0.0, tuple(there)), y0, atol=1e-13)


def test_a_drift_that_time_does_not_drive_is_refused():
    control = diffrax.LinearInterpolation(jnp.array([0.0, 1.0]), jnp.array([0.0, 2.0]))
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def field(t, y, args):
        return lx.FunctionLinearOperator(lambda w: (-y[1] * w, y[0] * w), number)

    bath = ds.bath_terms(_pendula, 0.5, 1.0, weak_path(2)).terms
    terms = diffrax.MultiTerm(diffrax.ControlTerm(field, control), *bath)
    with pytest.raises(ValueError, match="`BAOAB` needs a drift driven by time"):
        ds.BAOAB().init(terms, 0.0, 0.1, (jnp.ones(2), jnp.ones(2)), None)
