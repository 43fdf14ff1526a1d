"""Expectations over many paths: the same paths however they are run, none lost, none
counted that failed."""

import dataclasses
import functools
import os
import socket
import subprocess
import sys
import warnings
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
import pytest

import diffrax_symplectic as ds

from ..picard import by_picard
from ..problems import kubo_terms


def _normal(key):
    return {"x": 1e6 + jr.normal(key, (2,))}


def _by_hand(fn, key, n):
    index = jnp.arange(n, dtype=jnp.uint32)
    of_path = lambda i, key: fn(jr.fold_in(jr.fold_in(key, 0), i))
    return jax.jit(jax.vmap(of_path, (0, None)))(index, key)


@pytest.mark.parametrize("batch_size", [7, 4096])
def test_mean_and_standard_error_are_those_of_all_paths(batch_size):
    key = jr.key(1)
    got = ds.monte_carlo(_normal, key=key, num_paths=1000, batch_size=batch_size)
    x = np.asarray(_by_hand(_normal, key, 1000)["x"])
    np.testing.assert_allclose(got.mean["x"], x.mean(axis=0), rtol=1e-14)
    # Small deviations about a large mean: a difference of squares would lose these.
    np.testing.assert_allclose(got.variance["x"], x.var(axis=0, ddof=1), rtol=1e-9)
    error = x.std(axis=0, ddof=1) / np.sqrt(1000)
    np.testing.assert_allclose(got.std_error["x"], error, rtol=1e-9)
    assert (got.num_paths, got.num_failed) == (1000, 0)


def test_what_is_sampled_is_traced_once():
    calls = []

    def fn(key):
        calls.append(key)
        return jr.normal(key)

    ds.monte_carlo(fn, key=jr.key(0), num_paths=1000, batch_size=100)
    assert len(calls) == 1


def test_single_precision_is_accumulated_in_double():
    ones = lambda key: jnp.float32(1) + 1e-3 * jr.normal(key, (), jnp.float32)
    got = ds.monte_carlo(ones, key=jr.key(0), num_paths=100_000, batch_size=1000)
    x = np.asarray(_by_hand(ones, jr.key(0), 100_000), float)
    np.testing.assert_allclose(got.mean, x.mean(), rtol=1e-8)
    np.testing.assert_allclose(got.variance, x.var(ddof=1), rtol=1e-4)


def test_the_mean_of_a_constant_in_single_precision_is_that_constant():
    third = jnp.float32(1 / 3)
    same = lambda key: third + 0 * jr.normal(key, (), "f4")
    got = ds.monte_carlo(same, key=jr.key(0), num_paths=1023)
    assert got.mean == np.float64(third)
    # It is known no better than it is rounded.
    np.testing.assert_allclose(got.std_error, np.finfo(np.float32).eps / 3)


@pytest.mark.core
def test_an_estimate_can_be_continued():
    key = jr.key(2)
    first = ds.monte_carlo(_normal, key=key, num_paths=300, batch_size=128)
    rest = ds.monte_carlo(_normal, key=key, num_paths=1000, batch_size=200, start=first)
    whole = ds.monte_carlo(_normal, key=key, num_paths=1000)
    assert rest.num_paths == 1000
    np.testing.assert_allclose(rest.mean["x"], whole.mean["x"], rtol=1e-14)
    np.testing.assert_allclose(rest.variance["x"], whole.variance["x"], rtol=1e-9)
    with pytest.raises(ValueError, match="another `key`"):
        ds.monte_carlo(_normal, key=jr.key(3), num_paths=1000, start=first)
    with pytest.raises(ValueError, match="which has 1000 already"):
        ds.monte_carlo(_normal, key=key, num_paths=300, start=rest)
    with pytest.raises(ValueError, match="another `fn`"):
        ds.monte_carlo(lambda k: jr.normal(k), key=key, num_paths=2000, start=rest)


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


DECAY = diffrax.ODETerm(lambda t, y, args: -y)


