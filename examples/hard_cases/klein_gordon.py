"""A Klein-Gordon chain of 4,096 sites, its fast waves split off, and the resonances.

H0 = sum p_j^2 / 2 + (q_(j+1) - q_j)^2 / (2 dx^2) + q_j^2 / 2 + q_j^4 / 4 on a ring, and
H_k = -s q_k. E H0 grows by N s^2 / 2 in each unit of time.
"""

import time
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ..stability._page import fill, Page, table
from ._ensemble import Mean


N, DX = 4096, 0.05


def waves(n: int = N, dx: float = DX):
    """The exact flow of all but the quartic part, by Fourier transforms."""
    k = 2 * np.pi * np.arange(n // 2 + 1) / n
    omega = np.sqrt(1 + (2 * np.sin(k / 2) / dx) ** 2)

    def flow(time, y, args):
        P, Q = map(jnp.fft.rfft, y)
        w = omega.astype(y[0].dtype)
        c, s = jnp.cos(w * time), jnp.sin(w * time)
        back = lambda x: jnp.fft.irfft(x, n).astype(y[0].dtype)
        return back(c * P - w * s * Q), back(c * Q + s / w * P)

    return flow


def rest(t, p, q, s):
    return jnp.sum(q**4) / 4


def energy(t, p, q, s, dx: float = DX):
    bonds = jnp.sum((jnp.roll(q, -1) - q) ** 2) / dx**2
    return jnp.sum(p**2 + q**2) / 2 + bonds / 2 + rest(t, p, q, s)


def kicks(t, p, q, s):
    return -s * q


def start(n: int = N):
    """A smooth bump of height 1/2, at rest."""
    x = np.cos(2 * np.pi * np.arange(n) / n)
    return jnp.zeros(n), jnp.asarray(np.exp(8 * (x - 1)) / 2)


class Course(NamedTuple):
    # H0 of each path after each step.
    energies: np.ndarray
    # For each path and unit of time.
    seconds: float


def course(solver, h: float, t1: float, s: float = 0.0, paths: int = 1) -> Course:
    H0 = rest if isinstance(solver, ds.LinearFlow) else energy
    steps = round(t1 / h)

    @jax.jit
    @jax.vmap
    def solve(key):
        terms = ds.hamiltonian_terms(H0, kicks, ds.WeakBrownianPath((N,), key))
        look = lambda t, y, s: energy(t, y[0], y[1], s)
        return diffrax.diffeqsolve(
            terms, solver, 0.0, t1, t1 / steps, start(), s, throw=False,
            saveat=diffrax.SaveAt(t0=True, steps=True, fn=look),
            max_steps=steps + 1, adjoint=diffrax.ForwardMode(),
        ).ys  # fmt: skip

    keys = jr.split(jr.key(0), paths)
    compiled = solve.lower(keys).compile()
    begin = time.perf_counter()
    energies = np.asarray(compiled(keys))[:, : steps + 1]
    return Course(energies, (time.perf_counter() - begin) / (t1 * paths))


def trace(h: float, omega: float, e: float) -> jax.Array:
    """Of one mode with a kick -e q: that of the matrix of a step."""

    def rotation(time, y, args):
        c, s = jnp.cos(omega * time), jnp.sin(omega * time)
        return c * y[0] - omega * s * y[1], c * y[1] + s / omega * y[0]

    soft, still = lambda t, p, q, args: e * q**2 / 2, lambda t, p, q, args: 0 * q
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(soft, still, path)
    solver = ds.LinearFlow(ds.StormerVerlet(), rotation)

    def step(x):
        y = x[0], x[1]
        state = solver.init(terms, 0.0, h, y, None)
        return jnp.stack(solver.step(terms, 0.0, h, y, None, state, False)[0])

    return jnp.trace(jax.jacfwd(step)(jnp.zeros(2)))


SPLIT, EXPLICIT = ds.LinearFlow(ds.StormerVerlet(), waves()), ds.StormerVerlet()


def section(page: Page) -> str:
    t1, long, s, paths = (5.0, 10.0, 0.05, 2) if page.quick else (20.0, 400.0, 0.05, 8)
    print(f"\nKlein-Gordon chain, {N:,} sites, until t = {t1:g}")
    rows = []
    for name, solver, h in (
        ("LinearFlow(StormerVerlet)", SPLIT, 0.5),
        ("LinearFlow(StormerVerlet)", SPLIT, 0.125),
        ("StormerVerlet", EXPLICIT, 0.04),
        ("StormerVerlet", EXPLICIT, 0.02),
    )[:: 3 if page.quick else 1]:
        still, noisy = course(solver, h, t1), course(solver, h, t1, s, paths)
        error = np.max(np.abs(still.energies / still.energies[:, :1] - 1))
        brought = N * s**2 / 2 * t1
        excess = noisy.energies[:, -1] - noisy.energies[:, 0] - brought
        milliseconds = f"{1e3 * noisy.seconds:.1f}"
        rows.append((name, h, f"{error:.1e}", str(Mean.of(excess)), milliseconds))
    figure, axes = plt.subplots(1, 2, figsize=(11, 4))
    x = np.linspace(0.8, 2.2, 1401)
    for e in (1.0, 3.0, 10.0):
        traces = jax.jit(jax.vmap(trace, (0, None, None)))(np.pi * x / 10, 10.0, e)
        # The determinant is one.
        growth = np.exp(np.arccosh(np.maximum(np.abs(traces) / 2, 1)))
        axes[0].plot(x, growth, lw=1, label=f"e = {e:g}")
    title = "one mode of frequency 10 with a kick -e q"
    axes[0].set(xlabel="omega h / pi", ylabel="growth in a step", title=title)
    for h in (0.5, 0.25, 0.125):
        energies = course(SPLIT, h, long).energies[0]
        t = h * np.arange(len(energies))
        axes[1].plot(t, energies / energies[0] - 1, lw=0.6, label=f"h = {h:g}")
    title = "the chain without noise: relative error of H0"
    axes[1].set(xlabel="t", title=title)
    for ax in axes:
        ax.legend(fontsize=7)
    picture = page.picture(figure, "klein_gordon", "Resonances of LinearFlow")
    plt.close(figure)
    header = "solver", "$h$", "energy error", "energy balance", "milliseconds"
    return fill(
        __file__, table=table(header, rows), picture=picture, t1=f"{t1:g}", s=s,
        paths=paths, long=f"{long:g}", brought=f"{N * s**2 / 2 * t1:g}",
    )  # fmt: skip
