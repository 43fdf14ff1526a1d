"""Thermal moments in a double well, H0 = p^2 / 2 + q^4 / 4 - q^2 / 2."""

import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

import diffrax_symplectic as ds

from .._pictures import style
from ..benchmarks._timing import ensemble as many, keys, measure
from ..stability._page import fill, Page, table
from ._ensemble import areas, gaussian, weak
from ._stationary import stationary_bias, Step


def energy(p, q):
    return p**2 / 2 + q**4 / 4 - q**2 / 2


# At rest at the bottom of a well.
Y0 = (jnp.array(0.0), jnp.array(1.0))


# With friction, and noise that balances it: the density exp(-H0 / T) is stationary.
GAMMA, T = 1.0, 0.5


def langevin_terms(path, friction=GAMMA, T=T):
    H0 = lambda t, p, q, args: energy(p, q)
    return ds.langevin_terms(H0, friction, T, path)


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


# Each with its evaluations of the force in a step.
LANGEVIN = {
    "BAOAB": (Step(langevin_terms, gaussian(), ds.BAOAB()), 1),
    "BAOAB, three-point": (Step(langevin_terms, weak(), ds.BAOAB()), 1),
    "LangevinMiddle": (Step(langevin_terms, gaussian(), ds.LangevinMiddle()), 1),
    "ALIGN": (Step(diffrax_terms, areas(), diffrax.ALIGN(), True), 1),
    "QUICSORT": (
        Step(diffrax_terms, with_third_areas, diffrax.QUICSORT(), True, nodes=5),
        2,
    ),
    "Heun": (Step(langevin_terms, gaussian(), diffrax.Heun()), 2),
}
# The picture has all of them, the table these.
SHOWN = (
    "BAOAB", "LangevinMiddle", "ALIGN", "QUICSORT", "Heun",
)  # fmt: skip


def seconds_per_step(step: Step, repeats: int) -> float:
    """Of one path, of many at once."""
    paths, steps = 1_000, 100
    y0 = Y0[::-1] if step.q_first else Y0
    solve = many(step.make_terms, step.make_path, step.solver, y0, 0.1, steps)
    timing = measure(solve, keys(paths), repeats=repeats)
    return timing.seconds / (paths * steps)


def section(page: Page) -> str:
    names = ["ALIGN"] if page.quick else LANGEVIN
    hs = np.array([0.2, 0.1] if page.quick else [0.4, 0.2, 0.1, 0.05])
    print(f"\nDouble well with friction: stationary moments less Gibbs, T = {T:g}")
    rows = []
    figure, ax = plt.subplots(figsize=(6, 4.6))
    for name in names:
        step, evaluations = LANGEVIN[name]
        bias = stationary_bias(step, lambda q: energy(0.0, q), T, hs)
        q2, p2 = bias[hs == 0.1][0]
        if name in SHOWN:
            seconds = seconds_per_step(step, 5 if page.quick else 100)
            cells = evaluations, f"{1e6 * seconds:.2f}"
            rows.append((name, f"{q2:+.1e}", f"{p2:+.1e}", *cells))
        y = np.abs(bias[:, 0])
        # Hollow ones, if the same solver has other increments.
        other = dict(mfc="white", ms=7) if "three-point" in name else {}
        ax.loglog(evaluations / hs, y, label=name, **style(name) | other)
    header = "solver", "$q^2$", "$p^2$", "forces per step", "µs per step"
    shown = table(header, rows)
    ax.set_xlabel("evaluations of the force per unit of time")
    ax.set_ylabel(r"bias of $E[q^2]$")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(loc="outside lower center", ncols=2)
    picture = page.picture(figure, "langevin", "Bias against cost")
    return fill(__file__, table=shown, picture=picture)
