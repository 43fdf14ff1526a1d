"""Speed against accuracy of solvers on one system."""

import dataclasses
import functools as ft
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PRNGKeyArray

from ._arguments import check_solver, check_takes, shapes
from ._brownian import (
    FixedStepBrownianPath,
    LevyAreaBrownianPath,
    LevyAreaIncrement,
    PlateauBrownianPath,
    PlateauIncrement,
)
from ._custom_types import Args, RealScalarLike, Y
from ._expectation import Expectation, monte_carlo
from ._solver import AbstractSymplecticSolver, Want
from ._suggest import suggest_solver, with_paths
from ._terms import check_stratonovich


# How many steps of the reference there are in the smallest step that is compared.
_FINER = 8


class ComparedStep(NamedTuple):
    """One solver at one step size.

    - `solver`: the name of the solver.
    - `dt`: the step size.
    - `error`, `std_error`: the error, and its standard error.
    - `seconds`: the measured time of a path.
    - `num_failed`: how many paths failed; they have no part in the error.
    """

    solver: str
    dt: float
    error: float
    std_error: float
    seconds: float
    num_failed: int


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison:
    """What [`diffrax_symplectic.compare_solvers`][] returns. To print it gives a table.

    - `kind`: `"strong"` or `"weak"`.
    - `steps`: one for each solver and step size, with `solver`, `dt`, `error` and its
        `std_error`, `seconds` for each path, and `num_failed`.
    - `refused`: the solvers that do not fit the terms, each with the reason.
    """

    kind: str
    steps: tuple[ComparedStep, ...]
    refused: dict[str, str]

    def __str__(self) -> str:
        title = f"{self.kind} error"
        lines = [f"{'solver':20} {'dt':>9} {title:>22} {'seconds per path':>17}"]
        for s in self.steps:
            failed = f"  {s.num_failed} failed" if s.num_failed else ""
            error = f"{s.error:.1e} +- {s.std_error:.0e}"
            row = f"{s.solver:20} {s.dt:9.3g} {error:>22} {s.seconds:17.1e}"
            lines.append(row + failed)
        lines += [f"{name}: {why}" for name, why in self.refused.items()]
        return "\n".join(lines)

    __repr__ = __str__

    def plot(self, axes: Any = None) -> Any:
        """Draws errors against times, with three standard errors, and returns the axes.

        **Arguments:**

        - `axes`: Matplotlib's axes; by default new ones.

        **Raises:** an `ImportError` without Matplotlib.
        """
        try:
            import matplotlib.pyplot as plt
        except ImportError as error:
            raise ImportError(
                "To plot needs Matplotlib: `pip install 'diffrax_symplectic[examples]'`, "
                "or `pip install matplotlib`."
            ) from error
        if axes is None:
            _, axes = plt.subplots(layout="constrained")
        for name in dict.fromkeys(s.solver for s in self.steps):
            own = [s for s in self.steps if s.solver == name]
            axes.errorbar(
                [s.seconds for s in own],
                [s.error for s in own],
                [3 * s.std_error for s in own],
                label=name,
                marker="o",
                capsize=2,
            )
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="seconds per path",
            ylabel=f"{self.kind} error",
        )
        axes.legend()
        return axes


