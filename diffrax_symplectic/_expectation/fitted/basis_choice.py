"""The choice of the basis in which the value functions of a problem are fitted: a grid, or
polynomials of some degree, as fine as memory and time allow."""

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


# By default a grid is used in up to this many dimensions. In three, 32 points along each
# axis would be 32,768 points, each with all outcomes of a step.
_MOST_DIMENSIONS_OF_GRID = 2
# The numbers of points along an axis, of which the first one is taken that memory and time
# allow.
_SIZES_OF_GRID = (64, 32)
# A fit takes a step from each of its points for each node of the noise, and computes the
# states at the ends of these steps. The most ends for one time, which are in memory
# together, and the most for all times together, which take time to compute.
_MOST_ENDS_OF_STEP = 50_000
_MOST_ENDS = 2**25
# The most polynomials in a fit by default: 120 of degree 2 in 14 dimensions.
_MOST_POLYNOMIALS = 130
# The highest degree by default. (In one dimension the most polynomials that are allowed
# would be of degree 129.)
_HIGHEST_DEGREE = 8
# The lowest degree by default, which is taken however long the fit takes.
_LOWEST_DEGREE = 2
# The most bytes that a fit may take, so that it fits into machines of 8 GiB.
_MOST_MEMORY = 4 * 2**30
# A fit that computes at most this many numbers takes less time than compiling its program.
# (Compiling took 5 s of processor time. Fits of two coordinates took 0.4 s for 2.5 million
# numbers, 9 s for 54 million and 11 s for 82 million.)
_MOST_OF_QUICK_FIT = 2**24


class ChosenBasis(NamedTuple):
    """A basis, and what a fit to it costs.

    - `num_states`: the number of states that are computed in each step.
    - `num_numbers`: how many numbers are computed in all steps: for each state its
        components, and the value of each function.
    """

    basis: AbstractBasis
    num_states: int
    num_numbers: int

    @property
    def has_quick_fit(self) -> bool:
        """Whether the fit takes less time than compiling its program."""
        return self.num_numbers <= _MOST_OF_QUICK_FIT


def chosen_basis(problem: Problem, degree: int | None) -> ChosenBasis:
    """Chooses the basis of a fit:

    - with a `degree`, the polynomials of this degree;
    - otherwise the finest grid that fits into memory and time;
    - otherwise the polynomials of the highest degree that fit into time;
    - for degrees up to 2 in many dimensions, polynomials by averages of derivatives.

    A fit costs as many steps as there are ends: for each point at which it is made, one for
    each node, an outcome of the random variables of a step.

    Raises a `ValueError` if the fit needs too much memory, or for random variables without
    finitely many outcomes.
    """
    nodes, _ = Noise.of(problem, problem.level(0)).weighted_nodes()
    num_nodes = len(nodes)
    total_steps = int(np.sum(problem.levels.num_steps))
    d = problem.num_components
    num_outputs = math.prod(problem.output_shape)
    # A fit has a function for each level, step, time at which to average, and component.
    num_functions = len(problem.levels.h) * room_for_steps(problem) * num_outputs

    def with_cost(basis: AbstractBasis) -> ChosenBasis:
        num_states = basis.num_sites * num_nodes
        return ChosenBasis(
            basis, num_states, num_states * total_steps * (d + num_outputs)
        )

    def fits_into_time(num_points: int) -> bool:
        """Whether a fit at so many points takes few enough steps."""
        return num_points * num_nodes * total_steps <= _MOST_ENDS

    # The finest grid that fits.
    if degree is None and d <= _MOST_DIMENSIONS_OF_GRID:
        for size in _SIZES_OF_GRID:
            grid = Grid(d, size)
            num_points = size**d
            has_few_ends = num_points * num_nodes <= _MOST_ENDS_OF_STEP
            # The loop over steps backward holds the coefficients twice.
            memory = 2 * problem.dtype.itemsize * grid.size * num_functions
            if has_few_ends and memory <= _MOST_MEMORY and fits_into_time(num_points):
                return with_cost(grid)

    if degree is not None:
        degree = whole_number("degree", degree, 0)
    else:
        # The highest degree that has few polynomials and does not take too long.
        degree = _LOWEST_DEGREE
        for higher in range(degree + 1, _HIGHEST_DEGREE + 1):
            has_few_polynomials = num_polynomials(d, higher) <= _MOST_POLYNOMIALS
            if has_few_polynomials and fits_into_time(Hermite(d, higher).num_sites):
                degree = higher

    # With so many polynomials least squares would cost more than averages of derivatives,
    # which `Quadratic` takes.
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
    """Whether value functions can be fitted on a grid, and unless `may_take_long` whether
    such a fit is quick. The steps of the problem must have finitely many outcomes."""
    if problem.num_components > _MOST_DIMENSIONS_OF_GRID:
        return False
    chosen = chosen_basis(problem, None)
    return isinstance(chosen.basis, Grid) and (may_take_long or chosen.has_quick_fit)
