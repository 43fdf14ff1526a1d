"""How often the stage equation of a step is not solved, and whether it could have been."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

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
# The tests look at all of them, the table shows these.
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


def section(page: Page) -> str:
    steps, h, s = 1024 if page.quick else 4096, 0.67, 2.4
    cases: dict[str, tuple[Model, diffrax.AbstractSolver]]
    cases = {
        f"ImplicitMidpoint, {n}": (m, ds.ImplicitMidpoint()) for n, m in MODELS.items()
    }
    # Its one equation is the midpoint step of an oscillator, after the kick.
    kick = MODELS["cubic"]._replace(solvable=MODELS["rotation"].solvable)
    cases["SRKw3c, cubic"] = (kick, ds.SRKw3("c"))
    print(f"\nSteps that fail, in percent of {steps:,}")
    results = {
        name: shares(model, solver, np.array([h]), np.array([s]), steps)
        for name, (model, solver) in cases.items()
    }
    assert not any(r.impossible.any() for r in results.values())
    few = [n for n, law in enumerate(LAWS) if law.label in SHOWN]
    shown = table(
        ("step", *[LAWS[n].label.replace("k = 2", "$k = 2$") for n in few]),
        [
            (name, *[f"{100 * r.failed[n, 0, 0]:.2f}" for n in few])
            for name, r in results.items()
        ],
    )
    error = max(np.max(r.std_error(r.failed)) for r in results.values())
    given_up = max(np.max(r.given_up) for r in results.values())
    return fill(
        __file__,
        table=shown,
        steps=f"{steps:,}",
        h=h,
        s=s,
        given_up=f"{100 * given_up:.2f}",
        error=f"{100 * error:.2f}",
    )
