"""Stiff springs and a soft, expensive force in a heat bath: the mean soft energy."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .._pictures import style, WIDTH
from ._page import fill, Page, table


BEADS, STIFFNESS, FRICTION, T = 16, 400.0, 0.5, 1.0
REST = jnp.arange(float(BEADS))
FIRST, SECOND = np.triu_indices(BEADS, 1)
# The mean soft energy by importance sampling, with an error of 0.002: the springs are drawn
# from their Gaussian law, with weights exp(-soft energy / T).
EXACT, PROMISED = 56.967, 1e-3
LENGTH, PATHS = 80.0, 800


def springs(q):
    return STIFFNESS / 2 * jnp.sum((jnp.diff(q) - 1) ** 2)


def stiff(t, p, q, args):
    return jnp.sum(p**2) / 2 + springs(q)


def soft(t, q, args):
    return jnp.sum(jnp.exp(-((q[FIRST] - q[SECOND] - (FIRST - SECOND)) ** 2))) / 2


K = jax.hessian(springs)(REST)


def exact_flow(time, y, args):
    """The springs, each mode by its own angle."""
    squares, modes = jnp.linalg.eigh(K)
    omega = jnp.sqrt(jnp.maximum(squares, 0.0))
    p, q = y
    P = modes.T @ p
    Q = modes.T @ (q - REST)
    cosine = jnp.cos(omega * time)
    # The sine over the frequency, which is the time for the mode at rest.
    sine = time * jnp.sinc(omega * time / jnp.pi)
    p = modes @ (cosine * P - squares * sine * Q)
    return p, REST + modes @ (cosine * Q + sine * P)


# A solver, and its steps.
CASES: dict[str, tuple[Any, tuple[float, ...]]] = {
    "BAOAB()": (ds.BAOAB(), (0.02, 0.03, 0.04, 0.048)),
    "BAOAB(StormerVerlet(), steps=4)": (
        ds.BAOAB(ds.StormerVerlet(), steps=4),
        (0.07, 0.1, 0.14, 0.2),
    ),
    "BAOAB(exact_flow)": (
        ds.BAOAB(exact_flow),
        (0.05, 0.0785, 0.1, 0.125, 0.157, 0.25, 0.5),
    ),
    "BAOAB(linear_flow(...))": (
        ds.BAOAB(ds.linear_flow(K, rest=REST)),
        (0.05, 0.1, 0.2, 0.5, 0.8),
    ),
}


def path_means(solver, h: float, length: float) -> Callable:
    """From a key to the soft energy along a path, the second half of it."""
    steps = round(length / h)

    def mean(key):
        path = ds.WeakBrownianPath((BEADS,), key)
        terms = ds.langevin_terms(stiff, FRICTION, T, path, slow=soft)
        energies = diffrax.diffeqsolve(
            terms,
            solver,
            t0=0.0,
            t1=steps * h,
            dt0=h,
            y0=(jnp.zeros(BEADS), REST),
            saveat=diffrax.SaveAt(
                steps=True, fn=lambda t, y, args: soft(t, y[1], args)
            ),
            max_steps=steps + 1,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        ).ys
        assert energies is not None
        return jnp.mean(energies[steps // 2 : steps])

    return mean


def measured(solver, h: float, quick: bool) -> tuple[float, float]:
    """The mean soft energy, and its standard error over the paths."""
    length, paths = (10.0, 20) if quick else (LENGTH, PATHS)
    one = path_means(solver, h, length)
    means = jax.jit(jax.vmap(one))(jr.split(jr.key(0), paths))
    return float(jnp.mean(means)), float(jnp.std(means)) / paths**0.5


def section(page: Page) -> str:
    figure, ax = plt.subplots(figsize=(WIDTH, 4.4))
    rows = []
    print("\nA chain of stiff springs: the mean soft energy")
    for name, (solver, steps) in CASES.items():
        taken = steps[:1] if page.quick else steps
        found = np.array([measured(solver, h, page.quick) for h in taken])
        means, errors = found.T
        shown = [f"{h:g}: {mean:.2f}" for h, mean in zip(taken, means)]
        rows.append((f"`{name}`", ", ".join(shown)))
        print(f"  standard errors {errors}", flush=True)
        ax.errorbar(taken, means, 2 * errors, label=name, **style(name))
    band = EXACT * (1 - PROMISED), EXACT * (1 + PROMISED)
    ax.axhspan(*band, color="k", alpha=0.15, lw=0)
    ax.set(xscale="log", xlabel="step $h$", ylabel="mean soft energy")
    ticks = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    ax.set_xticks(ticks, [f"{x:g}" for x in ticks])
    ax.minorticks_off()
    if not page.quick:
        ax.set(ylim=(56.6, 57.4))  # resonances lie far below
    figure.legend(loc="outside lower center", ncols=2)
    energies = table(("solver", "$h$: mean soft energy"), rows)
    picture = page.picture(figure, "chain", "Mean soft energy against the step")
    return fill(__file__, table=energies, picture=picture, exact=f"{EXACT:g}")
