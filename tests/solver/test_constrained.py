"""Systems with constraints: the steps that keep them, and starts that satisfy them."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.integrate

import diffrax_symplectic as ds
from diffrax_symplectic._solver.step import no_failure

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..problems import as_friction, Given


MASSES = jnp.array([1.0, 2.0])[:, None]


def chain_energy(t, p, q, args):
    wind = args * jnp.sum(jnp.cos(q) * jnp.sin(q[::-1] + t**2))
    return jnp.sum(p**2 / MASSES) / 2 + jnp.sum(MASSES[:, 0] * q[:, 1]) + wind


def gusts(t, p, q, args):
    return 0.3 * jnp.stack([jnp.sin(q[0, 0] + q[1, 1]), jnp.cos(q[1, 0]) * q[1, 1]])


def rods(q, args):
    """Two rods of length 1, in a chain that hangs from the origin."""
    return jnp.sum(jnp.diff(q, axis=0, prepend=0) ** 2, axis=1) - 1


def chain(path):
    return ds.hamiltonian_terms(chain_energy, gusts, path, constraint=rods)


@jax.jit
@jax.vmap
def chain_states(key):
    """Any allowed states."""
    p, angles = jr.normal(key, (2, 2)), jr.uniform(key, (2,), maxval=2 * jnp.pi)
    steps = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    terms = chain(ds.WeakBrownianPath((2,), jr.key(0)))
    return ds.constrained_state(terms, (p, jnp.cumsum(steps, axis=0)), 0.5)


KEYS = jr.split(jr.key(1), 50)


def some_chain_state():
    return jax.tree.map(lambda x: x[0], chain_states(KEYS))


def take_steps(number, terms, h, y0, args=None):
    """The end of some steps. Compared with a solve they are quick to compile, and may be
    differentiated in reverse mode."""
    solver = ds.StormerVerlet()
    state = solver.init(terms, 0.0, h, y0, args)

    def body(carry, i):
        y, state = carry
        y, _, _, state, result = solver.step(
            terms, i * h, (i + 1) * h, y, args, state, False
        )
        return (y, state), result == diffrax.RESULTS.successful

    (y, _), okay = jax.lax.scan(body, (y0, state), jnp.arange(number))
    return y, jnp.all(okay)


def test_steps_are_symplectic_on_the_constrained_phase_space():
    @jax.jit
    @jax.vmap
    def defect(key, y0):
        at = chain(Given(0.3 * jr.normal(key, (2,)))), ds.StormerVerlet(), 0.0, 0.1
        return ds.symplecticity_defect(*at, y0, 0.5)

    assert np.max(defect(KEYS, chain_states(KEYS))) <= 1e-14


def pendulum_energy(t, p, q, args):
    return jnp.sum(p**2) / 2 + q[1]


def rod(q, args):
    return jnp.stack([jnp.sum(q**2) - 1])


PENDULUM = ds.hamiltonian_terms(pendulum_energy, constraint=rod)
# At the angle 0, of the speed 0.1.
LEVEL = jnp.array([0.0, 0.1]), jnp.array([1.0, 0.0])


def test_solves_have_order_two_forward_and_return_backward():
    @jax.jit
    def solve(t0, t1, steps, y0):
        at = PENDULUM, ds.StormerVerlet(), t0, t1, (t1 - t0) / steps, y0
        sol = diffrax.diffeqsolve(*at, max_steps=None, adjoint=diffrax.ForwardMode())
        return jnp.stack([x[-1] for x in sol.ys])

    in_angle = lambda t, y: [y[1], -np.cos(y[0])]
    exact = scipy.integrate.solve_ivp(
        in_angle, (0, 2), (0.0, 0.1), "DOP853", rtol=1e-12
    )
    theta, speed = exact.y[:, -1]
    along = np.array([-np.sin(theta), np.cos(theta)])
    right = np.stack([speed * along, [np.cos(theta), np.sin(theta)]])
    coarse, half = (solve(0.0, 2.0, n, LEVEL) for n in (40, 80))
    errors = [np.linalg.norm(y - right, axis=1) for y in (coarse, half)]
    np.testing.assert_allclose(np.log2(np.divide(*errors)), 2, atol=0.02)
    begin = solve(2.0, 0.0, 40, tuple(coarse))
    np.testing.assert_allclose(begin, np.stack(LEVEL), atol=1e-13)


def test_derivatives_are_those_of_the_solution():
    # With respect to masses, to the length of the rod, and to the start.
    def H0(t, p, q, args):
        return jnp.sum(p["x"] ** 2) / (2 * args["mass"]) + args["mass"] * q["x"][1]

    def ring(q, args):
        return jnp.stack([jnp.sum(q["x"] ** 2) - args["length"] ** 2])

    terms = ds.hamiltonian_terms(H0, constraint=ring)

    def end(x):
        args = {"mass": x[0], "length": x[1]}
        y0 = {"x": x[2:4]}, {"x": x[4:]}
        y0 = ds.constrained_state(terms, y0, args)
        (p, q), _ = take_steps(1, terms, 0.1, y0, args)
        return jnp.sum(p["x"] ** 3) + jnp.sum(q["x"] ** 3)

    x = np.array([1.3, 0.8, 0.3, 0.4, 0.6, 0.5])
    # Along each of them, and once more along all.
    along = [*np.eye(6), np.ones(6)]
    moved = np.stack([x, *[x + s * 1e-5 * e for e in along for s in (1, -1)]])
    both = jax.vmap(jax.value_and_grad(end))
    forward = jax.jit(lambda x: jax.jvp(both, (x,), (jnp.ones_like(x),)))
    (values, gradients), (slope, second) = jax.device_get(forward(moved))
    differences = (values[1:13:2] - values[2:13:2]) / 2e-5
    np.testing.assert_allclose(differences, gradients[0], atol=1e-8)
    np.testing.assert_allclose(slope[0], np.sum(gradients[0]), rtol=1e-11)
    differences = (gradients[-2] - gradients[-1]) / 2e-5
    np.testing.assert_allclose(differences, second[0], rtol=1e-7, atol=1e-8)


OFF = LEVEL[0], 1.01 * LEVEL[1]


def test_steps_that_are_too_long_and_starts_off_the_surface_fail_alone():
    @jax.jit
    @ft.partial(jax.value_and_grad, has_aux=True)
    def ends(speeds, q):
        def end(speed, q):
            y0 = jnp.stack([0 * speed, speed]), q
            (_, q), okay = take_steps(2, PENDULUM, 0.5, y0)
            return q, okay

        q, okay = jax.vmap(end)(speeds, q)
        return jnp.sum(q), (q, okay)

    speeds = jnp.array([0.1, 40.0, 0.2, jnp.nan, 0.2])
    on = jnp.stack([LEVEL[1]] * 5)
    (_, (q, okay)), _ = ends(speeds, on.at[4].set(OFF[1]))
    np.testing.assert_array_equal(okay, [True, False, True, False, False])
    (_, (alone, okay)), right = ends(jnp.array([0.1, 0.1, 0.2, 0.2, 0.2]), on)
    assert np.all(okay)
    np.testing.assert_allclose(q[:3:2], alone[:3:2], rtol=1e-14)
    # Summed over a batch, too, a path without a solution has no derivative.
    _, found = ends(speeds.at[3].set(0.3), on)
    assert found[1] == 0
    np.testing.assert_allclose(found[:3:2], right[:3:2], rtol=1e-12)


TWICE = ds.hamiltonian_terms(
    pendulum_energy, constraint=lambda q, args: jnp.sum(q**2) - jnp.array([1.0, 1.0])
)


def _free(t, p, q, args):
    return jnp.sum(p**2) / 2


def _distances(q, args):
    sides = q - jnp.roll(q, 1, axis=0)
    return jnp.sum(sides**2, axis=1) - jnp.array([4.0, 1.0, 1.0])


LINE = jnp.zeros((3, 2)), jnp.array([[-0.6, -0.8], [0.0, 0.0], [0.6, 0.8]])


def test_bad_starts_and_redundant_constraints_are_refused():
    in_a_line = r"atoms on a line.*q\[1\] - \(q\[0\] \+ q\[2\]\) / 2"
    line = ds.hamiltonian_terms(_free, constraint=_distances)
    single = jnp.array([0.2, 1.0], jnp.float32), jnp.array([0.3, 0.5], jnp.float32)
    single = ds.constrained_state(PENDULUM, single)
    for terms, y0, advice in (
        (PENDULUM, LEVEL[::-1], "constrained_state"),
        (PENDULUM, (LEVEL[0], 0 * LEVEL[1]), "linearly dependent"),
        (line, LINE, in_a_line),
        # Diffrax converts a state in single precision to the precision of the times.
        (PENDULUM, jax.tree.map(jnp.float64, single), "dtype of the times"),
        (PENDULUM, OFF, "constrained_state"),
        (TWICE, LEVEL, "linearly dependent"),
    ):
        init = lambda y0, terms=terms: ds.StormerVerlet().init(
            terms, 0.0, 0.1, y0, None
        )
        with pytest.raises(ValueError, match=advice):
            init(y0)
    # Also from within a program.
    with pytest.raises(Exception, match=advice):
        jax.jit(init)(y0)
    # What is left of a momentum that was normal is no reason.
    normal = jnp.array([0.3, 0.7])
    y0 = ds.constrained_state(PENDULUM, (normal, normal))
    ds.StormerVerlet().init(PENDULUM, 0.0, 0.1, y0, None)


def test_a_state_is_projected_in_the_metric_of_the_masses():
    terms = chain(ds.WeakBrownianPath((2,), jr.key(0)))
    p, q = jr.normal(jr.key(3), (2, 2)), 0.9 * some_chain_state()[1]

    @jax.jit
    def project(y, wind):
        y1 = ds.constrained_state(terms, y, wind)
        return y1, [jax.jacfwd(rods)(x, None).reshape(2, 4) for x in (y[1], y1[1])]

    (p1, q1), (before, after) = jax.device_get(project((p, q), 0.5))
    assert np.max(np.abs(rods(q1, None))) <= 1e-15
    # Positions move along M^-1 J^T at the old ones, momenta along J^T at the new ones.
    masses = np.asarray(MASSES)
    for normals, x in ((before, (q1 - q) * masses), (after, p1 - p)):
        rest = np.linalg.lstsq(normals.T, np.ravel(x))[1]
        assert rest <= 1e-28
    np.testing.assert_allclose(after @ np.ravel(p1 / masses), 0, atol=1e-14)
    again, _ = project((p1, q1), 0.5)
    np.testing.assert_allclose(np.stack(again), np.stack((p1, q1)), atol=1e-15)
    single = jax.tree.map(jnp.float32, (p, q))
    below, _ = project(single, jnp.float32(0.5))
    assert below[0].dtype == jnp.float32
    np.testing.assert_allclose(np.stack(below), np.stack((p1, q1)), atol=2e-6)


def test_positions_that_cannot_be_projected_are_refused():
    # No point of the parabola's tangent space reaches a negative number.
    above = lambda q, args: jnp.stack([q[0] ** 2 + 1])
    terms = ds.hamiltonian_terms(pendulum_energy, constraint=above)
    with pytest.raises(ValueError, match="closer"):
        ds.constrained_state(terms, LEVEL)
    nowhere = jax.jit(lambda y0: ds.constrained_state(terms, y0))(LEVEL)
    assert np.all(np.isnan(np.stack(nowhere)))
    with pytest.raises(ValueError, match="needs constrained terms"):
        ds.constrained_state(ds.hamiltonian_terms(pendulum_energy), LEVEL)


def test_other_solvers_refuse_constraints_and_name_those_that_keep_them():
    flow = lambda time, y, args: (y[0] - time, y[1])
    implicit = ds.ImplicitMidpoint()
    path = implicit.path((2,), jr.key(0))
    without_noise = ds.hamiltonian_terms(chain_energy, constraint=rods)
    adaptive = diffrax.PIDController(1e-3, 1e-3)
    plateaus, flows = ds.PlateauVerlet(), ds.NinomiyaVictoir()
    for solver, terms, controller in (
        *((x, chain(x.path((2,), jr.key(0))), None) for x in (plateaus, flows)),
        (implicit, chain(path), None),
        (ds.LinearFlow(ds.StormerVerlet(), flow), chain(path), None),
        (diffrax.EulerHeun(), chain(path), None),
        (diffrax.Tsit5(), without_noise, adaptive),
        (diffrax.Kvaerno5(), without_noise, adaptive),
    ):
        at = terms, solver, 0.0, 1.0, 0.1, some_chain_state(), 0.5
        controller = controller or diffrax.ConstantStepSize()
        with pytest.raises(ValueError, match="`StormerVerlet.*BAOAB"):
            diffrax.diffeqsolve(*at, stepsize_controller=controller)


def test_what_makes_no_sense_with_constraints_refuses_them():
    terms = chain(ds.WeakBrownianPath((2,), jr.key(0)))
    y0 = some_chain_state()
    at = terms, ds.StormerVerlet(), 0.0, 0.1, y0, 0.5
    fn = lambda t, y, args: y[0]
    for name, call in (
        ("second_moment_map", lambda: ds.second_moment_map(*at)),
        ("weak_order_defect", lambda: ds.weak_order_defect(*at, fn=fn, order=1)),
        (
            "ReversingAdjoint",
            lambda: diffrax.diffeqsolve(
                *at[:2], 0.0, 1.0, 0.1, y0, 0.5, adjoint=ds.ReversingAdjoint()
            ),
        ),
    ):
        with pytest.raises(ValueError, match=f"`{name}` takes no constrained terms"):
            call()
    two = diffrax.MultiTerm(*terms.terms, *PENDULUM.terms)
    with pytest.raises(ValueError, match="Only one of the terms"):
        ds.StormerVerlet().init(two, *at[2:])


def test_constraints_of_another_kind_are_refused():
    for constraint, message in (
        (lambda q, args: jnp.sum(q**2) - 1, "real array of shape"),
        (lambda q, args: (q[0],), "real array of shape"),
        (lambda q, args: q[:, None], "real array of shape"),
        (lambda q, args: 1j * q, r"real array of shape .*got c\d+\["),
        (lambda q, args: q > 0, r"real array of shape .*got bool\["),
        (lambda q: q, "is called as `constraint"),
        (3.0, "must be a function"),
    ):
        with pytest.raises(ValueError, match=message):
            terms = ds.hamiltonian_terms(pendulum_energy, constraint=constraint)
            ds.StormerVerlet().init(terms, 0.0, 0.1, LEVEL, None)


def test_masses_that_are_not_constant_are_refused():
    for H0, message in (
        (lambda t, p, q, args: jnp.sum(jnp.sqrt(1 + p**2)) + q[1], "constant masses"),
        (lambda t, p, q, args: jnp.sum(p**2) * q[1], "dH0/dq depends on p"),
    ):
        terms = ds.hamiltonian_terms(H0, constraint=rod)
        with pytest.raises(ValueError, match=message):
            ds.StormerVerlet().init(terms, 0.0, 0.1, LEVEL, None)
        with pytest.raises(ValueError, match=message):
            ds.constrained_state(terms, LEVEL)


# Friction between coordinates, masses that differ, and a plane that is oblique to both.
INERTIA = jnp.array([1.0, 4.0, 0.5])
TENSOR = jnp.array([[1.0, 0.3, 0.0], [0.3, 0.5, -0.2], [0.0, -0.2, 0.7]])
NORMAL, TEMPERATURE = jnp.array([1.0, -2.0, 0.5]), 0.6
STIFF = jnp.diag(jnp.array([2.0, 1.0, 1.5]))
Y_IN_PLANE = jnp.zeros(3), jnp.zeros(3)


def in_a_plane(path, stiffness, slow=False):
    kinetic = lambda t, p, q, args: jnp.sum(p**2 / INERTIA) / 2
    potential = lambda t, q, args: q @ stiffness @ q / 2
    whole = lambda t, p, q, args: kinetic(t, p, q, args) + potential(t, q, args)
    plane = lambda q, args: jnp.stack([NORMAL @ q])
    at = as_friction(TENSOR), TEMPERATURE, path
    if slow:
        return ds.langevin_terms(kinetic, *at, constraint=plane, slow=potential)
    return ds.langevin_terms(whole, *at, constraint=plane)


def stationary(step, n, h):
    """The covariance that a linear `step(y, W)` keeps, of the coordinates in the plane."""
    A, B = (
        np.asarray(x) for x in jax.jit(jax.jacfwd(step, (0, 1)))(*map(jnp.zeros, n))
    )
    # It maps the allowed states to themselves, and B leads to them.
    U, S, _ = np.linalg.svd(np.concatenate([A @ A, B, A @ B], axis=1))
    Z = U[:, S > 1e-10]
    A, B = Z.T @ A @ Z, Z.T @ B
    K = np.kron(A, A)
    C = np.linalg.solve(np.eye(len(K)) - K, (h * B @ B.T).reshape(-1))
    return Z @ C.reshape(A.shape) @ Z.T


def _errors_of_gibbs(solver, h, slow=False):
    """Of the stationary moments of positions, and of those with momenta."""

    def step(y, W):
        terms = in_a_plane(Given(W), STIFF, slow)
        before = solver.init(terms, 0.0, h, Y_IN_PLANE, None)
        y0 = tuple(jnp.split(y, 2))
        y1 = solver.step(terms, 0.0, h, y0, None, before, True)[0]
        return jnp.concatenate(y1)

    _, _, V = np.linalg.svd(NORMAL[None])
    Z = V[1:].T
    exact = TEMPERATURE * Z @ np.linalg.inv(Z.T @ STIFF @ Z) @ Z.T
    found = stationary(step, (6, 3), h)
    return np.max(abs(found[3:, 3:] - exact)), np.max(abs(found[:3, 3:]))


@pytest.mark.core
def test_kicked_positions_in_a_harmonic_well_and_a_plane_have_the_law_of_gibbs():
    assert max(_errors_of_gibbs(ds.BAOAB(), 0.5)) < 1e-13


@pytest.mark.slow
def test_a_flow_in_a_plane_has_an_error_of_second_order_in_the_law_of_gibbs():
    solver = ds.BAOAB(ds.StormerVerlet())
    long, mixed = _errors_of_gibbs(solver, 0.5)
    short, _ = _errors_of_gibbs(solver, 0.25)
    assert mixed < 1e-13
    assert 3.8 < long / short < 4.2
    # Beside a slow force, which kicks, it has none.
    assert max(_errors_of_gibbs(solver, 0.5, slow=True)) < 1e-13


FIELD = 1.2


def dimer_energy(t, p, q, args):
    return jnp.sum(p**2) / 2 - FIELD * (q[0, 0] - q[1, 0])


def dimer_rod(q, args):
    return jnp.stack([jnp.sum((q[0] - q[1]) ** 2) - 1])


def dimer(path, friction=1.0):
    at = dimer_energy, friction, TEMPERATURE, path
    return ds.langevin_terms(*at, constraint=dimer_rod)


DIMER = jnp.zeros((2, 3)), jnp.array([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])


PATH = ds.WeakBrownianPath((2, 3), jr.key(0))


def zigzag():
    """Seven bonds, for more multipliers than are written out."""
    places = jnp.arange(7)
    q = jnp.stack([places % 2, places // 2], axis=1) * 1.0
    bonds = lambda q, args: jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1)
    terms = ds.langevin_terms(
        _free, 1.0, TEMPERATURE, ds.WeakBrownianPath((7, 2), jr.key(0)),
        constraint=lambda x, args: bonds(x, args) - bonds(q, args),
    )  # fmt: skip
    return terms, ds.BAOAB(), (0 * q, q)


@needs_drjit
@pytest.mark.parametrize(
    "terms, solver, y0",
    [
        (dimer(PATH), ds.BAOAB(), DIMER),
        pytest.param(*zigzag(), marks=pytest.mark.slow),
    ],
    ids=["bath", "bonds"],
)
def test_the_fused_engine_takes_the_same_steps(terms, solver, y0):
    at = terms, solver, 0, 0.4, 0.1, y0
    fused, plain = (
        ds.ensemble(*at, key=jr.key(2), num_paths=50, engine=engine)
        for engine in ("drjit", "jax")
    )
    assert fused.num_stragglers == 0
    for a, b in zip(fused.ys, plain.ys):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_langevin_dynamics_refuse_constraints_with_other_solvers():
    terms = dimer(ds.WeakBrownianPath((2, 3), jr.key(0)))
    leaves = r"not keep.*`BAOAB\(StormerVerlet\(\)\)`"
    for solver, message in (
        (ds.BAOAB(ds.ImplicitMidpoint()), leaves),
        (ds.BAOAB(lambda time, y, args: y), leaves),
        (ds.LangevinMiddle(), "`StormerVerlet.*BAOAB"),
        (ds.StormerVerlet(), "Take friction from|BAOAB"),
    ):
        with pytest.raises(ValueError, match=message):
            solver.init(terms, 0.0, 0.1, DIMER, None)
    off = DIMER[0], 1.001 * DIMER[1]
    phi = lambda t, y, args: y[1]
    with pytest.raises(ValueError, match="constrained_state"):
        ds.expectation(phi, terms, ds.BAOAB(), 0, 1, 0.1, off, key=jr.key(1))


def circle(centre, radius):
    """A pendulum whose pivot is at the centre, with the height and the length in units."""
    kinetic = lambda t, p, q, args: jnp.sum(p**2) / 2 + radius * q[1]
    on = lambda q, args: jnp.sum((q - centre) ** 2)[None] - radius**2
    return kinetic, on


@pytest.mark.parametrize(
    "dtype", slow_except([jnp.float32], [jnp.float64, jnp.float32])
)
@pytest.mark.parametrize("pivot", [(0.6, 0.8), (0.0, 1000.0)])
def test_no_step_depends_on_the_origin_or_the_unit_of_length(pivot, dtype):
    # With a bath, so that many come close to the origin at a low temperature. The radius
    # is a unit of length.
    for radius in (1.0, 1000.0, 1e-3):
        centre = radius * jnp.array(pivot, dtype)
        H0, on = circle(centre, jnp.array(radius, dtype))
        y0 = jnp.array([0.1 * radius, 0.0], dtype), centre.at[1].add(-radius)
        path = jax.ShapeDtypeStruct((2,), dtype)
        terms = ds.langevin_terms(H0, 1.0, 0.01 * radius**2, path, constraint=on)
        times = np.array([0, 2, 0.1], np.dtype(dtype))
        paths = ds.ensemble(terms, ds.BAOAB(), *times, y0, key=jr.key(0), num_paths=500)
        assert paths.num_failed == 0
        far = radius * (1 + np.hypot(*pivot))
        error = np.abs(
            np.linalg.norm(paths.ys[1] - np.asarray(centre), axis=1) - radius
        )
        assert np.max(error) <= 10 * np.finfo(dtype).eps * far


def test_steps_that_are_too_long_are_never_taken_for_solved():
    H0, on = circle(jnp.array([0.0, 1.0]), 1.0)
    terms = ds.hamiltonian_terms(H0, constraint=on)

    @jax.jit
    @jax.vmap
    def end(speed):
        y0 = jnp.stack([speed, 0 * speed]), jnp.zeros(2, speed.dtype)
        solver = ds.StormerVerlet()
        h = jnp.array(0.3, speed.dtype)
        y1, *_, result = solver.step(terms, 0 * h, h, y0, None, no_failure(), False)
        return on(y1[1], None)[0], result == diffrax.RESULTS.successful

    for dtype in (jnp.float64, jnp.float32):
        off, okay = end(jnp.geomspace(1e-3, 100.0, 20_000, dtype=dtype))
        # Some do not reach the circle.
        assert 0.5 < np.mean(okay) < 0.95
        assert np.max(np.abs(off[okay])) <= 10 * np.finfo(dtype).eps
