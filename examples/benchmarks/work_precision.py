"""Speed against accuracy on the four models, and one with two noises:

    python -m examples.benchmarks.work_precision errors
    python -m examples.benchmarks.work_precision seconds
    python -m examples.benchmarks.work_precision

Weak errors are exact on the linear models (linear and Kubo oscillator, two noises) and
estimated by quasi-Monte Carlo on the others, with error bars of three standard errors.
Strong errors are root mean squares over one set of Brownian paths, by `compare_solvers`.
The first measures these, in a quarter of an hour of processor time on however busy a
machine. The second measures costs, and wants a quiet one: CPU seconds per path, in batches
of 10,000, in turns after all programs are compiled. What was measured is kept in
`docs/benchmarks/work_precision.json`, from which all three write their part of
`docs/benchmarks/index.md` and its pictures.
"""

import functools as ft
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .. import kubo, linear_oscillator, rigid_body, synchrotron
from .._orders import (
    Errors,
    exact_moment_map,
    exact_weak_error,
)
from .._pictures import style, WIDTH
from ._exact import two_noises_square
from ._timing import DOCS, ensemble, keys, machine, table, write


KEPT = DOCS / "work_precision.json"
BATCH = 10_000
# Of the steps whose time is measured.
H, STEPS = 1 / 64, 16
HS = [2.0**-k for k in range(1, 8)]
# Which one the table shows. Strong errors begin with the second step size.
SHOWN = 3
# The pictures have these, too.
OMITTED = "StratonovichMilstein", "SRKs1", "SRKs3", "SRKw2", "SRKw3a", "SRKw3c"

Weak = lambda shape, **kwargs: lambda key: ds.WeakBrownianPath(shape, key, **kwargs)
Gaussian = lambda shape: lambda key: ds.FixedStepBrownianPath(shape, key)
Area = lambda shape: (
    lambda key: ds.FixedStepBrownianPath(
        shape, key, levy_area=diffrax.SpaceTimeLevyArea
    )
)


class Program(NamedTuple):
    """Solves a batch of paths, compiled."""

    run: Callable
    batch: jax.Array

    def seconds(self) -> float:
        begin = time.process_time()
        jax.block_until_ready(self.run(self.batch))
        return time.process_time() - begin


def compiled(make_terms, make_path, solver, y0) -> Program:
    fn, batch = ensemble(make_terms, make_path, solver, y0, H, STEPS), keys(BATCH)
    return Program(jax.jit(lambda keys: fn(keys)).lower(batch).compile(), batch)


def costs(programs: dict[Any, Program], rounds: int = 6) -> dict[Any, float]:
    """Seconds per path and step, the best of several rounds. A step costs the same whatever
    its size is, or nearly so."""
    times = [[p.seconds() for p in programs.values()] for _ in range(1 + rounds)]
    best = np.min(times[1:], axis=0) / BATCH / STEPS
    return dict(zip(programs, best.tolist()))


def two_noises(path):
    """A linear oscillator with two noises that do not commute."""
    return ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
        lambda t, p, q, args: jnp.stack([jnp.sum(p**2 - q**2) / 2, jnp.sum(p * q)]) / 2,
        path,
    )


def weak(model: str):
    """(solver, path) by name, and the function from these to `Errors`."""
    scalar = {
        "SRKw1": (ds.SRKw1(), Weak(())),
        "SRKw2": (ds.SRKw2(), Weak(())),
        "StrangGauss": (ds.StrangGauss(), Weak(())),
        "Heun": (diffrax.Heun(), Gaussian(())),
        "StratonovichMilstein": (diffrax.StratonovichMilstein(), Gaussian(())),
        "SlowRK": (diffrax.SlowRK(), Area(())),
    }
    if model == "linear oscillator":
        make_terms, y0 = linear_oscillator.make_terms, linear_oscillator.Y0
        exact = np.sin(1) ** 2 + 1 / 2 - np.sin(2) / 4
        additive = {
            "SRKw5": (ds.SRKw5(), Weak((), second=True)),
            "AdditiveGauss": (ds.AdditiveGauss(), Weak((), order=3)),
            "SRKw4": (ds.SRKw4(), Weak(())),
            "StormerVerlet": (ds.StormerVerlet(), Weak(())),
            "SRKs4": (ds.SRKs4(), Area(())),
            "ShARK": (diffrax.ShARK(), Area(())),
            "Heun": (diffrax.Heun(), Gaussian(())),
        }
        return make_terms, y0, additive, _exact(make_terms, y0, exact)
    if model == "Kubo oscillator":
        make_terms, y0 = kubo.make_terms, (jnp.array(0.0), jnp.array(1.0))
        exact = (1 + np.cos(2) * np.exp(-2)) / 2
        return make_terms, y0, scalar, _exact(make_terms, y0, exact)
    if model == "synchrotron":
        make_terms, y0 = synchrotron.make_terms, synchrotron.Y0
        separable = {
            "SRKw3a": (ds.SRKw3("a"), Weak((2,))),
            "SRKw3c": (ds.SRKw3("c"), Weak((2,))),
            "SRKw4": (ds.SRKw4(), Weak((2,))),
            "StormerVerlet": (ds.StormerVerlet(), Weak((2,))),
            "Heun": (diffrax.Heun(), Gaussian((2,))),
            "SlowRK": (diffrax.SlowRK(), Area((2,))),
        }
        phi = lambda y: y[0] ** 2
        reference = ds.SRKw4(), Weak((2,))
        return make_terms, y0, separable, _sampled(make_terms, y0, phi, *reference)
    if model == "two noises":
        several = {
            "SRKw1": (ds.SRKw1(), Weak((2,))),
            "StrangGauss": (ds.StrangGauss(), Weak((2,))),
            "NinomiyaVictoir": (ds.NinomiyaVictoir(), Weak((2,), two_point=True)),
            "Heun": (diffrax.Heun(), Gaussian((2,))),
        }
        y0 = (jnp.array(0.0), jnp.array(1.0))
        return two_noises, y0, several, _exact(two_noises, y0, two_noises_square())
    make_terms = lambda path: rigid_body.make_terms(path, 0.5)
    y0 = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)])
    phi = lambda X: X[0] ** 2
    reference = ds.StrangGauss(), Weak(())
    # A point of a sphere, by its height along the axis of the noise and the angle about it.
    on_sphere = lambda X: (X[0], jnp.arctan2(X[1], X[2]))
    errors = _sampled(make_terms, y0, phi, *reference, sort_by=on_sphere)
    return make_terms, y0, scalar, errors


