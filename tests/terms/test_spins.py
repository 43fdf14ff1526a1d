"""Spins and rigid bodies: the pair (p, q) stands for s, and each step is a Poisson map."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..picard import by_picard
from ..problems import Given, rigid_body_terms, weak_path


def _args(spins):
    """Random coefficients of the functions below."""
    rng = np.random.default_rng(spins)

    def coefficients(shape, size):
        u = rng.normal(size=(*shape, 3 * spins)) / np.sqrt(spins)
        return size * rng.normal(size=shape), u, rng.uniform(0, 2 * np.pi, shape)

    return {"drift": coefficients((4,), 0.5), "noise": coefficients((3, 4), 0.2)}


def H0(t, s, args):
    """`sum_j a_j cos(u_j . s + phi_j)` of all components: smooth, and no structure."""
    a, u, phi = args["drift"]
    return jnp.sum(a * jnp.cos(u @ s.ravel() + phi + t))


def noise(t, s, args):
    a, u, phi = args["noise"]
    return jnp.sum(a * jnp.cos(u @ s.ravel() + phi - t), axis=-1)


POLES = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
EQUATOR = np.array([[1.0, 0.0, 0.0], [-0.6, 0.8, -0.0], [0.3, -0.4, 1e-300]])


def test_solutions_push_forward_to_the_equation_of_spins_and_of_landau_and_lifshitz():
    # On a lattice of eight times five spins.
    rng, args = np.random.default_rng(0), _args(40)
    s = np.concatenate([rng.normal(size=(35, 3)), POLES, EQUATOR]).reshape(8, 5, 3)
    each = rng.uniform(size=(8, 5))
    dampings = [None, each, 0.3]
    W = jnp.array([0.3, -0.7, 0.4])
    of = lambda damping: ds.spin_terms(H0, noise, weak_path(3), damping).terms

    @jax.jit
    def both_sides(s):
        y = ds.to_spinors(s)
        push = lambda dy: jax.jvp(ds.from_spinors, (y,), (dy,))[1]
        drifts = [push(of(x)[0].vf(0.4, y, args)) for x in dampings]
        kick = push(of(None)[1].vf_prod(0.4, y, args, W))
        gradient = jax.grad(lambda s: H0(0.4, s, args))(s)
        field = jax.grad(lambda s: noise(0.4, s, args) @ W)(s)
        return drifts, kick, gradient, field

    drifts, kick, gradient, field = both_sides(s)
    np.testing.assert_allclose(kick, np.cross(s, field), atol=1e-14)
    turn = np.cross(s, gradient)
    assert np.max(np.abs(kick)) > 0.1 and np.max(np.abs(turn)) > 0.1
    for damping, velocity in zip(dampings, drifts):
        rate = np.multiply(0 if damping is None else damping, np.ones((8, 5)))
        expected = turn + rate[..., None] * np.cross(s, turn)
        np.testing.assert_allclose(velocity, expected, atol=1e-14)
    # The damping takes the precision of the spins.
    short, args = jax.tree.map(np.float32, (s, args))
    velocity = lambda s: of(each)[0].vf(jnp.float32(0.4), ds.to_spinors(s), args)
    assert {x.dtype.name for x in jax.eval_shape(velocity, short)} == {"float32"}


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_spinors_of_spins_give_them_back_with_their_derivatives_everywhere(dtype):
    eps = jnp.finfo(dtype).eps
    s = np.random.default_rng(0).normal(size=(100, 3))
    s = np.concatenate([s, POLES, EQUATOR])
    # And where squares leave the range of the numbers.
    extreme = float(jnp.finfo(dtype).max) ** 0.7
    moderate = len(s)
    s = np.concatenate([s, s * extreme, s / extreme]).astype(dtype)
    identity = lambda s: ds.from_spinors(ds.to_spinors(s))
    backward = jax.jacrev(identity)

    @jax.jit
    @jax.vmap
    def of_each(s):
        twice = jax.jacfwd(lambda s: (backward(s), backward(s)), has_aux=True)
        return ds.to_spinors(s), identity(s), jax.jacfwd(identity)(s), twice(s)

    found = jax.tree.map(np.asarray, of_each(s))
    (p, q), again, forward, (hessian, by_reverse) = found
    assert p.shape == q.shape == s.shape[:-1] + (2,) and p.dtype == q.dtype == dtype
    largest = np.max(np.abs(s), axis=-1)
    length = np.linalg.norm(s / largest[:, None], axis=-1) * largest
    assert np.max(np.abs(again - s) / length[:, None]) <= 4 * eps
    np.testing.assert_allclose(np.sum(p**2 + q**2, axis=-1) / 4, length, rtol=8 * eps)
    for jacobian in (forward, by_reverse):
        assert np.max(np.abs(jacobian - np.eye(3))) <= 8 * eps
    # The second derivative, at moderate lengths.
    sizes = np.abs(hessian[:moderate]) * length[:moderate, None, None, None]
    assert np.max(sizes) <= 32 * eps


def test_a_step_is_a_poisson_map_and_one_for_the_spins_themselves_is_none():
    # A symplectic step for (p, q) is a Poisson map for s, whatever the solver, and every
    # solver has a test that its steps are symplectic.
    solver, args = by_picard(ds.ImplicitMidpoint()), _args(1)
    rng = np.random.default_rng(0)
    s0 = 0.7 * rng.normal(size=(1000, 1, 3))
    # Uniform in the logarithm over [1e-3, 0.2].
    h = np.exp(rng.uniform(np.log(1e-3), np.log(0.2), 1000))
    W = np.sqrt(h)[:, None] * np.clip(rng.normal(size=(1000, 3)), -2.5, 2.5)

    @jax.jit
    @jax.vmap
    def defect(s0, h, W):
        at = ds.spin_terms(H0, noise, Given(W)), solver, 0.0, h
        return ds.poisson_defect(*at, ds.to_spinors(s0), args)

    assert jnp.max(defect(s0, h, W)) <= 1e-13
    # The midpoint rule keeps |s| there, but not the bracket.
    at = rigid_body_terms(Given(jnp.array(0.1))), solver, 0.0, 0.2
    other = jax.jit(lambda s0: ds.poisson_defect(*at, s0))(np.array([0.6, 0.0, 0.8]))
    assert 1e-4 < other < 1e-2


def test_a_step_keeps_lengths_in_single_precision_and_does_not_see_the_phase():
    dtype, eps = np.float32, np.finfo(np.float32).eps
    H0 = lambda t, s, args: -jnp.sum(s[1:] * s[:-1])
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((4, 3), dtype), jr.key(0))
    terms = ds.spin_terms(H0, lambda t, s, args: 0.3 * s, path)

    solver = ds.ImplicitMidpoint(root_finder=ds.PicardNewton(newton_steps=0))

    @jax.jit
    def step(y0):
        at = terms, jnp.zeros((), dtype), jnp.ones((), dtype), y0, None, None, False
        return ds.from_spinors(solver.step(*at)[0])

    s0 = np.array(
        [[0.6, 0.0, 0.8], [0, 0, -1], [-1.2, 0.1, 0.3], [0.2, 0.4, -0.5]], dtype
    )
    p, q = map(np.asarray, jax.jit(ds.to_spinors)(s0))
    # Another phase for each spin.
    phase = 2 * np.pi * np.random.default_rng(1).random((4, 1))
    c, s = np.cos(phase).astype(dtype), np.sin(phase).astype(dtype)
    s1, again = step((p, q)), step((c * p + s * q, c * q - s * p))
    assert s1.dtype == dtype
    assert np.max(np.linalg.norm(s1 - s0, axis=-1)) > 0.1
    lengths = [np.linalg.norm(s, axis=-1) for s in (s0, s1)]
    np.testing.assert_allclose(*lengths, rtol=16 * eps)
    np.testing.assert_allclose(again, s1, atol=32 * eps)


def test_what_are_no_spins_is_refused():
    s = jnp.ones((5, 3))
    for wrong in (jnp.ones((3, 5)), 1.0, None, (s, s), s.astype(complex)):
        with pytest.raises(ValueError, match=r"real array `s` of shape `\(..., 3\)`"):
            ds.to_spinors(wrong)
    for wrong in ((s, s), (jnp.array(1.0),) * 2, ({"s": s}, {"s": s})):
        with pytest.raises(ValueError, match=r"pass `y0=to_spinors\(s0\)`"):
            ds.from_spinors(wrong)
    path = weak_path(3)
    terms = ds.spin_terms(H0, noise, path)
    for y0, says in (
        (s, r"for spins `y0=to_spinors"),
        ((s, s), r"pass `y0=to_spinors"),
    ):
        with pytest.raises(ValueError, match=says):
            diffrax.diffeqsolve(terms, ds.ImplicitMidpoint(), 0, 1, 0.1, y0)
    with pytest.raises(ValueError, match="real array `s`"):
        ds.poisson_defect(terms, ds.ImplicitMidpoint(), 0.0, 0.1, jnp.ones(4))
    for to_spinors in (ds.to_spinors, jax.jit(jax.vmap(ds.to_spinors))):
        with pytest.raises(Exception, match="of nonzero length"):
            jax.block_until_ready(to_spinors(np.array([[1.0, 0, 0], [0, 0, 0]])))
    # Hamiltonians that do not fit.
    with pytest.raises(ValueError, match=r"must be a function, called as `H0\(t, s"):
        ds.spin_terms(1.0, noise, path)
    each = lambda t, s, args: s
    y0 = np.ones(2), np.ones(2)
    for damping in (None, 1.0):
        with pytest.raises(ValueError, match="`H0` must return a scalar"):
            ds.spin_terms(each, each, path, damping).terms[0].vf(0.0, y0, None)
    with pytest.raises(ValueError, match="one Hamiltonian for each noise of the path"):
        ds.spin_terms(H0, each, weak_path(2)).terms[1].vf(0.0, y0, None)


def test_a_field_on_each_of_many_spins_costs_one_reverse_pass():
    n = 1024
    path = ds.WeakBrownianPath((n, 3), jr.key(0))
    terms = ds.spin_terms(lambda t, s, args: 0.0, lambda t, s, args: s, path)
    y0 = ds.to_spinors(jnp.ones((n, 3)))
    noise = terms.terms[1]
    increment = jax.eval_shape(lambda: noise.contr(0.0, 0.1))
    evaluate = lambda y, W: noise.vf_prod(0.0, y, None, W)
    shapes = eqx.filter_make_jaxpr(evaluate)(y0, increment)[0].jaxpr.eqns
    largest = max(v.aval.size for eqn in shapes for v in eqn.outvars)
    assert largest <= 4 * n


def test_dampings_that_are_none_are_refused():
    path = weak_path(3)
    array = jnp.array([0.1, -0.1])
    for wrong in (-0.1, jnp.nan, jnp.inf, 1j, "much", array, array > -1, 1j * array):
        with pytest.raises(ValueError, match="`damping` must be a number"):
            ds.spin_terms(H0, noise, path, damping=wrong)  # pyright: ignore
    y0, args = (np.ones((2, 2)), np.ones((2, 2))), _args(2)
    for shape in ((3,), (1,), (2, 1)):
        terms = ds.spin_terms(H0, noise, path, damping=jnp.ones(shape))
        with pytest.raises(ValueError, match=r"one for each spin, of shape \(2,\)"):
            terms.terms[0].vf(0.0, y0, args)
    for solver in (ds.StormerVerlet(), ds.SRKw5(), ds.BAOAB()):
        damped = ds.spin_terms(H0, noise, path, damping=1.0)
        with pytest.raises(ValueError, match="use a solver for general systems"):
            solver.init(damped, 0.0, 0.1, y0, args)

    @jax.jit
    @jax.vmap
    def run(alpha):
        terms = ds.spin_terms(H0, noise, path, damping=alpha)
        at = terms, 0.0, 0.1, y0, args, None, False
        solver = by_picard(ds.ImplicitMidpoint())
        return solver.step(*at)[-1] == diffrax.RESULTS.successful

    np.testing.assert_array_equal(
        run(jnp.array([0.5, -0.5, jnp.nan, jnp.inf])), [True, False, False, False]
    )
