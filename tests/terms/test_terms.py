"""Terms from Hamiltonians: values, structures, derivatives, and use with Diffrax."""

import functools as ft

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..picard import by_picard
from ..problems import H0, noise, random_problem, weak_path


def test_terms_are_the_symplectic_gradients():
    H0 = lambda t, p, q, args: jnp.sum(p**2) * args + jnp.cos(t) * jnp.sum(p * q**2)
    noise = lambda t, p, q, args: jnp.stack([jnp.sum(q**3), args * jnp.sum(p * q)])
    drift, diffusion = ds.hamiltonian_terms(H0, noise, weak_path(2)).terms
    # One noise may be a scalar.
    _, single = ds.hamiltonian_terms(H0, H0, ()).terms
    p, q = np.array([0.3, -0.5]), np.array([0.2, 0.9])
    t = 0.4
    args = 1.7
    control = np.array([0.7, -1.1])

    @jax.jit
    def fields(p, q):
        at = t, (p, q), args
        vf = diffusion.vf(*at)
        products = diffusion.vf_prod(*at, control), diffusion.prod(vf, control)
        kicks = [single.vf_prod(*at, W) for W in (jnp.array(0.3), jnp.array([0.3]))]
        return drift.vf(*at), vf, products, kicks

    (f, g), (sigma, gamma), products, kicks = fields(p, q)
    same = ft.partial(np.testing.assert_allclose, rtol=1e-14)
    same(f, -np.cos(t) * 2 * p * q)
    same(g, 2 * args * p + np.cos(t) * q**2)
    same(sigma, np.stack([-3 * q**2, -args * p], 1))
    same(gamma, np.stack([0 * q, args * q], 1))
    for got in products:
        same(got, (sigma @ control, gamma @ control))
    for kick in kicks:
        same(kick, np.multiply((f, g), 0.3))


def test_state_and_noise_may_be_any_pytrees():
    shape = {
        "bath": jax.ShapeDtypeStruct((2,), jnp.float64),
        "drive": jax.ShapeDtypeStruct((), jnp.float64),
    }
    path = ds.WeakBrownianPath(shape, jr.key(0))

    def noise(t, p, q, args):
        x, (z,) = q["x"], q["rest"]
        return {"bath": jnp.stack([jnp.sum(x), p["rest"][0] * z]), "drive": z**2}

    def H0(t, p, q, args):
        squares = jax.tree.map(lambda a, b: jnp.sum(a**2 + b**4), p, q)
        return sum(jax.tree.leaves(squares))

    p = {"x": jnp.array([[0.1, 0.2]]), "rest": (jnp.array(0.3),)}
    q = {"x": jnp.array([[0.5, 0.4]]), "rest": (jnp.array(-0.6),)}
    terms = ds.hamiltonian_terms(H0, noise, path)
    _, diffusion = terms.terms
    control = {"bath": np.array([0.3, -0.2]), "drive": np.array(0.8)}

    @jax.jit
    def all_at_once(y):
        vf = diffusion.vf(0.0, y, None)
        products = diffusion.prod(vf, control), diffusion.vf_prod(0.0, y, None, control)
        solver = by_picard(ds.ImplicitMidpoint())
        return vf, products, ds.symplecticity_defect(terms, solver, 0.0, 0.1, y)

    vf, products, defect = all_at_once((p, q))
    assert vf[0]["x"].shape == (1, 2, 3)
    jax.tree.map(ft.partial(np.testing.assert_allclose, atol=1e-15), *products)
    assert defect < 1e-14