def _exact(make_terms, y0, exact):
    def errors(solver, path, hs):
        moment_map = exact_moment_map(make_terms, path, solver, y0)
        return exact_weak_error(moment_map, y0, lambda m: m[1, 1], exact, hs)

    return errors


def _sampled(make_terms, y0, phi, solver, path, sort_by=None):
    """By quasi-Monte Carlo."""
    estimate = lambda solver, path, h, num_paths, **kwargs: ds.expectation(
        lambda t, y, args: phi(y), make_terms(path(jr.key(0))), solver, 0.0, 1.0, h, y0,
        key=jr.key(round(1 / h)), sampling=ds.ArrayRQMC(num_paths, 16, sort_by), **kwargs,
    )  # fmt: skip
    reference = ft.cache(
        lambda: estimate(solver, path, HS[-1] / 2, num_paths=2**13, levels=2)
    )

    def errors(solver, path, hs):
        fine = reference()
        own = [estimate(solver, path, h, num_paths=2**11, levels=1) for h in hs]
        signed = np.array([float(e.mean - fine.mean) for e in own])
        bars = np.hypot([float(e.std_error) for e in own], float(fine.std_error))
        return Errors(np.array(hs), signed, bars)

    return errors


_EXPLICIT = diffrax.Heun(), diffrax.StratonovichMilstein(), diffrax.SlowRK()
_GENERAL = (ds.PlateauGauss(), ds.ImplicitMidpoint(), ds.SRKs1(), *_EXPLICIT)
# Terms, start, shape of the path, the solver of the reference, and all solvers.
STRONG = {
    "linear oscillator": (
        linear_oscillator.make_terms, linear_oscillator.Y0, (), ds.SRKs4(),
        (ds.SRKs4(), ds.ImplicitMidpoint(), ds.SRKs3(), diffrax.Heun(), diffrax.ShARK()),
    ),
    "Kubo oscillator": (kubo.make_terms, kubo.Y0, (), ds.PlateauGauss(), _GENERAL),
    "synchrotron": (
        synchrotron.make_terms, synchrotron.Y0, (2,), ds.PlateauVerlet(),
        (ds.PlateauVerlet(), ds.StormerVerlet(), ds.SRKs3(), ds.ImplicitMidpoint(),
         diffrax.Heun(), diffrax.SlowRK()),
    ),
    "rigid body": (
        lambda path: rigid_body.make_terms(path, 0.5), rigid_body.X0, (),
        ds.PlateauGauss(), _GENERAL,
    ),
    "two noises": (
        two_noises, kubo.Y0, (2,), ds.LevyAreaMidpoint(),
        (ds.LevyAreaMidpoint(), ds.ImplicitMidpoint(), ds.SRKs1(), diffrax.Heun()),
    ),
}  # fmt: skip


# What solvers ask of a path beyond space-time area.
WRAP = {
    ds.PlateauVerlet: ds.PlateauBrownianPath,
    ds.LevyAreaMidpoint: lambda path, key: ds.LevyAreaBrownianPath(
        path, key, num_terms=2
    ),
}


def strong_errors(model: str) -> dict[str, Errors]:
    """Root-mean-square errors of the state at t = 1."""
    make_terms, y0, shape, reference, solvers = STRONG[model]
    compared = ds.compare_solvers(
        make_terms(ds.WeakBrownianPath(shape, jr.key(0))), solvers, 0.0, 1.0, HS[1:], y0,
        reference=reference, key=jr.key(0), num_paths=500,
    )  # fmt: skip
    assert not compared.refused
    results = {}
    for solver in solvers:
        own = [s for s in compared.steps if s.solver == repr(solver)]
        rows = [(s.dt, s.error, s.std_error) for s in own]
        results[type(solver).__name__] = Errors._make(np.array(rows).T)
    return results


