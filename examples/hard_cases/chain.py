"""A chain of 32 oscillators between walls with 32 noises, one on each: 64 unknowns.

H0 = |p|^2 / 2 + sum_j (r_j^2 / 2 + beta r_j^4 / 4), r_j = q_(j+1) - q_j, H_k = -s q_k.
E H0 grows by 32 s^2 / 2 in each unit of time, whatever beta is.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

import diffrax_symplectic as ds

from .._pictures import style
from ..stability._page import fill, Page
from ._ensemble import ensemble, gaussian, Mean, plateaus, truncated


N = 32


class Args(NamedTuple):
    beta: float
    s: float


def energy(p, q, beta):
    r = jnp.diff(q, prepend=0.0, append=0.0)
    return jnp.sum(p**2) / 2 + jnp.sum(r**2 / 2 + beta * r**4 / 4)


def make_terms(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: energy(p, q, args.beta),
        lambda t, p, q, args: -args.s * q,
        path,
    )


def start(amplitude: float):
    """The slowest mode."""
    j = jnp.arange(1, N + 1)
    return jnp.zeros(N), amplitude * jnp.sin(jnp.pi * j / (N + 1))


class Heating(NamedTuple):
    # max |R^T A R - A| for the step y1 = R y0 + G W and the energy y^T A y / 2
    energy_defect: np.ndarray
    # By which E H0 grows in each unit of time.
    rate: np.ndarray


def heating(solver, hs, s: float = 1.0) -> Heating:
    """Of the harmonic chain, exactly, by the Jacobians of one step of each size."""
    args = Args(0.0, s)

    def step(y, W, h):
        terms = make_terms(_Given(W))  # pyright: ignore[reportCallIssue]
        y1, *_ = solver.step(terms, 0.0, h, (y[:N], y[N:]), args, None, False)
        return jnp.concatenate(y1)

    jacobians = jax.vmap(jax.jacrev(step, argnums=(0, 1)), in_axes=(None, None, 0))
    R, G = jax.jit(jacobians)(jnp.zeros(2 * N), jnp.zeros(N), jnp.asarray(hs))
    A = jax.hessian(lambda y: energy(y[:N], y[N:], 0.0))(jnp.zeros(2 * N))
    defect = np.max(np.abs(R.mT @ A @ R - A), axis=(1, 2))
    # Increments have variance h, and there is one of them in each h.
    return Heating(defect, np.trace(G.mT @ A @ G, axis1=1, axis2=2) / 2)


class _Given(diffrax.AbstractBrownianPath):
    W: jax.Array
    t0 = -jnp.inf
    t1 = jnp.inf
    levy_area = diffrax.BrownianIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del t0, t1, left, use_levy
        return self.W


def midpoint_heating(h: float, s: float = 1.0) -> float:
    """In closed form: a mode of frequency w is heated by (s^2 / 2) / (1 + (h w / 2)^2)."""
    w = 2 * np.sin(np.pi * np.arange(1, N + 1) / (2 * (N + 1)))
    return float(np.sum(s**2 / 2 / (1 + (h * w / 2) ** 2)))


class Nonlinear(NamedTuple):
    # H0 at the end less what it has to be on average.
    excess: Mean
    failed: float


def nonlinear(
    solver,
    make_path,
    h: float,
    t1: float,
    paths: int,
    args: Args,
    amplitude: float = 4.0,
) -> Nonlinear:
    y0 = start(amplitude)
    _, (p, q), failed = ensemble(
        make_terms, make_path, solver, y0, h, round(t1 / h), paths, args=args
    )
    good = ~failed
    if not good.any():
        return Nonlinear(Mean(np.nan, np.nan), 1.0)
    ends = jax.vmap(lambda p, q: energy(p, q, args.beta))(p[good, -1], q[good, -1])
    exact = energy(*y0, args.beta) + N * args.s**2 / 2 * t1
    return Nonlinear(Mean.of(ends - exact), float(np.mean(failed)))


def symplecticity(solver, hs, args: Args, amplitude: float = 4.0) -> np.ndarray:
    """Of one step in 64 dimensions, of each size."""
    path = ds.WeakBrownianPath((N,), jr.key(0))
    defect = lambda h: ds.symplecticity_defect(
        make_terms(path), solver, 0.0, h, start(amplitude), args
    )
    return np.asarray(jax.jit(jax.vmap(defect))(jnp.asarray(hs)))


SOLVERS = {
    "ImplicitMidpoint": (ds.ImplicitMidpoint(), truncated((N,))),
    "SRKs3": (ds.SRKs3(), truncated((N,))),
    "PlateauVerlet": (ds.PlateauVerlet(), plateaus((N,))),
    "Heun": (diffrax.Heun(), gaussian((N,))),
}


def section(page: Page) -> str:
    t1, paths = (2.0, 16) if page.quick else (20.0, 256)
    hs = [0.1] if page.quick else [0.8, 0.4, 0.2, 0.1]
    names = ["ImplicitMidpoint", "Heun"] if page.quick else SOLVERS
    args = Args(beta=1.0, s=0.2)
    sizes = (0.1, 1.0)
    rates = heating(ds.ImplicitMidpoint(), sizes).rate
    midpoint = " and ".join(f"{rate:.2f}" for rate in rates)

    print(f"\nNonlinear chain, beta = 1: energy at t = {t1:g}, {paths} paths")
    figure, axes = plt.subplots(figsize=(6, 4.2))
    for number, name in enumerate(names):
        solver, make_path = SOLVERS[name]
        means = []
        for h in hs:
            r = nonlinear(solver, make_path, h, t1, paths, args)
            assert r.failed == 0
            means.append(r.excess)
            shown = str(r.excess) if abs(r.excess.value) < 1e6 else "overflow"
            print(f"  {name}, h = {h}: {shown}", flush=True)
        y, error = np.array(means).T
        # One beside another, so that no bar hides the next. Means that overflowed, or
        # would need another scale, have no dot.
        shown = np.where(np.abs(y) < 100, y, np.nan)
        beside = np.array(hs) * 1.03 ** (number - 1.5)
        axes.errorbar(beside, shown, 3 * error, label=name, **style(name))
    axes.set(
        xscale="log", xlabel="step $h$", ylabel="mean of $H_0$ less its exact value"
    )
    axes.set_xticks(hs, [f"{h:g}" for h in hs])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.axhline(0, color="k", lw=0.8)
    axes.legend(loc="lower left")
    picture = page.picture(figure, "chain", "Chain of 32 oscillators")
    return fill(
        __file__, picture=picture, t1=f"{t1:g}", paths=paths, midpoint=midpoint,
        sizes=" and ".join(map(str, sizes)),
        heat=f"{N * args.s**2 / 2 * t1:g}", s=args.s,
    )  # fmt: skip
