"""Total error against seconds, from nothing to answer, compilation aside:

    python -m examples.benchmarks.total_error errors [MODEL ...]
    python -m examples.benchmarks.total_error seconds [MODEL ...]
    python -m examples.benchmarks.total_error [--quick]

The first measures errors, of the models named or of all, on however busy a machine. The
second measures how long the estimates take, and wants a quiet one. Both keep what they
measure in `docs/benchmarks/total_error.json`. The last writes `total_error.md` and its
picture from that, and measures what is missing; with `--quick` it goes through all of this
at small sizes for one model and writes nothing. The section down to 1e-10 is that of
`expectations`, which is to be run afterwards.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np

from diffrax_symplectic._simulation.levels import level_weights

from .._orders import exact_moment_map, exact_weak_error
from .._pictures import line, SKY, style, WIDTH
from ._ensembles import Model, MODELS, other, plain, quasi
from ._limits import limits, LONG
from ._timing import DOCS, keys, machine, measure


KEPT = DOCS / "total_error.json"
# An estimate is of so many replicates.
REPLICATES = 4
REPETITIONS = 20
BATCH = 10_000
LEVELS = {"quasi, one level": 1, "quasi, two levels": 2}
TARGET = 1e-5


def sizes(model: Model, levels: int, quick: bool) -> list[int]:
    """How many paths a replicate has. With one level the bias is what is left of more."""
    if quick:
        return [2**6]
    largest = model.paths if levels > 1 else min(model.paths, 2**14)
    return [n for n in (2**8, 2**10, 2**12, 2**14, 2**16) if n <= largest]


def plain_sizes(quick: bool) -> list[int]:
    return [2**8] if quick else [2**10, 2**13, 2**16]


def steps_of(model: Model, levels: int) -> int:
    return model.steps if levels == 1 else model.coarse


def errors(model: Model, quick: bool = False) -> dict[str, Any]:
    """Of each estimate the root mean square error, its systematic part, and what the
    variance of a replicate is below that of as many independent paths."""
    repetitions = 2 if quick else REPETITIONS
    run, known = quasi(model), model.exact()
    exact, exact_error = known if isinstance(known, tuple) else (known, 0.0)
    variance = 0.0
    out: dict[str, Any] = {"exact": exact, "exact error": exact_error}
    for name, levels in LEVELS.items():
        out[name] = []
        for paths in sizes(model, levels, quick):
            estimates = [
                run(steps_of(model, levels), paths, REPLICATES, levels, seed)
                for seed in range(repetitions)
            ]
            assert all(e.num_failed == 0 for e in estimates)
            first = estimates[0].mean
            variance = float(first[1] - first[0] ** 2)
            gain = variance / paths / np.mean([e.variance[0] for e in estimates])
            means = [e.mean[0] for e in estimates]
            row = _row(paths, means, exact) | {"gain": float(gain)}
            if model.linear:
                row["systematic"] = abs(own_bias(model, levels, exact))
            out[name].append(row)
    out["variance"] = variance
    estimate = plain(model)
    out["expectation"] = [
        _row(n, [float(estimate(n, s).mean) for s in range(repetitions)], exact)
        for n in plain_sizes(quick)
    ]
    out["others"] = {x: bias(model, x, exact, quick) for x in model.others}
    return out


def _row(paths: int, estimates, exact: float) -> dict[str, float]:
    """The square of the systematic part is unbiased, or zero where it would be less."""
    off = np.asarray(estimates) - exact
    rms, own = np.sqrt(np.mean(off**2)), np.var(off, ddof=1) / len(off)
    systematic = np.sqrt(max(0.0, np.mean(off) ** 2 - own))
    return {"paths": paths, "error": float(rms), "systematic": float(systematic)}


def own_bias(model: Model, levels: int, exact: float) -> float:
    """Of the solver here for a linear model, by its second moments: no sampling."""
    path = lambda key: model.quasi_path()
    moments = exact_moment_map(model.make_terms, path, model.solver, model.y0)
    hs = [model.t1 / (steps_of(model, levels) * 2**k) for k in range(levels)]
    e = exact_weak_error(moments, model.y0, lambda m: m[1, 1], exact, hs).signed
    order = model.solver.weak_order(model.make_terms(path(None)))
    return float(level_weights(order, levels)[0] @ e)


def bias(model: Model, name: str, exact: float, quick: bool) -> list[list[float]]:
    """(steps, bias, its standard error) of one of Diffrax's solvers: exact for linear
    models, otherwise by `ArrayRQMC` with that solver."""
    solver, area = model.others[name]
    if model.linear:
        steps = [2**k for k in range(3, 5 if quick else 12)]
        hs = [model.t1 / n for n in steps]
        path = lambda key: model.gaussian_path(key, area)
        moments = exact_moment_map(model.make_terms, path, solver, model.y0)
        e = exact_weak_error(moments, model.y0, lambda m: m[1, 1], exact, hs)
        return [[n, b, 0.0] for n, b in zip(steps, e.signed.tolist())]
    run, out = quasi(model, solver, area), []
    for steps in (model.coarse, 2 * model.coarse):
        e = run(steps, min(2**14, sizes(model, 2, quick)[-1]), 16)
        out.append([steps, float(e.mean[0]) - exact, float(e.std_error[0])])
    return out


def seconds(model: Model, quick: bool = False) -> dict[str, Any]:
    """Of each estimate, and of a path and step of Diffrax's solvers."""
    batch = 100 if quick else BATCH
    out: dict[str, Any] = {"others": {}}
    for name in model.others:
        timing = measure(other(model, name), keys(batch), repeats=3)
        out["others"][name] = timing.seconds / batch / model.steps
    estimate = plain(model)
    out["expectation"] = [
        _seconds(lambda n=n: estimate(n, 0)) for n in plain_sizes(quick)
    ]
    run = quasi(model)
    for name, levels in LEVELS.items():
        out[name] = [
            _seconds(lambda n=n: run(steps_of(model, levels), n, REPLICATES, levels))
            for n in sizes(model, levels, quick)
        ]
    return out


