"""What the figures share: solves, pictures and claims."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt

import diffrax_symplectic as ds

from ._srkw2 import PaperSRKw2


# The claims that failed since the last figure began, and where pictures go.
failed: list[str] = []
_output = Path(__file__).parent / "output"

# The paper's members of these families; the defaults are others.
PAPER_SRKW2 = PaperSRKw2()
PAPER_SRKS3 = ds.SRKs3(a=0.25)


def weak(m: int | None = None, **kwargs) -> Callable[[Any], ds.WeakBrownianPath]:
    """Paths of `m` noises (one, without an axis, if `None`) from keys."""
    return lambda key: ds.WeakBrownianPath(() if m is None else (m,), key, **kwargs)


def gaussian(m: int | None = None, area: bool = False) -> Callable:
    levy_area = diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement
    return lambda key: ds.FixedStepBrownianPath(
        () if m is None else (m,), key, levy_area=levy_area
    )


def truncated(key) -> diffrax.AbstractBrownianPath:
    """One noise, with the increments that implicit strong methods are meant for."""
    return ds.ImplicitMidpoint().path((), key)


def briefly(fn: Callable) -> Callable:
    """`jax.jit` of what is run for less time than it takes to optimise it."""
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


def solve(terms, solver, y0, t1, h, **kwargs) -> diffrax.Solution:
    settings: dict[str, Any] = dict(max_steps=None, adjoint=diffrax.ForwardMode())
    settings |= kwargs
    return diffrax.diffeqsolve(terms, solver, 0.0, t1, h, y0, throw=False, **settings)


def trajectory(make_terms, make_path, solver, y0, h, steps: int, every: int, seed=0):
    """One path, its start and every so many steps of it: times and states. Works under
    `vmap` over seeds."""
    saveat = diffrax.SaveAt(t0=True, steps=every)
    terms = make_terms(make_path(jr.key(seed)))
    sol = solve(terms, solver, y0, h * steps, h, saveat=saveat, max_steps=steps)
    assert sol.ts is not None and sol.ys is not None
    return sol.ts, sol.ys, sol.result == diffrax.RESULTS.successful


def begin(output: Path) -> None:
    """Of a figure, with its pictures in `output`."""
    global _output
    _output = output
    failed.clear()


def claim(what: str, value, low: float = -jnp.inf, high: float = jnp.inf) -> None:
    """Says whether `low <= value <= high`; the command fails in the end if not."""
    holds = bool(low <= value <= high)
    interval = f"[{low:.4g}, {high:.4g}]"
    print(f"  {'ok' if holds else 'FAILS'}: {what}: {float(value):.4g} in {interval}")
    if not holds:
        failed.append(what)


def save(figure, name: str) -> None:
    _output.mkdir(parents=True, exist_ok=True)
    figure.savefig(_output / name)
    plt.close(figure)
    print(f"  picture: {_output / name}", flush=True)
