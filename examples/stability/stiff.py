"""A slow oscillator with noise, coupled to a fast one."""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import StrMethodFormatter

import diffrax_symplectic as ds

from .._pictures import style, WIDTH
from ._models import areas, Case, gaussian, weak
from ._page import fill, Page, table


OMEGA = 50.0
SIGMA = 0.5


def plateaus(key, shape=()):
    return ds.PlateauVerlet().path(shape, key)


CASES = {
    "ImplicitMidpoint": Case(ds.ImplicitMidpoint(), weak),
    "SRKs3": Case(ds.SRKs3(), weak),
    "SRKw4": Case(ds.SRKw4(), weak),
    "SRKs4": Case(ds.SRKs4(), areas),
    "PlateauVerlet": Case(ds.PlateauVerlet(), plateaus),
    "StormerVerlet": Case(ds.StormerVerlet(), weak),
    "Heun": Case(diffrax.Heun(), gaussian),
}
QUICK = ("ImplicitMidpoint", "StormerVerlet")
# In the picture these have a colour each, and implicit methods, which lie upon each other,
# one of them for all.
PICTURED = "PlateauVerlet", "StormerVerlet", "Heun"
# Below this a spectral radius is 1 but for rounding.
ROUNDING = 1e-12


class Args(NamedTuple):
    """How strong noise, harmonic and quartic coupling are."""

    sigma: float
    harmonic: float
    quartic: float


def H0(t, p, q, args):
    stretch = q[1] - q[0]
    alone = (q[0] ** 2 + OMEGA**2 * q[1] ** 2) / 2
    coupling = args.harmonic * stretch**2 / 2 + args.quartic * stretch**4 / 4
    return jnp.sum(p**2) / 2 + alone + coupling


def make_terms(path):
    # Noise on the slow one: E H0 grows by sigma^2 / 2 in each unit of time, exactly,
    # whatever the potential is.
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: -args.sigma * q[0], path)


LINEAR, QUARTIC = Args(0.0, 1.0, 0.0), Args(0.5, 1.0, 1.0)
# p and q of the slow one and the fast one.
Y0 = (jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0]))


def fastest() -> float:
    """The largest eigenfrequency of the harmonic part."""
    a = LINEAR.harmonic
    return float(np.sqrt(np.linalg.eigvalsh([[1 + a, -a], [-a, OMEGA**2 + a]])[-1]))


def spectral_radii(case: Case, hs) -> np.ndarray:
    """Of one step of the linear system, exactly: additive noise does not matter."""
    terms = make_terms(case.path(jr.key(0)))

    def step(y, h):
        y0 = y[:2], y[2:]
        y1, *_ = case.solver.step(terms, 0.0, h, y0, LINEAR, None, False)
        return jnp.concatenate(y1)

    jacobians = jax.jit(jax.vmap(jax.jacrev(step), in_axes=(None, 0)))
    R = np.asarray(jacobians(jnp.zeros(4), jnp.asarray(hs)))
    return np.max(np.abs(np.linalg.eigvals(R)), axis=-1)


class Energies(NamedTuple):
    """Means over paths with their standard errors; infinite if a path overflowed."""

    excess: float
    excess_error: float
    fast: float
    failed: float


