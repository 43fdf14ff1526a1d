"""Whole solves: strong order, invariants, gradients, failures, bad input."""

import dataclasses
import functools as ft
import os
import subprocess
import sys

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
    GENERAL,
    H0,
    kubo_terms,
    noise,
    random_problem,
    rigid_body_terms,
    weak_path,
)


all_solvers = pytest.mark.parametrize("solver", GENERAL.values(), ids=GENERAL.keys())


def _drift_of_invariant(terms, solver, y0, invariant, h, steps):
    sol = diffrax.diffeqsolve(
        terms,
        solver,
        0.0,
        h * steps,
        h,
        y0,
        max_steps=None,
        adjoint=diffrax.ForwardMode(),
        saveat=diffrax.SaveAt(ts=jnp.linspace(0, h * steps, 101)),
    )
    values = jax.vmap(invariant)(sol.ys)
    return jnp.max(jnp.abs(values / invariant(y0) - 1))


# What a solver keeps of one quadratic invariant it keeps of any, and every one has the test
# below: here are a solver with one system of equations and one with several.
@pytest.mark.parametrize("solver", [ds.ImplicitMidpoint(), ds.SRKw2()], ids=repr)
@pytest.mark.slow
def test_kubo_energy_is_conserved_over_1e5_steps(solver):
    y0 = (jnp.array(0.0), jnp.array(1.0))
    terms = kubo_terms(ds.WeakBrownianPath((), jr.key(0)))
    energy = lambda y: y[0] ** 2 + y[1] ** 2
    assert _drift_of_invariant(terms, solver, y0, energy, 0.01, 10**5) <= 1e-11


@all_solvers
@pytest.mark.slow
def test_rigid_body_stays_on_the_sphere_over_1e5_steps(solver):
    y0 = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)])
    terms = rigid_body_terms(ds.WeakBrownianPath((), jr.key(0)))
    squared = lambda y: jnp.sum(y**2)
    assert _drift_of_invariant(terms, solver, y0, squared, 0.02, 10**5) <= 1e-11


_CUT = ds.TruncatedBrownianPath(ds.FixedStepBrownianPath((2,), jr.key(3)), k=1)


@pytest.mark.parametrize(
    "solver, path",
    [
        (ds.ImplicitMidpoint(), weak_path(2)),
        pytest.param(ds.SRKs1(), _CUT, marks=pytest.mark.slow),
    ],
    ids=["ImplicitMidpoint", "SRKs1-cut"],
)
def test_gradients_equal_central_differences(solver, path):
    y0, args = random_problem(jr.key(0), 1, 2)
    terms = ds.hamiltonian_terms(H0, noise, path)

    def loss(y0, args):
        ys = diffrax.diffeqsolve(
            terms,
            solver,
            0.0,
            1.0,
            0.1,
            y0,
            args,
            saveat=diffrax.SaveAt(ts=[0.5, 1.0]),
            adjoint=diffrax.RecursiveCheckpointAdjoint(checkpoints=2),
        ).ys
        return jnp.sum(ys[0] ** 2) + jnp.sum(jnp.sin(ys[1]))

    flat, unravel = jax.flatten_util.ravel_pytree((y0, args))
    eps = 1e-5
    shifts = eps * np.concatenate(
        [0 * flat[None], np.eye(flat.size), -np.eye(flat.size)]
    )
    # One program for the gradient and for all values that are compared to it.
    value_and_grad = jax.value_and_grad(lambda x: loss(*unravel(x)))
    values, gradients = jax.jit(jax.vmap(value_and_grad))(flat + shifts)
    gradient = gradients[0]
    plus, minus = values[1:].reshape(2, -1)
    differences = (plus - minus) / (2 * eps)
    assert jnp.max(jnp.abs(gradient)) > 1e-2
    np.testing.assert_allclose(gradient, differences, atol=1e-6)


