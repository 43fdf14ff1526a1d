"""What a step costs, by the operations that it is made of."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._compat import Jaxpr, programs_in
from .._custom_types import Y
from .._lapack import LAPACK
from .._signature import once_for_each_signature
from .._simulation import Problem
from .._solver import without_newton


# The operations of two cores in a second in large batches of paths. The constants
# here are a fit to 24 systems and solvers, from the pendulum to a chain of 64 oscillators:
# seconds predicted are 0.5 to 2.3 times those measured for 22 of them (0.3 for a spin with
# slow sweeps, 3.5 for two noises whose linear flows need one sweep).
OPERATIONS_PER_SECOND = 3e10
# The passes through a loop. All loops of a step are sweeps over its equations.
_SWEEPS = 4
# A sine in a loop takes as long as so many sums.
_OF_TRANSCENDENTAL = 8
_TRANSCENDENTAL = frozenset(
    "acos acosh asin asinh atan atan2 atanh cos cosh erf erf_inv erfc exp exp2 expm1 "
    "lgamma log log1p logistic pow sin sinh tan tanh".split()
)
# Operations on matrices are calls of LAPACK, which take some 100 ns each: as long as so
# many sums.
_OF_LAPACK = 3_000


@once_for_each_signature
def operations_per_step(problem: Problem) -> int:
    """How many operations on single numbers a step of one path takes, as a measure of its
    cost. An operation that takes longer than a sum counts as several."""
    # Newton's method, which rescues paths whose sweeps fail, is rarely used.
    lean = dataclasses.replace(problem, solver=without_newton(problem.solver))
    traced, _, _ = eqx.filter_make_jaxpr(_first_step)(lean, problem.y0)
    return max(1, _count_operations(traced.jaxpr, in_loop=False))


def _first_step(problem: Problem, y: Y) -> tuple[Y, Float[Array, ""]]:
    """The state after step 0 from `y`, and whether the step succeeded."""
    i = jnp.zeros((), jnp.int32)
    h = problem.level(i).h
    state = problem.init(problem.terms, i, h, y)
    y, _, success = problem.step(problem.terms, i, h, y, state)
    return y, success


def _count_operations(jaxpr: Jaxpr, in_loop: bool) -> int:
    """The number of operations in a program, with the programs inside it. `in_loop` is
    whether it is a part of a `while` loop."""
    count = 0
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        size = sum(map(_size, eqn.outvars))
        inner_programs = programs_in(eqn)
        if name == "while" and not in_loop:
            sweep = sum(_count_operations(x, in_loop=True) for x in inner_programs)
            count += _SWEEPS * sweep
        elif inner_programs:
            # A loop inside a sweep counts once. In a batch all branches of a conditional
            # are evaluated.
            passes = eqn.params["length"] if name == "scan" else 1
            count += passes * sum(_count_operations(x, in_loop) for x in inner_programs)
        elif name in LAPACK:
            count += _OF_LAPACK
        elif name in _TRANSCENDENTAL and in_loop:
            count += _OF_TRANSCENDENTAL * size
        elif name == "dot_general":
            (contracted_axes, _), _ = eqn.params["dimension_numbers"]
            factor, _ = eqn.invars
            shape = factor.aval.shape  # pyright: ignore (of arrays)
            count += size * math.prod(shape[axis] for axis in contracted_axes)
        else:
            count += size
    return count


def _size(variable: Any) -> int:
    return math.prod(variable.aval.shape)