def _seconds(fn: Callable) -> float:
    """The first call compiles. Of short ones the best of several."""
    fn()
    times = []
    while sum(times) < 0.5:
        begin = time.perf_counter()
        fn()
        times.append(time.perf_counter() - begin)
    return min(times)


def extrapolated(
    biases: list[list[float]], variance: float, cost: float, error: np.ndarray
) -> np.ndarray:
    """Seconds of independent paths for each total error, with the best step for each: the
    square of the error is that of the bias plus the variance over the number of paths.

    Past the finest step measured the bias falls by the power of the step that the last two
    show. What is not clear of its own uncertainty counts in favour of the solver."""
    n, b, s = np.array(biases).T
    b = np.maximum(np.abs(b) - 2 * s, 1e-12)
    order = np.clip(np.log2(b[-2] / b[-1]), 1.0, 2.0)
    finer = 2.0 ** np.arange(1, 24)
    steps = np.concatenate([n, n[-1] * finer])[:, None]
    left = np.concatenate([b, b[-1] / finer**order])[:, None]
    left = np.where(error > left, error**2 - left**2, np.nan)
    return np.nanmin(cost * steps * variance / left, axis=0)


def to_target(rows: list[dict], times: list[float], target: float = TARGET) -> float:
    """Seconds to the target, with as many replicates as it takes."""
    best = np.inf
    for row, s in zip(rows, times):
        random = row["error"] ** 2 - row["systematic"] ** 2
        left = target**2 - row["systematic"] ** 2
        if left > 0:
            best = min(best, s * max(1.0, random / left))
    return best


def draw(results: dict[str, dict]) -> None:
    figure, axes = plt.subplots(4, 2, figsize=(WIDTH, 11), sharex=True, sharey=True)
    named = {"expectation": "IndependentPaths"}
    named |= {x: x.replace("quasi", "ArrayRQMC") for x in LEVELS}
    # Two levels look like all other pictures of this sampling.
    styles = {name: style(label) for name, label in named.items()}
    styles["quasi, one level"] = style("ArrayRQMC") | dict(color=SKY)
    lines = {}
    for ax, (title, result) in zip(axes.flat, results.items()):
        e, s = result["errors"], result["seconds"]
        for name in (*LEVELS, "expectation"):
            y = [row["error"] for row in e[name]]
            lines[name] = ax.plot(s[name], y, **styles[name])[0]
        error = np.logspace(-5.5, -1, 46)
        for name, b in e["others"].items():
            x = extrapolated(b, e["variance"], s["others"][name], error)
            lines[name] = ax.plot(x, error, **line(name))[0]
        ax.axhline(TARGET, color="k", lw=0.8, ls=":")
        ax.set(xscale="log", yscale="log", title=title)
        ax.set(ylim=(1e-6, 3e-2), xlim=(1e-3, 1e9))
    # Those below which there is no other panel have the labels of the axis.
    for ax in axes.flat[-3:-1]:
        ax.set_xlabel("seconds")
        ax.tick_params(labelbottom=True)
    for ax in axes[:, 0]:
        ax.set_ylabel("total error")
    ax = axes.flat[-1]
    ax.axis("off")
    labels = [named.get(x, f"diffrax.{x}") for x in lines]
    ax.legend(lines.values(), labels, loc="center")
    figure.savefig(DOCS / "total_error.png")
    plt.close(figure)


