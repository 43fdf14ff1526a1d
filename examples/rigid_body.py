"""A free rigid body with one noise about an axis of its own.

dX = Xhat I^-1 X dt + mu Xhat e1 o dw for the angular momentum X in R^3, whose length is
invariant. Not a pair (p, q): three numbers are the state, and plain Diffrax terms.
Wang, Hong and Xu (2017), example 4: figures 5 and 6(b).
"""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullLocator

import diffrax_symplectic as ds

from ._command import run
from ._gallery import (
    briefly,
    claim,
    gaussian,
    PAPER_SRKW2,
    save,
    trajectory,
    truncated,
    weak,
)
from ._orders import (
    claim_samples,
    claim_slopes,
    claim_small_first_order,
    plot_orders,
    report,
    resolved,
    resolved_solvers,
    sampled_weak_error,
)
from ._pictures import colour, line, style, WIDTH
from ._transfer import enumerated_expectation, transfer_weak_errors
from .benchmarks._exact import rigid_body_square


def make_terms(path, mu=0.1, inertia=(0.8, 0.6, 0.2)):
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


X0 = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)])
SOLVERS = {
    "Milstein": (diffrax.StratonovichMilstein(), gaussian()),
    "Heun": (diffrax.Heun(), gaussian()),
    "SRKs1": (ds.SRKs1(), truncated),
    "SRKw1(b=0)": (ds.SRKw1(b=0.0), weak()),
    "SRKw2": (PAPER_SRKW2, weak()),
}


def figure_5(full: bool) -> None:
    """One path on the sphere, with the paper's noise and a stronger one."""
    h, steps = 0.02, 2_000
    print(f"\nFig. 5: one path to t = {h * steps:g}, h = {h}; the largest ||X| - 1|")
    mus = (0.1, 0.2, 1.0)
    figure, axes = plt.subplots(
        2, 5, figsize=(WIDTH, 3.4), subplot_kw={"projection": "3d"}
    )
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    sphere = np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)
    drifts = {}
    for i, (name, (solver, path)) in enumerate(SOLVERS.items()):

        @briefly
        def solve_all(mus, solver=solver, path=path):
            def one(mu):
                terms = lambda path: make_terms(path, mu)
                return trajectory(terms, path, solver, X0, h, steps, every=1)

            return jax.vmap(one)(mus)

        _, X, success = solve_all(jnp.array(mus))
        with np.errstate(all="ignore"):
            length = np.linalg.norm(X, axis=-1)
        # Numbers that overflow are infinite.
        drifts[name] = np.nan_to_num(np.max(np.abs(length - 1), axis=1), nan=np.inf)
        assert i < 2 or np.all(success)
        listed = ", ".join(f"{d:.1e} (mu = {mu})" for d, mu in zip(drifts[name], mus))
        print(f"    {name:12} {listed}", flush=True)
        for ax, j in zip(axes[:, i], (0, 2)):
            ax.plot_wireframe(*sphere, color="0.85", lw=0.3)
            shown = np.asarray(X[j])[length[j] < 1.5]
            ax.plot(*shown.T, ".", ms=1, color=colour(name))
            drift = drifts[name][j]
            error = f"off by {drift:.0e}" if np.isfinite(drift) else "overflows"
            ax.set_title(f"{name}\n{error}" if j == 0 else error, fontsize=9, y=1.04)
            ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
            ax.set_box_aspect((1, 1, 1), zoom=1.25)
            ax.set_axis_off()
    for ax, j in zip(axes[:, 0], (0, 2)):
        ax.text2D(-0.2, 0.5, rf"$\mu = {mus[j]:g}$", rotation=90, va="center",
                  transform=ax.transAxes)  # fmt: skip
    save(figure, "fig5.png")
    for name, drift in drifts.items():
        ours = isinstance(SOLVERS[name][0], ds.AbstractSymplecticRungeKutta)
        bounds = dict(high=1e-11) if ours else dict(low=1e-5)
        worst = drift.max() if ours else drift.min()
        claim(f"largest ||X| - 1| of {name}", worst, **bounds)


