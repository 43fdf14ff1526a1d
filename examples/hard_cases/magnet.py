"""A Heisenberg magnet of 1,024 spins at a temperature.

H0 = -sum s_i . s_j over neighbours on a cubic lattice, less B sum s_z. By the
Landau-Lifshitz equation with damping and noise, and by a heat-bath Monte Carlo method,
which draws one spin after another from its law in the field of its neighbours.
"""

import functools as ft
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

from ..stability._page import fill, Page, table


SHAPE = (8, 8, 16)
B = 0.2
ALPHA = 0.5


def neighbours(s):
    """The sums over the six neighbours of each spin."""
    return sum(jnp.roll(s, d, axis=i) for i in range(3) for d in (1, -1))


def energy(t, s, args):
    return -jnp.sum(s * neighbours(s)) / 2 - B * jnp.sum(s[..., 2])


def observe(s):
    """Energy and magnetization along the field, of each spin."""
    number = s.size // 3
    return jnp.stack([energy(0.0, s, None), jnp.sum(s[..., 2])]) / number


class Means(NamedTuple):
    """Energy, magnetization, their standard errors, and the largest error of a length."""

    values: np.ndarray
    std_errors: np.ndarray
    length_error: float = 0.0

    @staticmethod
    def of(rows, length_error: float = 0.0) -> "Means":
        """From rows of one long run. The first quarter is left out; 16 blocks."""
        rows = np.asarray(rows)
        rows = rows[len(rows) // 4 :]
        blocks = rows[: len(rows) // 16 * 16].reshape(16, -1, 2).mean(axis=1)
        return Means(
            blocks.mean(axis=0), blocks.std(axis=0) / np.sqrt(15), length_error
        )


def _up(shape):
    return jnp.zeros((*shape, 3)).at[..., 2].set(1.0)


@ft.partial(jax.jit, static_argnames=("h", "steps", "shape"))
def _follow(T, alpha, key, h: float, steps: int, shape):
    def look(t, y, args):
        s = ds.from_spinors(y)
        return observe(s), jnp.max(jnp.abs(jnp.linalg.norm(s, axis=-1) - 1))

    path = ds.WeakBrownianPath((*shape, 3), key)
    noise = lambda t, s, T: jnp.sqrt(2 * alpha * T) * s
    return diffrax.diffeqsolve(
        ds.spin_terms(energy, noise, path, damping=alpha), ds.ImplicitMidpoint(), 0.0,
        h * steps, h, ds.to_spinors(_up(shape)), T,
        saveat=diffrax.SaveAt(steps=True, fn=look),
        max_steps=steps + 1, adjoint=diffrax.ForwardMode(),
    ).ys  # fmt: skip


def dynamics(T: float, h: float, steps: int, shape=SHAPE, alpha=ALPHA) -> Means:
    """By steps of the Landau-Lifshitz equation. The law does not depend on `alpha`."""
    rows, errors = _follow(T, alpha, jr.key(1), h=h, steps=steps, shape=shape)
    return Means.of(rows[:steps], float(np.max(errors[:steps])))


def _draw(s, key, half, T):
    """New spins on one half of the lattice, from their laws in the field of the other."""
    k_u, k_phi = jr.split(key)
    field = jnp.asarray(neighbours(s)).at[..., 2].add(B)
    size = jnp.linalg.norm(field, axis=-1)
    x = size / T
    # cos of the angle to the field has the density exp(x cos).
    cos = 1 + jnp.log1p(jr.uniform(k_u, size.shape) * jnp.expm1(-2 * x)) / x
    axis = field / size[..., None]
    other = jnp.where(jnp.abs(axis[..., :1]) < 0.5, np.eye(3)[0], np.eye(3)[1])
    first = jnp.cross(axis, other)
    first = first / jnp.linalg.norm(first, axis=-1, keepdims=True)
    phi = 2 * np.pi * jr.uniform(k_phi, (*size.shape, 1))
    turn = jnp.cos(phi) * first + jnp.sin(phi) * jnp.cross(axis, first)
    sin = jnp.sqrt(jnp.maximum(0, 1 - cos**2))
    new = cos[..., None] * axis + sin[..., None] * turn
    return jnp.where(half[..., None], new, s)


@ft.partial(jax.jit, static_argnames=("sweeps", "shape"))
def _sweep(T, key, sweeps: int, shape):
    black = sum(np.indices(shape)) % 2 == 0

    def sweep(s, key):
        k_black, k_white = jr.split(key)
        s = _draw(_draw(s, k_black, black, T), k_white, ~black, T)
        return s, observe(s)

    return jax.lax.scan(sweep, _up(shape), jr.split(key, sweeps))[1]


def monte_carlo(T: float, sweeps: int, shape=SHAPE) -> Means:
    """By heat-bath sweeps, each over the two halves of a checkerboard."""
    return Means.of(_sweep(T, jr.key(2), sweeps=sweeps, shape=shape))


def section(page: Page) -> str:
    steps, sweeps = (50, 100) if page.quick else (2_000, 6_000)
    Ts = [0.8, 2.0] if page.quick else [0.4, 1.0, 1.6, 2.2]
    h = 0.1
    print(f"\nHeisenberg magnet of {np.prod(SHAPE):,} spins, h = {h:g}")
    rows = []
    both = [(dynamics(T, h, steps), monte_carlo(T, sweeps)) for T in Ts]
    ours, coarse = both[0][0], dynamics(Ts[0], 2 * h, steps)
    to_zero = (4 * ours.values[0] - coarse.values[0]) / 3
    its_error = np.hypot(4 * ours.std_errors[0], coarse.std_errors[0]) / 3
    doubled = f"{coarse.values[0]:.4f} ± {coarse.std_errors[0]:.4f}"
    limit = f"{to_zero:.4f} ± {its_error:.4f}"
    for T, (ours, exact) in zip(Ts, both):
        cells = [
            f"{value:.4f} ± {error:.4f}"
            for i in range(2)
            for value, error in ((m.values[i], m.std_errors[i]) for m in (ours, exact))
        ]
        rows.append((f"{T:g}", *cells))
    header = (
        "$T$", "energy: `spin_terms`", "Monte Carlo", "magnetization: `spin_terms`",
        "Monte Carlo",
    )  # fmt: skip
    length = max(ours.length_error for ours, _ in both)
    return fill(
        __file__, table=table(header, rows), h=h, B=B, alpha=ALPHA,
        steps=f"{steps:,}", sweeps=f"{sweeps:,}", coarse=doubled, limit=limit,
        length=f"{length:.0e}",
    )  # fmt: skip
