"""The solver of stage equations, on its own."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._batch import largest_in_batch
from diffrax_symplectic._fused.sweeps import solve_one_path
from diffrax_symplectic._root_finder.tolerance import converged, max_norm


def _found(residual, start, finder=None, **options):
    """The root, and whether it counts as one."""
    return _solver(residual, finder, **options)(start)


def _solver(residual, finder=None, batch=lambda fn: fn, **options):
    """A compiled function from a start to its root, and whether it counts as one. With
    `batch`, from many."""
    finder = ds.PicardNewton() if finder is None else finder

    def solve(start):
        sol = optx.root_find(residual, finder, start, throw=False, **options)
        return sol.value, sol.result == optx.RESULTS.successful

    return jax.jit(batch(solve))


# Sweeps alone.
SWEEPS = ds.PicardNewton(newton_steps=0)


@pytest.mark.core
def test_overshooting_corrections_are_shortened():
    # Newton's method alone diverges on arctan from beyond 1.39.
    finder = ds.PicardNewton(atol=1e-12)
    solve = _solver(lambda x, _: jnp.arctan(x), finder, jax.vmap, max_steps=50)
    value, success = solve(jnp.array([1.0, 3.0, 30.0]))
    assert np.all(success) and np.max(np.abs(value)) <= 1e-12


def test_part_of_a_step_is_not_taken_for_all_of_it():
    # From the flat part Newton's method goes back and forth. Where it is solved for only a
    # part of the step, that part is linear, and its corrections vanish at once.
    def residual(x, _):
        x = x - 1
        return jnp.where(jnp.abs(x) < 1, 10 * x, jnp.sign(x) * (9.9 + 0.1 * jnp.abs(x)))

    starts = np.array([2.5, 4.0, -3.0, 9.0, 30.0])
    value, success = _solver(residual, batch=jax.vmap)(starts)
    assert np.all(success)
    np.testing.assert_allclose(value, 1, rtol=1e-14)


@pytest.mark.core
def test_leaves_that_vanish_do_not_keep_it_from_finishing():
    # One leaf has its root at exactly 0, where no relative tolerance can be met.
    def residual(x, _):
        a, b = x
        return a - 1 + 1e-3 * jnp.sin(b), b - 1e-3 * (a - 1) ** 2 * b

    value, success = _found(residual, (jnp.array(0.5), jnp.array(0.1)), max_steps=20)
    assert success
    np.testing.assert_allclose(value, (1, 0), atol=1e-13)


def test_a_leaf_that_rounding_errors_keep_moving_does_not_keep_it_from_finishing():
    # The second leaf is small, and moves by 1e-15 in each evaluation, as if it were a
    # difference of numbers like the first: far more than its own tolerance.
    def residual(x, _):
        a, b = x
        moving = 1e-15 * jnp.sin(1e17 * b)
        return a - 1 - 0.01 * jnp.sin(a), b - 1e-8 - jax.lax.stop_gradient(moving)

    value, success = _found(residual, (jnp.array(0.5), jnp.array(0.0)), SWEEPS)
    assert success
    np.testing.assert_allclose(value[1], 1e-8, atol=1e-14)


def test_a_solution_of_zero_is_found_from_zero():
    # No correction at all, next to an iterate without size.
    value, success = _found(lambda x, _: 2 * x, jnp.zeros(6), max_steps=3)
    assert success
    np.testing.assert_array_equal(value, np.zeros(6))


@pytest.mark.core
def test_leaving_the_domain_on_the_way_is_no_failure():
    # From 3 the first fixed-point iteration leads to where the logarithm has no value.
    finder, start = ds.PicardNewton(atol=1e-13), jnp.array(3.0)
    value, success = _found(lambda x, _: 10 * jnp.log(x), start, finder, max_steps=50)
    assert success
    np.testing.assert_allclose(value, 1, atol=1e-13)


# Where sweeps have to do it alone, and where they diverge.
@pytest.mark.parametrize("slope, most", [(0.1, 0), (30.0, 20)])
def test_corrections_are_measured_by_the_scale_that_is_passed(slope, most):
    # Errors of 1e-6 in each evaluation, as if from a state of size 1e10 to which the
    # unknowns are added. No tolerance relative to the unknowns themselves can be met.
    noise = lambda k: jax.lax.stop_gradient(1e-6 * jnp.sin(1e12 * k))

    residual = lambda k, _: (1 + slope) * k + noise(k) - jnp.arange(1.0, 7.0)
    given = residual, jnp.zeros(6), ds.PicardNewton(newton_steps=most)
    value, success = _found(*given, options=dict(scale=lambda k: 1e10 + jnp.abs(k)))
    assert success
    np.testing.assert_allclose(value, np.arange(1, 7) / (1 + slope), atol=1e-5)
    if most == 0:
        assert not _found(*given)[1]


def test_numbers_that_mean_nothing_are_refused():
    for name, wrong, says in (
        ("rtol", float("nan"), "of .* must be >= 0; got"),
        ("atol", -1, "of .* must be >= 0; got"),
        ("picard_steps", np.int64(-1), "must be an integer, 0 or"),
        ("newton_steps", 2.5, "must be an integer, 0 or"),
        ("root_find_max_steps", -1, "must be an? "),
        ("root_finder", ds.PicardNewton, "must be an? "),
        ("root_finder", None, "must be an? "),
    ):
        make = ds.ImplicitMidpoint if "root" in name else ds.PicardNewton
        with pytest.raises(ValueError, match=f"`{name}` {says}"):
            make(**{name: wrong})


@pytest.mark.parametrize("most", [8, 200])
def test_sweeps_end_when_the_next_correction_is_small_enough(most):
    # Of y = slope y + 1 each iterate is known. There are two in each sweep, and six sweeps
    # before the first convergence check. Each path of the batch counts by itself.
    def solve(slope, rtol):
        residual = lambda y, _: y - slope * y - 1
        finder = ds.PicardNewton(rtol=rtol, picard_steps=most, newton_steps=0)
        return _found(residual, jnp.zeros(()), finder)

    slopes = np.array([0.0, 0.05, -0.1, 0.3, -0.5, 0.3, -0.5, 0.4, 0.02])
    rtols = np.array([*[1e-3] * 5, *[1e-9] * 3, 2e-16])
    numbers = []
    for s, rtol, value, success in zip(slopes, rtols, *jax.vmap(solve)(slopes, rtols)):
        iterate = lambda n: (1 - s**n) / (1 - s)
        errors = {n: abs(value / iterate(n) - 1) for n in range(12, 60, 2)}
        n = min(errors, key=lambda n: errors[n])
        assert errors[n] <= 1e-14
        assert success == (abs(s) ** n <= rtol / 64)
        numbers.append(n)
    first, further = [*numbers[:4], numbers[8]], numbers[4:8]
    assert first == [12] * 5
    assert further == [12] * 4 if most == 8 else all(12 < n <= 44 for n in further)


def test_slow_sweeps_are_relaxed_or_given_up():
    @jax.jit
    @jax.vmap
    def solve(slopes):
        return _found(lambda y, _: y - slopes * y - 1, jnp.zeros(30), SWEEPS)

    slopes = np.array([0.7, -0.7, 0.8, -1.5, -3.0, 1.5])[:, None] * np.ones(30)
    # Side by side with other slopes, too.
    spread = np.array([[0.6], [-0.6], [0.3]]) * np.linspace(0.5, 1, 30)
    slopes = np.concatenate([slopes, spread])
    value, success = solve(slopes)
    # The eigenvalue of a sweep of the doubled system is the square of the slope.
    expected = np.abs(slopes) < 1
    np.testing.assert_array_equal(success, expected[:, 0])
    # Where it did not converge, Newton's method begins from zero.
    np.testing.assert_allclose(
        value, np.where(expected, 1 / (1 - slopes), 0), rtol=1e-13
    )
    # Of some of these the iterates overflow between two checks, of some at one: there an
    # infinite correction stands next to an infinite state.
    sizes = 10.0 ** np.arange(1, 300)
    huge = np.concatenate([sizes, -sizes[1:]])
    assert not np.any(solve(huge[:, None] * np.ones(30))[1])


def _oscillators(fastest, steps, rescue=0, dtype=jnp.float64):
    """A midpoint step of twenty oscillators of frequencies up to `fastest`, and whether it
    was solved."""
    turn = jnp.asarray(fastest * np.linspace(0.05, 1, 20), dtype)
    term = diffrax.ODETerm(lambda t, y, args: (-turn * y[1], turn * y[0]))
    angles = np.arange(20, dtype=dtype)
    y0 = np.cos(angles), np.sin(angles)
    times = np.zeros((), dtype), np.ones((), dtype)
    finder = ds.PicardNewton(picard_steps=steps, newton_steps=rescue)
    solver = ds.ImplicitMidpoint(root_finder=finder)
    (p, q), *_, result = solver.step(term, *times, y0, None, None, False)
    # In the complex plane the exact step is a product.
    z = (1 + 0.5j * turn) / (1 - 0.5j * turn) * (y0[0] + 1j * y0[1])
    return result == diffrax.RESULTS.successful, jnp.max(jnp.abs(p + 1j * q - z))


# Fixed-point iterations shrink errors by half the frequency: 49 of them for the second ones
# to 2e-5 of themselves.
@pytest.mark.parametrize("fastest, steps", [(0.2, 17), (1.6, 49)])
def test_many_oscillators_need_neither_newton_nor_many_iterations(fastest, steps):
    in_single = ft.partial(_oscillators, steps=steps // 2 + 4, dtype=jnp.float32)
    both = jax.jit(lambda w: (_oscillators(w, steps), in_single(w)))
    (solved, error), (solved_in_single, error_in_single) = both(fastest)
    assert solved and error < 2e-15
    assert solved_in_single and error_in_single < 1e-6


def test_each_path_of_many_unknowns_is_iterated_at_its_own_rate():
    # The last one only Newton's method solves.
    fastest = jnp.array([0.01, 0.3, 1.0, 3.0, 4.0, 300.0])
    solve = lambda w: (_oscillators(w, 200), _oscillators(w, 200, rescue=64))
    (first, error), (solved, error_with_rescue) = jax.jit(jax.vmap(solve))(fastest)
    assert first.tolist() == [True] * 5 + [False]
    assert error[:5].max() < 2e-15
    assert solved.all() and error_with_rescue.max() < 1e-13


def test_of_many_unknowns_no_step_is_taken_for_solved_that_is_not():
    # One is fast, or all others are half as fast.
    @jax.jit
    @jax.vmap
    def solve(slope, others):
        turn = slope * jnp.where(jnp.arange(20) == 0, 1, others)
        residual = lambda k, _: (k[0] + turn * (1 + k[1]), k[1] - turn * (1 + k[0]))
        value, success = _found(residual, (jnp.zeros(20),) * 2, SWEEPS)
        return success, jnp.max(jnp.abs(jnp.stack(residual(value, None))))

    slopes = np.linspace(0.1, 4, 40)
    success, size = solve(np.tile(slopes, 2), np.repeat([0.01, 0.5], 40))
    success, size = success.reshape(2, 40), size.reshape(2, 40)
    assert success[:, :9].all() and np.all(success.sum(axis=1) >= 20)
    assert size[success].max() < 2e-15


def test_what_is_not_a_number_ends_at_once():
    evaluations = []

    def residual(k, _):
        jax.debug.callback(lambda: evaluations.append(1))
        return k - 0.5 * k - jnp.nan

    _, success = _found(residual, jnp.zeros(30), SWEEPS)
    jax.effects_barrier()
    assert not success and 0 < len(evaluations) < 30


class _ForSmallMatrices(lx.AbstractLinearSolver):
    """Finds no correction where an entry is larger than `limit`. Elimination may do so
    where rounding errors are as large as what matters."""

    limit: float

    def init(self, operator, options):
        return operator.as_matrix()

    def compute(self, state, vector, options):
        small = jnp.max(jnp.abs(state)) <= self.limit
        x = jnp.where(small, jnp.linalg.solve(state, vector), 0)
        return x, lx.RESULTS.successful, {}

    def transpose(self, state, options):
        return state.T, options

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True


def test_corrections_of_zero_are_no_solution_where_the_residual_exceeds_the_state():
    finder = ds.PicardNewton(linear_solver=_ForSmallMatrices(0))
    # The residual at the start, where the state is one.
    given = lambda size: lambda y, _: 5 * (y - 1) + size
    solve = jax.jit(jax.vmap(lambda x: _found(given(x), jnp.ones(3), finder)[1]))
    assert solve(jnp.array([0.9, 1.1])).tolist() == [True, False]


def test_where_no_correction_is_found_the_step_is_solved_in_parts():
    # The derivative is 5 at the start and 2.7 at the solution.
    finder = ds.PicardNewton(picard_steps=0, linear_solver=_ForSmallMatrices(3))
    fn = lambda y, _: 2.5 * (y - 2 + jnp.tanh(y) - jnp.tanh(2.0))
    value, success = _found(fn, jnp.zeros(1), finder)
    assert success
    np.testing.assert_allclose(value, 2, rtol=1e-14)


def test_a_linear_system_that_gmres_cannot_solve_is_no_solution():
    # It makes no progress at all with a shift until it has as many images as unknowns.
    unit = np.eye(40)
    residual = lambda y, _: jnp.roll(y, 1) - unit[0]
    assert not _found(residual, unit[-1] + unit[3] / 2)[1]


def test_a_solution_of_zero_is_found_among_rounding_errors():
    # What the function returns there is a rounding error, and larger than the solution.
    fn = lambda x, _: 1000 * (jnp.sin(x + 0.3) - jnp.sin(0.3)) + 3e-13
    solve = _solver(fn, ds.PicardNewton(atol=1e-12), jax.vmap)
    value, success = solve(jnp.array([0.0, 0.1]))
    assert np.all(success) and np.all(np.abs(value) <= 1e-12)


def test_corrections_that_rounding_errors_make_grow_are_accepted_below_the_tolerance():
    no = jnp.array(False)
    for size, expected in ((0.015, True), (0.016, False)):
        assert converged(jnp.log2(size), jnp.array(3.0), no, no) == expected


def test_what_else_a_function_returns_belongs_to_its_root():
    # Sweeps diverge from the second start, and Newton's method takes over.
    fn = lambda x, _: (jnp.arctan(x - 1), {"three": 3 * x})

    @jax.jit
    @jax.vmap
    def solve(start):
        sol = optx.root_find(fn, ds.PicardNewton(), start, has_aux=True)
        return sol.value, sol.aux["three"]

    value, three = solve(jnp.array([1.1, 31.0]))
    np.testing.assert_allclose(value, 1, atol=1e-14)
    np.testing.assert_allclose(three, 3 * value, rtol=1e-14)


def test_a_loop_of_a_batch_has_one_length_for_all():
    # Were it one for each path, whatever they share would be computed for each of them.
    shared = lambda fn: jax.vmap(fn, out_axes=None)
    counts = jnp.array([[0, 2, 1], [1, 5, 0]])
    assert shared(shared(largest_in_batch))(counts) == 5


@pytest.mark.core
@pytest.mark.parametrize("n", [3, 17])
def test_the_norm_of_a_correction_tells_what_is_not_a_number(n):
    # In batches of thousands XLA's own maximum of NaNs is -inf on CPUs.
    norm = jax.jit(jax.vmap(max_norm))
    is_bad = np.arange(3000) % 7 == 0
    for bad in (np.nan, -np.nan, np.inf):
        for at in range(n):
            spoilt = np.tile(np.linspace(-2.0, 1.0, n), (3000, 1))
            spoilt[is_bad, at] = bad
            np.testing.assert_array_equal(norm(spoilt), np.where(is_bad, bad, 2.0))
    assert np.isnan(max_norm(jnp.full((n, 1), jnp.nan)))


def test_doubled_equations_with_kinks_are_solved_to_rounding_error_in_a_kernel():
    @jax.jit
    def solution(near, far, kink):
        def image(y):
            return jnp.stack(
                [near * jnp.abs(y[0] - kink) + far * y[1] + 1, far * y[0] + 0.7]
            )

        y, is_solved = solve_one_path(image, jnp.abs, jnp.zeros(2), jnp.array(True))
        exact = jax.lax.fori_loop(0, 300, lambda _, y: image(y), y)
        return y, is_solved, exact

    rng = np.random.default_rng(0)
    for size in 10.0 ** -rng.uniform(1, 3, 200):
        near, far, kink = size * rng.normal(size=3)
        y, is_solved, exact = solution(near, far, 1 + kink)
        assert is_solved
        # Of the largest number, 1.5 units in the last place.
        bound = 1.5 * np.finfo(float).eps * np.max(np.abs(exact))
        assert np.max(np.abs(y - exact)) <= bound
