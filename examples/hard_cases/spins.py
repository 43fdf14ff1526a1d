"""A ring of 1,024 spins with exchange and a noisy field along each axis of each.

H0 = -sum_j s_j . s_(j+1), H_jk = -sigma s_jk: 3,072 noises. Exchange keeps H0 and the
total spin M, which is quadratic in (p, q). The noise turns each spin by itself, so that
E M and E H0 decay like exp(-sigma^2 t) and exp(-2 sigma^2 t), whatever exchange does.
"""

from typing import ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .._pictures import line, WIDTH
from ..stability._page import fill, Page, table
from ._ensemble import Mean


N = 1024


def energy(t, s, args):
    return -jnp.sum(s * jnp.roll(s, 1, axis=0))


def make_terms(path):
    """For the state `to_spinors(s0)`."""
    return ds.spin_terms(energy, lambda t, s, sigma: -sigma * s, path)


def make_plain_terms(path):
    """For the state `s0`, as plain terms of Diffrax."""
    struct = jax.eval_shape(lambda: path.evaluate(0.0, 1.0))

    def drift(t, s, args):
        return jnp.cross(s, jax.grad(energy, argnums=1)(t, s, args))

    def diffusion(t, s, sigma):
        turn = lambda W: -sigma * jnp.cross(s, W)
        return lx.FunctionLinearOperator(turn, struct)

    return diffrax.MultiTerm(
        diffrax.ODETerm(drift), diffrax.ControlTerm(diffusion, path)
    )


class RenormalizedHeun(diffrax.AbstractStratonovichSolver):
    """A step of Heun's method, and then each spin is divided by its length."""

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        control = terms.contr(t0, t1)
        first = terms.vf_prod(t0, y0, args, control)
        second = terms.vf_prod(t1, y0 + first, args, control)
        y1 = y0 + (first + second) / 2
        y1 = y1 / jnp.linalg.norm(y1, axis=-1, keepdims=True)
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful


def start(spins: int = N):
    """Aligned to some degree, of length one."""
    s = jnp.array([0.0, 0.0, 1.0]) + 0.7 * jr.normal(jr.key(0), (spins, 3))
    return s / jnp.linalg.norm(s, axis=-1, keepdims=True)


class Method(NamedTuple):
    solver: diffrax.AbstractSolver
    # Whether it solves for `(p, q)`, and not for `s`.
    lifted: bool

    def terms(self, path):
        return make_terms(path) if self.lifted else make_plain_terms(path)

    def state(self, s):
        return ds.to_spinors(s) if self.lifted else s

    def spins(self, y):
        return ds.from_spinors(y) if self.lifted else y


METHODS = {
    "ImplicitMidpoint, spin_terms": Method(ds.ImplicitMidpoint(), True),
    "ImplicitMidpoint of s": Method(ds.ImplicitMidpoint(), False),
    "Heun, renormalized": Method(RenormalizedHeun(), False),
}


class Course(NamedTuple):
    """Energy, total spin and largest error of a length, in each row of one path."""

    ts: np.ndarray
    energy: np.ndarray
    total: np.ndarray
    length_error: np.ndarray

    @property
    def energy_error(self) -> float:
        """Without noise: how far the energy goes from its start."""
        return float(np.max(np.abs(self.energy - self.energy[:, :1])))

    @property
    def total_error(self) -> float:
        """Without noise: how far the total spin goes from its start."""
        moved = self.total - self.total[:, :1]
        return float(np.max(np.linalg.norm(moved, axis=-1)))

    def excess(self, sigma: float) -> Mean:
        """The energy at the end, less its exact mean."""
        exact = self.energy[:, 0] * np.exp(-2 * sigma**2 * self.ts[-1])
        return Mean.of(self.energy[:, -1] - exact)

    def total_excess(self, sigma: float) -> Mean:
        """The third component of the total spin at the end, less its exact mean."""
        exact = self.total[:, 0, 2] * np.exp(-(sigma**2) * self.ts[-1])
        return Mean.of(self.total[:, -1, 2] - exact)


def course(
    method: Method, sigma: float, h: float, steps: int, paths: int, spins: int = N
) -> Course:
    s0 = start(spins)

    def look(t, y, args):
        s = method.spins(y)
        error = jnp.max(jnp.abs(jnp.linalg.norm(s, axis=-1) - 1))
        return energy(t, s, args), jnp.sum(s, axis=0), error

    def solve(key):
        saveat = diffrax.SaveAt(t0=True, steps=max(1, steps // 100), fn=look)
        sol = diffrax.diffeqsolve(
            method.terms(ds.WeakBrownianPath((spins, 3), key)), method.solver, 0.0,
            h * steps, h, method.state(s0), sigma, saveat=saveat,
            # Room for a step that rounding adds.
            max_steps=steps + 1, adjoint=diffrax.ForwardMode(),
        )  # fmt: skip
        return sol.ts, sol.ys

    # One path after another: a state of these is large enough.
    ts, looks = jax.jit(lambda keys: jax.lax.map(solve, keys))(
        jr.split(jr.key(1), paths)
    )
    good = np.isfinite(ts[0])
    return Course(np.asarray(ts[0])[good], *(np.asarray(x)[:, good] for x in looks))


def poisson_defect(method: Method, h: float, sigma: float, spins: int = 8) -> float:
    """Of one step of a short ring."""
    terms = method.terms(ds.WeakBrownianPath((spins, 3), jr.key(0)))
    y0 = method.state(start(spins))
    defect = lambda h: ds.poisson_defect(terms, method.solver, 0.0, h, y0, sigma)
    return float(jax.jit(defect)(h))


def section(page: Page) -> str:
    t1, noisy_t1, paths, sigma = (
        (10.0, 5.0, 2, 0.1) if page.quick else (200, 50, 8, 0.1)
    )
    h = 0.2
    print(f"\nRing of {N:,} spins without noise, until t = {t1:g}")
    print(f"and with sigma = {sigma}, at t = {noisy_t1:g}, {paths} paths")
    rows = []
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.8))
    for name, method in METHODS.items():
        still = course(method, 0.0, h, round(t1 / h), 1)
        noisy = course(method, sigma, h, round(noisy_t1 / h), paths)
        rows.append(
            (name, f"{still.energy_error:.1e}", f"{still.total_error:.1e}",
             str(noisy.excess(sigma)), f"{poisson_defect(method, h, sigma):.1e}")
        )  # fmt: skip
        look = line(name) | dict(label=name)
        if "spin_terms" in name:
            # It lies below the other one.
            look |= dict(lw=4, alpha=0.4)
        axes[0].plot(still.ts, still.energy[0], **look)
        axes[1].plot(noisy.ts, np.mean(noisy.energy, axis=0), **look)
    ts = np.linspace(0, noisy_t1)
    exact = energy(0.0, start(), None) * np.exp(-2 * sigma**2 * ts)
    axes[1].plot(ts, exact, "k:", label="exact mean")
    header = "method", "$H_0$", "$M$", "noisy $H_0$", "Poisson defect"
    shown = table(header, rows)
    axes[0].set(xlabel="time $t$", ylabel="energy $H_0$", title="without noise")
    axes[1].set(xlabel="time $t$", ylabel="mean energy", title="with noise")
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    picture = page.picture(figure, "spins", "Ring of spins")
    return fill(
        __file__, table=shown, picture=picture, t1=f"{t1:g}", noisy_t1=f"{noisy_t1:g}",
        paths=paths, sigma=sigma, h=h,
    )  # fmt: skip
