"""Expectations of functions of the state, with error bars."""

import dataclasses
import functools as ft
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray, PyTree

from .._arguments import ShortTraceback
from .._brownian import Discrete, laws_of, UnspecifiedPath
from .._custom_types import Args, Devices, RealScalarLike, Y
from .._simulation import (
    advice_on_failures,
    has_discrete_increments,
    Problem,
    warn_of_stragglers,
    warn_of_truncation,
)
from .._solver import own_path
from .._terms import (
    brownian_paths,
    constraint_of,
    motion_numbers,
    random_paths,
    with_paths,
)
from .call import checked_call
from .choose import choose, trial_key, trial_sampling
from .estimate import (
    cautions,
    Expectation,
    largest_error,
    needs_level,
)
from .fast_drive import unresolved_drive
from .finer_level import trial_with_finer_level, Verdict
from .fused_paths import FusedPaths
from .jumps import jumps_at_step_ends, jumps_within_steps
from .kinks import has_kinks
from .long_steps import (
    too_long_steps,
    unresolved_angle,
    unresolved_noise,
)
from .out_of_range import is_finite_at_start, out_of_range
from .progress import NO_METER, Progress
from .run import Kept, run
from .sampling import AbstractSampling, SamplingPlan
from .strong_friction import unresolved_friction


# The number of levels, unless the user chooses it: the fewest that show the discretization
# error.
_FEWEST_LEVELS = 2
# The number up to which levels are added to reach a `tol`. The last level has steps of
# `dt0 / 32`.
_MOST_LEVELS = 6
# The advice for a quick first look. With these arguments only one program is compiled, as
# there are no fits, no further levels and no checks of the steps.
_QUICK_LOOK = "few paths on one level, `sampling=IndependentPaths(1000), levels=1`"
# Two means count as different if they are this many standard errors apart: by chance that
# happens once in sixteen thousand times.
_STD_ERRORS_TO_BE_SURE = 4