@pytest.mark.slow
def test_adjoints_agree():
    y0, args = random_problem(jr.key(0), 1, 2)
    terms = ds.hamiltonian_terms(H0, noise, weak_path(2))
    solve = lambda y0, adjoint: jnp.sum(
        diffrax.diffeqsolve(
            terms,
            ds.ImplicitMidpoint(),
            0.0,
            0.5,
            0.1,
            y0,
            args,
            adjoint=adjoint,
            max_steps=8,
        ).ys[0]
    )

    @jax.jit
    def derivatives(y0):
        tangent = jax.tree.map(jnp.ones_like, y0)
        forward = lambda y0: solve(y0, diffrax.ForwardMode())
        backward = [
            jnp.sum(jnp.stack(jax.grad(solve)(y0, adjoint)))
            for adjoint in (
                diffrax.DirectAdjoint(),
                diffrax.RecursiveCheckpointAdjoint(),
            )
        ]
        return jax.jvp(forward, (y0,), (tangent,))[1], backward

    expected, got = derivatives(y0)
    np.testing.assert_allclose(got, expected, rtol=1e-10)


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
    slow_except([OTHER_FINDERS[0], *OWN_FINDERS], [*OTHER_FINDERS, *OWN_FINDERS]),
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
    solver = dataclasses.replace(GENERAL["SRKw1-0.2"], **options)
    step = lambda y0, args: solver.step(terms, 0.0, 0.1, y0, args, None, False)[0]
    return jax.jit(step)(y0, args)


# A noise for which a step can be too large: q' = q^2 has no midpoint step once the
# increment exceeds 1 / (2 q).
def _explosive(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: 0.0, lambda t, p, q, args: p * q**2, path
    )


def test_parts_of_the_state_may_be_empty():
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: (p["x"] ** 2 + q["x"] ** 2) / 2,
        lambda t, p, q, args: q["x"],
        ds.WeakBrownianPath((), jr.key(0)),
    )
    half = {"x": jnp.array(1.0), "none": jnp.zeros(0)}
    solver = ds.ImplicitMidpoint()
    y1, *_, result = solver.step(terms, 0.0, 0.1, (half, half), None, None, False)
    assert result == diffrax.RESULTS.successful
    assert y1[0]["none"].shape == (0,) and jnp.isfinite(y1[0]["x"])


def test_unsolvable_stages_are_reported():
    path = ds.WeakBrownianPath((), jr.key(0))
    y0 = (jnp.array(0.1), jnp.array(10.0))
    solve = lambda **kwargs: diffrax.diffeqsolve(
        _explosive(path), ds.ImplicitMidpoint(), 0.0, 1.0, 0.1, y0, **kwargs,
        max_steps=None, adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    with pytest.raises(Exception, match="(?i)nonlinear solve"):
        jax.block_until_ready(solve())
    assert solve(throw=False).result != diffrax.RESULTS.successful


@pytest.mark.parametrize(
    "dtype", slow_except([jnp.float64], [jnp.float32, jnp.float64])
)
def test_failed_paths_do_not_spoil_their_neighbours(dtype):
    def solve(q, key):
        path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((), dtype), key)
        y0 = (dtype(0.1), q)
        return diffrax.diffeqsolve(
            _explosive(path),
            ds.ImplicitMidpoint(),
            dtype(0),
            dtype(1),
            dtype(0.1),
            y0,
            throw=False,
            max_steps=None,
            adjoint=diffrax.ForwardMode(),
        )

    q = jnp.array([0.1, 50.0, 0.2, jnp.nan], dtype)
    keys = jr.split(jr.key(0), 4)
    batch = jax.jit(jax.vmap(solve))(q, keys)
    solve = jax.jit(solve)
    success = batch.result == diffrax.RESULTS.successful
    np.testing.assert_array_equal(success, [True, False, True, False])
    for i in (0, 2):
        alone = solve(q[i], keys[i])
        for a, b in zip(batch.ys, alone.ys):
            np.testing.assert_allclose(a[i], b, rtol=4 * jnp.finfo(dtype).eps)
    # Nothing that is not a number goes unannounced.
    finite = jnp.isfinite(batch.ys[0][:, 0]) & jnp.isfinite(batch.ys[1][:, 0])
    assert jnp.all(finite | ~success)


