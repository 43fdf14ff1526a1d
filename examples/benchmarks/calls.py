"""Processor seconds of first and repeated calls, next to Diffrax's `Heun`:

    python -m examples.benchmarks.calls

Each call is measured in a process of its own, since a process remembers what it has traced
and compiled. Writes its part of `docs/benchmarks/index.md`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds

from ._timing import machine, table, write


STEPS, H = 10, 0.1
PATHS = 64
REPEATS = 10
Y0 = (jnp.array(0.0), jnp.array(1.0))


class Seconds(NamedTuple):
    """Processor time of the first call, and of the best of the calls after it."""

    first: float
    repeated: float


def pendulum(path_or_shape: Any) -> Any:
    return ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2 - jnp.cos(q),
        lambda t, p, q, args: 0.2 * jnp.sin(q),
        path_or_shape,
    )


def solve(solver: Any, make_path: Callable) -> Callable:
    """A jitted solve by `diffrax.diffeqsolve`, as a function of a number."""

    @jax.jit
    def end(key):
        terms = pendulum(make_path(key))
        return diffrax.diffeqsolve(terms, solver, 0.0, STEPS * H, H, Y0).ys

    return lambda i: jax.block_until_ready(end(jr.key(i)))


def solved_by(solver: Any) -> Callable:
    return solve(solver, lambda key: solver.path((), key))


def heun() -> Callable:
    return solve(diffrax.Heun(), lambda key: ds.FixedStepBrownianPath((), key))


def square(t, y, args):
    return y[1] ** 2


def expectation(solver: Any, **arguments: Any) -> Callable:
    """`expectation` as a function of a number."""
    terms = pendulum(())
    problem = (square, terms, solver, 0.0, STEPS * H, H, Y0)
    return lambda i: ds.expectation(*problem, key=jr.key(i), **arguments)


FEW = ds.IndependentPaths(PATHS)
SOLVERS = (ds.StormerVerlet(), ds.ImplicitMidpoint(), ds.StrangGauss())
DEFAULTS = {
    f"`expectation` with the defaults, `{type(solver).__name__}`": (
        lambda solver=solver: expectation(solver)
    )
    for solver in SOLVERS
}
SOLVES = {
    f"jitted `diffeqsolve`, `{type(solver).__name__}`": (
        lambda solver=solver: solved_by(solver)
    )
    for solver in (ds.ImplicitMidpoint(), ds.StrangGauss())
}
HEUN = "jitted `diffeqsolve`, `Heun`"
CALLS: dict[str, Callable[[], Callable]] = {
    HEUN: heun,
    **SOLVES,
    **DEFAULTS,
    f"`expectation` of {PATHS} independent paths": (
        lambda: expectation(ds.ImplicitMidpoint(), sampling=FEW, levels=1)
    ),
    f'`expectation` of {PATHS} independent paths, `engine="drjit"`': (
        lambda: expectation(
            ds.ImplicitMidpoint(), sampling=FEW, levels=1, engine="drjit"
        )
    ),
}


def measure(name: str) -> Seconds:
    """In this process."""
    call = CALLS[name]()
    # Starting JAX is no part of a call.
    jax.block_until_ready(jnp.zeros(3) + 1)

    def seconds(i: int) -> float:
        begin = time.process_time()
        call(i)
        return time.process_time() - begin

    first = seconds(0)
    return Seconds(first, min(seconds(i) for i in range(1, REPEATS + 1)))


def in_a_process(name: str, settings: dict[str, str]) -> Seconds:
    """In a process of its own, with these environment variables."""
    command = [sys.executable, "-m", "examples.benchmarks.calls", name]
    done = subprocess.run(
        command,
        env={**os.environ, **settings},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    *_, last = done.stdout.splitlines()
    return Seconds(*json.loads(last))


def in_a_second_process(name: str) -> Seconds:
    """In a process that finds the programs of another one on disk."""
    with tempfile.TemporaryDirectory() as folder:
        settings = {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }
        in_a_process(name, settings)
        return in_a_process(name, settings)


def main() -> None:
    measured = {name: in_a_process(name, {}) for name in CALLS}
    later = {name: in_a_second_process(name) for name in DEFAULTS}
    rows = [
        (
            name,
            f"{time.first:.2f}",
            f"{later[name].first:.2f}" if name in later else "",
            f"{time.repeated * 1e3:.1f}",
        )
        for name, time in measured.items()
    ]
    of_defaults = [measured[name] for name in DEFAULTS]
    firsts = [time.first / measured[HEUN].first for time in of_defaults]
    repeated = [time.repeated for time in of_defaults]
    lines = [
        f"A first `expectation` takes {min(firsts):.0f} to {max(firsts):.0f} times as long "
        f"as the first jitted `Heun`; later calls take {min(repeated):.2f} to "
        f"{max(repeated):.2f} s. Processor time of a pendulum with one noise and {STEPS} "
        "steps, float64; each row in its own process, then in one that finds its programs "
        f"in JAX's cache; repeated calls with other keys (best of {REPEATS}). {machine()}.",
        "",
        *table(("call", "first, s", "from JAX's cache, s", "repeated, ms"), rows),
    ]
    write("examples.benchmarks.calls", lines)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure(sys.argv[1])))
    else:
        main()
