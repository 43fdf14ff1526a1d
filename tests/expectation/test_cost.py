"""What a step costs, as a count of operations, and how many paths that allows."""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import diffrax_symplectic as ds
from diffrax_symplectic._expectation import choose
from diffrax_symplectic._expectation.choose import sampling_for
from diffrax_symplectic._expectation.cost import (
    _count_operations,
    OPERATIONS_PER_SECOND,
    operations_per_step,
)
from diffrax_symplectic._expectation.fitted import MOST_DIMENSIONS_OF_GRID
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
def test_the_operations_of_a_program_are_counted(fn, count):
    program = jax.make_jaxpr(fn)(jnp.ones(5)).jaxpr
    assert _count_operations(program, in_loop=False) == count


def test_a_call_of_lapack_counts_as_thousands_of_operations():
    program = jax.make_jaxpr(triangular_solve)(jnp.ones(5)).jaxpr
    # What surrounds it makes the identity and some copies.
    assert 3_000 <= _count_operations(program, in_loop=False) <= 3_300


def problem_of(solver, n=3, steps=100, levels=1):
    H0 = lambda t, p, q, args: p @ p / 2 - jnp.sum(jnp.cos(q))
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: jnp.sum(q), ())
    y0 = (jnp.zeros(n), jnp.ones(n))
    phi = lambda t, y, args: y[1][0]
    return Problem.of(phi, terms, solver, 0, 1, 1 / steps, y0, None, None, levels)


def test_implicit_steps_large_systems_and_more_stages_cost_more():
    leapfrog = operations_per_step(problem_of(ds.StormerVerlet()))
    midpoint = operations_per_step(problem_of(ds.ImplicitMidpoint()))
    gauss = operations_per_step(problem_of(ds.StrangGauss()))
    large = operations_per_step(problem_of(ds.ImplicitMidpoint(), n=64))
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
    operations = sampling.num_paths * of_levels * operations_per_step(problem)
    assert operations == pytest.approx(10 * OPERATIONS_PER_SECOND, rel=0.01)


def test_the_cost_of_sorted_paths_includes_sorting():
    problem = problem_of(ds.StormerVerlet(), n=1, steps=20_000)
    sampling, _ = sampling_for(problem, None)
    assert isinstance(sampling, ds.ArrayRQMC)
    operations = sampling.num_paths * sampling.replicates * 20_000
    operations *= operations_per_step(problem) + 1500
    # Rounded down to a power of two.
    assert 5 * OPERATIONS_PER_SECOND < operations <= 10 * OPERATIONS_PER_SECOND


def test_solvers_of_diffrax_are_counted():
    assert operations_per_step(problem_of(diffrax.Heun())) > 0


def test_the_page_of_expectation_states_the_rule_of_the_default():
    sorted_paths = ds.ArrayRQMC()
    rule = (
        "| one or two components; `y0` and `args` not drawn | at most "
        f"{choose._MOST_OUTCOMES_OF_STEP} outcomes each and "
        f"{choose._MOST_OUTCOMES_OF_STEPS:,} for all; in trials, the fit leaves at most "
        f"{choose._MOST_REMAINDER:.0%} of the standard error | `ValueFunctions` | "
        f"{ds.ValueFunctions().num_paths:,} paths |",
        "| at most four components |",
        f"| `ArrayRQMC` | {sorted_paths.replicates} × {sorted_paths.num_paths:,} paths |",
        f"| `IndependentPaths` | {choose._PATHS:,} paths |",
        "more than about ten seconds",
    )
    page = Path(__file__).parents[2] / "docs" / "expectation.md"
    words = " ".join(page.read_text().split())
    for part in rule:
        assert part in words, part
    # Those that are spelled out there.
    assert MOST_DIMENSIONS_OF_GRID == 2
    assert choose._MOST_COMPONENTS_SORTED == 4
    assert choose._SECONDS == 10
