"""Synchrotron oscillations of particles in a storage ring, with two noises.

dP = -w^2 sin Q dt - s1 cos Q dw1 - s2 sin Q dw2, dQ = P dt: separable, with noise in the
potential. Wang, Hong and Xu (2017), example 3: figures 2(d), 4 and 6(a).
"""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ._command import run
from ._gallery import briefly, claim, gaussian, PAPER_SRKS3, save, trajectory, weak
from ._orders import (
    claim_samples,
    claim_slopes,
    claim_small_first_order,
    plot_orders,
    report,
    resolved,
    resolved_solvers,
    sampled_weak_error,
    strong_errors,
)
from ._pictures import BLUE, line, WIDTH
from ._transfer import enumerated_expectation, transfer_weak_errors


OMEGA, S1, S2 = 2.0, 0.2, 0.1


def H0(t, p, q, args):
    return p**2 / 2 - OMEGA**2 * jnp.cos(q)


def make_terms(path, s1: float = S1, s2: float = S2):
    noise = lambda t, p, q, args: jnp.stack([s1 * jnp.sin(q), -s2 * jnp.cos(q)])
    return ds.hamiltonian_terms(H0, noise, path)


def make_terms_one_noise(path):
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: S1 * jnp.sin(q), path)


# (P, Q); the paper does not give its own.
Y0 = (jnp.array(1.0), jnp.array(0.0))


def figure_2d(full: bool) -> None:
    """Strong error of P at t = 1, with 20 batches of 250 paths as in the paper."""
    paths, fine = (5_000, 2**14) if full else (1_000, 2**11)
    print(
        f"\nFig. 2(d): strong error of P at t = 1, h = 2^-1 .. 2^-8; {paths:,} paths,"
    )
    print(f"  against the same paths in {fine:,} steps")
    study = strong_errors(
        make_terms,
        {"SRKs3": PAPER_SRKS3, "Euler": diffrax.Euler()},
        # Its own error is far smaller than those that are measured.
        ds.ImplicitMidpoint(),
        Y0,
        [2.0**-k for k in range(1, 9)],
        m=2,
        fine=fine,
        component=lambda y: y[0],
    )
    sampled = study(paths)
    report("sampled", sampled)
    figure, axes = plt.subplots(figsize=(6, 4.5))
    plot_orders(axes, "2(d): strong error of $P$", sampled, slopes=(0.5, 1))
    save(figure, "fig2d.png")
    claim_slopes(sampled, {"SRKs3": 1, "Euler": 1})


LONG_RUN = {
    "SRKw3a": (ds.SRKw3("a"), weak(2)),
    "SRKw3b": (ds.SRKw3("b"), weak(2)),
    "SRKw3c": (ds.SRKw3("c"), weak(2)),
    "SRKw3d": (ds.SRKw3("d"), weak(2)),
    "SRKw3e": (ds.SRKw3("e"), weak(2)),
    "SRKw3f": (ds.SRKw3("f"), weak(2)),
    "SRKs3": (PAPER_SRKS3, gaussian(2)),
    "Euler": (diffrax.Euler(), gaussian(2)),
}


def long_run(solver, path, h: float, steps: int, paths: int):
    """P of one path, and the mean of H0 over many with its standard error."""

    @briefly
    def solve_all(seeds):
        one = lambda seed: trajectory(make_terms, path, solver, Y0, h, steps, 10, seed)
        _, (p, q), success = jax.vmap(one)(seeds)
        energy = H0(0.0, p, q, None)
        bar = jnp.std(energy, axis=0) / np.sqrt(paths)
        return p[0], jnp.mean(energy, axis=0), bar, jnp.all(success)

    p, mean, bar, success = map(np.asarray, solve_all(jnp.arange(paths)))
    assert success
    return p, mean, bar