def weak_errors(model: str) -> dict[str, Errors]:
    _, _, solvers, errors = weak(model)
    return {name: errors(solver, path, HS) for name, (solver, path) in solvers.items()}


ERRORS = {"weak": weak_errors, "strong": strong_errors}


def measured_errors() -> dict[str, dict]:
    """By kind, model and name of the solver: step sizes, errors, and standard errors."""
    out = {kind: {} for kind in ERRORS}
    for kind, errors_of in ERRORS.items():
        for model in STRONG:
            out[kind][model] = {
                name: [[float(f"{x:.6g}") for x in field] for field in errors]
                for name, errors in errors_of(model).items()
            }
            print(f"{kind}, {model}: done", flush=True)
    return out


def programs() -> dict[Any, Program]:
    """Of all solvers, by kind of error, model and name."""
    out = {}
    for model, (make_terms, y0, shape, _, solvers) in STRONG.items():
        for solver in solvers:
            wrap = WRAP.get(type(solver), lambda path, key: path)
            path = lambda key, wrap=wrap, shape=shape: wrap(Area(shape)(key), key)
            program = compiled(make_terms, path, solver, y0)
            out["strong", model, type(solver).__name__] = program
        make_terms, y0, pairs, _ = weak(model)
        for name, (solver, path) in pairs.items():
            out["weak", model, name] = compiled(make_terms, path, solver, y0)
    return out


def measured_seconds() -> dict[str, dict]:
    """Per path and step, by kind of error, model and name."""
    out = {kind: {model: {} for model in STRONG} for kind in ERRORS}
    for (kind, model, name), seconds in costs(programs()).items():
        out[kind][model][name] = float(f"{seconds:.4g}")
    return out


def draw(kind: str, kept: dict) -> None:
    """Errors against seconds, a panel for each model. A point that is not clear of its own
    error bar is not drawn: it says nothing."""
    figure, axes = plt.subplots(len(STRONG), figsize=(WIDTH, 2.6 * len(STRONG)))
    for ax, model in zip(axes, STRONG):
        entries = {}
        for name, fields in kept["errors"][kind][model].items():
            e = Errors._make(np.array(fields))
            seconds = kept["seconds"][kind][model][name] / e.hs
            clear = e.errors > 3 * e.std_errors
            bars = 3 * e.std_errors[clear]
            curve, *_ = ax.errorbar(
                seconds[clear], e.errors[clear], bars, **style(name)
            )
            entries[name] = curve
        ax.set(xscale="log", yscale="log", title=model, ylabel=f"{kind} error")
        # Without their bars, which hide markers.
        names = sorted(entries)
        handles = [entries[name] for name in names]
        ax.legend(handles, names, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes[-1].set_xlabel("CPU seconds per path")
    figure.savefig(DOCS / f"work_precision_{kind}.png")
    plt.close(figure)


def cell(kind: str, model: str, kept: dict) -> str:
    """Errors and microseconds of all solvers."""
    out = []
    for name, fields in kept["errors"][kind][model].items():
        e = Errors._make(np.array(fields))
        micro = kept["seconds"][kind][model][name] / e.hs[SHOWN] * 1e6
        error, own = e.errors[SHOWN], e.std_errors[SHOWN]
        bar = f" ± {own:.0e}" if own > error / 10 else ""
        if name not in OMITTED:
            out.append(f"{name} {error:.1e}{bar} ({micro:.2f})")
    return ", ".join(out)


EXPLAINED = {
    "weak": f"Weak errors at $h = 1/{1 / HS[SHOWN]:g}$, exact for linear models, else from "
    "`ArrayRQMC`:",
    "strong": "Strong errors, root mean squares over 500 Brownian paths at "
    f"$h = 1/{1 / HS[1 + SHOWN]:g}$ (`compare_solvers`):",
}


def write_page(kept: dict) -> None:
    lines = [
        Path(__file__).with_suffix(".md").read_text().strip(),
        "",
        "Bars: three standard errors; points not clear of zero are omitted. CPU time per "
        f"path, one core, batches of 10,000. {kept['machine']}.",
    ]
    for kind in ERRORS:
        draw(kind, kept)
        title = f"{kind.title()} errors against CPU seconds per path"
        picture = f"![{title}](work_precision_{kind}.png)"
        cells = [(model, cell(kind, model, kept)) for model in STRONG]
        shown = table(("system", "error of each solver (µs per path)"), cells)
        lines += ["", picture, "", EXPLAINED[kind], "", *shown]
    write("examples.benchmarks.work_precision", lines)


def main(*kinds: str) -> None:
    """Measures `errors` or `seconds` anew, and writes the page."""
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    if "errors" in kinds:
        kept["errors"] = measured_errors()
    if "seconds" in kinds:
        kept["seconds"] = measured_seconds()
        kept["machine"] = machine()
    if kinds:
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    write_page(kept)


if __name__ == "__main__":
    main(*sys.argv[1:])