def test_non_finite_hamiltonians_are_reported():
    solver = ds.ImplicitMidpoint()
    H0 = lambda t, p, q, args: args[0] * (q + p**2)
    noise = lambda t, p, q, args: jnp.sqrt(args[1] + q)
    terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    y0 = (jnp.array(0.1), jnp.array(-1.0))
    solve = lambda args, throw=False: diffrax.diffeqsolve(
        terms, solver, 0.0, 0.3, 0.1, y0, args, throw=throw, max_steps=None,
        adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    # The drift is not a number, the noise is not, and both are.
    args = jnp.array([[jnp.nan, 3.0], [1.0, 0.5], [1.0, 3.0]])
    success = jax.jit(jax.vmap(solve))(args).result == diffrax.RESULTS.successful
    np.testing.assert_array_equal(success, [False, False, True])
    with pytest.raises(Exception, match=r"(?i)non-?finite|nonlinear solve"):
        jax.block_until_ready(solve(args[1], throw=True))


@pytest.mark.parametrize(
    "solver, path",
    [
        ("ds.ImplicitMidpoint()", "cut"),
        pytest.param("ds.SRKw2()", "weak", marks=pytest.mark.slow),
    ],
)
def test_everything_works_in_single_precision_mode(solver, path):
    # In a process of its own: the tests run with 64-bit floats enabled.
    program = f"""
import diffrax, diffrax_symplectic as ds, jax, jax.numpy as jnp, jax.random as jr
H = lambda t, p, q, args: (p**2 + q**2) / 2
y0 = (jnp.array(0.0), jnp.array(1.0))
fixed = ds.FixedStepBrownianPath((), jr.key(0))
weak, cut = ds.WeakBrownianPath((), jr.key(0)), ds.TruncatedBrownianPath(fixed)
terms = ds.hamiltonian_terms(H, H, {path})
def momentum(y0):
    ys = diffrax.diffeqsolve(terms, {solver}, 0.0, 1.0, 0.01, y0).ys
    return jnp.sum(ys[0]), ys
grad, (p, q) = jax.jit(jax.grad(momentum, has_aux=True))(y0)
assert p.dtype == grad[0].dtype == jnp.float32
assert abs(p**2 + q**2 - 1) < 1e-5, (p, q)
assert all(jnp.isfinite(g) for g in grad)
"""
    # The examples, which other tests import, ask for double precision.
    single = os.environ | {"JAX_ENABLE_X64": "0"}
    subprocess.run([sys.executable, "-c", program], check=True, env=single)


def test_results_under_jit_and_vmap_are_those_without():
    y0, args = random_problem(jr.key(0), 1, 2)

    def solve(key):
        terms = ds.hamiltonian_terms(H0, noise, weak_path(2, key))
        options = dict(max_steps=None, adjoint=diffrax.ForwardMode())
        sol = diffrax.diffeqsolve(terms, ds.SRKs1(), 0.0, 0.5, 0.1, y0, args, **options)
        return sol.ys

    keys = jr.split(jr.key(0), 3)
    batch = eqx.filter_jit(jax.vmap(solve))(keys)
    for i, key in enumerate(keys):
        for a, b in zip(batch, solve(key)):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-13)


def test_a_batch_over_an_array_of_numpy_within_jit():
    terms = ds.hamiltonian_terms(H0, noise, weak_path(1))
    y0, args = random_problem(jr.key(0), 1, 1)

    def end(q):
        solver = ds.ImplicitMidpoint()
        return diffrax.diffeqsolve(terms, solver, 0, 0.2, 0.1, (y0[0], q), args).ys

    q = np.array([[0.1], [0.2]])
    batch = jax.jit(lambda: jax.vmap(end)(q))()
    same = ft.partial(np.testing.assert_allclose, rtol=1e-14)
    jax.tree.map(same, batch, jax.jit(jax.vmap(end))(jnp.asarray(q)))
