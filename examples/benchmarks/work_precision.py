"""Speed against accuracy on the four models, and one with two noises:

    python -m examples.benchmarks.work_precision

Weak errors are exact on the linear models (linear and Kubo oscillator, two noises) and
sampled on the others, with error bars of three standard errors. Strong errors are root
mean squares over one set of Brownian paths. Costs are CPU seconds per path, in batches of
10,000. Writes `docs/benchmarks/work_precision.md` and its picture.
"""

import diffrax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jax.scipy.linalg import expm

import diffrax_symplectic as ds

from .. import kubo, linear_oscillator, rigid_body, synchrotron
from .._orders import (
    Errors,
    exact_moment_map,
    exact_weak_error,
    sampled_weak_error,
    strong_errors,
)
from ._timing import DOCS, ensemble, keys, machine, measure


matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402


BATCH = 10_000
HS = [2.0**-k for k in range(1, 8)]

Weak = lambda shape, **kwargs: lambda key: ds.WeakBrownianPath(shape, key, **kwargs)
Gaussian = lambda shape: lambda key: diffrax.UnsafeBrownianPath(shape, key)
Area = lambda shape: (
    lambda key: diffrax.UnsafeBrownianPath(
        shape, key, levy_area=diffrax.SpaceTimeLevyArea
    )
)


def cost(make_terms, make_path, solver, y0, hs) -> np.ndarray:
    """Seconds per path over one unit of time."""
    steps = 64
    fn = ensemble(make_terms, make_path, solver, y0, 1 / steps, steps)
    timing = measure(fn, keys(BATCH), repeats=3)
    # Cost per step hardly depends on the step.
    return timing.seconds / BATCH / steps / np.asarray(hs)


def two_noises(path):
    """A linear oscillator with two noises that do not commute."""
    return ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
        lambda t, p, q, args: jnp.stack([jnp.sum(p**2 - q**2) / 2, jnp.sum(p * q)]) / 2,
        path,
    )


def _two_noises_moment() -> float:
    """E(q^2) at t = 1 from (p, q) = (0, 1), by the linear equation of second moments."""
    A = np.array([[0, -1], [1, 0]])
    Bs = np.array([[0, 1], [1, 0]]) / 2, np.array([[-1, 0], [0, 1]]) / 2
    ito = A + sum(B @ B for B in Bs) / 2
    one = np.eye(2)
    generator = np.kron(ito, one) + np.kron(one, ito) + sum(np.kron(B, B) for B in Bs)
    return float((expm(generator) @ np.array([0, 0, 0, 1.0]))[3])


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
        return two_noises, y0, several, _exact(two_noises, y0, _two_noises_moment())
    make_terms = lambda path: rigid_body.make_terms(path, 0.5)
    y0 = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)])
    phi = lambda X: X[0] ** 2
    reference = ds.StrangGauss(), Weak(())
    return make_terms, y0, scalar, _sampled(make_terms, y0, phi, *reference)


def _exact(make_terms, y0, exact):
    def errors(solver, path, hs):
        moment_map = exact_moment_map(make_terms, path, solver, y0)
        return exact_weak_error(moment_map, y0, lambda m: m[1, 1], exact, hs)

    return errors


def _sampled(make_terms, y0, phi, solver, path, paths: int = 200_000):
    args = make_terms, path, solver, y0, phi, 0.0, [2.0**-7], 4 * paths
    fine = sampled_weak_error(*args)

    def errors(solver, path, hs):
        args = make_terms, path, solver, y0, phi, float(fine.errors[0]), hs, paths
        e = sampled_weak_error(*args)
        return e._replace(std_errors=np.hypot(e.std_errors, fine.std_errors[0]))

    return errors


def _scalar(path):
    return _Scalar(path)  # pyright: ignore[reportCallIssue]


