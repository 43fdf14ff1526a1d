"""Families for H0 = V(p) + U(t, q) with noise in the potential."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._tableau import make_plan
from examples._srkw2 import PaperSRKw2

from .. import paper
from ..picard import by_picard
from ..problems import (
    Given,
    separable_H0 as H0,
    separable_noise as noise,
    separable_problem as _problem,
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
    y0, args = _problem(jr.key(0), 2, 2)
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
