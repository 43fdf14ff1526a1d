"""Expectations of functions of the state, with their error bars."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PRNGKeyArray, PyTree

from .._custom_types import Args, RealScalarLike, Y
from ._choose import choose, MOST
from ._estimate import Expectation, ExpectationInterrupted
from ._run import checked_call, Meter, NO_METER, run
from ._sampling import AbstractSampling
from ._steps import Problem


# The key made from this number belongs to no sample.
_NO_SAMPLE = 0xFFFFFFFF


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
    first: int = 0,
    engine: str | None = None,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = NO_METER,
    **others: Any,
) -> Expectation:
    r"""Estimates $\mathbb E[\phi(t, y_t)]$, its standard error, and the error of
    discretization.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax
        import jax.numpy as jnp
        import jax.random as jr

        jax.config.update("jax_enable_x64", True)
        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.2 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ())  # the shape of one noise
        estimate = ds.expectation(
            lambda t, y, args: y[1] ** 2,
            terms,
            ds.StormerVerlet(),
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
        with `t1` after `t0` by a whole number of steps `dt0`. `terms` may have the
        shape of a path in its place; then the path is the one that the solver needs. Paths
        say which random variables there are, and paths with equal keys are one Brownian
        motion. Any solver of this package, and those of Diffrax with
        fixed steps for Stratonovich equations.
    - `key`: a JAX random key.
    - `sampling`: an [`diffrax_symplectic.IndependentPaths`][],
        [`diffrax_symplectic.ArrayRQMC`][] or [`diffrax_symplectic.ValueFunctions`][].
        `None` is a rule, and `reason` of the result says how it came out:
        `ValueFunctions` for one or two numbers in the state, if a step has at most 48
        outcomes and all steps together 4,096; otherwise `ArrayRQMC` for up to four
        numbers, if the paths in `terms` can be made of given words; `IndependentPaths`
        for all else. Without `tol` it takes 4,096 paths with value functions, 16
        replicates of 16,384 paths, or 131,072 paths, and fewer where all steps of all
        paths would make more than $2^{28}$ numbers: about ten seconds.
    - `ts`: the times at which to average, each a whole number of steps after `t0`; by
        default `t1` alone.
    - `levels`: how many step sizes, each half of the one before. With one, the error of
        discretization is unknown, and no part of `std_error`.
    - `tol`: no further batch begins once every standard error is at most this. The number
        of samples in `sampling` is then the most that are taken.
    - `start`: an earlier estimate to continue. It has to come from the same `key` and the
        same arguments; of these only the shapes are checked.
    - `first`: the number of the first sample. Parts of an estimate, made anywhere with
        another `first` each, are put together by `Expectation.merge`: see [many
        machines](many_machines.md).
    - `engine`: with `"drjit"` independent paths are taken by one fused kernel, several
        times as fast; see [Large ensembles][large-ensembles]. `"jax"` or `None` is JAX.
    - `devices`: the devices that share the work, by default all of `jax.devices()`: under
        `jax.distributed` those of every process, each of which has to make the same call
        and gets the same result.
    - `progress_meter`: one of Diffrax's.

    **Returns:** an [`diffrax_symplectic.Expectation`][]. A path that fails has no part in
    it and is counted in `num_failed`: one with a step that the solver reports as failed, or
    with a state or $\phi$ that is not finite.

    **Raises:** a `ValueError` for a solver of Itô equations where these differ from
    Stratonovich's, times between steps, a $\phi$ that is not real, sizes that are not
    positive integers, a `tol` that is not positive, a `key` that is none, a `start` from
    another key, of other shapes or with more paths, terms without noise, and for paths that
    `sampling` cannot use (it says which ones it can);
    [`diffrax_symplectic.ExpectationInterrupted`][], with the estimate so far, on an
    interrupt from the keyboard. Warns if `tol` was not reached, if more than one path in a
    hundred failed, if few samples make up for most of the spread, if a fit was dropped or
    takes long, if all samples are equal or underflow, and where rounding in single
    precision may be more than the standard error.

    **Source:** [Chan, Golub and LeVeque
    (1983)](https://doi.org/10.1080/00031305.1983.10483115) for the formula by which means
    and variances of batches are combined; [Talay and Tubaro
    (1990)](https://doi.org/10.1080/07362999008809220) for extrapolation.
    """
    if others:
        raise TypeError(
            f"`expectation` takes no {', '.join(f'`{name}`' for name in others)}. Solves "
            "with events, or with other arguments of `diffrax.diffeqsolve`, are averaged "
            "by `monte_carlo`: write one as a function of a random key."
        )
    given = terms, t0, t1, dt0, y0, args, ts
    key, begin, devices = checked_call(
        "expectation", key, tol, start, first, devices, given
    )
    if engine not in (None, "jax", "drjit"):
        raise ValueError(f'`engine` must be "jax", "drjit" or `None`; got {engine!r}.')
    problem = Problem.of(phi, terms, solver, t0, t1, dt0, y0, args, ts, levels)
    reason = ""
    if sampling is None and start is not None:
        sampling = start.sampling
    elif sampling is None:
        sampling, reason = choose(problem, tol)
    sampling = _checked_sampling(sampling, start)
    with Meter(progress_meter) as meter:
        try:
            if engine == "drjit":
                from .._ensemble import (
                    fused_plan,
                )  # It is made of parts of this folder.

                plan = fused_plan(problem, key, sampling, devices)
            else:
                plan = sampling.prepare(problem, jr.fold_in(key, _NO_SAMPLE), devices)
        except ExpectationInterrupted:
            # A trial's samples are not those of an estimate, to go on from.
            raise KeyboardInterrupt from None
        reason = "; ".join(filter(None, (reason, plan.reason)))
        reason = reason if start is None else start.reason
        plan = plan._replace(reason=reason, roundings=problem.max_steps)
        if start is not None and tol is None and plan.num_samples == MOST:
            # Only a tolerance has asked for more.
            used = start.moments[-1].end - start.moments[0].begin
            plan = plan._replace(num_samples=used)
        estimate = run(plan, key, devices, sampling, begin, tol, meter)
    _warn_of_rounding(estimate, problem)
    return estimate


def _checked_sampling(sampling: Any, start: Expectation | None) -> AbstractSampling:
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
    return sampling


def _warn_of_rounding(estimate: Expectation, problem: Problem) -> None:
    """Of single precision, in which many small sampling errors are below rounding."""
    numbers = np.finfo(problem.dtype)
    if numbers.bits >= 64:
        return
    # Sizes of steps are rounded with times, so that errors of one sign add up.
    fraction = float(numbers.eps) * problem.max_steps
    rounding = lambda mean: fraction * np.abs(mean)
    pairs = zip(jtu.tree_leaves(estimate.mean), jtu.tree_leaves(estimate.std_error))
    if any(np.any(error <= 2 * rounding(mean)) for mean, error in pairs):
        warnings.warn(
            "Rounding errors may be larger than the sampling error: over "
            f"{problem.max_steps:,} steps in {numbers.dtype} some {fraction:.0e} of the "
            "mean, the least that `std_error` is. For more digits call "
            '`jax.config.update("jax_enable_x64", True)` first.',
            stacklevel=3,
        )
