"""Friction and temperature as terms: every solver sees them, in every form."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._terms import semidefinite_root

from ..problems import as_friction, Given, weak_path


TENSOR = jnp.array([[1.0, 0.3, 0.0], [0.3, 0.5, -0.2], [0.0, -0.2, 0.7]])
MASSES = jnp.array([1.0, 4.0, 0.5])
T = 0.6


def _pendula(t, p, q, args):
    return jnp.sum(p**2 / MASSES) / 2 + jnp.sum(jnp.sin(q)) * jnp.cos(t) + jnp.prod(q)


def _at(q):
    return 1 + q**2


# Each with what it is at a position, as a matrix.
FRICTIONS = {
    "number": (0.7, lambda q: 0.7 * np.eye(3)),
    "each": (jnp.array([0.4, 0.0, 2.0]), lambda q: np.diag([0.4, 0.0, 2.0])),
    "matrix": (as_friction(TENSOR), lambda q: TENSOR),
    "number at q": (lambda t, q, args: _at(q[0]), lambda q: _at(q[0]) * np.eye(3)),
    "each at q": (lambda t, q, args: _at(q), lambda q: np.diag(_at(q))),
    "matrix at q": (
        lambda t, q, args: as_friction(_at(q[0]) * TENSOR),
        lambda q: _at(q[0]) * TENSOR,
    ),
    "along": (
        ds.FrictionAlong(jnp.array([[1.0, 0.0], [-1.0, 2.0], [0.0, -2.0]])),
        lambda q: np.array([[1.0, -1.0, 0.0], [-1.0, 5.0, -4.0], [0.0, -4.0, 4.0]]),
    ),
    "along at q": (
        ds.FrictionAlong(lambda t, q, args: q[:, None] * jnp.ones(2)),
        lambda q: 2 * np.outer(q, q),
    ),
}


def test_drift_and_noise_are_those_of_the_equation():
    numbers = {name: 2 if "along" in name else 3 for name in FRICTIONS}
    controls = {name: np.arange(1.0, m + 1) for name, m in numbers.items()}
    made = {
        name: (
            ds.langevin_terms(_pendula, friction, T, (numbers[name],)).terms,
            ds.bath_terms(_pendula, friction, T, (numbers[name],)).terms,
        )
        for name, (friction, _) in FRICTIONS.items()
    }
    assert all(type(of[1]) is type(of_bath[1]) for of, of_bath in made.values())

    @jax.jit
    def fields(p, q):
        at = 0.3, (p, q), None

        def of_each(name):
            (drift, noise), (alone, _) = made[name]
            kick = noise.vf_prod(*at, controls[name])
            return alone.vf(*at), drift.vf(*at), noise.vf(*at), kick

        return ds.hamiltonian_terms(_pendula).terms[0].vf(*at), {
            name: of_each(name) for name in made
        }

    p, q = np.random.default_rng(0).normal(size=(2, 3))
    (forces, velocities), results = jax.tree.map(np.asarray, fields(p, q))
    for name, ((dp, dq), both, (B, still), kick) in results.items():
        G = FRICTIONS[name][1](q)
        np.testing.assert_allclose(dp, -G @ (p / MASSES), rtol=1e-14)
        np.testing.assert_array_equal(dq, 0)
        np.testing.assert_allclose(both, (forces + dp, velocities), rtol=1e-14)
        np.testing.assert_allclose(B @ B.T, 2 * T * G, atol=1e-14)
        np.testing.assert_array_equal(still, 0)
        np.testing.assert_allclose(kick, (B @ controls[name], 0 * q), atol=1e-14)


def test_momenta_in_trees_have_frictions_and_temperatures_in_trees():
    H0 = lambda t, p, q, args: jnp.sum(p["a"] ** 2) / 4 + p["b"] ** 2 / 2
    shape = jax.eval_shape(lambda: {"a": jnp.ones(3), "b": jnp.ones(())})
    p = {"a": np.arange(3.0), "b": np.array(2.0)}

    def fields(*terms):
        evaluate = jax.jit(lambda y: [term.vf(0.0, y, None)[0] for term in terms])
        return jax.tree.map(np.asarray, evaluate((p, p)))

    for friction, heat, forces, squares in (
        (0.5, T, (-0.25 * p["a"], -1.0), (T * np.eye(3), T)),
        ({"a": jnp.arange(3.0), "b": 3.0}, T, (-np.arange(3.0) * p["a"] / 2, -6),
         (2 * T * np.diag(np.arange(3.0)), 6 * T)),
        (0.5, {"a": jnp.arange(3.0), "b": 0.0}, (-0.25 * p["a"], -1.0),
         (np.diag([0.0, 1.0, 2.0]), 0.0)),
    ):  # fmt: skip
        dp, B = fields(*ds.bath_terms(H0, friction, heat, shape).terms)
        np.testing.assert_allclose(dp["a"], forces[0])
        np.testing.assert_allclose(dp["b"], forces[1])
        np.testing.assert_allclose(B["a"] @ B["a"].T, squares[0], atol=1e-14)
        np.testing.assert_allclose(B["b"] @ B["b"], squares[1])
    # Directions couple the arrays of a tree, and conserve the total momentum.
    along = {"a": jnp.ones((3, 1)), "b": -3 * jnp.ones(1)}
    force, _ = ds.bath_terms(H0, ds.FrictionAlong(along), T, (1,)).terms
    (dp,) = fields(force)
    # The velocities 0, 0.5, 1 and 2.
    np.testing.assert_allclose([*dp["a"], dp["b"]], 4.5 * np.array([1, 1, 1, -3]))
    with pytest.raises(ValueError, match="besides friction"):
        ds.BAOAB().init(force, 0.0, 0.1, (p, p), None)


# Lengths and ranks of the factors of semidefinite matrices.
@pytest.mark.parametrize("n, rank", [(8, 8), (20, 7)])
def test_roots_of_semidefinite_matrices_are_roots(n, rank):
    # In single precision, too, and with entries of very different size.
    X = jr.normal(jr.key(n), (n, rank)) * jnp.logspace(0, -6, n)[:, None]
    for dtype in (jnp.float64, jnp.float32):
        A = (X @ X.T).astype(dtype)
        L = np.asarray(semidefinite_root(A), np.float64)
        sizes = np.sqrt(np.diag(A))
        error = np.abs(L @ L.T - np.asarray(A, np.float64)) / np.outer(sizes, sizes)
        # Without pivoting, a small pivot may count as zero.
        most = 50 if rank == n else np.finfo(dtype).eps ** -0.5
        assert np.max(error) <= most * n * np.finfo(dtype).eps
        np.testing.assert_allclose(L, np.tril(L))
    # The root of a multiple is a multiple of the root.
    slope = jax.jit(jax.grad(lambda a: jnp.sum(semidefinite_root(a * A))))(1.0)
    np.testing.assert_allclose(slope, np.sum(L) / 2, rtol=1e-4)


def test_the_root_of_a_rounding_error_in_a_singular_matrix_is_no_noise():
    # Friction between each two of six particles conserves the total momentum.
    L = semidefinite_root(6 * jnp.eye(6) - jnp.ones((6, 6)))
    np.testing.assert_allclose(np.sum(L, axis=0), 0, atol=1e-14)


def test_other_matrices_have_no_root():
    for A in (
        [[1.0, 0.5], [0.2, 1.0]],
        [[1.0, 3.0], [3.0, 1.0]],
        [[0.0, 1.0], [1.0, 0.0]],
        [[1.0, 0.0], [0.0, -1e-9]],
        [[1.0, 1.0], [1.0, 1.0 - 1e-9]],
        [[np.nan, 0.0], [0.0, 1.0]],
        [[np.inf, 0.0], [0.0, 1.0]],
    ):
        assert np.all(np.isnan(semidefinite_root(jnp.array(A))))


def test_traced_frictions_and_temperatures_that_are_none_fail_alone():
    y0, given = (jnp.ones(3), jnp.ones(3)), Given(jnp.array([0.3, 0.1, -0.2]))
    solver = ds.BAOAB()

    @jax.jit
    @jax.vmap
    def run(friction, T):
        if friction.ndim == 2:
            friction = as_friction(friction)
        terms = ds.langevin_terms(_pendula, friction, T, given)
        state = solver.init(terms, 0.0, 0.1, y0, None)
        *_, result = solver.step(terms, 0.0, 0.1, y0, None, state, False)
        return result == diffrax.RESULTS.successful

    skew = TENSOR.at[0, 1].set(0.5)
    one = jnp.eye(3)
    matrices = jnp.stack([one, -one, TENSOR, skew, jnp.nan * one, 0 * one])
    valid = [True, False, True, False, False, True]
    np.testing.assert_array_equal(run(matrices, jnp.ones(6)), valid)
    rates = jnp.array([0.5, -0.5, jnp.inf, 0.5, -0.5])
    heats = jnp.array([1.0, 1.0, 1.0, -1.0, -1.0])
    np.testing.assert_array_equal(run(rates, heats), [True] + [False] * 4)


def test_two_baths_have_the_mean_temperature_that_their_frictions_weigh():
    H0 = lambda t, p, q, args: p**2 / 2 + q**2 / 2

    def step(p, q, W):
        second = ds.bath_terms(H0, 1.5, 1.0, Given(W[1])).terms
        first = ds.langevin_terms(H0, 0.5, 2.0, Given(W[0])).terms
        given = diffrax.MultiTerm(*first, *second)
        state = ds.BAOAB().init(given, 0.0, h, (p, q), None)
        return jnp.stack(ds.BAOAB().step(given, 0.0, h, (p, q), None, state, False)[0])

    h, zero = 0.3, jnp.zeros(())
    derivatives = jax.jit(jax.jacobian(step, (0, 1, 2)))
    *columns, B = map(np.asarray, derivatives(zero, zero, jnp.zeros(2)))
    A, B = np.stack(columns, axis=1), B * np.sqrt(h)
    moments = np.linalg.solve(np.eye(4) - np.kron(A, A), (B @ B.T).ravel())
    np.testing.assert_allclose(moments[-1], 1.25, rtol=1e-13)


def test_a_new_friction_or_temperature_of_the_same_shape_compiles_nothing():
    path = ds.FixedStepBrownianPath((3,), jr.key(0))

    def signature(friction, T):
        """What programs are compiled for: all of the terms but the values of arrays."""
        terms = ds.langevin_terms(_pendula, friction, T, path)
        arrays, others = eqx.partition(terms, eqx.is_array)
        return jax.eval_shape(lambda: arrays), others

    pairs = (
        (0.5, 0.3),
        (jnp.array([0.5, 1.0, 0.2]), 0.3),
        (as_friction(np.eye(3)), jnp.array(0.4)),
    )
    for pair in pairs:
        other = jax.tree.map(lambda x: 2 * x, pair)
        assert eqx.tree_equal(signature(*pair), signature(*other))


def test_values_and_shapes_that_fit_nothing_are_refused_with_advice():
    make = lambda *args: ds.langevin_terms(_pendula, *args)
    negative = jnp.array([[1.0, -3.0], [-3.0, 1.0]])
    for arguments, match in (
        ((-1.0, T, (3,)), "`friction` must be a real number.*not negative; got -1.0"),
        ((np.nan, T, (3,)), "`friction` must be .*finite"),
        ((None, T, (3,)), "`friction` must be a number"),
        ((jnp.ones(2), T, (3,)), r"and the momenta, \(3,\).*got shape \(2,\)"),
        ((jnp.eye(3), T, (3,)), r"Pass a matrix as `lineax.MatrixLinearOperator"),
        ((jnp.eye(4), T, (4, 2)), r"For momenta of .* `lineax.PyTreeLinearOperator"),
        ((jnp.ones((4, 1)), T, (2, 4)), r"got shape \(4, 1\)\.$"),
        ((as_friction(jnp.eye(4)), T, (2,)), r"\(2,\); got one for shape \(4,\)"),
        ((lx.MatrixLinearOperator(TENSOR), T, (3,)), "tagged as positive semidefinite"),
        (([1.0, 0, 1.0], T, (3,)), r"got \[1.0, 0, 1.0\]. .*`jnp.array\(friction\)`"),
        ((as_friction(negative),), "`friction` must be a symmetric positive semidef"),
        (({"a": 1.0}, T, (3,)), "`friction` must be .* structure of the momenta"),
        ((lambda q: 1.0, T, (3,)), r"`friction\(t, q, args\)`"),
        ((1.0, -T, (3,)), "`temperature` must be a real number.*not negative"),
        ((1.0, lambda t: 1.0, (3,)), r"`temperature\(t, q, args\)`"),
        ((1.0, T), "both a `temperature` and a `path`"),
        ((1.0, T, 3), r"`path` must be .*; got 3, for which write `\(3,\)`"),
        ((ds.FrictionAlong(lambda q: q), T, (3,)), r"`directions\(t, q, args\)`"),
    ):
        with pytest.raises(ValueError, match=match):
            make(*arguments)
    y0 = jnp.ones(3), jnp.ones(3)
    along = ds.FrictionAlong(jnp.ones((3, 2)))
    untagged = lambda t, q, args: lx.MatrixLinearOperator(TENSOR)
    for arguments, match in (
        ((1.0, T, weak_path(2)), r"must have the shape of `q`, \(3,\)"),
        ((along, T, weak_path(3)), r"one noise for each direction.* shape \(2,\)"),
        ((ds.FrictionAlong(jnp.ones(3)), T, weak_path(3)), "and one more axis"),
        ((along, jnp.ones(2), weak_path(2)), "`temperature` must be one number"),
        ((1.0, jnp.ones(2), weak_path(3)), "array of `temperature` must have"),
        ((lambda t, q, args: q[:2], T, weak_path(3)), "array of `friction` must have"),
        ((1.0, [T] * 3, weak_path(3)), r"`jnp.array\(temperature\)`"),
        ((untagged, T, weak_path(3)), "tagged as positive semidefinite"),
    ):
        with pytest.raises(ValueError, match=match):
            ds.BAOAB().init(make(*arguments), 0.0, 0.1, y0, None)


def test_numbers_for_each_particle_are_repeated_along_the_axes_of_space():
    masses = jnp.arange(1.0, 5.0)[:, None]
    H0 = lambda t, p, q, args: jnp.sum(p**2 / masses) / 2 + jnp.sum(q**2)
    ones = np.ones((4, 3))

    def fields(friction, temperature):
        terms = ds.bath_terms(H0, friction, temperature, (4, 3)).terms
        return [term.vf(0.0, (ones, ones), None)[0] for term in terms]

    at_q = lambda t, q, args: masses
    whole = masses * ones
    given = (masses, masses / 2), (at_q, masses / 2), (whole, whole / 2)
    *others, expected = jax.jit(lambda: [fields(*pair) for pair in given])()
    for other in others:
        jax.tree.map(np.testing.assert_array_equal, other, expected)
    # One number for each axis, or for each particle: which of them is meant?
    for wrong in (masses[:, 0], lambda t, q, args: masses[:, 0]):
        with pytest.raises(ValueError, match=r"pass `friction\[:, None\]`"):
            fields(wrong, 1.0)
        with pytest.raises(ValueError, match=r"pass `temperature\[:, None\]`"):
            fields(1.0, wrong)


def test_a_matrix_for_momenta_with_two_axes_is_an_operator_on_their_structure():
    rng = np.random.default_rng(0)
    root, p = rng.normal(size=(6, 6)), rng.normal(size=(2, 3))
    G = root @ root.T
    struct = jax.ShapeDtypeStruct((2, 3), float)
    operator = lx.PyTreeLinearOperator(
        jnp.array(G.reshape(2, 3, 2, 3)), struct, lx.positive_semidefinite_tag
    )
    H0 = lambda t, p, q, args: jnp.sum(p**2) / 2
    terms = ds.bath_terms(H0, operator, T, (2, 3)).terms
    dp, B = jax.jit(lambda y: [term.vf(0.0, y, None)[0] for term in terms])((p, p))
    np.testing.assert_allclose(dp, -(G @ p.ravel()).reshape(2, 3), rtol=1e-13)
    B = B.reshape(6, 6)
    np.testing.assert_allclose(B @ B.T, 2 * T * G, atol=1e-12)


def test_derivatives_by_roots_of_zero_are_finite_and_those_of_differences():
    # Three baths whose friction is zero along some direction, or on one side of a wall.
    pair = jnp.array([[1.0, -1.0], [-1.0, 1.0]])
    directions = jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    H0 = lambda t, p, q, args: jnp.sum(p**2) / 2 + jnp.sum(jnp.cos(q))
    solver = ds.BAOAB()

    def end(x):
        a, shift = x
        wall = lambda t, q, args: a * jnp.maximum(q - 1, 0)
        noises = [Given(jnp.array(x)) for x in ([0.3, 0.2], [-0.1, 0.4], [0.2, 0.1])]
        terms = diffrax.MultiTerm(
            *ds.langevin_terms(H0, as_friction(a * pair), a, noises[0]).terms,
            *ds.bath_terms(H0, wall, a * jnp.array([0.0, 2.0]), noises[1]).terms,
            *ds.bath_terms(
                H0, ds.FrictionAlong(a * directions), 0 * a, noises[2]
            ).terms,
        )
        y0 = jnp.array([0.3, 0.5]), jnp.array([0.2, 1.7]) + shift
        state = solver.init(terms, 0.0, 0.3, y0, None)
        y1, *_ = solver.step(terms, 0.0, 0.3, y0, None, state, False)
        return jnp.sum(jnp.sin(jnp.stack(y1)))

    # One program for all derivatives and for the values that are compared to them.
    both = jax.value_and_grad(end)
    with_second = jax.jacfwd(lambda x: (both(x), both(x)), has_aux=True)
    points = np.array([[0.7, 0.0], [1.3, 0.05]])
    units = 1e-5 * np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)])
    moved = (points[:, None] + units).reshape(10, 2)
    found = jax.tree.map(np.asarray, jax.jit(jax.vmap(with_second))(moved))
    (forward, second), (values, gradients) = found
    plus, minus = np.split(values.reshape(2, 5)[:, 1:], 2, axis=1)
    exact = (plus - minus) / 2e-5
    assert np.all(np.abs(exact[:, 1]) > 1e-3)
    np.testing.assert_allclose(forward[::5], exact, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(gradients[::5], exact, rtol=1e-6, atol=1e-9)
    # Of second derivatives by the friction, too.
    differences = (gradients[1::5] - gradients[3::5]) / 2e-5
    np.testing.assert_allclose(second[::5, :, 0], differences, rtol=1e-6, atol=1e-8)
