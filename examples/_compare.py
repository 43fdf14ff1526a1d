"""What the examples share: solve one model by several solvers, and tell of it."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import diffrax
import jax
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds


# Invariants are conserved to rounding error; let that be the one of double precision.
jax.config.update("jax_enable_x64", True)

OUTPUT = Path(__file__).parent / "output"

# Each with the increments it is meant for.
SOLVERS = {
    "Midpoint": (ds.Midpoint(), "truncated"),
    "SRKs1": (ds.SRKs1(), "truncated"),
    "SRKw1": (ds.SRKw1(), "weak"),
    "SRKw2": (ds.SRKw2(), "weak"),
    "Heun": (diffrax.Heun(), "Gaussian"),
    "StratonovichMilstein": (diffrax.StratonovichMilstein(), "Gaussian"),
}


def make_path(kind: str, key) -> diffrax.AbstractBrownianPath:
    """One noise. The symplectic strong methods need bounded increments, weak ones come
    with their own."""
    if kind == "weak":
        return ds.WeakBrownianPath((), key)
    gaussian = diffrax.UnsafeBrownianPath((), key)
    return gaussian if kind == "Gaussian" else ds.TruncatedBrownianPath(gaussian, k=2)


COLOURS = {name: f"C{i}" for i, name in enumerate(SOLVERS)}


class Run(NamedTuple):
    ts: np.ndarray
    ys: np.ndarray
    # |invariant / its first value - 1| at each of `ts`
    drift: np.ndarray
    seconds: float
    failed_steps: int


def run(
    make_terms: Callable,
    invariant: Callable,
    y0,
    h: float,
    steps: int,
    solver: diffrax.AbstractSolver,
    kind: str,
    seed: int = 0,
) -> Run:
    """One path, kept every hundredth step. The time does not include compilation."""

    @jax.jit
    def solve(key):
        return diffrax.diffeqsolve(
            make_terms(make_path(kind, key)),
            solver,
            0.0,
            h * steps,
            h,
            y0,
            saveat=diffrax.SaveAt(t0=True, steps=100),
            max_steps=steps,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )

    key = jr.key(seed)
    compiled = solve.lower(key).compile()
    start = time.perf_counter()
    sol = jax.block_until_ready(compiled(key))
    seconds = time.perf_counter() - start
    values = jax.vmap(invariant)(sol.ys)
    drift = np.abs(np.asarray(values / invariant(y0) - 1))
    failed = int(sol.result != diffrax.RESULTS.successful)
    ys = np.stack(jax.tree.leaves(sol.ys), axis=-1).reshape(len(drift), -1)
    assert sol.ts is not None
    return Run(np.asarray(sol.ts), ys, drift, seconds, failed)


def compare(title: str, make_terms, invariant, y0, h: float, steps: int) -> dict:
    """Runs all of `SOLVERS`, printing a line as each is done."""
    print(f"\n{title}: {steps:,} steps of h = {h}", flush=True)
    print(f"{'solver':22}{'increments':>12}{'drift':>10}{'seconds':>9}{'failed':>8}")
    runs = {}
    for i, (name, (solver, kind)) in enumerate(SOLVERS.items()):
        if sys.stdout.isatty():
            print(f"  [{i + 1}/{len(SOLVERS)}] {name} ...", end="\r", flush=True)
        runs[name] = r = run(make_terms, invariant, y0, h, steps, solver, kind)
        worst = np.max(r.drift) if np.all(np.isfinite(r.drift)) else np.inf
        print(
            f"{name:22}{kind:>12}{worst:>10.1e}{r.seconds:>9.2f}{r.failed_steps:>8}",
            flush=True,
        )
    return runs


def plot_drift(axes, runs: dict) -> None:
    """Relative drift of the invariant against time, on logarithmic axes."""
    for name, r in runs.items():
        ours = isinstance(SOLVERS[name][0], ds.AbstractSymplecticRungeKutta)
        style = dict(color=COLOURS[name], ls="-" if ours else "--", lw=1)
        axes.loglog(r.ts[1:], np.maximum(r.drift[1:], 1e-17), label=name, **style)
    axes.set_xlabel("time")
    axes.set_ylabel("relative drift of the invariant")
    axes.set_ylim(1e-17, 1e3)
    axes.legend(fontsize=7, loc="center left")
    axes.grid(alpha=0.3)


def save(figure, name: str) -> None:
    OUTPUT.mkdir(exist_ok=True)
    figure.tight_layout()
    figure.savefig(OUTPUT / name, dpi=130)
    print(f"picture: {OUTPUT / name}", flush=True)
