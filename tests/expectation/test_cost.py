"""What a step costs, as a count of numbers, and how many paths that allows by default."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.choose import sampling_for
from diffrax_symplectic._expectation.cost import (
    _numbers,
    NUMBERS_PER_SECOND,
    numbers_per_step,
)
from diffrax_symplectic._simulation.problem import Problem


MATRIX = np.ones((3, 5))


def three_sums(x):
    return (x + x) * x - x


def matrix_product(x):
    return lax.dot_general(MATRIX, x, (([1], [0]), ([], [])))


def triangular_solve(x):
    return lax.linalg.triangular_solve(jnp.eye(5), x[:, None], left_side=True)


def seven_sums(x):
    return lax.scan(lambda x, _: (x + x, None), x, length=7)[0]


def either(x):
    return lax.cond(True, three_sums, lambda x: x + x, x)


def sine_in_a_loop(x):
    return lax.while_loop(lambda x: True, lax.sin, x)


def sine_in_a_loop_in_a_loop(x):
    return lax.while_loop(lambda x: True, sine_in_a_loop, x)


@pytest.mark.parametrize(
    "fn, count",
    [
        (three_sums, 3 * 5),
        (jax.jit(three_sums), 3 * 5),
        (matrix_product, 3 * 5),
        (seven_sums, 7 * 5),
        (either, (3 + 1) * 5),
        (lax.sin, 5),
        (sine_in_a_loop, 4 * 8 * 5),
        (sine_in_a_loop_in_a_loop, 4 * 8 * 5),
    ],
)
def test_the_numbers_that_a_program_computes_are_counted(fn, count):
    program = jax.make_jaxpr(fn)(jnp.ones(5)).jaxpr
    assert _numbers(program, in_loop=False) == count


def test_a_call_of_lapack_counts_as_thousands_of_numbers():
    program = jax.make_jaxpr(triangular_solve)(jnp.ones(5)).jaxpr
    # What surrounds it makes the identity and some copies.
    assert 3_000 <= _numbers(program, in_loop=False) <= 3_300


def problem_of(solver, n=3, steps=100, levels=1):
    H0 = lambda t, p, q, args: p @ p / 2 - jnp.sum(jnp.cos(q))
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: jnp.sum(q), ())
    y0 = (jnp.zeros(n), jnp.ones(n))
    phi = lambda t, y, args: y[1][0]
    return Problem.of(phi, terms, solver, 0, 1, 1 / steps, y0, None, None, levels)


def test_implicit_steps_large_systems_and_more_stages_cost_more():
    leapfrog = numbers_per_step(problem_of(ds.StormerVerlet()))
    midpoint = numbers_per_step(problem_of(ds.ImplicitMidpoint()))
    gauss = numbers_per_step(problem_of(ds.StrangGauss()))
    large = numbers_per_step(problem_of(ds.ImplicitMidpoint(), n=64))
    assert 2 * leapfrog < midpoint
    assert 1.5 * midpoint < gauss
    assert 5 * midpoint < large


@pytest.mark.parametrize("solver", [ds.StormerVerlet(), ds.ImplicitMidpoint()])
@pytest.mark.parametrize("steps, levels", [(20_000, 1), (5_000, 3)])
def test_the_default_takes_as_many_paths_as_ten_seconds_allow(solver, steps, levels):
    problem = problem_of(solver, steps=steps, levels=levels)
    sampling, _ = sampling_for(problem, None)
    assert isinstance(sampling, ds.IndependentPaths)
    of_levels = steps * (2**levels - 1)
    numbers = sampling.num_paths * of_levels * numbers_per_step(problem)
    assert numbers == pytest.approx(10 * NUMBERS_PER_SECOND, rel=0.01)


def test_the_cost_of_sorted_paths_includes_sorting():
    problem = problem_of(ds.StormerVerlet(), n=1, steps=20_000)
    sampling, _ = sampling_for(problem, None)
    assert isinstance(sampling, ds.ArrayRQMC)
    numbers = sampling.num_paths * sampling.replicates * 20_000
    numbers *= numbers_per_step(problem) + 1500
    # Rounded down to a power of two.
    assert 5 * NUMBERS_PER_SECOND < numbers <= 10 * NUMBERS_PER_SECOND


def test_solvers_of_diffrax_are_counted():
    assert numbers_per_step(problem_of(diffrax.Heun())) > 0
