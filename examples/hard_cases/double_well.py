"""A double well, H0 = p^2 / 2 + q^4 / 4 - q^2 / 2: escape from it, and thermal moments."""

from typing import NamedTuple

import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

import diffrax_symplectic as ds

from ..benchmarks._timing import ensemble as many, keys, measure
from ..stability._page import fill, Page, table
from ._ensemble import areas, ensemble, gaussian, Mean, plateaus, truncated, weak
from ._stationary import stationary_bias, Step


def energy(p, q):
    return p**2 / 2 + q**4 / 4 - q**2 / 2


# The bottom of a well. The barrier is at energy 0.
Y0 = (jnp.array(0.0), jnp.array(1.0))
BOTTOM = -0.25


def make_terms(path):
    """Additive noise of strength `args`: E H0 grows by s^2 / 2 in each unit of time."""
    return ds.hamiltonian_terms(
        lambda t, p, q, s: energy(p, q), lambda t, p, q, s: -s * q, path
    )


class Escape(NamedTuple):
    """H0 when it first is above the barrier, or at the end, less its start, less s^2 / 2
    times that time: zero on average (optional stopping)."""

    balance: Mean
    escaped: Mean
    failed: float


def escape(solver, make_path, s: float, h: float, t1: float, paths: int) -> Escape:
    above = diffrax.Event(lambda t, y, args, **kwargs: energy(*y) > 0)
    ts, (p, q), failed = ensemble(
        make_terms, make_path, solver, Y0, h, round(t1 / h), paths, args=s, event=above
    )
    good = ~failed
    t, end = ts[good, -1], energy(p[good, -1], q[good, -1])
    return Escape(
        Mean.of(end - BOTTOM - s**2 / 2 * t), Mean.of(end > 0), float(np.mean(failed)),
    )  # fmt: skip


# With friction, and noise that balances it: the density exp(-H0 / T) is stationary.
GAMMA, T = 1.0, 0.5


def langevin_terms(path, gamma=GAMMA, T=T):
    """Those of a solver that is `Damped`."""
    return ds.hamiltonian_terms(
        lambda t, p, q, args: energy(p, q),
        lambda t, p, q, args: -np.sqrt(2 * gamma * T) * q,
        path,
    )


def terms_with_friction(path):
    friction = diffrax.ODETerm(lambda t, y, args: (-GAMMA * y[0], jnp.zeros_like(y[1])))
    return diffrax.MultiTerm(*langevin_terms(path).terms, friction)


def diffrax_terms(path):
    """Diffrax's own, of which its solvers for Langevin dynamics make use. Their
    temperature is `u`."""
    force = lambda q, args: (q**3 - q) / T
    return diffrax.MultiTerm(
        diffrax.UnderdampedLangevinDriftTerm(GAMMA, T, force),
        diffrax.UnderdampedLangevinDiffusionTerm(GAMMA, T, path),
    )


def with_third_areas(key):
    """Diffrax's own path, for only it has space-time-time areas."""
    return diffrax.UnsafeBrownianPath((), key, diffrax.SpaceTimeTimeLevyArea)


def damped(solver, make_path) -> Step:
    return Step(langevin_terms, make_path, ds.Damped(solver, GAMMA))


# Each with its evaluations of the force in a step.
LANGEVIN = {
    "BAOAB": (Step(langevin_terms, gaussian(), ds.BAOAB(GAMMA)), 1),
    "BAOAB, three-point": (Step(langevin_terms, weak(), ds.BAOAB(GAMMA)), 1),
    "Damped(StormerVerlet)": (damped(ds.StormerVerlet(), gaussian()), 1),
    "Damped(PlateauVerlet)": (damped(ds.PlateauVerlet(), plateaus()), 2),
    "Damped(ImplicitMidpoint)": (damped(ds.ImplicitMidpoint(), gaussian()), None),
    "ALIGN": (Step(diffrax_terms, areas(), diffrax.ALIGN(), True), 1),
    "QUICSORT": (
        Step(diffrax_terms, with_third_areas, diffrax.QUICSORT(), True, nodes=5),
        2,
    ),
    "Heun": (Step(terms_with_friction, gaussian(), diffrax.Heun()), 2),
}
# The picture has all of them, the table these.
SHOWN = (
    "BAOAB", "Damped(StormerVerlet)", "Damped(PlateauVerlet)", "ALIGN", "QUICSORT", "Heun",
)  # fmt: skip


