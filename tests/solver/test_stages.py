"""The stages of one step: those of the docstrings, their measures, their roundings, and
blocks without unknowns."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import step as step_module
from diffrax_symplectic._tableau import make_plan
from examples._srkw2 import PaperSRKw2

from .. import paper
from ..picard import by_picard
from ..problems import (
    Given,
    separable_H0 as H0,
    separable_noise as noise,
    separable_problem,
)


@pytest.mark.parametrize(
    "make, solver",
    [
        (lambda x: paper.srkw2(b1=x[0], b2=x[1], b3=x[2]), PaperSRKw2()),
        (
            lambda x: paper.srkw4(0.2, a31=x[0], a32=x[1], b33=x[2], b=x[3]),
            ds.SRKw4(0.2),
        ),
        (lambda x: paper.srks2(d1=x[0]), ds.SRKs2()),
        (lambda x: paper.srks3(0.2, b1_plus_b2=x[0]), ds.SRKs3(0.2)),
    ],
    ids=["SRKw2", "SRKw4", "SRKs2", "SRKs3"],
)
def test_no_step_depends_on_other_parameters_of_the_paper(make, solver):
    expected = make_plan(solver.tableau.flatten())
    for x in np.random.default_rng(0).normal(size=(5, 4)):
        plan = make_plan(make(x).flatten())
        assert plan.blocks == expected.blocks
        assert plan.tableau.stages == expected.tableau.stages
        for name in ("matrix", "weights"):
            a, b = (getattr(p.tableau, name) for p in (plan, expected))
            np.testing.assert_allclose(a, b, atol=1e-15)
        assert np.max(np.abs(ds.symplectic_residuals(make(x)))) <= 2e-15


def test_steps_are_those_that_the_docstrings_say():
    y0, args = separable_problem(jr.key(0), 2, 2)
    t0, h, W = 0.3, 0.1, jnp.array([0.4, -0.3])

    def steps_and_others(y0):
        terms = ds.hamiltonian_terms(H0, noise, Given(W))
        negated = ds.hamiltonian_terms(H0, noise, Given(-W))
        drift, diffusion = terms.terms
        (p, q), middle = y0, t0 + h / 2

        def step(solver, terms=terms, y=y0):
            solver = by_picard(solver)
            return solver.step(terms, t0, t0 + h, y, args, None, False)[0]

        kick = lambda q, t: diffusion.vf_prod(t, (p, q), args, W)[0]
        # `SRKs2` is the midpoint rule, and `SRKw3` that after a kick.
        yield step(ds.SRKs2()), step(ds.ImplicitMidpoint())
        kicked = p + kick(q, t0), q
        yield step(ds.SRKw3("c")), step(ds.ImplicitMidpoint(), drift, kicked)
        for one, other in ("ad", "be", "cf"):
            yield step(ds.SRKw3(one)), step(ds.SRKw3(other), negated)
        # `StormerVerlet` drifts half a step, kicks and drifts again.
        q = q + h / 2 * drift.vf(t0, (p, q), args)[1]
        p = p + h * drift.vf(middle, (p, q), args)[0] + kick(q, middle)
        q = q + h / 2 * drift.vf(t0, (p, q), args)[1]
        yield step(ds.StormerVerlet()), (p, q)

    for got, expected in jax.jit(lambda y0: [*steps_and_others(y0)])(y0):
        np.testing.assert_allclose(got, expected, atol=1e-15, rtol=1e-15)


def test_unused_halves_of_gradients_are_not_computed():
    # A transcendental function of its own in each of V, U and the noise.
    H0 = lambda t, p, q, args: jnp.sum(jnp.tanh(p)) + jnp.sum(jnp.exp(q))
    noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))
    terms = ds.hamiltonian_terms(H0, noise, Given(jnp.array(0.1)))
    y0 = (jnp.ones(2), jnp.ones(2))

    def program(fn):
        return jax.jit(fn).lower(y0).compile().as_text()

    def cosines(solver):
        solver = by_picard(solver)
        step = lambda y0: solver.step(terms, 0.0, 0.1, y0, None, None, False)[0]
        return program(step).count(" cosine(")

    # Half of a gradient leaves the program if it is not asked for.
    half = lambda part: lambda y: terms.terms[0].vf_prod(0.0, y, None, 0.1)[part]
    force, velocity = program(half(0)), program(half(1))
    assert " exponential(" in force and " tanh(" not in force
    assert " exponential(" not in velocity and " tanh(" in velocity
    # Each kick evaluates the noise once, and that of `SRKw3` once more at its end.
    for solver, kicks in ((ds.StormerVerlet(), 1), (ds.SRKw3("b"), 1), (ds.SRKw3(), 2)):
        assert cosines(solver) == kicks
    assert cosines(ds.SRKs3()) < cosines(ds.SRKs2())


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
