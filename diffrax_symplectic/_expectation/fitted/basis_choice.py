"""The basis in which the value functions of a problem are fitted."""

import math
from typing import NamedTuple

import numpy as np

from ..._arguments import whole_number
from ..._simulation import Problem
from .bases import AbstractBasis, Hermite, Quadratic
from .fits import room_for_steps
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
# This degree is allowed however long it takes.
_ALWAYS_ALLOWED_DEGREE = 2
# The most bytes that a fit may take, so that it fits into machines of 8 GiB.
_MOST_MEMORY = 4 * 2**30
# A fit that computes at most this many numbers takes less time than compiling its program.
# (Fits of two coordinates took 0.4 s of processor time for 2.5 million numbers, and 9 and
# 11 s for 54 and 82 million, where compiling took 5 s.)
_MOST_OF_QUICK_FIT = 2**24


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
    """The basis for polynomials of this degree; or for `None` a grid if it fits into memory
    and time, and otherwise polynomials of the highest degree that does. Raises a
    `ValueError` if the fit needs too much memory, or for random variables without finitely
    many outcomes."""
    nodes, _ = Noise.of(problem, problem.level(0)).weighted_nodes()
    num_nodes = len(nodes)
    total_steps = int(np.sum(problem.levels.num_steps))
    d = problem.num_components
    num_outputs = math.prod(problem.output_shape)
    # In a fit: for all levels, steps, times and components.
    num_functions = len(problem.levels.h) * room_for_steps(problem) * num_outputs

    def with_cost(basis: AbstractBasis) -> ChosenBasis:
        num_states = basis.num_sites * num_nodes
        return ChosenBasis(
            basis, num_states, num_states * total_steps * (d + num_outputs)
        )

    if degree is None and d <= _MOST_DIMENSIONS_OF_GRID:
        for size in _SIZES_OF_GRID:
            grid = Grid(d, size)
            # The loop over steps backward holds the coefficients twice.
            memory = 2 * problem.dtype.itemsize * grid.size * num_functions
            num_ends = size**d * num_nodes
            fits_into_step = num_ends <= _MOST_ENDS_OF_STEP
            is_quick = num_ends * total_steps <= _MOST_ENDS
            if memory <= _MOST_MEMORY and fits_into_step and is_quick:
                return with_cost(grid)

    if degree is not None:
        degree = whole_number("degree", degree, 0)
    else:
        # The highest that has few polynomials and does not take too long.
        degree = _ALWAYS_ALLOWED_DEGREE
        for higher in range(degree + 1, _HIGHEST_DEGREE + 1):
            num_ends = Hermite(d, higher).num_sites * num_nodes
            is_quick = num_ends * total_steps <= _MOST_ENDS
            if is_quick and num_polynomials(d, higher) <= _MOST_POLYNOMIALS:
                degree = higher
    # `Quadratic` averages derivatives in place of least squares, which would cost more with
    # so many polynomials.
    if degree <= 2 and num_polynomials(d, 2) > _MOST_POLYNOMIALS:
        return with_cost(Quadratic(d, degree))

    basis = Hermite(d, degree)
    # The fit holds the polynomials at all points of one step, and the coefficients of all
    # functions.
    num_numbers = basis.size * (basis.num_pilots + num_functions)
    memory = problem.dtype.itemsize * num_numbers
    if memory > _MOST_MEMORY:
        raise ValueError(
            f"`degree={degree}` has {basis.size:,} polynomials in {d} dimensions, "
            f"and its fit needs {memory / 2**30:,.0f} GiB. Pass a smaller `degree`."
        )
    return with_cost(basis)


def suits_grid(problem: Problem, may_take_long: bool) -> bool:
    """Whether value functions can be fitted on a grid, by default only if that is quick.
    Steps have finitely many outcomes."""
    if problem.num_components > _MOST_DIMENSIONS_OF_GRID:
        return False
    chosen = chosen_basis(problem, None)
    return isinstance(chosen.basis, Grid) and (may_take_long or chosen.is_quick)
