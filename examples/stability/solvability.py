"""How often the stage equation of a step is not solved, and whether it could have been."""

import re
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

import diffrax_symplectic as ds

from .._pictures import WIDTH
from ._page import fill, Page, table


class Given(diffrax.AbstractBrownianPath):
    """The same increment over every step."""

    W: jax.Array
    t0 = -jnp.inf
    t1 = jnp.inf
    levy_area = diffrax.BrownianIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del t0, t1, left, use_levy
        return self.W


class Law(NamedTuple):
    label: str
    path: Callable
    # The largest increment over a step of size h.
    bound: Callable


def _truncated(k: int) -> Law:
    path = lambda g: ds.TruncatedBrownianPath(g, k=k)
    return Law(f"truncated, k = {k}", path, lambda h: np.sqrt(2 * k * h * -np.log(h)))


LAWS = [
    Law("Gaussian", lambda g: g, lambda h: np.full_like(h, np.inf)),
    *map(_truncated, (4, 2, 1)),
    Law(
        "three-point",
        lambda g: ds.WeakBrownianPath((), g.key),
        lambda h: np.sqrt(3 * h),
    ),
]
# The picture has all of them, the table these.
SHOWN = "Gaussian", "truncated, k = 2", "three-point"


class Model(NamedTuple):
    """`dy = J grad H0 dt + s J grad H1 o dw`, and whether the midpoint rule has a real
    solution for a step of size h from (p, q) with x = s I."""

    H0: Callable
    H1: Callable
    solvable: Callable


_oscillator = lambda p, q: (p**2 + q**2) / 2
MODELS = {
    # q' = q^2 by the noise alone: m = q + x m^2 / 2 for the midpoint m.
    "escape": Model(
        lambda p, q: 0 * p, lambda p, q: p * q**2, lambda h, x, p, q: x * q <= 1 / 2
    ),
    # Once p is eliminated, h x m^2 / 4 + (1 + h^2 / 4) m = q + h p / 2.
    "cubic": Model(
        _oscillator,
        lambda p, q: q**3 / 3,
        lambda h, x, p, q: (1 + h**2 / 4) ** 2 + h * x * (q + h * p / 2) >= 0,
    ),
    # r (1 + (h + x r)^2 / 4) = p^2 + q^2 for r = |m|^2, from 0 to infinity on the left.
    "rotation": Model(
        _oscillator,
        lambda p, q: (p**2 + q**2) ** 2 / 4,
        lambda h, x, p, q: np.full_like(x, True, dtype=bool),
    ),
}


class Shares(NamedTuple):
    """Of steps, each with its standard error: by law, step size and strength."""

    failed: np.ndarray
    # For which there is no solution; and that failed although there is one.
    unsolvable: np.ndarray
    given_up: np.ndarray
    # Solved although there is no solution: none, or something is very wrong.
    impossible: np.ndarray
    steps: int

    def std_error(self, share):
        return np.sqrt(np.maximum(share * (1 - share), 0) / self.steps)


def draw(hs, steps: int, seed: int = 0) -> np.ndarray:
    """Increments over the first step of `steps` paths, by law and step size: the truncated
    ones of the same Gaussian paths."""
    keys = jr.split(jr.key(seed), steps)

    def one(h, key):
        gaussian = ds.FixedStepBrownianPath((), key)
        paths = [law.path(gaussian) for law in LAWS]
        return jnp.stack([path.evaluate(jnp.zeros(()), h) for path in paths])

    over_keys = jax.vmap(one, in_axes=(None, 0), out_axes=1)
    W = jax.jit(jax.vmap(over_keys, in_axes=(0, None), out_axes=1))(
        jnp.asarray(hs), keys
    )
    return np.asarray(W)


