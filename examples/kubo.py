"""The Kubo oscillator: an oscillator whose frequency is noisy.

dq = p dt + s p o dw, dp = -q dt - s q o dw: H0 = (p^2 + q^2) / 2 and H1 = s H0, so that
every path stays on its circle. Wang, Hong and Xu (2017), example 2: figures 2(c) and 3.
"""

import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ._command import run
from ._gallery import (
    briefly,
    claim,
    gaussian,
    PAPER_SRKW2,
    save,
    trajectory,
    truncated,
    weak,
)
from ._orders import (
    claim_samples,
    claim_slopes,
    exact_moment_map,
    exact_weak_error,
    plot_orders,
    report,
    resolved,
    resolved_solvers,
    sampled_weak_error,
    second_moments,
)
from ._pictures import colour, WIDTH


def make_terms(path, s: float = 1.0):
    def energy(t, p, q, args):
        return (p**2 + q**2) / 2

    def noise(t, p, q, args):
        return s * energy(t, p, q, args)

    return ds.hamiltonian_terms(energy, noise, path)


# (p, q)
Y0 = (jnp.array(0.0), jnp.array(1.0))


def figure_2c(full: bool) -> None:
    """Weak error of E(q^2) at t = 1."""
    paths = 30_000_000 if full else 100_000
    print(
        f"\nFig. 2(c): weak error of E(q^2) at t = 1, h = 2^-1 .. 2^-8; {paths:,} paths"
    )
    # q + ip turns by 1 + w(1): E(q^2) = (1 + E cos(2 + 2 w)) / 2.
    value = (1 + np.cos(2) * np.exp(-2)) / 2
    hs = [2.0**-k for k in range(1, 9)]
    solvers = {
        "SRKw1(b=0)": (ds.SRKw1(b=0.0), weak()),
        "SRKw2": (PAPER_SRKW2, weak()),
        "Milstein": (diffrax.StratonovichMilstein(), gaussian()),
    }
    exact, sampled = {}, {}
    for name, (solver, path) in solvers.items():
        moment_map = exact_moment_map(make_terms, path, solver, Y0)
        exact[name] = exact_weak_error(moment_map, Y0, lambda m: m[1, 1], value, hs)
    for name, (solver, path) in resolved_solvers(solvers, full).items():
        sampled[name] = sampled_weak_error(
            make_terms,
            path,
            solver,
            Y0,
            lambda y: y[1] ** 2,
            value,
            resolved(hs, full),
            paths,
        )
    report("exact", exact)
    report("sampled", sampled)
    figure, axes = plt.subplots(figsize=(6, 4.5))
    plot_orders(axes, "2(c): weak error of $E[q^2]$", exact, sampled)
    save(figure, "fig2c.png")
    claim_slopes(exact, {"SRKw1(b=0)": 1, "SRKw2": 2, "Milstein": 1})
    claim_samples(exact, sampled)


def figure_3(full: bool) -> None:
    """One path, and the circle that it should stay on."""
    h, steps = 0.01, 10_000
    print(f"\nFig. 3: one path to t = {h * steps:g}, h = {h}; the largest |radius - 1|")
    solvers = {
        "Milstein": (diffrax.StratonovichMilstein(), gaussian()),
        "Heun": (diffrax.Heun(), gaussian()),
        "SRKs1": (ds.SRKs1(), truncated),
        "SRKw1(b=0)": (ds.SRKw1(b=0.0), weak()),
        "SRKw2": (PAPER_SRKW2, weak()),
    }
    figure, axes = plt.subplots(2, 3, figsize=(WIDTH, 5.4))
    angle = np.linspace(0, 2 * np.pi, 200)
    drifts = {}
    for ax, (name, (solver, path)) in zip(axes.flat, solvers.items()):
        solution = briefly(
            lambda: trajectory(make_terms, path, solver, Y0, h, steps, every=2)
        )
        _, (p, q), success = solution()
        drift = np.max(np.abs(np.hypot(p, q) - 1))
        drifts[name] = float(drift) if success else np.inf
        shown = f"largest error {drifts[name]:.0e}"
        if name in ("Milstein", "Heun"):
            moment_map = exact_moment_map(make_terms, path, solver, Y0)
            mean = np.trace(second_moments(moment_map, Y0, h, steps))
            shown += f"\n$E[p^2 + q^2] = {mean:.3g}$"
        print(f"    {name}: {shown}".replace("\n", "; "), flush=True)
        ax.plot(q, p, ".", ms=1, color=colour(name))
        ax.plot(np.cos(angle), np.sin(angle), "k-", lw=0.8)
        ax.set(aspect="equal")
        # As many lines in each, so that the panels are in rows.
        lines = f"{name}\n{shown}" if "\n" in shown else f"{name}\n{shown}\n"
        ax.set_title(lines, fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("$q$")
    for ax in axes[:, 0]:
        ax.set_ylabel("$p$")
    axes[-1, -1].axis("off")
    save(figure, "fig3.png")
    for name, drift in drifts.items():
        ours = isinstance(solvers[name][0], ds.AbstractSymplecticRungeKutta)
        bounds = dict(high=1e-11) if ours else dict(low=1e-2)
        claim(f"largest |radius - 1| of {name}", drift, **bounds)


FIGURES = {"2c": figure_2c, "3": figure_3}


if __name__ == "__main__":
    run(dict.fromkeys(FIGURES, "kubo"))
