"""Spins and rigid bodies: the pair (p, q) stands for s, and each step is a Poisson map."""

import functools as ft

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


def H0(t, s, args):
    """`sum_j a_j cos(u_j . s + phi_j)` of all components: smooth, and no structure."""
    a, u, phi = args["drift"]
    return jnp.sum(a * jnp.cos(u @ s.ravel() + phi + t))


def noise(t, s, args):
    a, u, phi = args["noise"]
    return jnp.sum(a * jnp.cos(u @ s.ravel() + phi - t), axis=-1)


@ft.partial(jax.jit, static_argnums=(1, 2, 3))
def _problem(key, spins: int, m: int, dtype=jnp.float64):
    """Random spins of lengths from 1/2 to 2, some at a pole, and random `args`."""
    k_s, k_length, k_pole, kd, kn = jr.split(key, 5)
    s = jr.normal(k_s, (spins, 3), dtype)
    pole = jr.randint(k_pole, (spins, 1), 0, 8)
    s = jnp.where(pole == 0, jnp.array([0, 0, 1], dtype), s)
    s = jnp.where(pole == 1, jnp.array([0, 0, -1], dtype), s)
    length = 2 ** jr.uniform(k_length, (spins, 1), dtype, -1, 1)
    s = length * s / jnp.linalg.norm(s, axis=-1, keepdims=True)

    def coefficients(key, shape, size):
        ka, ku, kphi = jr.split(key, 3)
        u = jr.normal(ku, (*shape, 3 * spins), dtype) / np.sqrt(spins)
        phase = jr.uniform(kphi, shape, dtype, 0, 2 * np.pi)
        return size * jr.normal(ka, shape, dtype), u, phase

    args = {
        "drift": coefficients(kd, (4,), 0.5),
        "noise": coefficients(kn, (m, 4), 0.2),
    }
    return s, args


POLES = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
EQUATOR = np.array([[1.0, 0.0, 0.0], [-0.6, 0.8, -0.0], [0.3, -0.4, 1e-300]])


def test_solutions_push_forward_to_the_equation_of_spins():
    s, args = _problem(jr.key(0), 40, 3)
    s = np.concatenate([s[:-5], POLES, EQUATOR])
    W = jnp.array([0.3, -0.7, 0.4])
    drift, diffusion = ds.spin_terms(H0, noise, weak_path(3)).terms

    @jax.jit
    def both_sides(s):
        y = ds.to_spinors(s)
        velocity = lambda dy: jax.jvp(ds.from_spinors, (y,), (dy,))[1]
        return [
            (velocity(dy), jnp.cross(s, jax.grad(H)(s)))
            for dy, H in (
                (drift.vf(0.4, y, args), lambda s: H0(0.4, s, args)),
                (diffusion.vf_prod(0.4, y, args, W), lambda s: noise(0.4, s, args) @ W),
            )
        ]

    for velocity, expected in both_sides(s):
        np.testing.assert_allclose(velocity, expected, atol=1e-14)
        assert np.max(np.abs(expected)) > 0.1


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_spinors_of_spins_give_them_back_with_their_derivatives_everywhere(dtype):
    eps = jnp.finfo(dtype).eps
    s = np.concatenate([_problem(jr.key(0), 100, 1)[0], POLES, EQUATOR])
    # And where squares leave the range of the numbers.
    extreme = float(jnp.finfo(dtype).max) ** 0.7
    s = np.concatenate([s, s * extreme, s / extreme]).astype(dtype)
    p, q = map(np.asarray, jax.jit(ds.to_spinors)(s))
    assert p.shape == q.shape == s.shape[:-1] + (2,) and p.dtype == q.dtype == dtype
    largest = np.max(np.abs(s), axis=-1)
    length = np.linalg.norm(s / largest[:, None], axis=-1) * largest
    again = jax.jit(ds.from_spinors)((p, q))
    assert np.max(np.abs(again - s) / length[:, None]) <= 4 * eps
    np.testing.assert_allclose(np.sum(p**2 + q**2, axis=-1) / 4, length, rtol=8 * eps)

    identity = lambda s: ds.from_spinors(ds.to_spinors(s))
    backward, forward = jax.jacrev(identity), jax.jacfwd(identity)
    both = lambda s: (backward(s), forward(s), jax.jacfwd(backward)(s))
    *jacobians, hessian = map(np.asarray, jax.jit(jax.vmap(both))(s))
    assert np.max(np.abs(np.stack(jacobians) - np.eye(3))) <= 8 * eps
    # The second derivative, at moderate lengths.
    sizes = np.abs(hessian[:105]) * length[:105, None, None, None]
    assert np.max(sizes) <= 32 * eps