def energies(case: Case, hs, t1: float, paths: int) -> list[Energies]:
    """With quartic coupling: H0 at the end, less what it has to be on average; and the
    energy of the fast oscillator alone, which starts at 1/2 and is nearly constant."""

    def end(h, key):
        sol = diffrax.diffeqsolve(
            make_terms(case.path(key)), case.solver, 0.0, t1, h, Y0, QUARTIC,
            max_steps=None, adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        assert sol.ys is not None
        p, q = (y[-1] for y in sol.ys)
        exact = H0(0.0, *Y0, QUARTIC) + QUARTIC.sigma**2 * t1 / 2
        fast = (p[1] ** 2 + OMEGA**2 * q[1] ** 2) / 2
        excess = H0(t1, p, q, QUARTIC) - exact
        return excess, fast, sol.result == diffrax.RESULTS.successful

    ends = jax.jit(jax.vmap(end, in_axes=(None, 0)))
    keys = jr.split(jr.key(0), paths)
    out = []
    for h in hs:
        excess, fast, good = map(np.asarray, ends(h, keys))
        failed = 1 - float(np.mean(good))
        # Nothing is left of a mean if one path in it has overflowed.
        if failed or not np.max(np.abs(excess)) < 1e6:
            out.append(Energies(np.inf, np.inf, np.inf, failed))
            continue
        error = np.std(excess) / np.sqrt(paths)
        out.append(
            Energies(float(np.mean(excess)), float(error), float(np.mean(fast)), 0)
        )
    return out


def limit(case: Case, omegas: np.ndarray) -> str:
    """Where explicit steps begin to grow, by h times the fastest frequency."""
    radii = spectral_radii(case, omegas / fastest())
    grows = radii > 1 + 1e-9
    if not grows.any():
        return "none"
    return "every $h$" if grows[0] else f"{omegas[np.argmax(grows)]:.2f}"


def section(page: Page) -> str:
    points, t1, paths = (40, 2.0, 64) if page.quick else (400, 20.0, 1024)
    cases = {n: CASES[n] for n in (QUICK if page.quick else CASES)}
    omegas = np.geomspace(0.1, 10, points)
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 4))
    implicit = [name for name in cases if name not in PICTURED]
    alike = dict(color="0.6", marker="o", zorder=1)
    styles = {name: alike for name in implicit}
    styles[implicit[0]] = alike | dict(label=f"implicit ({len(implicit)} methods)")
    styles |= {name: style(name) | dict(label=name) for name in PICTURED}
    for name, case in cases.items():
        excess = spectral_radii(case, omegas / fastest()) - 1
        shown = np.maximum(np.abs(excess), ROUNDING)
        axes[0].loglog(omegas, shown, **styles[name], markevery=40)
    axes[0].set(xlabel=r"$h \omega$", title="linear coupling")
    axes[0].set_ylabel("spectral radius $-$ 1")
    axes[0].text(0.1, 2 * ROUNDING, "stable")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)

    print(f"\nStiff: mean of H0 at t = {t1:g}, less its exact value, {paths} paths")
    some = np.array([0.1, 0.5, 1.0, 1.9, 2.1, 3.9, 4.1, 10.0])
    hs = some / fastest()
    rows, errors, shown = [], [], [list(some).index(x) for x in (1.9, 10.0)]
    for name, case in cases.items():
        results = energies(case, hs, t1, paths)
        cells = [
            f"{e.excess:+.2f}" if np.isfinite(e.excess)
            else "fails" if e.failed else "grows"
            for e in (results[k] for k in shown)
        ]  # fmt: skip
        rows.append((name, limit(case, omegas), *cells))
        errors += [e.excess_error for e in results if np.isfinite(e.excess)]
        y = np.array([e.fast for e in results])
        y = np.where(np.isfinite(y), y, np.nan)
        axes[1].semilogx(some, y, **styles[name])
    axes[1].set(xlabel=r"$h \omega$", title="quartic coupling", ylim=(0, None))
    axes[1].set_ylabel("mean energy of the fast oscillator")
    for ax in axes:
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    header = "solver", "limit", *[f"$h \\omega = {some[k]:g}$" for k in shown]
    energy_table = table(header, rows)
    picture = page.picture(figure, "stiff", "Stiff system")
    return fill(__file__, 
        picture=picture, energy_table=energy_table, t1=f"{t1:g}",
        paths=f"{paths:,}", omega=f"{OMEGA:g}",
        heat=f"{QUARTIC.sigma**2 * t1 / 2:.2f}", error=f"{max(errors):.2f}",
    )  # fmt: skip
