"""Random programs with every kind of control flow are replayed as JAX runs them. Where a
program of Dr.Jit is wrong, LLVM may abort the process, which pytest-xdist reports as a
failure of the test that ran in it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax import lax

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..stablehlo.replayed import replayed_lanes
from .test_same_paths import assert_same_paths


pytestmark = needs_drjit
# Random functions of one number are made of these parts, with control flow and all that has
# once gone wrong in the fused engine, each in company of others. Their derivatives are of
# the size of one, and what they compare or convert to integers is not within rounding of
# another answer, for most numbers.
PARTS = []


def part(fn):
    PARTS.append(fn)
    return fn


def quarters(x):
    """A whole number, as an integer."""
    return jnp.floor(4 * lax.stop_gradient(x)).astype(jnp.int32)


def square(x):
    return x * x


def half(x):
    return x / 2


@part
def values_from_outside(x):
    y = jnp.sin(x)
    z = 2 * x
    a, b = lax.cond(x > 0, lambda: (y, z), lambda: (z, y))
    return a * a / 2 + b / 4 + y * lax.cond(x > 0.2, square, lambda x: y, x) / 2


@part
def constants_of_branches(x):
    one = lambda x: jnp.ones_like(x)
    three_halves = lambda x: jnp.full_like(x, 1.5)
    zero = lambda x: 0 * x
    found = [lax.cond(x > 0, one, other, x) for other in (square, three_halves, zero)]
    return x * sum(found) / 3


@part
def unused_results_and_branches(x):
    three = lambda x: (x, x * x, x / 2)
    others = lambda x: (x * x, jnp.exp(x), x)
    a, _, b = lax.cond(x > 0, three, others, x)
    known = lax.cond(jnp.zeros(()) < 1, square, half, x)
    return (a + b) / 2 + lax.cond(x > 99, square, half, x) + known / 4


@part
def integers_and_masks_in_branches(x):
    n = lax.cond(x > 0, lambda: jnp.int32(2), lambda: jnp.int32(1))
    mask = lax.cond(x > 0, lambda x: x > 0.5, lambda x: jnp.array(True), x)
    chosen = lax.switch(n, [jnp.negative, half, square], x)
    return chosen * n / 2 + jnp.where(mask & ~(x > 0.8), x * x, half(x))


@part
def loops_with_values_from_outside(x):
    y = jnp.sin(x)
    swap = lambda i, y: (y[1], y[0] + y[1] / 9)
    a, b = lax.fori_loop(0, 15, swap, (x, jnp.cos(x)))
    return lax.fori_loop(0, 12, lambda i, z: y, x) + (a + b) / 9


@part
def loop_in_a_loop(x):
    inner = lambda i, y: y / 2 + jnp.sin(x)
    outer = lambda i, y: lax.fori_loop(0, 9, inner, y) / 3
    return lax.fori_loop(0, 10, outer, x)


@part
def loop_of_unknown_length(x):
    """The number is no function that JAX derives."""
    going = lambda state: (state[0] > 0.1) & (state[1] < 9)
    halved = lambda state: (state[0] / 2, state[1] + 1)
    start = jnp.abs(lax.stop_gradient(x)), jnp.int32(0)
    _, number = lax.while_loop(going, halved, start)
    return x * x * (1 + number / 9)


@part
def sine_of_a_large_angle_in_a_loop(x):
    # The last angle is 1.2e10, for large numbers only: too large for kernels.
    angle = lambda i: jnp.where(x > 0.8, 1e9 * i.astype(x.dtype), 1.0)
    return x * lax.fori_loop(0, 13, lambda i, y: y / 2 + jnp.sin(angle(i)), x)


# Of more entries a kernel would only read an array in `args`.
TABLE = np.sin(np.arange(60.0))


@part
def table_in_a_branch(x):
    table = jnp.asarray(TABLE, x.dtype)
    read = lambda table: x * table[50 + quarters(x)]
    return lax.cond(x > 0, read, lambda table: x * table[3], table)


# What the parts stand in


def bounded(y):
    return y / (1 + y * y / 4)


def in_a_branch(rng, inner):
    edge = rng.uniform(-0.6, 0.6)
    yes = inner()
    no = inner()
    return lambda x: lax.cond(x > edge, yes, no, x)


def in_a_switch(rng, inner):
    branches = [inner(), jnp.sin, inner()]
    return lambda x: lax.switch(quarters(x) % 3, branches, x)


def in_a_loop(rng, inner):
    fn = inner()
    # Longer ones are a loop of the kernel after eight turns, and take long to compile.
    number = int(rng.choice([2, 10], p=[0.8, 0.2]))
    once = lambda x: lambda i, y: bounded(fn(y)) / 2 + x / 2
    return lambda x: lax.fori_loop(0, number, once(x), x)


def in_a_scan(rng, inner):
    fn = inner()
    table = rng.uniform(-0.3, 0.3, int(rng.choice([3, 12], p=[0.8, 0.2])))
    once = lambda y, a: (bounded(fn(y + a)) / 2, y)

    def scanned(x):
        last, each = lax.scan(once, x, jnp.asarray(table, x.dtype))
        return last + jnp.sum(each) / 9

    return scanned


def in_a_map(rng, inner):
    fn = inner()
    shifts = rng.uniform(-0.4, 0.4, 2)
    return lambda x: jnp.sum(jax.vmap(fn)(x + jnp.asarray(shifts, x.dtype))) / 2


COMPANY = in_a_branch, in_a_switch, in_a_loop, in_a_scan, in_a_map


def drawn(
    rng: np.random.Generator, first: Callable, depth: int
) -> tuple[Callable, list[Callable]]:
    """A random function of this depth with the part `first`, and others at random, in it;
    and these parts."""
    parts: list[Callable] = []

    def at(depth: int) -> Callable:
        if depth > 0:
            around = COMPANY[rng.integers(len(COMPANY))]
            return around(rng, lambda: at(depth - 1))
        parts.append(PARTS[rng.integers(len(PARTS))] if parts else first)
        return parts[-1]

    return at(depth), parts


# Without equations, and with some: their sweeps are a loop around those of the system.
SOLVERS = ds.StormerVerlet(), ds.ImplicitMidpoint()


@pytest.mark.parametrize("number", slow_except([0], range(8)))
def test_each_part_in_random_company_has_the_value_and_derivative_of_jax(number):
    dtype = (np.float64, np.float32)[number // 4]
    rng = np.random.default_rng(number)
    x = rng.uniform(-1, 1, 500).astype(dtype)
    functions, parts = zip(
        *[drawn(rng, part, depth=2) for part in PARTS[number % 4 :: 4]]
    )
    every = lambda x: [jax.value_and_grad(fn)(x) for fn in functions]
    exact = jax.jit(jax.vmap(every))(x)
    for fn, others, of_jax in zip(functions, parts, exact):
        found, lost = replayed_lanes(jax.value_and_grad(fn), x)
        # JAX gets paths with large angles.
        handed_back = sine_of_a_large_angle_in_a_loop in others
        assert handed_back or not np.any(lost)
        for a, b in zip(found, of_jax, strict=True):
            size = np.max(np.abs(b[~lost]))
            close = np.abs(a - b)[~lost] <= 64 * np.finfo(dtype).eps * size
            # Rounding errors move few numbers across the edge of a branch.
            assert np.mean(close) > 0.99, others


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS, ids=repr)
def test_systems_of_such_parts_have_the_same_paths(solver):
    rng = np.random.default_rng(0)
    functions = [drawn(rng, part, depth=1)[0] for part in PARTS[:3]]

    def H0(t, p, q, args):
        # A number between -1 and 1, for most states.
        x = jnp.sum(q) / 4
        return (p @ p + q @ q) / 2 + sum(fn(x) for fn in functions) / 9

    noise = lambda t, p, q, args: jnp.stack([jnp.sin(q[0]), q[1]]) / 4
    terms = ds.hamiltonian_terms(H0, noise, solver.path((2,), jr.key(0)))
    assert_same_paths(terms, solver)
