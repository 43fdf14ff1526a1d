"""Methods for noises that do not commute, and for more accurate paths."""

import re

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._terms import apply, apply_one

from ..picard import by_picard
from ..problems import Given, H0, noise, random_problem, weak_path


def gauss(X):
    """The stability function of the Gauss method with two stages, of a matrix."""
    even, odd = np.eye(len(X)) + X @ X / 12, X / 2
    return np.linalg.solve(even - odd, even + odd)


def test_steps_of_quadratic_energies_are_those_of_matrices():
    # Flows are steps of the Gauss method in the order of the coin. Noises depend on time,
    # which stands still in the middle of the step. Drift or noise may be missing, and
    # noises may come in several terms.
    rng = np.random.default_rng(0)
    energies = [S + S.T for S in rng.normal(size=(3, 2, 2))]
    h, W, area = 0.3, 0.3 * rng.normal(size=2), 0.04
    turned = [np.array([[0, -1], [1, 0]]) @ S for S in energies]
    turned = [turned[0], *(np.exp(h / 2) * X for X in turned[1:])]
    half = gauss(h / 2 * turned[0])
    first, second = (gauss(w * X) for w, X in zip(W, turned[1:]))

    def energy(*which):
        S = jnp.asarray(energies)[jnp.array(which)]
        pair = lambda p, q: jnp.concatenate([p, q])
        return lambda t, p, q, args: pair(p, q) @ S @ pair(p, q) / 2

    def terms(*noises, coins):
        W_k = jnp.asarray(W)[jnp.array(noises) - 1]
        path = Given(W_k, two_point=coins, A=jnp.array([[0.0, area], [-area, 0.0]]))
        drift = lambda *x: energy(0)(*x)[0]
        noise = lambda t, *x: jnp.exp(t) * energy(*noises)(t, *x)
        return ds.hamiltonian_terms(drift, noise, path).terms

    @jax.jit
    def ends(y0):
        def step(terms, solver=None):
            solver = by_picard(solver or ds.NinomiyaVictoir())
            at = terms, 0.0, h, y0, None, None, False
            return jnp.concatenate(solver.step(*at)[0])

        coins = jnp.array([1.0, -1.0])
        both = lambda sign: step(diffrax.MultiTerm(*terms(1, 2, coins=sign * coins)))
        drift, one = terms(1, coins=coins[:1])
        other = terms(2, coins=coins[1:])[1]
        apart = step(diffrax.MultiTerm(drift, one, other))
        whole = diffrax.MultiTerm(*terms(1, 2, coins=coins))
        midpoint = step(whole, ds.LevyAreaMidpoint())
        return [*jax.vmap(both)(coins), apart, step(drift), step(one), midpoint]

    y0 = rng.normal(size=2)
    # Of the field with brackets a step of the midpoint rule.
    drift, *Xs = turned
    field = (h * drift + W[0] * Xs[0] + W[1] * Xs[1]) / 2
    field += area / 2 * (Xs[1] @ Xs[0] - Xs[0] @ Xs[1])
    factors = (
        half @ second @ first @ half,
        half @ first @ second @ half,
        half @ second @ first @ half,
        half @ half,
        first,
        np.linalg.solve(np.eye(2) - field, np.eye(2) + field),
    )
    for got, factor in zip(ends(tuple(y0[:, None])), factors, strict=True):
        np.testing.assert_allclose(got, factor @ y0, atol=1e-14)
    assert np.max(abs((factors[0] - factors[1]) @ y0)) > 1e-2


def test_a_failure_of_any_flow_is_reported():
    # q' = q^2 has no step from 10. Before the middle of the step, after it, by the first
    # noise, by the second; and by none.
    def success(sizes):
        stuck = lambda t, p, q, args: jnp.where(t < 0.5, sizes[0], sizes[1]) * p * q**2
        noise = lambda t, p, q, args: sizes[2:] * p * q**2
        path = Given(jnp.ones(2), two_point=jnp.ones(2))
        y0 = jnp.array(0.1), jnp.array(10.0)
        terms = ds.hamiltonian_terms(stuck, noise, path)
        solver = by_picard(ds.NinomiyaVictoir())
        *_, result = solver.step(terms, 0.0, 1.0, y0, None, None, False)
        return result == diffrax.RESULTS.successful

    sizes = jnp.concatenate([jnp.eye(4), jnp.zeros((1, 4))])
    got = jax.jit(jax.vmap(success))(sizes)
    np.testing.assert_array_equal(got, [False, False, False, False, True])