@pytest.mark.slow
def test_step_is_a_poisson_map_for_a_thousand_random_systems():
    # A symplectic step for (p, q) is a Poisson map for s, whatever the solver, and every
    # solver has a test that its steps are symplectic.
    @jax.jit
    @jax.vmap
    def defect(key):
        k_problem, k_h, k_W = jr.split(key, 3)
        s0, args = _problem(k_problem, 2, 3)
        # Uniform in the logarithm over [1e-3, 0.2].
        h = jnp.exp(jr.uniform(k_h, (), float, jnp.log(1e-3), jnp.log(0.2)))
        W = jnp.sqrt(h) * jnp.clip(jr.normal(k_W, (3,)), -2.5, 2.5)
        solver = by_picard(ds.ImplicitMidpoint())
        at = ds.spin_terms(H0, noise, Given(W)), solver, 0.0, h
        return ds.poisson_defect(*at, ds.to_spinors(s0), args)

    assert jnp.max(defect(jr.split(jr.key(0), 1000))) <= 1e-13


def test_poisson_defect_sees_a_method_for_the_spins_themselves():
    # The midpoint rule keeps |s| there, but not the bracket.
    terms = rigid_body_terms(Given(jnp.array(0.1)))
    at = terms, by_picard(ds.ImplicitMidpoint()), 0.0, 0.2
    defect = jax.jit(lambda s0: ds.poisson_defect(*at, s0))(np.array([0.6, 0.0, 0.8]))
    assert 1e-4 < defect < 1e-2


def test_noises_of_spins_may_be_indexed():
    s0, args = _problem(jr.key(0), 2, 3)
    indexed = ds.IndexedNoise(lambda k, t, s, args: noise(t, s, args)[k], 3)
    both = [ds.spin_terms(H0, x, weak_path(3)) for x in (noise, indexed)]
    field = lambda s, terms: terms.terms[1].vf(0.4, ds.to_spinors(s), args)
    fields = jax.jit(lambda s: [field(s, terms) for terms in both])(s0)
    np.testing.assert_allclose(*fields, atol=1e-15)


def test_a_step_keeps_lengths_in_single_precision_and_does_not_see_the_phase():
    dtype, eps = np.float32, np.finfo(np.float32).eps
    H0 = lambda t, s, args: -jnp.sum(s[1:] * s[:-1])
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((4, 3), dtype), jr.key(0))
    terms = ds.spin_terms(H0, lambda t, s, args: 0.3 * s, path)

    @jax.jit
    def step(y0):
        at = terms, jnp.zeros((), dtype), jnp.ones((), dtype), y0, None, None, False
        return ds.from_spinors(ds.ImplicitMidpoint().step(*at)[0])

    s0 = _problem(jr.key(0), 4, 1, jnp.float32)[0]
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
    terms = ds.spin_terms(H0, noise, weak_path(3))
    step = lambda y0: diffrax.diffeqsolve(terms, ds.ImplicitMidpoint(), 0, 1, 0.1, y0)
    with pytest.raises(ValueError, match=r"for spins `y0=to_spinors\(s0\)`"):
        step(s)
    with pytest.raises(ValueError, match=r"pass `y0=to_spinors\(s0\)`"):
        step((s, s))
    with pytest.raises(ValueError, match="real array `s`"):
        ds.poisson_defect(terms, ds.ImplicitMidpoint(), 0.0, 0.1, jnp.ones(4))


def test_spins_of_length_zero_are_refused_traced_or_not():
    s = jnp.ones((2, 3)).at[1].set(0.0)
    jitted = jax.jit(ds.to_spinors)
    for to_spinors in (ds.to_spinors, jitted, jax.vmap(jitted)):
        with pytest.raises(Exception, match="of nonzero length"):
            jax.block_until_ready(to_spinors(s))


def test_hamiltonians_that_do_not_fit_are_refused():
    y0 = ds.to_spinors(jnp.ones(3))
    path = weak_path(2)
    with pytest.raises(
        ValueError, match=r"`H0` must be a function, called as `H0\(t, s"
    ):
        ds.spin_terms(1.0, noise, path)
    with pytest.raises(ValueError, match="must be a Brownian path"):
        ds.spin_terms(H0, noise, None)
    each = lambda t, s, args: s
    with pytest.raises(ValueError, match="`H0` must return a scalar"):
        ds.spin_terms(each, each, path).terms[0].vf(0.0, y0, None)
    with pytest.raises(ValueError, match="one Hamiltonian for each noise of the path"):
        ds.spin_terms(H0, each, path).terms[1].vf(0.0, y0, None)


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


