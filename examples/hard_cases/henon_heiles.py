"""The Henon-Heiles system with two weak noises, near its escape energy.

H0 = |p|^2 / 2 + |q|^2 / 2 + q1^2 q2 - q2^3 / 3, H_k = -s q_k. Above
H0 = 1/6 orbits may leave.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .._pictures import line, style, WIDTH
from ..stability._page import fill, Page, table
from ._ensemble import ensemble, gaussian, Mean, plateaus, truncated


ESCAPE = 1 / 6


def energy(p, q):
    return jnp.sum(p**2 + q**2) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def make_terms(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, s: energy(p, q), lambda t, p, q, s: -s * q, path
    )


def start(level: float = 0.15):
    """In the chaotic sea, at this energy."""
    q = jnp.array([0.0, -0.15])
    p2 = 0.1
    p1 = jnp.sqrt(2 * (level - energy(jnp.zeros(2), q)) - p2**2)
    return jnp.stack([p1, jnp.asarray(p2)]), q


class Stay(NamedTuple):
    """Until an orbit leaves (|q| > 2), or the end."""

    left: Mean
    # H0 there, less its start, less s^2 times the time: zero on average.
    balance: Mean
    # The energy of the first orbits, as saved.
    energies: np.ndarray
    failed: float


def stay(solver, make_path, s: float, h: float, t1: float, paths: int) -> Stay:
    outside = lambda t, y, args, **kwargs: jnp.sum(y[1] ** 2) > 4
    steps = round(t1 / h)
    saveat = diffrax.SaveAt(
        subs=[
            diffrax.SubSaveAt(t1=True),
            diffrax.SubSaveAt(
                steps=max(1, steps // 200), fn=lambda t, y, a: energy(*y)
            ),
        ]
    )
    (ts, _), ((p, q), energies), failed = ensemble(
        make_terms, make_path, solver, start(), h, steps, paths, args=s, saveat=saveat,
        event=diffrax.Event(outside),
    )  # fmt: skip
    good = ~failed
    t, p, q = ts[good, -1], p[good, -1], q[good, -1]
    end = np.asarray(jax.vmap(energy)(p, q))
    gained = end - float(energy(*start()))
    return Stay(
        Mean.of(np.sum(q**2, axis=1) > 4), Mean.of(gained - s**2 * t),
        energies[:64], float(np.mean(failed)),
    )  # fmt: skip


SOLVERS = {
    "ImplicitMidpoint": (ds.ImplicitMidpoint(), truncated((2,))),
    "PlateauVerlet": (ds.PlateauVerlet(), plateaus((2,))),
    "Heun": (diffrax.Heun(), gaussian((2,))),
}


def section(page: Page) -> str:
    t1, paths = (100.0, 64) if page.quick else (500.0, 1_000)
    hs = [0.2] if page.quick else [0.4, 0.2, 0.1]
    names = ["ImplicitMidpoint", "Heun"] if page.quick else SOLVERS
    print(f"\nHenon-Heiles from energy 0.15 until t = {t1:g}, {paths:,} paths")
    rows = []
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.8))
    for name in names:
        solver, make_path = SOLVERS[name]
        left, balances = [], []
        for h in hs:
            for s in (0.0, 0.003) if h == 0.2 else (0.003,):
                r = stay(solver, make_path, s, h, t1, 16 if s == 0 else paths)
                assert r.failed == 0
                if s == 0:
                    ts = np.linspace(0, t1, r.energies.shape[1])
                    axes[0].plot(ts, r.energies[0], **line(name))
                else:
                    balances.append(str(r.balance))
                    left.append(r.left)
        rows.append((name, *balances[:: max(1, len(hs) - 1)]))
        y, error = np.array(left).T
        axes[1].errorbar(hs, y, 3 * error, label=name, **style(name))
    axes[0].axhline(ESCAPE, color="k", lw=0.8, ls=":")
    axes[0].text(t1, ESCAPE, "escape energy", ha="right", va="bottom")
    axes[0].set(xlabel="time $t$", ylabel="energy $H_0$", ylim=(0.14, 0.2))
    axes[0].set_title("without noise, $h = 0.2$")
    axes[1].set(xscale="log", xlabel="step $h$", ylabel="share of orbits that left")
    axes[1].set(title="$s = 0.003$", ylim=(0, 1.05))
    axes[1].set_xticks(hs, [f"{h:g}" for h in hs])
    axes[1].minorticks_off()
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    picture = page.picture(figure, "henon_heiles", "Hénon–Heiles system")
    shown = table(
        ("solver", *[f"$h = {h:g}$" for h in hs[:: max(1, len(hs) - 1)]]), rows
    )
    return fill(
        __file__, table=shown, picture=picture, t1=f"{t1:g}", paths=f"{paths:,}"
    )
