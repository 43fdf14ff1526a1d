"""Expectations of functions of the state, with their error bars."""

import dataclasses
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
from jaxtyping import ArrayLike, PRNGKeyArray, PyTree

from .._arguments import check_solver, check_takes, whole_number
from .._custom_types import Args, RealScalarLike, Y
from .._terms import check_stratonovich
from ._array_rqmc import ArrayRQMC
from ._estimate import Expectation, NO_METER, run, warn_of_tol
from ._monte_carlo import check_tol, checked_key, IndependentPaths
from ._steps import (
    AbstractSampling,
    check_real,
    Level,
    level_weights,
    Prepared,
    Problem,
)
from ._value_functions import ValueFunctions


# The keys made from this number belong to no sample.
_NO_SAMPLE = 0xFFFFFFFF
# Paths of a trial of independent paths, which is one batch; of a replicate, and how many.
_PATHS, _REPLICATE, _REPLICATES = 2**13, 2**12, 8
# What promises to take less time than this is taken without further trials.
_SECONDS = 0.5
# A gain for which no other sampling is tried.
_CLEAR = 1e5
# The most samples that a tolerance may ask for.
_MOST = 10**9


def expectation(
    phi: Callable[[RealScalarLike, Y, Args], PyTree[ArrayLike]],
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: float,
    t1: float,
    dt0: float,
    y0: Y,
    args: Args = None,
    *,
    key: PRNGKeyArray,
    sampling: AbstractSampling | None = None,
    ts: Sequence[float] | np.ndarray | None = None,
    levels: int = 1,
    tol: float | None = None,
    start: Expectation | None = None,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = NO_METER,
) -> Expectation:
    r"""Estimates $\mathbb E[\phi(t, y_t)]$, its standard error, and the error of
    discretization.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H = lambda t, p, q, args: (p**2 + q**2) / 2
        terms = ds.hamiltonian_terms(H, H, ds.WeakBrownianPath((), jr.key(0)))
        estimate = ds.expectation(
            lambda t, y, args: y[1] ** 2,
            terms,
            ds.StrangGauss(),
            t0=0,
            t1=1,
            dt0=1 / 8,
            y0=(jnp.array(0.0), jnp.array(1.0)),
            key=jr.key(1),
            sampling=ds.ValueFunctions(degree=4),
            levels=3,
        )
        print(estimate)
        ```

    **Samples** are paths, or replicates of many paths, as `sampling` says. They are taken
    in batches, so that memory does not grow with their number. Sample number $i$ gets the
    key `fold_in(fold_in(key, i >> 32), i & 0xFFFFFFFF)`, whatever the batch size and the
    devices are.

    **Levels.** With `levels=2` (3, ...) a sample takes steps $h$ and $h/2$ (and $h/4$,
    ...). `mean` is then extrapolated to steps of size zero, by the solver's own
    `weak_order(terms)`, and order 1 for solvers that have none, as those of Diffrax. `bias`
    is the error of discretization that the finest of the levels has.

    This function is no part of a JAX program: it cannot be differentiated, `jit`ted or
    `vmap`ped. The gradient of an expectation is the expectation of the gradient, by
    [`diffrax_symplectic.monte_carlo`][].

    It compiles anew for each new `phi`, `sort_by` and function in `terms`. For many values
    of a parameter pass the same functions, and the parameter as an array in `args`.

    **Arguments:**

    - `phi`: takes time, state and `args` to a PyTree of real arrays.
    - `terms`, `solver`, `t0`, `t1`, `dt0`, `y0`, `args`: as for `diffrax.diffeqsolve`,
        with `t1` after `t0` by a whole number of steps `dt0`. The paths in `terms` say
        which random variables there are; that their keys are equal or not says which of
        them are one Brownian motion. Any solver of this package, and those of Diffrax with
        fixed steps for Stratonovich equations.
    - `key`: a JAX random key.
    - `sampling`: an [`diffrax_symplectic.IndependentPaths`][],
        [`diffrax_symplectic.ArrayRQMC`][] or [`diffrax_symplectic.ValueFunctions`][]. With
        `None` a short pilot tries those that can be used and takes the one with the least
        error for its time; `reason` of the result says which and why. (It measures times.
        So a second call may choose another.)
    - `ts`: the times at which to average, each a whole number of steps after `t0`; by
        default `t1` alone.
    - `levels`: how many step sizes, each half of the one before.
    - `tol`: no further batch begins once every standard error is at most this. The number
        of samples in `sampling` is then the most that are taken.
    - `start`: an earlier estimate to continue. It has to come from the same `key` and the
        same arguments; of these only the shapes are checked.
    - `devices`: the devices that share the work, by default all of `jax.devices()`: under
        `jax.distributed` those of every process, each of which has to make the same call
        and gets the same result.
    - `progress_meter`: one of Diffrax's.

    **Returns:** an [`diffrax_symplectic.Expectation`][]. A path that fails has no part in
    it and is counted in `num_failed`: one with a step that the solver reports as failed, or
    with a state or $\phi$ that is not finite.

    **Raises:** a `ValueError` for a solver of Itô equations (these terms are
    Stratonovich's), times between steps, a $\phi$ that is not real, sizes that are not
    positive integers, a `tol` that is not positive, a `key` that is none, a `start` from
    another key, of other shapes or with more paths, and for paths that `sampling` cannot
    use (it says which ones it can); [`diffrax_symplectic.ExpectationInterrupted`][], with
    the estimate so far, on an interrupt from the keyboard. Warns if `tol` was not reached.

    **Source:** [Chan, Golub and LeVeque
    (1983)](https://doi.org/10.1080/00031305.1983.10483115) for the formula by which means
    and variances of batches are combined; [Talay and Tubaro
    (1990)](https://doi.org/10.1080/07362999008809220) for extrapolation.
    """
    key = checked_key(key, "expectation")
    check_tol(tol)
    levels = whole_number("levels", levels)
    _check_solver(solver)
    problem = _problem(phi, terms, solver, t0, t1, dt0, y0, args, ts, levels)
    devices = tuple(jax.devices() if devices is None else devices)
    k_pilot, why, prepared = jr.fold_in(key, _NO_SAMPLE), "", None
    if sampling is None and start is not None:
        sampling, why = start.sampling, start.reason
    elif sampling is None:
        sampling, prepared, why = _chosen(problem, k_pilot, tol, devices)
    if not isinstance(sampling, AbstractSampling):
        raise ValueError(
            "`sampling` must be `IndependentPaths(num_paths)`, `ArrayRQMC()`, "
            f"`ValueFunctions()` or `None`; got {sampling!r}."
        )
    if start is not None and type(start.sampling) is not type(sampling):
        raise ValueError(
            f"`start` was sampled by {start.sampling}; got sampling={sampling}. Pass the "
            "same."
        )
    if prepared is None:
        prepared = sampling.prepare(problem, k_pilot, devices)
    sampler, plan, reason = prepared
    about = dict(sampling=sampling, reason=why or reason)
    estimate = run(sampler, key, plan, devices, start, tol, progress_meter, **about)
    warn_of_tol(estimate, tol)
    return estimate


