"""Random systems with every kind of control flow, by both engines. As a program,

    python -m tests.fused.fuzz NUMBER ...

it prints one line of JSON for each of these cases: its number and how far the engines are
apart, in units in the last place of the largest number."""

import functools
import json
import sys
import warnings
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds
from diffrax_symplectic._solver import LANGEVIN

from ..picard import by_picard
from .parts import drawn, PARTS


NUMBERS = jnp.array([0.4, -0.3, 0.7, 0.2, -0.5, 0.6])


def numbers(*shape):
    return NUMBERS[: int(np.prod(shape))].reshape(shape)


STATES = [
    numbers(),
    numbers(1),
    numbers(2),
    numbers(1, 1),
    numbers(3, 2),
    {"a": numbers(), "b": numbers(1), "c": numbers(2)},
    (numbers(2), numbers(1, 1)),
]
# Solvers whose steps are different programs, of few evaluations: programs of many take
# minutes to compile.
SEPARABLE = ds.BAOAB(), ds.StormerVerlet(), ds.BAOAB(ds.ImplicitMidpoint())
SOLVERS = *SEPARABLE, ds.ImplicitMidpoint(), diffrax.Heun()
PATHS = 64
PRECISIONS = jnp.float64, jnp.float32


class Case(NamedTuple):
    """A system and how it is solved.

    - `energy`, `noise`: functions of a number.
    - `handed_back`: whether JAX gets many paths.
    """

    energy: Callable
    noise: Callable
    solver: diffrax.AbstractSolver
    dtype: type
    y: object
    handed_back: bool = False


def case(number: int) -> Case:
    """A random system. Each part is in turn in the potential, in company of others: first
    in programs that are cheap to compile, then with other solvers, states, precisions and
    noise."""
    rng = np.random.default_rng(number)
    energy = drawn(rng, PARTS[number % len(PARTS)], depth=2)
    if number < len(PARTS):
        one = STATES[0]
        verlet = ds.StormerVerlet()
        return Case(energy.fn, jnp.sin, verlet, jnp.float64, one, energy.handed_back)
    noise = drawn(rng, PARTS[rng.integers(len(PARTS))], depth=0)
    return Case(
        energy.fn,
        noise.fn,
        SOLVERS[number % len(SOLVERS)],
        PRECISIONS[rng.integers(2)],
        STATES[number % len(STATES)],
        energy.handed_back or noise.handed_back,
    )


NUM_CASES = 2 * len(PARTS)


def apart(case: Case) -> float:
    """How far the paths of both engines are apart."""
    y = jax.tree.map(lambda x: x.astype(case.dtype), case.y)
    separable = case.solver in SEPARABLE
    dot = lambda x, y: sum(
        jnp.sum(a * b) for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y))
    )
    weights = jax.tree.map(lambda x: 1 + x / 2, y)

    def at(p, q):
        """A number between -1 and 1, for most states."""
        return dot(weights, q) / 2 + (0 if separable else dot(weights, p) / 4)

    def H0(t, p, q, args):
        return (dot(p, p) + dot(q, q) + case.energy(at(p, q))) / 2

    def H1(t, p, q, args):
        return case.noise(at(p, q)) / 4 + dot(weights, q) / 4

    path = (
        case.solver.path if hasattr(case.solver, "path") else ds.FixedStepBrownianPath
    )
    path = path(jax.ShapeDtypeStruct((), case.dtype), jr.key(0))
    terms = ds.hamiltonian_terms(H0, H1, path)
    if isinstance(case.solver, LANGEVIN):
        terms = diffrax.MultiTerm(*terms.terms, *ds.bath_terms(H0, 0.3).terms)
    atol = 1e-15 if case.dtype == jnp.float64 else 1e-6
    y0 = jax.tree.map(jnp.zeros_like, y), y
    run = functools.partial(
        ds.ensemble, t0=0.0, t1=0.5, dt0=0.125, y0=y0, key=jr.key(1), num_paths=PATHS
    )
    reference = run(terms, by_picard(case.solver, atol))
    fused = run(terms, case.solver, engine="drjit")
    # The simple reference does not solve each step across a kink, and JAX takes the
    # stragglers: what is compared are at least nine of ten paths.
    stragglers = 0 if case.handed_back else fused.num_stragglers
    assert reference.num_failed + stragglers <= PATHS // 10
    both = ~reference.failed & ~fused.failed
    pairs = [
        (x[both], y[both])
        for x, y in zip(jax.tree.leaves(reference.ys), jax.tree.leaves(fused.ys))
    ]
    largest = max(np.max(np.abs(x)) for x, _ in pairs)
    gap = max(np.max(np.abs(x - y)) for x, y in pairs)
    return float(gap / largest / np.finfo(case.dtype).eps)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for number in map(int, sys.argv[1:]):
        print(json.dumps([number, apart(case(number))]), flush=True)
