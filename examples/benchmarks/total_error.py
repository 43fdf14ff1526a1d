"""Total error against seconds, from nothing to answer, compilation aside:

    python -m examples.benchmarks.total_error [--quick] [MODEL ...]

Measures the models named (all without names), keeps what it measured of each in
`examples/output`, and writes `docs/benchmarks/total_error.md` and its picture. With
`--quick` it measures at small sizes and writes nothing.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np

import diffrax_symplectic as ds

from .. import kubo, linear_oscillator, rigid_body, synchrotron
from ..hard_cases import chain, henon_heiles
from ._timing import DOCS, ensemble, keys, machine, measure


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402


KEPT = Path(__file__).parents[1] / "output" / "total_error"
REPLICATES = 16
BATCH = 10_000


class Model(NamedTuple):
    """A problem, its solvers, and the steps that are taken."""

    make_terms: Callable
    y0: Any
    phi: Callable[[Any], Any]
    t1: float
    # Of the quasi-Monte Carlo runs: with one level, and of the coarser of two.
    steps: int
    coarse: int
    noises: tuple[int, ...]
    solver: diffrax.AbstractSolver
    # What Diffrax has, and whether it needs space-time area.
    others: Mapping[str, tuple[diffrax.AbstractSolver, bool]]
    sort_by: Callable | None = None
    exact: float | None = None


_heun = {"Heun": (diffrax.Heun(), False)}
_slow = _heun | {"SlowRK": (diffrax.SlowRK(), True)}
_hh_start = (jnp.array([0.4, 0.1]), jnp.array([0.0, -0.15]))


def _chain_terms(path):
    terms = lambda f: lambda t, p, q, args: f(p, q)
    return ds.hamiltonian_terms(
        terms(lambda p, q: chain.energy(p, q, 0.5)), terms(lambda p, q: -0.1 * q), path
    )


def _henon_heiles_terms(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: henon_heiles.energy(p, q),
        lambda t, p, q, args: -0.03 * q,
        path,
    )


MODELS = {
    "linear oscillator": Model(
        linear_oscillator.make_terms, linear_oscillator.Y0, lambda y: y[1] ** 2, 1.0,
        64, 16, (), ds.StormerVerlet(), _heun | {"ShARK": (diffrax.ShARK(), True)},
        exact=float(np.sin(1) ** 2 + 1 / 2 - np.sin(2) / 4),
    ),
    "Kubo oscillator": Model(
        kubo.make_terms, kubo.Y0, lambda y: y[1] ** 2, 1.0, 32, 16, (),
        ds.StrangGauss(), _slow, exact=float((1 + np.cos(2) * np.exp(-2)) / 2),
    ),
    "synchrotron": Model(
        synchrotron.make_terms, synchrotron.Y0, lambda y: y[0] ** 2, 2.0, 128, 32, (2,),
        ds.StormerVerlet(), _slow,
    ),
    "rigid body": Model(
        lambda path: rigid_body.make_terms(path, 0.5), rigid_body.X0,
        lambda X: X[0] ** 2, 4.0, 64, 32, (), ds.StrangGauss(), _slow,
        sort_by=lambda X: (X[0], jnp.arctan2(X[1], X[2])),
    ),
    "Henon-Heiles": Model(
        _henon_heiles_terms, _hh_start, lambda y: y[1][0] ** 2, 5.0, 100, 50, (2,),
        ds.StormerVerlet(), _slow,
    ),
    "chain of 32": Model(
        _chain_terms, chain.start(1.0), lambda y: jnp.mean(y[0] ** 2), 2.0, 32, 16,
        (chain.N,), ds.StormerVerlet(), _heun,
    ),
}  # fmt: skip


def _quasi(model: Model, solver, area=False) -> Callable[..., ds.QuasiExpectation]:
    """Estimates phi and its square. Of one solver: the program is compiled once for each
    number of paths."""
    levy_area = diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement
    path = ds.FixedStepBrownianPath(model.noises, jr.key(0), levy_area=levy_area)
    terms = model.make_terms(path)

    def phi(t, y, args):
        value = model.phi(y)
        return jnp.stack([value, value**2])

    def run(steps: int, paths: int, replicates: int, levels: int = 1):
        return ds.quasi_expectation(
            phi, terms, solver, 0.0, model.t1, model.t1 / steps, model.y0,
            key=jr.key(steps), num_paths=paths, replicates=replicates, levels=levels,
            sort_by=model.sort_by,
        )  # fmt: skip

    return run


def study(model: Model, quick: bool = False) -> dict[str, Any]:
    """Of each pipeline, seconds and the errors that they buy."""
    sizes = [2**6, 2**8] if quick else [2**8, 2**10, 2**12]
    run = _quasi(model, model.solver)
    finest = run(2 * model.steps, 4 * sizes[-1], 4, levels=2)
    exact = float(finest.mean[0]) if model.exact is None else model.exact
    variance = float(finest.mean[1] - finest.mean[0] ** 2)
    out: dict[str, Any] = {"exact": exact, "variance": variance, "pipelines": {}}
    for name, steps, levels in (
        ("quasi, one level", model.steps, 1),
        ("quasi, two levels", model.coarse, 2),
    ):
        rows = []
        for paths in sizes:
            run(steps, paths, 2, levels)
            begin = time.perf_counter()
            estimate = run(steps, paths, REPLICATES, levels)
            seconds = time.perf_counter() - begin
            spread = float(np.var(estimate.replicates[:, 0], ddof=1))
            error = np.hypot(
                float(estimate.mean[0]) - exact, np.sqrt(spread / REPLICATES)
            )
            rows.append((seconds, float(error), variance / paths / spread, paths))
        out["pipelines"][name] = {"rows": rows}
    ours = lambda key: ds.FixedStepBrownianPath(model.noises, key)
    plain: dict[str, Any] = {type(model.solver).__name__: (model.solver, False, ours)}
    for name, (solver, area) in model.others.items():
        levy_area = diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement
        path = lambda key, levy_area=levy_area: diffrax.UnsafeBrownianPath(
            model.noises, key, levy_area=levy_area
        )
        plain[name] = solver, area, path
    for name, (solver, area, path) in plain.items():
        fn = ensemble(
            model.make_terms,
            path,
            solver,
            model.y0,
            model.t1 / model.steps,
            model.steps,
        )
        batch = 100 if quick else BATCH
        cost = measure(fn, keys(batch), repeats=1 if quick else 3).seconds
        biases, other = [], _quasi(model, solver, area)
        for steps in (model.steps, 2 * model.steps):
            e = other(steps, sizes[-1], REPLICATES)
            biases.append((steps, float(e.mean[0]) - exact, float(e.std_error[0])))
        out["pipelines"][name] = {"cost": cost / batch / model.steps, "biases": biases}
    return out


def curve(pipeline: dict, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of plain Monte Carlo for each error, with the best step for each: the bias
    falls by the power of the step that it shows, and its square and the variance over the
    number of paths are the square of the error."""
    (n1, b1, s1), (n2, b2, s2) = pipeline["biases"]
    # What is not clear of its own uncertainty counts for nothing: in favour of plain paths.
    b1, b2 = (max(abs(b) - 2 * s, 1e-9) for b, s in ((b1, s1), (b2, s2)))
    order = np.clip(np.log2(b1 / b2), 1.0, 2.0)
    errors = np.logspace(-6, -2, 41)
    steps = n2 * 2.0 ** np.arange(-6, 24)[:, None]
    bias = b2 * (n2 / steps) ** order
    left = np.where(errors > bias, errors**2 - bias**2, np.nan)
    seconds = pipeline["cost"] * steps * variance / left
    return np.nanmin(seconds, axis=0), errors


