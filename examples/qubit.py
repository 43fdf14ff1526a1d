"""A noisy qubit against its Lindblad equation: `python -m examples.qubit`.

i dpsi = H psi dt + A psi o dw. The mean of psi psi^dagger follows
d rho / dt = -i [H, rho] - [A, [A, rho]] / 2. Makes the picture of `docs/waves.md`.
"""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ._pictures import BLUE, style, VERMILION, WIDTH


X = np.array([[0, 1], [1, 0]])
Z = np.array([[1, 0], [0, -1]])
H, A = X / 2 + 0.3 * Z, 0.3 * (Z + X / 2)
PSI0 = np.array([np.sqrt(0.9), np.sqrt(0.1) * 1j])


def mean(M, psi):
    return jnp.real(jnp.conj(psi) @ M @ psi)


def make_terms(path):
    return ds.wave_terms(
        lambda t, psi, args: mean(H, psi), lambda t, psi, args: mean(A, psi), path
    )


def lindblad(t):
    """The density matrix."""
    commutator = lambda M: np.kron(M, np.eye(2)) - np.kron(np.eye(2), M.T)
    L = -1j * commutator(H) - commutator(A) @ commutator(A) / 2
    rho = np.outer(PSI0, np.conj(PSI0)).ravel()
    return (jax.scipy.linalg.expm(t * L) @ rho).reshape(2, 2)


def density(solver, t: float, steps: int):
    """The density matrix by steps, without sampling: of the mean of p, q and their
    products."""
    y0 = ds.to_pair(jnp.asarray(PSI0))
    terms = make_terms(ds.WeakBrownianPath((), jr.key(0)))
    K = ds.second_moment_map(terms, solver, 0.0, t / steps, y0)
    flat = jnp.concatenate([jnp.ones(1), *y0])
    moments = jnp.linalg.matrix_power(K, steps) @ jnp.kron(flat, flat)
    m = moments.reshape(5, 5)[1:, 1:]  # of p1, p2, q1, q2
    pp, pq, qp, qq = m[:2, :2], m[:2, 2:], m[2:, :2], m[2:, 2:]
    return (qq + pp + 1j * (pq - qp)) / 2


def sampled(key, times, h: float):
    """<sigma_x> and <sigma_z> of one path."""
    terms = make_terms(ds.WeakBrownianPath((), key))
    sol = diffrax.diffeqsolve(
        terms, ds.StrangGauss(), 0.0, times[-1], h, ds.to_pair(jnp.asarray(PSI0)),
        saveat=diffrax.SaveAt(ts=times), adjoint=diffrax.ForwardMode(),
        max_steps=round(times[-1] / h) + 1,
    )  # fmt: skip
    assert sol.ys is not None
    psi = ds.from_pair(sol.ys)
    return jax.vmap(lambda psi: jnp.stack([mean(M, psi) for M in (X, Z)]))(psi)


def main():
    figure, (above, below) = plt.subplots(2, 1, figsize=(WIDTH, 6.5))
    times, paths = np.arange(1, 13) * 1.0, 1_000
    values = jax.jit(jax.vmap(lambda key: sampled(key, times, 0.1)))(
        jr.split(jr.key(0), paths)
    )
    fine = np.linspace(0, 12, 200)
    rho = jax.vmap(lindblad)(fine)
    for i, (M, name) in enumerate(((X, "x"), (Z, "z"))):
        line = jnp.trace(rho @ M, axis1=1, axis2=2).real
        colour = (BLUE, VERMILION)[i]
        above.plot(fine, line, color=colour, ls=("-", "--")[i])
        bars = 3 * jnp.std(values[..., i], axis=0) / paths**0.5
        above.errorbar(
            times, jnp.mean(values[..., i], axis=0), bars, ls="none", color=colour,
            marker="os"[i], label=rf"$\sigma_{name}$",
        )  # fmt: skip
    above.set(xlabel="time $t$", ylabel=r"mean $E\langle\sigma\rangle$")
    above.set_title(f"lines: Lindblad equation; dots: {paths:,} paths")
    steps = 2 ** np.arange(2, 8)
    for name, solver in (("SRKw1", ds.SRKw1()), ("StrangGauss", ds.StrangGauss())):
        found = jnp.stack([density(solver, 2.0, int(n)) for n in steps])
        bias = jnp.trace((found - lindblad(2.0)) @ X, axis1=1, axis2=2).real
        below.loglog(2 / steps, np.abs(bias), label=name, **style(name))
    below.set_xticks(2 / steps, [f"1/{n // 2}" if n > 2 else "1" for n in steps])
    below.minorticks_off()
    below.set(xlabel="step $h$", ylabel=r"bias of $E\langle\sigma_x\rangle$ at $t = 2$")
    below.set_title("without sampling")
    for ax in (above, below):
        ax.legend()
    figure.savefig(Path(__file__).parents[1] / "docs/img/qubit.png")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
