"""The path of a trial with several levels."""

import diffrax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import common_path, path_of_array_cell


SOLVERS = [
    ds.StormerVerlet(),
    ds.PlateauVerlet(),
    ds.LevyAreaMidpoint(),
    diffrax.Heun(),
]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
def test_a_cell_that_is_an_array_gives_the_same_motion(solver):
    cell, key = 0.125, jr.key(4)
    plain = common_path(solver, cell, (3,), key)
    traced = path_of_array_cell(solver, np.asarray(cell), (3,), key)
    over = jnp.asarray(0.5), jnp.asarray(0.5 + 4 * cell)
    got = traced.evaluate(*over, use_levy=True)
    exact = plain.evaluate(*over, use_levy=True)
    for x, y in zip(jtu.tree_leaves(got), jtu.tree_leaves(exact), strict=True):
        np.testing.assert_array_equal(x, y)