def table(results: dict[str, dict]) -> str:
    lines = []
    for title, result in results.items():
        e, s = result["errors"], result["seconds"]
        ours = {x: to_target(e[x], s[x]) for x in LEVELS}
        name = min(ours, key=lambda x: ours[x])
        theirs = {
            x: float(
                extrapolated(b, e["variance"], s["others"][x], np.array([TARGET]))[0]
            )
            for x, b in e["others"].items()
        }
        other = min(theirs, key=lambda x: theirs[x])
        last = e["quasi, two levels"][-1]
        cells = (
            title, f"{last['paths']:,}", f"{last['gain']:,.0f}",
            f"{ours[name]:.2g}", f"{theirs[other]:,.0f} ({other})",
            f"{theirs[other] / ours[name]:,.0f}",
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def limit_tables(measured: dict) -> dict[str, str]:
    shown = lambda x: f"{x:,.0f}" if x >= 10 else f"{x:.2f}"
    out = {
        key: ", ".join(
            f"{shown(x)} at $t = {t:g}$" for t, x in zip(LONG[key], measured[key])
        )
        for key in LONG
    }
    row = lambda cells: "| " + " | ".join(cells) + " |"
    lines = [row((str(n), *map(shown, x))) for n, *x in measured["dimensions"]]
    return out | {"dimensions": "\n".join(lines)}


def kept(kind: str, name: str, fn: Callable, again: bool) -> dict:
    """What was measured, or is measured now."""
    everything = _read()
    if again or name not in everything.get(kind, {}):
        begin = time.process_time()
        found = fn()
        used = time.process_time() - begin
        # With what was measured beside it meanwhile.
        everything = _read()
        everything.setdefault(kind, {})[name] = found
        if kind == "seconds":
            everything["machine"] = machine()
        KEPT.write_text(json.dumps(everything, indent=1) + "\n")
        print(f"{kind}, {name}: {used:.0f} s of processor time", flush=True)
        jax.clear_caches()
    return everything[kind][name]


def _read() -> dict[str, Any]:
    return json.loads(KEPT.read_text()) if KEPT.exists() else {}


def main(kind: str | None = None, names: list[str] | None = None) -> None:
    kinds = {"errors": errors, "seconds": seconds}
    results = {
        name: {
            k: kept(k, name, lambda fn=fn, n=name: fn(MODELS[n]), again=kind == k)
            for k, fn in kinds.items()
            if kind in (None, k)
        }
        for name in names or MODELS
    }
    if kind is None:
        write(results, kept("limits", "limits", limits, again=False))


def write(results: dict[str, dict], measured: dict) -> None:
    draw(results)
    page = Path(__file__).with_suffix(".md").read_text()
    text = page.format(
        machine=_read()["machine"], rows=table(results), replicates=REPLICATES,
        chain_error=f"{results['chain of 32']['errors']['exact error']:.0e}",
        **limit_tables(measured),
    )  # fmt: skip
    (DOCS / "total_error.md").write_text(text)


def quick() -> None:
    model = "linear oscillator"
    args = MODELS[model], True
    print(table({model: {"errors": errors(*args), "seconds": seconds(*args)}}))
    print("\n".join(limit_tables(limits(quick=True)).values()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("kind", nargs="?", choices=("errors", "seconds"))
    parser.add_argument("models", nargs="*", help="of " + ", ".join(MODELS))
    arguments = parser.parse_args()
    if arguments.quick:
        quick()
    else:
        main(arguments.kind, arguments.models)