STRONG = {
    "linear oscillator": (
        linear_oscillator.make_terms,
        (jnp.ones(1), jnp.zeros(1)),
        1,
        lambda y: y[1][0],
        {"SRKs4": ds.SRKs4(), "Midpoint": ds.Midpoint(), "SRKs3": ds.SRKs3(),
         "Heun": diffrax.Heun(), "ShARK": diffrax.ShARK()},
        ds.SRKs4(),
    ),
    "Kubo oscillator": (
        lambda path: ds.hamiltonian_terms(
            lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
            lambda t, p, q, args: (p**2 + q**2) / 2,
            path,
        ),
        (jnp.zeros(1), jnp.ones(1)),
        1,
        lambda y: y[1][0],
        {"PlateauGauss": ds.PlateauGauss(),
         "Midpoint": ds.Midpoint(), "SRKs1": ds.SRKs1(), "Heun": diffrax.Heun(),
         "StratonovichMilstein": diffrax.StratonovichMilstein(),
         "SlowRK": diffrax.SlowRK()},
        ds.PlateauGauss(),
    ),
    "synchrotron": (
        synchrotron.make_terms,
        synchrotron.Y0,
        2,
        lambda y: y[0],
        {"PlateauVerlet": ds.PlateauVerlet(),
         "StormerVerlet": ds.StormerVerlet(), "SRKs3": ds.SRKs3(),
         "Midpoint": ds.Midpoint(), "Heun": diffrax.Heun(),
         "SlowRK": diffrax.SlowRK()},
        ds.PlateauVerlet(),
    ),
    "rigid body": (
        lambda path: rigid_body.make_terms(_scalar(path), 0.5),
        jnp.array([np.cos(1.1), 0.0, np.sin(1.1)]),
        1,
        lambda X: X[0],
        {"PlateauGauss": ds.PlateauGauss(),
         "Midpoint": ds.Midpoint(), "SRKs1": ds.SRKs1(), "Heun": diffrax.Heun(),
         "StratonovichMilstein": diffrax.StratonovichMilstein(),
         "SlowRK": diffrax.SlowRK()},
        ds.PlateauGauss(),
    ),
    "two noises": (
        two_noises,
        (jnp.zeros(1), jnp.ones(1)),
        2,
        lambda y: y[1][0],
        {"LevyAreaMidpoint": ds.LevyAreaMidpoint(), "Midpoint": ds.Midpoint(),
         "SRKs1": ds.SRKs1(), "Heun": diffrax.Heun()},
        ds.LevyAreaMidpoint(),
    ),
}  # fmt: skip


def _plateaus(path, key, cell):
    return ds.PlateauBrownianPath(path, key)


def _levy_areas(path, key, cell):
    return ds.LevyAreaBrownianPath(path, key, terms=0 if cell else 2, cell=cell)


# What solvers ask of a path beyond space-time area.
WRAP = {"synchrotron": _plateaus, "two noises": _levy_areas}


class _Scalar(diffrax.AbstractBrownianPath):
    """A path of shape (1,) as one of shape ()."""

    path: diffrax.AbstractBrownianPath
    t0 = 0.0
    t1 = np.inf
    levy_area = diffrax.SpaceTimeLevyArea

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        out = self.path.evaluate(t0, t1, left, use_levy)
        if not use_levy:
            return out[0]  # pyright: ignore
        return diffrax.SpaceTimeLevyArea(dt=out.dt, W=out.W[0], H=out.H[0])  # pyright: ignore


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
    figure, axes = plt.subplots(2, 5, figsize=(25, 9))
    models = [*STRONG]
    for ax, model in zip(axes[0], models):
        make_terms, y0, solvers, error_of = weak(model)
        results = {
            name: (cost(make_terms, path, solver, y0, HS), error_of(solver, path, HS))
            for name, (solver, path) in solvers.items()
        }
        lines += draw(ax, f"weak, {model}", results)
        print(f"weak, {model}: done", flush=True)
    for ax, model in zip(axes[1], models):
        make_terms, y0, m, component, solvers, reference = STRONG[model]
        hs = [2.0**-k for k in range(2, 8)]
        wrap = WRAP.get(model, lambda path, key, cell: path)
        errors = strong_errors(
            make_terms, solvers, reference, y0, hs, m, 2**12, component, wrap=wrap
        )(500)
        path = lambda key, wrap=wrap, m=m: wrap(Area((m,))(key), key, None)
        results = {
            name: (cost(make_terms, path, solvers[name], y0, hs), e)
            for name, e in errors.items()
        }
        lines += draw(ax, f"strong, {model}", results)
        print(f"strong, {model}: done", flush=True)
    figure.tight_layout()
    DOCS.mkdir(parents=True, exist_ok=True)
    figure.savefig(DOCS / "work_precision.png", dpi=90)
    (DOCS / "work_precision.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
