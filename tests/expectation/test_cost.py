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

from .steps import problem_of


def three_sums(x):
    return (x + x) * x - x


def sine_in_a_loop(x):
    return lax.while_loop(lambda x: True, lax.sin, x)


def triangular_solve(x):
    return lax.linalg.triangular_solve(jnp.eye(5), x[:, None], left_side=True)


@pytest.mark.parametrize(
    "fn, least, more",
    [
        (three_sums, 3 * 5, 0),
        (jax.jit(three_sums), 3 * 5, 0),
        (lambda x: np.ones((3, 5)) @ x, 300 + 3 * 5, 0),
        (lambda x: x[jnp.array([0, 2])], 150 * 2 + 6, 0),
        (lambda x: lax.scan(lambda x, _: (x + x, None), x, length=7)[0], 7 * 5, 0),
        (lambda x: lax.cond(True, three_sums, lambda x: x + x, x), (3 + 1) * 5, 0),
        (lax.sin, 75 * 5, 0),
        (lambda x: 1 / (x + x), (1 + 4) * 5, 0),
        (lambda x: lax.reduce_sum(x, [0]), 10 * 5, 0),
        (lambda x: lax.complex(x, x) * 2, 7 * 5, 0),
        (lambda x: jr.bits(jr.key(0), (3,)), 150 * 3 + 150, 0),
        (lambda x: lax.while_loop(lambda x: True, sine_in_a_loop, x), 12 * 75 * 5, 0),
        (lambda x: jax.jit(lambda x: (lax.sin(x), x + x))(x)[1], 5, 0),
        # What surrounds a call of LAPACK makes the identity and some copies.
        (triangular_solve, 6_000, 300),
    ],
)
def test_the_operations_of_a_program_are_counted(fn, least, more):
    program = jax.make_jaxpr(fn)(jnp.ones(5)).jaxpr
    assert least <= _count_operations(program) <= least + more


def pendula(solver, n=3, steps=100, levels=1):
    H0 = lambda t, p, q, args: p @ p / 2 - jnp.sum(jnp.cos(q))
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: jnp.sum(q), ())
    y0 = (jnp.zeros(n), jnp.ones(n))
    return problem_of(terms, solver, 1 / steps, y0, num_steps=steps, levels=levels)


def test_costs_are_within_a_factor_of_two_and_a_half():
    """The processor time for a step of one path was measured once, in large batches, with
    steps of 0.05."""
    square = lambda z: jnp.real(z * jnp.conj(z))

    def lattice(t, psi, args):
        hops = jnp.sum(square(jnp.roll(psi, -1) - psi))
        return hops / 2 - jnp.sum(square(psi) ** 2) / 2

    terms = ds.wave_terms(lattice, lambda t, psi, args: 0.3 * square(psi), (16,))
    y0 = ds.to_pair(jnp.ones(16, complex))
    problem = problem_of(terms, ds.ImplicitMidpoint(), 0.1, y0, levels=1)
    # Two cores.
    nanoseconds = 2e9 * operations_per_step(problem) / OPERATIONS_PER_SECOND
    assert 1 / 2.5 < nanoseconds / 5032 < 2.5


@pytest.mark.parametrize(
    "solver, steps, levels",
    [(ds.StormerVerlet(), 20_000, 1), (ds.ImplicitMidpoint(), 2_000, 3)],
)
def test_the_default_takes_as_many_paths_as_there_is_time_for(solver, steps, levels):
    problem = pendula(solver, steps=steps, levels=levels)
    sampling, _ = sampling_for(problem, None)
    assert isinstance(sampling, ds.IndependentPaths)
    of_levels = steps * (2**levels - 1)
    operations = sampling.num_paths * of_levels * operations_per_step(problem)
    assert operations == pytest.approx(1.5 * OPERATIONS_PER_SECOND, rel=0.01)


def test_the_cost_of_sorted_paths_includes_sorting():
    problem = pendula(ds.StormerVerlet(), n=1, steps=5_000)
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
        suits_grid(pendula(ds.StormerVerlet(), n=1, steps=n), may_take_long=is_long)
        for n, is_long in ((410, False), (411, False), (411, True))
    ]
    assert by_fits == [True, False, True]