def test_the_same_equation_in_other_terms_has_the_same_step():
    # It treats drift and noise differently, and so tells them apart.
    solver = by_picard(ds.StrangGauss())
    y0, args = random_problem(jr.key(0), 2, 2)
    path = weak_path(2)
    drift, diffusion = ds.hamiltonian_terms(H0, noise, path).terms
    friction = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], jnp.zeros(2)))
    both = lambda t, y, args: jax.tree.map(
        jnp.add, drift.vf(t, y, args), friction.vf(t, y, args)
    )
    # The same vector fields on one array for the whole state.
    on_array = lambda vf: (
        lambda t, y, args: jnp.concatenate(vf(t, (y[:2], y[2:]), args))
    )
    noises = on_array(diffusion.vf)

    class OneNoise(diffrax.AbstractPath):
        k: int
        t0 = 0
        t1 = 1

        def evaluate(self, t0, t1=None, left=True):
            return path.evaluate(t0, t1)[self.k]

    def one(k):
        return diffrax.ControlTerm(
            lambda t, y, args: noises(t, y, args)[:, k], OneNoise(k)
        )

    plain = diffrax.ODETerm(on_array(both))
    nested = diffrax.MultiTerm(friction, diffrax.MultiTerm(drift))
    whole = diffrax.ODETerm(both)
    of_pairs = (whole, diffusion), (diffusion, nested)
    of_arrays = (plain, diffrax.ControlTerm(noises, path)), (plain, one(0), one(1))

    def step(terms, y0):
        y1, *_ = solver.step(diffrax.MultiTerm(*terms), 0.0, 0.1, y0, args, None, False)
        return jfu.ravel_pytree(y1)[0]

    @jax.jit
    def steps(y0):
        flat = jnp.concatenate(y0)
        return [step(x, y0) for x in of_pairs] + [step(x, flat) for x in of_arrays]

    expected, *others = steps(y0)
    for got in others:
        np.testing.assert_allclose(got, expected, atol=1e-14)
    # Of one noise the weak order is two, which is seen in terms of any order, too.
    single = ds.hamiltonian_terms(H0, noise, weak_path(1)).terms[1]
    assert solver.weak_order(diffrax.MultiTerm(single, nested)) == 2


def test_without_noise_terms_are_the_drift():
    H0 = lambda t, p, q, args: jnp.sum(p**2 * q**2)
    of_last = lambda t, x, args: jnp.sum(jnp.abs(x[..., -1]) ** 2)
    y = tuple(np.random.default_rng(0).normal(size=(2, 2)))
    makers = [(ds.hamiltonian_terms, H0)]
    for make in (ds.spin_terms, ds.wave_terms):
        makers += [(make, of_last), (ft.partial(make, damping=0.1), of_last)]
    both = [(make(H), make(H, H, weak_path(1))) for make, H in makers]
    assert all(len(alone.terms) == 1 for alone, _ in both)
    field = lambda y, terms: terms.terms[0].vf(0.0, y, None)
    fields = jax.jit(lambda y: [[field(y, x) for x in pair] for pair in both])(y)
    for pair in fields:
        np.testing.assert_array_equal(*pair)


def test_a_hamiltonian_that_changes_its_args_changes_a_copy():
    def doubles(t, p, q, args):
        args["k"] = 2 * args["k"]
        return (p**2 + args["k"] * q**2) / 2

    plain = lambda t, p, q, args: (p**2 + 2 * args["k"] * q**2) / 2
    args, y0 = {"k": jnp.array(1.5)}, (jnp.array(0.0), jnp.array(1.0))

    def fields(H):
        terms = ds.hamiltonian_terms(H, H, weak_path(1)).terms
        return [term.vf(0.0, y0, args) for term in terms]

    both = jax.jit(lambda: (fields(doubles), fields(plain)))()
    jax.tree.map(np.testing.assert_array_equal, *both)
    assert args == {"k": 1.5}


def test_integer_times_are_times():
    moving = lambda t, p, q, args: jnp.sum(p**2 / 2 + jnp.cos(3 * t) * q)
    terms = ds.hamiltonian_terms(moving, lambda t, p, q, args: -q, weak_path(1))
    y0 = jnp.array([0.2]), jnp.array([1.0])
    mean = lambda t0, t1: ds.step_expectation(
        terms, ds.StormerVerlet(), t0, t1, y0, fn=lambda t, y, args: jnp.stack(y)
    )
    means = jax.jit(lambda: (mean(0, 1), mean(0.0, 1.0)))()
    np.testing.assert_allclose(*means, rtol=1e-14)


def test_a_shape_stands_for_the_path_that_the_solver_needs():
    H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
    noise = lambda t, p, q, args: {"a": 0.1 * jnp.sin(q) * jnp.ones(2)}
    shape, y0 = {"a": jax.ShapeDtypeStruct((2,), float)}, (jnp.zeros(()), jnp.ones(()))
    terms = ds.hamiltonian_terms(H0, noise, shape)
    for want in ("weak", "strong"):
        best = ds.suggest_solver(terms, 0.0, y0, want=want)[0]
        path = best.solver.path(shape, jr.key(1), want=want)
        assert eqx.tree_equal(best.terms(jr.key(1)).terms[1].path, path)
    for solver in (ds.StormerVerlet(), diffrax.Heun()):
        with pytest.raises(ValueError, match=r"pass `path=solver.path\(shape, key\)`"):
            diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.5, y0)
    for path in (3, "path", (1.5,)):
        with pytest.raises(ValueError, match="shape"):
            ds.hamiltonian_terms(H0, noise, path)
