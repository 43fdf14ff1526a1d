"""The stages of one step: their measures, their roundings, and blocks without unknowns."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds
from diffrax_symplectic._plan import make_plan
from diffrax_symplectic._solver._stages import Stages, Step

from .problems import Given


def _negative(tree, key):
    leaves, treedef = jax.tree.flatten(tree)
    keys = jr.split(key, len(leaves))
    return treedef.unflatten(-jr.uniform(k, x.shape) for k, x in zip(keys, leaves))


def test_extent_and_scale_are_the_largest_of_all_unknown_values():
    y0 = jnp.array([-3.0, 0.5]), jnp.array([-0.1, -7.0])
    # One unknown stage, two together, and one more; and half of the state in two blocks,
    # which is q if the stages that change it come first.
    halves = ds.SRKs3(a=0.25).tableau.flatten()
    halves = halves.take([*range(len(halves.stages))][::-1])
    for tableau, leaves in (
        (ds.StrangGauss().tableau.flatten(), [0, 1]),
        (halves, [1]),
    ):
        plan = make_plan(tableau)
        stages = Stages(plan, Step(0.0, 1.0, {}), y0)
        zero = [stages.zero_of(block) for block in plan.blocks]
        unknown = _negative(zero, jr.key(0))
        assert len(jax.tree.leaves(unknown)) > len(leaves)
        extent, scale = stages.extent(unknown), stages.scale(unknown)
        assert len(extent) == len(scale) == len(leaves)
        for j, i in enumerate(leaves):
            values = [np.reshape(k, (-1, 2)) for k in jax.tree.leaves(unknown)]
            largest = np.abs(np.concatenate(values[j :: len(leaves)])).max(0)
            np.testing.assert_array_equal(extent[j], largest)
            np.testing.assert_array_equal(scale[j], np.abs(y0[i]) + largest)


def test_small_changes_are_added_before_they_are_added_to_the_state():
    # Two kicks, or two drifts, of 1: to add them one by one to 2^53 would change nothing.
    H0 = lambda t, p, q, args: p - q
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.0, Given(jnp.array(0.0)))
    y0 = jnp.array(2.0**53), jnp.array(2.0**53)
    (p, q), *_ = ds.StormerVerlet().step(terms, 0.0, 2.0, y0, None, None, False)
    assert p == q == 2.0**53 + 2


def test_blocks_without_unknowns_do_not_call_for_the_safety_net():
    # It has no iterations here.
    solver = ds.SRKw3("b", root_find_max_steps=0)
    assert [len(b.unknown) for b in make_plan(solver.tableau.flatten()).blocks] == [
        1,
        0,
    ]
    H0 = lambda t, p, q, args: jnp.sum(jnp.cosh(p) - jnp.cos(q))
    noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))
    terms = ds.hamiltonian_terms(H0, noise, Given(jnp.array(0.1)))
    step = lambda y0: solver.step(terms, 0.0, 0.1, y0, None, None, False)[-1]
    result = jax.jit(step)((jnp.ones(1), jnp.ones(1)))
    assert result == diffrax.RESULTS.successful