def figure_4(full: bool) -> None:
    """One path of each method, and the mean energy of many."""
    h, steps = 0.02, 10_000
    paths = 4096 if full else 64
    print(
        f"\nFig. 4: paths to t = {h * steps:g}, h = {h}; the mean of H0 over {paths:,}"
    )
    figure = plt.figure(figsize=(WIDTH, 7))
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.3, 1))[:, 0]
    panels = above.subplots(2, 4, sharex=True, sharey=True)
    energies = below.subplots()
    ts = np.linspace(0, h * steps, steps // 10 + 1)
    # d E(H0) / dt = E(s1^2 cos^2 Q + s2^2 sin^2 Q) / 2.
    start = H0(0.0, 1.0, 0.0, None)
    low, high = (np.asarray(start + s**2 / 2 * ts) for s in (S2, S1))
    means = {}
    for ax, (name, (solver, path)) in zip(panels.ravel(), LONG_RUN.items()):
        p, mean, bar = long_run(solver, path, h, steps, paths)
        means[name] = mean[-1], bar[-1]
        print(f"    {name:8} {mean[-1]:8.3f} +- {bar[-1]:.3f}", flush=True)
        look = line(name) if name == "Euler" else dict(color=BLUE)
        ax.plot(ts, p, color=look["color"], lw=0.3)
        ax.set(title=name, ylim=(-12, 12))
        # The symplectic methods lie on top of each other: one colour, one entry.
        first = name == next(iter(LONG_RUN))
        label = f"{len(LONG_RUN) - 1} symplectic methods" if first else None
        label = name if name == "Euler" else label
        energies.errorbar(ts, mean, 3 * bar, label=label, errorevery=100, **look)
    energies.fill_between(ts, low, high, color="0.8", label="bounds of the exact mean")
    above.supylabel("$P$ of one path", fontsize=10)
    above.supxlabel("time", fontsize=10)
    energies.set(xlabel="time", ylabel="mean of $H_0$", ylim=(-5, 32))
    energies.set_title(f"{paths:,} paths, bars of three standard errors")
    energies.legend(loc="upper left")
    save(figure, "fig4.png")
    for name, (mean, bar) in means.items():
        if name == "Euler":
            claim("mean H0 of Euler", mean, low=high[-1] + 4 * bar)
        else:
            claim(f"mean H0 of {name}", mean, low[-1] - 4 * bar, high[-1] + 4 * bar)


def figure_6a(full: bool) -> None:
    """Weak error of E(P^2) at t = 1 with one noise."""
    paths = 20_000_000 if full else 100_000
    print(
        f"\nFig. 6(a): weak error of E(P^2) at t = 1, h = 2^-1 .. 2^-8; {paths:,} paths"
    )
    hs = [2.0**-k for k in range(1, 9)]
    solvers = {
        "SRKw3a": (ds.SRKw3("a"), weak()),
        "SRKw4(a21=0)": (ds.SRKw4(a21=0.0), weak()),
        "Euler": (diffrax.Euler(), gaussian()),
    }
    phi = lambda y: y[0] ** 2
    # Five standard deviations of P, and of Q.
    exact, value = transfer_weak_errors(
        make_terms_one_noise,
        solvers,
        Y0,
        phi,
        hs,
        widths=(1.0, 0.5),
        degree=14,
        reference="SRKw4(a21=0)",
    )
    sampled = {
        name: sampled_weak_error(
            make_terms_one_noise,
            path,
            solver,
            Y0,
            phi,
            value,
            resolved(hs, full),
            paths,
        )
        for name, (solver, path) in resolved_solvers(solvers, full).items()
    }
    print(f"  E(P^2) = {value:.9f}")
    report("exact", exact)
    report("sampled", sampled)
    figure, axes = plt.subplots(figsize=(6, 4.5))
    plot_orders(axes, "6(a): weak error of $E[P^2]$", exact, sampled)
    save(figure, "fig6a.png")
    claim_slopes(exact, {"SRKw4(a21=0)": 2, "Euler": 1})
    claim_small_first_order("SRKw3a", exact["SRKw3a"])
    claim_samples(exact, sampled)
    terms = make_terms_one_noise(weak()(jr.key(0)))
    all_paths = briefly(
        lambda: enumerated_expectation(terms, ds.SRKw3("a"), Y0, phi, 0.5, 2)
    )
    difference = float(all_paths()) - value - exact["SRKw3a"].signed[0]
    claim("transfer against all paths of two steps", abs(difference), high=1e-10)


FIGURES = {"2d": figure_2d, "4": figure_4, "6a": figure_6a}


if __name__ == "__main__":
    run(dict.fromkeys(FIGURES, "synchrotron"))
