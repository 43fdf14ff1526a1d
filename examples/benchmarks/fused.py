"""Ensembles by one fused kernel, next to JAX and to a program in C:

    pip install '.[fused,examples]' && python -m examples.benchmarks.fused

Prints the table of `docs/ensembles.md` and draws its picture. Only steps are timed: a call
of `ensemble` takes some ten milliseconds more to check its arguments. All take turns, in
many short runs, and the best run of each counts, so that it matters less what else the
machine does.
"""

import re
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt

import diffrax_symplectic as ds
from diffrax_symplectic._ensemble._engines import state_itself
from diffrax_symplectic._ensemble._kernels import Kernels
from diffrax_symplectic._ensemble._layout import split
from diffrax_symplectic._expectation._steps import Problem

from ._timing import ensemble, keys, machine, race


IMAGE = Path(__file__).parents[2] / "docs" / "img" / "ensembles.png"
FEW, ROUNDS = 1024, 60


def kubo(t, p, q, args):
    return (p**2 + q**2) / 2 + (p**4 + q**4) / 10


def kubo_noise(t, p, q, args):
    return 0.3 * kubo(t, p, q, args)


def pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


def push(t, p, q, args):
    return 0.2 * jnp.sin(q)


def henon_heiles(t, p, q, args):
    return jnp.sum(p**2 + q**2) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def turn(t, p, q, args):
    return 0.1 * jnp.sum(p * q)


def chain(t, p, q, args):
    bonds = jnp.sum((q[1:] - q[:-1]) ** 4) / 8
    return jnp.sum(p**2 + q**2) / 2 + bonds + jnp.sum(q**4) / 8


def kicks(t, p, q, args):
    return 0.2 * q


class Case(NamedTuple):
    H0: Callable
    noise: Callable
    solver: diffrax.AbstractSolver
    y0: Any
    h: float
    shape: tuple[int, ...] = ()
    path: Callable | None = None

    def terms(self, key, dtype):
        shape = jax.ShapeDtypeStruct(self.shape, dtype)
        path = self.path or ds.WeakBrownianPath
        return ds.hamiltonian_terms(self.H0, self.noise, path(shape, key))

    def start(self, dtype):
        return jax.tree.map(lambda x: jnp.asarray(x, dtype), self.y0)


ONE, TWO = (0.0, 1.0), (jnp.array([0.2, 0.1]), jnp.array([0.0, -0.15]))
line = lambda d: (jnp.linspace(-0.5, 0.5, d), jnp.linspace(0.3, 1.0, d))
midpoint = lambda h: Case(kubo, kubo_noise, ds.ImplicitMidpoint(), ONE, h)
CASES = {
    "pendulum, `StormerVerlet`": Case(pendulum, push, ds.StormerVerlet(), ONE, 0.02),
    "oscillators, `BAOAB`": Case(pendulum, kicks, ds.BAOAB(0.5), ONE, 0.02),
    **{f"Kubo, `ImplicitMidpoint`, h = {h}": midpoint(h) for h in (0.01, 0.2, 0.4)},
    "Kubo, `StrangGauss`, h = 0.1": Case(kubo, kubo_noise, ds.StrangGauss(), ONE, 0.1),
    "Henon-Heiles, `ImplicitMidpoint`, h = 0.1": Case(
        henon_heiles, turn, ds.ImplicitMidpoint(), TWO, 0.1
    ),
    "pendulum, Diffrax's `Heun`, `UnsafeBrownianPath`": Case(
        pendulum, push, diffrax.Heun(), ONE, 0.02, path=diffrax.UnsafeBrownianPath
    ),
    **{
        f"chain of {d}, `StormerVerlet`": Case(
            chain, kicks, ds.StormerVerlet(), line(d), 0.02, (d,)
        )
        for d in (4, 16, 64)
    },
}


def by_drjit(case: Case, n: int, steps: int, dtype) -> Callable:
    """Takes the steps, with the parts that `ensemble` is made of."""
    import drjit

    y0, terms = case.start(dtype), case.terms(jr.key(0), dtype)
    given = terms, case.solver, 0.0, steps * case.h, case.h, y0, None, None, 1
    problem = Problem.of(state_itself, *given)
    layout, arrays = split(problem, jr.key(1))
    kernels = Kernels(layout)
    h = problem.level(0).h
    start, parameters = kernels.begin(arrays, jr.key(1), h, 0, n)

    def run():
        drjit.eval(kernels.advance(start, parameters, 0, steps))
        drjit.sync_thread()

    return run


def by_jax(case: Case, n: int, steps: int) -> Callable:
    make = lambda path: ds.hamiltonian_terms(case.H0, case.noise, path)
    path = lambda key: case.terms(key, jnp.float64).terms[1].path
    y0, own = case.start(jnp.float64), keys(n)
    batch = jax.jit(ensemble(make, path, case.solver, y0, case.h, steps))
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
    print(f"{machine()}. float64, nanoseconds a path and step, {FEW:,} paths.\n")
    c = by_c()
    in_c = c(FEW)
    print("| | fused | `vmap(diffeqsolve)` | ratio | in C | fused, float32 |")
    print("|---|---|---|---|---|---|")
    for name, case in CASES.items():
        fused, jax_ns, single = nanoseconds(case, FEW, 20 if "of 64" in name else 100)
        own = isinstance(case.solver, ds.ImplicitMidpoint) and case.H0 is kubo
        shown = f"{in_c[case.h]:.1f}" if own else ""
        print(
            f"| {name} | {fused:.1f} | {jax_ns:.0f} | {jax_ns / fused:.1f} | {shown} | "
            f"{single:.1f} |",
            flush=True,
        )
    draw(c)


def draw(c: Callable) -> None:
    numbers = [2**k for k in (6, 10, 14)]
    steps = [max(10, 2**16 // n) for n in numbers]
    rows = [nanoseconds(midpoint(0.01), n, k, False) for n, k in zip(numbers, steps)]
    in_c = [c(n)[0.01] for n in numbers]
    fig, ax = plt.subplots(figsize=(5, 3.2), layout="constrained")
    ax.loglog(numbers, [b for _, b in rows], "o-", label="vmap(diffeqsolve)")
    ax.loglog(numbers, [a for a, _ in rows], "s-", label="fused")
    ax.loglog(numbers, in_c, "^--", label="in C")
    ax.set(xlabel="paths", ylabel="nanoseconds a path and step", ylim=(1, None))
    ax.legend(frameon=False, fontsize=8)
    fig.savefig(IMAGE, dpi=150)
    for n, (a, b), own in zip(numbers, rows, in_c):
        print(f"{n} paths: fused {a:.1f}, vmap {b:.1f}, C {own:.1f}", flush=True)


if __name__ == "__main__":
    main()
