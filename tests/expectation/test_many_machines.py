"""An estimate in parts, made anywhere, is that of one run to the last bit, and parts come
from the same arguments: others are refused by their names."""

import dataclasses
import functools as ft
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.sampling import AbstractSampling
from diffrax_symplectic._simulation import Problem

from ..families import slow_except


KEY = jr.key(3)
SAMPLINGS = {
    "IndependentPaths": lambda n: ds.IndependentPaths(n, 16),
    "ValueFunctions": lambda n: ds.ValueFunctions(1, n, 16),
    "ArrayRQMC": lambda n: ds.ArrayRQMC(64, n),
}


def _start(key):
    """Each path has its own."""
    return jnp.array(0.0), 1 + jr.normal(key) / 8


def _phi(t, y, args):
    return {"q2": y[1] ** 2, "both": (y[0], jnp.stack(y))}


def _spring(t, p, q, args):
    return p**2 / 2 + args * q**2 / 2


def _arguments(
    k=1.0, energy=_spring, solver=None, dt0=0.25, t1=1.0, t0=0.0, y0=_start, phi=_phi,
    ts=None,
):  # fmt: skip
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: jnp.cos(q), path)
    solver = solver or ds.StormerVerlet()
    return phi, terms, solver, t0, t1, dt0, y0, jnp.array(k), ts


def _part(name: str, n: int, first: int = 0, k=1.0, **kwargs) -> ds.Expectation:
    return ds.expectation(
        *_arguments(k)[:-1], key=KEY, levels=2, sampling=SAMPLINGS[name](n),
        first=first, **kwargs,
    )  # fmt: skip


def _bits(e: ds.Expectation) -> list[str]:
    leaves = jax.tree.leaves((e.mean, e.std_error, e.bias, e.error))
    return [float(x).hex() for leaf in leaves for x in np.ravel(leaf)]


@pytest.mark.parametrize("name", slow_except(["IndependentPaths"], SAMPLINGS))
def test_parts_are_one_run_to_the_last_bit_in_any_order(name, tmp_path):
    unit = 2 if name == "ArrayRQMC" else 16
    # Later parts are not looked at, which takes long.
    cut = [unit, 3 * unit, 4 * unit, 8 * unit]
    whole = _part(name, 7 * unit, unit)
    parts = [_part(name, b - a, a) for a, b in zip(cut, cut[1:])]
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        one, *others = [parts[k] for k in order]
        got = one.merge(*others)
        assert _bits(got) == _bits(whole) and got.samples == [(unit, cut[-1])]
        assert (got.num_paths, got.num_samples) == (whole.num_paths, 7 * unit)
    # And through files.
    for k, part in enumerate(parts):
        part.save(tmp_path / f"{k}.npz")
    one, *others = [ds.Expectation.load(tmp_path / f"{k}.npz") for k in (2, 0, 1)]
    merged = one.merge(*others)
    assert _bits(merged) == _bits(whole)
    assert str(merged.sampling) == str(parts[2].sampling)
    assert merged.reason == whole.reason
    # It can go on.
    more = _part(name, 9 * unit, start=merged)
    assert _bits(more) == _bits(_part(name, 9 * unit, unit))


def test_parts_that_do_not_fit_are_refused():
    name = "IndependentPaths"
    one, next_ = _part(name, 32, 32), _part(name, 32, 64)
    gap = one.merge(_part(name, 32, 96))
    assert gap.samples == [(32, 64), (96, 128)] and gap.num_paths == 64
    with pytest.raises(ValueError, match="Samples 80 to 95 are in two"):
        gap.merge(next_, _part(name, 16, 80))
    other = ds.monte_carlo(jr.normal, key=KEY, num_paths=10, first=100)
    with pytest.raises(ValueError, match="another structure or other shapes"):
        one.merge(other)
    with pytest.raises(ValueError, match="has another `key`"):
        other.merge(ds.monte_carlo(jr.normal, key=jr.key(4), num_paths=10))
    larger = dataclasses.replace(next_, paths_per_sample=32)
    with pytest.raises(ValueError, match="over 1 path.*over 32"):
        one.merge(larger)
    with pytest.raises(ValueError, match="over 32 paths.*over 1.*same `sampling`"):
        _part(name, 96, start=larger)
    with pytest.raises(ValueError, match="were sampled by IndependentPaths"):
        one.merge(dataclasses.replace(next_, sampling=SAMPLINGS["ValueFunctions"](32)))
    with pytest.raises(ValueError, match="`merge` takes estimates; got 3"):
        one.merge(3)  # pyright: ignore
    with pytest.raises(ValueError, match="`first` must be an integer from 0 to"):
        _part(name, 32, -1)
    with pytest.raises(ValueError, match="Pass either `start`.*, or `first`"):
        _part(name, 64, 32, start=one)