def expectation(
    phi: Callable[[RealScalarLike, Y, Args], PyTree[ArrayLike]],
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    dt0: RealScalarLike,
    y0: Y | Callable[..., Y],
    args: Args | Callable[[PRNGKeyArray], Args] = None,
    *,
    key: PRNGKeyArray,
    sampling: AbstractSampling | None = None,
    ts: Sequence[RealScalarLike] | np.ndarray | Array | None = None,
    levels: int | None = None,
    tol: float | None = None,
    start: Expectation | None = None,
    first: int = 0,
    engine: str | None = None,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = NO_METER,
) -> Expectation:
    r"""Estimates the mean $\mathbb E[\phi(t, y_t)]$, with an error bar for sampling and
    step size.

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
        )
        print(estimate)  # 0.364083 ± 8.6e-05, and the parts of this error
        ```

    **Samples** are paths, or replicates of many paths, drawn in batches, so memory does not
    grow with their number.

    **Levels.** Each sample is solved with `dt0` and `dt0 / 2`, and `mean` is extrapolated
    by the solver's weak order (1 if it states none). Three levels also check that order.

    This function runs outside JAX transformations: it cannot be differentiated, `jit`ted or
    `vmap`ped. Each call traces the functions anew, so what they read is read anew, and
    compiles only if they compute something else than before: other numbers and arrays do
    not count, but for numbers like 1, 2 and 1/2 in a formula, and exponents. For gradients,
    events and other options of `diffeqsolve`, write a function of a key for
    [`diffrax_symplectic.monte_carlo`][].

    **Arguments:**

    - `phi`: maps time, state and `args` to a PyTree of real arrays.
    - `terms`, `solver`, `t0`, `t1`, `dt0`, `y0`, `args`: as for `diffrax.diffeqsolve`,
        with `t1 - t0` a whole number of steps, and any solver of this package or
        Stratonovich solver of Diffrax with fixed steps. Give `terms` a shape in place of a
        path, and the solver chooses one. Paths with equal keys are one Brownian motion;
        each shape is another. `y0(key)` or `y0(key, args)`, and `args(key)`, may draw a
        value for each path; `std_error` then includes their variance. (To pass a function
        in `args` as it is, put it in a tuple or dictionary.)
    - `key`: a JAX random key.
    - `sampling`: an [`diffrax_symplectic.IndependentPaths`][],
        [`diffrax_symplectic.ArrayRQMC`][] or [`diffrax_symplectic.ValueFunctions`][].
        `None` chooses one (`reason` says why); see [How a sampling is
        chosen](expectation.md#how-a-sampling-is-chosen).
    - `ts`: the times at which to average, each a whole number of steps after `t0`; by
        default only `t1`.
    - `levels`: the number of step sizes, each half the previous one. With one level the
        discretization error is unknown, and not part of `error`: for maps, which have no
        smaller step. With three or more, the result is checked against the solver's order:
        see `Expectation.discretization_error`. `None` is two, those of `start`, or with
        `tol` as many as it takes, up to six.
    - `tol`: the largest `error`. No further batch starts once every `error` is at most
        `tol`, or more samples would not reach it. The number of samples in `sampling` is
        then an upper limit. Parts to merge need a number of `levels` beside `tol`.
    - `start`: an earlier estimate to continue, from the same `key` and the same arguments:
        others are refused.
    - `first`: the number of the first sample. Parts of an estimate that were computed
        separately, each with its own `first`, are combined by `Expectation.merge`: see
        [many machines](many_machines.md).
    - `engine`: `"drjit"` solves independent paths in one fused kernel, several times as
        fast; see [Large ensembles][large-ensembles]. `"jax"` or `None` is JAX.
    - `devices`: the devices that share the work, by default all of `jax.devices()`. Under
        `jax.distributed` these include the devices of every process; each process must make
        the same call, and gets the same result.
    - `progress_meter`: a Diffrax progress meter. Without one, a call that takes more than
        five seconds prints once to `sys.stderr` what it is doing.

    **Returns:** an [`diffrax_symplectic.Expectation`][]. A path fails if the solver reports
    a failed step, or if its state or $\phi$ is not finite. Failed paths are excluded, and
    counted in `num_failed`.

    **Raises:** a `ValueError` for an Itô solver where the Itô and Stratonovich equations
    differ, times between steps, a $\phi$ that is not real, sizes that are not positive
    integers, a `tol` that is not positive, an invalid `key`, a `start` with another key,
    other shapes or more paths, terms without noise, and for paths that `sampling` cannot
    use (the message names suitable ones); a
    [`diffrax_symplectic.ExpectationInterrupted`][] holding the estimate so far, on a
    keyboard interrupt after the first batch.

    Warns of the error bar: if `tol` was not reached, if failed paths could change the mean
    by more than the standard error, if a few samples account for most of the variance, if
    all samples are equal or underflow, if a fit was dropped or takes long, and if `phi` is
    not smooth and a trial with Gaussian increments has another mean than discrete ones. Of
    the steps: if two levels do not agree; if steps are too long at `y0` for an explicit
    solver, for [`diffrax_symplectic.StrangGauss`][], for the noise, for the friction or for
    another decay; if forces or noise jump in time within a step, or at its end where the
    solver takes them, or change too fast for the steps; if none of these is the case, but a
    trial with a third level changes a mean of two levels by more than its error, or steps
    turn states far and the trial is too noisy to tell; and if rounding in single precision
    may exceed the standard error, or numbers count as zero.

    **Source:** [Chan, Golub and LeVeque
    (1983)](https://doi.org/10.1080/00031305.1983.10483115) for combining means and
    variances of batches; [Talay and Tubaro
    (1990)](https://doi.org/10.1080/07362999008809220) for extrapolation.
    """
    other_arguments = terms, t0, t1, dt0, y0, args, ts
    key, first, devices = checked_call(
        "expectation", key, tol, start, first, devices, other_arguments
    )
    # Levels are added to reach `tol`, unless the user chose their number. To continue
    # `start`, an estimate must have the same levels.
    may_add_levels = levels is None and start is None
    if levels is None:
        levels = _FEWEST_LEVELS if start is None else start.levels

    has_path = not any(isinstance(x, UnspecifiedPath) for x in brownian_paths(terms))
    problem_of = ft.partial(
        Problem.of, phi, terms, solver, t0, t1, dt0, y0, args, ts, key=key
    )
    times = None if ts is None else np.array(ts, float).reshape(-1)
    progress = Progress("expectation", progress_meter, _QUICK_LOOK)
    # The checks after the last sample may be interrupted, too, and the estimate is kept.
    with ShortTraceback(), Kept() as kept, progress:
        while True:
            progress.stage("preparing the samples")
            problem, used_sampling, plan = choose(
                ft.partial(problem_of, levels), has_path, key, sampling, tol, start,
                engine, devices,
            )  # fmt: skip
            sizes = "one step size" if levels == 1 else f"{levels} step sizes"
            progress.stage(f"compiling and sampling with {sizes}")
            estimate = run(
                plan, key, devices, start, first, tol, progress, kept,
                sampling=used_sampling,
                rounding_floor=problem.finest_steps,
                digests=problem.digests,
                ts=times,
            )  # fmt: skip
            is_last = not may_add_levels or levels == _MOST_LEVELS
            if tol is None or is_last or not needs_level(estimate, tol):
                break
            # With another level all samples are taken anew.
            levels += 1

        progress.stage("checking the steps")
        dt0 = float(dt0)
        for message in _messages_on_result(estimate, problem, tol, dt0):
            warnings.warn(message, stacklevel=2)
        paths = plan.simulate_paths
        if isinstance(paths, FusedPaths):
            warn_of_stragglers(
                paths.num_stragglers, paths.num_failed, paths.num_paths, stacklevel=2
            )
        # The steps are checked with the first samples of a problem, and not again with
        # later parts.
        if start is None and first == 0:
            messages, caveat = _step_checks(estimate, problem, plan, key, devices, dt0)
            estimate = dataclasses.replace(estimate, caveat=caveat)
            for message in messages:
                warnings.warn(message, stacklevel=2)
            warn_of_truncation(problem.terms, dt0, stacklevel=2)
    return estimate


