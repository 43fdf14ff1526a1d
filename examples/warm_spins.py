"""Spins at a temperature against the Langevin function: `python -m examples.warm_spins`.

L(x) = coth x - 1/x is the mean of s_z of one spin in a field B, with x = B / T. It is also
the mean of s_i . s_{i+1} in an open chain with H0 = -J sum s_i . s_{i+1}, with x = J / T
(Fisher 1964, https://doi.org/10.1119/1.1970340). Makes the picture of `docs/spins.md`.
"""

from collections.abc import Callable
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ._pictures import BLUE, style, VERMILION, WIDTH


ALPHA = 0.5
NUM_CHAINS, LENGTH = 128, 8


def langevin(x):
    return 1 / np.tanh(x) - 1 / x


def neighbours(s):
    """The products s_i . s_{i+1} of all neighbours in each chain."""
    return jnp.sum(s[:, 1:] * s[:, :-1], axis=-1)


def in_field(s):
    return s[..., 2]


def warm_terms(H: Callable, path, alpha: float, T: float) -> diffrax.MultiTerm:
    """The Landau-Lifshitz equation whose stationary density is exp(-H / T)."""
    noise = lambda t, s, args: jnp.sqrt(2 * alpha * T) * s
    return ds.spin_terms(lambda t, s, args: H(s), noise, path, damping=alpha)


def sampled(what: Callable, T, h: float = 0.1, steps: int = 800):
    """The mean of `what` for H = -sum of `what`, and its standard error, from `NUM_CHAINS`
    independent runs without their first quarter."""
    shape = NUM_CHAINS, LENGTH, 3
    path = ds.WeakBrownianPath(shape, jr.key(0))
    terms = warm_terms(lambda s: -jnp.sum(what(s)), path, ALPHA, T)
    look = lambda t, y, args: jnp.mean(what(ds.from_spinors(y)), axis=1)
    sol = diffrax.diffeqsolve(
        terms, ds.ImplicitMidpoint(), 0.0, steps * h, h,
        ds.to_spinors(jnp.zeros(shape).at[..., 2].set(1.0)),
        saveat=diffrax.SaveAt(steps=True, fn=look),
        max_steps=steps, adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    assert sol.ys is not None
    means = jnp.mean(sol.ys[steps // 4 :], axis=0)
    return jnp.mean(means), jnp.std(means) / NUM_CHAINS**0.5


def stationary_bias(
    H: Callable, what: Callable, solver, hs, alpha: float, T: float, degree: int = 7
) -> np.ndarray:
    """What is too much in the means of `what(s)`, polynomials of one spin of length 1, in
    the stationary law of steps of each size `hs`. Without sampling.

    On the polynomials of the sphere up to `degree` (that is, its spherical harmonics),
    made orthonormal in the density of Gibbs, a step is a matrix M of the means of
    f_i(s0) f_j(s1). The moments c_j = E f_j of the stationary law solve c = c M, c_0 = 1.
    """
    n = 2 * degree + 4
    z, weights = np.polynomial.legendre.leggauss(n)
    phi = 2 * np.pi * np.arange(2 * n) / (2 * n)
    z, phi = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - z**2)
    s = jnp.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    weights = np.repeat(weights, 2 * n) * np.exp(-np.asarray(jax.vmap(H)(s)) / T)
    weights /= np.sum(weights)

    def powers(s):
        w = s[0] + 1j * s[1]
        values = [
            part * s[2] ** k
            for m in range(degree + 1)
            for part in ([(w**m).real, (w**m).imag][: 1 + (m > 0)])
            for k in range(degree - m + 1)
        ]
        return jnp.stack(values)

    weighted = lambda fn: np.sqrt(weights)[:, None] * np.asarray(jax.vmap(fn)(s))
    Q, R = np.linalg.qr(weighted(powers))
    # The first polynomial is 1, and not -1.
    Q, R = Q * np.sign(R[0, 0]), R * np.sign(R[0, 0])
    terms = warm_terms(H, solver.path((3,), jr.key(0), want="weak"), alpha, T)

    @jax.jit
    def after(h):
        fn = lambda t, y, args: powers(ds.from_spinors(y))
        mean = lambda s: ds.step_expectation(
            terms, solver, 0.0, h, ds.to_spinors(s), fn=fn
        )
        return jax.lax.map(mean, s, batch_size=16)

    seen = Q.T @ weighted(what)
    biases = []
    for h in hs:
        f1 = np.linalg.solve(R.T, np.asarray(after(h)).T).T
        M = Q.T @ (np.sqrt(weights)[:, None] * f1)
        c = np.linalg.solve((np.eye(len(M)) - M)[1:, 1:].T, M[0, 1:])
        biases.append(c @ seen[1:])
    return np.array(biases)


def main():
    figure, (above, below) = plt.subplots(2, 1, figsize=(WIDTH, 6.5))
    fine = np.linspace(0.05, 3, 200)
    above.plot(fine, langevin(1 / fine), "k", label=r"$\coth(1/T) - T$")
    Ts = np.array([0.2, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0])
    for i, (what, label) in enumerate(
        (
            (in_field, "one spin in a field, $s_z$"),
            (neighbours, r"chain, $s_i \cdot s_{i+1}$"),
        )
    ):
        run = jax.jit(lambda T, what=what: sampled(what, T))
        means, errors = np.array([run(T) for T in Ts]).T
        above.errorbar(
            Ts, means, 3 * errors, ls="none", color=(BLUE, VERMILION)[i],
            marker="os"[i], ms=4 + 4 * i, fillstyle="none", label=label,
        )  # fmt: skip
    above.set(xlabel="temperature $T$", ylabel="mean")
    above.set_title("bars of three standard errors")
    hs, T = np.array([0.8, 0.4, 0.2]), 0.6
    H, what = (lambda s: -s[2]), (lambda s: s[2:])
    for solver in (ds.ImplicitMidpoint(), ds.NinomiyaVictoir()):
        bias = stationary_bias(H, what, solver, hs, ALPHA, T, degree=5)[:, 0]
        name = type(solver).__name__
        below.loglog(hs, np.abs(bias), label=name, **style(name))
    below.minorticks_off()
    below.set_xticks(hs, map(str, hs))
    below.set(xlabel="step $h$", ylabel=f"bias of $E[s_z]$ at $T = {T}$")
    below.set_title("without sampling")
    for ax in (above, below):
        ax.legend()
    figure.savefig(Path(__file__).parents[1] / "docs/img/warm_spins.png")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
