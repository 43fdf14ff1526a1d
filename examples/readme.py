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
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import RectBivariateSpline

import diffrax_symplectic as ds

from ._pictures import colour, style, WIDTH


jax.config.update("jax_enable_x64", True)

IMG = Path(__file__).parent.parent / "docs" / "img"
H, STEPS = 0.1, 2000
# The expectation: q^2 at the time T in a double well, from (p, q) = (0, 1).
T, REPEATS = 2.0, 8
Y0 = (jnp.array(0.0), jnp.array(1.0))
HEUN = "Diffrax's `Heun`, independent paths"
PLAIN = "`StormerVerlet`, independent paths"
DEFAULT = "`StormerVerlet`, `expectation` with its defaults"


def portrait(solver) -> np.ndarray:
    """A Kubo oscillator, whose exact solution stays on the unit circle."""
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: 0.5 * energy(t, p, q, args)
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(energy, noise, path)
    options: dict[str, Any] = dict(max_steps=STEPS + 1, adjoint=diffrax.ForwardMode())
    options["saveat"] = diffrax.SaveAt(steps=True)
    end = H * STEPS
    solve = lambda: diffrax.diffeqsolve(terms, solver, 0, end, H, Y0, **options).ys
    points = np.stack(jax.jit(solve)())
    return points[:, np.all(np.abs(points) < 1e3, axis=0)]


def double_well(path) -> diffrax.MultiTerm:
    return ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2 + q**4 / 4 - q**2 / 2,
        lambda t, p, q, args: 0.3 * jnp.sin(q),
        path,
    )


def square(t, y, args):
    return y[1] ** 2


def expectation(path, solver, steps: int, **options) -> Callable:
    """A function from a key to an estimate."""
    terms = double_well(path)  # once: other functions are compiled anew
    return lambda key: (
        ds.expectation(
            square, terms, solver, 0.0, T, T / steps, Y0, key=key, **options
        ).mean
    )


def estimates() -> list[tuple[str, int, Callable]]:
    """What is drawn: a name, the number of steps, and an estimate of each key. Independent
    paths of both solvers have as few steps as leave the bias below the error of
    sampling."""
    unsafe = diffrax.UnsafeBrownianPath((), jr.key(0))
    verlet = ds.StormerVerlet()
    out = []
    for n, steps in ((2**10, 20), (2**13, 40), (2**16, 80), (2**19, 160)):
        options = dict(sampling=ds.IndependentPaths(n), levels=1)
        out.append((HEUN, steps, expectation(unsafe, diffrax.Heun(), steps, **options)))
        out.append((PLAIN, steps, expectation((), verlet, steps, **options)))
    for steps in (10, 20, 40, 80):
        out.append((DEFAULT, steps, expectation((), verlet, steps)))
    return out


def exact() -> float:
    """The mean by quadrature, to ten digits: the expected end from each point of a grid,
    step by step backward, with Verlet steps and a quintic spline between the points, then
    extrapolated to steps of size zero. Nothing of this package is used."""
    q = np.linspace(-3.5, 3.5, 281)
    p = np.linspace(-5.0, 5.0, 281)
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    weights = weights / weights.sum()

    def mean(steps: int) -> float:
        h = T / steps
        P, Q = np.meshgrid(p, q, indexing="ij")
        middle = Q + h / 2 * P
        ends = []
        for z in nodes:
            kick = h * (middle - middle**3) - 0.3 * h**0.5 * z * np.cos(middle)
            # Paths that leave the grid are too rare to count.
            p1 = np.clip(P + kick, p[0], p[-1])
            ends.append((p1, np.clip(middle + h / 2 * p1, q[0], q[-1])))
        u = Q**2
        for _ in range(steps):
            spline = RectBivariateSpline(p, q, u, kx=5, ky=5)
            u = sum(w * spline.ev(*end) for w, end in zip(weights, ends))
        return float(RectBivariateSpline(p, q, u, kx=5, ky=5)(0.0, 1.0)[0, 0])

    # The error has even powers of the step.
    table = [mean(steps) for steps in (10, 20, 40, 80)]
    for order in (2, 4, 6):
        pairs = zip(table[:-1], table[1:])
        table = [fine + (fine - coarse) / (2**order - 1) for coarse, fine in pairs]
        print("reference", *table, flush=True)
    return table[0]


def measured() -> list[tuple[str, int, float, float]]:
    """Of each: its name, the steps, the root mean square error of several estimates, and
    the seconds of the quickest. They take turns."""
    value, out = exact(), []
    for name, steps, estimate in estimates():
        estimate(jr.key(0))  # compiles
        means, seconds = [], []
        for i in range(REPEATS):
            begin = time.perf_counter()
            means.append(float(estimate(jr.key(1 + i))))
            seconds.append(time.perf_counter() - begin)
        error = np.sqrt(np.mean((np.array(means) - value) ** 2))
        out.append((name, steps, float(error), min(seconds)))
        print(*out[-1], flush=True)
    return out


def draw_portrait(ax) -> None:
    for solver in (diffrax.Heun(), ds.ImplicitMidpoint()):
        name = type(solver).__name__
        p, q = portrait(solver)
        near = np.hypot(p, q) < 2.2
        ax.plot(q[near], p[near], ".", ms=2, color=colour(name), label=name)
    ax.set(xlabel="$q$", ylabel="$p$")
    ax.set_title(f"noisy oscillator, $t = {H * STEPS:g}$")
    ax.set(xlim=(-2.3, 2.3), ylim=(-2.3, 3.6), aspect="equal")
    ax.legend(loc="upper center", markerscale=4)


def draw_errors(ax, rows) -> None:
    styles = {HEUN: style("Heun"), PLAIN: style("StormerVerlet") | dict(ls=":")}
    styles[DEFAULT] = style("StormerVerlet")
    for name, look in styles.items():
        points = [(seconds, error) for x, _, error, seconds in rows if x == name]
        ax.plot(*zip(*points), label=name.replace("`", ""), **look)
    ax.set(xscale="log", yscale="log", title="a mean in a double well")
    ax.set(xlabel="seconds", ylabel="total error", ylim=(2e-10, 3e-2))


def main() -> None:
    rows = measured()
    with (IMG / "first.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("estimate", "steps", "total error", "seconds"))
        for name, steps, error, seconds in rows:
            writer.writerow((name, steps, f"{error:.1e}", f"{seconds:.2g}"))
    draw(rows)


def draw(rows) -> None:
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(WIDTH, 4), width_ratios=(1, 1.1)
    )
    draw_portrait(left)
    draw_errors(right, rows)
    lines, labels = right.get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower center")
    figure.savefig(IMG / "first.png")


if __name__ == "__main__":
    main()
