"""Langevin dynamics by BAOAB, and friction by a matrix."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest
import scipy.linalg

import diffrax_symplectic as ds
from diffrax_symplectic._adjoint import _undoes_its_steps
from diffrax_symplectic._solver._friction import spread
from examples.hard_cases import double_well
from examples.hard_cases._ensemble import gaussian, weak
from examples.hard_cases._stationary import stationary_bias, Step

from ..problems import Given, orders_of_a_splitting, weak_path


def _bath(sigma):
    """Constant noise of the matrix `sigma` in the momenta."""
    return lambda t, p, q, args: -q @ sigma


def _pendula(t, p, q, args):
    """With coupling, and masses 1 and 2."""
    forces = jnp.cos(q[0] - 2 * q[-1] + t) - jnp.sum(jnp.sin(q))
    return jnp.sum(p**2 / jnp.arange(1, len(p) + 1)) / 2 + forces


MATRIX = jnp.array([[1.0, 0.4], [0.4, 0.7]])
SIGMA = jnp.array([[0.5, 0.1], [-0.3, 0.8]])
FRICTIONS = {"number": 0.7, "each": jnp.array([0.7, 0.2]), "matrix": MATRIX}


def _one_step(solver, terms, h, y0, t0=0.1):
    state = solver.init(terms, t0, t0 + h, y0, None)
    return solver.step(terms, t0, t0 + h, y0, None, state, False)[0]


@pytest.mark.parametrize(
    "make_path, expected",
    [
        (gaussian(), [-4.51e-3, -1.03e-3, -2.51e-4]),
        (weak(), [-3.22e-3, -7.78e-4, -1.96e-4]),
    ],
    ids=["Gaussian", "three-point"],
)
def test_stationary_bias_of_the_double_well(make_path, expected):
    step = Step(double_well.langevin_terms, make_path, ds.BAOAB(1.0))
    V = lambda q: double_well.energy(0.0, q)
    bias = stationary_bias(step, V, double_well.T, [0.4, 0.2, 0.1])
    np.testing.assert_allclose(bias[:, 0], expected, rtol=1e-2)


@pytest.mark.parametrize("h", [0.1, 0.5, 1.5])
def test_positions_in_a_harmonic_well_have_the_law_of_gibbs(h):
    gamma, T, mass, stiffness = 0.7, 0.5, 2.0, 1.6
    H0 = lambda t, p, q, args: p**2 / (2 * mass) + stiffness * q**2 / 2
    noise = lambda t, p, q, args: -np.sqrt(2 * gamma * mass * T) * q
    terms = ds.hamiltonian_terms(H0, noise, ds.FixedStepBrownianPath((), jr.key(0)))
    y0 = jnp.array(0.0), jnp.array(0.0)
    moments_of = lambda h: ds.second_moment_map(terms, ds.BAOAB(gamma), 0.0, h, y0)
    K = jax.jit(moments_of)(h)
    # The stationary second moments of z = (1, p, q).
    rest = np.array([i for i in range(9) if i != 0])
    moments = np.linalg.solve(
        np.eye(8) - np.array(K)[np.ix_(rest, rest)], np.array(K)[rest, 0]
    )
    assert abs(moments[-1] - T / stiffness) <= 1e-13


@pytest.mark.parametrize(
    "wrap", [ds.BAOAB, lambda gamma: ds.Damped(ds.StormerVerlet(), gamma)]
)
@pytest.mark.parametrize("friction", ["each", "matrix"])
def test_local_weak_defect_is_of_order_three(friction, wrap):
    # The matrix does not commute with the covariance of the noise.
    gamma = FRICTIONS[friction]
    full = gamma if jnp.ndim(gamma) == 2 else jnp.diag(gamma * jnp.ones(2))
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), weak_path(2))
    term = lambda t, y, args: (-full @ y[0], jnp.zeros_like(y[1]))
    y0 = jnp.array([0.3, -0.4]), jnp.array([0.5, 0.1])
    hs = np.array([0.02, 0.01, 0.005])
    slopes = orders_of_a_splitting(wrap(gamma), terms, term, y0, hs)
    np.testing.assert_allclose(slopes, 3.0, atol=0.1)


def test_friction_and_noise_together_have_their_exact_law():
    # Free momenta. The noise commutes with the friction. The axes of two by two matrices
    # may be their own transposes, those of three by three are not.
    h = 0.8
    gamma = jnp.array([[1.0, 0.4, 0.1], [0.4, 0.7, -0.3], [0.1, -0.3, 0.5]])
    sigma = scipy.linalg.sqrtm(2 * np.asarray(gamma)).real
    free = lambda t, p, q, args: 0 * jnp.sum(p)
    y0 = jnp.array([1.0, 2.0, -0.5]), jnp.zeros(3)

    def after(W):
        terms = ds.hamiltonian_terms(free, _bath(sigma), Given(W))
        return _one_step(ds.BAOAB(gamma), terms, h, y0)[0]

    decay = scipy.linalg.expm(-np.asarray(gamma) * h)
    zero = jnp.zeros(3)
    A, mean = jax.jit(lambda W: (jax.jacobian(after)(W), after(W)))(zero)
    np.testing.assert_allclose(mean, decay @ y0[0], atol=1e-14)
    covariance = np.eye(3) - decay @ decay  # at temperature 1
    np.testing.assert_allclose(h * A @ A.T, covariance, atol=2e-15)


def test_spread_is_smooth_and_exact_on_both_sides_of_zero():
    x = jnp.concatenate([-jnp.logspace(-9, 1, 200), jnp.logspace(-9, 1, 200)])
    exact = np.sqrt(-np.expm1(-2 * np.longdouble(x)) / (2 * np.longdouble(x)))
    np.testing.assert_allclose(spread(x), exact.astype(float), rtol=1e-15)
    # It undoes itself: backward in time the noise is taken out again.
    np.testing.assert_allclose(spread(-x), jnp.exp(x) * spread(x), rtol=1e-14)
    assert spread(jnp.array(0.0)) == 1 and jax.grad(spread)(0.0) == -0.5
    assert jnp.isfinite(spread(jnp.array(1e4)))
    assert jnp.isfinite(jax.grad(spread)(1e50))


def test_a_matrix_of_friction_is_that_of_its_own_axes():
    turn = jnp.linalg.qr(jr.normal(jr.key(0), (3, 3)))[0]
    rates = jnp.array([0.0, 0.3, 2.0])
    H0 = lambda t, p, q, args: jnp.sum(p**2 + jnp.sin(args @ q) ** 2) / 2
    noise = lambda t, p, q, args: -(args @ q)
    terms = ds.hamiltonian_terms(H0, noise, Given(jnp.array([0.3, -0.4, 0.1])))
    p, q = jr.normal(jr.key(1), (2, 3))

    def end(gamma, turn):
        y0 = turn.T @ p, turn.T @ q
        ends = diffrax.diffeqsolve(
            terms, ds.BAOAB(gamma), 0, 1, 0.25, y0, turn, max_steps=4
        ).ys
        return [turn @ x[-1] for x in ends]

    matrix = turn.T @ jnp.diag(rates) @ turn
    np.testing.assert_allclose(end(matrix, turn), end(rates, jnp.eye(3)), atol=1e-13)
    # Arrays of momenta have matrices of twice their shape, in PyTrees as well.
    shaped = ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p["x"] ** 2) / 2,
        lambda t, p, q, args: 0.0 * q["x"][0],
        Given(jnp.zeros(1)),
    )
    y0 = ({"x": jnp.ones((3, 1))},) * 2
    p1, _ = _one_step(ds.BAOAB({"x": matrix.reshape(3, 1, 3, 1)}), shaped, 0.1, y0)
    expected = scipy.linalg.expm(-0.1 * np.asarray(matrix)) @ np.ones(3)
    np.testing.assert_allclose(p1["x"][:, 0], expected, atol=1e-14)


@pytest.mark.parametrize("wrap", [ds.BAOAB, lambda g: ds.Damped(ds.StormerVerlet(), g)])
def test_gradients_with_respect_to_a_matrix_with_equal_rates(wrap):
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), weak_path(2))
    y0 = jnp.ones(2), jnp.zeros(2)

    def end(gamma, adjoint=None):
        sol = diffrax.diffeqsolve(
            terms, wrap(gamma), 0, 1, 0.25, y0, max_steps=4,
            adjoint=adjoint or diffrax.RecursiveCheckpointAdjoint(),
        )  # fmt: skip
        return jnp.sum(jnp.stack(sol.ys)[:, -1] * jnp.array([[1.0, 2.0], [-1.0, 0.5]]))

    change, k = jnp.array([[0.3, -0.2], [-0.2, 0.5]]), 1e-5
    both = jax.jit(jax.value_and_grad(end))
    for gamma in (0.6 * jnp.eye(2), MATRIX, 5 * MATRIX):
        plus, minus = (both(gamma + e * change)[0] for e in (k, -k))
        slope, gradient = (plus - minus) / (2 * k), both(gamma)[1]
        np.testing.assert_allclose(jnp.sum(gradient * change), slope, rtol=1e-8)
    # A second derivative is refused, and not wrong. From compiled programs JAX drops what
    # no derivative reads.
    direct = jax.jit(lambda gamma: end(gamma, diffrax.DirectAdjoint()))
    for second in (jax.hessian(end), jax.hessian(direct), jax.jit(jax.hessian(direct))):
        with pytest.raises(Exception, match="a second time"):
            jax.eval_shape(second, MATRIX)


def test_a_matrix_may_take_the_place_of_a_number_and_solvers_be_batched():
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), Given(jnp.array([0.3, 0.1])))
    y0 = jnp.ones(2), jnp.array([0.2, 0.4])
    step = lambda solver: jnp.stack(_one_step(solver, terms, 0.25, y0))
    expected = step(ds.BAOAB(MATRIX))
    replaced = eqx.tree_at(lambda s: s.gamma, ds.BAOAB(1.0), MATRIX)
    np.testing.assert_allclose(step(replaced), expected, rtol=1e-15)
    batch = eqx.filter_vmap(step)(ds.BAOAB(jnp.stack([MATRIX, 2 * MATRIX, MATRIX])))
    np.testing.assert_allclose(batch[::2], [expected] * 2, rtol=1e-14)
    # What takes the place is checked, too.
    skew = jnp.array([[1.0, 0.5], [0.2, 1.0]])
    with pytest.raises(ValueError, match="semidefinite matrix.*but it is not"):
        step(eqx.tree_at(lambda s: s.gamma, ds.BAOAB(1.0), skew))


def test_frictions_that_are_none_are_refused():
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), Given(jnp.zeros(2)))
    y0 = jnp.ones(2), jnp.ones(2)
    negative = jnp.array([[1.0, -3.0], [-3.0, 1.0]])
    for wrong, match in (
        (-1.0, "must not be negative: .*; got -1.0"),
        (jnp.nan, "must be finite"),
        (negative, "but it has the negative eigenvalue -2"),
        (
            jnp.array([[1.0, -0.5], [0.5, 1.0]]),
            "but it is not symmetric, and has complex",
        ),
    ):
        with pytest.raises(ValueError, match=f"`gamma` .*{match}"):
            ds.BAOAB(wrong)
    with pytest.raises(ValueError, match="a real number, an array or a PyTree"):
        ds.BAOAB(True)
    # For momenta of shape (2, 2) these are rates. For two momenta they are matrices.
    for wrong, match in (
        (jnp.array([[1.0, 0.5], [0.2, 1.0]]), "not symmetric"),
        (jnp.array([[1.0, 3.0], [3.0, 1.0]]), "the negative eigenvalue -2"),
    ):
        for solver in (ds.BAOAB(wrong), ds.Damped(ds.StormerVerlet(), wrong)):
            with pytest.raises(ValueError, match=f"semidefinite matrix.*{match}"):
                solver.init(terms, 0.0, 0.1, y0, None)
    # The solve traces them, but they were passed as numbers.
    with pytest.raises(ValueError, match="the negative eigenvalue -2") as info:
        diffrax.diffeqsolve(terms, ds.BAOAB(wrong), 0.0, 1.0, 0.1, y0)
    assert "Tracer" not in str(info.value)
    with pytest.raises(ValueError, match=r"as a matrix the shape \(2, 2\)"):
        ds.BAOAB(jnp.ones(3)).init(terms, 0.0, 0.1, y0, None)


def test_traced_frictions_that_are_none_fail_their_paths_alone():
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), Given(jnp.array([0.3, 0.1])))
    y0 = jnp.ones(2), jnp.ones(2)

    @eqx.filter_jit
    @jax.vmap
    def run(gamma):
        solver = ds.BAOAB(gamma)
        sol = diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, throw=False)
        says = sol.result == diffrax.RESULTS.nonfinite
        return sol.result == diffrax.RESULTS.successful, says

    eye = jnp.eye(2)
    skew = jnp.array([[1.0, 0.5], [0.2, 1.0]])
    matrices = jnp.stack([eye, -eye, MATRIX, skew, jnp.nan * eye, 0 * eye])
    of_matrices = [True, False, True, False, False, True]
    rates = jnp.array([0.5, -0.5, jnp.inf])
    for gammas, expected in ((matrices, of_matrices), (rates, [True, False, False])):
        good, says_why = run(gammas)
        np.testing.assert_array_equal(good, expected)
        np.testing.assert_array_equal(says_why, ~good)


def test_systems_without_the_structure_are_refused():
    y0, path = (jnp.ones(2), jnp.ones(2)), weak_path(2)
    mixed = lambda t, p, q, args: jnp.sum(p * q)
    state = lambda t, p, q, args: jnp.sin(q)
    in_time = lambda t, p, q, args: jnp.sin(t) * q
    for H0, noise, match in (
        (mixed, _bath(SIGMA), "needs H0 = V"),
        (_pendula, state, "needs additive noise"),
        (_pendula, in_time, "constant in time"),
    ):
        with pytest.raises(ValueError, match=f"`BAOAB` {match}|{match}"):
            ds.BAOAB(1.0).init(
                ds.hamiltonian_terms(H0, noise, path), 0.0, 0.1, y0, None
            )


def test_states_that_are_not_real_floating_point_are_refused():
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), weak_path(2))
    for dtype in (int, complex):
        y0 = jnp.ones(2, dtype), jnp.ones(2, dtype)
        with pytest.raises(ValueError, match="`BAOAB` needs a state `y0` of real"):
            ds.BAOAB(1.0).init(terms, 0.0, 0.1, y0, None)


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

    terms = ds.hamiltonian_terms(H0, _bath(SIGMA), weak_path(2), structure="separable")
    y0 = jnp.ones(2), jnp.ones(2)
    sol = diffrax.diffeqsolve(terms, ds.BAOAB(1.0), 0, 1, 0.1, y0, max_steps=16)
    jax.block_until_ready(sol.ys)
    assert sol.stats["num_steps"] == 10
    assert len(calls) == 11


def test_terms_of_diffrax_for_langevin_dynamics_translate_as_the_docs_say():
    gamma, u = jnp.array([0.7, 0.2]), jnp.array([0.5, 2.0])
    f = lambda x: jnp.sum(jnp.cos(x) * x)
    grad_f = lambda x, args: jax.grad(f)(x)
    path = diffrax.UnsafeBrownianPath((2,), jr.key(0))
    theirs = diffrax.UnderdampedLangevinDriftTerm(gamma, u, grad_f)
    noise = diffrax.UnderdampedLangevinDiffusionTerm(gamma, u, path)
    drift, diffusion = ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(u * p**2) / 2 + f(q),
        lambda t, p, q, args: -jnp.sqrt(2 * gamma / u) * q,
        path,
    ).terms
    x, v, W = jr.normal(jr.key(1), (3, 2))
    p, q = v / u, x
    dp, dq = drift.vf(0.0, (p, q), None)
    dx, dv = theirs.vf(0.0, (x, v), None)
    np.testing.assert_allclose(dx, dq, atol=1e-15)
    np.testing.assert_allclose(dv, u * (dp - gamma * p), atol=1e-15)
    dp, _ = diffusion.vf_prod(0.0, (p, q), None, W)
    _, dv = noise.vf_prod(0.0, (x, v), None, W)
    np.testing.assert_allclose(dv, u * dp, atol=1e-15)


def test_after_a_jump_the_forces_are_new():
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), Given(jnp.array([0.3, 0.1])))
    solver, y0 = ds.BAOAB(0.5), (jnp.ones(2), jnp.zeros(2))
    state = solver.init(terms, 0.0, 0.1, (y0[0], y0[1] + 1), None)
    step = lambda state, jump: solver.step(terms, 0.0, 0.1, y0, None, state, jump)[0]
    fresh = step(solver.init(terms, 0.0, 0.1, y0, None), False)
    np.testing.assert_array_equal(jax.jit(step)(state, True), fresh)
    assert np.max(np.abs(np.subtract(step(state, False), fresh))) > 1e-3


def test_gradients_may_walk_back_along_the_solution():
    solver = ds.BAOAB(MATRIX)
    assert _undoes_its_steps(solver)
    assert _undoes_its_steps(ds.Damped(ds.StormerVerlet(), MATRIX))
    assert not _undoes_its_steps(ds.Damped(ds.SRKw4(), 1.0))
    H0 = lambda t, p, q, args: _pendula(t, p, args * q, None)
    terms = ds.hamiltonian_terms(H0, _bath(SIGMA), weak_path(2))

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
    terms = ds.hamiltonian_terms(_pendula, _bath(SIGMA), Given(jnp.zeros(2)))
    y0 = jnp.ones(2), jnp.array([0.2, 0.4])
    solve = lambda t0, t1, y: [
        x[-1]
        for x in diffrax.diffeqsolve(
            terms, ds.BAOAB(MATRIX), t0, t1, (t1 - t0) / 8, y, max_steps=8
        ).ys
    ]
    there = solve(0.0, 1.0, y0)
    np.testing.assert_allclose(solve(1.0, 0.0, tuple(there)), y0, atol=1e-13)


def test_a_drift_that_time_does_not_drive_is_refused():
    control = diffrax.LinearInterpolation(jnp.array([0.0, 1.0]), jnp.array([0.0, 2.0]))
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def field(t, y, args):
        return lx.FunctionLinearOperator(lambda w: (-y[1] * w, y[0] * w), number)

    bath = ds.hamiltonian_terms(_pendula, _bath(SIGMA), weak_path(2)).terms[1]
    terms = diffrax.MultiTerm(diffrax.ControlTerm(field, control), bath)
    with pytest.raises(ValueError, match="`BAOAB` needs a drift driven by time"):
        ds.BAOAB(1.0).init(terms, 0.0, 0.1, (jnp.ones(2), jnp.ones(2)), None)
