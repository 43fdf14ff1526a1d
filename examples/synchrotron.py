"""Synchrotron oscillations of particles in a storage ring, with two noises.

dP = -w^2 sin Q dt - s1 cos Q dw1 - s2 sin Q dw2, dQ = P dt: separable, with noise in the
potential. Wang, Hong and Xu (2017), example 3: figures 4, 2(d) and 6(a).
"""

import diffrax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np

import diffrax_symplectic as ds


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from ._compare import save  # noqa: E402
from ._orders import (  # noqa: E402
    plot_orders,
    report,
    sampled_weak_error,
    strong_errors,
)


OMEGA = 2.0


def H0(t, p, q, args):
    return p**2 / 2 - OMEGA**2 * jnp.cos(q)


def make_terms(path, s1: float = 0.2, s2: float = 0.1):
    noise = lambda t, p, q, args: jnp.stack([s1 * jnp.sin(q), -s2 * jnp.cos(q)])
    return ds.hamiltonian_terms(H0, noise, path)


def weak(key):
    return ds.WeakBrownianPath((2,), key)


def gaussian(key):
    return diffrax.UnsafeBrownianPath((2,), key)


LONG_RUN = {
    "SRKw3a": (ds.SRKw3("a"), weak),
    "SRKw3b": (ds.SRKw3("b"), weak),
    "SRKw3c": (ds.SRKw3("c"), weak),
    "SRKw3d": (ds.SRKw3("d"), weak),
    "SRKw3e": (ds.SRKw3("e"), weak),
    "SRKw3f": (ds.SRKw3("f"), weak),
    "SRKw4": (ds.SRKw4(), weak),
    "SRKs3": (ds.SRKs3(), weak),
    "Euler": (diffrax.Euler(), gaussian),
}
Y0 = (jnp.array(1.0), jnp.array(0.0))


def mean_energy(solver, path, h: float, steps: int, paths: int) -> np.ndarray:
    """The mean of H0 over all paths, at 51 times."""

    def phi(key):
        sol = diffrax.diffeqsolve(
            make_terms(path(key)),
            solver,
            0.0,
            h * steps,
            h,
            Y0,
            saveat=diffrax.SaveAt(ts=jnp.linspace(0, h * steps, 51)),
            max_steps=steps,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        assert sol.ys is not None
        p, q = sol.ys
        return H0(None, p, q, None), sol.result

    return ds.expectation(phi, jr.key(0), paths).mean


def long_run(axes, h: float = 0.02, steps: int = 5_000, paths: int = 64) -> None:
    print(f"\nSynchrotron: mean H0 at t = {h * steps:g}, {paths} paths, h = {h}")
    for i, (name, (solver, path)) in enumerate(LONG_RUN.items()):
        energy = mean_energy(solver, path, h, steps, paths)
        print(f"{name:22}{energy[-1]:10.3f}", flush=True)
        style = dict(color=f"C{i}", ls="--" if name == "Euler" else "-", lw=1)
        axes.plot(np.linspace(0, h * steps, 51), energy, label=name, **style)
    axes.set(
        xlabel="time", title=f"mean of H0 over {paths} paths, h = {h}", ylim=(-4, 60)
    )
    axes.legend(fontsize=7)


def weak_orders(axes, paths: int = 100_000) -> None:
    """Figure 6(a): the error of E(P^2) at t = 1 with one noise, against a fine solve."""
    one_noise = lambda path: ds.hamiltonian_terms(
        H0, lambda t, p, q, args: 0.2 * jnp.sin(q), path
    )
    weak = lambda key: ds.WeakBrownianPath((), key)
    gaussian = lambda key: diffrax.UnsafeBrownianPath((), key)
    solvers = {
        "SRKw3a": (ds.SRKw3("a"), weak),
        "SRKw3c": (ds.SRKw3("c"), weak),
        "SRKw4": (ds.SRKw4(), weak),
        "Euler": (diffrax.Euler(), gaussian),
    }
    phi = lambda y: y[0] ** 2
    args = (phi, 0.0, [2.0**-6], 4 * paths)
    fine = sampled_weak_error(one_noise, weak, ds.SRKw4(), Y0, *args)
    exact = float(fine.errors[0])
    hs = [2.0**-k for k in range(1, 6)]
    results = {}
    for name, (solver, path) in solvers.items():
        e = sampled_weak_error(one_noise, path, solver, Y0, phi, exact, hs, paths)
        both = np.hypot(e.std_errors, fine.std_errors[0])
        results[name] = e._replace(std_errors=both)
    report(f"Weak error of E(P^2) at t = 1, {paths:,} paths; h = 2^-1 .. 2^-5", results)
    plot_orders(axes, "weak error of E(P^2)", results)


def main(paths: int = 100_000) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.5))
    long_run(axes[0])
    weak_orders(axes[1], paths)
    results = strong_errors(
        make_terms,
        {"SRKs3": ds.SRKs3(), "Midpoint": ds.Midpoint(), "Euler": diffrax.Euler()},
        ds.SRKs3(),
        Y0,
        [2.0**-k for k in range(2, 8)],
        m=2,
        paths=1000,
        fine=2**11,
        component=lambda y: y[0],
    )
    report("Strong error of P at t = 1, 1,000 paths; h = 2^-2 .. 2^-7", results)
    plot_orders(axes[2], "strong error of P", results, slopes=(1,))
    save(figure, "synchrotron.png")


if __name__ == "__main__":
    main()