def test_with_damping_solutions_push_forward_to_the_landau_lifshitz_equation():
    s, args = _problem(jr.key(0), 40, 3)
    dampings = jr.uniform(jr.key(1), (40,)), 0.3, 0.0

    @jax.jit
    def gradient_and_velocities(s):
        y = ds.to_spinors(s)
        push = lambda vf: jax.jvp(ds.from_spinors, (y,), (vf,))[1]
        terms = [ds.spin_terms(H0, noise, weak_path(3), x) for x in dampings]
        velocities = [push(x.terms[0].vf(0.4, y, args)) for x in terms]
        return jax.grad(lambda s: H0(0.4, s, args))(s), velocities

    gradient, velocities = jax.tree.map(np.asarray, gradient_and_velocities(s))
    turn = np.cross(s, gradient)
    for damping, velocity in zip(dampings, velocities):
        rate = np.reshape(np.broadcast_to(damping, 40), (40, 1))
        expected = turn + rate * np.cross(s, turn)
        np.testing.assert_allclose(velocity, expected, atol=1e-14)
        # The energy falls at this rate.
        power = np.sum(gradient * velocity)
        lost = np.sum(rate * turn**2)
        np.testing.assert_allclose(power, -lost, rtol=1e-12, atol=1e-15)


def test_dampings_fit_lattices_of_spins_and_take_their_precision():
    s, args = _problem(jr.key(0), 6, 3, jnp.float32)
    alpha = np.linspace(0.0, 1.0, 6)

    def velocity(s, *lattice):
        y = ds.to_spinors(s.reshape(*lattice, 3))
        terms = ds.spin_terms(H0, noise, weak_path(3), alpha.reshape(lattice))
        return terms.terms[0].vf(jnp.float32(0.4), y, args)

    both = jax.jit(lambda s: (velocity(s, 6), velocity(s, 2, 3)))
    for flat, shaped in zip(*both(s)):
        assert shaped.dtype == jnp.float32
        np.testing.assert_array_equal(shaped.reshape(6, 2), flat)


# The last makes vector fields of brackets. Quick tests of waves know that spins are pairs
# of amplitudes, and that steps keep the length of these.
@pytest.mark.parametrize("solver", [ds.ImplicitMidpoint(), ds.PlateauGauss()], ids=repr)
@pytest.mark.slow
def test_with_damping_length_is_kept_for_a_thousand_random_systems(solver):
    def change(key):
        k_problem, k_h, k_W, k_alpha = jr.split(key, 4)
        s0, args = _problem(k_problem, 2, 3)
        h = jnp.exp(jr.uniform(k_h, (), float, jnp.log(1e-3), jnp.log(0.2)))
        W = jnp.sqrt(h) * jnp.clip(jr.normal(k_W, (3,)), -2.5, 2.5)
        given, alpha = Given(W, H=W[::-1] / 4), jr.uniform(k_alpha, (2,))
        terms = ds.spin_terms(H0, noise, given, damping=alpha)
        y0 = ds.to_spinors(s0)
        y1, *_ = by_picard(solver).step(terms, 0.0, h, y0, args, None, False)
        before, after = (jnp.linalg.norm(ds.from_spinors(y), axis=-1) for y in (y0, y1))
        return jnp.max(jnp.abs(after / before - 1))

    changes = jax.jit(jax.vmap(change))(jr.split(jr.key(0), 1000))
    assert jnp.max(changes) <= 1e-13


def test_dampings_that_are_none_are_refused():
    path = weak_path(3)
    array = jnp.array([0.1, -0.1])
    for wrong in (-0.1, jnp.nan, jnp.inf, 1j, "much", array, array > -1, 1j * array):
        with pytest.raises(ValueError, match="`damping` must be a number"):
            ds.spin_terms(H0, noise, path, damping=wrong)  # pyright: ignore
    # One that has been used above.
    s, args = _problem(jr.key(0), 2, 3)
    y0 = jax.jit(ds.to_spinors)(s)
    for shape in ((3,), (1,), (2, 1)):
        terms = ds.spin_terms(H0, noise, path, damping=jnp.ones(shape))
        with pytest.raises(ValueError, match=r"one for each spin, of shape \(2,\)"):
            terms.terms[0].vf(0.0, y0, args)
    each = ds.spin_terms(lambda t, s, args: s, noise, path, damping=1.0)
    with pytest.raises(ValueError, match="`H0` must return a scalar"):
        each.terms[0].vf(0.0, y0, args)
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