def test_failures_are_counted_if_they_are_reported_and_raised_if_they_are_thrown():
    def fn(key, throw):
        """A solve that stops after half of its steps."""
        sol = diffrax.diffeqsolve(
            DECAY,
            diffrax.Euler(),
            0.0,
            1.0,
            0.1,
            jr.normal(key),
            throw=throw,
            max_steps=5,
        )
        return sol.ys[-1], sol.result

    run = lambda throw: ds.monte_carlo(
        lambda key: fn(key, throw), key=jr.key(0), num_paths=100
    )
    with pytest.warns(UserWarning, match="100 paths failed"):
        assert run(False).num_failed == 100
    with pytest.raises(RuntimeError, match="max_steps"):
        run(True)


def _square(solver, steps=10):
    def phi(key):
        terms = kubo_terms(ds.WeakBrownianPath((), key))
        y0 = (jnp.array(0.0), jnp.array(1.0))
        sol = diffrax.diffeqsolve(
            terms, solver, 0.0, 1.0, 1 / steps, y0, max_steps=steps, throw=False
        )
        return sol.ys[1][-1] ** 2, sol.result

    return phi


@pytest.mark.core
def test_the_estimate_of_a_solve_is_its_exact_expectation():
    # A step turns by 2 atan((h + I) / 2): the moments of the method in closed form.
    n, h = 10, 0.1
    phi = _square(by_picard(ds.ImplicitMidpoint()), n)
    got = ds.monte_carlo(phi, key=jr.key(0), num_paths=4_000)
    increments = np.sqrt(3 * h) * np.array([-1, 0, 1])
    twice = 4 * np.arctan((h + increments) / 2)
    exact = (1 + (np.exp(1j * twice) @ np.array([1, 4, 1]) / 6) ** n).real / 2
    assert got.num_failed == 0
    assert abs(got.mean - exact) <= 4 * got.std_error
    assert 0 < got.std_error < 0.01
    # Where no path is left to solve it stays as it is.
    same = ds.monte_carlo(phi, key=jr.key(0), num_paths=4_000, start=got)
    assert same.mean == got.mean


def test_an_interrupt_loses_only_what_is_running():
    class Interrupting(diffrax.AbstractProgressMeter):
        def init(self):
            return 0

        def step(self, state, progress):
            if state == 2:
                raise KeyboardInterrupt
            return state + 1

        def close(self, state):
            pass

    with pytest.raises(ds.ExpectationInterrupted) as info:
        ds.monte_carlo(
            _normal,
            key=jr.key(0),
            num_paths=1000,
            batch_size=100,
            progress_meter=Interrupting(),
        )
    estimate = info.value.estimate
    assert estimate.num_paths == 300
    rest = ds.monte_carlo(_normal, key=jr.key(0), num_paths=1000, start=estimate)
    whole = ds.monte_carlo(_normal, key=jr.key(0), num_paths=1000)
    np.testing.assert_allclose(rest.mean["x"], whole.mean["x"], rtol=1e-14)


@pytest.mark.parametrize("meter", ["TqdmProgressMeter", "TextProgressMeter"])
def test_meters_of_diffrax_take_expectations(meter, capfd):
    meter = getattr(diffrax, meter)()
    ds.monte_carlo(_normal, key=jr.key(0), num_paths=100, progress_meter=meter)
    jax.effects_barrier()
    assert "100" in "".join(capfd.readouterr())


@pytest.mark.parametrize("value", [0, -1, 1.5, "3", True])
def test_sizes_that_are_not_positive_integers_are_refused(value):
    with pytest.raises(ValueError, match="`batch_size` must be a positive integer"):
        ds.monte_carlo(_normal, key=jr.key(0), num_paths=10, batch_size=value)
    # One path alone says nothing of its error.
    few = 1 if value is True else value
    with pytest.raises(ValueError, match="`num_paths` must be an integer, 2 or larger"):
        ds.monte_carlo(_normal, key=jr.key(0), num_paths=few)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_values_whose_squares_underflow_or_overflow_are_as_good_as_others(size):
    run = lambda size: ds.monte_carlo(
        lambda key: size * jr.normal(key), key=jr.key(0), num_paths=100, batch_size=30
    )
    one, got = run(1.0), run(size)
    np.testing.assert_allclose(got.mean, size * one.mean, rtol=1e-12)
    np.testing.assert_allclose(got.std_error, size * one.std_error, rtol=1e-12)