def _messages_on_result(
    estimate: Expectation, problem: Problem, tol: float | None, dt0: float
) -> list[str]:
    """Warnings of what is wrong with the numbers of an estimate: failed paths, numbers out
    of range, an error bar that may be too small, and rounding.

    If most paths fail, the warning of failed paths names the most likely cause: a number
    that is out of range, or else explicit steps that are too long."""
    # `num_paths` counts the paths that did not fail.
    most_fail = estimate.num_failed > estimate.num_paths
    lost_numbers = out_of_range(problem, most_fail)
    if lost_numbers is not None and most_fail:
        return [*cautions(estimate, tol, advice=lost_numbers)]
    advice = advice_on_failures(problem)
    is_explicit = not problem.is_implicit and constraint_of(problem.terms) is None
    # If even the first evaluation fails, the length of steps is not the cause.
    if most_fail and is_explicit and is_finite_at_start(problem):
        # A quarter of `dt0`, or if that is shorter, the step that turns the state by one
        # radian.
        shorter = dt0 / max(4, unresolved_angle(problem) or 0)
        advice = (
            f"Most likely, steps of `dt0={dt0:g}` are too long for "
            f"`{type(problem.solver).__name__}`: pass `dt0={shorter:.2g}` or less, or an "
            f"implicit solver. {advice}"
        )
    messages = [*cautions(estimate, tol, advice), lost_numbers]
    messages.append(_message_on_rounding(estimate, problem))
    return [message for message in messages if message is not None]


def _message_on_rounding(estimate: Expectation, problem: Problem) -> str | None:
    """A warning that rounding in single precision may exceed the sampling error; `None` if
    it does not."""
    precision = np.finfo(problem.dtype)
    if precision.bits >= 64:
        return None
    # Each step may be wrong by `eps` as a fraction of the state. The errors may have the
    # same sign in all steps, so they are taken to add up.
    fraction = float(precision.eps) * problem.finest_steps
    # No estimate reports a standard error below this floor (see `rounding_floor`). Rounding
    # may be most of a standard error up to twice the floor.
    floor = fraction * np.abs(estimate.vectors.mean)
    if not np.any(estimate.vectors.std_error <= 2 * floor):
        return None
    return (
        "Rounding errors may be larger than the sampling error: over "
        f"{problem.finest_steps:,} steps in {precision.dtype} they are about "
        f"{fraction:.0e} of the mean, which is the smallest `std_error` reported. For more "
        'digits call `jax.config.update("jax_enable_x64", True)` first.'
    )


