"""Expectations over many paths: the same paths however they are run, none lost, none
counted that failed, and as many as a tolerance needs."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
import pytest

import diffrax_symplectic as ds

from ..problems import RecordingMeter
from .cells import Cell, moment
from .steps import sampled


KEY = jr.key(2)


def _normal(key):
    return {"x": 1e6 + jr.normal(key, (2,))}


def _by_hand(fn, key, n):
    index = jnp.arange(n, dtype=jnp.uint32)
    of_path = lambda i, key: fn(jr.fold_in(jr.fold_in(key, 0), i))
    return jax.jit(jax.vmap(of_path, (0, None)))(index, key)


def test_mean_and_standard_error_are_those_of_all_paths():
    traced = []

    def fn(key):
        traced.append(key)
        return _normal(key)

    key = jr.key(1)
    got = ds.monte_carlo(fn, key=key, num_paths=1000, batch_size=7)
    assert len(traced) == 1
    x = np.asarray(_by_hand(_normal, key, 1000)["x"])
    np.testing.assert_allclose(got.mean["x"], x.mean(axis=0), rtol=1e-14)
    # Small deviations about a large mean: a difference of squares would lose these.
    np.testing.assert_allclose(got.variance["x"], x.var(axis=0, ddof=1), rtol=1e-9)
    error = x.std(axis=0, ddof=1) / np.sqrt(1000)
    np.testing.assert_allclose(got.std_error["x"], error, rtol=1e-9)
    assert (got.num_paths, got.num_failed) == (1000, 0)


def test_single_precision_is_accumulated_in_double():
    third = jnp.float32(1 / 3)

    def fn(key):
        x = jr.normal(key, (), jnp.float32)
        return {"ones": jnp.float32(1) + 1e-3 * x, "constant": third + 0 * x}

    got = ds.monte_carlo(fn, key=jr.key(0), num_paths=100_000, batch_size=1000)
    x = np.asarray(_by_hand(fn, jr.key(0), 100_000)["ones"], float)
    np.testing.assert_allclose(got.mean["ones"], x.mean(), rtol=1e-8)
    np.testing.assert_allclose(got.variance["ones"], x.var(ddof=1), rtol=1e-4)
    assert got.mean["constant"] == np.float64(third)
    # It is known no better than it is rounded.
    rounding = np.finfo(np.float32).eps / 3
    np.testing.assert_allclose(got.std_error["constant"], rounding)


@pytest.mark.core
def test_an_interrupt_loses_only_what_is_running_and_the_estimate_can_be_continued():
    run = lambda num_paths, key=KEY, fn=_normal, **options: ds.monte_carlo(
        fn, key=key, num_paths=num_paths, batch_size=100, **options
    )
    with pytest.raises(ds.ExpectationInterrupted) as info:
        run(1000, progress_meter=RecordingMeter([], 2, KeyboardInterrupt))
    first = info.value.estimate
    assert first.num_paths == 300
    rest = ds.monte_carlo(_normal, key=KEY, num_paths=1000, start=first)
    whole = run(1000)
    assert rest.num_paths == 1000
    np.testing.assert_allclose(rest.mean["x"], whole.mean["x"], rtol=1e-14)
    np.testing.assert_allclose(rest.variance["x"], whole.variance["x"], rtol=1e-9)
    with pytest.raises(ValueError, match="another `key`"):
        run(1000, jr.key(3), start=first)
    with pytest.raises(ValueError, match="which has 1000 already"):
        run(300, start=rest)
    with pytest.raises(ValueError, match="another `fn`"):
        run(2000, fn=lambda key: jr.normal(key), start=rest)


def test_failed_paths_are_counted_and_left_out():
    def phi(key):
        x = jr.uniform(key)
        ok = diffrax.RESULTS.successful
        bad = diffrax.RESULTS.max_steps_reached
        value = jnp.where(x > 0.9, jnp.nan, x)
        return value, diffrax.RESULTS.where(x < 0.2, bad, ok)

    with pytest.warns(UserWarning, match=r"paths failed: they are left out"):
        got = ds.monte_carlo(phi, key=jr.key(0), num_paths=5000, batch_size=999)
    x = np.asarray(_by_hand(jr.uniform, jr.key(0), 5000))
    good = x[(x >= 0.2) & (x <= 0.9)]
    assert got.num_paths == len(good) and got.num_failed == 5000 - len(good)
    np.testing.assert_allclose(got.mean, good.mean(), rtol=1e-13)


def test_failures_are_counted_if_they_are_reported_and_raised_if_they_are_thrown():
    def fn(key):
        """A solve that an event ends below 0.5, or a failure after five steps."""
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: -y),
            diffrax.Euler(),
            0.0,
            2.0,
            0.1,
            jr.uniform(key),
            event=diffrax.Event(lambda t, y, args, **kwargs: y < 0.5),
            max_steps=5,
            throw=False,
        )
        return sol.ts[-1], sol.result

    with pytest.warns(UserWarning, match="paths failed"):
        got = ds.monte_carlo(fn, key=jr.key(0), num_paths=200)
    starts = _by_hand(jr.uniform, jr.key(0), 200)
    assert got.num_failed == np.sum(starts > 0.5 / 0.9**5) > 0
    assert 0.1 < got.mean < 0.5
    thrown = lambda key: eqx.error_if(jr.normal(key), True, "a failure")
    with pytest.raises(RuntimeError, match="a failure"):
        ds.monte_carlo(thrown, key=jr.key(0), num_paths=100)


def _square(key):
    """Of an oscillator with multiplicative noise after ten steps."""
    path, steps = ds.WeakBrownianPath((), key), 10
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: (p**2 + q**2) / 2, lambda t, p, q, args: q**2 / 4, path
    )
    y0 = (jnp.array(0.0), jnp.array(1.0))
    sol = diffrax.diffeqsolve(
        terms, ds.StormerVerlet(), 0.0, 1.0, 1 / steps, y0, max_steps=steps, throw=False
    )
    return sol.ys[1][-1] ** 2, sol.result


@pytest.mark.core
def test_the_estimate_of_a_solve_is_its_exact_expectation():
    got = ds.monte_carlo(_square, key=jr.key(0), num_paths=4_000)
    cell = Cell("multiplicative", 0.5, 1.0, 10)
    exact, exact_square = moment(cell, 2)[4], moment(cell, 4)[40]
    assert got.num_failed == 0
    assert abs(got.mean - exact) <= 4 * got.std_error
    std_error = np.sqrt((exact_square - exact**2) / 4_000)
    assert got.std_error == pytest.approx(std_error, rel=0.1)
    # Where no path is left to solve it stays as it is.
    same = ds.monte_carlo(_square, key=jr.key(0), num_paths=4_000, start=got)
    assert same.mean == got.mean


@pytest.mark.parametrize("meter", ["TqdmProgressMeter", "TextProgressMeter"])
def test_meters_of_diffrax_take_expectations(meter, capfd):
    meter = getattr(diffrax, meter)()
    ds.monte_carlo(_normal, key=jr.key(0), num_paths=100, progress_meter=meter)
    jax.effects_barrier()
    assert "100" in "".join(capfd.readouterr())


def test_old_style_keys_will_do():
    a = ds.monte_carlo(_normal, key=jr.PRNGKey(1), num_paths=100)
    np.testing.assert_array_equal(
        a.mean["x"], ds.monte_carlo(_normal, key=jr.key(1), num_paths=100).mean["x"]
    )


def test_without_any_success_there_is_no_mean_and_it_can_go_on():
    nan = lambda key: jnp.nan * jr.normal(key)
    with pytest.warns(UserWarning, match="10 paths failed: there is no mean"):
        nothing = ds.monte_carlo(nan, key=jr.key(0), num_paths=10, tol=1.0)
    assert (nothing.num_paths, nothing.num_failed) == (0, 10)
    assert nothing.tol_reached is False
    numbers = nothing.mean, nothing.std_error, nothing.failed_error
    assert np.all(np.isnan(numbers)) and "could change" not in str(nothing)
    # As in a file of an earlier version, which does not know its function.
    nothing = dataclasses.replace(nothing, digests=None)
    more = ds.monte_carlo(
        jr.normal, key=jr.key(0), num_paths=np.int64(20), start=nothing
    )
    assert np.isfinite(more.mean) and (more.num_paths, more.num_failed) == (10, 10)
    with pytest.raises(ValueError, match="other shapes"):
        ds.monte_carlo(
            lambda k: jr.normal(k, (2,)), key=jr.key(0), num_paths=30, start=nothing
        )


def test_newtons_method_takes_part_from_the_first_batch_that_needs_it():
    # Sweeps solve no step in which an oscillator turns by 40.
    stiff = lambda t, p, q, args: (p**2 + 400 * q**2) / 2
    terms = ds.hamiltonian_terms(stiff, lambda t, p, q, args: -q, ())
    given = terms, ds.ImplicitMidpoint(), 2.0, (jnp.array(0.0), jnp.array(1.0))
    square = lambda t, y, args: y[0] ** 2
    few = ds.IndependentPaths(256, batch_size=64)
    got = sampled(few, *given, num_steps=2, levels=1, phi=square, key=KEY)
    assert got.num_failed == 0 and got.num_paths == 256
    # Two steps of the midpoint rule, (1 - A) y1 = (1 + A) y0 + (W, 0).
    A = np.array([[0.0, -400.0], [1.0, 0.0]])
    turn = np.linalg.solve(np.eye(2) - A, np.eye(2) + A)
    kick = np.linalg.solve(np.eye(2) - A, [1, 0])
    start = turn @ turn @ [0, 1]
    exact = start[0] ** 2 + 2.0 * (kick[0] ** 2 + (turn @ kick)[0] ** 2)
    assert abs(got.mean - exact) <= 4 * got.std_error


class _Steps(eqx.Module):
    """A function that holds a solver, and says how it solves its steps."""

    solver: ds.ImplicitMidpoint

    def __call__(self, key):
        return jr.normal(key) + self.solver.root_finder.newton_steps  # pyright: ignore


def test_a_solver_in_a_function_of_the_user_keeps_newtons_method():
    got = ds.monte_carlo(_Steps(ds.ImplicitMidpoint()), key=jr.key(0), num_paths=64)
    assert got.mean > 90


def _number(key):
    """Which word the key has: no two paths share it."""
    return jr.bits(key, (), jnp.uint32).astype(float)


def test_keys_of_paths_beyond_32_bits_carry_into_the_second_word():
    key, n, first = jr.key(7), 10, 2**33 - 4
    got = ds.monte_carlo(_number, key=key, num_paths=n, batch_size=n, first=first)
    words = [divmod(i, 2**32) for i in range(first, first + n)]
    keys = [jr.fold_in(jr.fold_in(key, hi), np.uint32(lo)) for hi, lo in words]
    x = np.array([_number(k) for k in keys])
    assert {hi for hi, _ in words} == {1, 2}
    assert (got.num_paths, got.num_failed) == (n, 0)
    np.testing.assert_allclose(got.mean, x.mean(), rtol=1e-14)
    np.testing.assert_allclose(got.variance, x.var(ddof=1), rtol=1e-12)


def test_progress_is_shown_after_each_batch_and_closed_in_any_case():
    calls = []
    run = lambda meter: ds.monte_carlo(
        jr.normal, key=jr.key(0), num_paths=10, batch_size=4, progress_meter=meter
    )
    run(RecordingMeter(calls))
    assert calls == ["init", 0.4, 0.8, 1.0, ("closed after", 3)]
    calls.clear()
    with pytest.raises(RuntimeError, match="stop here"):
        run(RecordingMeter(calls, fails_at=1))
    assert calls == ["init", 0.4, 0.8, ("closed after", 1)]


def test_paths_are_added_until_every_standard_error_is_below_tol():
    def two(key):
        x = jr.normal(key, (2,))
        return {"small": 1e-3 * x[0], "large": x}

    run = lambda n, **kwargs: ds.monte_carlo(
        two, key=jr.key(3), num_paths=n, batch_size=500, **kwargs
    )
    tol = 0.02
    got = run(100_000, tol=tol)
    # 2,500 paths are about enough for a deviation of 1; one batch more is under way.
    assert 2_000 <= got.num_paths <= 4_000 and got.num_paths % 500 == 0
    assert got.tol_reached and np.all(got.std_error["large"] <= tol)
    before = run(got.num_paths - 1_000)
    assert before.tol_reached is None and np.any(before.std_error["large"] > tol)
    whole = run(got.num_paths)
    np.testing.assert_array_equal(got.mean["large"], whole.mean["large"])
    with pytest.warns(
        UserWarning, match="`tol=0.02` was not reached: .* 1,000 p"
    ) as told:
        short = run(1_000, tol=tol)
    needed = 1_000 * (np.max(short.std_error["large"]) / tol) ** 2
    assert f"takes about {needed:.1e} paths" in str(told[0].message)
    assert short.tol_reached is False and "`tol` was not reached" in str(short)
    assert short.num_paths == 1_000
    # It goes on from there, and not at all where nothing is left to do.
    on = run(100_000, tol=tol, start=short)
    assert on.tol_reached and on.num_paths == got.num_paths
    assert run(100_000, tol=tol, start=on).num_paths == on.num_paths


def test_levels_of_a_sample_share_its_key_and_go_on_where_they_stopped():
    def fn(key, level):
        return (1 + 0.1 * 0.5**level) * jr.normal(key)

    run = lambda n, start=None: ds.monte_carlo(
        fn, key=jr.key(0), num_paths=n, levels=2, order=1, start=start
    )
    got = run(1000)
    one = ds.monte_carlo(jr.normal, key=jr.key(0), num_paths=1000)
    np.testing.assert_allclose(got.mean, one.mean, rtol=1e-12)
    # The mean of the finer level less the extrapolated one.
    np.testing.assert_allclose(got.bias, 0.05 * one.mean, rtol=1e-12)
    np.testing.assert_allclose(got.bias_std_error, 0.05 * one.std_error, rtol=1e-12)
    np.testing.assert_allclose(got.error, np.hypot(got.std_error, got.bias))
    parts = (
        f"sampling {got.std_error:.1e}, discretization {got.discretization_error:.1e}"
    )
    assert f"± {got.error:.1e} ({parts})" in str(got)
    low, high = got.interval(0.5)
    assert high - low > got.error
    rest = run(1000, start=run(300))
    np.testing.assert_allclose(rest.mean, got.mean, rtol=1e-12)
    np.testing.assert_allclose(rest.bias, got.bias, rtol=1e-11)
    assert one.bias is None and one.bias_std_error is None
    np.testing.assert_array_equal(one.error, one.std_error)


def test_a_path_fails_if_it_does_on_one_of_the_levels():
    def phi(key, level):
        x = jr.uniform(key)
        return jnp.where((level == 1) & (x < 0.5), jnp.nan, x * (1 + level))

    got = ds.monte_carlo(phi, key=jr.key(1), num_paths=64, levels=2, order=2)
    x = np.array(
        [jr.uniform(jr.fold_in(jr.fold_in(jr.key(1), 0), i)) for i in range(64)]
    )
    assert got.num_failed == np.sum(x < 0.5) and got.num_paths == np.sum(x >= 0.5)
    # 4/3 of the finer level less 1/3 of the coarser one.
    np.testing.assert_allclose(got.mean, np.mean(x[x >= 0.5]) * 7 / 3, rtol=1e-12)


def test_an_order_of_one_half_removes_powers_of_the_root_of_the_step():
    def phi(key, level):
        h = 0.5**level
        return jr.uniform(key) + 3 * jnp.sqrt(h) - 2 * h

    got = ds.monte_carlo(phi, key=jr.key(1), num_paths=64, levels=3, order=0.5)
    exact = ds.monte_carlo(jr.uniform, key=jr.key(1), num_paths=64)
    np.testing.assert_allclose(got.mean, exact.mean, rtol=1e-12)
    np.testing.assert_allclose(got.bias, 3 * 0.5 - 2 * 0.25, rtol=1e-12)


SUCCESS = diffrax.RESULTS.successful


@pytest.mark.parametrize(
    "message, changes",
    [
        ("`batch_size` must be a positive integer", dict(batch_size=0)),
        ("`batch_size` must be a positive integer", dict(batch_size=1.5)),
        ("`batch_size` must be a positive integer", dict(batch_size="3")),
        ("`batch_size` must be a positive integer", dict(batch_size=True)),
        # One path alone says nothing of its error.
        ("`num_paths` must be an integer, 2 or larger", dict(num_paths=1)),
        ("`num_paths` must be an integer, 2 or larger", dict(num_paths=2.5)),
        ("`tol` must be a positive number", dict(tol=0.0)),
        ("`tol` must be a positive number", dict(tol=float("nan"))),
        ("the weak order of the solver", dict(levels=2)),
        ("`order` must be a positive integer", dict(levels=2, order=0)),
        ("`order` must be a positive integer, or 1/2", dict(levels=2, order=1.5)),
        ("needs a random key", dict(key=0)),
        ("`fn` must return real arrays", dict(fn=lambda key: jr.normal(key) * 1j)),
        ("`fn` must return real arrays.*none", dict(fn=lambda key: None)),
        (
            r"Return a pair `\(phi, sol.result\)`",
            dict(fn=lambda key: (1.0, 1.0, SUCCESS)),
        ),
        (
            r"Return a pair `\(phi, sol.result\)`",
            dict(fn=lambda key: (1.0, optx.RESULTS.successful)),
        ),
    ],
)
def test_bad_input_is_told_what_to_pass(message, changes):
    given = dict(fn=jr.normal, key=jr.key(0), num_paths=10) | changes
    with pytest.raises(ValueError, match=message):
        ds.monte_carlo(**given)
