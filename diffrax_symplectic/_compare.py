"""Comparison of solvers on one system: speed against accuracy."""

import dataclasses
import functools as ft
import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, PRNGKeyArray, PyTree

from ._arguments import check_real, check_solver, check_takes, shapes
from ._custom_types import Args, RealScalarLike, Y
from ._suggest import (
    common_path,
    own_path,
    random_paths,
    suggest_solver,
    with_paths,
)
from ._terms import check_stratonovich, path_numbers


# The results of a batch of paths, and which paths succeeded.
_Batch: TypeAlias = tuple[PyTree[Array], Bool[Array, " num_paths"]]

# The number of steps of the reference in the smallest compared step.
_FINER = 8


class ComparedStep(NamedTuple):
    """One solver at one step size.

    - `solver`: the name of the solver.
    - `dt`: the step size.
    - `error`, `std_error`: the error and its standard error.
    - `seconds`: the measured time per path.
    - `num_failed`: the number of failed paths, which are excluded from the error.
    """

    solver: str
    dt: float
    error: float
    std_error: float
    seconds: float
    num_failed: int


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison:
    """The result of [`diffrax_symplectic.compare_solvers`][]. Printed, it is a table.

    - `kind`: `"strong"` or `"weak"`.
    - `steps`: an entry for each solver and step size, with `solver`, `dt`, `error` and its
        `std_error`, `seconds` per path, and `num_failed`.
    - `refused`: the solvers that do not accept the terms, each with the reason.
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
        """Plots errors against times with Matplotlib, with bars of three standard errors.

        **Arguments:**

        - `axes`: Matplotlib axes; by default new ones.

        **Returns:** the axes.
        """
        import matplotlib.pyplot as plt

        axes = plt.subplots(layout="constrained")[1] if axes is None else axes
        for name in dict.fromkeys(s.solver for s in self.steps):
            own = [s for s in self.steps if s.solver == name]
            x, y = [s.seconds for s in own], [s.error for s in own]
            bars = [3 * s.std_error for s in own]
            axes.errorbar(x, y, bars, label=name, marker="o", capsize=2)
        axes.set(xscale="log", yscale="log")
        axes.set(xlabel="seconds per path", ylabel=f"{self.kind} error")
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
    r"""Measures speed against accuracy on your own system.

    Without `phi`, errors are strong: the root mean square of $|y - y^*|$ at `t1`, where
    $y^*$ is solved along the same Brownian path with an eighth of the smallest step in
    `dt0`. With `phi` errors are weak: $|\mathbb E \phi(t, y) - \mathbb E \phi(t, y^*)|$ at
    `t1`, from independent paths. Times are measured on this machine for a batch of paths,
    without compilation, and divided by the number of paths.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.1 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ())  # the shape of one noise
        y0 = (jnp.array(0.0), jnp.array(1.0))
        print(ds.compare_solvers(terms, None, 0.0, 1.0, [0.25, 0.125], y0, key=jr.key(1)))
        ```

    **Arguments:**

    - `terms`: the terms, with any Brownian path or its shape. Each solver gets the path
        that it needs.
    - `solvers`: a list of solvers, or `None` for the suggestions of `suggest_solver`.
    - `t0`, `t1`, `y0`, `args`: as for `diffrax.diffeqsolve`, with numbers for the times.
    - `dt0`: a list of step sizes, each of which divides the interval and is a multiple of
        the smallest.
    - `key`: a JAX random key.
    - `phi`: maps time, state and `args` to a number.
    - `num_paths`: the number of paths.
    - `reference`: the solver of $y^*$; by default the first suggestion of `suggest_solver`.

    **Returns:** a [`diffrax_symplectic.Comparison`][], which also lists solvers that do not
    accept the terms, with the reason.

    **Raises:** a `ValueError` if a step size does not divide the interval or is not a
    multiple of the smallest, if `phi` does not return one number, or if a solver is not a
    Diffrax solver.
    """
    dts = _checked_steps(t0, t1, dt0)
    want = "strong" if phi is None else "weak"
    suggestions = suggest_solver(terms, t0, y0, args, want=want)
    reference = suggestions[0].solver if reference is None else reference
    if solvers is None:
        solvers = [s.solver for s in suggestions]
    _check_solvers(solvers, reference)
    if phi is not None:
        _check_scalar(phi, t1, y0, args)
    problem = _Problem(terms, t0, t1, y0, args, phi)
    cell = min(dts) / _FINER
    own_of = lambda solver: ft.partial(own_path, solver, want)
    # Strong errors need a common Brownian motion, which not all solvers can use.
    common = lambda solver: ft.partial(common_path, solver, cell)
    error_path = common if phi is None else own_of
    keys = lambda number: jr.split(jr.fold_in(key, number), num_paths)
    fine = problem.batch(reference, error_path(reference))(keys(0), jnp.asarray(cell))
    steps, refused = [], {}
    for solver in solvers:
        name, own = repr(solver), problem.batch(solver, own_of(solver))
        compared = problem.batch(solver, common(solver)) if phi is None else own
        try:
            eqx.filter_eval_shape(compared, keys(0), jnp.asarray(dts[0]))
        except ValueError as error:
            refused[name] = str(error).splitlines()[0]
            continue
        jax.block_until_ready(own(keys(1), jnp.asarray(dts[0])))  # compiles
        for number, dt in enumerate(map(jnp.asarray, dts), start=1):
            begin = time.perf_counter()
            out = jax.block_until_ready(own(keys(number), dt))
            seconds = (time.perf_counter() - begin) / num_paths
            if phi is None:
                error, bar, failed = strong_error(compared(keys(0), dt), fine)
            else:
                error, bar, failed = weak_error(out, fine)
            steps.append(ComparedStep(name, float(dt), error, bar, seconds, failed))
    return Comparison(want, tuple(steps), refused)


class _Problem(NamedTuple):
    terms: diffrax.AbstractTerm
    t0: float
    t1: float
    y0: Y
    args: Args
    phi: Callable[[RealScalarLike, Y, Args], ArrayLike] | None

    def batch(self, solver: diffrax.AbstractSolver, make_path: Callable) -> Callable:
        """The results of paths as a function of their keys and the step size."""
        terms, t0, t1, y0, args, phi = self
        numbers = path_numbers(random_paths(terms))

        @eqx.filter_jit
        @ft.partial(jax.vmap, in_axes=(0, None))
        def results(key, dt):
            own = with_paths(make_path, numbers, terms, key)
            check_stratonovich(own, solver, t0, y0, args)
            sol = diffrax.diffeqsolve(
                own, solver, t0, t1, dt, y0, args, max_steps=None,
                adjoint=diffrax.ForwardMode(), throw=False,
            )  # fmt: skip
            y1 = jtu.tree_map(lambda y: y[-1], sol.ys)
            result = y1 if phi is None else phi(t1, y1, args)
            return result, diffrax.is_okay(sol.result)

        return results


def strong_error(out: _Batch, fine: _Batch) -> tuple[float, float, int]:
    """The root mean square of the difference over the paths that both solvers finish, its
    standard error, and the number of paths that either does not finish."""
    okay = np.asarray(out[1] & fine[1])
    square = lambda a, b: np.asarray(a - b, np.float64).reshape(len(okay), -1) ** 2
    squares = jtu.tree_leaves(jtu.tree_map(square, out[0], fine[0]))
    mean, bar = _mean(np.concatenate(squares, axis=1).sum(axis=1), okay)
    with np.errstate(all="ignore"):
        rms = np.sqrt(mean)
        return float(rms), float(bar / (2 * rms)), int(np.sum(~okay))


def weak_error(out: _Batch, fine: _Batch) -> tuple[float, float, int]:
    """The difference of the means, its standard error, and the number of failed paths."""
    (mean, bar), (exact, other) = _mean(*out), _mean(*fine)
    return abs(mean - exact), math.hypot(bar, other), int(np.sum(~np.asarray(out[1])))


def _mean(x, okay) -> tuple[float, float]:
    """The mean of the values that are `okay`, and its standard error."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no path is left
        kept = np.asarray(x, np.float64)[np.asarray(okay)]
        return float(np.mean(kept)), float(np.std(kept) / np.sqrt(len(kept)))


def _check_solvers(solvers, reference) -> None:
    if not isinstance(solvers, Sequence) or isinstance(solvers, str):
        raise ValueError(f"`solvers` must be a list of solvers; got {solvers!r}.")
    for solver in solvers:
        check_solver("solvers", solver)
    check_solver("reference", reference)


def _check_scalar(phi, t: RealScalarLike, y0: Y, args: Args) -> None:
    check_takes("phi", phi, "t", "y", "args")
    out = eqx.filter_eval_shape(phi, jnp.asarray(t, float), y0, args)
    leaves = jtu.tree_leaves(out)
    check_real("phi", leaves)
    if [*map(jnp.shape, leaves)] != [()]:
        raise ValueError(f"`phi` must return one number; got shape {shapes(out)}.")


def _checked_steps(t0, t1, dts: Sequence[float]) -> list[float]:
    if not t1 > t0:
        raise ValueError(f"`t1` must be after `t0`; got t0={t0!r} and t1={t1!r}.")
    if np.ndim(dts) != 1 or len(dts) == 0:
        raise ValueError(f"`dt0` must be a list of step sizes; got {dts!r}.")
    whole = lambda x: math.isfinite(x) and x > 0.5 and abs(x - round(x)) < 1e-6
    for dt in dts:
        if not dt or not whole((t1 - t0) / dt) or not whole(dt / min(dts)):
            raise ValueError(
                f"Every step in `dt0` must divide the interval from {t0} to {t1} and be a "
                f"multiple of the smallest; got {dt}. Take for example "
                "`[(t1 - t0) / 2**k for k in range(3, 8)]`."
            )
    return [float(dt) for dt in dts]