def test_values_whose_spread_overflows_are_told():
    huge = lambda key: 1e308 * jr.rademacher(key, dtype=float)
    with pytest.warns(UserWarning, match="or its standard error is not finite"):
        ds.monte_carlo(huge, key=jr.key(0), num_paths=100)


def test_complex_values_and_functions_that_return_nothing_are_refused():
    for fn, said in ((lambda key: jr.normal(key) * 1j, ""), (lambda key: None, "none")):
        with pytest.raises(ValueError, match=f"`fn` must return real arrays.*{said}"):
            ds.monte_carlo(fn, key=jr.key(0), num_paths=10)


def test_functions_that_ignore_their_key_are_told():
    with pytest.warns(UserWarning, match="All 10 samples are equal.* on its key"):
        ds.monte_carlo(lambda key: jr.normal(jr.key(1)), key=jr.key(0), num_paths=10)


def test_an_estimate_prints_every_number_of_the_mean_in_a_line_with_its_place():
    ones = lambda key: jnp.ones((5, 6)) + 0 * jr.normal(key)
    got = ds.monte_carlo(
        lambda key: {"a": ones(key), "b": 2.0}, key=jr.key(0), num_paths=10
    )
    lines = str(got).splitlines()
    assert lines[0] == "['a'][0, 0]: 1.000000000000000 ± 2.2e-16"
    assert lines[29] == "['a'][4, 5]: 1.000000000000000 ± 2.2e-16"
    assert lines[30] == "['b']: 2.000000000000000 ± 4.4e-16"
    assert len(lines) == 33 and "10 paths on 1 level, 0 failed" in lines[-1]


def test_old_style_keys_will_do():
    a = ds.monte_carlo(_normal, key=jr.PRNGKey(1), num_paths=100)
    np.testing.assert_array_equal(
        a.mean["x"], ds.monte_carlo(_normal, key=jr.key(1), num_paths=100).mean["x"]
    )


PROGRAM = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
if len(sys.argv) > 2:
    address, rank = sys.argv[2:]
    jax.distributed.initialize(address, num_processes=2, process_id=int(rank))
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
import jax.random as jr
import diffrax_symplectic as ds
from tests.expectation.test_monte_carlo import _square
assert len(jax.devices()) == int(sys.argv[1]) * (2 if len(sys.argv) > 2 else 1)
square = _square(ds.ImplicitMidpoint())
e = ds.monte_carlo(square, key=jr.key(0), num_paths=3001, batch_size=100)
numbers = [float(e.mean), float(e.std_error), e.num_paths]
if len(sys.argv) == 2:
    import diffrax
    from tests.expectation.test_monte_carlo import _gradient
    try:
        got = ds.monte_carlo(_gradient(), key=jr.key(0), num_paths=100)
    except ValueError as error:
        said = "does not work on several devices. Pass `adjoint="
        assert any(said in note for note in error.__notes__), error.__notes__
        direct = _gradient(diffrax.DirectAdjoint())
        got = ds.monte_carlo(direct, key=jr.key(0), num_paths=100)
    numbers.append(float(got.mean))