def _problem(phi, terms, solver, t0, t1, dt0, y0, args, ts, levels: int) -> Problem:
    num_steps, saved_steps = _steps(t0, t1, dt0, ts)
    y0 = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), y0)
    start = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
    check_stratonovich(terms, solver, start, y0, args)
    check_takes("phi", phi, "t", "y", "args")
    check_real("phi", jtu.tree_leaves(eqx.filter_eval_shape(phi, start, y0, args)))
    finer = 2 ** np.arange(levels, dtype=np.int32)
    grid = Level(
        jnp.arange(levels, dtype=jnp.int32),
        jnp.asarray(float(dt0) / finer, start.dtype),
        jnp.asarray(finer * num_steps),
        jnp.asarray(finer[:, None] * saved_steps),
    )
    most = int(finer[-1] * num_steps)
    order = getattr(solver, "weak_order", lambda terms: 1)(terms) or 1
    weights = jnp.asarray(level_weights(order, levels), float)
    phi, at = _Arrays(phi), (grid, weights, ts is None, most)
    return Problem(phi, terms, solver, start, y0, args, *at)


class _Arrays(eqx.Module):
    """`phi`, with arrays for its numbers."""

    phi: Callable

    def __call__(self, t, y, args):
        return jtu.tree_map(jnp.asarray, self.phi(t, y, args))


