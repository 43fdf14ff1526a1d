"""What a step costs, by the operations that it is made of."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._compat import dce_jaxpr, Jaxpr, programs_in
from .._custom_types import Y
from .._lapack import LAPACK
from .._programs import once_for_each_signature
from .._simulation import Problem
from .._solver import without_newton


# All costs here are in units of a sum of two real numbers. This is how many of them two
# cores compute in a second in large batches of paths. This constant, the passes through a
# loop, and the costs of complex numbers and of a sine are a fit to the processor time of 26
# systems and solvers, from the pendulum to a Schroedinger lattice and Brownian paths of a
# user's own: seconds predicted are 0.4 to 2.5 times those measured. They are too few where
# sweeps converge slowly: two damped spins take 5 times as long as predicted at h = 0.2, and
# 10 times at h = 0.5.
OPERATIONS_PER_SECOND = 6e10
# How often a loop of unknown length runs, if no other such loop is inside of it: sweeps
# over the equations of a step until the last path of a batch has converged, or the levels
# of a `diffrax.VirtualBrownianTree`.
_PASSES = 12
# An operation on complex numbers takes this many times as long as on real ones.
_COMPLEX_PER_REAL = 7
# Operations on matrices are calls of LAPACK, which take some 100 ns each.
_COST_OF_LAPACK = 6_000
# The cost for each number in the result of an operation; those not listed cost 1. Except
# for sines and their like, which the compiler partly merges, they were timed by themselves.
# Operations that only move numbers are free.
_NAMES_BY_COST = {
    0: "bitcast_convert_type broadcast_in_dim complex convert_element_type copy imag "
    "random_unwrap random_wrap real reshape squeeze transpose",
    4: "cbrt div integer_pow rem rsqrt sqrt",
    20: "exp exp2 tanh",
    75: "acos acosh asin asinh atan atan2 atanh cos cosh cumlogsumexp cummax cummin "
    "cumprod cumsum erf erf_inv erfc expm1 lgamma log log1p logistic pow sin sinh tan",
    # A call of the generator, which hashes in a loop; and a number that is looked up by its
    # index, as in `q[i]` with an array `i`.
    150: "gather random_bits random_fold_in random_seed random_split threefry2x32",
    900: "sort",
}
_COST_BY_NAME = {
    name: cost for cost, names in _NAMES_BY_COST.items() for name in names.split()
}
# Reductions read their arguments from memory: the cost for each number that they read.
_COST_OF_REDUCTION = 10
# The cost for each number that is added by its index, as in the derivative of `q[i]`.
_COST_OF_SCATTER = 80
# What a product of matrices or vectors costs besides its sums and products, for real and
# for complex numbers.
_COST_OF_PRODUCT = 300
_COST_OF_COMPLEX_PRODUCT = 4_000


@once_for_each_signature
def operations_per_step(problem: Problem) -> int:
    """How many operations on single numbers a step of one path takes, as a measure of its
    cost. An operation that takes longer than a sum counts as several."""
    # Newton's method is in the program of a step, but rarely runs: only where sweeps fail.
    lean = dataclasses.replace(problem, solver=without_newton(problem.solver))
    traced, _, _ = eqx.filter_make_jaxpr(_first_step)(lean, problem.y0)
    return max(1, _count_operations(traced.jaxpr))


def _first_step(problem: Problem, y: Y) -> tuple[Y, Bool[Array, ""]]:
    """The state after step 0 from `y`, and whether the step succeeded."""
    i = jnp.zeros((), jnp.int32)
    h = problem.level(i).h
    state = problem.init(problem.terms, i, h, y)
    y, _, success = problem.step(problem.terms, i, h, y, state)
    return y, success


def _count_operations(jaxpr: Jaxpr) -> int:
    """The number of operations on single numbers in a program, with the programs inside
    it."""
    # The compiler leaves out what no result needs. For example, the program of a sweep over
    # the momenta contains the velocity, which only a sweep over the positions would use.
    jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return sum(map(_operations_of, jaxpr.eqns))


def _operations_of(eqn: Any) -> int:
    """The number of operations on single numbers that an operation on arrays consists of:
    for a loop, a call or a conditional those of the programs inside it, and otherwise the
    cost for each number by the tables above, times how many numbers there are."""
    name = eqn.primitive.name
    inner_programs = programs_in(eqn)
    if inner_programs:
        passes = 1
        if name == "scan":
            passes = eqn.params["length"]
        # A loop of unknown length. Around another such loop it counts as one pass, since it
        # runs again only if the inner loop has not finished, which is rare.
        elif name == "while" and not any(map(_has_loop, inner_programs)):
            passes = _PASSES
        # In a batch all branches of a conditional are evaluated.
        return passes * sum(map(_count_operations, inner_programs))
    if name in LAPACK:
        return _COST_OF_LAPACK
    if name.startswith("reduce_"):
        return _COST_OF_REDUCTION * sum(map(_size, eqn.invars))
    if name.startswith("scatter"):
        return _COST_OF_SCATTER * _size(eqn.invars[-1])
    size = sum(map(_size, eqn.outvars))
    is_complex = any(
        jnp.issubdtype(x.aval.dtype, jnp.complexfloating) for x in eqn.outvars
    )
    cost_of_number = _COMPLEX_PER_REAL if is_complex else 1
    if name == "dot_general":
        # Each entry of the result is a sum of products over the contracted axes.
        (contracted_axes, _), _ = eqn.params["dimension_numbers"]
        shape = eqn.invars[0].aval.shape
        num_products = size * math.prod(shape[axis] for axis in contracted_axes)
        cost = _COST_OF_COMPLEX_PRODUCT if is_complex else _COST_OF_PRODUCT
        return cost + cost_of_number * num_products
    return _COST_BY_NAME.get(name, 1) * size * cost_of_number


def _has_loop(jaxpr: Jaxpr) -> bool:
    """Whether a program contains a loop of unknown length."""
    return any(
        eqn.primitive.name == "while" or any(map(_has_loop, programs_in(eqn)))
        for eqn in jaxpr.eqns
    )


def _size(variable: Any) -> int:
    """The number of entries of an array."""
    return math.prod(variable.aval.shape)
