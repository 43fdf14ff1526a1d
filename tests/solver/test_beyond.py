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
from ..problems import FineSample, Given, H0, noise, random_problem, weak_path


def test_flows_follow_each_other_in_the_order_of_the_coin():
    # Without drift and for one coin, two separate solves with one noise each.
    y0, args = random_problem(jr.key(0), 2, 2)
    W = jnp.array([0.3, -0.2])
    zero = lambda t, p, q, args: 0.0 * jnp.sum(p)
    solver = by_picard(ds.NinomiyaVictoir())

    def end(W, coin, y0):
        path = Given(W, two_point=coin * jnp.array([1, -1]))
        terms = ds.hamiltonian_terms(zero, lambda *x: noise(0.05, *x[1:]), path)
        return solver.step(terms, 0.0, 0.1, y0, args, None, False)[0]

    end = jax.jit(end)
    first, then = W * jnp.array([1, 0]), W * jnp.array([0, 1])
    for coin, (a, b) in {1.0: (first, then), -1.0: (then, first)}.items():
        expected = end(b, 1.0, end(a, 1.0, y0))
        got = end(W, coin, y0)
        np.testing.assert_allclose(got[0], expected[0], atol=1e-14)
        np.testing.assert_allclose(got[1], expected[1], atol=1e-14)
    assert abs(end(W, 1.0, y0)[0] - end(W, -1.0, y0)[0]).max() > 1e-4


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
    m, (p, q) = 3, random_problem(jr.key(0), 2, 3)[0]
    args = random_problem(jr.key(0), 2, m)[1]
    W = jr.normal(jr.key(1), (m,))
    restrict = lambda args, i: {"noise": jax.tree.map(lambda x: x[i], args["noise"])}
    indexed = ds.IndexedNoise(
        lambda k, t, p, q, args: noise(t, p, q, restrict(args, k)), m
    )
    first = lambda t, p, q, args: noise(t, p, q, restrict(args, slice(0, 1)))
    rest = lambda t, p, q, args: noise(t, p, q, restrict(args, slice(1, None)))
    term = lambda fn, W: ds.hamiltonian_terms(H0, fn, Given(W)).terms[1]
    matrix = lambda t, y, args: jnp.outer(jnp.sin(y + t), jnp.arange(1.0, m + 1))
    diagonal = lambda t, y, args: lx.DiagonalLinearOperator(jnp.sin(y + t))
    y = jnp.concatenate([p, q])[:m]

    def deviations(t):
        both = (p, q)
        forms = {
            "function": ((term(noise, W),), both),
            "index": ((term(indexed, W),), both),
            "terms": ((term(first, W[:1]), term(rest, W[1:])), both),
            "matrix": ((diffrax.ControlTerm(matrix, Given(W)),), y),
            "operator": ((diffrax.ControlTerm(diagonal, Given(W)),), y),
        }

        def deviation(terms, y):
            controls = [term.contr(0.0, 1.0) for term in terms]
            flat, unravel = jfu.ravel_pytree(controls)

            def one(k):
                alone = unravel(jnp.where(jnp.arange(m) == k, flat, 0))
                expected = apply(terms, alone, args, t, y)
                got = apply_one(terms, k, flat[k], args, t, y)
                return jfu.ravel_pytree(got)[0], jfu.ravel_pytree(expected)[0]

            return jax.vmap(one)(jnp.arange(m))

        return {name: deviation(*form) for name, form in forms.items()}

    for got, expected in jax.jit(deviations)(0.3).values():
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
            solver, terms = ds.NinomiyaVictoir(), terms.terms[1]
            return solver.step(terms, 0.0, 0.1, y0, u, None, False)[0]

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


def test_noises_by_their_index_are_checked():
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


def test_levy_area_midpoint_is_one_step_of_the_hamiltonian_with_brackets():
    y0, args = random_problem(jr.key(0), 2, 3)
    W = jnp.array([0.3, -0.2, 0.1])
    A = jnp.array([[0, 0.04, -0.05], [-0.04, 0, 0.02], [0.05, -0.02, 0]])
    t0, h = 0.4, 0.2

    def total(t, p, q, args):
        values = noise(t0 + h / 2, p, q, args)
        dp = jax.jacobian(noise, 1)(t0 + h / 2, p, q, args)
        dq = jax.jacobian(noise, 2)(t0 + h / 2, p, q, args)
        brackets = dp @ dq.T - dq @ dp.T
        deterministic = h * H0(t0 + h / 2, p, q, args)
        return deterministic + W @ values + jnp.sum(jnp.triu(A) * brackets)

    terms = ds.hamiltonian_terms(H0, noise, Given(W, A=A))
    unit = ds.hamiltonian_terms(total, noise, Given(jnp.zeros(3)))

    @jax.jit
    def ends(y0, args):
        end = lambda solver, *x: solver.step(*x, y0, args, None, False)[0]
        midpoint = by_picard(ds.ImplicitMidpoint())
        return (
            end(by_picard(ds.LevyAreaMidpoint()), terms, t0, t0 + h),
            end(midpoint, unit, 0.0, 1.0),
            end(midpoint, terms, t0, t0 + h),
        )

    got, expected, without = ends(y0, args)
    np.testing.assert_allclose(got, expected, atol=1e-14)
    assert np.abs(np.subtract(without, expected)).max() > 1e-4


