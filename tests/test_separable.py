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
from diffrax_symplectic._plan import Block, make_plan

from . import paper
from .problems import FineSample, Given, slope, weak_path


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


def _potential(t, q, a, v, phi):
    return jnp.sum(a * jnp.cos(v @ q + phi + t), axis=-1)


def H0(t, p, q, args):
    a, u, v, phi = args["drift"]
    kinetic = jnp.sum(a * jnp.sin(u @ p)) + jnp.sum(p**2) / 2
    return kinetic + _potential(t, q, a, v, phi)


def noise(t, p, q, args):
    a, v, phi = args["noise"]
    return jax.vmap(lambda a, v, phi: _potential(t, q, a, v, phi))(a, v, phi)


def _problem(key, d, m, dtype=jnp.float64):
    ks = jr.split(key, 8)
    draw = lambda i, *shape: jr.normal(ks[i], shape, dtype)
    args = {
        "drift": (0.5 * draw(0, 4), draw(1, 4, d), draw(2, 4, d), draw(3, 4)),
        "noise": (0.3 * draw(4, m, 4), draw(5, m, 4, d), draw(6, m, 4)),
    }
    p, q = jr.normal(ks[7], (2, d), dtype)
    return (p, q), args


@all_solvers
def test_tableau_is_symplectic(solver):
    assert np.max(np.abs(ds.symplectic_residuals(solver.tableau))) <= 1e-15


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
        (lambda x: paper.srkw2(b1=x[0], b2=x[1], b3=x[2]), ds.SRKw2((1, 2, 3, 4))),
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


@pytest.mark.parametrize("dtype, bound", [(jnp.float64, 1e-13), (jnp.float32, 5e-6)])
@pytest.mark.parametrize("name", ["SRKw3a", "SRKw3c", "SRKw4", "SRKs3"])
def test_step_is_symplectic_for_a_thousand_random_systems(name, dtype, bound):
    def defect(key):
        k_problem, k_sizes, k_path, k_h = jr.split(key, 4)
        y0, args = _problem(k_problem, 3, 3, dtype)
        a, v, phi = args["noise"]
        m = jr.randint(k_sizes, (), 1, 4)
        args["noise"] = jnp.where(jnp.arange(3)[:, None] < m, a, 0), v, phi
        h = jnp.exp(jr.uniform(k_h, (), dtype, jnp.log(1e-3), jnp.log(0.2)))
        terms = ds.hamiltonian_terms(H0, noise, weak_path(3, k_path, dtype))
        solver = SEPARABLE[name]
        return ds.symplecticity_defect(terms, solver, jnp.zeros_like(h), h, y0, args)

    defects = eqx.filter_jit(jax.vmap(defect))(jr.split(jr.key(0), 1000))
    assert defects.dtype == dtype
    assert jnp.max(defects) <= bound


# Variants d, e and f have the defects of a, b and c: the same steps at the negated
# increments (a test below), which are as likely.
@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("name", [n for n in SEPARABLE if n[-1] not in "def"])
def test_local_weak_defect_has_the_order_of_the_solver(name, m):
    solver = SEPARABLE[name]

    def H0(t, p, q, args):
        return jnp.sum(jnp.cosh(p) + jnp.cos(p) + jnp.cos(q + t) + 0.1 * q**4)

    def noise(t, p, q, args):
        return jnp.stack([0.5 * jnp.sin(q[0] * (k + 1) + t) for k in range(m)])

    def functions(y):
        p, q = y[0][0], y[1][0]
        return jnp.stack([p, q**2, p * q, jnp.sin(p + q), jnp.exp(p / 2)])

    terms = ds.hamiltonian_terms(H0, noise, weak_path(m))
    order = solver.weak_order(terms)
    y0 = (jnp.array([0.3]), jnp.array([0.5]))
    hs = np.array([0.04, 0.02, 0.01, 0.005])
    defect = lambda h: ds.weak_order_defect(
        terms, solver, 0.1, 0.1 + h, y0, fn=functions, order=order
    )
    defects = jax.jit(jax.vmap(defect))(hs)
    slopes = [slope(hs, d) for d in defects.T]
    np.testing.assert_allclose(slopes, order + 1, atol=0.1)


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
    # A kick is evaluated once a step, the noise of the midpoint rule in each iteration.
    assert count(step(ds.SRKw3("c")), "cosine") < count(
        step(ds.ImplicitMidpoint()), "cosine"
    )
    assert count(step(ds.SRKs3()), "cosine") < count(step(ds.SRKs2()), "cosine")


@pytest.mark.parametrize(
    "solver, m",
    [(s, m) for s in (ds.SRKs2(), ds.SRKs3(), ds.StormerVerlet()) for m in (1, 2)],
    ids=repr,
)
def test_strong_order_is_one(solver, m):
    y0, args = _problem(jr.key(3), 1, m)
    steps, fine = [2.0**-k for k in (4, 5, 6, 7)], 2**11

    @jax.jit
    @jax.vmap
    def ends(key):
        terms = ds.hamiltonian_terms(H0, noise, FineSample.draw(key, fine, m))
        solve = lambda h: jnp.concatenate(
            diffrax.diffeqsolve(terms, solver, 0.0, 1.0, h, y0, args).ys, axis=1
        )[0]
        return jax.lax.map(solve, jnp.array([*steps, 1 / fine]))

    ys = ends(jr.split(jr.key(0), 200))
    squared = jnp.sum((ys[:, :-1] - ys[:, -1:]) ** 2, axis=-1)
    measured = slope(np.array(steps), np.sqrt(jnp.mean(squared, axis=0)))
    assert solver.strong_order(None) == 1.0
    assert abs(measured - 1) <= 0.1
