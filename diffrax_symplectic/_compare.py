"""`compare_solvers`: the speed and the accuracy of solvers on one system."""

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
from jaxtyping import Array, ArrayLike, Bool, Key, PRNGKeyArray, PyTree

from ._arguments import (
    check_memory,
    check_real,
    check_solver,
    check_takes,
    check_untraced,
    shapes,
    whole_number,
)
from ._custom_types import Args, RealScalarLike, Y
from ._lapack import lapack_in_turn
from ._programs import traced
from ._simulation import checked_key
from ._solver import common_path, own_path
from ._suggest import suggest_solver
from ._terms import (
    check_stratonovich,
    motion_numbers,
    random_paths,
    shapes_as_paths,
    with_paths,
    with_programs,
)


# The number of steps of the reference in the smallest compared step. With order 1/2 the
# error of the reference is then 8^(-1/2), about a third, of the error that is measured.
# With any higher order it is less.
_REFERENCE_STEPS = 8
# The number of the batch of paths for which the reference is solved. Strong errors of all
# solvers are measured along these paths. (The batches for times begin with number 1.)
_COMMON_BATCH = 0
# A quotient of times counts as a whole number if it differs from one by less than this.
_TIME_ROUNDING = 1e-6


class PathResults(NamedTuple):
    """The results of a batch of paths.

    - `results`: the states at the end, or the values of `phi` there.
    - `okay`: which paths succeeded.
    """

    results: PyTree[Array]
    okay: Bool[Array, " num_paths"]


# Solves for a batch of paths. The arguments are their random keys, and the step size.
_SolveBatch: TypeAlias = Callable[[Key[Array, " num_paths"], Array], PathResults]


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
        # The rows below have columns of the same widths.
        lines = [f"{'solver':20} {'dt':>9} {title:>22} {'seconds per path':>17}"]
        for step in self.steps:
            failed = f"  {step.num_failed} failed" if step.num_failed else ""
            error = f"{step.error:.1e} +- {step.std_error:.0e}"
            row = f"{step.solver:20} {step.dt:9.3g} {error:>22} {step.seconds:17.1e}"
            lines.append(row + failed)
        lines += [f"{name}: {reason}" for name, reason in self.refused.items()]
        return "\n".join(lines)

    __repr__ = __str__

    def plot(self, axes: Any = None) -> Any:
        """Plots errors against times with Matplotlib, with bars of three standard errors.

        **Arguments:**

        - `axes`: Matplotlib axes; by default new ones.

        **Returns:** the axes.
        """
        # Matplotlib is no dependency of the package, and takes long to import.
        import matplotlib.pyplot as plt

        if axes is None:
            _, axes = plt.subplots(layout="constrained")
        # A dictionary keeps each name once, in the order of `steps`.
        for solver_name in dict.fromkeys(step.solver for step in self.steps):
            steps = [step for step in self.steps if step.solver == solver_name]
            axes.errorbar(
                x=[step.seconds for step in steps],
                y=[step.error for step in steps],
                yerr=[3 * step.std_error for step in steps],
                label=solver_name,
                marker="o",
                capsize=2,
            )
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
    key = checked_key("compare_solvers", key, (terms, y0, args))
    num_paths = whole_number("num_paths", num_paths, least=2)
    dts = _checked_dts(t0, t1, dt0)
    want = "strong" if phi is None else "weak"
    terms = shapes_as_paths(terms)
    suggestions = suggest_solver(terms, t0, y0, args, want=want)
    bytes_of_state = sum(jnp.asarray(leaf).nbytes for leaf in jtu.tree_leaves(y0))
    check_memory("num_paths", num_paths, bytes_of_state)
    reference = suggestions[0].solver if reference is None else reference
    solvers = [s.solver for s in suggestions] if solvers is None else solvers
    _check_solvers(solvers, reference)
    if phi is not None:
        _check_scalar(phi, t1, y0, args)
        phi = traced(phi, jnp.asarray(t1, float), y0, args)
    terms = with_programs(terms, t0, y0, args)
    reference_dt = min(dts) / _REFERENCE_STEPS
    solve_along = ft.partial(_solve_batch, terms, t0, t1, y0, args, phi)

    def keys(batch_number: int) -> Key[Array, " num_paths"]:
        return jr.split(jr.fold_in(key, batch_number), num_paths)

    # Common paths are the same Brownian motion for all solvers. (A solver that cannot use
    # them is refused.) Own paths are those that a solver makes itself, which may take less
    # time to sample.
    #
    # |                           | `want="strong"` | `want="weak"` |
    # | ------------------------- | --------------- | ------------- |
    # | times are measured along  | own paths       | own paths     |
    # | errors are measured along | common paths    | own paths     |
    def solve_along_own(solver: diffrax.AbstractSolver) -> _SolveBatch:
        return solve_along(solver, ft.partial(own_path, solver, want))

    def solve_along_common(solver: diffrax.AbstractSolver) -> _SolveBatch:
        return solve_along(solver, ft.partial(common_path, solver, reference_dt))

    solve_for_errors = solve_along_common if want == "strong" else solve_along_own
    common_keys = keys(_COMMON_BATCH)
    # Step sizes are arrays: for a Python number the program would compile anew.
    exact = solve_for_errors(reference)(common_keys, jnp.asarray(reference_dt))
    # The results are traced if a function of the user closes over traced values.
    check_untraced("`compare_solvers`", exact)
    steps = []
    refused = {}
    for solver in solvers:
        name = repr(solver)
        error_solve = solve_for_errors(solver)
        refusal = _refusal(error_solve, common_keys, jnp.asarray(dts[0]))
        if refusal is not None:
            refused[name] = refusal
            continue
        timed_solve = solve_along_own(solver) if want == "strong" else error_solve
        # The first call compiles, and is not timed.
        jax.block_until_ready(timed_solve(keys(1), jnp.asarray(dts[0])))
        # Weak errors are from independent paths, so each step size has its own batch.
        for batch_number, dt in enumerate(dts, start=1):
            dt_array = jnp.asarray(dt)
            results, seconds = _timed(timed_solve, keys(batch_number), dt_array)
            if want == "strong":
                error = strong_error(error_solve(common_keys, dt_array), exact)
            else:
                error = weak_error(results, exact)
            steps.append(ComparedStep(name, dt, seconds=seconds, **error._asdict()))
    return Comparison(want, tuple(steps), refused)


