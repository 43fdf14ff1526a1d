"""Second moments on linear models, exactly: one step, and whole solves."""

from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from .families import slow_except
from .picard import by_picard
from .problems import kubo_terms


# The excess of E(x^2 + y^2) over s^2 h that one step adds for h = 0.2 and s = 1, as far as
# it is known in the literature or in closed form.
EXCESS = [
    (ds.ImplicitMidpoint(), -0.00198020),
    (ds.SRKs1(a=0.25), -0.00099626),
    (ds.SRKs2(), -0.00198020),
    (ds.SRKs3(), 0.0),
    (ds.SRKs4(), None),
    (ds.SRKs4(sign=1), None),
    (ds.SRKw1(b=0.5), -0.00198020),
    (ds.SRKw1(b=0.0), 0.0),
    (ds.SRKw2(), None),
    (ds.StrangGauss(), None),
    (ds.SRKw3("a"), -0.00198020),
    (ds.SRKw3("b"), 0.0),
    (ds.SRKw4(a21=0.0), 0.0),
    (ds.SRKw5(), 0.0),
]
Y0 = (jnp.array(0.7), jnp.array(-0.4))
PATH = ds.WeakBrownianPath((), jr.key(0))


def _push(t, p, q, args):
    return -q


def _linear_step(tableau, h):
    """The step `y1 = R y + sum_v r_v xi_v` on the linear oscillator dp = -q dt + dw,
    dq = p dt, by one dense linear solve with the tableau's full matrix."""
    flat = tableau.flatten()
    s = len(flat.stages)
    parts = {"y": (1, 1), "p": (1, 0), "q": (0, 1), "": (0, 0)}
    reads, writes = (
        [np.diag(parts[getattr(x, name)]) for x in flat.stages]
        for name in ("reads", "writes")
    )
    field = np.array([[0.0, -1.0], [1.0, 0.0]])
    drift = [
        h * w @ field @ r if x.channels == ("h",) else np.zeros((2, 2))
        for x, r, w in zip(flat.stages, reads, writes)
    ]
    # k_i = drift_i (y + sum_j M_ij k_j) + noise_i
    rows = [[drift[i] * flat.matrix[i, j] for j in range(s)] for i in range(s)]
    system = np.eye(2 * s) - np.block(rows)
    end = np.kron(flat.weights, np.eye(2))
    R = np.eye(2) + end @ np.linalg.solve(system, np.concatenate(drift))
    r = {}
    for name in {x.channels[0] for x in flat.stages} - {"h"}:
        kicks = [(x.channels[0] == name) * np.array([1.0, 0.0]) for x in flat.stages]
        r[name] = end @ np.linalg.solve(system, np.concatenate(kicks))
    return R, r


def moment_map(terms, solver, h):
    return np.asarray(
        jax.jit(lambda: ds.second_moment_map(terms, solver, 0.0, h, Y0))()
    )


def oscillator(path):
    return ds.hamiltonian_terms(lambda t, p, q, args: (p**2 + q**2) / 2, _push, path)


def _by_tableau(solver, h):
    """The noise-free part `R` of a step, and what noise adds to E(p^2 + q^2), over `h`."""
    R, r = _linear_step(solver.tableau, h)
    variance = {"W": 1, "second": 1, "H": 1 / 12}
    # Other variables of the paper's tableaus cancel.
    return R, sum(x @ x * variance.get(name, np.inf) for name, x in r.items() if any(x))


@pytest.mark.parametrize("solver, excess", EXCESS, ids=repr)
def test_moments_grow_by_the_exact_excess_of_each_of_25_000_steps(solver, excess):
    h, steps = 0.2, 25_000
    R, total = _by_tableau(solver, h)
    # So each step adds `h * total`.
    np.testing.assert_allclose(R.T @ R, np.eye(2), atol=1e-14)
    if excess is not None:
        assert abs(h * (total - 1) - excess) <= (1e-12 if excess == 0 else 5e-9)
    error = (1 + h * total * steps) / (1 + h * steps) - 1
    if solver == ds.SRKs4(sign=1):
        # The paper's choice of sign is the one that misses.
        assert abs(error + 0.0136) < 1e-4
    else:
        assert abs(error) < 0.01


# One for each random variable, and one without noise stages of their own.
SOLVED = ds.SRKw1(), ds.SRKw2(), ds.SRKs4(), ds.SRKw5()


@pytest.mark.parametrize("solver", slow_except(SOLVED[:1], SOLVED), ids=repr)
def test_moments_of_a_whole_solve_are_those_of_the_tableau(solver):
    h, steps = 0.2, 25_000
    _, total = _by_tableau(solver, h)
    K = moment_map(oscillator(solver.path((), jr.key(0))), by_picard(solver), h)
    z0 = np.array([1.0, *map(float, Y0)])
    for n, rtol in ((1, 1e-12), (steps, 1e-9)):
        moments = np.linalg.matrix_power(K, n) @ np.kron(z0, z0)
        exact = Y0[0] ** 2 + Y0[1] ** 2 + n * h * total
        np.testing.assert_allclose(moments[4] + moments[8], exact, rtol=rtol)


def test_explicit_methods_explode():
    h = 0.2
    terms = oscillator(diffrax.UnsafeBrownianPath((), jr.key(0)))
    # The mean square of a rotation with this determinant.
    for solver, square in (
        (diffrax.Euler(), 1 + h**2),
        (diffrax.Heun(), 1 + h**4 / 4),
    ):
        growth = np.max(np.abs(np.linalg.eigvals(moment_map(terms, solver, h))))
        np.testing.assert_allclose(growth, square, rtol=1e-12)
        # Over 25,000 steps.
        assert 25_000 * np.log(growth) > np.log(2e4)


