"""A free rigid body with one noise about an axis of its own.

dX = Xhat I^-1 X dt + mu Xhat e1 o dw for the angular momentum X in R^3, whose length is
invariant. Not a pair (p, q): three numbers are the state, and plain Diffrax terms.
Wang, Hong and Xu (2017), example 4: figures 5 and 6(b).
"""

import diffrax
import jax.numpy as jnp
import matplotlib

import diffrax_symplectic as ds


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from ._compare import COLOURS, compare, plot_drift, save  # noqa: E402
from ._orders import plot_orders, report, sampled_weak_error  # noqa: E402


def make_terms(path, mu: float = 0.1, inertia=(0.8, 0.6, 0.2)):
    I1, I2, I3 = inertia

    def drift(t, X, args):
        X1, X2, X3 = X
        return jnp.stack(
            [
                (1 / I3 - 1 / I2) * X3 * X2,
                (1 / I1 - 1 / I3) * X3 * X1,
                (1 / I2 - 1 / I1) * X2 * X1,
            ]
        )

    def diffusion(t, X, args):
        _, X2, X3 = X
        return mu * jnp.stack([jnp.zeros_like(X2), X3, -X2])

    return diffrax.MultiTerm(
        diffrax.ODETerm(drift), diffrax.ControlTerm(diffusion, path)
    )


def weak_orders(axes, X0, mu: float = 0.5, paths: int = 100_000) -> None:
    """Figure 6(b): the error of E(X1^2) at t = 1, against a fine solve. (With a stronger
    noise than above, so that its errors show.)"""
    terms = lambda path: make_terms(path, mu)
    weak = lambda key: ds.WeakBrownianPath((), key)
    gaussian = lambda key: diffrax.UnsafeBrownianPath((), key)
    solvers = {
        "SRKw1": (ds.SRKw1(), weak),
        "SRKw2": (ds.SRKw2(), weak),
        "StratonovichMilstein": (diffrax.StratonovichMilstein(), gaussian),
    }
    phi = lambda X: X[0] ** 2
    fine = sampled_weak_error(
        terms, weak, ds.SRKw2(), X0, phi, 0.0, [2.0**-5], 4 * paths
    )
    hs = [2.0**-k for k in range(1, 5)]
    results = {}
    for name, (solver, path) in solvers.items():
        exact = float(fine.errors[0])
        e = sampled_weak_error(terms, path, solver, X0, phi, exact, hs, paths)
        both = np.hypot(e.std_errors, fine.std_errors[0])
        results[name] = e._replace(std_errors=both)
    report(f"Weak error of E(X1^2) at t = 1, mu = {mu}, {paths:,} paths", results)
    plot_orders(axes, "weak error of E(X1^2)", results)


def main(steps: int = 100_000) -> None:
    X0 = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)])
    squared = lambda X: jnp.sum(X**2)
    runs = compare("Rigid body", make_terms, squared, X0, h=0.02, steps=steps)

    figure = plt.figure(figsize=(15, 4.5))
    left = figure.add_subplot(1, 3, 1, projection="3d")
    for name in ("StratonovichMilstein", "SRKw1"):
        X = runs[name].ys
        keep = np.all(np.isfinite(X), axis=1) & (np.sum(X**2, axis=1) < 25)
        left.plot(*X[keep].T, ".", ms=2, color=COLOURS[name], label=name)
    left.set(xlabel="X1", ylabel="X2", zlabel="X3", title="Rigid body, one path")
    left.set_aspect("equal")
    left.legend(fontsize=7)
    plot_drift(figure.add_subplot(1, 3, 2), runs)
    weak_orders(figure.add_subplot(1, 3, 3), X0)
    save(figure, "rigid_body.png")


if __name__ == "__main__":
    main()
