"""Ensembles by one fused kernel, next to JAX and to a program in C:

    pip install '.[fused,examples]' && python -m examples.benchmarks.fused

Prints the table of `docs/ensembles.md` and draws its picture. What a call costs in any
case is left out: nanoseconds are those of the steps that a longer call takes more.
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

from ._timing import ensemble as by_diffeqsolve, keys, machine, race


IMAGE = Path(__file__).parents[2] / "docs" / "img" / "ensembles.png"
FEW, SHARE = 1024, 8  # A long call takes eight times as many steps as a short one.


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
    return 0.2 * jnp.sum(p * q)


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


def calls(case: Case, n: int, steps: int, dtype=jnp.float64) -> dict[str, Callable]:
    """Short and long calls, by Dr.Jit and by `diffeqsolve`."""
    y0, terms = case.start(dtype), case.terms(jr.key(0), dtype)
    out = {}
    for name, k in (("short", steps), ("long", SHARE * steps)):
        t1 = k * case.h
        out[f"fused {name}"] = lambda t1=t1: (
            ds.ensemble(
                terms, case.solver, 0.0, t1, case.h, y0,
                key=jr.key(1), num_paths=n, engine="drjit",
            ).ys
        )  # fmt: skip
        make = lambda path: ds.hamiltonian_terms(case.H0, case.noise, path)
        path = lambda key: case.terms(key, dtype).terms[1].path
        batch = jax.jit(by_diffeqsolve(make, path, case.solver, y0, case.h, k))
        own = keys(n)
        out[f"jax {name}"] = lambda batch=batch: batch(own)
    return out


def nanoseconds(case: Case, n: int, steps: int, dtype=jnp.float64, rounds: int = 4):
    """A path and step takes: fused, and by `vmap(diffeqsolve)`."""
    best = race(calls(case, n, steps, dtype), rounds)
    each = 1e9 / (n * steps * (SHARE - 1))
    long = lambda name: each * (best[f"{name} long"] - best[f"{name} short"])
    return long("fused"), long("jax")


def by_c() -> Callable[[int], dict[float, float]]:
    """From a number of paths to the nanoseconds of a program in C, for its step sizes."""
    source, binary = (
        Path(__file__).with_name("midpoint.c"),
        tempfile.mkdtemp() + "/midpoint",
    )
    flags = "-O3", "-march=native", "-ffast-math", "-fopenmp"
    subprocess.run(["gcc", *flags, str(source), "-o", binary, "-lm"], check=True)

    def run(n: int) -> dict[float, float]:
        lines = subprocess.run([binary, str(n), "1000"], capture_output=True, text=True)
        found = re.findall(r"h = ([\d.]+): ([\d.]+) ns", lines.stdout)
        return {float(h): float(ns) for h, ns in found}

    return run


def main() -> None:
    print(f"{machine()}. float64, nanoseconds a path and step, {FEW:,} paths.\n")
    c = by_c()
    in_c = c(FEW)
    print("| | fused | `vmap(diffeqsolve)` | ratio | in C | float32, fused |")
    print("|---|---|---|---|---|---|")
    for name, case in CASES.items():
        steps = 20 if "chain of 64" in name else 100
        fused, jax_ns = nanoseconds(case, FEW, steps)
        single, _ = nanoseconds(case, FEW, steps, jnp.float32, rounds=2)
        own = f"{in_c[case.h]:.1f}" if case.H0 is kubo and case.h in in_c else ""
        own = own if isinstance(case.solver, ds.ImplicitMidpoint) else ""
        print(
            f"| {name} | {fused:.1f} | {jax_ns:.0f} | {jax_ns / fused:.1f} | {own} | "
            f"{single:.1f} |",
            flush=True,
        )
    draw(c)


def draw(c: Callable) -> None:
    numbers = [2**k for k in (6, 8, 10, 12, 14, 16)]
    rows = [nanoseconds(midpoint(0.01), n, max(4, 2**16 // n)) for n in numbers]
    fig, ax = plt.subplots(figsize=(5, 3.2), layout="constrained")
    ax.loglog(numbers, [b for _, b in rows], "o-", label="vmap(diffeqsolve)")
    ax.loglog(
        numbers, [a for a, _ in rows], "s-", label='ensemble(..., engine="drjit")'
    )
    ax.loglog(numbers, [c(n)[0.01] for n in numbers], "^--", label="a program in C")
    ax.set(xlabel="paths", ylabel="nanoseconds a path and step", ylim=(1, None))
    ax.legend(frameon=False, fontsize=8)
    fig.savefig(IMAGE, dpi=150)
    for n, (a, b) in zip(numbers, rows):
        print(f"{n} paths: fused {a:.1f}, vmap {b:.1f}, C {c(n)[0.01]:.1f}", flush=True)


if __name__ == "__main__":
    main()