def _solve_batch(
    terms: diffrax.AbstractTerm,
    t0: float,
    t1: float,
    y0: Y,
    args: Args,
    phi: Callable[[RealScalarLike, Y, Args], ArrayLike] | None,
    solver: diffrax.AbstractSolver,
    make_path: Callable,
) -> _SolveBatch:
    """Returns a compiled function that solves for a batch of paths by one solver, each with
    Brownian paths `make_path(shape, key)` in place of the terms' own paths."""
    solver = with_programs(solver, t0, y0, args)
    # Terms that share a Brownian motion have equal numbers, and get the same new path.
    numbers = motion_numbers(random_paths(terms))

    @eqx.filter_jit
    @lapack_in_turn
    @ft.partial(jax.vmap, in_axes=(0, None))
    def solve_path(key: PRNGKeyArray, dt: Array) -> PathResults:
        # Increments are not truncated, so the equations of an implicit step may have no
        # solution. The path then counts as failed.
        own_terms = with_paths(make_path, numbers, terms, key)
        check_stratonovich(own_terms, solver, t0, y0, args)
        sol = diffrax.diffeqsolve(
            own_terms, solver, t0, t1, dt, y0, args, max_steps=None,
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        y1 = jtu.tree_map(lambda y: y[-1], sol.ys)
        result = y1 if phi is None else phi(t1, y1, args)
        return PathResults(result, diffrax.is_okay(sol.result))

    return solve_path


def _refusal(
    solve_batch: _SolveBatch, keys: Key[Array, " num_paths"], dt: Array
) -> str | None:
    """The reason for which a solver does not accept the terms; `None` if it does."""
    # Solvers raise these errors while JAX traces them, so nothing need be compiled.
    try:
        eqx.filter_eval_shape(solve_batch, keys, dt)
    except ValueError as error:
        return str(error).splitlines()[0]
    return None


def _timed(
    solve_batch: _SolveBatch, keys: Key[Array, " num_paths"], dt: Array
) -> tuple[PathResults, float]:
    """The results of a batch of paths, and the time per path in seconds."""
    begin = time.perf_counter()
    results = jax.block_until_ready(solve_batch(keys, dt))
    return results, (time.perf_counter() - begin) / len(keys)


class MeasuredError(NamedTuple):
    """The error of a batch of paths: the fields of the same names of `ComparedStep`."""

    error: float
    std_error: float
    num_failed: int


def strong_error(compared: PathResults, exact: PathResults) -> MeasuredError:
    """The root mean square of the difference between two solutions along the same paths.
    Paths on which one of the two solvers fails are excluded, and counted as failed."""
    okay = np.asarray(compared.okay & exact.okay)

    def squared_differences(y: Array, exact_y: Array) -> np.ndarray:
        return np.asarray(y - exact_y, np.float64).reshape(len(okay), -1) ** 2

    # Each leaf of the state has squares of shape (paths, entries).
    of_leaves = jtu.tree_map(squared_differences, compared.results, exact.results)
    squares = np.concatenate(jtu.tree_leaves(of_leaves), axis=1).sum(axis=1)
    mean_square, std_error_of_mean_square = _mean_and_std_error(squares, okay)
    root_mean_square = math.sqrt(mean_square)
    # The standard error of sqrt(x) is that of x, times the derivative 1 / (2 sqrt(x)). If
    # there is no difference at all, 0 / 0 makes it NaN.
    with np.errstate(all="ignore"):
        std_error = np.divide(std_error_of_mean_square, 2 * root_mean_square)
    return MeasuredError(root_mean_square, float(std_error), int(np.sum(~okay)))


def weak_error(compared: PathResults, exact: PathResults) -> MeasuredError:
    """The absolute difference between the means of two solutions along independent paths.
    Failed paths of either solution are excluded, and those of `compared` are counted."""
    mean, std_error = _mean_and_std_error(compared.results, compared.okay)
    exact_mean, exact_std_error = _mean_and_std_error(exact.results, exact.okay)
    return MeasuredError(
        error=abs(mean - exact_mean),
        # The variances of means from independent paths add up.
        std_error=math.hypot(std_error, exact_std_error),
        num_failed=int(np.sum(~np.asarray(compared.okay))),
    )


def _mean_and_std_error(values: Any, okay: Any) -> tuple[float, float]:
    """The mean of the values of paths that are `okay`, and its standard error."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        # If no path is left, the mean is NaN without a warning, since the number of failed
        # paths tells why.
        warnings.simplefilter("ignore", RuntimeWarning)
        okay_values = np.asarray(values, np.float64)[np.asarray(okay)]
        std_error = np.std(okay_values) / np.sqrt(len(okay_values))
        return float(np.mean(okay_values)), float(std_error)


def _check_solvers(solvers: Any, reference: Any) -> None:
    """Raises a `ValueError` unless `solvers` is a list of one or more solvers, and
    `reference` is a solver."""
    is_list = isinstance(solvers, Sequence) and not isinstance(solvers, str)
    if not is_list or len(solvers) == 0:
        raise ValueError(
            "`solvers` must be a list of one or more solvers, or `None` for the suggested "
            f"ones; got {solvers!r}."
        )
    for solver in solvers:
        check_solver("solvers", solver)
    check_solver("reference", reference)


def _check_scalar(phi: Any, t: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` unless `phi` returns one real number."""
    check_takes("phi", phi, "t", "y", "args")
    result = eqx.filter_eval_shape(phi, jnp.asarray(t, float), y0, args)
    leaves = jtu.tree_leaves(result)
    check_real("phi", leaves)
    is_one_number = len(leaves) == 1 and jnp.shape(leaves[0]) == ()
    if not is_one_number:
        raise ValueError(f"`phi` must return one number; got shape {shapes(result)}.")


def _checked_dts(t0: float, t1: float, dts: Sequence[float]) -> list[float]:
    """The step sizes `dts`, as Python numbers. Raises a `ValueError` unless each is
    positive, divides the interval, and is a multiple of the smallest. (Brownian increments
    over the smallest step are added up to those over longer steps.)"""
    # With `not`, NaN is refused, too: comparisons with NaN are false.
    if not t1 > t0:
        raise ValueError(f"`t1` must be after `t0`; got t0={t0!r} and t1={t1!r}.")
    if np.ndim(dts) != 1 or len(dts) == 0:
        raise ValueError(f"`dt0` must be a list of step sizes; got {dts!r}.")
    smallest = min(dts)
    if not smallest > 0:
        raise ValueError(f"Every step in `dt0` must be positive; got {smallest}.")
    for dt in dts:
        if not (_is_whole((t1 - t0) / dt) and _is_whole(dt / smallest)):
            raise ValueError(
                f"Every step in `dt0` must divide the interval from {t0} to {t1} and be a "
                f"multiple of the smallest; got {dt}. Take for example "
                "`[(t1 - t0) / 2**k for k in range(3, 8)]`."
            )
    return [float(dt) for dt in dts]


def _is_whole(x: float) -> bool:
    """Whether `x` is a positive whole number, up to rounding."""
    # Numbers up to a half are excluded, since they are rounded to zero.
    return math.isfinite(x) and x > 0.5 and abs(x - round(x)) < _TIME_ROUNDING