def shares(model: Model, solver, hs, strengths, steps: int, seed: int = 0) -> Shares:
    """Of one step from points spread evenly over the unit circle."""
    W = draw(hs, steps, seed)
    angle = 2 * np.pi * (np.arange(steps) + 0.5) / steps
    p, q = np.sin(angle), np.cos(angle)

    def one(h, s, w, p, q):
        H0 = lambda t, p, q, s: model.H0(p, q)
        noise = lambda t, p, q, s: s * model.H1(p, q)
        path = Given(w)  # pyright: ignore[reportCallIssue]
        terms = ds.hamiltonian_terms(H0, noise, path)
        *_, result = solver.step(terms, 0.0, h, (p, q), s, None, False)
        return result == diffrax.RESULTS.successful

    over = jax.vmap(one, in_axes=(None, None, 0, 0, 0))
    over = jax.vmap(over, in_axes=(None, 0, None, None, None))
    over = jax.jit(jax.vmap(over, in_axes=(0, None, 0, None, None)))
    # Law after law: those that fail keep the others of their batch waiting.
    solved = np.stack([np.asarray(over(hs, strengths, w, p, q)) for w in W])
    x = strengths[:, None] * W[:, :, None]
    solvable = model.solvable(hs[:, None, None], x, p, q)
    mean = lambda y: np.mean(y, axis=-1)
    return Shares(
        mean(~solved), mean(~solvable), mean(~solved & solvable),
        mean(solved & ~solvable), steps,
    )  # fmt: skip


def _picture(page: Page, hs, strengths, results: dict[str, Shares]) -> str:
    figure, axes = plt.subplots(
        len(results), len(LAWS), figsize=(WIDTH, 0.8 + 1.9 * len(results)),
        sharex=True, sharey=True, squeeze=False,
    )  # fmt: skip
    image = None
    for row, (name, r) in zip(axes, results.items()):
        system = name.split(", ")[1]
        row[0].set_ylabel(f"{system}\nstep $h$")
        for ax, failed, none in zip(row, r.failed, r.unsolvable):
            image = ax.pcolormesh(
                strengths, hs, np.ma.masked_equal(failed, 0),
                norm=LogNorm(1e-4, 1), cmap="viridis_r",
            )  # fmt: skip
            if none.any():
                ax.contour(strengths, hs, none, [1 / r.steps / 2], colors="r")
            ax.set(xscale="log", yscale="log")
            ax.grid(visible=False)
    for ax, law in zip(axes[0], LAWS):
        ax.set_title(re.sub(", k = (.)", r",\n$k = \1$", law.label), fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("noise $s$")
        ax.set_xticks([0.1, 1], ["0.1", "1"])
    assert image is not None
    label = "share of steps that fail (white: none)"
    figure.colorbar(image, ax=axes, label=label, location="bottom", aspect=50)
    markdown = page.picture(figure, "solvability", "Shares of steps that fail")
    return markdown


def section(page: Page) -> str:
    points, steps = (6, 1024) if page.quick else (16, 4096)
    hs, strengths = np.geomspace(0.01, 0.9, points), np.geomspace(0.1, 4, points)
    cases: dict[str, tuple[Model, diffrax.AbstractSolver]]
    cases = {
        f"ImplicitMidpoint, {n}": (m, ds.ImplicitMidpoint()) for n, m in MODELS.items()
    }
    # Its one equation is the midpoint step of an oscillator, after the kick.
    kick = MODELS["cubic"]._replace(solvable=MODELS["rotation"].solvable)
    cases["SRKw3c, cubic"] = (kick, ds.SRKw3("c"))
    print(f"\nSteps that fail, in percent of {steps:,}")
    results = {
        name: shares(model, solver, hs, strengths, steps)
        for name, (model, solver) in cases.items()
    }
    assert not any(r.impossible.any() for r in results.values())
    i, j = points - 2, points - 3
    few = [n for n, law in enumerate(LAWS) if law.label in SHOWN]
    shown = table(
        ("step", *[LAWS[n].label.replace("k = 2", "$k = 2$") for n in few]),
        [
            (name, *[f"{100 * r.failed[n, i, j]:.2f}" for n in few])
            for name, r in results.items()
        ],
    )
    error = max(np.max(r.std_error(r.failed)[:, i, j]) for r in results.values())
    given_up = max(np.max(r.given_up[:, i, j]) for r in results.values())
    failing = {
        name: r
        for name, r in results.items()
        if name.startswith("ImplicitMidpoint") and r.failed.any()
    }
    picture = _picture(page, hs, strengths, failing)
    return fill(__file__, 
        table=shown, picture=picture, steps=f"{steps:,}", h=f"{hs[i]:.2g}",
        s=f"{strengths[j]:.2g}", given_up=f"{100 * given_up:.2f}",
        error=f"{100 * error:.2f}",
    )  # fmt: skip
