"""The basis in which the value functions of a problem are fitted."""

import math
import warnings
from typing import NamedTuple

import numpy as np

from ..._arguments import whole_number
from ..._simulation import Problem
from .bases import AbstractBasis, Hermite, Quadratic
from .grid import Grid
from .noise import Noise
from .polynomials import num_polynomials


# By default a grid is used in up to this many dimensions: in three, 32 points along each
# axis are 32,768 together, each with all outcomes of a step.
_MOST_DIMENSIONS_OF_GRID = 2
# The points along an axis: as many as memory and time allow.
_SIZES_OF_GRID = (64, 32)
# A fit computes the end of a step from each point for each node of the noise. The most ends
# for one step, whose states are in memory together, and for all steps, which take time.
_MOST_ENDS_OF_STEP = 50_000
_MOST_ENDS = 2**25
# The most polynomials in a fit by default: 120 of degree 2 in 14 dimensions.
_MOST_POLYNOMIALS = 130
# The highest degree by default. (In one dimension there are few polynomials: the most that
# are allowed would be of degree 129.)
_HIGHEST_DEGREE = 8
# Degrees up to this one are tried however long they take.
_ALWAYS_TRIED_UP_TO = 2
# The most bytes that a fit may take, so that it fits into machines of 8 GiB.
_MOST_MEMORY = 4 * 2**30
# A fit that computes at most this many numbers takes less time than compiling its program.
# (Fits of two coordinates took 0.4 s of processor time for 2.5 million numbers, and 9 and
# 11 s for 54 and 82 million, where compiling took 5 s.)
_MOST_OF_QUICK_FIT = 2**24
# The most that a fit computes without a warning that it will take long.
_MOST_WITHOUT_WARNING = 2**31


class ChosenBasis(NamedTuple):
    """A basis, and what a fit to it costs.

    - `num_states`: the number of states that are computed in each step.
    - `num_numbers`: the numbers that are computed in all steps: the components of states,
        and the functions at each of them.
    """

    basis: AbstractBasis
    num_states: int
    num_numbers: int

    @property
    def is_quick(self) -> bool:
        """Whether the fit takes less time than compiling its program."""
        return self.num_numbers <= _MOST_OF_QUICK_FIT


def chosen_basis(problem: Problem, degree: int | None) -> ChosenBasis:
    """The basis for polynomials of this degree, or for `None` a grid or polynomials of
    several degrees to try. Raises a `ValueError` if the fit needs too much memory, or for
    random variables without finitely many outcomes."""
    noise = Noise.of(problem, problem.level(0))
    num_nodes = len(noise.weighted_nodes().weights)
    total_steps = int(np.sum(problem.levels.num_steps))
    basis = _basis(problem, degree, num_nodes, total_steps)
    num_states = basis.num_sites * num_nodes
    numbers_of_state = basis.d + math.prod(problem.output_shape)
    return ChosenBasis(basis, num_states, num_states * total_steps * numbers_of_state)


def suits_grid(problem: Problem, may_take_long: bool) -> bool:
    """Whether value functions can be fitted on a grid, by default only if that is quick.
    Steps have finitely many outcomes."""
    if problem.num_components > _MOST_DIMENSIONS_OF_GRID:
        return False
    chosen = chosen_basis(problem, None)
    return isinstance(chosen.basis, Grid) and (may_take_long or chosen.is_quick)


def warn_of_long_fit(chosen: ChosenBasis, stacklevel: int) -> None:
    """Warns if a fit takes long next to independent paths."""
    if chosen.num_numbers > _MOST_WITHOUT_WARNING:
        warnings.warn(
            f"The fit of `ValueFunctions` takes as long as {chosen.num_states:,} "
            "independent paths. If fewer paths are accurate enough, pass "
            "`sampling=IndependentPaths(num_paths)`.",
            stacklevel=stacklevel + 1,
        )


def _basis(
    problem: Problem, degree: int | None, num_nodes: int, total_steps: int
) -> AbstractBasis:
    """A grid if it fits into memory and time, or polynomials of several degrees to try; for
    a given `degree`, polynomials of this degree. The noise has `num_nodes` in a step, and
    all levels together have `total_steps`."""
    d = problem.num_components
    if degree is None:
        grid = _finest_grid(problem, d, num_nodes, total_steps)
        if grid is not None:
            return grid
        degrees = _candidate_degrees(d, num_nodes, total_steps)
    else:
        degrees = (whole_number("degree", degree, 0),)
    # `Quadratic` averages derivatives in place of least squares, which would cost more with
    # so many polynomials.
    if _too_many_for_least_squares(d) and max(degrees) <= 2:
        return Quadratic(d, degrees)
    basis = Hermite(d, degrees)
    _check_memory(problem, basis)
    return basis


def _finest_grid(
    problem: Problem, d: int, num_nodes: int, total_steps: int
) -> Grid | None:
    """The finest grid that memory and time allow; `None` if there is none, or in many
    dimensions."""
    if d > _MOST_DIMENSIONS_OF_GRID:
        return None
    for size in _SIZES_OF_GRID:
        grid = Grid(d, (size,))
        # The loop over steps backward holds the coefficients twice.
        memory = 2 * problem.dtype.itemsize * grid.size * _num_functions(problem)
        num_ends = size**d * num_nodes
        fits_into_step = num_ends <= _MOST_ENDS_OF_STEP
        is_quick = num_ends * total_steps <= _MOST_ENDS
        if memory <= _MOST_MEMORY and fits_into_step and is_quick:
            return grid
    return None


def _candidate_degrees(d: int, num_nodes: int, total_steps: int) -> tuple[int, ...]:
    """The degrees to try: the highest that has few polynomials and does not take too long,
    and all even degrees below it."""
    if _too_many_for_least_squares(d):
        # Both that `Quadratic` has.
        return (1, 2)

    def is_allowed(degree: int) -> bool:
        if num_polynomials(d, degree) > _MOST_POLYNOMIALS:
            return False
        # The ends of all steps from all points of the fit.
        num_ends = Hermite(d, (degree,)).num_sites * num_nodes * total_steps
        return degree <= _ALWAYS_TRIED_UP_TO or num_ends <= _MOST_ENDS

    *lower, highest = filter(is_allowed, range(1, _HIGHEST_DEGREE + 1))
    lower_even = [degree for degree in lower if degree % 2 == 0]
    return (*lower_even, highest)


def _too_many_for_least_squares(d: int) -> bool:
    """Whether there are too many polynomials up to degree 2 for a fit by least squares."""
    return num_polynomials(d, 2) > _MOST_POLYNOMIALS


def _num_functions(problem: Problem) -> int:
    """The number of functions in a fit: for all levels, steps, times and components."""
    return len(problem.levels.h) * problem.most_steps * math.prod(problem.output_shape)


def _check_memory(problem: Problem, basis: Hermite) -> None:
    """Raises a `ValueError` if a fit needs too much memory."""
    # The fit holds the polynomials at all points of one step, and the coefficients of all
    # functions.
    num_rows = basis.num_pilots + len(basis.candidates) * _num_functions(problem)
    memory = problem.dtype.itemsize * basis.size * num_rows
    if memory > _MOST_MEMORY:
        raise ValueError(
            f"`degree={max(basis.candidates)}` has {basis.size:,} polynomials in "
            f"{basis.d} dimensions, and its fit needs {memory / 2**30:,.0f} GiB. Pass a "
            "smaller `degree`."
        )