# From the name of an argument to other ones.
OTHERS = {
    "args": dict(k=9.0),
    "terms": dict(energy=lambda t, p, q, args: p**2 / 2 + args * q**2),
    "solver": dict(solver=ds.ImplicitMidpoint()),
    "dt0": dict(dt0=0.125),
    "t1": dict(t1=2.0),
    "t0": dict(t0=0.5, t1=1.5),
    "y0": dict(y0=(jnp.array(1.0), jnp.array(1.0))),
    "phi": dict(phi=lambda t, y, args: _phi(t, y, args) | {"q2": y[0]}),
    "ts": dict(ts=[0.5]),
}


@pytest.fixture(scope="module")
def first():
    return _part("IndependentPaths", 16, 16)


@pytest.fixture(scope="module")
def second():
    return _part("IndependentPaths", 16, 32)


@pytest.mark.parametrize("name", OTHERS)
def test_parts_of_another_problem_are_refused_by_its_argument(name, first, second):
    def with_digests(estimate, **changes):
        problem = Problem.of(*_arguments(**changes), 2, key=KEY)
        return dataclasses.replace(estimate, digests=problem.digests)

    # With times the estimate has another shape.
    same = dict(ts=[1.0]) if name == "ts" else {}
    one = with_digests(first, **same)
    # A function that computes the same is the same.
    again = dict(energy=lambda t, p, q, args: p**2 / 2 + args * q**2 / 2)
    assert one.merge(with_digests(second, **same, **again)).num_paths == 32
    with pytest.raises(ValueError, match=f"merge was computed with another `{name}`"):
        one.merge(with_digests(second, **OTHERS[name]))


def test_what_another_problem_computed_is_not_continued(first, second):
    assert first.merge(second).num_paths == 32
    with pytest.raises(ValueError, match="`start` was computed with another `args`"):
        _part("IndependentPaths", 32, k=9.0, start=first)


def test_parts_of_other_levels_are_refused(first, second):
    # Four levels have as many combinations as five.
    four, five = (
        dataclasses.replace(one, levels=levels)
        for one, levels in ((first, 4), (second, 5))
    )
    with pytest.raises(ValueError, match="another structure or other shapes"):
        four.merge(five)


def test_files_keep_what_tells_problems_apart(first, second, tmp_path):
    first.save(tmp_path / "first")
    assert ds.Expectation.load(tmp_path / "first").digests == first.digests
    # Those of earlier versions do not have it.
    dataclasses.replace(first, digests=None).save(tmp_path / "old")
    with pytest.warns(UserWarning, match="without digests of its arguments"):
        old = ds.Expectation.load(tmp_path / "old")
    assert old.merge(second).num_paths == 32


class Own(AbstractSampling):
    def prepare(self, problem, key, devices): ...


class IndependentPaths(Own):
    old_name: int = 3


@pytest.mark.parametrize(
    "sampling, said",
    [
        (Own(), "sampled by `Own`, which this version does not"),
        (IndependentPaths(), "`IndependentPaths` with old_name, which"),
    ],
    ids=["unknown", "with another field"],
)
def test_an_estimate_by_an_unknown_sampling_is_refused_by_name(
    tmp_path, sampling, said
):
    estimate = ds.monte_carlo(jr.normal, key=KEY, num_paths=8)
    dataclasses.replace(estimate, sampling=sampling).save(tmp_path / "own.npz")
    with pytest.raises(ValueError, match=said):
        ds.Expectation.load(tmp_path / "own.npz")


def _started(program: str, *args) -> subprocess.Popen:
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", program, *map(str, args)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": root}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment, cwd=root
    )


KILLED = """
import os, signal, sys
import jax
jax.config.update("jax_enable_x64", True)
from tests.expectation.test_many_machines import _part
import diffrax
class Killing(diffrax.AbstractProgressMeter):
    def init(self): return 0
    def step(self, state, progress):
        if state == 1 and sys.argv[3] == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        return state + 1
    def close(self, state): pass
part = int(sys.argv[1])
e = _part("IndependentPaths", 64, 64 * part, progress_meter=Killing())
e.save(sys.argv[2])
"""