def figure_6b(full: bool) -> None:
    """Weak error of E(X1^2) at t = 1."""
    paths = 20_000_000 if full else 100_000
    print(
        f"\nFig. 6(b): weak error of E(X1^2) at t = 1, h = 2^-1 .. 2^-8; {paths:,} paths"
    )
    hs = [2.0**-k for k in range(1, 9)]
    solvers = {name: SOLVERS[name] for name in ("SRKw1(b=0)", "SRKw2", "Milstein")}
    phi = lambda X: X[0] ** 2
    # Three standard deviations of the largest of them.
    value = rigid_body_square(0.1, 1.0, degree=60, turns=60)
    exact, _ = transfer_weak_errors(
        make_terms, solvers, X0, phi, hs, (0.3,) * 3, degree=8, exact=value
    )
    sampled = {
        name: sampled_weak_error(
            make_terms, path, solver, X0, phi, value, resolved(hs, full), paths
        )
        for name, (solver, path) in resolved_solvers(solvers, full).items()
    }
    print(f"  E(X1^2) = {value:.9f}")
    report("exact", exact)
    report("sampled", sampled)
    figure, axes = plt.subplots(figsize=(6, 4.5))
    plot_orders(axes, "6(b): weak error of $E[X_1^2]$", exact, sampled)
    save(figure, "fig6b.png")
    claim_slopes(exact, {"SRKw2": 2, "Milstein": 1})
    claim_small_first_order("SRKw1(b=0)", exact["SRKw1(b=0)"])
    coarse, fine = exact["SRKw2"].signed[-2:]
    claim("SRKw2, extrapolated", abs(fine + (fine - coarse) / 3), high=1e-9)
    claim_samples(exact, sampled)
    terms = make_terms(weak()(jr.key(0)))
    all_paths = briefly(
        lambda: enumerated_expectation(terms, ds.SRKw1(b=0.0), X0, phi, 0.5, 2)
    )
    difference = float(all_paths()) - value - exact["SRKw1(b=0)"].signed[0]
    claim("transfer against all paths of two steps", abs(difference), high=1e-8)


def spinor_terms(path, mu=0.1, inertia=(0.8, 0.6, 0.2)):
    """The same body with a noise about each of its axes, for `ds.to_spinors(X0)`."""
    H0 = lambda t, X, args: jnp.sum(X**2 / jnp.array(inertia)) / 2
    return ds.spin_terms(H0, lambda t, X, args: mu * X, path)


def local_weak_errors(hs, mu=0.5, inertia=(0.8, 0.6, 0.2)):
    r"""Of E(X1^2) after one step by NinomiyaVictoir with strong noise, exactly: the
    expectation of the step less the first terms of the exact one, $\sum_{j \le 2} h^j
    L^j \phi / j!$."""
    path = ds.NinomiyaVictoir().path((3,), jr.key(0))
    terms, y0 = spinor_terms(path, mu, inertia), ds.to_spinors(X0)

    def expected(h):
        square = lambda t, y, args: ds.from_spinors(y)[0] ** 2
        return ds.step_expectation(terms, ds.NinomiyaVictoir(), 0.0, h, y0, fn=square)

    # For X itself and not for spinors, whose derivatives are long: turns of X about each
    # axis make up the generator.
    turn = lambda phi, axis: lambda X: jnp.cross(X, axis) @ jax.grad(phi)(X)

    def L(phi):
        drift = lambda X: jnp.cross(X, X / jnp.array(inertia)) @ jax.grad(phi)(X)
        second = [turn(turn(phi, axis), axis) for axis in jnp.eye(3)]
        return lambda X: drift(X) + mu**2 / 2 * sum(f(X) for f in second)

    phi = lambda X: X[0] ** 2
    exact = lambda h: phi(X0) + h * L(phi)(X0) + h**2 / 2 * L(L(phi))(X0)
    return np.asarray(briefly(jax.vmap(lambda h: expected(h) - exact(h)))(hs))


