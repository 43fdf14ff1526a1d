"""A double well, H0 = p^2 / 2 + q^4 / 4 - q^2 / 2: escape from it, and thermal moments."""

from typing import NamedTuple

import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ..stability._page import fill, Page, table
from ._ensemble import ensemble, gaussian, Mean, truncated


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
    time: Mean
    failed: float


def escape(solver, make_path, s: float, h: float, t1: float, paths: int) -> Escape:
    above = diffrax.Event(lambda t, y, args, **kwargs: energy(*y) > 0)
    ts, (p, q), failed = ensemble(
        make_terms, make_path, solver, Y0, h, round(t1 / h), paths, args=s, event=above
    )
    good = ~failed
    t, end = ts[good, -1], energy(p[good, -1], q[good, -1])
    return Escape(
        Mean.of(end - BOTTOM - s**2 / 2 * t), Mean.of(end > 0), Mean.of(t),
        float(np.mean(failed)),
    )  # fmt: skip


def make_thermal_terms(path):
    """With friction, `args = (gamma, T)`: no Hamiltonian system, but plain Diffrax terms
    for the array [p, q], which the general solvers take. The Gibbs density exp(-H0 / T) is
    stationary."""

    def drift(t, y, args):
        p, q = y
        return jnp.stack([q - q**3 - args[0] * p, p])

    def diffusion(t, y, args):
        return jnp.stack([jnp.sqrt(2 * args[0] * args[1]), 0.0])

    return diffrax.MultiTerm(
        diffrax.ODETerm(drift), diffrax.ControlTerm(diffusion, path)
    )


def gibbs_moments(T: float) -> tuple[float, float]:
    """E p^2 and E q^2, by quadrature."""
    q = np.linspace(-6, 6, 20001)
    density = np.exp(-energy(0.0, q) / T)
    return T, float(np.sum(q**2 * density) / np.sum(density))


class Thermal(NamedTuple):
    """What is too much in E p^2 and E q^2; and the mean of q."""

    p2: Mean
    q2: Mean
    q: Mean


def thermal(solver, make_path, h, t1, paths, gamma=1.0, T=0.5) -> Thermal:
    _, ys, failed = ensemble(
        make_thermal_terms, make_path, solver, jnp.stack(Y0), h, round(t1 / h), paths,
        args=(gamma, T),
    )  # fmt: skip
    assert not failed.any()
    p, q = ys[:, -1].T
    p2, q2 = gibbs_moments(T)
    return Thermal(Mean.of(p**2 - p2), Mean.of(q**2 - q2), Mean.of(q))


SOLVERS = {
    "Midpoint": (ds.Midpoint(), truncated()),
    "Heun": (diffrax.Heun(), gaussian()),
    "EulerHeun": (diffrax.EulerHeun(), gaussian()),
}


def section(page: Page) -> str:
    paths = 1_000 if page.quick else 20_000
    hs = [0.1] if page.quick else [0.4, 0.2, 0.1]
    names = ["Midpoint", "Heun"] if page.quick else SOLVERS
    s, t1, thermal_t1 = 0.2, 20.0, 20.0
    print(f"\nDouble well: escape until t = {t1:g}, s = {s}, {paths:,} paths")
    rows, thermal_rows = [], []
    figure, axes = plt.subplots(1, 2, figsize=(11, 4))
    for name in names:
        solver, make_path = SOLVERS[name]
        balances, squares = [], []
        for h in hs:
            e = escape(solver, make_path, s, h, t1, paths)
            rows.append((name, h, str(e.balance), str(e.escaped), str(e.time)))
            balances.append(e.balance)
            th = thermal(solver, make_path, h, thermal_t1, paths)
            thermal_rows.append((name, h, str(th.p2), str(th.q2), str(th.q)))
            squares.append(th.q2)
        for ax, means in zip(axes, (balances, squares)):
            y, error = np.array(means).T
            ax.errorbar(hs, y, 3 * error, marker="o", ms=3, lw=1, capsize=2, label=name)
    header = ("solver", "h", "balance", "escaped", "mean of min(time, t)")
    shown = table(header, rows)
    print(f"\nDouble well with friction: moments at t = {thermal_t1:g} less Gibbs")
    thermal_table = table(("solver", "h", "E p^2", "E q^2", "E q"), thermal_rows)
    for ax, title in zip(
        axes, ("escape: energy balance", "friction: E q^2 less Gibbs")
    ):
        ax.set(xlabel="h", title=title, xscale="log")
        ax.set_yscale("symlog", linthresh=1e-2)
        ax.axhline(0, color="k", lw=0.5)
        ax.legend(fontsize=7)
    picture = page.picture(figure, "double_well", "Double well")
    plt.close(figure)
    return fill(__file__, 
        table=shown, thermal=thermal_table, picture=picture, s=s, t1=f"{t1:g}",
        paths=f"{paths:,}", t2=f"{thermal_t1:g}",
    )  # fmt: skip
