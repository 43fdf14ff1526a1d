"""The default choice of `sampling` in `expectation`."""

import jax.tree_util as jtu
import numpy as np

from ._problem import Problem
from ._value_functions import ValueFunctions
from .array_rqmc import ArrayRQMC, layout
from .cost import NUMBERS_PER_SECOND, numbers_per_step
from .monte_carlo import IndependentPaths
from .noise import num_outcomes
from .sampling import AbstractSampling


# Limits for value functions: the dimension, and the outcomes of all steps and of one step.
# The dimension up to which paths are sorted.
_FUNCTIONS, _OUTCOMES, _FEW_OUTCOMES, _SORTED = 2, 2**12, 48, 4
# The number of samples without a tolerance, and the maximum with one.
_PATHS_OF_FUNCTIONS, _PATHS, _REPLICATE, _REPLICATES = 2**12, 2**17, 2**14, 16
MOST = 10**9
# Where a fit leaves more than this of the standard error, paths are sorted instead. For an
# indicator and a call option on the pendulum fits left 26% and 1.3%, and sorted paths had
# error bars that were 23 and 8 times less.
MUCH_LEFT = 0.01
# The sizes of a trial.
_FEW_SORTED, _FEW_REPLICATES, _FEW_PATHS = 2**12, 8, 2**14
# Scrambling more random variables per step takes long.
_MOST_WORDS = 2**8
# Without a tolerance, samples are to take no more than about this many seconds.
_SECONDS = 10
# A replicate draws and sorts its paths before each step, which takes as long as computing
# this many numbers for each path.
_SORTING = 1500
# The fewest paths.
_FEWEST = 2**8


def choose(problem: Problem, tol: float | None) -> tuple[AbstractSampling, str]:
    """The sampling, and the reason. The docstring of `expectation` documents the rule."""
    d = sum(x.size for x in jtu.tree_leaves(problem.y0))
    steps = int(np.sum(problem.levels.num_steps))
    outcomes = num_outcomes(problem)
    why = f"{d} components of the state, {steps:,} steps"
    why += f" of {outcomes} outcomes each" if outcomes else ""
    # Value functions leave the variance of the start, for which few paths are too few.
    few_suffice = not problem.paths_differ
    if few_suffice and d <= _FUNCTIONS and outcomes and outcomes <= _FEW_OUTCOMES:
        if steps * outcomes <= _OUTCOMES:
            sampling = ValueFunctions(None, MOST if tol else _PATHS_OF_FUNCTIONS)
            return sampling, f"value functions for {why}"
    if (sampling := sorted_paths(problem, tol)) is not None:
        return sampling, f"sorted paths for {why}"
    if tol:
        return IndependentPaths(MOST), f"independent paths for {why}"
    steps_of_all = _SECONDS * NUMBERS_PER_SECOND / numbers_per_step(problem)
    paths = int(np.clip(steps_of_all / steps, _FEWEST, _PATHS))
    return IndependentPaths(paths), f"independent paths for {why}"


def sorted_paths(problem: Problem, tol: float | None) -> ArrayRQMC | None:
    """Sorted paths, or `None` for many components and for paths that cannot be sorted."""
    d = sum(x.size for x in jtu.tree_leaves(problem.y0))
    steps = int(np.sum(problem.levels.num_steps))
    if d > _SORTED or not _can_be_sorted(problem):
        return None
    numbers = numbers_per_step(problem) + _SORTING
    steps_of_all = _SECONDS * NUMBERS_PER_SECOND / numbers
    fewer = max(int(steps_of_all / steps / _REPLICATES), _FEWEST)
    size = min(2 ** (fewer.bit_length() - 1), _REPLICATE)
    return ArrayRQMC(size, MOST if tol else _REPLICATES)


def few_paths(problem: Problem) -> AbstractSampling:
    """The most accurate sampling of a few seconds that takes Gaussian increments, too."""
    d = sum(x.size for x in jtu.tree_leaves(problem.y0))
    if d <= _SORTED and _can_be_sorted(problem):
        return ArrayRQMC(_FEW_SORTED, _FEW_REPLICATES)
    return IndependentPaths(_FEW_PATHS)


def _can_be_sorted(problem: Problem) -> bool:
    try:
        return 0 < layout(problem.terms).num_words <= _MOST_WORDS
    except ValueError:
        return False
