"""Ensembles by one fused kernel, next to JAX and to a program in C:

    pip install '.[fused,examples]' && python -m examples.benchmarks.fused

Writes the table of `docs/ensembles.md`. Only steps are timed, and
first calls: each later call of `ensemble` takes 10 to 30 milliseconds more to check its
arguments. The engines take turns, in many short runs, and the best run of each counts, so
that other load on the machine matters less.
"""

import re
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds
from diffrax_symplectic._simulation.arguments import state_itself
from diffrax_symplectic._simulation.engines import fused_start
from diffrax_symplectic._simulation.problem import Problem

from .. import rigid_body
from ._timing import DOCS, ensemble, keys, machine, race, table, write


FEW, ROUNDS = 1024, 60
HEAD = (
    "",
    "fused",
    "`vmap(diffeqsolve)`",
    "in C",
    "fused, float32",
    "ratio, 16,384 paths",
    "first calls: fused, JAX",
)


def kubo(t, p, q, args):
    return (p**2 + q**2) / 2 + (p**4 + q**4) / 10


def kubo_noise(t, p, q, args):
    return 0.3 * kubo(t, p, q, args)


def pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


def push(t, p, q, args):
    return 0.2 * jnp.sin(q)


def chain(t, p, q, args):
    bonds = jnp.sum((q[1:] - q[:-1]) ** 4) / 8
    return jnp.sum(p**2 + q**2) / 2 + bonds + jnp.sum(q**4) / 8


def kicks(t, p, q, args):
    return 0.2 * q


def field(t, s, args):
    return s[2] + jnp.sum(s**2 * jnp.array([1.0, 0.5, 0.0]))


def shake(t, s, args):
    return 0.2 * s[0]


class Case(NamedTuple):
    """`make` takes a path to the terms of the system."""

    make: Callable
    solver: diffrax.AbstractSolver
    y0: Any
    h: float
    shape: tuple[int, ...] = ()
    path: Callable = ds.WeakBrownianPath

    def new_path(self, key, dtype=jnp.float64):
        return self.path(jax.ShapeDtypeStruct(self.shape, dtype), key)

    def terms(self, key, dtype):
        return self.make(self.new_path(key, dtype))

    def start(self, dtype):
        return jax.tree.map(lambda x: jnp.asarray(x, dtype), self.y0)


ONE = (0.0, 1.0)
line = lambda d: (jnp.linspace(-0.5, 0.5, d), jnp.linspace(0.3, 1.0, d))
of = lambda H0, noise: lambda path: ds.hamiltonian_terms(H0, noise, path)
warm = lambda H0: lambda path: ds.langevin_terms(H0, 0.5, 1.0, path)
midpoint = lambda h: Case(of(kubo, kubo_noise), ds.ImplicitMidpoint(), ONE, h)
CASES = {
    "pendulum, `StormerVerlet`": Case(
        of(pendulum, push), ds.StormerVerlet(), ONE, 0.02
    ),
    "pendulum, `BAOAB`": Case(warm(pendulum), ds.BAOAB(), ONE, 0.02),
    **{f"Kubo, `ImplicitMidpoint`, h = {h}": midpoint(h) for h in (0.01, 0.4)},
    "Kubo, `StrangGauss`, h = 0.1": Case(
        of(kubo, kubo_noise), ds.StrangGauss(), ONE, 0.1
    ),
    "rigid body, `ImplicitMidpoint`, h = 0.1": Case(
        rigid_body.make_terms, ds.ImplicitMidpoint(), rigid_body.X0, 0.1
    ),
    "spin, `ImplicitMidpoint`, h = 0.1": Case(
        lambda path: ds.spin_terms(field, shake, path),
        ds.ImplicitMidpoint(),
        ds.to_spinors(jnp.array([0.6, 0.0, 0.8])),
        0.1,
    ),
    "pendulum, Diffrax's `Heun`, `UnsafeBrownianPath`": Case(
        of(pendulum, push), diffrax.Heun(), ONE, 0.02, path=diffrax.UnsafeBrownianPath
    ),
    **{
        f"chain of {d}, `StormerVerlet`": Case(
            of(chain, kicks), ds.StormerVerlet(), line(d), 0.02, (d,)
        )
        for d in (16, 64)
    },
}


