"""The linear oscillator with additive noise.

dx = y dt, dy = -x dt + s dw: H0 = (x^2 + y^2) / 2 and H1 = -s x, with the position x and
the momentum y. E(x^2 + y^2) grows by s^2 in each unit of time, exactly. Wang, Hong and Xu
(2017), example 1: figures 1, 2(a), 2(b) and table 1. Everything but the strong errors is
exact here, by the recursion of second moments.
"""

import diffrax
import jax.numpy as jnp
import matplotlib
import numpy as np

import diffrax_symplectic as ds


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from ._compare import save  # noqa: E402
from ._orders import (  # noqa: E402
    exact_moment_map,
    exact_weak_error,
    plot_orders,
    report,
    strong_errors,
)


def make_terms(path, s: float = 1.0):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
        lambda t, p, q, args: -s * q,
        path,
    )


def weak(key, shape=()):
    return ds.WeakBrownianPath(shape, key, second=True)


def gaussian(key, shape=()):
    return diffrax.UnsafeBrownianPath(shape, key, levy_area=diffrax.SpaceTimeLevyArea)


SOLVERS = {
    "Midpoint": (ds.Midpoint(), weak),
    "SRKs1": (ds.SRKs1(), weak),
    "SRKs2": (ds.SRKs2(), weak),
    "SRKs3": (ds.SRKs3(), weak),
    "SRKs4": (ds.SRKs4(), gaussian),
    "SRKw1(b=0)": (ds.SRKw1(b=0.0), weak),
    "SRKw2": (ds.SRKw2(), weak),
    "SRKw3c": (ds.SRKw3("c"), weak),
    "SRKw4(a21=0)": (ds.SRKw4(a21=0.0), weak),
    "SRKw5": (ds.SRKw5(), weak),
    "Heun": (diffrax.Heun(), gaussian),
    "Euler": (diffrax.Euler(), gaussian),
}
# (momentum, position)
Y0 = (jnp.array(1.0), jnp.array(0.0))


def growth(moment_map, h: float, counts: list[int]) -> np.ndarray:
    """E(x^2 + y^2) after so many steps."""
    z0 = np.array([1.0, *map(float, Y0)])
    out = []
    for n in counts:
        with np.errstate(all="ignore"):
            m = np.linalg.matrix_power(moment_map(h), n) @ np.kron(z0, z0)
        value = m[4] + m[8]
        out.append(value if np.isfinite(value) else np.inf)
    return np.array(out)


def main() -> None:
    h, counts = 0.2, [5_000, 10_000, 25_000]
    print(f"\nLinear oscillator: |E(x^2 + y^2) - exact| / N after N steps of h = {h}")
    exact = np.array([1 + h * n for n in counts])
    maps = {
        name: exact_moment_map(make_terms, path, solver, Y0)
        for name, (solver, path) in SOLVERS.items()
    }
    for name, moment_map in maps.items():
        errors = abs(growth(moment_map, h, counts) - exact) / counts
        print(f"{name:22}" + "".join(f"{x:14.3e}" for x in errors), flush=True)

    figure, axes = plt.subplots(1, 3, figsize=(15, 4.5))
    counts = [*range(0, 5001, 250)]
    ts = np.array(counts) * h
    for i, (name, moment_map) in enumerate(maps.items()):
        style = dict(ls="--" if name in ("Heun", "Euler") else "-", lw=1, color=f"C{i}")
        axes[0].plot(ts, growth(moment_map, h, counts), label=name, **style)
    axes[0].plot(ts, 1 + ts, "k:", label="exact")
    axes[0].set(ylim=(0, 2500), xlabel="time", ylabel="E(x^2 + y^2)", title="h = 0.2")
    axes[0].legend(fontsize=7)

    hs = [2.0**-k for k in range(1, 9)]
    # x(1) from (x, y) = (0, 1): sin 1 + int sin(1 - u) dw.
    second_moment = np.sin(1) ** 2 + 1 / 2 - np.sin(2) / 4
    results = {
        name: exact_weak_error(moment_map, Y0, lambda m: m[1, 1], second_moment, hs)
        for name, moment_map in maps.items()
    }
    report("Weak error of E(x^2) at t = 1, exact; h = 2^-1 .. 2^-8", results)
    plot_orders(axes[1], "weak error of E(x^2), exact", results)

    results = strong_errors(
        make_terms,
        {name: SOLVERS[name][0] for name in ("Midpoint", "SRKs4", "Heun", "Euler")},
        ds.SRKs4(),
        (jnp.ones(1), jnp.zeros(1)),
        [2.0**-k for k in range(2, 8)],
        m=1,
        paths=1000,
        fine=2**11,
        component=lambda y: y[1][0],
    )
    report("Strong error of x at t = 1, 1,000 paths; h = 2^-2 .. 2^-7", results)
    plot_orders(axes[2], "strong error of x", results, slopes=(1, 1.5))
    save(figure, "linear_oscillator.png")


if __name__ == "__main__":
    main()
