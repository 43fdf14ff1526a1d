"""The Kubo oscillator: an oscillator whose frequency is noisy.

H0 = (p^2 + q^2) / 2 and H1 = s H0, so that every path stays on its circle.
Wang, Hong and Xu (2017), example 2: figures 3 and 2(c).
"""

import diffrax
import jax.numpy as jnp
import matplotlib

import diffrax_symplectic as ds


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from ._compare import COLOURS, compare, plot_drift, save  # noqa: E402
from ._orders import (  # noqa: E402
    exact_moment_map,
    exact_weak_error,
    plot_orders,
    report,
)


def make_terms(path, s: float = 1.0):
    def energy(t, p, q, args):
        return (p**2 + q**2) / 2

    def noise(t, p, q, args):
        return s * energy(t, p, q, args)

    return ds.hamiltonian_terms(energy, noise, path)


def weak_orders(axes) -> None:
    """Figure 2(c): the error of E(q^2) at t = 1 from (p, q) = (0, 1), exactly."""
    y0 = (jnp.array(0.0), jnp.array(1.0))
    # q + ip turns by 1 + w(1): E(q^2) = (1 + E cos(2 + 2 w)) / 2.
    exact = (1 + np.cos(2) * np.exp(-2)) / 2
    weak = lambda key: ds.WeakBrownianPath((), key)
    gaussian = lambda key: diffrax.UnsafeBrownianPath((), key)
    area = lambda key: diffrax.UnsafeBrownianPath(
        (), key, levy_area=diffrax.SpaceTimeLevyArea
    )
    solvers = {
        "SRKw1": (ds.SRKw1(), weak),
        "SRKw2": (ds.SRKw2(), weak),
        "StrangGauss": (ds.StrangGauss(), weak),
        "SlowRK": (diffrax.SlowRK(), area),
        "Heun": (diffrax.Heun(), gaussian),
        "StratonovichMilstein": (diffrax.StratonovichMilstein(), gaussian),
    }
    results = {}
    for name, (solver, path) in solvers.items():
        moment_map = exact_moment_map(make_terms, path, solver, y0)
        hs = [2.0**-k for k in range(2, 9)]
        results[name] = exact_weak_error(moment_map, y0, lambda m: m[1, 1], exact, hs)
    report("Weak error of E(q^2) at t = 1, exact; h = 2^-2 .. 2^-8", results)
    plot_orders(axes, "weak error of E(q^2), exact", results)


def main(steps: int = 100_000) -> None:
    y0 = (jnp.array(0.0), jnp.array(1.0))
    radius = lambda y: y[0] ** 2 + y[1] ** 2
    runs = compare("Kubo oscillator", make_terms, radius, y0, h=0.01, steps=steps)

    figure, (left, right, orders) = plt.subplots(1, 3, figsize=(15, 4.5))
    for name in ("Heun", "StratonovichMilstein", "SRKw1"):
        p, q = runs[name].ys.T
        keep = np.isfinite(p) & (p**2 + q**2 < 25)
        left.plot(q[keep], p[keep], ".", ms=2, color=COLOURS[name], label=name)
    angle = np.linspace(0, 2 * np.pi, 200)
    left.plot(np.cos(angle), np.sin(angle), "k-", lw=0.8, label="exact circle")
    left.set(xlabel="q", ylabel="p", aspect="equal", title="Kubo oscillator, one path")
    left.legend(fontsize=7, loc="upper right")
    plot_drift(right, runs)
    weak_orders(orders)
    save(figure, "kubo.png")


if __name__ == "__main__":
    main()
