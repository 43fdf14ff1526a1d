"""Whole solves: invariants, root finders, failures, single precision."""

import dataclasses
import functools as ft

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

import diffrax_symplectic as ds

from ..families import slow_except
from ..problems import (
    Given,
    H0,
    noise,
    random_problem,
    rigid_body_terms,
    weak_path,
)


# Of a solver with one system of equations and of one with several.
@pytest.mark.parametrize("solver", [ds.ImplicitMidpoint(), ds.SRKw2()], ids=repr)
@pytest.mark.slow
def test_rigid_body_stays_on_the_sphere_over_1e5_steps(solver):
    y0, h, steps = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)]), 0.02, 10**5
    terms = rigid_body_terms(ds.WeakBrownianPath((), jr.key(0)))
    sol = diffrax.diffeqsolve(
        terms, solver, 0.0, h * steps, h, y0, max_steps=None,
        adjoint=diffrax.ForwardMode(),
        saveat=diffrax.SaveAt(ts=jnp.linspace(0, h * steps, 101)),
    )  # fmt: skip
    assert np.max(np.abs(np.sum(np.square(sol.ys), axis=1) - 1)) <= 1e-11


OTHER_FINDERS = [
    optx.Newton(rtol=1e-12, atol=1e-14),
    optx.Chord(rtol=1e-12, atol=1e-14),
    optx.Dogleg(rtol=1e-12, atol=1e-14),
    optx.LevenbergMarquardt(rtol=1e-12, atol=1e-14),
]
OWN_FINDERS = [
    ds.PicardNewton(linear_solver=lx.QR()),
    ds.PicardNewton(),
    ds.PicardNewton(picard_steps=0),
]


@pytest.mark.parametrize(
    "root_finder",
    slow_except(OTHER_FINDERS[:1], [*OTHER_FINDERS, *OWN_FINDERS]),
    ids=lambda r: type(r).__name__,
)
def test_any_root_finder_gives_the_same_solution(root_finder):
    options = dict(root_finder=root_finder, root_find_max_steps=50)
    np.testing.assert_allclose(_end_of_a_step(**options), _end_of_a_step(), atol=1e-10)


@ft.cache
def _end_of_a_step(**options):
    # Two coupled stages, eight unknowns.
    y0, args = random_problem(jr.key(0), 2, 2)
    terms = ds.hamiltonian_terms(H0, noise, weak_path(2))
    solver = dataclasses.replace(ds.SRKw1(b=0.2), **options)
    step = lambda y0, args: solver.step(terms, 0.0, 0.1, y0, args, None, False)[0]
    return jax.jit(step)(y0, args)


def test_unsolvable_stages_are_reported_and_do_not_spoil_other_paths():
    # q' = q^2 has no midpoint step once the increment exceeds 1 / (2 q).
    explosive = lambda t, p, q, args: p * q**2

    def solve(q, key, throw):
        path = ds.WeakBrownianPath((), key)
        terms = ds.hamiltonian_terms(lambda t, p, q, args: 0.0, explosive, path)
        return diffrax.diffeqsolve(
            terms, ds.ImplicitMidpoint(), 0.0, 1.0, 0.1, (jnp.array(0.1), q),
            throw=throw, max_steps=None, adjoint=diffrax.ForwardMode(),
        )  # fmt: skip

    q = jnp.array([0.1, 50.0, 0.2, jnp.nan])
    keys = jr.split(jr.key(0), 4)
    batch = jax.jit(jax.vmap(ft.partial(solve, throw=False)))(q, keys)
    success = batch.result == diffrax.RESULTS.successful
    np.testing.assert_array_equal(success, [True, False, True, False])
    alone = eqx.filter_jit(ft.partial(solve, throw=True))
    for i in (0, 2):
        for a, b in zip(batch.ys, alone(q[i], keys[i]).ys):
            np.testing.assert_allclose(a[i], b, rtol=4 * np.finfo(float).eps)
    with pytest.raises(Exception, match="(?i)nonlinear solve"):
        jax.block_until_ready(alone(q[1], keys[1]))
    # Nothing that is not a number goes unannounced.
    finite = jnp.isfinite(batch.ys[0][:, 0]) & jnp.isfinite(batch.ys[1][:, 0])
    assert jnp.all(finite | ~success)


def test_everything_works_in_single_precision_mode():
    with jax.enable_x64(False):
        H = lambda t, p, q, args: (p**2 + q**2) / 2
        path = ds.TruncatedBrownianPath(ds.FixedStepBrownianPath((), jr.key(0)))
        terms = ds.hamiltonian_terms(H, H, path)

        def momentum(y0):
            at = terms, ds.ImplicitMidpoint(), 0.0, 1.0, 0.01, y0
            ys = diffrax.diffeqsolve(*at).ys
            return jnp.sum(ys[0]), ys

        y0 = jnp.array(0.0), jnp.array(1.0)
        grad, (p, q) = jax.jit(jax.grad(momentum, has_aux=True))(y0)
    assert p.dtype == grad[0].dtype == np.float32
    assert abs(p**2 + q**2 - 1) < 1e-5
    assert np.all(np.isfinite(grad))


def test_a_batch_over_an_array_of_numpy_within_jit_of_states_with_empty_parts():
    W, h, q0 = 0.3, 0.1, np.array([0.5, 0.2])
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: (p["x"] ** 2 + q["x"] ** 2) / 2,
        lambda t, p, q, args: q["x"],
        Given(jnp.array(W)),
    )

    def end(q):
        y0 = tuple({"x": x, "none": jnp.zeros(0)} for x in (jnp.ones(()), q))
        return ds.ImplicitMidpoint().step(terms, 0.0, h, y0, None, None, False)[0]

    p, q = jax.jit(lambda: jax.vmap(end)(q0))()
    matrix = np.array([[1, h / 2], [-h / 2, 1]])
    right = matrix.T @ [np.ones(2), q0] - [[W], [0]]
    expected = np.linalg.solve(matrix, right)
    np.testing.assert_allclose([p["x"], q["x"]], expected, rtol=1e-14)
    assert p["none"].shape == q["none"].shape == (2, 0)