def test_one_noise_alone_is_that_noise_of_all():
    # For every way to give noises: one function of all, one of the index, several terms, a
    # matrix of noises, a Lineax operator.
    m = 3
    (p, q), args = random_problem(jr.key(0), 2, m)
    W, y = jr.normal(jr.key(1), (m,)), jnp.concatenate([p, q])[:m]

    def some(which):
        part = lambda args: {"noise": jax.tree.map(lambda x: x[which], args["noise"])}
        return lambda t, p, q, args: noise(t, p, q, part(args))

    indexed = ds.IndexedNoise(lambda k, t, p, q, args: some(k)(t, p, q, args), m)
    term = lambda fn, W=W: ds.hamiltonian_terms(H0, fn, Given(W)).terms[1]
    matrix = lambda t, y, args: jnp.outer(jnp.sin(y + t), jnp.arange(1.0, m + 1))
    diagonal = lambda t, y, args: lx.DiagonalLinearOperator(jnp.sin(y + t))
    forms = (
        ([term(noise)], (p, q)),
        ([term(indexed)], (p, q)),
        ([term(some(slice(0, 1)), W[:1]), term(some(slice(1, m)), W[1:])], (p, q)),
        ([diffrax.ControlTerm(matrix, Given(W))], y),
        ([diffrax.ControlTerm(diagonal, Given(W))], y),
    )

    def values(t):
        for terms, y in forms:
            flat, unravel = jfu.ravel_pytree([term.contr(0.0, 1.0) for term in terms])

            def one(k, terms=tuple(terms), y=y, flat=flat, unravel=unravel):
                alone = unravel(jnp.where(jnp.arange(m) == k, flat, 0))
                expected = apply(terms, alone, args, t, y)
                got = apply_one(terms, k, flat[k], args, t, y)
                return jfu.ravel_pytree(got)[0], jfu.ravel_pytree(expected)[0]

            yield jax.vmap(one)(jnp.arange(m))

    for got, expected in jax.jit(lambda t: [*values(t)])(0.3):
        np.testing.assert_allclose(got, expected, atol=1e-15)
        # No two noises are alike.
        assert np.min(np.abs(np.diff(expected, axis=0)).max(axis=1)) > 1e-3


def test_noises_given_by_their_index_are_not_all_evaluated_in_each_flow():
    m, d = 1000, 2
    u = jr.normal(jr.key(0), (m, d))
    one = lambda k, t, p, q, u: jnp.cos(u[k] @ q) * jnp.sin(u[k] @ p)
    every = lambda t, p, q, u: jnp.cos(u @ q) * jnp.sin(u @ p)

    def step(noise):
        def end(u, y0):
            path = weak_path(m, two_point=True)
            terms = ds.hamiltonian_terms(H0, noise, path)
            # The noise alone.
            solver, terms = by_picard(ds.NinomiyaVictoir(), 1e-12), terms.terms[1]
            return solver.step(terms, 0.0, 0.01, y0, u, None, False)[0]

        return jax.jit(end), (u, (jnp.ones(d), jnp.ones(d)))

    def takes_cosines_of_all(noise):
        end, inputs = step(noise)
        return re.search(rf"{m}[^\]]*\] = cos", str(jax.make_jaxpr(end)(*inputs)))

    assert not takes_cosines_of_all(ds.IndexedNoise(one, m))
    assert takes_cosines_of_all(every)
    end, inputs = step(ds.IndexedNoise(one, m))
    compiled = end.lower(*inputs).compile()
    # The increments, the order and the random numbers: some numbers for each noise.
    assert compiled.memory_analysis().temp_size_in_bytes <= 100 * m
    assert np.all(np.isfinite(compiled(*inputs)))


def test_noises_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="`m` must be a positive integer"):
        ds.IndexedNoise(lambda k, t, p, q, args: q[k], 0)
    with pytest.raises(ValueError, match="`H` must be a function"):
        ds.IndexedNoise(3.0, 2)  # pyright: ignore[reportArgumentType]
    y0 = jnp.ones(2), jnp.ones(2)

    def step(H, m):
        path = weak_path(2, two_point=True)
        terms = ds.hamiltonian_terms(H0, ds.IndexedNoise(H, m), path).terms[1]
        return ds.NinomiyaVictoir().step(terms, 0.0, 0.1, y0, None, None, False)

    with pytest.raises(ValueError, match="must return one Hamiltonian for each noise"):
        step(lambda k, t, p, q, args: q[k], 3)
    with pytest.raises(ValueError, match="`H` must return a scalar"):
        step(lambda k, t, p, q, args: q, 2)
    solver = ds.LevyAreaMidpoint()
    path = solver.path((1,), jr.key(0))
    drift, term = ds.hamiltonian_terms(H0, lambda t, p, q, args: q[:1], path).terms
    several = diffrax.MultiTerm(drift, term, term)
    with pytest.raises(ValueError, match="all noises in one term"):
        solver.step(several, 0.0, 0.1, y0, None, None, False)


