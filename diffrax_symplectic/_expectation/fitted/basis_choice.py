"""The basis in which the value functions of a problem are fitted."""

import math
import warnings
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np

from ..._arguments import whole_number
from ..._simulation import Problem
from .bases import AbstractBasis, Hermite, Quadratic
from .grid import Grid
from .noise import Noise
from .polynomials import num_polynomials


# By default a grid is used in up to this many dimensions: in three, 32 points along each
# axis are 32,768 together, each with all outcomes of a step.
MOST_DIMENSIONS_OF_GRID = 2
# The points along an axis, of which the most are taken that memory and time allow.
_SIZES_OF_GRID = (64, 32)
# The most evaluations (points times outcomes) for one step of a path, whose states are in
# memory together, and for all steps, which take time.
_MOST_ENDS_OF_STEP = 50_000
_MOST_ENDS = 2**25
# The most polynomials in a fit by default: 120 of degree 2 in 14 dimensions.
_MOST_POLYNOMIALS = 130
# The highest degree by default. (In one dimension there are few polynomials: the most that
# are allowed would be of degree 129.)
_HIGHEST_DEGREE = 8
# Degrees that take too long are dropped, but not these.
_ALWAYS_CHEAP = 2
# Bytes that a fit may take, so that it fits into machines of 8 GiB.
_MOST_MEMORY = 4 * 2**30
# Entries of states that a fit may compute before a warning that it will take long (about
# a minute).
_OUT_OF_PROPORTION = 2**31


class ChosenBasis(NamedTuple):
    """A basis, and what a fit to it costs.

    - `states`: the number of states that are computed in each step.
    - `entries`: the entries of all states of all steps.
    """

    basis: AbstractBasis
    states: int
    entries: int


def chosen_basis(p: Problem, degree: int | None) -> ChosenBasis:
    """The basis for polynomials of this degree, or the best one. Raises a `ValueError` if
    the fit needs too much memory, or for random variables without finitely many outcomes.
    """
    _, weights = Noise.of(p, p.level(0)).nodes()
    num_outcomes = len(weights)
    steps = int(np.sum(p.levels.num_steps))
    basis = _basis(p, degree, num_outcomes, steps)
    states = basis.sites * num_outcomes
    return ChosenBasis(basis, states, states * steps * basis.d)


def warn_of_long_fit(chosen: ChosenBasis, stacklevel: int) -> None:
    """Warns if a fit takes long next to independent paths."""
    if chosen.entries > _OUT_OF_PROPORTION:
        warnings.warn(
            f"The fit of `ValueFunctions` takes as long as {chosen.states:,} independent "
            "paths. If fewer paths are accurate enough, pass "
            "`sampling=IndependentPaths(num_paths)`.",
            stacklevel=stacklevel + 1,
        )


def _basis(
    p: Problem, degree: int | None, num_outcomes: int, steps: int
) -> AbstractBasis:
    """The basis for a step with so many outcomes, and so many steps on all levels."""
    d = sum(leaf.size for leaf in jtu.tree_leaves(p.y0))
    if degree is None:
        grid = _grid(p, d, num_outcomes, steps)
        if grid is not None:
            return grid
        degrees = _degrees(d, num_outcomes, steps)
    else:
        degrees = (whole_number("degree", degree, 0),)
    # Averaged derivatives cost less than a fit to many polynomials.
    if _has_many_of_degree_two(d) and max(degrees) <= 2:
        return Quadratic(d, degrees)
    basis = Hermite(d, degrees)
    _check_memory(p, basis)
    return basis


def _grid(p: Problem, d: int, num_outcomes: int, steps: int) -> Grid | None:
    """The finest grid that memory and time allow, in few dimensions."""
    if d > MOST_DIMENSIONS_OF_GRID:
        return None
    for size in _SIZES_OF_GRID:
        grid = Grid(d, (size,))
        # The loop over steps backward holds the coefficients twice.
        memory = 2 * p.dtype.itemsize * grid.size * _num_functions(p)
        ends = size**d * num_outcomes
        is_quick = ends <= _MOST_ENDS_OF_STEP and ends * steps <= _MOST_ENDS
        if memory <= _MOST_MEMORY and is_quick:
            return grid
    return None


def _degrees(d: int, num_outcomes: int, steps: int) -> tuple[int, ...]:
    """The degrees to choose from: the highest that has few polynomials and takes not too
    long, and lower even ones."""
    if _has_many_of_degree_two(d):
        return (1, 2)

    def is_allowed(degree: int) -> bool:
        if num_polynomials(d, degree) > _MOST_POLYNOMIALS:
            return False
        ends = Hermite(d, (degree,)).sites * num_outcomes * steps
        return degree <= _ALWAYS_CHEAP or ends <= _MOST_ENDS

    *lower, highest = filter(is_allowed, range(1, _HIGHEST_DEGREE + 1))
    return (*(degree for degree in lower if degree % 2 == 0), highest)


def _has_many_of_degree_two(d: int) -> bool:
    return num_polynomials(d, 2) > _MOST_POLYNOMIALS


def _num_functions(p: Problem) -> int:
    """The number of functions in a fit: for all levels, steps, times and components."""
    return len(p.levels.h) * p.finest_steps * math.prod(p.num_outputs)


def _check_memory(p: Problem, basis: Hermite) -> None:
    """Raises a `ValueError` if a fit needs too much memory."""
    # The polynomials at all points of one step, and the coefficients of all functions.
    rows = basis.pilots + len(basis.candidates) * _num_functions(p)
    need = p.dtype.itemsize * basis.size * rows
    if need > _MOST_MEMORY:
        raise ValueError(
            f"`degree={max(basis.candidates)}` has {basis.size:,} polynomials in "
            f"{basis.d} dimensions, and its fit needs {need / 2**30:,.0f} GiB. Pass a "
            "smaller `degree`."
        )