def compare_solvers(
    terms: diffrax.AbstractTerm,
    solvers: Sequence[diffrax.AbstractSolver] | None,
    t0: float,
    t1: float,
    dt0: Sequence[float],
    y0: Y,
    args: Args = None,
    *,
    key: PRNGKeyArray,
    phi: Callable[[RealScalarLike, Y, Args], ArrayLike] | None = None,
    num_paths: int = 1000,
    reference: diffrax.AbstractSolver | None = None,
) -> Comparison:
    r"""Measures speed against accuracy on a system of your own.

    Without `phi` errors are strong: root mean squares of $|y - y^*|$ at `t1`, with $y^*$
    a solution along the same Brownian path in steps an eighth of the smallest of `dt0`.
    With `phi` they are weak: $|\mathbb E \phi(t, y) - \mathbb E \phi(t, y^*)|$ at `t1`,
    by independent paths; their standard errors fall as one over the root of `num_paths`.

    Times are those of a batch of paths on this machine, divided by their number, without
    compiling.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.1 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
        y0 = (jnp.array(0.0), jnp.array(1.0))
        solvers = [ds.StormerVerlet(), ds.ImplicitMidpoint()]
        print(
            ds.compare_solvers(terms, solvers, 0.0, 1.0, [0.25, 0.125], y0, key=jr.key(1))
        )
        ```

    **Arguments:**

    - `terms`: the terms, with any Brownian path. Each solver gets the path that it needs
        in its place.
    - `solvers`: a list of solvers, or `None` for those that `suggest_solver` names.
    - `t0`, `t1`, `y0`, `args`: as for `diffrax.diffeqsolve`, with numbers for the times.
    - `dt0`: a list of step sizes; each divides the interval, and is a multiple of the
        smallest.
    - `key`: a JAX random key.
    - `phi`: takes time, state and `args` to a number.
    - `num_paths`: how many paths.
    - `reference`: the solver of $y^*$; by default the first that `suggest_solver` names.

    **Returns:** a [`diffrax_symplectic.Comparison`][]. A solver that does not fit the terms
    is named there with the reason, and the others are compared.

    **Raises:** a `ValueError` if a step size does not divide the interval or is no multiple
    of the smallest, if `phi` does not return one number, and for what is no solver.
    """
    dts = _checked_steps(t0, t1, dt0)
    want = "paths" if phi is None else "expectations"
    suggestions = suggest_solver(terms, t0, y0, args, want=want)
    reference = suggestions[0].solver if reference is None else reference
    if solvers is None:
        solvers = [s.solver for s in suggestions]
    _check_solvers(solvers, reference)
    if phi is not None:
        _check_scalar(phi, t1, y0, args)
    cell = min(dts) / _FINER

    def end(solver, make_path, key, dt):
        return _end(with_paths(make_path, terms, key), solver, t0, t1, dt, y0, args)

    def sample(solver, dt, key):
        y1, result = end(solver, ft.partial(_path, solver, want), key, dt)
        return (y1 if phi is None else phi(t1, y1, args)), result

    def trial(solver):
        if phi is not None:
            return sample(solver, dts[0], key)
        # Errors are those along one Brownian motion, which not all solvers can follow.
        return end(solver, ft.partial(_common_path, solver, cell), key, dts[0])

    named, refused = _those_that_fit(solvers, trial)

    def measure(solver, dt, number: int):
        """The estimate by the paths of a number, and the seconds for each."""
        fn = eqx.Partial(sample, solver, jnp.asarray(dt))
        start = time.perf_counter()
        estimate = monte_carlo(fn, key=jr.fold_in(key, number), num_paths=num_paths)
        return estimate, (time.perf_counter() - start) / num_paths

    strong, fine = {}, None
    if phi is None:
        strong = _strong_errors(end, named, reference, dts, cell, key, num_paths)
    else:
        fine, _ = measure(reference, cell, 0)
    steps = []
    for name, solver in named.items():
        # Compiles the program, in which the step size is an array.
        measure(solver, dts[0], 1)
        for i, dt in enumerate(dts):
            estimate, seconds = measure(solver, dt, 1 + i)
            error, bar, failed = (
                strong[name][i] if fine is None else _weak_error(estimate, fine)
            )
            steps.append(ComparedStep(name, dt, error, bar, seconds, failed))
    return Comparison("strong" if phi is None else "weak", tuple(steps), refused)


def _end(terms, solver, t0, t1, dt, y0, args) -> tuple[Y, diffrax.RESULTS]:
    check_stratonovich(terms, solver, t0, y0, args)
    options: Any = dict(max_steps=None, adjoint=diffrax.ForwardMode(), throw=False)
    sol = diffrax.diffeqsolve(terms, solver, t0, t1, dt, y0, args, **options)
    return jtu.tree_map(lambda y: y[-1], sol.ys), sol.result


def _those_that_fit(solvers, solve: Callable) -> tuple[dict, dict[str, str]]:
    """Solvers by their names, and why those left out do not fit."""
    named, refused = {}, {}
    for solver in solvers:
        try:
            eqx.filter_eval_shape(solve, solver)
            named[repr(solver)] = solver
        except ValueError as error:
            refused[repr(solver)] = str(error).splitlines()[0]
    return named, refused


