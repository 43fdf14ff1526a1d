"""The picture of README and of the first page of the documentation:

    python -m examples.readme

A noisy oscillator in phase space by a symplectic and an explicit method, and exact errors
against costs as `docs/benchmarks/work_precision.md` has them.
"""

import re
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .benchmarks import work_precision


DOCS = Path(__file__).parent.parent / "docs"
H, STEPS = 0.1, 2000
SHOWN = {
    "AdditiveGauss": "linear oscillator",
    "ShARK": "linear oscillator",
    "NinomiyaVictoir": "two noises",
    "Heun": "two noises",
}


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


def cost(model: str, solver: str) -> float:
    """Microseconds per path and step of size 1, from the page of the benchmark. The cost of
    a step does not depend on its size."""
    page = (DOCS / "benchmarks/work_precision.md").read_text()
    row = rf"^\| weak, {model} \| {solver} \| 0.0625 \| .* \| (\S+) \|$"
    (microseconds,) = re.findall(row, page, re.M)
    return 0.0625 * float(microseconds)


def error(model: str, solver: str) -> np.ndarray:
    """Exact, for all step sizes of the benchmark."""
    _, _, solvers, errors = work_precision.weak(model)
    method, path = solvers[solver]
    return errors(method, path, work_precision.HS).errors


def main() -> None:
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9, 3.8), layout="constrained", width_ratios=(1, 1.3)
    )
    for name, solver, colour in (
        ("Heun", diffrax.Heun(), "C1"),
        ("ImplicitMidpoint", ds.ImplicitMidpoint(), "C0"),
    ):
        p, q = portrait(solver)
        near = np.hypot(p, q) < 2.2
        left.plot(q[near], p[near], ".", ms=2, color=colour, label=name)
    left.set(xlabel="q", ylabel="p", title=f"a noisy oscillator to t = {H * STEPS:g}")
    left.set(xlim=(-2.3, 2.3), ylim=(-2.3, 2.9), aspect="equal")
    left.legend(loc="upper center", ncols=2, markerscale=4, frameon=False)
    for i, (solver, model) in enumerate(SHOWN.items()):
        time = cost(model, solver) / np.array(work_precision.HS)
        style = "-" if hasattr(ds, solver) else "--"
        label = f"{solver}, {model}"
        right.plot(
            time,
            error(model, solver),
            style,
            marker="o",
            label=label,
            color=f"C{i // 2}",
        )
    right.set(xscale="log", yscale="log", title="error of an expectation")
    right.set(xlabel="microseconds per path", ylabel="error")
    right.set_ylim(top=100)
    right.legend(loc="upper center", ncols=2, fontsize=7.5, frameon=False)
    right.grid(alpha=0.3)
    figure.savefig(DOCS / "img/first.png", dpi=110)


if __name__ == "__main__":
    main()
