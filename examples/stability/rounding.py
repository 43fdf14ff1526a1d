"""How the errors of invariants grow over a million steps."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

from ..rigid_body import make_terms as rigid_body
from ._page import fill, Page, table


# A power of two: times are then exact in float32 as well, up to 2^24 steps.
H = 2.0**-6


class System(NamedTuple):
    make_terms: Callable
    invariant: Callable
    y0: tuple


def _with_noise(H0: Callable, s: float) -> Callable:
    """Noise in the time of the system: H1 = s H0, so that H0 is constant on every path."""
    drift = lambda t, p, q, args: H0(p, q)
    return lambda path: ds.hamiltonian_terms(
        drift, lambda t, p, q, args: s * H0(p, q), path
    )


_oscillator = lambda p, q: (p**2 + q**2) / 2
_pendulum = lambda p, q: p**2 / 2 - jnp.cos(q) + 1
KUBO = System(_with_noise(_oscillator, 1.0), lambda y: _oscillator(*y), (0.0, 1.0))
RIGID_BODY = System(
    rigid_body, lambda X: jnp.sum(X**2), (np.cos(1.1), 0.0, np.sin(1.1))
)
PENDULUM = System(_with_noise(_pendulum, 0.0), lambda y: _pendulum(*y), (0.0, 1.5))
NOISY_PENDULUM = PENDULUM._replace(make_terms=_with_noise(_pendulum, 0.5))


class Growth(NamedTuple):
    """The relative error of an invariant: `errors[path, i]` after `steps[i]` steps."""

    steps: np.ndarray
    errors: np.ndarray

    @property
    def rms(self) -> np.ndarray:
        return np.sqrt(np.mean(self.errors**2, axis=0))

    @property
    def bias(self) -> tuple[float, float]:
        """The mean error per step with its standard error, from the ends."""
        end = self.errors[:, -1] / self.steps[-1]
        return float(np.mean(end)), float(np.std(end) / np.sqrt(len(end)))

    def exponent(self, resamples: int = 200) -> tuple[float, float]:
        """Of the growth of `rms` with the number of steps, by least squares in logarithms
        over the last two decades; its standard error by the bootstrap over paths."""
        keep = np.geomspace(self.steps[-1] / 100, self.steps[-1], 15)
        index = np.unique([np.argmin(np.abs(self.steps - n)) for n in keep])
        log_n = np.log(self.steps[index])

        def fit(errors):
            rms = np.sqrt(np.mean(errors**2, axis=0))
            return np.polyfit(log_n, np.log(np.maximum(rms, 1e-300)), 1)[0]

        errors = self.errors[:, index]
        rows = np.random.default_rng(0).integers(
            len(errors), size=(resamples, len(errors))
        )
        spread = np.std([fit(errors[r]) for r in rows])
        return float(fit(errors)), float(spread)


def growth(
    system: System, solver, steps: int, paths: int, dtype=np.float64, seed: int = 0
) -> Growth:
    """All paths at once, from different starts on the same circle or sphere as far as the
    system has one. Saved at steps, not by `ts=`: between steps Diffrax interpolates
    linearly, and a chord leaves the invariant by much more than rounding."""
    ours = isinstance(solver, ds.AbstractSymplecticRungeKutta)
    as_state = lambda y: jnp.stack(y) if len(y) == 3 else tuple(y)
    y0 = as_state([dtype(x) for x in system.y0])

    def solve(key):
        struct = jax.ShapeDtypeStruct((), dtype)
        path = (ds.WeakBrownianPath if ours else ds.FixedStepBrownianPath)(struct, key)
        sol = diffrax.diffeqsolve(
            system.make_terms(path), solver, dtype(0), dtype(H * steps), dtype(H), y0,
            saveat=diffrax.SaveAt(steps=max(steps // 1000, 1)), max_steps=steps,
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return sol.ts, sol.ys

    ts, ys = jax.jit(jax.vmap(solve))(jr.split(jr.key(seed), paths))
    # The invariant itself in double precision.
    double = lambda x: np.asarray(x, np.float64)
    values = jax.vmap(jax.vmap(system.invariant))(jax.tree.map(double, ys))
    first = system.invariant(jax.tree.map(double, y0))
    # The last place is empty if Diffrax merges the last two steps.
    errors = np.asarray(values / first - 1)[:, np.isfinite(ts[0])]
    every = max(steps // 1000, 1)
    return Growth(every * np.arange(1, errors.shape[1] + 1), errors)


class Run(NamedTuple):
    label: str
    system: System
    solver: diffrax.AbstractSolver


MIDPOINT = ds.ImplicitMidpoint()
RUNS = [
    Run("Kubo, ImplicitMidpoint", KUBO, MIDPOINT),
    Run("Kubo, SRKs1", KUBO, ds.SRKs1()),
    Run("Kubo, SRKw2", KUBO, ds.SRKw2()),
    Run("rigid body, ImplicitMidpoint", RIGID_BODY, MIDPOINT),
    Run("pendulum without noise, ImplicitMidpoint", PENDULUM, MIDPOINT),
    Run("pendulum, ImplicitMidpoint", NOISY_PENDULUM, MIDPOINT),
]
_QUICK = [RUNS[0], RUNS[2]]


def section(page: Page) -> str:
    steps, paths = (10_000, 32) if page.quick else (1_000_000, 32)
    print(f"\nErrors of invariants over {steps:,} steps of h = 2^-6, {paths} paths")
    rows, in_epsilons = [], {}
    for run in _QUICK if page.quick else RUNS:
        g = growth(run.system, run.solver, steps, paths)
        exponent, error = g.exponent()
        bias, _ = g.bias
        rows.append((run.label, f"{g.rms[-1]:.1e}", f"{exponent:.2f} ± {error:.2f}"))
        in_epsilons[run.label] = bias / float(np.finfo(np.float64).eps)
    return fill(
        __file__,
        table=table(("system, solver", "rms at the end", "exponent"), rows),
        steps=f"{steps:,}",
        paths=paths,
        bias=f"{in_epsilons['Kubo, ImplicitMidpoint']:.1g}",
    )
