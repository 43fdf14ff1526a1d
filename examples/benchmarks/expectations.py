"""Total errors of the three samplings against exact values, and seconds, compilation aside:

    python -m examples.benchmarks.expectations measure [MODEL ...]
    python -m examples.benchmarks.expectations

The first measures, on a quiet machine, and keeps what it measures in
`docs/benchmarks/samplings.json`. The second writes the picture and the section about it in
`docs/benchmarks/total_error.md`.
Exact values are known in closed form or computed without sampling: by quadrature (quartic
Kubo), backwards in time by splines (pendulum, double well, quartic with two noises) or on
Chebyshev grids (synchrotron, Hénon-Heiles).
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .. import linear_oscillator, synchrotron
from .._pictures import style, WIDTH
from ..hard_cases import chain
from . import _exact
from ._ensembles import MODELS
from ._timing import DOCS
from .work_precision import two_noises


class Case(NamedTuple):
    """A model, and how it is estimated."""

    phi: Callable
    terms: Any
    solver: Any
    t1: float
    steps: int
    y0: Any
    levels: int
    degree: int | None
    paths: int
    exact: Callable[[], Any]


Y0 = (jnp.array(0.0), jnp.array(1.0))
_UP = (jnp.array(0.0), jnp.array(1.2))
_q2 = lambda t, y, args: y[1] ** 2
_one = ds.WeakBrownianPath((), jr.key(0))


def _harmonic(t, p, q, args):
    return (p**2 + q**2) / 2


def _quartic(t, p, q, args):
    return (p**2 + q**2) / 2 + 0.1 * (p**4 + q**4)


def _pendulum(path):
    kicks = lambda t, p, q, args: 0.4 * jnp.cos(q) + 0.1 * q
    H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
    return ds.hamiltonian_terms(H0, kicks, path)


def _double_well(path):
    H0 = lambda t, p, q, args: p**2 / 2 + q**4 / 4 - q**2 / 2
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.3 * jnp.sin(q), path)


def _quartic_kubo(path):
    return ds.hamiltonian_terms(_quartic, lambda *x: 0.3 * _quartic(*x), path)


def _quartic_two(path):
    noise = lambda t, p, q, args: 0.3 * jnp.stack([p * q, (q**2 - p**2) / 2])
    return ds.hamiltonian_terms(_quartic, noise, path)


def quartic_kubo_square() -> float:
    r"""The noise only changes time: the deterministic flow at $1 + 0.3 w(1)$, averaged by
    Gauss--Hermite quadrature."""
    x, w = np.polynomial.hermite_e.hermegauss(60)
    times = jnp.asarray(1 + 0.3 * x)
    n = 400

    def flow(t):
        h = t / n

        def f(y):
            p, q = y
            return jnp.stack([-q - 0.4 * q**3, p + 0.4 * p**3])

        def step(i, y):
            a = f(y)
            b = f(y + h / 2 * a)
            c = f(y + h / 2 * b)
            return y + h / 6 * (a + 2 * b + 2 * c + f(y + h * c))

        return jax.lax.fori_loop(0, n, step, jnp.array([0.0, 1.0]))[1] ** 2

    return float(np.asarray(jax.vmap(flow)(times)) @ w / w.sum())


_henon = MODELS["Hénon-Heiles"]
_verlet = ds.StormerVerlet()
_two = lambda: ds.WeakBrownianPath((2,), jr.key(0), two_point=True)
_chain = lambda s: ds.hamiltonian_terms(
    lambda t, p, q, args: chain.energy(p, q, 0.5),
    lambda t, p, q, args: -s * q,
    ds.WeakBrownianPath((chain.N,), jr.key(0)),
)

CASES = {
    "linear oscillator": Case(
        _q2, linear_oscillator.make_terms(_one), _verlet,
        1.0, 4, linear_oscillator.Y0, 5, 2, 512, _exact.linear_oscillator_square,
    ),
    "Kubo oscillator": Case(
        _q2, ds.hamiltonian_terms(_harmonic, _harmonic, _one), ds.StrangGauss(),
        1.0, 4, Y0, 6, 2, 512, _exact.kubo_square,
    ),
    "pendulum": Case(
        _q2, _pendulum(_one), _verlet, 2.0, 16, Y0, 4, None, 4096,
        lambda: _exact.by_splines(
            _exact.verlet(lambda q: -np.sin(q), lambda q: 0.4 * np.sin(q) - 0.1),
            Y0, 2.0, 16, (4, 4),
        ),
    ),
    "synchrotron": Case(
        lambda t, y, args: y[0] ** 2,
        synchrotron.make_terms(ds.WeakBrownianPath((2,), jr.key(0))), _verlet,
        2.0, 16, synchrotron.Y0, 4, None, 4096,
        lambda: _exact.by_transfer(
            synchrotron.make_terms, synchrotron.Y0, lambda y: y[0] ** 2, 2.0, 512,
            (1.0, 0.6), 20,
        ),
    ),
    "double well": Case(
        _q2, _double_well(_one), _verlet, 2.0, 20, _UP, 4, None, 4096,
        lambda: _exact.by_splines(
            _exact.verlet(lambda q: q - q**3, lambda q: -0.3 * np.cos(q)),
            _UP, 2.0, 20, (3.5, 2.8),
        ),
    ),
    "quartic Kubo": Case(
        _q2, _quartic_kubo(_one), ds.StrangGauss(), 1.0, 4, Y0, 5, None, 4096,
        quartic_kubo_square,
    ),
    "Hénon-Heiles": Case(
        lambda t, y, args: y[1][0] ** 2,
        _henon.make_terms(ds.WeakBrownianPath((2,), jr.key(0))), _verlet,
        5.0, 24, _henon.y0, 3, 5, 2048, _henon.exact,
    ),
    "two noises, linear": Case(
        _q2, two_noises(_two()), ds.NinomiyaVictoir(), 1.0, 4, Y0, 4, 2, 512,
        _exact.two_noises_square,
    ),
    "two noises, quartic": Case(
        _q2, _quartic_two(_two()), ds.NinomiyaVictoir(), 1.0, 4, Y0, 3, None, 2048,
        lambda: _exact.by_splines(
            _exact.step_of(_quartic_two(_two()), ds.NinomiyaVictoir()),
            Y0, 1.0, 8, (6, 6), 200,
        ),
    ),
    "chain of 32, s = 0.1": Case(
        lambda t, y, args: jnp.mean(y[1] ** 2), _chain(0.1), _verlet, 2.0, 16,
        chain.start(1.0), 2, 2, 2**14,
        lambda: _exact.chain_square(0.5, 0.1, 2.0, 64, 2**13, 32)[0],
    ),
}  # fmt: skip


PICTURE = "linear oscillator", "Kubo oscillator", "pendulum", "synchrotron"
KEPT = DOCS / "samplings.json"
SEEDS = range(1, 5)


def measure(name: str) -> dict[str, Any]:
    """Of the largest estimate by value functions more, and of the models of the picture the
    error and the seconds of other estimates, too."""
    c = CASES[name]

    def run(sampling, levels: int, finer: int = 1) -> tuple[list, float, float]:
        def one(seed: int):
            begin = time.perf_counter()
            e = ds.expectation(
                c.phi, c.terms, c.solver, 0.0, c.t1, c.t1 / c.steps / finer, c.y0,
                levels=levels, key=jr.key(seed), sampling=sampling,
            )  # fmt: skip
            return e, time.perf_counter() - begin

        first = one(0)[1]
        done = [one(seed) for seed in SEEDS]
        return [e for e, _ in done], min(s for _, s in done), first

    def dot(sampling, levels: int, finer: int = 1) -> list[float]:
        estimates, seconds, _ = run(sampling, levels, finer)
        off = [float(e.mean) - exact for e in estimates]
        return [seconds, float(np.sqrt(np.mean(np.square(off))))]

    exact = float(c.exact())
    functions = ds.ValueFunctions(c.degree, c.paths)
    estimates, seconds, first = run(functions, c.levels)
    out: dict[str, Any] = {
        "exact": exact, "mean": float(estimates[0].mean), "seconds": seconds,
        "first": first, "reason": estimates[0].reason,
        "std_error": float(np.median([e.std_error for e in estimates])),
        "error": max(abs(float(e.mean) - exact) for e in estimates),
    }  # fmt: skip
    if name in PICTURE:
        off = [float(e.mean) - exact for e in estimates]
        last = [seconds, float(np.sqrt(np.mean(np.square(off))))]
        out["ValueFunctions"] = [dot(functions, k) for k in (1, 3)] + [last]
        rqmc = [ds.ArrayRQMC(2**k, 4) for k in (8, 12, 14)]
        out["ArrayRQMC"] = [dot(sampling, 2, 2) for sampling in rqmc]
        plain = [ds.IndependentPaths(2**k, 4096) for k in (12, 15, 18)]
        out["IndependentPaths"] = [dot(sampling, 1, 4) for sampling in plain]
    return out


def draw(measured: dict[str, dict]) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(WIDTH, 6.5), sharex=True, sharey=True)
    for ax, name in zip(axes.flat, PICTURE):
        for sampling in ("IndependentPaths", "ArrayRQMC", "ValueFunctions"):
            dots = zip(*measured[name][sampling])
            ax.loglog(*dots, label=sampling, **style(sampling))
        ax.set_title(name)
    for ax in axes[-1]:
        ax.set_xlabel("seconds")
    for ax in axes[:, 0]:
        ax.set_ylabel("total error")
    lines, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside upper center", ncols=3)
    figure.savefig(DOCS / "samplings.png")
    plt.close(figure)


def table(measured: dict[str, dict]) -> str:
    head = (
        "| model | functions | standard error | total error | seconds |\n"
        + "|---" * 5
        + "|"
    )
    lines = []
    for name, m in measured.items():
        c = CASES[name]
        basis, best = m["reason"].split(",")[0].split(": ")
        kind = f"grid, {best}" if basis.startswith("grid") else f"degree {best}"
        error = "" if np.isnan(m["exact"]) else f"{m['error']:.1e}"
        cells = (
            f"{name}, $t = {c.t1:g}$", kind, f"{m['std_error']:.1e}", error,
            f"{m['seconds']:.2g}",
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([head, *lines])


def write() -> None:
    kept = _read()
    measured = {name: kept[name] for name in CASES if name in kept}
    draw(measured)
    page = DOCS / "total_error.md"
    before, rest = page.read_text().split("<!-- samplings -->\n")[::2]
    marker = "<!-- samplings -->\n"
    page.write_text(before + marker + "\n" + table(measured) + "\n\n" + marker + rest)


def _read() -> dict[str, Any]:
    return json.loads(KEPT.read_text()) if KEPT.exists() else {}


if __name__ == "__main__":
    if sys.argv[1:2] != ["measure"]:
        write()
    for name in sys.argv[2:] or (CASES if sys.argv[1:] else ()):
        found = measure(name)
        KEPT.write_text(json.dumps(_read() | {name: found}, indent=1) + "\n")
        print(name, found, flush=True)
        jax.clear_caches()
