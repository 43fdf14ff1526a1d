"""Exact values of the expectations in `total_error`, without sampling where that can be."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.linalg import expm
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import expm_multiply
from scipy.special import gammaln, lpmv

import diffrax_symplectic as ds
from diffrax_symplectic._simulation.levels import level_weights

from .._gallery import weak
from .._transfer import transfer_expectations
from ..hard_cases import chain


def linear_oscillator_square() -> float:
    """E(q^2) at t = 1."""
    return float(np.sin(1) ** 2 + 1 / 2 - np.sin(2) / 4)


def kubo_square() -> float:
    """E(q^2) at t = 1: q + ip turns by 1 + w(1)."""
    return float((1 + np.cos(2) * np.exp(-2)) / 2)


def two_noises_square() -> float:
    """E(q^2) at t = 1 from (p, q) = (0, 1), by the linear equation of second moments."""
    A = np.array([[0, -1], [1, 0]])
    Bs = np.array([[0, 1], [1, 0]]) / 2, np.array([[-1, 0], [0, 1]]) / 2
    ito = A + sum(B @ B for B in Bs) / 2
    one = np.eye(2)
    generator = np.kron(ito, one) + np.kron(one, ito) + sum(np.kron(B, B) for B in Bs)
    return float((expm(generator) @ np.array([0, 0, 0, 1.0]))[3])


def by_transfer(
    make_terms: Callable, y0, phi: Callable, t1: float, steps: int, widths, degree: int
) -> float:
    """By Richardson's extrapolation of what `StormerVerlet` expects for two noises, with so
    many steps, half of them and a quarter, computed backwards in time."""
    coarse, middle, fine = transfer_expectations(
        make_terms, weak(2), ds.StormerVerlet(), y0, phi,
        [t1 / n for n in (steps // 4, steps // 2, steps)], widths, degree, t1,
    )  # fmt: skip
    # The error has all powers of the step from the second on.
    first, second = middle + (middle - coarse) / 3, fine + (fine - middle) / 3
    return float(second + (second - first) / 7)


def by_splines(
    mean_after: Callable, y0, t1: float, steps: int, box, size: int = 200
) -> float:
    """E(q^2) for one degree of freedom, without sampling: what `mean_after(h)` says of the
    mean of a function after a step is carried back by quintic splines in a box that no path
    leaves, and four step sizes are extrapolated."""
    axes = [np.linspace(-half, half, size) for half in box]
    grid = np.meshgrid(*axes, indexing="ij")

    def spline(values):
        u = RectBivariateSpline(axes[0], axes[1], values, kx=5, ky=5)
        return lambda *y: u.ev(*(np.clip(x, -b, b) for x, b in zip(y, box)))

    def mean(steps: int) -> float:
        expected, u = mean_after(t1 / steps), spline(grid[1] ** 2)
        for _ in range(steps - 1):
            u = spline(expected(u, *grid))
        return float(expected(u, *map(np.asarray, y0)))

    means = [mean(steps * 2**k) for k in range(4)]
    return float(level_weights(2, 4)[0] @ means)


def verlet(force: Callable, kick: Callable) -> Callable:
    """The drift, kick and drift of a step for unit mass and one noise, without any of this
    package, and the mean over its three outcomes."""

    def mean_after(h: float):
        def end(p, q, increment):
            q = q + h / 2 * p
            p = p + h * force(q) + increment * kick(q)
            return p, q + h / 2 * p

        outcomes = zip((1 / 6, 2 / 3, 1 / 6), np.sqrt(3 * h) * np.array([-1, 0, 1]))
        each = [*outcomes]
        return lambda u, p, q: sum(w * u(*end(p, q, x)) for w, x in each)

    return mean_after


def step_of(terms, solver) -> Callable:
    """The mean over all outcomes of a step of a solver."""

    def mean_after(h: float):
        functions = []
        number = jax.ShapeDtypeStruct((), float)
        call = lambda p, q: functions[-1](p, q)

        def fn(t, y, args):
            return jax.pure_callback(call, number, *y, vmap_method="broadcast_all")

        mean = lambda *y: ds.step_expectation(terms, solver, 0.0, h, y, fn=fn)
        means = jax.jit(jax.vmap(mean))

        def expected(u, p, q):
            functions.append(u)
            return np.asarray(means(np.ravel(p), np.ravel(q))).reshape(np.shape(p))

        return expected

    return mean_after


def rigid_body_square(
    mu: float, t1: float = 4.0, degree: int = 300, turns: int = 20
) -> float:
    r"""E(X_1^2), by the backward Kolmogorov equation in spherical harmonics about the axis
    of the noise.

    With the rotations $R_k = (e_k \times X) \cdot \nabla$ the generator is
    $-\sum_k (X_k / I_k) R_k + \frac{\mu^2}{2} R_1^2$. The noise damps harmonics of more
    than a few `turns` about the axis.
    """
    degrees = np.concatenate([[k] * (2 * k + 1) for k in range(degree + 1)])
    turn = np.concatenate([np.arange(-k, k + 1) for k in range(degree + 1)])
    n = len(degrees)
    place = degrees * (degrees + 1) + turn
    # Angular momenta: axis 1 is the polar one, and 2 and 3 are the two across.
    raises = np.flatnonzero(turn < degrees)
    size = np.sqrt((degrees - turn) * (degrees + turn + 1.0))[raises]
    up = csr_array((size, (place[raises] + 1, raises)), (n, n))
    L1, L2, L3 = diags_array(1.0 * turn), (up + up.T) / 2, (up - up.T) / 2j
    # Multiplication by X_1, and by the others from [L_2, X_1] and [L_3, X_1].
    inner = np.flatnonzero((degrees > 0) & (np.abs(turn) < degrees))
    size = np.sqrt((degrees**2 - turn**2) / (4.0 * degrees**2 - 1))[inner]
    below = (degrees[inner] - 1) * degrees[inner] + turn[inner]
    down = csr_array((size, (below, inner)), (n, n))
    X1 = down + down.T
    X3, X2 = 1j * (L2 @ X1 - X1 @ L2), -1j * (L3 @ X1 - X1 @ L3)
    drift = sum(
        -1j / inertia * (X @ L)
        for inertia, X, L in zip((0.8, 0.6, 0.2), (X1, X2, X3), (L1, L2, L3))
    )
    generator = csr_array(drift - mu**2 / 2 * (L1 @ L1))
    # X_1^2 = 1/3 + 2/3 P_2(X_1)
    phi = np.zeros(n, complex)
    phi[0], phi[6] = np.sqrt(4 * np.pi) / 3, 2 / 3 * np.sqrt(4 * np.pi / 5)
    kept = np.abs(turn) <= turns
    u = expm_multiply(generator[kept][:, kept] * t1, phi[kept])
    return float(np.real(_harmonics(degrees[kept], turn[kept]) @ u))


def _harmonics(degrees: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """At (cos 1.1, 0, sin 1.1)."""
    m = np.abs(turn)
    scale = gammaln(degrees - m + 1) - gammaln(degrees + m + 1)
    scale = np.sqrt((2 * degrees + 1) / (4 * np.pi) * np.exp(scale))
    sign = np.where((turn < 0) & (m % 2 == 1), -1, 1)
    return sign * scale * lpmv(m, degrees, np.cos(1.1)) * 1j**turn


def chain_square(
    beta: float, s: float, t1: float, steps: int, paths: int, replicates: int
) -> tuple[float, float]:
    """E(|q|^2 / N), and its standard error. That of the harmonic chain is known; what the
    quartic springs change is sampled, along paths of both chains with the same noise. It
    varies eight hundred times less than the expectation itself does."""

    def H0(t, p, q, args):
        return chain.energy(p[0], q[0], beta) + chain.energy(p[1], q[1], 0.0)

    def phi(t, y, args):
        quartic, harmonic = jnp.mean(y[1] ** 2, axis=1)
        return quartic - harmonic

    path = ds.FixedStepBrownianPath((chain.N,), jr.key(0))
    terms = ds.hamiltonian_terms(
        H0, lambda t, p, q, args: -s * jnp.sum(q, axis=0), path
    )
    y0 = tuple(jnp.stack([x, x]) for x in chain.start(1.0))
    slowest = chain.start(1.0)[1]
    sort_by = lambda y: (y[0][0] @ slowest, y[1][0] @ slowest)
    change = ds.expectation(
        phi, terms, ds.StormerVerlet(), 0.0, t1, t1 / steps, y0, key=jr.key(1), levels=2,
        sampling=ds.ArrayRQMC(paths, replicates, sort_by),
    )  # fmt: skip
    return _harmonic_chain_square(s, t1) + float(change.mean), float(change.std_error)


def _harmonic_chain_square(s: float, t: float) -> float:
    """From the slowest mode: each mode is an oscillator with a noise of its own."""
    modes = np.arange(1, chain.N + 1)
    w = 2 * np.sin(np.pi * modes / (2 * (chain.N + 1)))
    start = np.sum(np.square(chain.start(1.0)[1])) * np.cos(w[0] * t) ** 2
    variances = s**2 * (t / (2 * w**2) - np.sin(2 * w * t) / (4 * w**3))
    return float((start + np.sum(variances)) / chain.N)
