"""Families for H0 = V(p) + U(t, q) with noise in the potential."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._tableau import Block, make_plan
from examples._srkw2 import PaperSRKw2

from .. import paper
from ..problems import (
    Given,
    separable_H0 as H0,
    separable_noise as noise,
    separable_problem as _problem,
)


_gauss = 1 / 4 + np.sqrt(3) / 6
SEPARABLE = {
    **{f"SRKw3{v}": ds.SRKw3(v) for v in "abcdef"},
    "SRKw4": ds.SRKw4(),
    "SRKw4-Gauss": ds.SRKw4(a21=_gauss),
    "SRKs2": ds.SRKs2(),
    "SRKs3": ds.SRKs3(a=0.25),
}
all_solvers = pytest.mark.parametrize(
    "solver", SEPARABLE.values(), ids=SEPARABLE.keys()
)


@all_solvers
def test_conditions_hold_and_see_every_live_coefficient(solver):
    weak_two = isinstance(solver, ds.SRKw4)

    def residuals(tableau):
        strong = ds.strong_order_residuals(tableau)
        return np.concatenate(
            [
                [*ds.weak_order_residuals(tableau, 2 if weak_two else 1).values()],
                [*strong.values()] if isinstance(solver, ds.SRKs2 | ds.SRKs3) else [],
                np.ravel(ds.symplectic_residuals(tableau)),
            ]
        )

    tableau = solver.tableau
    assert np.max(np.abs(residuals(tableau))) <= 1e-15
    for name in ("alpha", "beta", "A0", "B0", "A1"):
        value = getattr(tableau, name)
        for path, array in jax.tree_util.tree_leaves_with_path(value):
            for index in np.argwhere(array != 0):
                dead_row = name in ("A0", "B0") and tableau.alpha[index[0]] == 0
                moved = array.copy()
                moved[tuple(index)] += 1e-6
                changed = moved if path == () else value | {path[0].key: moved}
                perturbed = dataclasses.replace(tableau, **{name: changed})
                assert dead_row or np.max(np.abs(residuals(perturbed))) >= 1e-9


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


@pytest.mark.parametrize(
    "solver, blocks",
    [
        # Stages: velocities, then forces, then noise.
        (ds.SRKw3("a"), [Block(((0,),), ((1,),))]),  # the noise is read with the force
        (
            ds.SRKw3("b"),
            [Block(((0,),), ((1,),)), Block((), ((2,),))],
        ),  # drift, then kick
        (
            ds.SRKw3("c"),
            [Block((), ((2,),)), Block(((0,),), ((1,),))],
        ),  # kick, then drift
        (ds.SRKs2(), [Block(((0,),), ((1,),))]),
        (
            ds.SRKs3(a=0.25),
            [Block(((0,),), ((2,),)), Block(((1,),), ((3,),)), Block((), ((4,),))],
        ),
    ],
    ids=repr,
)
def test_kicks_are_explicit_and_only_half_of_the_state_is_solved(solver, blocks):
    assert list(make_plan(solver.tableau.flatten()).blocks) == blocks


def _step(solver, W, h=0.1):
    y0, args = _problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, Given(W))
    step = lambda y0: solver.step(terms, 0.0, h, y0, args, None, False)
    y1, *_, result = eqx.filter_jit(step)(y0)
    assert result == diffrax.RESULTS.successful
    return y1


@pytest.mark.parametrize("pair", ["ad", "be", "cf"])
def test_variants_d_e_f_are_a_b_c_at_negated_increments(pair):
    W = jnp.array([0.4, -0.3])
    plus, minus = (_step(ds.SRKw3(v), x) for v, x in zip(pair, (W, -W)))
    for a, b in zip(plus, minus):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_srks2_is_the_midpoint_rule():
    W = jnp.array([0.4, -0.3])
    for a, b in zip(_step(ds.SRKs2(), W), _step(ds.ImplicitMidpoint(), W)):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_srkw3_c_is_a_kick_and_a_midpoint_step():
    W = jnp.array([0.4, -0.3])
    y0, args = _problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, Given(W))
    drift, diffusion = terms.terms
    kicked = y0[0] + diffusion.vf_prod(0.0, y0, args, W)[0], y0[1]
    y1, *_ = ds.ImplicitMidpoint().step(drift, 0.0, 0.1, kicked, args, None, False)
    for a, b in zip(_step(ds.SRKw3("c"), W), y1):
        np.testing.assert_allclose(a, b, atol=1e-15)


@pytest.mark.parametrize("variant", ["g", "A", "", None, 1])
def test_unknown_variants_are_refused(variant):
    with pytest.raises(ValueError, match="`variant` must be one of"):
        ds.SRKw3(variant)


@pytest.mark.parametrize("value", [1j, np.nan, np.inf])
def test_malformed_parameters_are_refused(value):
    with pytest.raises(ValueError, match="`a21` must be a finite real number"):
        ds.SRKw4(a21=value)
    with pytest.raises(ValueError, match="`a` must be a finite real number"):
        ds.SRKs3(a=value)


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
