"""Random programs with every kind of control flow are replayed as JAX runs them. Where a
program of Dr.Jit is wrong, LLVM may abort the process, which pytest-xdist reports as a
failure of the test that ran in it."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..stablehlo.replayed import replayed_lanes
from .parts import drawn, PARTS, sine_of_a_large_angle_in_a_loop
from .test_same_paths import assert_same_paths


pytestmark = needs_drjit
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
