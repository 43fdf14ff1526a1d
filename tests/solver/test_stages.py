"""The stages of one step: their measures, their roundings, and blocks without unknowns."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_symplectic as ds
from diffrax_symplectic._solver import step as step_module
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
    blocks = make_plan(solver.tableau.flatten()).blocks
    assert [len(block.unknown) for block in blocks] == [1, 0]
    H0 = lambda t, p, q, args: jnp.sum(jnp.cosh(p) - jnp.cos(q))
    noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))
    terms = ds.hamiltonian_terms(H0, noise, Given(jnp.array(0.1)))
    step = lambda y0: solver.step(terms, 0.0, 0.1, y0, None, None, False)[-1]
    result = jax.jit(step)((jnp.ones(1), jnp.ones(1)))
    assert result == diffrax.RESULTS.successful


def _damped(t, y, args):
    """A nonlinear decay of an amplitude, of which the halves are the parts."""
    p, q = y
    psi = q + 1j * p
    rate = -(1 + 0.5j) * (1 + jnp.abs(psi) ** 2) * psi
    return jnp.imag(rate), jnp.real(rate)


def test_halves_that_are_computed_together_take_fewer_evaluations(monkeypatch):
    y0 = jnp.array([0.3, 0.5]), jnp.array([0.8, -0.4])

    def step_and_evaluations(in_halves):
        monkeypatch.setattr(
            step_module, "_computes_halves_together", lambda *_: not in_halves
        )
        count = []

        def counted(t, y, args):
            jax.debug.callback(lambda: count.append(1))
            return _damped(t, y, args)

        solver = ds.ImplicitMidpoint()
        terms = diffrax.ODETerm(counted)
        y1, *_ = solver.step(terms, 0.0, 0.3, y0, None, None, False)
        jax.effects_barrier()
        return np.stack(y1), len(count)

    halves, num_halves = step_and_evaluations(in_halves=True)
    whole, num_whole = step_and_evaluations(in_halves=False)
    np.testing.assert_allclose(whole, halves, rtol=0, atol=1e-15)
    assert num_whole < 0.8 * num_halves
    # As it is decided without the patch.
    monkeypatch.undo()
    pendulum = lambda t, y, args: (-jnp.sin(y[1]), y[0])
    for field, together in ((_damped, True), (pendulum, False)):
        changes = {"h": lambda t, y, field=field: field(t, y, None)}
        step = step_module.Step(0.0, 0.3, changes)
        assert step_module._computes_halves_together(step, y0) is together