@pytest.mark.slow
def test_two_processes_are_one_and_a_part_that_was_killed_is_done_again(tmp_path):
    file = lambda part: tmp_path / f"part{part}.npz"
    start = lambda part, how: _started(KILLED, part, file(part), how)
    processes = [start(0, "done"), start(1, "killed")]
    codes = [process.wait(timeout=300) for process in processes]
    assert codes == [0, -signal.SIGKILL] and not file(1).exists()
    assert start(1, "done").wait(timeout=300) == 0
    one, other = (ds.Expectation.load(file(part)) for part in (0, 1))
    assert _bits(other.merge(one)) == _bits(_part("IndependentPaths", 128))


DEVICES = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
if len(sys.argv) > 2:
    address, rank = sys.argv[2:]
    jax.distributed.initialize(address, num_processes=2, process_id=int(rank))
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
from tests.expectation import test_many_machines as here
assert len(jax.devices()) == int(sys.argv[1]) * (2 if len(sys.argv) > 2 else 1)
functions = here._of_solves, here._of_samplings, here._gradient
print(*[x.hex() for f in functions[: 1 if len(sys.argv) > 2 else 3] for x in f()])
"""


def _observable(strength, key, **options):
    noise = lambda t, p, q, args: strength * jnp.sin(q)
    terms = ds.hamiltonian_terms(_spring, noise, ds.WeakBrownianPath((), key))
    given = terms, ds.StormerVerlet(), 0.0, 0.5, 0.1, (jnp.array(0.0), jnp.array(1.0))
    return diffrax.diffeqsolve(*given, jnp.array(1.0), **options).ys[1][-1]


def _of_solves() -> list[float]:
    fn = jax.tree_util.Partial(_observable, jnp.array(0.5))
    e = ds.monte_carlo(fn, key=KEY, num_paths=3001, batch_size=100)
    return [float(e.mean), float(e.std_error), float(e.num_paths)]


def _of_samplings() -> list[float]:
    samplings = (
        ds.ArrayRQMC(64, 5),
        ds.ValueFunctions(2, 96, 16),
        ds.ValueFunctions(None, 96, 16),
        ds.IndependentPaths(96, 16),
    )
    _, *given, y0, k, _ = _arguments(energy=lambda t, p, q, k: (p**2 + k * q**4) / 2)
    given = lambda t, y, args: y[1] ** 2, *given, (jnp.array(0.0), jnp.array(1.0)), k
    each = [ds.expectation(*given, key=KEY, levels=2, sampling=x) for x in samplings]
    return [float(x) for e in each for x in (e.mean, e.bias, e.std_error)]


def _gradient() -> list[float]:
    """The mean of a gradient."""

    def mean(**options):
        gradient = jax.grad(ft.partial(_observable, **options))
        fn = jax.tree_util.Partial(gradient, jnp.array(0.5))
        return [float(ds.monte_carlo(fn, key=KEY, num_paths=100).mean)]

    try:
        return mean()
    except ValueError as error:
        # The default adjoint is refused on several devices from JAX 0.10 on.
        said = "does not work on several devices. Pass `adjoint="
        assert any(said in note for note in error.__notes__), error.__notes__
        return mean(adjoint=diffrax.DirectAdjoint())


@pytest.mark.slow
def test_the_paths_are_the_same_on_any_devices_and_hosts():
    def read(process):
        out, _ = process.communicate(timeout=300)
        assert process.returncode == 0
        return [*map(float.fromhex, out.splitlines()[-1].split())]

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{s.getsockname()[1]}"
    of_solves, of_samplings = _of_solves(), _of_samplings()
    # Two processes with two devices each.
    processes = [_started(DEVICES, 2, address, rank) for rank in (0, 1)]
    for process in processes:
        np.testing.assert_allclose(read(process), of_solves, rtol=1e-12)
    eight = read(_started(DEVICES, 8))
    np.testing.assert_allclose(eight[:3], of_solves, rtol=1e-12)
    # To the last bit.
    assert eight[3:-1] == of_samplings
    # Gradients are those by hand.
    keys = jax.vmap(lambda i: jr.fold_in(jr.fold_in(KEY, 0), i))(jnp.arange(100))
    by_hand = jax.vmap(lambda key: jax.grad(_observable)(0.5, key))(keys)
    for gradient in (eight[-1], *_gradient()):
        np.testing.assert_allclose(gradient, np.mean(by_hand), rtol=1e-12)
