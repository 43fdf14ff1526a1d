"""The linear oscillator with additive noise.

dx = y dt, dy = -x dt + s dw: H0 = (x^2 + y^2) / 2 and H1 = -s x, with the position x and
the momentum y. E(x^2 + y^2) grows by s^2 in each unit of time, exactly. Wang, Hong and Xu
(2017), example 1: figures 1, 2(a), 2(b) and table 1.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from ._command import run
from ._gallery import (
    briefly,
    claim,
    gaussian,
    PAPER_SRKS3,
    PAPER_SRKW2,
    save,
    solve,
    weak,
)
from ._orders import (
    claim_samples,
    claim_slopes,
    Errors,
    exact_moment_map,
    exact_weak_error,
    one_step,
    plot_orders,
    quasi_weak_error,
    report,
    resolved,
    second_moments,
    strong_errors,
)
from ._pictures import BLUE, line, VERMILION, WIDTH


def make_terms(path, s: float = 1.0):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
        lambda t, p, q, args: -s * q,
        path,
    )


# (momentum, position)
Y0 = (jnp.array(1.0), jnp.array(0.0))
PAPER_SRKs4 = ds.SRKs4(sign=1)
# The rows of table 1, with the paper's figures after 5,000, 10,000 and 25,000 steps.
# Gaussian increments serve the strong methods as well as truncated ones here: the stage
# equations are linear, and have a solution whatever the increment is.
TABLE_1 = {
    "Euler": (diffrax.Euler(), gaussian(), (7.34e82, 5.40e167, np.inf)),
    "Heun": (diffrax.Heun(), gaussian(), (0.44426, 2.50545, 443.928)),
    "SRKw1(b=0)": (ds.SRKw1(b=0.0), weak(), (0.002512, 0.001959, 0.002089)),
    "SRKw2": (PAPER_SRKW2, weak(), (0.004205, 0.004159, 0.004082)),
    "SRKw3a": (ds.SRKw3("a"), weak(), (0.002140, 0.001983, 0.002059)),
    "SRKw3b": (ds.SRKw3("b"), weak(), (0.000061, 0.000254, 0.000040)),
    "SRKw3c": (ds.SRKw3("c"), weak(), (0.000160, 0.000134, 0.000285)),
    "SRKw3d": (ds.SRKw3("d"), weak(), (0.002079, 0.001873, 0.001957)),
    "SRKw3e": (ds.SRKw3("e"), weak(), (0.000298, 0.000048, 0.000217)),
    "SRKw3f": (ds.SRKw3("f"), weak(), (0.000021, 0.000197, 0.000446)),
    "SRKw4(a21=0)": (ds.SRKw4(a21=0.0), weak(), (0.000145, 0.000162, 0.000216)),
    "SRKw5": (ds.SRKw5(), weak(second=True), (0.000336, 0.000022, 0.000051)),
    "SRKs1": (ds.SRKs1(), gaussian(), (0.000890, 0.001168, 0.001151)),
    "SRKs2": (ds.SRKs2(), gaussian(), (0.002091, 0.002016, 0.001959)),
    "SRKs3": (PAPER_SRKS3, gaussian(), (0.002626, 0.002448, 0.002180)),
    "SRKs4(sign=1)": (PAPER_SRKs4, gaussian(area=True), (0.002417, 0.002449, 0.002314)),
}
H = 0.2
COUNTS = (5_000, 10_000, 25_000)
# A quick run samples one method of each kind. It cannot resolve the biases, which are exact
# beside it.
SAMPLED = ("Heun", "SRKw2")


class Growth(NamedTuple):
    """x^2 + y^2 after every thousand steps, by one method."""

    exact: np.ndarray
    # NaN where it was not sampled.
    sampled: np.ndarray
    std_errors: np.ndarray


def growth(name: str, steps: int, paths: int, full: bool) -> Growth:
    solver, path, _ = TABLE_1[name]
    moment_map = exact_moment_map(make_terms, path, solver, Y0)
    counts = 1000 * np.arange(1, COUNTS[-1] // 1000 + 1)
    moments = [np.trace(second_moments(moment_map, Y0, H, int(n))) for n in counts]
    exact = np.nan_to_num(np.array(moments), nan=np.inf)
    sampled, std_errors = np.full((2, len(counts)), np.nan)
    # Euler's numbers overflow.
    if name in SAMPLED or (full and name != "Euler"):
        y0 = jax.tree.map(lambda y: y.astype(jnp.float32), Y0)

        def phi(key):
            saveat = diffrax.SaveAt(steps=1000)
            terms = make_terms(path(key))
            sol = solve(terms, solver, y0, H * steps, H, saveat=saveat, max_steps=steps)
            assert sol.ys is not None
            return sol.ys[0] ** 2 + sol.ys[1] ** 2, sol.result

        # In single precision: its rounding errors are far below what sampling leaves.
        with jax.enable_x64(False):
            estimate = ds.monte_carlo(phi, key=jr.key(0), num_paths=paths)
        assert estimate.num_failed == 0
        sampled[: steps // 1000] = estimate.mean
        std_errors[: steps // 1000] = estimate.std_error
    return Growth(exact, sampled, std_errors)


def figure_1(full: bool) -> None:
    """Figure 1 and table 1: growth of the second moment."""
    steps, paths = (25_000, 1_000_000) if full else (5_000, 1_000)
    print(
        "\nTable 1: |E(x^2 + y^2) - exact| / N after N = 5,000, 10,000, 25,000 steps of"
    )
    print(f"  h = {H}; exact | over {paths:,} paths (of {steps:,} steps) | the paper's")
    columns = np.array(COUNTS) // 1000 - 1
    # x^2 + y^2 comes to be exponentially distributed: its deviation is its mean.
    paper_bar = H / np.sqrt(1e6)
    results, off = {}, {}
    for name, (_, _, paper) in TABLE_1.items():
        results[name] = g = growth(name, steps, paths, full)
        true = 1 + H * np.array(COUNTS)
        bias, sampled = (
            np.abs(x[columns] - true) / COUNTS for x in (g.exact, g.sampled)
        )
        bars = g.std_errors[columns] / COUNTS
        with np.errstate(invalid="ignore"):
            off[name] = np.abs(g.sampled - g.exact)[columns] / g.std_errors[columns]
        row = ["".join(f"{x:10.3g}" for x in bias)]
        row += [" ".join(f"{x:.4f} ± {b:.4f}" for x, b in zip(sampled, bars) if b > 0)]
        row += ["".join(f"{x:10.3g}" for x in paper)]
        symplectic = bias.max() < 0.1
        if symplectic and np.any(np.abs(paper - bias) > 4 * paper_bar):
            row += ["differs"]
        print(f"  {name:14}" + " | ".join(row), flush=True)
    plot_growth(results)
    for name in TABLE_1:
        if np.any(np.isfinite(off[name])):
            claim(f"table 1, {name}, in standard errors", np.nanmax(off[name]), high=4)
    for one, other in ("ad", "be", "cf"):
        same = results[f"SRKw3{one}"].exact - results[f"SRKw3{other}"].exact
        claim(f"SRKw3{one} less SRKw3{other}", np.max(np.abs(same)), high=1e-8)
    for name in ("Euler", "Heun"):
        claim(f"growth of {name}", results[name].exact[-1], low=1000 * H * COUNTS[-1])


def plot_growth(results: dict[str, Growth]) -> None:
    figure, axes = plt.subplots(2, 1, figsize=(WIDTH, 7.5), height_ratios=(1, 1.4))
    counts = 1000 * np.arange(1, COUNTS[-1] // 1000 + 1)
    paper = dict(ls="none", marker="x", color=VERMILION)
    for i, (name, g) in enumerate(results.items()):
        symplectic = i >= 2
        # The symplectic methods lie on top of each other: one colour, one entry.
        look = dict(color=BLUE) if symplectic else line(name)
        label = f"{len(results) - 2} symplectic methods" if i == 2 else name
        if name == "Euler":
            label = "Euler (off the chart)"
        axes[0].plot(H * counts, g.exact, label=None if i > 2 else label, **look)
        bars = 3 * g.std_errors
        dots = look | dict(ls="none", marker=".")
        axes[0].errorbar(H * counts, g.sampled, bars, **dots)
        if symplectic:
            last = max(np.flatnonzero(np.isfinite(g.sampled)), default=0)
            biases = np.abs(np.array(g[:2]) - 1 - H * counts)[:, last] / counts[last]
            axes[1].plot(biases[0], i, "kD", ms=5)
            bar = 3 * g.std_errors[last] / counts[last]
            # Wider ones say nothing about what is compared here.
            if bar < 0.001:
                axes[1].errorbar(biases[1], i, xerr=bar, fmt="s", color=BLUE)
            axes[1].plot(TABLE_1[name][2], [i] * 3, **paper)
    axes[0].plot(H * counts, 1 + H * counts, "k:", label="exact solution")
    axes[0].set(ylim=(0, 3.6 * H * COUNTS[-1]), xlabel="time")
    axes[0].set(ylabel="$E[x^2 + y^2]$", title="figure 1: lines exact, dots sampled")
    axes[0].legend(loc="upper right")
    axes[1].set_yticks(range(2, len(TABLE_1)), [*TABLE_1][2:])
    axes[1].set(xlabel=r"$|E[x^2 + y^2] - \mathrm{exact}| \,/\, N$", title="table 1")
    axes[1].plot([], [], "kD", ms=5, label="exact")
    axes[1].plot([], [], label="paper, three values of $N$", **paper)
    if axes[1].containers:
        axes[1].plot([], [], "s", color=BLUE, label="sampled, 3 standard errors")
    # Above all rows.
    axes[1].set_ylim(top=len(TABLE_1) + 1.4)
    axes[1].legend(loc="upper center", ncols=2)
    save(figure, "fig1.png")


def figure_2a(full: bool) -> None:
    """Weak error of E(x^2) at t = 1."""
    paths = 2**16 if full else 2**12
    print("\nFig. 2(a): weak error of E(x^2) at t = 1, h = 2^-1 .. 2^-8; quasi-Monte")
    print(f"  Carlo, 32 times {paths:,} paths")
    hs = [2.0**-k for k in range(1, 9)]
    # x(1) from (x, y) = (0, 1): sin 1 + int sin(1 - u) dw.
    value = np.sin(1) ** 2 + 1 / 2 - np.sin(2) / 4
    solvers = {
        "SRKw5": (ds.SRKw5(), weak(second=True)),
        "Euler": (diffrax.Euler(), gaussian()),
    }
    exact, sampled = {}, {}
    for name, (solver, path) in solvers.items():
        moment_map = exact_moment_map(make_terms, path, solver, Y0)
        exact[name] = exact_weak_error(moment_map, Y0, lambda m: m[1, 1], value, hs)
        sampled[name] = quasi_weak_error(
            make_terms, path, solver, Y0, lambda y: y[1] ** 2, value,
            resolved(hs[:5], full), paths,
        )  # fmt: skip
    report("exact", exact)
    report("quasi-Monte Carlo", sampled)
    figure, axes = plt.subplots(figsize=(6, 4.5))
    plot_orders(axes, "2(a): weak error of $E[x^2]$", exact, sampled)
    save(figure, "fig2a.png")
    claim_slopes(exact, {"SRKw5": 2, "Euler": 1})
    claim_samples(exact, sampled)


def exact_strong_error(solver, hs, t1: float = 1.0) -> Errors:
    r"""The root-mean-square error of x at `t1`: the numerical solution is linear in the
    increments and space-time areas, so that its error is a Wiener integral, and Itô's
    isometry gives its variance."""

    @briefly
    def linear_step(h):
        def step(p, q, W, H):
            return jnp.stack(one_step(make_terms, solver, (p, q), h, W, H))

        zero = jnp.array(0.0)
        return jnp.stack(jax.jacrev(step, argnums=(0, 1, 2, 3))(*[zero] * 4), axis=1)

    nodes, weights = np.polynomial.legendre.leggauss(8)
    errors = []
    for h in hs:
        steps = round(t1 / h)
        R, noise = np.split(np.asarray(linear_step(h)), 2, axis=1)
        propagators = [np.linalg.matrix_power(R, steps - 1 - n) for n in range(steps)]
        W, area = np.stack([(P @ noise)[1] for P in propagators])[..., None].swapaxes(
            0, 1
        )
        # H is the integral of (1 - u) - 1/2 dw over the step, u from 0 to 1.
        u = (1 + nodes) / 2
        left = h * np.arange(steps)[:, None]
        kernel = W + area * (1 / 2 - u) - np.sin(t1 - left - h * u)
        bias = (np.linalg.matrix_power(R, steps) @ np.array(Y0))[1] - np.sin(t1)
        errors.append(np.sqrt(bias**2 + np.sum(kernel**2 * weights) * h / 2))
    return Errors(np.array([*hs]), np.array(errors), np.zeros(len(errors)))


def pendulum_terms(path):
    """The oscillator for `args=0.0`. For `args=1.0` a pendulum with noise in both its
    variables, for which strong order 3/2 shows."""

    def H0(t, p, q, args):
        return jnp.sum(p**2 + (1 - args) * q**2 - 2 * args * jnp.cos(2 * q)) / 2

    return ds.hamiltonian_terms(H0, lambda t, p, q, args: args * p - q, path)


def figure_2b(full: bool) -> None:
    """Strong error of x at t = 1, with 20 batches of 250 paths as in the paper."""
    print("\nFig. 2(b): strong error of x at t = 1, h = 2^-1 .. 2^-8")
    hs = [2.0**-k for k in range(1, 9)]
    solvers = {
        "SRKs4": ds.SRKs4(),
        "SRKs4(sign=1)": PAPER_SRKs4,
        "Euler": diffrax.Euler(),
    }
    exact = {name: exact_strong_error(solver, hs) for name, solver in solvers.items()}
    paths, fine = (5_000, 2**14) if full else (1_000, 2**11)
    study = strong_errors(
        pendulum_terms, solvers, solvers["SRKs4"], (jnp.ones(1), jnp.zeros(1)), hs, 1,
        fine, component=lambda y: y[1][0],
    )  # fmt: skip
    linear = 5_000 if full else 1_000
    sampled, nonlinear = study(linear, jnp.array(0.0)), study(paths, jnp.array(1.0))
    report("exact", exact)
    report("sampled", sampled)
    del nonlinear["SRKs4(sign=1)"]
    report(f"pendulum (not in the paper), {paths:,} paths", nonlinear)
    figure, axes = plt.subplots(2, 1, figsize=(WIDTH, 8.5))
    slopes = 1, 1.5, 2
    plot_orders(axes[0], "2(b): strong error of $x$", exact, sampled, slopes)
    plot_orders(axes[1], "strong error of $x$, pendulum", nonlinear, slopes=slopes)
    save(figure, "fig2b.png")
    # The terms that keep SRKs4 at order 3/2 vanish where the drift is linear.
    claim_slopes(exact, {"SRKs4": 2, "SRKs4(sign=1)": 2, "Euler": 1})
    claim_samples(exact, sampled)
    claim_slopes(nonlinear, {"SRKs4": 1.5, "Euler": 1})


FIGURES = {"1": figure_1, "2a": figure_2a, "2b": figure_2b}


if __name__ == "__main__":
    run(dict.fromkeys(FIGURES, "linear_oscillator"))
