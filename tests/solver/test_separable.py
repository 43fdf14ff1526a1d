"""Families for H0 = V(p) + U(t, q) with noise in the potential."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._tableau import make_plan
from examples._srkw2 import PaperSRKw2

from .. import paper
from ..families import slow_except
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


def _step(solver, W, h=0.1):
    y0, args = _problem(jr.key(0), 2, 2)
    solver = by_picard(solver)
    terms = ds.hamiltonian_terms(H0, noise, Given(W))
    step = lambda y0: solver.step(terms, 0.0, h, y0, args, None, False)
    y1, *_, result = eqx.filter_jit(step)(y0)
    assert result == diffrax.RESULTS.successful
    return y1


@pytest.mark.parametrize("pair", slow_except(["be"], ["ad", "be", "cf"]))
def test_variants_d_e_f_are_a_b_c_at_negated_increments(pair):
    W = jnp.array([0.4, -0.3])
    plus, minus = (_step(ds.SRKw3(v), x) for v, x in zip(pair, (W, -W)))
    for a, b in zip(plus, minus):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_srks2_is_the_midpoint_rule_and_srkw3_c_that_after_a_kick():
    W = jnp.array([0.4, -0.3])
    y0, args = _problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, Given(W))
    drift, diffusion = terms.terms
    kicked = y0[0] + diffusion.vf_prod(0.0, y0, args, W)[0], y0[1]
    solver = by_picard(ds.ImplicitMidpoint())
    midpoint = lambda terms, y: solver.step(terms, 0.0, 0.1, y, args, None, False)[0]
    whole, after = jax.jit(lambda: (midpoint(terms, y0), midpoint(drift, kicked)))()
    np.testing.assert_allclose(_step(ds.SRKs2(), W), whole, atol=1e-15)
    np.testing.assert_allclose(_step(ds.SRKw3("c"), W), after, atol=1e-15)


def test_unused_halves_of_gradients_are_not_computed():
    # A transcendental function of its own in each of V, U and the noise.
    H0 = lambda t, p, q, args: jnp.sum(jnp.tanh(p)) + jnp.sum(jnp.exp(q))
    noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))
    terms = ds.hamiltonian_terms(H0, noise, Given(jnp.array(0.1)))
    y0 = (jnp.ones(2), jnp.ones(2))

    def count(fn, name):
        text = jax.jit(fn).lower(y0).compile().as_text()
        return text.count(f" {name}(")

    def step(solver):
        return lambda y0: solver.step(terms, 0.0, 0.1, y0, None, None, False)[0]

    # Half of a gradient leaves the program if it is not asked for.
    half = lambda part: lambda y: terms.terms[0].vf_prod(0.0, y, None, 0.1)[part]
    assert count(half(0), "tanh") == 0 and count(half(0), "exponential") > 0
    assert count(half(1), "tanh") > 0 and count(half(1), "exponential") == 0
    # Each kick evaluates the noise once.
    for solver, kicks in ((ds.StormerVerlet(), 1), (ds.SRKw3("b"), 1), (ds.SRKw3(), 3)):
        assert count(step(solver), "cosine") == kicks
    assert count(step(ds.SRKs3()), "cosine") < count(step(ds.SRKs2()), "cosine")


def test_stormer_verlet_drifts_half_a_step_kicks_and_drifts_again():
    y0, args = _problem(jr.key(0), 2, 2)
    t0, h, W = 0.3, 0.1, jnp.array([0.4, -0.3])
    terms = ds.hamiltonian_terms(H0, noise, Given(W))
    drift, diffusion = terms.terms
    p, q = y0
    q = q + h / 2 * drift.vf(t0, (p, q), args)[1]
    kick = h * drift.vf(t0 + h / 2, (p, q), args)[0]
    p = p + kick + diffusion.vf_prod(t0 + h / 2, (p, q), args, W)[0]
    q = q + h / 2 * drift.vf(t0, (p, q), args)[1]
    y1, *_ = ds.StormerVerlet().step(terms, t0, t0 + h, y0, args, None, False)
    np.testing.assert_allclose(y1, (p, q), rtol=1e-15)


def test_explicit_methods_have_no_equation_to_solve():
    y0, args = _problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, ds.PlateauVerlet().path((2,), jr.key(0)))
    for solver in (ds.PlateauVerlet(), ds.StormerVerlet()):
        assert not isinstance(solver, diffrax.AbstractImplicitSolver)
        step = lambda y0, s=solver: s.step(terms, 0.0, 0.1, y0, args, None, False)[0]
        text = str(jax.make_jaxpr(step)(y0))
        assert "root_find" not in text and "triangular_solve" not in text
