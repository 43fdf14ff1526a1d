"""The pictures of README and of the first page of the documentation:

    python -m examples.readme

A noisy oscillator in phase space by a symplectic and an explicit method; and the total
error of an expectation against the seconds to it, compilation aside. What is drawn in the
second is kept in `docs/img/first.csv`.
"""

import csv
import time
from collections.abc import Callable
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np

import diffrax_symplectic as ds


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402


jax.config.update("jax_enable_x64", True)

IMG = Path(__file__).parent.parent / "docs" / "img"
H, STEPS = 0.1, 2000
# The expectation: q^2 at the time T in a double well, from (p, q) = (0, 1).
T, REPEATS = 2.0, 8
Y0 = (jnp.array(0.0), jnp.array(1.0))
PLAIN, VALUES = "`StormerVerlet`, independent paths", "`ValueFunctions`, 4 levels"
HEUN, RQMC = "Diffrax's `Heun`, independent paths", "`ArrayRQMC`, 2 levels"


def portrait(solver) -> np.ndarray:
    """A Kubo oscillator, whose exact solution stays on the unit circle."""
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: 0.5 * energy(t, p, q, args)
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(energy, noise, path)
    y0 = (jnp.array(0.0), jnp.array(1.0))
    sol = jax.jit(
        lambda: (
            diffrax.diffeqsolve(
                terms,
                solver,
                0,
                H * STEPS,
                H,
                y0,
                saveat=diffrax.SaveAt(steps=True),
                max_steps=STEPS + 1,
                adjoint=diffrax.ForwardMode(),
            ).ys
        )
    )()
    points = np.stack(sol)
    return points[:, np.all(np.abs(points) < 1e3, axis=0)]


def double_well(path) -> diffrax.MultiTerm:
    return ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2 + q**4 / 4 - q**2 / 2,
        lambda t, p, q, args: 0.3 * jnp.sin(q),
        path,
    )


def square(t, y, args):
    return y[1] ** 2


def expectation(path, solver, steps: int, sampling, levels: int = 1) -> Callable:
    """A function from a key to an estimate."""
    terms = double_well(path)  # once: other functions are compiled anew
    return lambda key: (
        ds.expectation(
            square,
            terms,
            solver,
            0.0,
            T,
            T / steps,
            Y0,
            key=key,
            sampling=sampling,
            levels=levels,
        ).mean
    )


def estimates() -> list[tuple[str, int, Callable]]:
    """What is drawn: a name, the number of paths, and an estimate of each key. Independent
    paths have as few steps as leave the bias below the error of sampling."""
    weak = ds.WeakBrownianPath((), jr.key(0))
    fixed = ds.FixedStepBrownianPath((), jr.key(0))
    unsafe = diffrax.UnsafeBrownianPath((), jr.key(0))
    verlet, out = ds.StormerVerlet(), []
    for n, steps in ((2**10, 20), (2**13, 40), (2**16, 80), (2**19, 160)):
        independent = ds.IndependentPaths(n)
        out.append((HEUN, n, expectation(unsafe, diffrax.Heun(), steps, independent)))
        out.append((PLAIN, n, expectation(weak, verlet, steps // 4 + 5, independent)))
    for n in (2**8, 2**10, 2**12, 2**14):
        rqmc = ds.ArrayRQMC(n, replicates=8)
        out.append((RQMC, 8 * n, expectation(fixed, verlet, 20, rqmc, 2)))
    for degree, n in ((4, 2**10), (6, 2**11), (8, 2**12), (8, 2**14)):
        values = ds.ValueFunctions(degree=degree, num_paths=n)
        out.append((VALUES, n, expectation(weak, verlet, 20, values, 4)))
    return out


def exact() -> float:
    """With shorter steps and more paths than all that is drawn."""
    weak = ds.WeakBrownianPath((), jr.key(0))
    values = ds.ValueFunctions(degree=8, num_paths=2**16)
    return float(expectation(weak, ds.StormerVerlet(), 32, values, 4)(jr.key(100)))


def measured() -> list[tuple[str, int, float, float]]:
    """Of each: its name, the paths, the root mean square error of several estimates, and
    the seconds of the quickest. They take turns."""
    value, out = exact(), []
    for name, n, estimate in estimates():
        estimate(jr.key(0))  # compiles
        means, seconds = [], []
        for i in range(REPEATS):
            begin = time.perf_counter()
            means.append(float(estimate(jr.key(1 + i))))
            seconds.append(time.perf_counter() - begin)
        error = np.sqrt(np.mean((np.array(means) - value) ** 2))
        out.append((name, n, float(error), min(seconds)))
        print(*out[-1], flush=True)
    return out


def draw_portrait(ax) -> None:
    for name, solver, colour in (
        ("Heun", diffrax.Heun(), "C1"),
        ("ImplicitMidpoint", ds.ImplicitMidpoint(), "C0"),
    ):
        p, q = portrait(solver)
        near = np.hypot(p, q) < 2.2
        ax.plot(q[near], p[near], ".", ms=2, color=colour, label=name)
    ax.set(xlabel="q", ylabel="p", title=f"a noisy oscillator to t = {H * STEPS:g}")
    ax.set(xlim=(-2.3, 2.3), ylim=(-2.3, 2.9), aspect="equal")
    ax.legend(loc="upper center", ncols=2, markerscale=4, frameon=False)


def draw_errors(ax, rows) -> None:
    styles = {HEUN: "C1o--", PLAIN: "C4o--", RQMC: "C2o-", VALUES: "C0o-"}
    for name, style in styles.items():
        points = [(seconds, error) for x, _, error, seconds in rows if x == name]
        ax.plot(*zip(*points), style, label=name.replace("`", ""))
    ax.set(xscale="log", yscale="log", title="a mean in a double well")
    ax.set(xlabel="seconds", ylabel="total error")
    ax.legend(loc="lower left", fontsize=8, frameon=False)
    ax.grid(alpha=0.3)


def main() -> None:
    rows = measured()
    with (IMG / "first.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("estimate", "paths", "total error", "seconds"))
        for name, n, error, seconds in rows:
            writer.writerow((name, n, f"{error:.1e}", f"{seconds:.2g}"))
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9, 3.8), layout="constrained", width_ratios=(1, 1.3)
    )
    draw_portrait(left)
    draw_errors(right, rows)
    figure.savefig(IMG / "first.png", dpi=110)


if __name__ == "__main__":
    main()