@pytest.mark.slow
def test_paths_of_a_batch_may_end_at_different_times():
    # Those that have ended go on with empty steps.
    y0, args = random_problem(jr.key(0), 1, 2)
    tree = diffrax.VirtualBrownianTree(
        0.0, 0.7, 0.01, (2,), jr.key(1), diffrax.SpaceTimeLevyArea
    )

    def end(scale, t1, cell):
        path = ds.LevyAreaBrownianPath(tree, jr.key(2), cell=cell)
        terms, solver = ds.hamiltonian_terms(H0, noise, path), ds.LevyAreaMidpoint()
        y = jax.tree.map(lambda x: scale * x, y0)
        return diffrax.diffeqsolve(terms, solver, 0.0, t1, 0.05, y, args).ys[1][-1, 0]

    ends = lambda t1: (end(1.0, t1, 0.05), jax.grad(end)(1.0, t1, None))
    batch = jax.jit(jax.vmap(ends))
    together, *apart = (
        np.stack(batch(jnp.array(times)))
        for times in ([0.25, 0.7], [0.25, 0.25], [0.7, 0.7])
    )
    for i, alone in enumerate(apart):
        np.testing.assert_allclose(together[:, i], alone[:, 0], rtol=1e-12)


def test_a_step_of_plateau_gauss_is_the_gauss_method_on_the_field_of_the_docstring():
    rng = np.random.default_rng(0)
    A, *Bs = rng.normal(size=(3, 3, 3))
    W, H, K = 0.3 * rng.normal(size=(3, 2))
    h, y0 = 0.3, rng.normal(size=3)
    bracket = lambda B, A: A @ B - B @ A

    def expected(A, W, H, K):
        L = 3 / 5 * h * np.outer(H, H)
        if K is None:
            L += h**2 / 30 * np.eye(2)
        else:
            L += 60 / 7 * h * np.outer(K, K) - h * (np.outer(W, K) + np.outer(K, W)) / 2
            L += 3 / 140 * h**2 * np.eye(2)
        omega = h * A
        for k, X in enumerate(Bs):
            omega = omega + W[k] * X + h * H[k] * bracket(X, A)
            for j, Y in enumerate(Bs):
                omega += L[k, j] * bracket(X, bracket(Y, A))
        return gauss(omega) @ y0

    def terms(noises, K):
        path = Given(*(jnp.asarray(x)[noises] for x in (W, H)))
        path = eqx.tree_at(lambda x: x.K, path, K, is_leaf=lambda x: x is None)
        field = lambda t, y, args: jnp.einsum("kij,j->ik", jnp.stack(Bs)[noises], y)
        drift = diffrax.ODETerm(lambda t, y, args: A @ y)
        return drift, diffrax.ControlTerm(field, path)

    @jax.jit
    def ends(y0, K):
        def step(*terms, y=y0, t0=0.0):
            at = diffrax.MultiTerm(*terms), t0, t0 + h, y, None, None, False
            return by_picard(ds.PlateauGauss()).step(*at)[0]

        part = lambda noises: None if K is None else K[noises]
        # Each noise in a term of its own, too.
        one, other = (terms(slice(k, k + 1), part(slice(k, k + 1))) for k in (0, 1))
        drift, both = terms(slice(0, 2), K)
        whole = step(drift, both)
        # As a solve that goes backward wraps the terms.
        reversed = [diffrax._term.WrapTerm(term, -1) for term in (drift, both)]
        back = step(*reversed, y=whole, t0=-h)
        return whole, step(*one, other[1]), step(drift), step(both), back

    for area in (None, K):
        whole, apart, drift, noise, back = ends(y0, area)
        np.testing.assert_allclose(whole, expected(A, W, H, area), rtol=1e-12)
        np.testing.assert_allclose(apart, whole, rtol=1e-12)
        np.testing.assert_allclose(drift, gauss(h * A) @ y0, rtol=1e-12)
        np.testing.assert_allclose(noise, expected(0 * A, W, H, area), rtol=1e-12)
        np.testing.assert_allclose(back, y0, rtol=1e-12)
