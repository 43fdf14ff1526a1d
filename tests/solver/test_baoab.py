"""Langevin dynamics by BAOAB, with friction by numbers and matrices."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._adjoint import _undoes_its_steps
from examples.hard_cases import double_well
from examples.hard_cases._ensemble import gaussian, weak
from examples.hard_cases._stationary import stationary_bias, Step

from ..families import slow_except
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
FRICTIONS = {
    "each": jnp.array([0.7, 0.2]),
    "matrix": as_friction(MATRIX),
    "positions": lambda t, q, args: as_friction(MATRIX * jnp.cos(t + q[0] - q[1])),
}


def _one_step(solver, terms, h, y0, t0=0.1):
    state = solver.init(terms, t0, t0 + h, y0, None)
    return solver.step(terms, t0, t0 + h, y0, None, state, False)[0]


@pytest.mark.parametrize(
    "make_path, expected",
    [
        (gaussian(), [-4.45e-3, -1.02e-3, -2.51e-4]),
        (weak(), [-3.15e-3, -7.74e-4, -1.96e-4]),
    ],
    ids=["Gaussian", "three-point"],
)
def test_stationary_bias_of_the_double_well(make_path, expected):
    step = Step(double_well.langevin_terms, make_path, ds.BAOAB())
    V = lambda q: double_well.energy(0.0, q)
    bias = stationary_bias(step, V, double_well.T, [0.4, 0.2, 0.1])
    np.testing.assert_allclose(bias[:, 0], expected, rtol=1e-2)


@pytest.mark.parametrize("solver", [ds.BAOAB(), ds.BAOAB(ds.StormerVerlet())])
@pytest.mark.parametrize(
    "friction", slow_except(["matrix"], ["each", "matrix", "positions"])
)
def test_local_weak_order_is_two(friction, solver):
    # The friction does not commute with the covariance of the noise, and may be one that
    # depends on positions and time.
    noise = _bath(SIGMA)
    if friction == "positions":
        noise = lambda t, p, q, args: jnp.stack([q[0], jnp.sin(q[1] + q[0] * t)])
    terms = damped_terms(_pendula, FRICTIONS[friction], noise, weak_path(2))
    y0 = jnp.array([0.3, -0.4]), jnp.array([0.5, 0.1])
    hs = jnp.array([0.004, 0.002, 0.001])
    batch = jax.tree.map(lambda x: x[None], y0)
    slopes = local_weak_orders(terms, solver, batch, None, hs, order=2)
    np.testing.assert_allclose(slopes, 3.0, atol=0.1)


def test_a_matrix_of_friction_is_that_of_its_own_axes():
    turn = jnp.linalg.qr(jr.normal(jr.key(0), (3, 3)))[0]
    rates = jnp.array([0.0, 0.3, 2.0])
    H0 = lambda t, p, q, args: jnp.sum(p**2 + jnp.sin(args @ q) ** 2) / 2
    noise = lambda t, p, q, args: -(args @ q)
    given = Given(jnp.array([0.3, -0.4, 0.1]))
    p, q = jr.normal(jr.key(1), (2, 3))

    def end(friction, turn):
        y0 = turn.T @ p, turn.T @ q
        terms = damped_terms(H0, friction, noise, given)
        ends = diffrax.diffeqsolve(
            terms, ds.BAOAB(), 0, 1, 0.25, y0, turn, max_steps=4
        ).ys
        return [turn @ x[-1] for x in ends]

    matrix = turn.T @ jnp.diag(rates) @ turn
    turned = end(as_friction(matrix), turn)
    np.testing.assert_allclose(turned, end(rates, jnp.eye(3)), atol=1e-13)
    # A matrix for momenta in a PyTree is an operator on it.
    kinetic = lambda t, p, q, args: jnp.sum(p["x"] ** 2) / 2
    y0 = ({"x": jnp.ones((3, 1))},) * 2
    blocks = {"x": {"x": matrix.reshape(3, 1, 3, 1)}}
    struct = jax.eval_shape(lambda: y0[0])
    tag = lx.positive_semidefinite_tag
    shaped = ds.langevin_terms(kinetic, lx.PyTreeLinearOperator(blocks, struct, tag))
    p1, _ = _one_step(ds.BAOAB(), shaped, 0.1, y0)
    x = 0.05 * np.asarray(matrix)
    expected = np.linalg.solve(np.eye(3) + x, (np.eye(3) - x) @ np.ones(3))
    np.testing.assert_allclose(p1["x"][:, 0], expected, atol=1e-14)


@pytest.mark.parametrize(
    "solver",
    [
        ds.BAOAB(),
        pytest.param(ds.BAOAB(ds.StormerVerlet()), marks=pytest.mark.slow),
    ],
)
def test_first_and_second_derivatives_by_a_matrix_with_equal_rates(solver):
    y0 = jnp.ones(2), jnp.zeros(2)

    def end(friction):
        given = as_friction(friction)
        terms = damped_terms(_pendula, given, _bath(SIGMA), weak_path(2))
        adjoint = diffrax.DirectAdjoint()
        sol = diffrax.diffeqsolve(
            terms, solver, 0, 1, 0.25, y0, max_steps=4, adjoint=adjoint
        )
        return jnp.sum(jnp.stack(sol.ys)[:, -1] * jnp.array([[1.0, 2.0], [-1.0, 0.5]]))

    change, k = jnp.array([[0.3, -0.2], [-0.2, 0.5]]), 1e-5
    both = jax.jit(jax.value_and_grad(end))
    second = jax.jit(lambda G: jax.jvp(jax.grad(end), (G,), (change,))[1])
    for friction in (0.6 * jnp.eye(2), MATRIX):
        (above, upper), (below, lower) = (both(friction + e * change) for e in (k, -k))
        slope = jnp.sum(both(friction)[1] * change)
        np.testing.assert_allclose(slope, (above - below) / (2 * k), rtol=1e-8)
        differences = (upper - lower) / (2 * k)
        np.testing.assert_allclose(second(friction), differences, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("friction", [0.5, jnp.array([0.5, 0.0]), MATRIX])
def test_momenta_fall_by_the_midpoint_rule_and_rise_again_backward(friction):
    # Of free particles with masses 1 and 4.
    H0 = lambda t, p, q, args: jnp.sum(p**2 / jnp.array([1.0, 4.0])) / 2
    given = as_friction(friction) if jnp.ndim(friction) == 2 else friction
    terms = ds.langevin_terms(H0, given)
    y0 = jnp.array([1.0, 2.0]), jnp.zeros(2)
    rates = np.eye(2) * friction if jnp.ndim(friction) < 2 else np.asarray(friction)
    x = rates / np.array([1.0, 4.0]) * 0.25 / 2
    once = np.linalg.solve(np.eye(2) + x, np.eye(2) - x)
    solver = ds.BAOAB()
    end = diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.25, y0, max_steps=4).ys
    expected = np.linalg.matrix_power(once, 4) @ y0[0]
    np.testing.assert_allclose(end[0][-1], expected, rtol=1e-13)
    back = tuple(x[-1] for x in end)
    back = diffrax.diffeqsolve(terms, solver, 1.0, 0.0, -0.25, back, max_steps=4).ys
    np.testing.assert_allclose([x[-1] for x in back], y0, atol=1e-14)


@pytest.mark.parametrize("solver", [ds.BAOAB(), ds.BAOAB(ds.StormerVerlet())])
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


def test_one_evaluation_of_the_forces_in_a_step():
    calls = []

    def H0(t, p, q, args):
        potential = jax.pure_callback(
            lambda q: calls.append(0) or np.sum(np.asarray(q) ** 2) / 2,
            jax.ShapeDtypeStruct((), q.dtype), jax.lax.stop_gradient(q),
        )  # fmt: skip
        force = jax.custom_jvp(lambda q: potential)
        force.defjvp(lambda x, v: (potential, potential * jnp.sum(v[0])))
        return jnp.sum(p**2) / 2 + force(q)

    terms = ds.langevin_terms(H0, 1.0, 1.0, weak_path(2), structure="separable")
    y0 = jnp.ones(2), jnp.ones(2)
    sol = diffrax.diffeqsolve(terms, ds.BAOAB(), 0, 1, 0.1, y0, max_steps=16)
    jax.block_until_ready(sol.ys)
    assert sol.stats["num_steps"] == 10
    assert len(calls) == 11


def test_after_a_jump_the_forces_are_new():
    terms = ds.langevin_terms(_pendula, 0.5, 0.8, Given(jnp.array([0.3, 0.1])))
    solver, y0 = ds.BAOAB(), (jnp.ones(2), jnp.zeros(2))
    state = solver.init(terms, 0.0, 0.1, (y0[0], y0[1] + 1), None)
    step = lambda state, jump: solver.step(terms, 0.0, 0.1, y0, None, state, jump)[0]
    fresh = step(solver.init(terms, 0.0, 0.1, y0, None), False)
    np.testing.assert_array_equal(jax.jit(step)(state, True), fresh)
    assert np.max(np.abs(np.subtract(step(state, False), fresh))) > 1e-3


def test_gradients_may_walk_back_along_the_solution():
    solver = ds.BAOAB()
    assert _undoes_its_steps(solver)
    assert _undoes_its_steps(ds.BAOAB(ds.StormerVerlet()))
    assert not _undoes_its_steps(ds.BAOAB(ds.SRKw4()))
    H0 = lambda t, p, q, args: _pendula(t, args * p, args * q, None)
    terms = ds.langevin_terms(H0, as_friction(MATRIX), 0.8, weak_path(2))

    def end(y0, args, adjoint):
        sol = diffrax.diffeqsolve(
            terms, solver, 0, 2, 0.1, y0, args, adjoint=adjoint, max_steps=32
        )
        return jnp.sum(sol.ys[0][-1] ** 2) + sol.ys[1][-1, 0]

    y0, args = (jnp.ones(2), jnp.array([0.2, 0.4])), jnp.array([1.0, 0.8])
    grad = jax.jit(jax.grad(end, argnums=(0, 1)), static_argnums=2)
    ours = grad(y0, args, ds.ReversingAdjoint(checkpoints=4))
    theirs = grad(y0, args, diffrax.RecursiveCheckpointAdjoint())
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), ours, theirs
    )


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
