"""The stages of one step: their measures, their roundings, and blocks without unknowns."""

import diffrax
import jax
import jax.numpy as jnp

import diffrax_symplectic as ds
from diffrax_symplectic._tableau import make_plan

from ..problems import Given


def test_small_changes_are_added_before_they_are_added_to_the_state():
    # Two kicks, or two drifts, of 1: to add them one by one to 2^53 would change nothing.
    H0 = lambda t, p, q, args: p - q
    nothing = lambda t, p, q, args: 0.0 * q
    terms = ds.hamiltonian_terms(H0, nothing, Given(jnp.array(0.0)))
    y0 = jnp.array(2.0**53), jnp.array(2.0**53)
    (p, q), *_ = ds.StormerVerlet().step(terms, 0.0, 2.0, y0, None, None, False)
    assert p == q == 2.0**53 + 2


def test_blocks_without_unknowns_do_not_call_for_the_safety_net():
    # It has no iterations here.
    solver = ds.SRKw3("b", root_finder=ds.PicardNewton(newton_steps=0))
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
