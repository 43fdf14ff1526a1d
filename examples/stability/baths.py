"""A harmonic mode in a heat bath: its stationary energies, exactly."""

import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds
from diffrax_symplectic._solver import LANGEVIN

from ._page import fill, Page, table


OMEGA, FRICTION = 20.0, 0.5
# Friction between two halves of a flow, and in the drift.
CASES = {
    **{kind.__name__: kind() for kind in LANGEVIN},
    "BAOAB(ImplicitMidpoint)": ds.BAOAB(ds.ImplicitMidpoint()),
    "BAOAB(linear_flow)": ds.BAOAB(ds.linear_flow(np.array([[OMEGA**2]]))),
    "ImplicitMidpoint": ds.ImplicitMidpoint(),
    "SRKw5": ds.SRKw5(),
    "AdditiveGauss": ds.AdditiveGauss(),
    "StrangGauss": ds.StrangGauss(),
}
QUICK = ("BAOAB", "SRKw5", "ImplicitMidpoint")
# Steps, by the frequency of the mode, of the table.
SHOWN = (0.5, 1.0, 1.8, 3.0, 5.0, 10.0)


def energies(solver, omega_h) -> np.ndarray:
    """The stationary `<p^2>` and `omega^2 <q^2>` at temperature 1, for each step; infinite
    where moments grow without end."""

    def H0(t, p, q, args):
        return p**2 / 2 + OMEGA**2 * q**2 / 2

    path = solver.path((), jr.key(0), want="weak")
    terms = ds.langevin_terms(H0, FRICTION, 1.0, path)
    y0 = (jnp.array(0.0), jnp.array(0.0))
    one = lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0)
    maps = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(omega_h) / OMEGA))
    second = [4, 5, 7, 8]  # pp, pq, qp, qq among the moments of (1, p, q)
    found = []
    for K in maps:
        matrix = K[np.ix_(second, second)]
        if np.max(np.abs(np.linalg.eigvals(matrix))) >= 1:
            found.append((np.inf, np.inf))
            continue
        pp, _, _, qq = np.linalg.solve(np.eye(4) - matrix, K[second, 0])
        found.append((pp, OMEGA**2 * qq))
    return np.array(found)


def _cell(pair) -> str:
    p, q = pair
    return f"{p:.3f}, {q:.3f}" if np.isfinite(p) else "grows"


def section(page: Page) -> str:
    cases = {name: CASES[name] for name in (QUICK if page.quick else CASES)}
    fine = np.geomspace(0.1, 20, 12 if page.quick else 60)
    figure, axes = plt.subplots(1, 2, figsize=(9, 5), sharey=True, layout="constrained")
    rows = []
    print("\nNoise on stiff modes: <p^2> / T, omega^2 <q^2> / T")
    for number, (name, solver) in enumerate(cases.items()):
        found = energies(solver, np.concatenate([SHOWN, fine]))
        rows.append((f"`{name}`", *map(_cell, found[: len(SHOWN)])))
        style = dict(color=f"C{number % 10}", ls=("-", "--")[number // 10], lw=1.5)
        for ax, values in zip(axes, found[len(SHOWN) :].T):
            shown = np.where(np.isfinite(values), values, np.nan)
            ax.loglog(fine, shown, label=name, **style)
    titles = r"$\langle p^2 \rangle / T$", r"$\omega^2 \langle q^2 \rangle / T$"
    for ax, title in zip(axes, titles):
        ax.axhline(1, color="k", lw=0.5, ls=":")
        ax.set(xlabel=r"$h\omega$", title=title, ylim=(0.02, 10))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, ncols=4, loc="outside lower center")
    heads = ["solver", *(f"$h \\omega = {x:g}$" for x in SHOWN)]
    energy_table = table(heads, rows)
    picture = page.picture(figure, "baths", "Energies of a mode in a heat bath")
    plt.close(figure)
    return fill(
        __file__,
        table=energy_table,
        picture=picture,
        omega=f"{OMEGA:g}",
        friction=f"{FRICTION:g}",
    )
