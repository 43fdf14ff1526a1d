"""Speed against accuracy on the four models, and one with two noises:

    python -m examples.benchmarks.work_precision

Weak errors are exact on the linear models (linear and Kubo oscillator, two noises) and
estimated by quasi-Monte Carlo on the others, with error bars of three standard errors.
Strong errors are root mean squares over one set of Brownian paths, by `compare_solvers`.
Costs are CPU seconds per path, in batches of 10,000. Writes
`docs/benchmarks/work_precision.md` and its picture.
"""

import time

import diffrax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np

import diffrax_symplectic as ds

from .. import kubo, linear_oscillator, rigid_body, synchrotron
from .._orders import (
    Errors,
    exact_moment_map,
    exact_weak_error,
)
from ._exact import two_noises_square
from ._timing import DOCS, ensemble, keys, machine, measure


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402


BATCH = 10_000
HS = [2.0**-k for k in range(1, 8)]

Weak = lambda shape, **kwargs: lambda key: ds.WeakBrownianPath(shape, key, **kwargs)
Gaussian = lambda shape: lambda key: ds.FixedStepBrownianPath(shape, key)
Area = lambda shape: (
    lambda key: ds.FixedStepBrownianPath(
        shape, key, levy_area=diffrax.SpaceTimeLevyArea
    )
)


def cost(make_terms, make_path, solver, y0, hs) -> np.ndarray:
    """Seconds per path over one unit of time."""
    steps = 64
    fn = ensemble(make_terms, make_path, solver, y0, 1 / steps, steps)
    timing = measure(fn, keys(BATCH), repeats=3, clock=time.process_time)
    # Cost per step hardly depends on the step.
    return timing.seconds / BATCH / steps / np.asarray(hs)


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
    estimate = lambda solver, path, h, **kwargs: ds.quasi_expectation(
        lambda t, y, args: phi(y), make_terms(path(jr.key(0))), solver, 0.0, 1.0, h, y0,
        key=jr.key(round(1 / h)), sort_by=sort_by, **kwargs,
    )  # fmt: skip
    fine = estimate(solver, path, HS[-1] / 2, num_paths=2**14, levels=2)

    def errors(solver, path, hs):
        own = [estimate(solver, path, h, num_paths=2**12) for h in hs]
        signed = np.array([float(e.mean - fine.mean) for e in own])
        bars = np.hypot([float(e.std_error) for e in own], float(fine.std_error))
        return Errors(np.array(hs), signed, bars)

    return errors


_EXPLICIT = diffrax.Heun(), diffrax.StratonovichMilstein(), diffrax.SlowRK()
_GENERAL = (ds.PlateauGauss(), ds.Midpoint(), ds.SRKs1(), *_EXPLICIT)
# Terms, start, shape of the path, the solver of the reference, and all solvers.
STRONG = {
    "linear oscillator": (
        linear_oscillator.make_terms, linear_oscillator.Y0, (), ds.SRKs4(),
        (ds.SRKs4(), ds.Midpoint(), ds.SRKs3(), diffrax.Heun(), diffrax.ShARK()),
    ),
    "Kubo oscillator": (kubo.make_terms, kubo.Y0, (), ds.PlateauGauss(), _GENERAL),
    "synchrotron": (
        synchrotron.make_terms, synchrotron.Y0, (2,), ds.PlateauVerlet(),
        (ds.PlateauVerlet(), ds.StormerVerlet(), ds.SRKs3(), ds.Midpoint(),
         diffrax.Heun(), diffrax.SlowRK()),
    ),
    "rigid body": (
        lambda path: rigid_body.make_terms(path, 0.5), rigid_body.X0, (),
        ds.PlateauGauss(), _GENERAL,
    ),
    "two noises": (
        two_noises, kubo.Y0, (2,), ds.LevyAreaMidpoint(),
        (ds.LevyAreaMidpoint(), ds.Midpoint(), ds.SRKs1(), diffrax.Heun()),
    ),
}  # fmt: skip


def strong(model: str, hs: list[float]) -> dict[str, tuple[np.ndarray, Errors]]:
    """Times and root-mean-square errors of the state at t = 1."""
    make_terms, y0, shape, reference, solvers = STRONG[model]
    compared = ds.compare_solvers(
        make_terms, y0, 0.0, 1.0, dts=hs, shape=shape, solvers=solvers,
        reference=reference, key=jr.key(0), num_paths=500,
    )  # fmt: skip
    assert not compared.refused
    results = {}
    for solver in solvers:
        own = [s for s in compared.steps if s.solver == repr(solver)]
        errors = Errors(
            np.array(hs),
            np.array([s.error for s in own]),
            np.array([s.std_error for s in own]),
        )
        wrap = WRAP.get(type(solver), lambda path, key: path)
        path = lambda key, wrap=wrap: wrap(Area(shape)(key), key)
        seconds = cost(make_terms, path, solver, y0, hs)
        results[type(solver).__name__] = seconds, errors
    return results


# What solvers ask of a path beyond space-time area.
WRAP = {
    ds.PlateauVerlet: ds.PlateauBrownianPath,
    ds.LevyAreaMidpoint: lambda path, key: ds.LevyAreaBrownianPath(path, key, terms=2),
}


def draw(axes, title: str, results: dict[str, tuple[np.ndarray, Errors]]) -> list[str]:
    lines = []
    for i, (name, (seconds, e)) in enumerate(results.items()):
        style = "--" if name in dir(diffrax) and name != "Midpoint" else "-"
        axes.errorbar(
            seconds, np.maximum(e.errors, 1e-16), 3 * e.std_errors, label=name,
            color=f"C{i}", ls=style, marker="o", ms=3, lw=1, capsize=2,
        )  # fmt: skip
        for j in (len(e.hs) // 2, len(e.hs) - 1):
            bar = f" ± {e.std_errors[j]:.0e}" if e.std_errors[j] > 0 else ""
            cells = title, name, f"{e.hs[j]:.4f}", f"{e.errors[j]:.1e}{bar}"
            lines.append("| " + " | ".join(cells) + f" | {seconds[j] * 1e6:.2f} |")
    axes.set(xscale="log", yscale="log", xlabel="CPU seconds per path", title=title)
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)
    return lines


def main() -> None:
    lines = [
        "# Speed against accuracy",
        "",
        f"{machine()}. Made by `python -m examples.benchmarks.work_precision`.",
        "",
        "![Errors against CPU seconds per path](work_precision.png)",
        "",
        "| error, model | solver | h | error | microseconds per path |",
        "|---" * 5 + "|",
    ]
    figure, axes = plt.subplots(5, 2, figsize=(11, 22), layout="constrained")
    for ax, model in zip(axes[:, 0], STRONG):
        make_terms, y0, solvers, error_of = weak(model)
        results = {
            name: (cost(make_terms, path, solver, y0, HS), error_of(solver, path, HS))
            for name, (solver, path) in solvers.items()
        }
        lines += draw(ax, f"weak, {model}", results)
        print(f"weak, {model}: done", flush=True)
    for ax, model in zip(axes[:, 1], STRONG):
        results = strong(model, HS[1:])
        lines += draw(ax, f"strong, {model}", results)
        print(f"strong, {model}: done", flush=True)
    DOCS.mkdir(parents=True, exist_ok=True)
    figure.savefig(DOCS / "work_precision.png", dpi=90)
    (DOCS / "work_precision.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
