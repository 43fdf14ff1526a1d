"""What a step costs, as a count of operations, and how many paths that allows."""

from pathlib import Path

import jax
import jax.numpy as jnp
import jax.random as jr
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
from diffrax_symplectic._expectation.fitted import basis_choice, suits_grid
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
        (matrix_product, 300 + 3 * 5),
        (lambda x: x[jnp.array([0, 2])], 150 * 2 + 6),
        (seven_sums, 7 * 5),
        (either, (3 + 1) * 5),
        (lax.sin, 75 * 5),
        (lambda x: 1 / (x + x), (1 + 4) * 5),
        (lambda x: lax.reduce_sum(x, [0]), 10 * 5),
        (lambda x: lax.complex(x, x) * 2, 7 * 5),
        (lambda x: jr.bits(jr.key(0), (3,)), 150 * 3 + 150),
        (sine_in_a_loop, 12 * 75 * 5),
        (sine_in_a_loop_in_a_loop, 12 * 75 * 5),
        (lambda x: (lax.sin(x), x + x)[1], 5),
        (lambda x: jax.jit(lambda x: (lax.sin(x), x + x))(x)[1], 5),
    ],
)
def test_the_operations_of_a_program_are_counted(fn, count):
    program = jax.make_jaxpr(fn)(jnp.ones(5)).jaxpr
    assert _count_operations(program) == count


def test_a_call_of_lapack_counts_as_thousands_of_operations():
    program = jax.make_jaxpr(triangular_solve)(jnp.ones(5)).jaxpr
    # What surrounds it makes the identity and some copies.
    assert 6_000 <= _count_operations(program) <= 6_300


def problem_of(solver, n=3, steps=100, levels=1):
    H0 = lambda t, p, q, args: p @ p / 2 - jnp.sum(jnp.cos(q))
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: jnp.sum(q), ())
    y0 = (jnp.zeros(n), jnp.ones(n))
    phi = lambda t, y, args: y[1][0]
    return Problem.of(phi, terms, solver, 0, 1, 1 / steps, y0, None, None, levels)


def chain():
    def H0(t, p, q, args):
        springs = (jnp.roll(q, 1) - q) ** 2
        return jnp.sum(p**2 + q**2 + springs) / 2 + jnp.sum(q**4) / 4

    noise = lambda t, p, q, args: 0.2 * jnp.sum(q)
    terms = ds.hamiltonian_terms(H0, noise, ())
    return terms, ds.StormerVerlet(), (jnp.zeros(64), jnp.ones(64))


def schroedinger_lattice():
    square = lambda z: jnp.real(z * jnp.conj(z))

    def H0(t, psi, args):
        hops = jnp.sum(square(jnp.roll(psi, -1) - psi))
        return hops / 2 - jnp.sum(square(psi) ** 2) / 2

    terms = ds.wave_terms(H0, lambda t, psi, args: 0.3 * square(psi), (16,))
    return terms, ds.ImplicitMidpoint(), ds.to_pair(jnp.ones(16, complex))


@pytest.mark.parametrize(
    "system, nanoseconds", [(schroedinger_lattice, 5032), (chain, 205)]
)
def test_costs_are_within_a_factor_of_two_and_a_half(system, nanoseconds):
    """`nanoseconds` of processor time for a step of one path were measured once, in large
    batches, with steps of 0.05."""
    terms, solver, y0 = system()
    phi = lambda t, y, args: jnp.sum(y[0])
    problem = Problem.of(phi, terms, solver, 0, 1, 0.1, y0, None, None, 1)
    # Two cores.
    predicted = 2e9 * operations_per_step(problem) / OPERATIONS_PER_SECOND
    assert 1 / 2.5 < predicted / nanoseconds < 2.5


@pytest.mark.parametrize(
    "solver, steps, levels",
    [(ds.StormerVerlet(), 20_000, 1), (ds.ImplicitMidpoint(), 2_000, 3)],
)
def test_the_default_takes_as_many_paths_as_there_is_time_for(solver, steps, levels):
    problem = problem_of(solver, steps=steps, levels=levels)
    sampling, _ = sampling_for(problem, None)
    assert isinstance(sampling, ds.IndependentPaths)
    of_levels = steps * (2**levels - 1)
    operations = sampling.num_paths * of_levels * operations_per_step(problem)
    assert operations == pytest.approx(1.5 * OPERATIONS_PER_SECOND, rel=0.01)


def test_the_cost_of_sorted_paths_includes_sorting():
    problem = problem_of(ds.StormerVerlet(), n=1, steps=5_000)
    sampling, _ = sampling_for(problem, None)
    assert isinstance(sampling, ds.ArrayRQMC)
    operations = sampling.num_paths * sampling.replicates * 5_000
    operations *= operations_per_step(problem) + 1500
    assert 16 <= sampling.replicates < 32
    # Less than a replicate is left.
    assert 1.4 * OPERATIONS_PER_SECOND < operations <= 1.5 * OPERATIONS_PER_SECOND


def test_the_page_of_expectation_states_the_rule_of_the_default():
    sorted_paths = ds.ArrayRQMC()
    rule = (
        "| one or two components; `y0` and `args` not drawn | a fit takes a few seconds, "
        f"or `tol` is given; in trials, it leaves at most {choose._MOST_REMAINDER:.0%} of "
        "the standard error | `ValueFunctions` | "
        f"{ds.ValueFunctions().num_paths:,} paths |",
        "| at most four components |",
        f"| `ArrayRQMC` | {sorted_paths.replicates} × {sorted_paths.num_paths:,} paths |",
        f"| `IndependentPaths` | {choose._MOST_INDEPENDENT_PATHS:,} paths |",
        "a few seconds up to 410 steps on all levels; each further mean costs a third more",
        f"more than about {choose._SECONDS_OF_PATHS} seconds",
    )
    page = Path(__file__).parents[2] / "docs" / "expectation.md"
    words = " ".join(page.read_text().split())
    for part in rule:
        assert part in words, part
    # Those that are spelled out there.
    assert basis_choice._MOST_DIMENSIONS_OF_GRID == 2
    assert choose._MOST_COMPONENTS_SORTED == 4
    by_fits = [
        suits_grid(problem_of(ds.StormerVerlet(), n=1, steps=n), may_take_long=is_long)
        for n, is_long in ((410, False), (411, False), (411, True))
    ]
    assert by_fits == [True, False, True]
