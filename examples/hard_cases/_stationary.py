"""Moments of the stationary law of Langevin dynamics with steps, without sampling."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds


class Polynomials(NamedTuple):
    """Orthonormal with respect to a density, by the recurrence
    `b[n + 1] f[n + 1] = (x - a[n]) f[n] - b[n] f[n - 1]`."""

    a: np.ndarray
    b: np.ndarray

    @staticmethod
    def of(x: np.ndarray, density: np.ndarray, degree: int) -> "Polynomials":
        """For a density given on a fine grid."""
        density = density / np.sum(density)
        before, now, a, b = np.zeros_like(x), np.ones_like(x), [], [0.0]
        for _ in range(degree):
            a.append(np.sum(density * x * now**2))
            after = (x - a[-1]) * now - b[-1] * before
            b.append(np.sqrt(np.sum(density * after**2)))
            before, now = now, after / b[-1]
        return Polynomials(np.array(a), np.array(b))

    def __call__(self, x, degree: int):
        """All up to `degree`, stacked."""
        f = [jnp.zeros_like(x), jnp.ones_like(x)]
        for a, b, c in zip(self.a[:degree], self.b, self.b[1:]):
            f.append(((x - a) * f[-1] - b * f[-2]) / c)
        return jnp.stack(f[1:])

    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """The Gauss rule of as many points as there are coefficients."""
        off = np.diag(self.b[1:-1], 1)
        points, vectors = np.linalg.eigh(np.diag(self.a) + off + off.T)
        return points, vectors[0] ** 2


class Step(NamedTuple):
    """Steps of `make_terms(make_path(key))` by `solver`."""

    make_terms: Callable
    make_path: Callable
    solver: diffrax.AbstractSolver
    # The state is (p, q), or with Diffrax's terms for Langevin dynamics (q, p).
    q_first: bool = False
    # Points of quadrature for each Gaussian variable of a step.
    nodes: int = 6


def stationary_bias(
    step: Step,
    potential: Callable,
    T: float,
    hs: Iterable[float],
    degrees: tuple[int, int] = (12, 10),
) -> np.ndarray:
    r"""What is too much in E q^2 and E p^2 in the stationary law, for each step size: of
    shape `(len(hs), 2)`.

    With f_0 = 1, f_1, ... the orthonormal polynomials of the Gibbs density of
    p^2 / 2 + V(q), and M_ij the mean of f_i(y0) f_j(y1) if y0 has that density, moments
    c_j = E f_j of the stationary law solve c = c M with c_0 = 1. Here up to `degrees` in q
    and in p. In the law of Gibbs all other c_j are zero, so that nothing cancels.
    """
    n_q, n_p = degrees
    x = np.linspace(-8, 8, 40_001)
    of_q = Polynomials.of(x, np.exp(-potential(x) / T), 2 * n_q)
    of_p = Polynomials(np.zeros(2 * n_p), np.sqrt(T * np.arange(2 * n_p + 1)))
    (q, weights_q), (p, weights_p) = of_q.quadrature(), of_p.quadrature()
    q, p = (z.ravel() for z in np.meshgrid(q, p, indexing="ij"))
    weights = np.outer(weights_q, weights_p).ravel()
    basis = lambda q, p: jnp.outer(of_q(q, n_q), of_p(p, n_p)).ravel()
    terms = step.make_terms(step.make_path(jr.key(0)))

    @jax.jit
    def moments(h):
        def after(x):
            q, p = x
            order = 1 if step.q_first else -1
            y0, fn = (q, p)[::order], lambda t, y, args: basis(*y[::order])
            return ds.step_expectation(
                terms, step.solver, 0.0, h, y0, fn=fn, nodes=step.nodes
            )

        M = project @ jax.lax.map(after, (q, p), batch_size=60)
        rest = jnp.eye(len(M) - 1) - M[1:, 1:]
        return jnp.linalg.solve(rest.T, M[0, 1:])

    project = jax.vmap(basis)(q, p).T * weights
    squares = project[1:] @ np.stack([q**2, p**2], axis=1)
    return np.stack([moments(h) for h in hs]) @ squares
