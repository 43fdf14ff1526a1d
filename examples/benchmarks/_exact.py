"""Exact values of expectations on two models, without sampling."""

import numpy as np
from scipy.linalg import expm
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import expm_multiply
from scipy.special import gammaln, lpmv


def two_noises_square() -> float:
    """E(q^2) at t = 1 from (p, q) = (0, 1), by the linear equation of second moments."""
    A = np.array([[0, -1], [1, 0]])
    Bs = np.array([[0, 1], [1, 0]]) / 2, np.array([[-1, 0], [0, 1]]) / 2
    ito = A + sum(B @ B for B in Bs) / 2
    one = np.eye(2)
    generator = np.kron(ito, one) + np.kron(one, ito) + sum(np.kron(B, B) for B in Bs)
    return float((expm(generator) @ np.array([0, 0, 0, 1.0]))[3])


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