SOLVERS = {
    "ImplicitMidpoint": (ds.ImplicitMidpoint(), truncated()),
    "Heun": (diffrax.Heun(), gaussian()),
    "EulerHeun": (diffrax.EulerHeun(), gaussian()),
}


def escapes(page: Page) -> dict[str, str]:
    paths = 1_000 if page.quick else 20_000
    hs = [0.1] if page.quick else [0.4, 0.2, 0.1]
    s, t1 = 0.2, 20.0
    print(f"\nDouble well: escape until t = {t1:g}, s = {s}, {paths:,} paths")
    balances = {}
    figure, ax = plt.subplots(figsize=(5.5, 4))
    for name, (solver, make_path) in SOLVERS.items():
        es = [escape(solver, make_path, s, h, t1, paths) for h in hs]
        balances[name] = str(es[-1].balance)
        print(f"  {name}, h = {hs[-1]}: {balances[name]}", flush=True)
        y, error = np.array([e.balance for e in es]).T
        ax.errorbar(hs, y, 3 * error, marker="o", ms=3, lw=1, capsize=2, label=name)
    ax.set(xlabel="h", title="escape: energy balance", xscale="log")
    ax.set_yscale("symlog", linthresh=1e-2)
    ax.axhline(0, color="k", lw=0.5)
    ax.legend(fontsize=7)
    picture = page.picture(figure, "double_well", "Double well")
    plt.close(figure)
    return dict(
        picture=picture, s=str(s), t1=f"{t1:g}", paths=f"{paths:,}", h=str(hs[-1]),
        midpoint=balances["ImplicitMidpoint"], heun=balances["Heun"],
        euler=balances["EulerHeun"],
    )  # fmt: skip


def seconds_per_step(step: Step, repeats: int) -> float:
    """Of one path, of many at once."""
    paths, steps = 1_000, 100
    y0 = Y0[::-1] if step.q_first else Y0
    solve = many(step.make_terms, step.make_path, step.solver, y0, 0.1, steps)
    timing = measure(solve, keys(paths), repeats=repeats)
    return timing.seconds / (paths * steps)


def temperatures(page: Page) -> dict[str, str]:
    names = ["ALIGN"] if page.quick else LANGEVIN
    hs = np.array([0.2, 0.1] if page.quick else [0.4, 0.2, 0.1, 0.05])
    print(f"\nDouble well with friction: stationary moments less Gibbs, T = {T:g}")
    rows = []
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True)
    for i, name in enumerate(names):
        step, evaluations = LANGEVIN[name]
        bias = stationary_bias(step, lambda q: energy(0.0, q), T, hs)
        seconds = seconds_per_step(step, 5 if page.quick else 100)
        costs = evaluations, 1e6 * seconds
        cells = "implicit" if evaluations is None else evaluations, f"{costs[1]:.2f}"
        q2, p2 = bias[hs == 0.1][0]
        if name in SHOWN:
            rows.append((name, f"{q2:+.1e}", f"{p2:+.1e}", *cells))
        for ax, cost in zip(axes, costs):
            if cost is not None:
                y = np.abs(bias[:, 0])
                ax.loglog(cost / hs, y, f"C{i}o-", ms=3, lw=1, label=name)
    header = "solver", "$q^2$", "$p^2$", "forces per step", "µs per step"
    shown = table(header, rows)
    units = "evaluations of the force", "microseconds"
    for ax, unit in zip(axes, units):
        ax.set(xlabel=f"{unit} per unit of time", title="bias of E q^2")
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.legend(fontsize=7)
    picture = page.picture(figure, "langevin", "Bias against cost")
    plt.close(figure)
    return dict(thermal=shown, chart=picture)


def section(page: Page) -> str:
    return fill(__file__, **escapes(page), **temperatures(page))
