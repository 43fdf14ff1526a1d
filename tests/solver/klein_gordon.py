"""A Klein-Gordon chain of 4,096 sites, its fast waves split off, and the resonances.

H0 = sum p_j^2 / 2 + (q_(j+1) - q_j)^2 / (2 dx^2) + q_j^2 / 2 + q_j^4 / 4 on a ring.
"""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds


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


def rest(t, p, q, args):
    return jnp.sum(q**4) / 4


def energy(p, q, dx: float = DX):
    bonds = jnp.sum((jnp.roll(q, -1) - q) ** 2) / dx**2
    return jnp.sum(p**2 + q**2) / 2 + bonds / 2 + rest(0, p, q, None)


def start(n: int = N):
    """A smooth bump of height 1/2, at rest."""
    x = np.cos(2 * np.pi * np.arange(n) / n)
    return jnp.zeros(n), jnp.asarray(np.exp(8 * (x - 1)) / 2)


def energies(h: float, steps: int) -> np.ndarray:
    """H0 at the start and after each step, without noise."""
    sol = diffrax.diffeqsolve(
        ds.hamiltonian_terms(rest), ds.LinearFlow(ds.StormerVerlet(), waves()), 0.0,
        h * steps, h, start(), max_steps=steps + 1, adjoint=diffrax.ForwardMode(),
        saveat=diffrax.SaveAt(t0=True, steps=True, fn=lambda t, y, args: energy(*y)),
    )  # fmt: skip
    assert sol.ys is not None
    return np.asarray(sol.ys)[: steps + 1]


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
