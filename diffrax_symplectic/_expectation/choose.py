"""What `expectation` chooses: the law of the increments, the sampling, and its plan.

Increments are either discrete, which suffices for means of smooth functions, or Gaussian.
"""

from collections.abc import Callable

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
# Paths are sorted in up to this many dimensions. (In four, the default of 2^14 paths is
# eleven along each coordinate.)
_MOST_COMPONENTS_SORTED = 4
# If fitted value functions leave more than this fraction of the standard error, paths are
# sorted instead. For an indicator and a call option on the pendulum fits left 26% and 1.3%,
# and the error bars of sorted paths were 23 and 8 times less.
_MOST_REMAINDER = 0.01
# Without a tolerance, an estimate by value functions ends after this fraction of its paths
# if the error of the steps is far larger than the sampling error. (A smaller fraction may
# miss rare paths.)
_FRACTION_BESIDE_STEPS = 1 / 4
# The most independent paths without a tolerance. (The other samplings have defaults.)
_MOST_INDEPENDENT_PATHS = 2**17
# With a tolerance, which ends the estimate, the number of samples is without limit.
_MOST_SAMPLES = 10**9
# Without a tolerance, paths take no more than about this many seconds on two cores. (The
# user also waits for compiling, fits and checks, which take longer.)
_SECONDS_OF_PATHS = 1.5
# To draw and sort paths before a step takes as long as this many operations for each path.
_OPERATIONS_OF_SORTING = 1500
# However long they take, there are no fewer independent paths than the first number, and no
# fewer sorted paths in each replicate than the second: the standard deviation of fewer is
# too uncertain.
_FEWEST_PATHS = 2**8
_FEWEST_PATHS_OF_REPLICATE = 2**7
# The sizes of a trial with another law are smaller than those of an estimate, since it only
# looks for changes that are several times the errors of both.
_REPLICATES_OF_TRIAL = 8
_PATHS_OF_SORTED_TRIAL = 2**12
_PATHS_OF_TRIAL = 2**14
# By default, paths are sorted only with at most this many words per step, integers of 32
# random bits of which increments are made: to scramble more takes long.
_MOST_WORDS = 2**8


def choose(
    problem_for: Callable[[Want], Problem],
    has_path: bool,
    key: PRNGKeyArray,
    sampling: AbstractSampling | None,
    tol: float | None,
    start: Expectation | None,
    engine: str | None,
    devices: Devices,
) -> tuple[Problem, AbstractSampling, SamplingPlan]:
    """Chooses the law of the increments and the sampling, unless the user did.
    `docs/expectation.md` states the rules. Returns the problem, its sampling and its plan,
    which holds the reason for the choice. The sampling is the first of these:

    1. `sampling`, if the user passed one, or else the sampling of `start`;
    2. the sampling that suits the problem, by `sampling_for`;
    3. in place of value functions, sorted paths, if they are possible and a trial shows
       that the fits of the value functions leave too much of the standard error.

    Of the arguments, these are not arguments of `expectation`:

    - `problem_for`: makes the problem for a purpose, "weak" or "strong". For each path that
        the user left open, the solver makes one that suits the purpose, usually with
        discrete increments for "weak" and Gaussian ones for "strong".
    - `has_path`: whether the user's `terms` hold paths rather than their shapes."""
    if engine not in (None, "jax", "drjit"):
        raise ValueError(f'`engine` must be "jax", "drjit" or `None`; got {engine!r}.')
    if sampling is None and start is not None:
        sampling = start.sampling

    problem = problem_for("weak")
    why_law = ""
    # Value functions need discrete increments, and so do some solvers.
    needs_discrete = isinstance(sampling, ValueFunctions)
    needs_discrete |= has_discrete_increments(problem.solver)
    if has_kinks(problem) and not has_path and not needs_discrete:
        problem = problem_for("strong")
        why_law = "Gaussian increments, since phi may not be smooth"

    # Only `choose` itself calls this function: warnings in `prepare` count the calls
    # between them and the user.
    def plan_for(sampling: AbstractSampling) -> SamplingPlan:
        if engine == "drjit":
            return fused_plan(problem, key, sampling, devices)
        return sampling.prepare(problem, trial_key(key), devices)

    why_sampling = ""
    if sampling is not None:
        _check_sampling(sampling, start)
        plan = plan_for(sampling)
    else:
        sampling, why_sampling = sampling_for(problem, tol, engine)
        plan = plan_for(sampling)
        # The fraction of the standard error that the fits of value functions leave; zero
        # for other samplings.
        if plan.remainder > _MOST_REMAINDER:
            sorted_paths = array_rqmc_for(problem, tol)
            if sorted_paths is not None:
                why_sampling = (
                    "sorted paths, since fitted value functions leave "
                    f"{plan.remainder:.1%} of the standard error"
                )
                sampling = sorted_paths
                plan = plan_for(sampling)
        # The user did not choose this plan, so it is changed to take less time.
        if isinstance(sampling, ValueFunctions):
            # A path with a control variate takes far longer than another. So sampling ends
            # early where the error of the steps is far larger than the sampling error.
            least = int(plan.num_samples * _FRACTION_BESIDE_STEPS)
            plan = plan._replace(least_beside_steps=least)
        if isinstance(sampling, ArrayRQMC) and tol is None:
            # So few paths take less time than compiling their program. If it is compiled
            # quickly, paths take up to 1.3 times as long, but first calls of five problems
            # took 17, 18, 23, 24 and 27 s of processor time, in place of 20, 21, 27, 27 and
            # 26.
            plan = plan._replace(is_quick=True)
    reason = "; ".join(filter(None, [why_sampling, why_law, plan.reason]))
    plan = plan._replace(reason=reason)
    if start is not None and tol is None and plan.num_samples == _MOST_SAMPLES:
        # `start` had a tolerance, so it had no limit of samples. Without a tolerance, this
        # call takes no further samples.
        num_taken = start.moments[-1].end - start.moments[0].begin
        plan = plan._replace(num_samples=num_taken)
    return problem, sampling, plan