def by_drjit(case: Case, n: int, steps: int, dtype) -> Callable:
    """Takes the steps, with the parts that `ensemble` is made of."""
    import drjit

    y0, terms = case.start(dtype), case.terms(jr.key(0), dtype)
    given = terms, case.solver, 0.0, steps * case.h, case.h, y0, None, None, 1
    problem = Problem.of(state_itself, *given)
    numbers = np.arange(n, dtype=np.uint64)
    kernels, lanes, shared = fused_start(problem, jr.key(1), numbers)

    def run():
        drjit.eval(kernels.advance(lanes, shared, 0, steps))
        drjit.sync_thread()

    return run


def by_jax(case: Case, n: int, steps: int) -> Callable:
    y0, own = case.start(jnp.float64), keys(n)
    batch = jax.jit(ensemble(case.make, case.new_path, case.solver, y0, case.h, steps))
    return lambda: batch(own)


def nanoseconds(case: Case, n: int, steps: int, single: bool = True) -> list[float]:
    """A path and step takes: fused, by `vmap(diffeqsolve)`, and fused in float32."""
    runs = {
        "fused": by_drjit(case, n, steps, jnp.float64),
        "jax": by_jax(case, n, steps),
    }
    if single:
        runs["float32"] = by_drjit(case, n, steps, jnp.float32)
    best = race(runs, ROUNDS)
    return [best[name] * 1e9 / (n * steps) for name in runs]


def first_call(case: Case, engine: str, steps: int = 100) -> float:
    """Seconds of the first call of `ensemble`, less those of the second."""
    y0, terms, seconds = case.start(jnp.float64), case.terms(jr.key(0), jnp.float64), []
    for _ in range(2):
        begin = time.perf_counter()
        ds.ensemble(
            terms,
            case.solver,
            0.0,
            steps * case.h,
            case.h,
            y0,
            key=jr.key(1),
            num_paths=FEW,
            engine=engine,
        )
        seconds.append(time.perf_counter() - begin)
    return seconds[0] - seconds[1]


def by_c() -> Callable[[int], dict[float, float]]:
    """From a number of paths to the nanoseconds of a program in C, for its step sizes."""
    source, binary = (
        Path(__file__).with_name("midpoint.c"),
        tempfile.mkdtemp() + "/midpoint",
    )
    flags = "-O3", "-march=native", "-ffast-math", "-fopenmp"
    subprocess.run(["gcc", *flags, str(source), "-o", binary, "-lm"], check=True)

    def run(n: int) -> dict[float, float]:
        lines = subprocess.run([binary, str(n), "200"], capture_output=True, text=True)
        found = re.findall(r"h = ([\d.]+): ([\d.]+) ns", lines.stdout)
        return {float(h): float(ns) for h, ns in found}

    return run


def main() -> None:
    in_c = by_c()(FEW)
    first_call(midpoint(0.1), "drjit")  # starts LLVM
    rows = []
    for name, case in CASES.items():
        first = [first_call(case, engine) for engine in ("drjit", "jax")]
        fused, jax_ns, single = nanoseconds(case, FEW, 20 if "of 64" in name else 100)
        many, jax_many = nanoseconds(case, 16 * FEW, 10, False)
        rows.append(
            (
                name,
                f"{fused:.1f}",
                f"{jax_ns:.0f}",
                f"{in_c[case.h]:.1f}" if name.startswith("Kubo, `Impl") else "",
                f"{single:.1f}",
                f"{jax_many / many:.1f}",
                f"{first[0]:.1f}, {first[1]:.1f} s",
            )
        )
    lines = [
        f"Nanoseconds per path and step for {FEW:,} paths in float64; only steps are "
        f"timed ({machine()}). The program in C uses a cheap hash instead of JAX's random "
        "numbers.",
        "",
        *table(HEAD, rows),
    ]
    write("examples.benchmarks.fused", lines, DOCS.parent / "ensembles.md")


if __name__ == "__main__":
    main()
