"""The Kubo oscillator: an oscillator whose frequency is noisy.

H0 = (p^2 + q^2) / 2 and H1 = s H0, so that every path stays on its circle.
Wang, Hong and Xu (2017), example 2 and figure 3.
"""

import jax.numpy as jnp
import matplotlib

import diffrax_symplectic as ds


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from ._compare import COLOURS, compare, plot_drift, save  # noqa: E402


def make_terms(path, s: float = 1.0):
    def energy(t, p, q, args):
        return (p**2 + q**2) / 2

    def noise(t, p, q, args):
        return s * energy(t, p, q, args)

    return ds.hamiltonian_terms(energy, noise, path)


def main(steps: int = 100_000) -> None:
    y0 = (jnp.array(0.0), jnp.array(1.0))
    radius = lambda y: y[0] ** 2 + y[1] ** 2
    runs = compare("Kubo oscillator", make_terms, radius, y0, h=0.01, steps=steps)

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.5))
    for name in ("Heun", "StratonovichMilstein", "SRKw1"):
        p, q = runs[name].ys.T
        keep = np.isfinite(p) & (p**2 + q**2 < 25)
        left.plot(q[keep], p[keep], ".", ms=2, color=COLOURS[name], label=name)
    angle = np.linspace(0, 2 * np.pi, 200)
    left.plot(np.cos(angle), np.sin(angle), "k-", lw=0.8, label="exact circle")
    left.set(xlabel="q", ylabel="p", aspect="equal", title="Kubo oscillator, one path")
    left.legend(fontsize=7, loc="upper right")
    plot_drift(right, runs)
    save(figure, "kubo.png")


if __name__ == "__main__":
    main()