def test_moments_of_a_multiplicative_noise_agree_with_the_closed_form():
    # A midpoint step of the Kubo oscillator turns the plane by 2 atan((h + s I) / 2).
    h, s = 0.1, 0.7
    terms = kubo_terms(PATH, s)
    K = moment_map(terms, by_picard(ds.ImplicitMidpoint()), h)
    increments = np.sqrt(3 * h) * np.array([-1, 0, 1])
    twice = 4 * np.arctan((h + s * increments) / 2)
    z0 = np.array([1.0, *Y0])
    moments = np.linalg.matrix_power(K, 50) @ np.kron(z0, z0)
    factor = np.sum(np.exp(1j * twice) * np.array([1, 4, 1]) / 6) ** 50
    # p + iq turns, |p + iq|^2 stays.
    square = factor * complex(*Y0) ** 2
    np.testing.assert_allclose(moments[4] - moments[8], square.real, atol=1e-14)
    np.testing.assert_allclose(2 * moments[5], square.imag, atol=1e-14)
    np.testing.assert_allclose(moments[4] + moments[8], abs(complex(*Y0)) ** 2)


def test_quadrature_over_gaussian_increments_is_exact_for_polynomials():
    # Heun on the Kubo oscillator is a polynomial in the increment, of degree 2.
    h = 0.1
    terms = kubo_terms(diffrax.UnsafeBrownianPath((), jr.key(0)))
    given = terms, diffrax.Heun(), 0.0, h, Y0
    square = lambda t, y, args: y[0] ** 2 + y[1] ** 2
    squared = lambda nodes: ds.step_expectation(*given, fn=square, nodes=nodes)
    # |1 + i x - x^2 / 2|^2 = 1 + x^4 / 4 with x = h + I.
    fourth = h**4 + 6 * h**2 * h + 3 * h**2
    exact = (Y0[0] ** 2 + Y0[1] ** 2) * (1 + fourth / 4)
    three, two = jax.jit(lambda: (squared(3), squared(2)))()
    np.testing.assert_allclose(three, exact, rtol=1e-14)
    assert abs(two - exact) > 1e-4


class _Twice(diffrax.AbstractPath):
    t0, t1 = 0.0, jnp.inf

    def evaluate(self, t0, t1=None, left=True):
        return 2 * t0 if t1 is None else 2 * (t1 - t0)


def test_the_local_error_counts_the_control_of_the_drift():
    # Heun's method for dy = y d(2 t), without noise: (1 + 2 h + 2 h^2) y.
    still = diffrax.ControlTerm(lambda t, y, args: 0 * y, PATH)
    drift = diffrax.ControlTerm(lambda t, y, args: y, _Twice())
    terms, one = diffrax.MultiTerm(drift, still), jnp.ones(())
    step = terms, diffrax.Heun(), 0.0, 0.125, one
    fn = lambda t, y, args: y
    defect = jax.jit(lambda: ds.weak_order_defect(*step, fn=fn, order=1))()
    np.testing.assert_allclose(defect, 2 * 0.125**2, rtol=1e-14)


def test_a_failed_step_has_no_expectation_and_says_why():
    H0 = lambda t, p, q, args: p**2 / 2 + args * q
    given = ds.hamiltonian_terms(H0, _push, PATH), ds.StormerVerlet(), 0.0, 0.1, Y0
    mean = jax.jit(lambda x: ds.step_expectation(*given, x, fn=lambda t, y, args: y[0]))
    with pytest.raises(RuntimeError, match="Nonfinite"):
        mean(jnp.nan)


class _NoiseInTwoPlaces(diffrax.EulerHeun):
    """Only noise, as the sum of two parts of it."""

    parts: Callable
    minimal_levy_area = diffrax.AbstractSpaceTimeLevyArea

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = self.parts(terms.terms[1], t0, t1)
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful


def test_noise_in_two_places_of_a_step_comes_from_one_draw():
    # As `AbstractSymplecticSolver` says.
    def drawn_twice(noise, t0, t1):
        middle = t0 + (t1 - t0) / 2
        return noise.contr(t0, middle), noise.contr(middle, t1)

    def drawn_once(noise, t0, t1):
        drawn = noise.contr(t0, t1, use_levy=True)
        difference = jnp.sqrt(3) * drawn.H
        return drawn.W / 2 + difference, drawn.W / 2 - difference

    h, area = 0.25, diffrax.SpaceTimeLevyArea
    path = ds.FixedStepBrownianPath((), jr.key(0), levy_area=area)
    terms = ds.hamiltonian_terms(lambda t, p, q, args: p**2 / 2, _push, path)

    def squares(parts):
        products = lambda t, y, args: jnp.stack([y[0] ** 2, y[0] * y[1], y[1] ** 2])
        solver = _NoiseInTwoPlaces(parts)
        return ds.step_expectation(terms, solver, 0.0, h, Y0, fn=products)

    once, twice = jax.jit(lambda: (squares(drawn_once), squares(drawn_twice)))()
    np.testing.assert_allclose(once, [h / 2, 0, h / 2], atol=1e-14)
    # The same increment, that of the whole step, in both places.
    np.testing.assert_allclose(twice, [h, h, h], atol=1e-14)