def draw(results: dict[str, dict]) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(15, 9))
    for ax, (title, result) in zip(axes.flat, results.items()):
        for i, (name, pipeline) in enumerate(result["pipelines"].items()):
            if "rows" in pipeline:
                seconds, errors, *_ = np.array(pipeline["rows"]).T
                ax.plot(seconds, errors, "o-", color=f"C{i}", label=name)
            else:
                seconds, errors = curve(pipeline, result["variance"])
                style = "--" if name in dir(diffrax) else "-"
                ax.plot(seconds, errors, style, color=f"C{i}", label=name)
        ax.set(xscale="log", yscale="log", title=title, ylim=(1e-6, 1e-2))
        ax.set(xlabel="seconds", ylabel="total error", xlim=(1e-2, 1e8))
        ax.legend(fontsize=7)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(results) :]:
        ax.axis("off")
    figure.tight_layout()
    DOCS.mkdir(parents=True, exist_ok=True)
    figure.savefig(DOCS / "total_error.png", dpi=90)
    plt.close(figure)


PAGE = (Path(__file__).with_suffix(".md")).read_text()


def page(results: dict[str, dict]) -> str:
    rows = []
    for title, result in results.items():
        seconds, error, gain, paths = result["pipelines"]["quasi, two levels"]["rows"][
            -1
        ]
        curves = [
            curve(p, result["variance"])
            for name, p in result["pipelines"].items()
            if name in dir(diffrax)
        ]
        best = min(float(np.interp(error, e, s)) for s, e in curves)
        cells = (
            title, f"{error:.1e}", f"{seconds:.2g}", f"{3 * REPLICATES * int(paths):,}",
            f"{gain:,.0f}", f"{best:,.2g}", f"{best / seconds:,.2g}",
        )  # fmt: skip
        rows.append("| " + " | ".join(cells) + " |")
    return PAGE.format(machine=machine(), rows="\n".join(rows))


def main(names: list[str] | None = None) -> None:
    KEPT.mkdir(parents=True, exist_ok=True)
    for name in names or MODELS:
        result = study(MODELS[name])
        (KEPT / f"{name}.json").write_text(json.dumps(result))
        print(name, json.dumps(result, indent=1), flush=True)
        jax.clear_caches()
    kept = {name: KEPT / f"{name}.json" for name in MODELS}
    results = {k: json.loads(p.read_text()) for k, p in kept.items() if p.exists()}
    draw(results)
    (DOCS / "total_error.md").write_text(page(results))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("models", nargs="*", help="of " + ", ".join(MODELS))
    arguments = parser.parse_args()
    if arguments.quick:
        for name in arguments.models or MODELS:
            print(name, study(MODELS[name], quick=True))
    else:
        main(arguments.models)
