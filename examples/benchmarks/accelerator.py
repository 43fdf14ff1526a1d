"""Speed, growth and a large ensemble on an accelerator, in float32 and float64:

    python -m examples.benchmarks.accelerator

Writes `docs/benchmarks/accelerator.md`. Runs on CPUs, too, where `--quick` is advised.
"""

import sys
import time
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds

from . import growth
from ._timing import DOCS, ensemble, keys, machine, measure
from .speed import additive, kubo, synchrotron


H, STEPS = 0.01, 100


def struct(shape, dtype):
    return jax.ShapeDtypeStruct(shape, dtype)


def weak(shape=(), **kwargs):
    return lambda dtype: (
        lambda key: ds.WeakBrownianPath(struct(shape, dtype), key, **kwargs)
    )


def gaussian(shape=(), area: Any = diffrax.BrownianIncrement):
    return lambda dtype: (
        lambda key: diffrax.UnsafeBrownianPath(struct(shape, dtype), key, area)
    )


SOLVERS = [
    ("Kubo", "Diffrax Heun", kubo, diffrax.Heun(), gaussian()),
    ("Kubo", "ImplicitMidpoint", kubo, ds.ImplicitMidpoint(), weak()),
    ("Kubo", "StrangGauss", kubo, ds.StrangGauss(), weak()),
    ("synchrotron", "Diffrax Heun", synchrotron, diffrax.Heun(), gaussian((2,))),
    ("synchrotron", "SRKw4", synchrotron, ds.SRKw4(), weak((2,))),
    ("synchrotron", "StormerVerlet", synchrotron, ds.StormerVerlet(), weak((2,))),
    ("additive", "Diffrax ShARK", additive, diffrax.ShARK(),
     gaussian((), diffrax.SpaceTimeLevyArea)),
    ("additive", "AdditiveGauss", additive, ds.AdditiveGauss(), weak(order=3)),
]  # fmt: skip


def speed(sizes, dtypes):
    yield "## Speed"
    yield ""
    yield (
        f"h = {H}, {STEPS} steps. The time of a step of one path is the floor that "
        "launches of kernels set; the last columns are what many paths cost."
    )
    yield ""
    heads = [f"ns, {n:,} paths" for n in sizes[1:]]
    yield "| model | solver | dtype | µs a step, 1 path | " + " | ".join(heads) + " |"
    yield "|---" * (4 + len(heads)) + "|"
    for model, name, make_terms, solver, path in SOLVERS:
        for dtype in dtypes:
            y0 = (jnp.array(0.0, dtype), jnp.array(1.0, dtype))
            t = jnp.asarray(H, dtype)
            cells = []
            for n in sizes:
                fn = ensemble(make_terms, path(dtype), solver, y0, t, STEPS)
                seconds = measure(fn, keys(n), repeats=3).seconds
                scale = 1e6 if n == 1 else 1e9 / n
                cells.append(f"{seconds / STEPS * scale:.3g}")
            yield f"| {model} | {name} | {dtype.__name__} | " + " | ".join(cells) + " |"


def growing(sizes, dtypes, paths: int):
    yield ""
    yield "## Growth"
    yield ""
    yield (
        f"A chain of d oscillators with quartic springs, one noise, {paths} paths, 50 "
        "steps: nanoseconds a path, step and degree of freedom."
    )
    yield ""
    yield "| d | dtype | Diffrax Heun | ImplicitMidpoint | ImplicitMidpoint to Heun |"
    yield "|---" * 5 + "|"
    for d in sizes:
        for dtype in dtypes:
            y0 = (jnp.zeros(d, dtype), jnp.sin(jnp.arange(d) + 1.0).astype(dtype))
            t = jnp.asarray(H, dtype)
            times = []
            for solver, path in (
                (diffrax.Heun(), gaussian((1,))),
                (ds.ImplicitMidpoint(), weak((1,))),
            ):
                fn = ensemble(growth.chain, path(dtype), solver, y0, t, 50)
                seconds = measure(fn, keys(paths), repeats=3).seconds
                times.append(seconds / paths / 50 / d * 1e9)
            heun, midpoint = times
            yield (
                f"| {d} | {dtype.__name__} | {heun:.3g} | {midpoint:.3g} | "
                f"{midpoint / heun:.2f} |"
            )


def large(num_paths: int, batch_sizes, dtypes):
    yield ""
    yield "## A large ensemble"
    yield ""
    yield (
        f"`monte_carlo` of q^2 over {num_paths:,} paths of {STEPS} steps, "
        "ImplicitMidpoint on the quartic Kubo oscillator, by batch size."
    )
    yield ""
    yield "| dtype | batch size | seconds | ps a path and step | E(q^2) |"
    yield "|---" * 5 + "|"
    for dtype in dtypes:
        y0 = (jnp.array(0.0, dtype), jnp.array(1.0, dtype))
        t = jnp.asarray(H, dtype)
        solve = ensemble(kubo, weak()(dtype), ds.ImplicitMidpoint(), y0, t, STEPS)

        def phi(key):
            _, q = solve(key[None])
            return q[-1] ** 2

        for batch_size in batch_sizes:
            ds.monte_carlo(
                phi, key=jr.key(1), num_paths=batch_size, batch_size=batch_size
            )
            begin = time.perf_counter()
            estimate = ds.monte_carlo(
                phi, key=jr.key(0), num_paths=num_paths, batch_size=batch_size
            )
            seconds = time.perf_counter() - begin
            yield (
                f"| {dtype.__name__} | {batch_size:,} | {seconds:.3f} | "
                f"{seconds / num_paths / STEPS * 1e12:.1f} | {estimate.mean:.6f} ± "
                f"{estimate.std_error:.6f} |"
            )


def main(quick: bool) -> None:
    dtypes = (jnp.float32, jnp.float64)
    if quick:
        parts = (
            speed((1, 100), dtypes),
            growing((1, 4), dtypes, 16),
            large(10_000, (5_000, 10_000), dtypes),
        )
    else:
        parts = (
            speed((1, 10_000, 1_000_000, 10_000_000), dtypes),
            growing((1, 4, 16, 64, 256, 1024), dtypes, 1024),
            large(10_000_000, (2**16, 2**18, 2**20, 2**22), dtypes),
        )
    lines = [
        "# On an accelerator",
        "",
        f"{machine()}. One process, best of 3 runs, compilation aside. Made by `python -m "
        "examples.benchmarks.accelerator`.",
        "",
    ]
    for part in parts:
        for line in part:
            print(line, flush=True)
            lines.append(line)
    if not quick:
        DOCS.mkdir(parents=True, exist_ok=True)
        (DOCS / "accelerator.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main("--quick" in sys.argv)
