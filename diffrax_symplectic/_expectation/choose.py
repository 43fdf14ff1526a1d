"""The default choice of `sampling` in `expectation`."""

import jax.tree_util as jtu
import numpy as np

from .array_rqmc import ArrayRQMC, step_words
from .cost import NUMBERS_PER_SECOND, numbers_per_step
from .independent import IndependentPaths
from .noise import num_outcomes
from .problem import Problem
from .sampling import AbstractSampling
from .value_functions import ValueFunctions


# Value functions are chosen up to this dimension, in which they are fitted on a grid, and
# up to this many outcomes of one step and of all steps, which a fit visits at each point.
_MOST_COMPONENTS_OF_FITS = 2
_MOST_OUTCOMES_OF_STEP = 48
_MOST_OUTCOMES_OF_STEPS = 2**12
# Paths are sorted up to this dimension.
_MOST_COMPONENTS_SORTED = 4
# Where a fit leaves more than this of the standard error, paths are sorted instead. For an
# indicator and a call option on the pendulum fits left 26% and 1.3%, and sorted paths had
# error bars that were 23 and 8 times less.
MUCH_LEFT = 0.01
# The numbers of paths and replicates without a tolerance.
_PATHS_OF_FITS = 2**12
_PATHS = 2**17
_PATHS_OF_REPLICATE = 2**14
_REPLICATES = 16
# With a tolerance, which ends the estimate, the number of samples is without limit.
MOST_SAMPLES = 10**9
# Without a tolerance, paths take no more than about this many seconds.
_SECONDS = 10
# Sorted paths are drawn and sorted before each step, which takes as long as computing this
# many numbers for each path.
_NUMBERS_OF_SORTING = 1500
# The fewest paths, however long they take.
_FEWEST_PATHS = 2**8
# The sizes of a trial.
_REPLICATES_OF_TRIAL = 8
_PATHS_OF_SORTED_TRIAL = 2**12
_PATHS_OF_TRIAL = 2**14
# Scrambling more random variables per step takes long.
_MOST_WORDS = 2**8


def choose(problem: Problem, tol: float | None) -> tuple[AbstractSampling, str]:
    """The sampling, and the reason. The docstring of `expectation` documents the rule."""
    components = _num_components(problem)
    steps = _num_steps(problem)
    outcomes = num_outcomes(problem)
    why = f"{components} components of the state, {steps:,} steps"
    if outcomes:
        why += f" of {outcomes} outcomes each"
    if _can_be_fitted(problem, outcomes):
        num_paths = MOST_SAMPLES if tol else _PATHS_OF_FITS
        return ValueFunctions(None, num_paths), f"value functions for {why}"
    sampling = sorted_paths(problem, tol)
    if sampling is not None:
        return sampling, f"sorted paths for {why}"
    if tol:
        num_paths = MOST_SAMPLES
    else:
        affordable = _SECONDS * NUMBERS_PER_SECOND / (steps * numbers_per_step(problem))
        num_paths = int(np.clip(affordable, _FEWEST_PATHS, _PATHS))
    return IndependentPaths(num_paths), f"independent paths for {why}"


def sorted_paths(problem: Problem, tol: float | None) -> ArrayRQMC | None:
    """Sorted paths, or `None` for many components and for paths that cannot be sorted."""
    if not _can_be_sorted(problem):
        return None
    numbers = numbers_per_step(problem) + _NUMBERS_OF_SORTING
    numbers_of_all = _num_steps(problem) * numbers * _REPLICATES
    affordable = max(int(_SECONDS * NUMBERS_PER_SECOND / numbers_of_all), _FEWEST_PATHS)
    # Rounded down to a power of two, as Sobol' points need.
    size = min(2 ** (affordable.bit_length() - 1), _PATHS_OF_REPLICATE)
    return ArrayRQMC(size, MOST_SAMPLES if tol else _REPLICATES)


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


def _can_be_fitted(problem: Problem, outcomes: int | None) -> bool:
    """Whether value functions are the best choice, as far as it is known without a fit."""
    # They leave the variance of the start, for which few paths are too few.
    if problem.paths_differ or not outcomes:
        return False
    return (
        _num_components(problem) <= _MOST_COMPONENTS_OF_FITS
        and outcomes <= _MOST_OUTCOMES_OF_STEP
        and _num_steps(problem) * outcomes <= _MOST_OUTCOMES_OF_STEPS
    )


def _can_be_sorted(problem: Problem) -> bool:
    """Whether sorting paths helps, and does not take long."""
    if _num_components(problem) > _MOST_COMPONENTS_SORTED:
        return False
    try:
        return 0 < step_words(problem.terms).number <= _MOST_WORDS
    except ValueError:
        return False