def _step_checks(
    estimate: Expectation,
    problem: Problem,
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: Devices,
    dt0: float,
) -> tuple[list[str], str]:
    """Warnings of errors that come from the steps, or from discrete increments, and that
    the error of the estimate may not include; and its `caveat`, which is empty or says
    which errors a trial could not see."""
    on_steps = messages_on_steps(problem, dt0)
    verdict = Verdict()
    # Where these checks find nothing, a trial may. It takes longer, and does not name the
    # cause. Three levels need no trial.
    if len(problem.levels.h) == 2 and not on_steps:
        verdict = trial_with_finer_level(estimate, problem, plan, key, devices)
    on_increments = _message_on_increments(estimate, problem, key, devices)
    messages = [*on_steps, verdict.warning, on_increments]
    return [message for message in messages if message is not None], verdict.caveat


def messages_on_steps(problem: Problem, dt0: float) -> list[str]:
    """Warnings of what is wrong with the steps, where the error of the estimate may not
    include it. Each check looks at the problem alone, without taking samples:

    - With one level there is no check, as the error does not claim to include the
        discretization error.
    - With two levels there are all checks.
    - With more levels the order of convergence is checked anyway, which shows what some of
        the checks look for. These are left out."""
    levels = len(problem.levels.h)
    if levels == 1:
        return []
    found = [
        jumps_within_steps(problem) or unresolved_drive(problem),
        too_long_steps(problem, dt0),
    ]
    if levels == 2:
        found += [
            unresolved_noise(problem, dt0),
            unresolved_friction(problem, dt0),
            jumps_at_step_ends(problem),
        ]
    return [message for message in found if message is not None]


def _message_on_increments(
    estimate: Expectation, problem: Problem, key: PRNGKeyArray, devices: Devices
) -> str | None:
    """A warning that discrete increments give a wrong mean of a `phi` that is not smooth;
    `None` if `phi` is smooth, increments are not discrete, or a trial with Gaussian
    increments has the same mean. For solvers that take discrete increments only, there is a
    warning without a trial."""
    paths = random_paths(problem.terms)
    # A path that states no laws does not count as discrete.
    laws = [law for path in paths for law in (laws_of(path) or {}).values()]
    are_discrete = any(isinstance(law, Discrete) for law in laws)
    if not are_discrete or not has_kinks(problem):
        return None
    if has_discrete_increments(problem.solver):
        return (
            f"`phi` may not be smooth, and `{type(problem.solver).__name__}` has discrete "
            "increments alone, which have the right means of smooth functions only. Pass "
            'a solver of `suggest_solver(terms, t0, y0, args, want="strong")`.'
        )
    # Where several terms share a Brownian motion, their Gaussian paths share one, too.
    gaussian_path = ft.partial(own_path, problem.solver, "strong")
    terms = with_paths(gaussian_path, motion_numbers(paths), problem.terms, key)
    gaussian_problem = dataclasses.replace(problem, terms=terms)
    key_of_trial = trial_key(key)
    sampling = trial_sampling(gaussian_problem)
    plan = sampling.prepare(gaussian_problem, key_of_trial, devices)
    of_trial = run(plan, key_of_trial, devices).vectors
    of_estimate = estimate.vectors
    changes = np.abs(of_estimate.mean - of_trial.mean)
    std_errors = np.hypot(of_estimate.std_error, of_trial.std_error)
    if not np.any(changes > _STD_ERRORS_TO_BE_SURE * std_errors):
        return None
    return (
        "`phi` is not smooth, and its mean changes by up to "
        f"{largest_error(changes):.1e} with Gaussian increments, which is more than the "
        "error of the estimate: the discrete increments of a `WeakBrownianPath` (and of "
        "`ValueFunctions`) are for smooth functions. Pass the shape in place of the path "
        "in `terms`, or a `FixedStepBrownianPath`, and another `sampling` than "
        "`ValueFunctions`."
    )