def _check_sampling(sampling: AbstractSampling, start: Expectation | None) -> None:
    """Raises a `ValueError` unless `sampling` is a sampling, and of the same class as that
    of `start`, if there is a `start`."""
    if not isinstance(sampling, AbstractSampling):
        names = ", ".join(f"`{name}`" for name in SAVED_SAMPLINGS)
        raise ValueError(
            f"`sampling` must be an instance of one of {names}, or `None`; got "
            f"{sampling!r}."
        )
    if start is not None and type(start.sampling) is not type(sampling):
        raise ValueError(
            f"`start` was sampled by {start.sampling}; got sampling={sampling}. Pass "
            "the same `sampling`."
        )


def trial_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """The key of trials, which are not part of the estimate."""
    return jr.fold_in(key, _TRIAL_KEY)


def sampling_for(
    problem: Problem, tol: float | None, engine: str | None = None
) -> tuple[AbstractSampling, str]:
    """The sampling that suits a problem best, and the reason for this choice: value
    functions, or else sorted paths, or else independent paths, which suit every problem."""
    # This engine takes independent paths only, so there is nothing to choose.
    if engine == "drjit":
        return _independent_paths_for(problem, tol), ""
    # How many values the random variables of a step may take together; `None` for many, or
    # for increments that are not discrete.
    num_outcomes = count_outcomes(problem)
    size = f"{problem.num_components} components of the state, "
    size += f"{_num_steps(problem):,} steps"
    if num_outcomes:
        size += f" of {num_outcomes} outcomes each"
    # Value functions reduce the variance of the noise, but not that of random starts, for
    # which their few paths do not suffice.
    is_random_by_noise = bool(num_outcomes) and not problem.paths_differ
    # With a tolerance, a fit may take long: as levels are added, it will anyway.
    if is_random_by_noise and suits_grid(problem, may_take_long=tol is not None):
        sampling = ValueFunctions()
        if tol is not None:
            sampling = ValueFunctions(num_paths=_MOST_SAMPLES)
        return sampling, f"value functions for {size}"
    sorted_paths = array_rqmc_for(problem, tol)
    if sorted_paths is not None:
        return sorted_paths, f"sorted paths for {size}"
    return _independent_paths_for(problem, tol), f"independent paths for {size}"


def _independent_paths_for(problem: Problem, tol: float | None) -> IndependentPaths:
    """As many independent paths as there is time for, or with `tol` as many as it takes."""
    if tol is not None:
        return IndependentPaths(_MOST_SAMPLES)
    num_affordable = _affordable_operations(problem) / operations_per_step(problem)
    num_paths = np.clip(num_affordable, _FEWEST_PATHS, _MOST_INDEPENDENT_PATHS)
    return IndependentPaths(int(num_paths))


def array_rqmc_for(problem: Problem, tol: float | None) -> ArrayRQMC | None:
    """As many sorted paths as there is time for, or with `tol` as many replicates as it
    takes; `None` if sorting does not help or is not possible."""
    if not _suits_sorting(problem):
        return None
    default = ArrayRQMC()
    # In each step, for one path.
    operations = operations_per_step(problem) + _OPERATIONS_OF_SORTING
    # The number of paths in all replicates together.
    num_affordable = int(_affordable_operations(problem) / operations)
    fewest = default.replicates * _FEWEST_PATHS_OF_REPLICATE
    most = default.replicates * default.num_paths
    num_affordable = int(np.clip(num_affordable, fewest, most))
    # A replicate takes a power of two of paths, as Sobol' points need: the largest that
    # allows as many replicates as by default. Paths that are left over make further
    # replicates.
    most_of_replicate = num_affordable // default.replicates
    num_paths = 2 ** (most_of_replicate.bit_length() - 1)
    replicates = num_affordable // num_paths
    return ArrayRQMC(num_paths, _MOST_SAMPLES if tol else replicates)


def _affordable_operations(problem: Problem) -> float:
    """How many operations all paths together may take in each step."""
    return _SECONDS_OF_PATHS * OPERATIONS_PER_SECOND / _num_steps(problem)


def trial_sampling(problem: Problem) -> AbstractSampling:
    """The most accurate sampling for a trial of a few seconds with Gaussian increments."""
    if _suits_sorting(problem):
        return ArrayRQMC(_PATHS_OF_SORTED_TRIAL, replicates=_REPLICATES_OF_TRIAL)
    return IndependentPaths(_PATHS_OF_TRIAL)


def _num_steps(problem: Problem) -> int:
    """The number of steps of a path, on all levels together."""
    return int(np.sum(problem.levels.num_steps))


def _suits_sorting(problem: Problem) -> bool:
    """Whether sorting paths is possible, helps, and does not take long."""
    if problem.num_components > _MOST_COMPONENTS_SORTED:
        return False
    # `word_layout` raises this error for paths whose increments are not made of words.
    try:
        return 0 < word_layout(problem.terms).num_words <= _MOST_WORDS
    except ValueError:
        return False
