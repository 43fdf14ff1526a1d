"""Many paths at once, and means with standard errors."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds


class Mean(NamedTuple):
    value: float
    std_error: float

    @staticmethod
    def of(samples) -> "Mean":
        samples = np.asarray(samples)
        return Mean(
            float(np.mean(samples)), float(np.std(samples) / np.sqrt(len(samples)))
        )

    @property
    def sigmas(self) -> float:
        """How far from zero, in standard errors."""
        return self.value / self.std_error

    def __str__(self) -> str:
        if not np.isfinite(self.value):
            return "overflow"
        return f"{self.value:+.4f} ± {self.std_error:.4f}"


def gaussian(shape=()) -> Callable:
    return lambda key: ds.FixedStepBrownianPath(shape, key)


def truncated(shape=()) -> Callable:
    """Bounded, so that implicit steps stay solvable."""
    return ft.partial(ds.ImplicitMidpoint().path, shape)


def weak(shape=()) -> Callable:
    return lambda key: ds.WeakBrownianPath(shape, key)


def areas(shape=()) -> Callable:
    return ft.partial(ds.SRKs4().path, shape)


def plateaus(shape=()) -> Callable:
    return ft.partial(ds.PlateauVerlet().path, shape)


def ensemble(
    make_terms: Callable,
    make_path: Callable,
    solver: diffrax.AbstractSolver,
    y0,
    h: float,
    steps: int,
    paths: int,
    *,
    args: Any = None,
    saveat: diffrax.SaveAt | None = None,
    event: diffrax.Event | None = None,
    seed: int = 0,
) -> tuple[Any, Any, np.ndarray]:
    """Times and states as saved, in each row one path, and which paths failed."""

    def solve(key):
        sol = diffrax.diffeqsolve(
            make_terms(make_path(key)), solver, 0.0, h * steps, h, y0, args,
            saveat=diffrax.SaveAt(t1=True) if saveat is None else saveat,
            # Room for a step that rounding adds.
            max_steps=steps + 1, adjoint=diffrax.ForwardMode(), throw=False, event=event,
        )  # fmt: skip
        stopped = sol.result == diffrax.RESULTS.event_occurred
        good = stopped | (sol.result == diffrax.RESULTS.successful)
        return sol.ts, sol.ys, ~good

    ts, ys, failed = jax.jit(jax.vmap(solve))(jr.split(jr.key(seed), paths))
    return jax.device_get((ts, ys, failed))
