"""Steps that fixed-point iteration does not solve, of few and of many unknowns, and what
their failures leave alone."""

import re
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._batch import where_pending

from ..picard import by_picard
from ..problems import Given


def _one_step(solver, term, h, y0):
    y1, *_, result = solver.step(term, 0.0, h, y0, None, None, False)
    return y1, result == diffrax.RESULTS.successful


def test_steps_of_stiff_networks_are_solved():
    # Newton's method alone fails in 26 of these, and shortened corrections
    # stall in more. The step that fails has no solution on the branch from its start.
    d = 2

    def residual(key):
        a, b, c = jr.split(key, 3)
        W1, W2 = jr.normal(a, (4, d)), 2 * jr.normal(b, (d, 4))
        y0 = jr.normal(c, (d,))
        term = diffrax.ODETerm(lambda t, y, args: W2 @ jnp.tanh(W1 @ y))
        y1, success = _one_step(ds.ImplicitMidpoint(), term, 1.0, y0)
        return success, y1 - y0 - W2 @ jnp.tanh(W1 @ (y0 + y1) / 2)

    success, error = jax.jit(jax.vmap(residual))(jr.split(jr.key(0), 400))
    assert jnp.sum(~success) <= 1
    assert jnp.max(jnp.abs(error[success])) <= d**2 * 5e-15


def test_iterations_of_newton_end_when_they_should():
    rate = 1000 * jnp.arange(1.0, 4.0)
    y0 = jnp.full(3, 0.6), jnp.full(3, 0.8)

    @eqx.filter_jit
    def success(factor, most):
        finder = ds.PicardNewton(newton_steps=most)
        solver = ds.ImplicitMidpoint(root_finder=finder)
        term = diffrax.ODETerm(
            lambda t, y, args: (-factor * rate * y[1], factor * rate * y[0])
        )
        return _one_step(solver, term, 1.0, y0)[1]

    # The first correction solves a linear system, up to what GMRES leaves.
    assert not success(1.0, 1)
    # However many there may be, they end with the solution, and where there is none.
    assert success(jnp.array(1.0), 10**9)
    assert not success(jnp.array(jnp.nan), 10**9)


def test_many_unknowns_are_solved_without_a_matrix():
    # A Schroedinger lattice: frequencies up to n^2, of which h resolves few.
    n, h = 100, 2e-3
    pad = lambda u: jnp.pad(u, 1)
    laplacian = lambda u: (2 * u - pad(u)[2:] - pad(u)[:-2]) * n**2 / 10
    term = diffrax.ODETerm(lambda t, y, args: (-laplacian(y[1]), laplacian(y[0])))
    x = np.arange(1, n + 1) / (n + 1) * np.pi
    y0 = np.sin(x), np.sin(2 * x) + 0.1 * np.sin(50 * x)
    step = jax.jit(lambda y0: _one_step(ds.ImplicitMidpoint(), term, h, y0))
    step = step.lower(y0).compile()
    # Sixty vectors of all unknowns; one dense matrix has 200.
    memory: Any = step.memory_analysis()
    assert memory.temp_size_in_bytes <= 55 * 2 * n * 8
    (p, q), success = step(y0)
    assert success
    # In the complex plane a dense matrix solves it.
    turn = 0.5j * h * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) * n**2 / 10
    rhs = (np.eye(n) + turn) @ (y0[0] + 1j * y0[1])
    exact = np.linalg.solve(np.eye(n) - turn, rhs)
    np.testing.assert_allclose(p + 1j * np.asarray(q), exact, atol=1e-13)
    np.testing.assert_allclose(np.sum(p**2 + q**2), np.sum(np.square(y0)), rtol=1e-13)


def test_the_derivative_of_a_failed_step_is_zero():
    fields = [
        # k = 1 + (y0 + k / 2)^2 has no solution for positive y0.
        lambda y: 1 + y**2,
        # Of these there is one, but the end of the step overflows.
        lambda y: 0 * y + 1e308,
        # And this one has no derivative at the solution.
        lambda y: 1.2e308 + jnp.sqrt(jnp.maximum(1e308 - y, 0)),
    ]

    def step(y0, number):
        term = diffrax.ODETerm(lambda t, y, args: jax.lax.switch(number, fields, y))
        y1, success = _one_step(ds.ImplicitMidpoint(), term, 1.0, y0)
        return y1, (y1, success)

    # In both modes.
    modes = [mode(step, has_aux=True) for mode in (jax.jacfwd, jax.jacrev)]
    slopes = jax.jit(lambda y0, number: [slope(y0, number) for slope in modes])
    for number, y0 in enumerate((0.5, 1.2e308, 0.8e308)):
        for derivative, (y1, success) in slopes(y0, number):
            assert jnp.isfinite(y1) == (number == 0)
            assert not success and derivative == 0


def test_a_failure_anywhere_in_a_step_is_reported():
    # Two systems one after another; what the other one's success says must not count.
    # One block of `StrangGauss` has more unknowns than the others.
    def success(sizes):
        stuck = lambda t, p, q, args: sizes[0] * jnp.sum(p * q**2)
        kicks = lambda t, p, q, args: sizes[1] * jnp.sum(p * q**2)
        terms = ds.hamiltonian_terms(stuck, kicks, Given(W=jnp.array(1.0)))
        y0 = (jnp.full(2, 0.1), jnp.full(2, 10.0))
        solver = ds.StrangGauss(root_finder=ds.PicardNewton(newton_steps=0))
        return _one_step(solver, terms, 1.0, y0)[1]

    of_each = jax.jit(jax.vmap(success))(jnp.eye(3, 2))
    np.testing.assert_array_equal(of_each, [False, False, True])


