"""Positions, momenta and transport of Langevin dynamics at a temperature."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..families import slow_except
from ..problems import as_friction, damped_terms, Given, local_weak_orders, weak_path
from .test_every_solver import OBABO
from .test_splitting import ABOBA, UNEQUAL


T = 0.5
# Friction and masses: numbers, arrays and matrices.
TENSOR = jnp.array([[1.0, 0.3, 0.0], [0.3, 0.5, -0.2], [0.0, -0.2, 0.7]])
EACH = jnp.array([0.4, 1.0, 2.0])
MASSES = jnp.array([1.0, 4.0, 0.5])
MASS_MATRIX = jnp.diag(MASSES) + 0.3
GIVEN = {"number": 0.7, "each": EACH, "matrix": as_friction(TENSOR)}
FRICTIONS = {"number": 0.7, "each": EACH, "matrix": TENSOR}
KINETIC = {
    "number": lambda p: jnp.sum(p**2) / 2,
    "each": lambda p: p @ (p / MASSES) / 2,
    "matrix": lambda p: p @ jnp.linalg.solve(MASS_MATRIX, p) / 2,
}


def moment_map(terms, solver, h, y0):
    """The map of second moments of (1, p, q) by one step, exactly."""
    of = lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0)
    return np.asarray(jax.jit(of)(h))


def stationary_moments(terms, solver, h, y0):
    """Second moments of (p, q), exactly."""
    K = moment_map(terms, solver, h, y0)
    n = round(len(K) ** 0.5)
    A = np.eye(n * n - 1) - K[1:, 1:]
    moments = np.append(1.0, np.linalg.solve(A, K[1:, 0]))
    return moments.reshape(n, n)[1:, 1:]


ALL = {
    "BAOAB": ds.BAOAB(),
    "middle": ds.LangevinMiddle(),
    "OBABO": OBABO,
    "ABOBA": ABOBA,
    "unequal": UNEQUAL,
}
MATRICES, NUMBERS = ("matrix", "matrix"), ("number", "number")
BOTH = [(friction, masses) for friction in FRICTIONS for masses in KINETIC]


# The solvers with the kinds of friction and masses. Two noises for each momentum have many
# outcomes, which are few for one momentum.
CASES = [
    *((name, MATRICES) for name in ("BAOAB", "middle", "ABOBA")),
    *((name, NUMBERS) for name in ("OBABO", "unequal")),
    *(("BAOAB", kinds) for kinds in BOTH[:-1]),
]


def system_of(name, kinds):
    """The solver, its shares of the bath, the path, friction, and masses as a matrix."""
    solver, (friction, masses) = ALL[name], kinds
    shares = [bath.share for bath in solver.pieces if isinstance(bath, ds.Bath)]
    n = 3 if len(shares) == 1 else 1
    M = {"number": np.eye(n), "each": np.diag(MASSES), "matrix": MASS_MATRIX}[masses]
    G = FRICTIONS[friction]
    G = np.asarray(G) if np.ndim(G) == 2 else np.diag(G * np.ones(n))
    return solver, shares, solver.path((n,), jr.key(0)), G, np.asarray(M)


@pytest.mark.parametrize(
    "case",
    # Of baths of different strength the law is not known.
    slow_except([*CASES[:2], CASES[3]], [x for x in CASES if x[0] != "unequal"]),
    ids=str,
)
def test_springs_of_any_friction_and_masses_have_the_law_of_the_splitting(case):
    name, kinds = case
    solver, _, path, G, M = system_of(name, kinds)
    h, n = 0.4, len(M)
    S = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.0], [0.1, 0.0, 1.5]])[:n, :n]
    H0 = lambda t, p, q, args: KINETIC[kinds[1]](p) + q @ S @ q / 2
    terms = ds.langevin_terms(H0, GIVEN[kinds[0]], T, path)
    moments = stationary_moments(terms, solver, h, (jnp.zeros(n),) * 2)
    # With one bath in the middle of free flight positions have the law of Gibbs.
    inverse, gibbs = np.linalg.inv(M), np.linalg.inv(S)
    pp, qq = {
        "BAOAB": (M - h**2 / 4 * S, gibbs),
        "middle": (M, gibbs),
        "OBABO": (M, np.linalg.inv(S - h**2 / 4 * S @ inverse @ S)),
        "ABOBA": (np.linalg.inv(inverse - h**2 / 4 * inverse @ S @ inverse), gibbs),
    }[name]
    # Momenta of `LangevinMiddle` are late by half a step.
    pq = (name == "middle") * h / 2 * np.eye(n)
    np.testing.assert_allclose(moments, T * np.block([[pp, pq], [pq, qq]]), atol=1e-13)


@pytest.mark.parametrize("case", slow_except([CASES[0], CASES[4]], CASES), ids=str)
def test_free_particles_drift_and_diffuse_as_einstein_says_for_any_step(case):
    name, kinds = case
    solver, shares, path, G, M = system_of(name, kinds)
    n = len(M)
    force, size = np.array([3e-3, -2e-3, 1e-3])[:n], 2 * n + 1
    H0 = lambda t, p, q, args: KINETIC[kinds[1]](p) - q @ force
    terms = ds.langevin_terms(H0, GIVEN[kinds[0]], T, path)
    inverse = np.linalg.inv(M)
    rates = np.sort(np.linalg.eigvals(inverse @ G).real)
    for rate_h in (0.2, 1.0, 4.0):
        h = rate_h / rates[-1]
        K = moment_map(terms, solver, h, (jnp.zeros(n),) * 2)
        # After a time in which each mode forgets its start.
        before = np.linalg.matrix_power(K, round(40 / min(rates[0] * h, 1)))
        moments = [x[:, 0].reshape(size, size) for x in (before, K @ before)]
        # With one bath these are exact, and two baths make both too fast.
        mobility = np.linalg.inv(G)
        if len(shares) == 2:
            mobility += np.prod(shares) * h**2 / 4 * inverse @ G @ inverse
        velocity = np.diff([x[0, n + 1 :] for x in moments], axis=0)[0] / h
        np.testing.assert_allclose(velocity, mobility @ force, rtol=1e-10)
        covariances = [(x - np.outer(x[0], x[0]))[n + 1 :, n + 1 :] for x in moments]
        diffusion = np.diff(covariances, axis=0)[0] / (2 * h)
        np.testing.assert_allclose(diffusion, T * mobility, rtol=1e-10, atol=1e-11)


GAMMA, U = jnp.array([0.7, 0.2]), jnp.array([0.5, 2.0])


def _diffrax_terms(path, gamma=GAMMA):
    grad_f = lambda x, args: x**3 + args * jnp.sin(x)
    return diffrax.MultiTerm(
        diffrax.UnderdampedLangevinDriftTerm(gamma, U, grad_f),
        diffrax.UnderdampedLangevinDiffusionTerm(gamma, U, path),
    )


def test_terms_of_diffrax_are_taken_as_they_are():
    solver = ds.BAOAB()
    path = solver.path((2,), jr.key(0), want="weak")
    x, v = jr.normal(jr.key(1), (2, 2))
    # More terms have the same state.
    push = diffrax.ODETerm(lambda t, y, args: (jnp.zeros(2), U * jnp.cos(t)))
    both = diffrax.MultiTerm(*_diffrax_terms(path).terms, push)
    energy = lambda t, p, q, args: (
        jnp.sum(U * p**2 / 2 + q**4 / 4 - args * jnp.cos(q)) - jnp.cos(t) * jnp.sum(q)
    )
    ours = ds.langevin_terms(energy, GAMMA / U, 1.0, path)

    @jax.jit
    def solve_both(t1):
        solve = lambda terms, y0: (
            diffrax.diffeqsolve(terms, solver, 0.0, t1, t1 / 8, y0, 0.3, max_steps=8).ys
        )
        return solve(both, (x, v)), solve(ours, (v / U, x))

    for t1 in (1.0, -1.0):
        theirs, expected = solve_both(t1)
        np.testing.assert_allclose(theirs[0], expected[1], atol=1e-14)
        np.testing.assert_allclose(theirs[1], U * expected[0], atol=1e-14)

    # A rate that is traced and negative fails its path alone.
    @jax.jit
    @jax.vmap
    def successful(gamma):
        at = _diffrax_terms(path, gamma), 0.0, 0.25, (x, v), 0.3
        *_, result = solver.step(*at, solver.init(*at), False)
        return result == diffrax.RESULTS.successful

    np.testing.assert_array_equal(successful(jnp.array([0.5, -0.5])), [True, False])
    found = ds.suggest_solver(_diffrax_terms(path), 0.0, (x, v), 0.3, want="weak")
    assert isinstance(found[0].solver, ds.BAOAB)


def _two_pendula(t, p, q, args):
    """With coupling, and masses 1 and 2."""
    forces = jnp.cos(q[0] - 2 * q[-1] + t) - jnp.sum(jnp.sin(q))
    return jnp.sum(p**2 / jnp.arange(1, len(p) + 1)) / 2 + forces


MATRIX = jnp.array([[1.0, 0.4], [0.4, 0.7]])


def test_local_weak_order_is_two_where_friction_depends_on_positions_and_time():
    # The friction does not commute with the covariance of the noise.
    friction = lambda t, q, args: as_friction(MATRIX * jnp.cos(t + q[0] - q[1]))
    noise = lambda t, p, q, args: jnp.stack([q[0], jnp.sin(q[1] + q[0] * t)])
    terms = damped_terms(_two_pendula, friction, noise, weak_path(2))
    y0 = jnp.array([0.3, -0.4]), jnp.array([0.5, 0.1])
    hs = jnp.array([0.004, 0.002, 0.001])
    batch = jax.tree.map(lambda x: x[None], y0)
    slopes = local_weak_orders(terms, ds.BAOAB(), batch, None, hs, order=2)
    np.testing.assert_allclose(slopes, 3.0, atol=0.1)


def test_after_a_jump_forces_are_new_and_within_a_step_solutions_are_interpolated():
    terms = ds.langevin_terms(_two_pendula, 0.5, 0.8, Given(jnp.array([0.3, 0.1])))
    solver, y0 = ds.BAOAB(), (jnp.ones(2), jnp.zeros(2))

    @jax.jit
    def steps(y0):
        step = lambda state, jump: solver.step(terms, 0.0, 0.1, y0, None, state, jump)
        init = lambda q: solver.init(terms, 0.0, 0.1, (y0[0], q), None)
        fresh, _, dense, *_ = step(init(y0[1]), False)
        other = init(y0[1] + 1)
        return fresh, dense, step(other, True)[0], step(other, False)[0]

    fresh, dense, new, old = steps(y0)
    np.testing.assert_array_equal(new, fresh)
    assert np.max(np.abs(np.subtract(old, fresh))) > 1e-3
    np.testing.assert_array_equal(dense["y0"], y0)
    np.testing.assert_array_equal(dense["y1"], fresh)


def test_what_baoab_cannot_solve_is_refused():
    y0, path = (jnp.ones(2), jnp.ones(2)), weak_path(2)
    force = lambda t, p, q, args: -q
    mixed = lambda t, p, q, args: jnp.sum(p * q)
    mass = lambda t, p, q, args: p @ jnp.linalg.solve(jnp.diag(1 + q**2), p) / 2
    fast = lambda t, p, q, args: jnp.sum(jnp.sqrt(1 + p**2))
    of_momenta = lambda t, p, q, args: jnp.sin(p)
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))
    control = diffrax.LinearInterpolation(jnp.array([0.0, 1.0]), jnp.array([0.0, 2.0]))

    def turn(t, y, args):
        return lx.FunctionLinearOperator(lambda w: (-y[1] * w, y[0] * w), number)

    bath = ds.bath_terms(_two_pendula, 0.5, 1.0, path).terms
    driven = diffrax.MultiTerm(diffrax.ControlTerm(turn, control), *bath)
    # A state (x, v), of which the first half is no momentum.
    swapped = diffrax.ODETerm(lambda t, y, args: (y[1], -y[0]))
    damped = lambda H0, noise=force: damped_terms(H0, 1.0, noise, path)
    integers = jax.tree.map(lambda x: x.astype(int), y0)
    complex_numbers = jax.tree.map(lambda x: 1j * x, y0)
    other = r"needs H0 = V.*`BAOAB\(ImplicitMidpoint\(\)\)`"
    none = "these have none.*`langevin_terms"
    for terms, match, start in (
        (damped(mixed), other, y0),
        (damped(mass), other, y0),
        (damped(_two_pendula, of_momenta), "needs H0 = V", y0),
        (damped(fast), "linear in p.*`ImplicitMidpoint` or `StrangGauss`", y0),
        (damped(_two_pendula), "needs a state `y0` of real", integers),
        (damped(_two_pendula), "needs a state `y0` of real", complex_numbers),
        (driven, "needs a drift driven by time", y0),
        (ds.hamiltonian_terms(_two_pendula, force, path), none, y0),
        (swapped, none, y0),
    ):
        with pytest.raises(ValueError, match=f"`BAOAB` .*{match}"):
            ds.BAOAB().init(terms, 0.0, 0.1, start, None)
    spins = ds.spin_terms(lambda t, s, args: s[2])
    terms = diffrax.MultiTerm(*spins.terms, *ds.bath_terms(_two_pendula, 0.3).terms)
    y0 = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    with pytest.raises(ValueError, match="friction to a canonical.*Pass `damping=`"):
        ds.BAOAB(ds.ImplicitMidpoint()).init(terms, 0.0, 0.1, y0, None)
