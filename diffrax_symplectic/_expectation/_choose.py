"""Which sampling an expectation takes, if it was not told."""

import jax.tree_util as jtu
import numpy as np

from ._array_rqmc import ArrayRQMC, layout
from ._monte_carlo import IndependentPaths
from ._noise import num_outcomes
from ._sampling import AbstractSampling
from ._steps import Problem
from ._value_functions import ValueFunctions


# Value functions in so many dimensions and for so many outcomes of all steps together, and
# for so many of one. Others sort by so many coordinates.
_FUNCTIONS, _OUTCOMES, _FEW_OUTCOMES, _SORTED = 2, 2**12, 32, 4
# How many samples there are without a tolerance, and at most with one.
_PATHS_OF_FUNCTIONS, _PATHS, _REPLICATE, _REPLICATES = 2**12, 2**17, 2**14, 16
_MOST = 10**9
# More random variables of a step take long to scramble.
_MOST_WORDS = 2**8
# Fewer paths where all steps of all would make more numbers: ten seconds or so.
_NUMBERS, _FEWEST = 2**28, 2**8


def choose(problem: Problem, tol: float | None) -> tuple[AbstractSampling, str]:
    """The sampling, and why. The docstring of `expectation` states this rule."""
    d = sum(x.size for x in jtu.tree_leaves(problem.y0))
    steps = int(np.sum(problem.levels.num_steps))
    outcomes = num_outcomes(problem)
    why = f"{d} numbers in the state, {steps:,} steps"
    why += f" of {outcomes} outcomes each" if outcomes else ""
    paths = int(np.clip(_NUMBERS // (steps * d), _FEWEST, _PATHS))
    if d <= _FUNCTIONS and outcomes and outcomes <= _FEW_OUTCOMES:
        if steps * outcomes <= _OUTCOMES:
            sampling = ValueFunctions(None, _MOST if tol else _PATHS_OF_FUNCTIONS)
            return sampling, f"value functions for {why}"
    if d <= _SORTED and _can_be_sorted(problem):
        fewer = max(_NUMBERS // (steps * d * _REPLICATES), _FEWEST)
        size = min(2 ** (fewer.bit_length() - 1), _REPLICATE)
        return ArrayRQMC(size, _MOST if tol else _REPLICATES), f"sorted paths for {why}"
    return IndependentPaths(_MOST if tol else paths), f"independent paths for {why}"


def _can_be_sorted(problem: Problem) -> bool:
    try:
        return 0 < layout(problem.terms).num_words <= _MOST_WORDS
    except ValueError:
        return False