def _check_solvers(solvers, reference) -> None:
    if not isinstance(solvers, Sequence) or isinstance(solvers, str):
        raise ValueError(f"`solvers` must be a list of solvers; got {solvers!r}.")
    for solver in solvers:
        check_solver("solvers", solver)
    check_solver("reference", reference)


def _check_scalar(phi, t: RealScalarLike, y0: Y, args: Args) -> None:
    check_takes("phi", phi, "t", "y", "args")
    out = eqx.filter_eval_shape(phi, jnp.asarray(t, float), y0, args)
    if [jnp.shape(leaf) for leaf in jtu.tree_leaves(out)] != [()]:
        raise ValueError(f"`phi` must return one number; got shape {shapes(out)}.")


def _checked_steps(t0, t1, dts: Sequence[float]) -> list[float]:
    if not t1 > t0:
        raise ValueError(f"`t1` must be after `t0`; got t0={t0!r} and t1={t1!r}.")
    if np.ndim(dts) != 1:
        raise ValueError(f"`dt0` must be a list of step sizes; got {dts!r}.")
    whole = lambda x: math.isfinite(x) and x > 0.5 and abs(x - round(x)) < 1e-6
    for dt in dts:
        if not dt or not whole((t1 - t0) / dt) or not whole(dt / min(dts)):
            raise ValueError(
                f"Every step in `dt0` must divide the interval from {t0} to {t1} and be a "
                f"multiple of the smallest; got {dt}. Take for example "
                "`[(t1 - t0) / 2**k for k in range(3, 8)]`."
            )
    if len(dts) == 0:
        raise ValueError("`dt0` must hold at least one step size.")
    return [float(dt) for dt in dts]


def _path(solver, want: Want, shape, key) -> diffrax.AbstractBrownianPath:
    """A path for `solver`, which samples each step by itself."""
    if isinstance(solver, AbstractSymplecticSolver):
        return solver.path(shape, key, want=want)
    return _common_path(solver, None, shape, key)


def _common_path(solver, cell, shape, key) -> diffrax.AbstractBrownianPath:
    """The same Brownian motion for all solvers."""
    area = diffrax.SpaceTimeLevyArea
    path = FixedStepBrownianPath(shape, key, levy_area=area, cell=cell)
    needs = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    if needs is PlateauIncrement:
        return PlateauBrownianPath(path, key)
    if needs is LevyAreaIncrement:
        return LevyAreaBrownianPath(path, key, terms=0 if cell else 2, cell=cell)
    return path


def _weak_error(estimate: Expectation, fine: Expectation) -> tuple[float, float, int]:
    """Error, standard error and failed paths."""
    error = abs(float(estimate.mean - fine.mean))
    bar = float(np.hypot(estimate.std_error, fine.std_error))
    return error, bar, estimate.num_failed


def _strong_errors(end, named, reference, dts, cell, key, num_paths) -> dict:
    """Error, standard error and failed paths for each solver and step size."""
    steps = jnp.asarray(dts)

    def squares(key):
        along = lambda solver, dt: end(
            solver, ft.partial(_common_path, solver, cell), key, dt
        )
        exact, solved = along(reference, cell)

        def at(solver, dt):
            y1, result = along(solver, dt)
            squared = jtu.tree_map(lambda a, b: jnp.sum((a - b) ** 2), y1, exact)
            okay = diffrax.is_okay(result) & diffrax.is_okay(solved)
            total = jnp.where(okay, sum(jtu.tree_leaves(squared)), 0.0)
            return total, total**2, okay.astype(total.dtype)

        one = lambda s: jax.lax.map(lambda dt: at(s, dt), steps)
        # Those that failed are counted here, for each solver by itself.
        errors = {name: one(solver) for name, solver in named.items()}
        return errors, diffrax.RESULTS.successful

    if not named:
        return {}
    estimate = monte_carlo(squares, key=key, num_paths=num_paths)
    out = {}
    for name, (square, fourth, okay) in estimate.mean.items():
        with np.errstate(all="ignore"):
            count = okay * estimate.num_paths
            mean = square / okay
            deviation = np.sqrt(np.maximum(fourth / okay - mean**2, 0) / count)
            rms = np.sqrt(mean)
            bars = deviation / (2 * rms)
        failed = np.round(num_paths - count).astype(int)
        out[name] = list(zip(rms.tolist(), bars.tolist(), failed.tolist()))
    return out
