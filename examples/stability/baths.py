"""A harmonic mode in a heat bath: its stationary energies, exactly."""

import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import StrMethodFormatter

import diffrax_symplectic as ds
from diffrax_symplectic._solver import LANGEVIN

from .._pictures import colour, style, WIDTH
from ._page import fill, merged, Page, table


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
SHOWN = (0.5, 1.8, 5.0)


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


def _picture(omega_h, curves: dict[str, np.ndarray]):
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 4.4), sharey=True)
    # Those that are right at every step lie upon each other.
    right = [name for name, x in curves.items() if np.max(np.abs(x - 1)) < 1e-6]
    for ax, number in zip(axes, (0, 1)):
        label = ",\n".join(right)
        ax.axhline(1, color=colour("ImplicitMidpoint"), lw=6, alpha=0.3, label=label)
        others = [name for name in curves if name not in right]
        for shift, name in enumerate(others):
            values = curves[name][:, number]
            shown = np.where(np.isfinite(values), values, np.nan)
            # So that no marker hides another.
            some = (4 * shift, 20)
            ax.loglog(omega_h, shown, label=name, **style(name), markevery=some)
        ax.axvline(2, color="k", lw=0.8, ls=":")
        ax.set(xlabel=r"$h \omega$", ylim=(0.05, 30))
        for ticks in (ax.xaxis, ax.yaxis):
            ticks.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes[0].set_title(r"$\langle p^2 \rangle / T$")
    axes[1].set_title(r"$\omega^2 \langle q^2 \rangle / T$")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, loc="outside lower center")
    return figure


def section(page: Page) -> str:
    cases = {name: CASES[name] for name in (QUICK if page.quick else CASES)}
    fine = np.geomspace(0.1, 20, 12 if page.quick else 200)
    rows = []
    curves = {}
    print("\nNoise on stiff modes: <p^2> / T, omega^2 <q^2> / T")
    for name, solver in cases.items():
        found = energies(solver, np.concatenate([SHOWN, fine]))
        rows.append((f"`{name}`", *map(_cell, found[: len(SHOWN)])))
        curves[name] = found[len(SHOWN) :]
    heads = ["solver", *(f"$h \\omega = {x:g}$" for x in SHOWN)]
    energy_table = table(heads, merged(rows))
    picture = page.picture(
        _picture(fine, curves), "baths", "Energies of a mode in a heat bath"
    )
    return fill(
        __file__,
        table=energy_table,
        picture=picture,
        omega=f"{OMEGA:g}",
        friction=f"{FRICTION:g}",
    )
