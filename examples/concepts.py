"""The picture of the page on concepts: a disk of initial states of a noisy pendulum, by a
symplectic and by an explicit method.

    python -m examples.concepts
"""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ._pictures import WIDTH


jax.config.update("jax_enable_x64", True)

H, TIMES = 0.6, (0.0, 12.0, 24.0)
IMG = Path(__file__).parent.parent / "docs" / "img"


def disk(count: int = 2000) -> tuple[jax.Array, jax.Array]:
    """The boundary of a disk of initial states (p, q)."""
    angle = jnp.linspace(0, 2 * jnp.pi, count)
    return 0.4 * jnp.cos(angle), 1.0 + 0.4 * jnp.sin(angle)


def area(p: np.ndarray, q: np.ndarray) -> float:
    """The area that a closed curve encloses."""
    return float(abs(np.sum(p * np.roll(q, 1) - q * np.roll(p, 1))) / 2)


def carried(solver) -> tuple[np.ndarray, np.ndarray]:
    """The boundary at all `TIMES`, every state driven by the same noise."""
    energy = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
    noise = lambda t, p, q, args: 0.2 * jnp.sin(q)
    path = ds.StormerVerlet().path((), jr.key(3))
    terms = ds.hamiltonian_terms(energy, noise, path)
    saveat = diffrax.SaveAt(ts=jnp.array(TIMES))
    solve = lambda y0: (
        diffrax.diffeqsolve(terms, solver, 0.0, TIMES[-1], H, y0, saveat=saveat).ys
    )
    p, q = jax.jit(jax.vmap(solve))(disk())
    return np.asarray(p).T, np.asarray(q).T


def main() -> None:
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 4.4), sharex=True, sharey=True)
    solvers = (ds.StormerVerlet(), "Störmer-Verlet"), (diffrax.Heun(), "Heun")
    for ax, (solver, name) in zip(axes, solvers):
        for t, p, q in zip(TIMES, *carried(solver)):
            label = f"$t = {t:g}$, area {area(p, q):.3f}"
            ax.fill(q, p, alpha=0.35, label=label)
        ax.set(title=f"{name}, $h = {H}$", xlabel="$q$", aspect="equal")
        ax.set_ylim(-1.7, 2.9)
        ax.legend(loc="upper left")
    axes[0].set(ylabel="$p$")
    figure.savefig(IMG / "concepts.png")


if __name__ == "__main__":
    main()