def figure_poisson(full: bool) -> None:
    """Past the paper: three noises, by `spin_terms`."""
    hs = 2.0 ** -np.arange(2, 8)
    steps = 20_000 if full else 2_000
    print(f"\nThree noises, one about each axis: Poisson defect; {steps:,} steps")
    y0, path = briefly(ds.to_spinors)(X0), gaussian(3)(jr.key(0))
    pairs = spinor_terms(path), y0
    # The midpoint rule for X itself, with the one noise of the paper.
    itself = make_terms(gaussian()(jr.key(0))), X0

    def defects(terms, y0):
        defect = lambda h: ds.poisson_defect(terms, ds.ImplicitMidpoint(), 0.0, h, y0)
        return np.asarray(briefly(jax.vmap(defect))(hs))

    of_pairs, of_X = defects(*pairs), defects(*itself)
    ts, y, success = briefly(
        lambda: trajectory(
            spinor_terms, gaussian(3), ds.ImplicitMidpoint(), y0, 0.1, steps, every=1
        )
    )()
    assert success
    length = np.abs(np.linalg.norm(briefly(ds.from_spinors)(y), axis=-1) - 1)
    local_hs = 2.0 ** -np.arange(2, 7)
    local = np.abs(local_weak_errors(local_hs))
    slope = np.polyfit(np.log(local_hs), np.log(local), 1)[0]
    figure = plt.figure(figsize=(WIDTH, 6.5))
    panels = figure.subplot_mosaic("AB;CC")
    axes = [panels[name] for name in "ABC"]
    midpoint = style("ImplicitMidpoint")
    hollow = midpoint | dict(ls=":", mfc="white")
    axes[0].loglog(hs, of_X, label="for $X$ itself", **hollow)
    axes[0].loglog(hs, of_pairs, label="with spin_terms", **midpoint)
    axes[0].set(
        xlabel="step $h$", ylabel="Poisson defect of one step", ylim=(1e-17, 10)
    )
    axes[0].set_title("ImplicitMidpoint")
    axes[0].legend(loc="center", bbox_to_anchor=(0.5, 0.3))
    # Below one unit in the last place there is nothing.
    shown = np.maximum.accumulate(np.maximum(length, 1e-17))
    axes[1].semilogy(ts, shown, **line("ImplicitMidpoint"))
    axes[1].set(xlabel="time", ylabel=r"$||X| - 1|$, largest so far")
    axes[1].set_ylim(1e-17, 1e-12)
    axes[1].set_title("spin_terms, $h = 0.1$")
    label = f"slope {slope:.2f}"
    axes[2].loglog(local_hs, local, label=label, **style("NinomiyaVictoir"))
    cube = local[0] * (local_hs / local_hs[0]) ** 3
    axes[2].loglog(local_hs, cube, "k:", label="$h^3$")
    axes[2].set(xlabel="step $h$", ylabel="weak error of one step, $E[X_1^2]$")
    axes[2].set_title("NinomiyaVictoir")
    axes[2].legend(loc="upper left")
    for ax, sizes in ((axes[0], hs), (axes[2], local_hs)):
        ax.set_xticks(sizes[::2], [f"1/{1 / h:.0f}" for h in sizes[::2]])
        ax.xaxis.set_minor_locator(NullLocator())
    save(figure, "poisson.png")
    claim("Poisson defect by spin_terms", of_pairs.max(), high=1e-13)
    claim("Poisson defect of the midpoint rule for X, h = 1/4", of_X[0], low=1e-4)
    claim("largest ||X| - 1| by spin_terms", np.nanmax(length), high=1e-11)
    claim("order of the local weak error, NinomiyaVictoir", slope, 2.9, 3.1)


FIGURES = {"5": figure_5, "6b": figure_6b, "poisson": figure_poisson}


if __name__ == "__main__":
    run(dict.fromkeys(FIGURES, "rigid_body"))
