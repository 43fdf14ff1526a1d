"""What `expectation` chooses: the law of the increments, the sampling, and its plan."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PRNGKeyArray

from .._custom_types import Devices
from .._simulation import has_discrete_increments, Problem
from .._solver import Want
from .cost import OPERATIONS_PER_SECOND, operations_per_step
from .estimate import Expectation
from .fitted import count_outcomes, MOST_DIMENSIONS_OF_GRID, ValueFunctions
from .fused_paths import fused_plan
from .independent import IndependentPaths
from .kinks import has_kinks
from .sampling import AbstractSampling, SamplingPlan, SAVED_SAMPLINGS
from .sorted import ArrayRQMC, step_words


# No sample's key is folded from this number.
_NO_SAMPLE = 0xFFFFFFFF
# Value functions are chosen where they are fitted on a grid, up to this many outcomes of
# one step and of all steps, which a fit visits at each point. With these, 32 points along
# each of two axes are less than `basis_choice` allows (32^2 * 48 = 49,152 for one step).
_MOST_OUTCOMES_OF_STEP = 48
_MOST_OUTCOMES_OF_STEPS = 2**12
# Paths are sorted up to this dimension: the default of 2^14 paths are eleven along each of
# four coordinates.
_MOST_COMPONENTS_SORTED = 4
# Where a fit leaves more than this of the standard error, paths are sorted instead. For an
# indicator and a call option on the pendulum fits left 26% and 1.3%, and sorted paths had
# error bars that were 23 and 8 times less.
_MOST_REMAINDER = 0.01
# The number of independent paths without a tolerance. (The other samplings have defaults.)
_PATHS = 2**17
# With a tolerance, which ends the estimate, the number of samples is without limit.
_MOST_SAMPLES = 10**9
# Without a tolerance, paths take no more than about this many seconds, so that a first call
# ends while its user waits.
_SECONDS = 10
# Sorted paths are drawn and sorted before each step, which takes as long as this many
# operations for each path.
_OPERATIONS_OF_SORTING = 1500
# The fewest paths, however long they take: fewer do not know their own spread.
_FEWEST_PATHS = 2**8
# The sizes of a trial, a part of those of an estimate: it looks for changes that are
# several times the error of both.
_REPLICATES_OF_TRIAL = 8
_PATHS_OF_SORTED_TRIAL = 2**12
_PATHS_OF_TRIAL = 2**14
# Scrambling more random variables per step takes long.
_MOST_WORDS = 2**8


class Wanted(NamedTuple):
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


class Chosen(NamedTuple):
    """What is computed, and how. The plan holds the reason."""

    problem: Problem
    sampling: AbstractSampling
    plan: SamplingPlan


def choose(problem_for: Callable[[Want], Problem], wanted: Wanted) -> Chosen:
    """Chooses the law of the increments and the sampling, as far as the user did not. The
    docstring of `expectation` states the rules. `problem_for` maps the purpose of paths
    that are not known yet to the problem."""
    has_path, key, sampling, tol, start, engine, devices = wanted
    if engine not in (None, "jax", "drjit"):
        raise ValueError(f'`engine` must be "jax", "drjit" or `None`; got {engine!r}.')
    if sampling is None and start is not None:
        sampling = start.sampling

    # Discrete increments, unless `phi` is not smooth.
    problem = problem_for("weak")
    why_law = ""
    # Value functions need discrete increments, as do solvers of the weak sense.
    needs_discrete = isinstance(sampling, ValueFunctions)
    needs_discrete |= has_discrete_increments(problem.solver)
    if has_kinks(problem) and not has_path and not needs_discrete:
        problem = problem_for("strong")
        why_law = "Gaussian increments, since phi may not be smooth"

    why_sampling = ""
    is_chosen = sampling is None
    if is_chosen:
        sampling, why_sampling = sampling_for(problem, tol, engine)
    sampling = _checked_sampling(sampling, start)

    if engine == "drjit":
        plan = fused_plan(problem, key, sampling, devices)
    else:
        plan = sampling.prepare(problem, trial_key(key), devices)
        # Only fits leave something.
        instead = None
        if is_chosen and plan.remainder > _MOST_REMAINDER:
            instead = sorted_paths(problem, tol)
        if instead is not None:
            why_sampling = (
                "sorted paths, since fitted value functions leave "
                f"{plan.remainder:.1%} of the standard error"
            )
            sampling = instead
            plan = sampling.prepare(problem, trial_key(key), devices)

    reason = "; ".join(filter(None, [why_sampling, why_law, plan.reason]))
    if start is not None:
        reason = start.reason
    plan = plan._replace(reason=reason, rounding_floor=problem.finest_steps)
    if start is not None and tol is None and plan.num_samples == _MOST_SAMPLES:
        # Without `tol` the number of samples stays as it was.
        used = start.moments[-1].end - start.moments[0].begin
        plan = plan._replace(num_samples=used)
    return Chosen(problem, sampling, plan)


def trial_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """The key of trials, which are not part of the estimate."""
    return jr.fold_in(key, _NO_SAMPLE)


def _checked_sampling(sampling: Any, start: Expectation | None) -> AbstractSampling:
    """The sampling. Raises a `ValueError` unless it is one, of the class that `start` was
    sampled by, if there is a `start`."""
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
    """The sampling, and the reason."""
    if engine == "drjit":
        # The engine has no other.
        return _independent_paths(problem, tol), ""
    components = _num_components(problem)
    steps = _num_steps(problem)
    num_outcomes = count_outcomes(problem)
    why = f"{components} components of the state, {steps:,} steps"
    if num_outcomes:
        why += f" of {num_outcomes} outcomes each"
    if _can_be_fitted(problem, num_outcomes):
        fitted = ValueFunctions(num_paths=_MOST_SAMPLES) if tol else ValueFunctions()
        return fitted, f"value functions for {why}"
    sampling = sorted_paths(problem, tol)
    if sampling is not None:
        return sampling, f"sorted paths for {why}"
    return _independent_paths(problem, tol), f"independent paths for {why}"


def _independent_paths(problem: Problem, tol: float | None) -> IndependentPaths:
    """As many independent paths as are affordable."""
    if tol:
        return IndependentPaths(_MOST_SAMPLES)
    affordable = _affordable_operations(problem) / operations_per_step(problem)
    return IndependentPaths(int(np.clip(affordable, _FEWEST_PATHS, _PATHS)))


def sorted_paths(problem: Problem, tol: float | None) -> ArrayRQMC | None:
    """Sorted paths, or `None` for many components and for paths that cannot be sorted."""
    if not _can_be_sorted(problem):
        return None
    usual = ArrayRQMC()
    operations = usual.replicates * (
        operations_per_step(problem) + _OPERATIONS_OF_SORTING
    )
    affordable = max(int(_affordable_operations(problem) / operations), _FEWEST_PATHS)
    # Rounded down to a power of two, as Sobol' points need.
    size = min(2 ** (affordable.bit_length() - 1), usual.num_paths)
    return ArrayRQMC(size, _MOST_SAMPLES if tol else usual.replicates)


def _affordable_operations(problem: Problem) -> float:
    """The operations of each step for which there is time, for all paths together."""
    return _SECONDS * OPERATIONS_PER_SECOND / _num_steps(problem)


def few_paths(problem: Problem) -> AbstractSampling:
    """The most accurate sampling of a few seconds that takes Gaussian increments, too."""
    if _can_be_sorted(problem):
        return ArrayRQMC(_PATHS_OF_SORTED_TRIAL, _REPLICATES_OF_TRIAL)
    return IndependentPaths(_PATHS_OF_TRIAL)


def _num_components(problem: Problem) -> int:
    return sum(leaf.size for leaf in jtu.tree_leaves(problem.y0))


def _num_steps(problem: Problem) -> int:
    """The steps of a path on all levels."""
    return int(np.sum(problem.levels.num_steps))


def _can_be_fitted(problem: Problem, num_outcomes: int | None) -> bool:
    """Whether value functions are the best choice, as far as it is known without a fit."""
    # They leave the variance of the start, for which few paths are too few.
    if problem.paths_differ or not num_outcomes:
        return False
    return (
        _num_components(problem) <= MOST_DIMENSIONS_OF_GRID
        and num_outcomes <= _MOST_OUTCOMES_OF_STEP
        and _num_steps(problem) * num_outcomes <= _MOST_OUTCOMES_OF_STEPS
    )


def _can_be_sorted(problem: Problem) -> bool:
    """Whether sorting paths helps, and does not take long."""
    if _num_components(problem) > _MOST_COMPONENTS_SORTED:
        return False
    try:
        return 0 < step_words(problem.terms).number <= _MOST_WORDS
    except ValueError:
        return False
