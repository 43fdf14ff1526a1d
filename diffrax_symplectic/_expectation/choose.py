"""What `expectation` chooses: the law of the increments, the sampling, and its plan."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from .._custom_types import Devices
from .._simulation import has_discrete_increments, Problem
from .._solver import Want
from .cost import OPERATIONS_PER_SECOND, operations_per_step
from .estimate import Expectation
from .fitted import count_outcomes, suits_grid, ValueFunctions
from .fused_paths import fused_plan
from .independent import IndependentPaths
from .kinks import has_kinks
from .sampling import AbstractSampling, SamplingPlan, SAVED_SAMPLINGS
from .sorted import ArrayRQMC, word_layout


# Folded into the key of a call to draw trials. Numbers of samples, from which the keys of
# samples are folded, are smaller.
_TRIAL_KEY = 0xFFFFFFFF
# Paths are sorted in up to this many dimensions: the default of 2^14 paths leaves eleven
# along each of four coordinates.
_MOST_COMPONENTS_SORTED = 4
# Where a fit leaves more than this fraction of the standard error, paths are sorted
# instead. For an indicator and a call option on the pendulum fits left 26% and 1.3%, and
# sorted paths had error bars that were 23 and 8 times less.
_MOST_REMAINDER = 0.01
# Without a tolerance, an estimate by value functions ends after this fraction of its paths
# if the error of the steps is far larger than that of sampling. (Fewer may miss rare
# paths.)
_FRACTION_BESIDE_STEPS = 1 / 4
# The most independent paths without a tolerance. (The other samplings have defaults.)
_MOST_INDEPENDENT_PATHS = 2**17
# With a tolerance, which ends the estimate, the number of samples is without limit.
_MOST_SAMPLES = 10**9
# Without a tolerance, paths take no more than about this many seconds on two cores, since
# compiling, fits and checks take longer, and the user waits for all of them.
_SECONDS_OF_PATHS = 1.5
# Sorted paths are drawn and sorted before each step, which takes as long as this many
# operations for each path.
_OPERATIONS_OF_SORTING = 1500
# The fewest independent paths, and sorted paths of each replicate, however long they take:
# the standard deviation of fewer is too uncertain.
_FEWEST_PATHS = 2**8
_FEWEST_PATHS_OF_REPLICATE = 2**7
# The sizes of a trial, which are smaller than those of an estimate: it only looks for
# changes that are several times the errors of both.
_REPLICATES_OF_TRIAL = 8
_PATHS_OF_SORTED_TRIAL = 2**12
_PATHS_OF_TRIAL = 2**14
# Scrambling more random variables per step takes long.
_MOST_WORDS = 2**8


class Request(NamedTuple):
    """How the user of `expectation` wants it to be computed.

    - `has_path`: whether the `terms` hold paths, rather than their shapes.
    - The others are the arguments of the same names.
    """

    has_path: bool
    key: PRNGKeyArray
    sampling: AbstractSampling | None
    tol: float | None
    start: Expectation | None
    engine: str | None
    devices: Devices


class Decision(NamedTuple):
    """What is computed, and how. The plan holds the reason."""

    problem: Problem
    sampling: AbstractSampling
    plan: SamplingPlan


def choose(problem_for: Callable[[Want], Problem], request: Request) -> Decision:
    """Chooses the law of the increments and the sampling, as far as the user did not.
    `docs/expectation.md` states the rules. `problem_for` maps a purpose ("weak" or
    "strong"), for which the solver makes the paths that the user left open, to the
    problem."""
    engine = request.engine
    if engine not in (None, "jax", "drjit"):
        raise ValueError(f'`engine` must be "jax", "drjit" or `None`; got {engine!r}.')
    start = request.start
    given = request.sampling
    if given is None and start is not None:
        given = start.sampling

    problem, why_law = _problem_and_reason(problem_for, given, request.has_path)
    if given is None:
        sampling, plan, why_sampling = _best_sampling(problem, request)
    else:
        sampling = _checked_sampling(given, start)
        plan = _plan_for(problem, sampling, request)
        why_sampling = ""
    reason = "; ".join(filter(None, [why_sampling, why_law, plan.reason]))
    plan = plan._replace(
        reason=reason if start is None else start.reason,
        rounding_floor=problem.finest_steps,
        digests=problem.digests,
    )
    if start is not None and request.tol is None and plan.num_samples == _MOST_SAMPLES:
        # `start` had a tolerance, and this call has none: it takes no further samples.
        num_taken = start.moments[-1].end - start.moments[0].begin
        plan = plan._replace(num_samples=num_taken)
    return Decision(problem, sampling, plan)


def _plan_for(
    problem: Problem, sampling: AbstractSampling, request: Request
) -> SamplingPlan:
    """The plan of a sampling, for the engine that the user wants."""
    if request.engine == "drjit":
        return fused_plan(problem, request.key, sampling, request.devices)
    return sampling.prepare(problem, trial_key(request.key), request.devices)


class _Best(NamedTuple):
    """The sampling that suits a problem best, its plan, and the reason."""

    sampling: AbstractSampling
    plan: SamplingPlan
    reason: str


def _best_sampling(problem: Problem, request: Request) -> _Best:
    """The sampling that suits a problem best, by its sizes and by a trial of a fit."""
    tol = request.tol
    sampling, reason = sampling_for(problem, tol, request.engine)
    plan = _plan_for(problem, sampling, request)
    # The remainder is zero except for value functions.
    if plan.remainder > _MOST_REMAINDER:
        sorted_sampling = array_rqmc_for(problem, tol)
        if sorted_sampling is not None:
            sampling = sorted_sampling
            reason = (
                "sorted paths, since fitted value functions leave "
                f"{plan.remainder:.1%} of the standard error"
            )
            plan = _plan_for(problem, sampling, request)
    if isinstance(sampling, ValueFunctions):
        # A path with a control variate takes far longer than another, so none is taken in
        # vain.
        least = int(plan.num_samples * _FRACTION_BESIDE_STEPS)
        plan = plan._replace(least_beside_steps=least)
    if isinstance(sampling, ArrayRQMC) and tol is None:
        # Compiling takes longer than so few paths, which then take up to 1.3 times as long.
        # First calls of five problems took 17, 18, 23, 24 and 27 s of processor time, in
        # place of 20, 21, 27, 27 and 26.
        plan = plan._replace(is_quick=True)
    return _Best(sampling, plan, reason)


def _problem_and_reason(
    problem_for: Callable[[Want], Problem],
    sampling: AbstractSampling | None,
    has_path: bool,
) -> tuple[Problem, str]:
    """The problem, and the reason for the law of its increments if that is not the usual
    one. Increments are discrete, unless `phi` may not be smooth and the user left the law
    open."""
    problem = problem_for("weak")
    # Value functions need discrete increments, as do solvers of the weak sense.
    needs_discrete = isinstance(sampling, ValueFunctions)
    needs_discrete |= has_discrete_increments(problem.solver)
    if has_kinks(problem) and not has_path and not needs_discrete:
        reason = "Gaussian increments, since phi may not be smooth"
        return problem_for("strong"), reason
    return problem, ""


def trial_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """The key of trials, which are not part of the estimate."""
    return jr.fold_in(key, _TRIAL_KEY)


def _checked_sampling(sampling: Any, start: Expectation | None) -> AbstractSampling:
    """The sampling itself. Raises a `ValueError` if it is not a sampling, or if `start` was
    sampled by one of another class."""
    if not isinstance(sampling, AbstractSampling):
        names = ", ".join(f"`{name}`" for name in SAVED_SAMPLINGS)
        raise ValueError(
            f"`sampling` must be an instance of one of {names}, or `None`; got "
            f"{sampling!r}."
        )
    if start is not None and type(start.sampling) is not type(sampling):
        raise ValueError(
            f"`start` was sampled by {start.sampling}; got sampling={sampling}. Pass the "
            "same `sampling`."
        )
    return sampling


def sampling_for(
    problem: Problem, tol: float | None, engine: str | None = None
) -> tuple[AbstractSampling, str]:
    """The sampling that suits a problem best, and the reason for this choice."""
    if engine == "drjit":
        # This engine takes independent paths only, so there is nothing to choose.
        return _independent_sampling(problem, tol), ""
    num_outcomes = count_outcomes(problem)
    num_steps = _num_steps(problem)
    size = f"{problem.num_components} components of the state, {num_steps:,} steps"
    if num_outcomes:
        size += f" of {num_outcomes} outcomes each"
    # Value functions leave the variance of random starts, for which their few paths do not
    # suffice. With a tolerance, levels are added until a fit takes far longer.
    is_random_by_noise = bool(num_outcomes) and not problem.paths_differ
    if is_random_by_noise and suits_grid(problem, may_take_long=tol is not None):
        sampling = ValueFunctions(num_paths=_MOST_SAMPLES) if tol else ValueFunctions()
        return sampling, f"value functions for {size}"
    sampling = array_rqmc_for(problem, tol)
    if sampling is not None:
        return sampling, f"sorted paths for {size}"
    return _independent_sampling(problem, tol), f"independent paths for {size}"


def _independent_sampling(problem: Problem, tol: float | None) -> IndependentPaths:
    """As many independent paths as there is time for, or with `tol` as many as it takes."""
    if tol:
        return IndependentPaths(_MOST_SAMPLES)
    num_affordable = _affordable_operations(problem) / operations_per_step(problem)
    num_paths = np.clip(num_affordable, _FEWEST_PATHS, _MOST_INDEPENDENT_PATHS)
    return IndependentPaths(int(num_paths))


def array_rqmc_for(problem: Problem, tol: float | None) -> ArrayRQMC | None:
    """As many sorted paths as there is time for; `None` if sorting does not help or is not
    possible."""
    if not _suits_sorting(problem):
        return None
    default = ArrayRQMC()
    # In each step, for one path.
    operations = operations_per_step(problem) + _OPERATIONS_OF_SORTING
    # Paths of all replicates together.
    num_affordable = np.clip(
        int(_affordable_operations(problem) / operations),
        default.replicates * _FEWEST_PATHS_OF_REPLICATE,
        default.replicates * default.num_paths,
    )
    # Sobol' points need a power of two: the largest that allows as many replicates as by
    # default. The paths that this leaves are spent on further replicates.
    most_of_replicate = int(num_affordable) // default.replicates
    num_paths = 2 ** (most_of_replicate.bit_length() - 1)
    replicates = int(num_affordable) // num_paths
    return ArrayRQMC(num_paths, _MOST_SAMPLES if tol else replicates)


def _affordable_operations(problem: Problem) -> float:
    """The operations of each step for which there is time, for all paths together."""
    return _SECONDS_OF_PATHS * OPERATIONS_PER_SECOND / _num_steps(problem)


def trial_sampling(problem: Problem) -> AbstractSampling:
    """The sampling for a trial of a few seconds: the most accurate one that takes Gaussian
    increments, too."""
    if _suits_sorting(problem):
        return ArrayRQMC(_PATHS_OF_SORTED_TRIAL, replicates=_REPLICATES_OF_TRIAL)
    return IndependentPaths(_PATHS_OF_TRIAL)


def _num_steps(problem: Problem) -> int:
    """The steps of a path on all levels."""
    return int(np.sum(problem.levels.num_steps))


def _suits_sorting(problem: Problem) -> bool:
    """Whether sorting paths helps, and does not take long."""
    if problem.num_components > _MOST_COMPONENTS_SORTED:
        return False
    try:
        return 0 < word_layout(problem.terms).num_words <= _MOST_WORDS
    except ValueError:
        return False