def test_a_failure_is_reported_for_any_root_finder():
    # There is no solution.
    term = diffrax.ODETerm(lambda t, y, args: 1 + y**2)
    solver = ds.ImplicitMidpoint(root_finder=optx.Newton(rtol=1e-9, atol=1e-9))
    y1, success = _one_step(solver, term, 1.0, jnp.array(0.5))
    assert jnp.isfinite(y1) and not success
    # The best iterate is no solution: of `PicardNewton` it would be the first guess.
    finder = optx.BestSoFarRootFinder(ds.PicardNewton())
    with pytest.raises(ValueError, match="Pass the root finder that it wraps"):
        _one_step(ds.ImplicitMidpoint(root_finder=finder), term, 0.1, jnp.array(0.5))


def test_an_overflow_in_any_part_of_the_state_is_reported():
    grow = diffrax.ODETerm(lambda t, y, args: jax.tree.map(lambda x: 0 * x + 1e308, y))
    y0 = jnp.array([1.2e308, 0.0, 0.0]), jnp.array([0.0, 1.2e308, 0.0])
    solver = by_picard(ds.ImplicitMidpoint())
    success = jax.jit(jax.vmap(lambda y0: _one_step(solver, grow, 1.0, y0)[1]))(y0)
    assert success.tolist() == [False, False, True]


def test_increments_are_solved_to_the_accuracy_of_the_state():
    # Rounding errors of a state of 1e8 make the force uncertain by 1e-5 of its size. Zero
    # iterations of Newton's method: the cheap iterations have to find that out.
    term = diffrax.ODETerm(lambda t, y, args: jnp.sin(1e3 * y))
    y0 = 1e8 + jnp.arange(6.0)
    solver = ds.ImplicitMidpoint(root_finder=ds.PicardNewton(newton_steps=0))
    y1, success = jax.jit(lambda y0: _one_step(solver, term, 1e-4, y0))(y0)
    assert success


@pytest.mark.parametrize("kind", [ds.ImplicitMidpoint, ds.NinomiyaVictoir])
def test_a_path_that_has_failed_stays_failed(kind):
    # In a batch Diffrax goes on to step a path that has ended. Of y' = 1 + y^2 a step of
    # length 3 has no solution, and one of length 0.01 has.
    solver = kind(root_finder=ds.PicardNewton(newton_steps=0))
    term = diffrax.ODETerm(lambda t, y, args: 1 + y**2)

    @jax.jit
    @jax.vmap
    def step(h, state):
        *_, state, result = solver.step(term, 0.0, h, jnp.zeros(2), None, state, False)
        return state, result == diffrax.RESULTS.successful

    begin = solver.init(term, 0.0, 1.0, jnp.zeros(2), None)
    begin = jax.tree.map(lambda x: jnp.stack([x, x]), begin)
    state, success = step(jnp.array([3.0, 0.01]), begin)
    assert success.tolist() == [False, True]
    again, success = step(jnp.array([0.01, 0.01]), state)
    assert success.tolist() == [False, True]
    assert jnp.all(again == state)


def test_nothing_is_solved_for_a_path_that_has_failed():
    residual = lambda y, args: y - 3 * (1 + y**2)

    @jax.jit
    @jax.vmap
    def steps(guess):
        sol = optx.root_find(residual, ds.PicardNewton(), guess, throw=False)
        return sol.stats["num_steps"]

    assert steps(jnp.array([jnp.nan, 0.0])).tolist() == [0, 1]


def test_pending_paths_alone_of_nested_batches_are_served_as_one():
    served = []

    def combine(args, x):
        jax.debug.callback(lambda: served.append(1))
        of_all, of_row, of_column, of_each = args
        return of_all * x + of_row + 10 * of_column + 100 * of_each

    @jax.jit
    def nested(pending, args, x):
        def serve(pending, args, x):
            return where_pending(lambda x: combine(args, x), pending, x)

        rows = jax.vmap(serve, (0, (None, None, 0, 0), 0))
        return jax.vmap(rows, (0, (None, 0, None, 0), 0))(pending, args, x)

    pending = jr.bernoulli(jr.key(0), 0.3, (3, 35))
    x = jnp.arange(105.0).reshape(3, 35)
    of_row, of_column = jnp.arange(3.0), jnp.arange(35.0)
    got = nested(pending, (jnp.array(2.0), of_row, of_column, x), x)
    everywhere = 2 * x + of_row[:, None] + 10 * of_column + 100 * x
    np.testing.assert_array_equal(got, jnp.where(pending, everywhere, x))
    jax.effects_barrier()
    assert len(served) == jnp.sum(pending)
    # All or none of them, when it is the same for all.
    serve = lambda pending, x: where_pending(lambda x: 2 * x, pending, x)
    together = jax.jit(jax.vmap(serve, (None, 0)))
    for every in (True, False):
        got = together(jnp.array(every), x[0])
        np.testing.assert_array_equal(got, (1 + every) * x[0])


def test_linear_solvers_of_the_user_solve_for_steps_and_their_derivatives():
    # With one there are no chords, and so no inverse of the Jacobian that nobody asked for.
    term = diffrax.ODETerm(lambda t, y, args: -30 * y + jnp.sin(y[::-1]))

    def factorizations(linear_solver):
        """How often the programs of a step and of its derivative factorize a matrix."""
        finder = ds.PicardNewton(linear_solver=linear_solver)
        solver = ds.ImplicitMidpoint(root_finder=finder)
        step = lambda y: _one_step(solver, term, 0.1, y)[0]
        programs = [jax.make_jaxpr(fn)(jnp.ones(2)) for fn in (step, jax.jacrev(step))]
        return [len(re.findall(r"= lu\b", str(program))) for program in programs]

    assert factorizations(None) == [0, 0]
    step, derivative = factorizations(lx.LU())
    assert 0 < step < derivative