def _steps(t0, t1, dt0, ts) -> tuple[np.integer, np.ndarray]:
    """How many steps there are, and after how many of them to average."""
    if dt0 is None:
        raise ValueError("`dt0` must be a number: steps are fixed; got None.")
    t0, t1, dt0 = float(t0), float(t1), float(dt0)
    if not (dt0 > 0 and t1 > t0):
        raise ValueError(
            f"`dt0` must be positive, and `t1` after `t0`; got dt0={dt0}, t0={t0}, "
            f"t1={t1}."
        )
    times = np.array([t1] if ts is None else ts, float).reshape(-1)
    counts = (np.append(times, t1) - t0) / dt0
    whole = np.round(counts)
    if not np.all(np.abs(counts - whole) <= 1e-6 * np.maximum(whole, 1)):
        raise ValueError(
            "`t1` and each of `ts` must be a whole number of steps after `t0`; got "
            f"steps of {dt0} from {t0} on, t1={t1} and ts={ts}. Choose a `dt0` that "
            "divides the times between them."
        )
    if len(times) == 0 or np.any(whole < 0) or np.any(whole > whole[-1]):
        raise ValueError(
            f"`ts` must lie between `t0` and `t1`, and hold one time at least; got {ts}."
        )
    steps = whole.astype(np.int32)
    return steps[-1], steps[:-1]


def _check_solver(solver) -> None:
    check_solver("solver", solver)
    if isinstance(solver, diffrax.HalfSolver):
        raise ValueError("`solver` must take fixed steps; got a `diffrax.HalfSolver`.")


class _Trial(NamedTuple):
    """A sampling that was tried: the variance of a sample, the largest if there are several
    numbers, and the seconds that it takes."""

    sampling: AbstractSampling
    prepared: Prepared
    variance: float
    seconds: float

    @property
    def work(self) -> float:
        """Seconds to a standard error of 1."""
        return self.variance * self.seconds


def _chosen(
    problem: Problem, key: PRNGKeyArray, tol: float | None, devices: tuple
) -> tuple[AbstractSampling, Prepared, str]:
    """The sampling with the least product of variance and time, of those that can be used,
    sized for `tol`; and why."""

    def tried(sampling, samples: int) -> _Trial | None:
        try:
            prepared = sampling.prepare(problem, key, devices)
        except ValueError:
            return None
        plan = prepared.plan._replace(num_samples=samples)
        own = jr.fold_in(key, 0xFFFFFFFF)
        sample = lambda: run(prepared.sampler, own, plan, devices)
        sample()  # compiles
        begin = time.perf_counter()
        e = sample()
        seconds = (time.perf_counter() - begin) / samples
        variances = [np.max(x, initial=0.0) for x in jtu.tree_leaves(e.variance)]
        variance = max(map(float, variances))
        return _Trial(
            sampling, prepared, variance if np.isfinite(variance) else np.inf, seconds
        )

    plain = tried(IndependentPaths(_PATHS, _PATHS), _PATHS)
    functions = rqmc = None
    assert plain is not None
    if tol is None or plain.work / tol**2 > _SECONDS:
        functions = ValueFunctions()
        functions = tried(functions, functions.batch_size)
        if functions is None or functions.work * _CLEAR > plain.work:
            rqmc = tried(ArrayRQMC(_REPLICATE, _REPLICATES), _REPLICATES)
    done = [trial for trial in (plain, functions, rqmc) if trial is not None]
    best = min(done, key=lambda trial: trial.work)
    listed = [f"{type(t.sampling).__name__} {t.work:.1e}" for t in done]
    reason = f"variance times seconds: {', '.join(listed)}"
    return *_sized(best, tol), reason


def _sized(best: _Trial, tol: float | None) -> tuple[AbstractSampling, Prepared]:
    """With as many samples as the tolerance needs, and some more."""
    sampling, plan = best.sampling, best.prepared.plan
    if tol is None:
        count = {IndependentPaths: 2**17, ArrayRQMC: 64, ValueFunctions: 4096}
        samples = count[type(sampling)]
    else:
        samples = int(np.clip(1.5 * best.variance / tol**2, plan.batch_size, _MOST))
        samples = max(samples, 2 * plan.least)
    name = "replicates" if isinstance(sampling, ArrayRQMC) else "num_paths"
    sampling = dataclasses.replace(sampling, **{name: samples})
    plan = plan._replace(num_samples=samples)
    return sampling, best.prepared._replace(plan=plan)