def test_flows_of_an_oscillator_are_those_of_the_gauss_method():
    # Of q + ip each flow over the "time" x makes R(-ix) (q + ip). Drift or noise may be
    # missing, and noises may come in several terms.
    h, x, y = 0.3, 0.4, -0.2
    R = lambda z: (1 + z / 2 + z**2 / 12) / (1 - z / 2 + z**2 / 12)
    energy = lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2
    given = lambda w: Given(jnp.array([w]), two_point=jnp.ones(1))
    drift, first = ds.hamiltonian_terms(energy, energy, given(x)).terms
    second = ds.hamiltonian_terms(energy, energy, given(y)).terms[1]
    half = R(-0.5j * h)
    factors = half**2, R(-1j * x), half**2 * R(-1j * x) * R(-1j * y)
    solver = by_picard(ds.NinomiyaVictoir())

    @jax.jit
    def ends(y0):
        cases = drift, first, diffrax.MultiTerm(drift, first, second)
        return [solver.step(x, 0.0, h, y0, None, None, False)[0] for x in cases]

    for (p, q), factor in zip(ends((jnp.zeros(1), jnp.ones(1))), factors):
        np.testing.assert_allclose(q + 1j * p, [factor], atol=1e-15)


def test_missing_variables_are_refused_with_advice():
    y0, args = random_problem(jr.key(0), 1, 2)
    solve = lambda solver, path: diffrax.diffeqsolve(
        ds.hamiltonian_terms(H0, noise, path), solver, 0.0, 0.2, 0.1, y0, args
    )
    advice = r".* Make its path by `solver.path\(shape, key\)`"
    with pytest.raises(ValueError, match="two-point variables" + advice):
        solve(ds.NinomiyaVictoir(), weak_path(2))
    with pytest.raises(ValueError, match="Lévy areas" + advice):
        solve(ds.LevyAreaMidpoint(), weak_path(2))
    path = ds.LevyAreaMidpoint().path((1,), jr.key(0))
    one = ds.hamiltonian_terms(H0, lambda *x: noise(*x)[:1], path)
    drift, diffusion = one.terms
    several = diffrax.MultiTerm(drift, diffusion, diffusion)
    with pytest.raises(ValueError, match="all noises in one term"):
        diffrax.diffeqsolve(several, ds.LevyAreaMidpoint(), 0.0, 0.2, 0.1, y0, args)


@pytest.mark.parametrize("cell", [None, 0.05])
@pytest.mark.slow
def test_paths_of_a_batch_may_end_at_different_times(cell):
    # Those that have ended go on with empty steps.
    y0, args = random_problem(jr.key(0), 1, 2)
    tree = diffrax.VirtualBrownianTree(
        0.0, 0.7, 0.01, (2,), jr.key(1), diffrax.SpaceTimeLevyArea
    )
    path = ds.LevyAreaBrownianPath(tree, jr.key(2), cell=cell)
    terms = ds.hamiltonian_terms(H0, noise, path)

    def end(scale, t1):
        y = jax.tree.map(lambda x: scale * x, y0)
        solver = ds.LevyAreaMidpoint()
        return diffrax.diffeqsolve(terms, solver, 0.0, t1, 0.05, y, args).ys[1][-1, 0]

    what = end if cell else jax.grad(end)
    batch = jax.jit(jax.vmap(what, (None, 0)))
    together = batch(1.0, jnp.array([0.25, 0.7]))
    apart = [batch(1.0, jnp.array([t, t]))[0] for t in (0.25, 0.7)]
    np.testing.assert_allclose(together, jnp.stack(apart), rtol=1e-12)


PLATEAU_GAUSS = ds.PlateauGauss()


def _linear_terms(path, *matrices):
    A, Bs = matrices[0], jnp.stack(matrices[1:])
    diffusion = lambda t, y, args: jnp.einsum("kij,j->ik", Bs, y)
    return diffrax.MultiTerm(
        diffrax.ODETerm(lambda t, y, args: A @ y), diffrax.ControlTerm(diffusion, path)
    )