print(*map(repr, numbers))
"""


def _start(program: str, *args) -> subprocess.Popen:
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", program, *map(str, args)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": root}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment, cwd=root
    )


def _read(process: subprocess.Popen) -> list[float]:
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    return [float(x) for x in out.splitlines()[-1].split()]


@functools.cache
def _of_three_devices() -> list[float]:
    """Three devices of one process: an estimate, its error and paths, and a gradient."""
    return _read(_start(PROGRAM, 3))


@pytest.mark.slow
def test_the_paths_are_the_same_on_any_devices_and_hosts():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{s.getsockname()[1]}"
    here = ds.monte_carlo(_square(ds.ImplicitMidpoint()), key=jr.key(0), num_paths=3001)
    expected = [here.mean, here.std_error, here.num_paths]
    np.testing.assert_allclose(_of_three_devices()[:3], expected, rtol=1e-12)
    # Two processes with two devices each.
    processes = [_start(PROGRAM, 2, address, rank) for rank in (0, 1)]
    for process in processes:
        np.testing.assert_allclose(_read(process), expected, rtol=1e-12)


def test_results_within_phi_are_refused():
    of_solve = lambda key: (jr.normal(key), jr.normal(key), diffrax.RESULTS.successful)
    of_root = lambda key: (jr.normal(key), optx.RESULTS.successful)
    for wrong in (of_solve, of_root):
        with pytest.raises(ValueError, match=r"Return a pair `\(phi, sol.result\)`"):
            ds.monte_carlo(wrong, key=jr.key(0), num_paths=10)


def test_without_any_success_there_is_no_mean_and_it_can_go_on():
    with pytest.warns(UserWarning, match="10 paths failed: there is no mean"):
        nothing = ds.monte_carlo(
            lambda key: jnp.nan * jr.normal(key), key=jr.key(0), num_paths=10
        )
    assert (nothing.num_paths, nothing.num_failed) == (0, 10)
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
    with pytest.raises(ValueError, match="needs a random key"):
        ds.monte_carlo(jr.normal, key=0, num_paths=10)


def test_paths_that_an_event_ends_are_no_failures():
    def fn(key):
        event = diffrax.Event(lambda t, y, args, **kwargs: y < 0.5)
        sol = diffrax.diffeqsolve(
            DECAY,
            diffrax.Euler(),
            0.0,
            2.0,
            0.1,
            jr.uniform(key),
            event=event,
            throw=False,
        )
        return sol.ts[-1], sol.result

    got = ds.monte_carlo(fn, key=jr.key(0), num_paths=200)
    assert got.num_failed == 0 and 0.1 < got.mean < 2


def _gradient(adjoint=None):
    if adjoint is None:
        adjoint = diffrax.RecursiveCheckpointAdjoint()

    def observable(strength, key):
        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: strength * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), key))
        y0, solver = (jnp.array(0.0), jnp.array(1.0)), ds.StormerVerlet()
        sol = diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, adjoint=adjoint)
        return sol.ys[1][-1]

    return jax.tree_util.Partial(jax.grad(observable), jnp.array(0.5))


@functools.cache
def _mean_gradient() -> float:
    by_hand = jax.jit(lambda key: _by_hand(_gradient(), key, 100))
    return np.mean(by_hand(jr.key(0)))


@pytest.mark.slow
def test_gradients_are_taken_within():
    one = jax.devices()[:1]
    got = ds.monte_carlo(_gradient(), key=jr.key(0), num_paths=100, devices=one)
    np.testing.assert_allclose(got.mean, _mean_gradient(), rtol=1e-12)


@pytest.mark.slow
def test_gradients_are_taken_within_on_several_devices():
    # The default adjoint is refused from JAX 0.10 on, and that of the advice works.
    np.testing.assert_allclose(_of_three_devices()[3], _mean_gradient(), rtol=1e-12)


def test_newtons_method_takes_part_from_the_first_batch_that_needs_it():
    # Sweeps solve no step in which an oscillator turns by 40.
    stiff = lambda t, p, q, args: (p**2 + 400 * q**2) / 2
    terms = ds.hamiltonian_terms(stiff, lambda t, p, q, args: -q, ())
    few = ds.IndependentPaths(256, batch_size=64)

    def estimate(root_finder):
        solver = ds.ImplicitMidpoint(root_finder=root_finder)
        y0 = jnp.array(0.0), jnp.array(1.0)
        given = lambda t, y, args: y[0] ** 2, terms, solver, 0, 4, 2.0, y0
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "256 paths failed")
            return ds.expectation(*given, key=jr.key(2), sampling=few, levels=1)

    assert estimate(ds.PicardNewton(newton_steps=0)).num_failed > 200
    got = estimate(ds.PicardNewton())
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