@pytest.mark.parametrize("with_K", [False, True])
def test_a_step_of_plateau_gauss_is_the_gauss_method_on_the_field_of_the_docstring(
    with_K,
):
    rng = np.random.default_rng(0)
    A, B, C = rng.normal(size=(3, 3, 3))
    W, H, K = 0.3 * rng.normal(size=(3, 2))
    h = 0.3
    bracket = lambda B, A: A @ B - B @ A
    L = 3 / 5 * h * np.outer(H, H)
    if with_K:
        L += 60 / 7 * h * np.outer(K, K) - h * (np.outer(W, K) + np.outer(K, W)) / 2
        L += 3 / 140 * h**2 * np.eye(2)
    else:
        L += h**2 / 30 * np.eye(2)
    omega = h * A
    for k, X in enumerate((B, C)):
        omega += W[k] * X + h * H[k] * bracket(X, A)
        for j, Y in enumerate((B, C)):
            omega += L[k, j] * bracket(X, bracket(Y, A))
    # The stability function of the Gauss method with two stages.
    even, odd = np.eye(3) + omega @ omega / 12, omega / 2
    y0 = rng.normal(size=3)
    expected = np.linalg.solve(even - odd, (even + odd) @ y0)

    path = Given(*map(jnp.asarray, (W, H)), K=jnp.asarray(K) if with_K else None)
    step = lambda terms: eqx.filter_jit(
        lambda y: PLATEAU_GAUSS.step(terms, 0.0, h, y, None, None, False)[0]
    )(jnp.asarray(y0))
    actual = step(_linear_terms(path, A, B, C))
    np.testing.assert_allclose(actual, expected, rtol=1e-12)

    # Each noise in a term of its own.
    def one(k):
        K_k = path.K[k : k + 1] if path.K is not None else None
        return Given(path.W[k : k + 1], H=path.H[k : k + 1], K=K_k)

    drift, first = _linear_terms(one(0), A, B).terms
    second = _linear_terms(one(1), A, C).terms[1]
    apart = step(diffrax.MultiTerm(drift, first, second))
    np.testing.assert_allclose(apart, expected, rtol=1e-12)


def _energy(t, p, q, args):
    return p**2 / 4 + q**4 / 8 + 0.15 * (1 + jnp.sin(3 * t)) * p * q**2


def _one(t, p, q, args):
    return jnp.stack([jnp.sin(q + 3 * t) / 2 + 0.4 * p * q + jnp.cos(p) / 5])


def _two_that_commute(t, p, q, args):
    """Two functions of one function."""
    f = p**2 / 2 + jnp.cos(q) + p * q / 2
    return jnp.stack([0.4 * jnp.sin(f), 0.3 * f])


@pytest.mark.slow
def test_backward_in_time_plateau_gauss_undoes_its_steps():
    """The Gauss method is its own inverse, and the field of the path run backward is the
    negative of that forward."""
    terms = ds.hamiltonian_terms(_energy, _one, FineSample.draw(jr.key(0), 8, 1))
    y0 = jnp.array(0.3), jnp.array(0.8)

    @jax.jit
    def step(direction, t0, t1, y0):
        # As a solve that goes backward wraps them.
        wrapped = [diffrax._term.WrapTerm(term, direction) for term in terms.terms]
        both = diffrax.MultiTerm(*wrapped)
        return PLATEAU_GAUSS.step(both, t0, t1, y0, None, None, False)[0]

    y1 = step(1, 0.25, 0.5, y0)
    np.testing.assert_allclose(step(-1, -0.5, -0.25, y1), y0, atol=1e-12)
    assert abs(y1[0] - y0[0]) > 0.02


def test_drift_or_noise_alone_will_do_for_plateau_gauss_but_not_a_path_without_area():
    y0 = jnp.array(0.3), jnp.array(0.8)
    levy = diffrax.SpaceTimeLevyArea
    path = diffrax.UnsafeBrownianPath((1,), jr.key(0), levy)
    for term in ds.hamiltonian_terms(_energy, _one, path).terms:
        terms = diffrax.MultiTerm(term) if term.is_vf_expensive else term
        at = terms, 0.0, 0.1, y0, None, None, False
        assert np.all(np.isfinite(jax.jit(lambda at=at: PLATEAU_GAUSS.step(*at)[0])()))
    terms = ds.hamiltonian_terms(_energy, _one, weak_path(1))
    with pytest.raises(ValueError, match="`PlateauGauss` needs space-time Lévy area"):
        diffrax.diffeqsolve(terms, PLATEAU_GAUSS, 0.0, 0.2, 0.1, y0)
    two = ds.hamiltonian_terms(_energy, _two_that_commute, weak_path(2))
    assert PLATEAU_GAUSS.strong_order(two) == 0.5 and PLATEAU_GAUSS.weak_order(two) == 1
