"""Terms from Hamiltonians: values, structures, derivatives, and use with Diffrax."""

import functools as ft

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..families import slow_except
from ..problems import (
    H0,
    local_weak_orders,
    noise,
    random_problem as _random_problem,
    weak_path,
)


random_problem = jax.jit(_random_problem, static_argnums=(1, 2, 3))
# The end of a solve is all that is looked at: that takes half the time to compile.
_END = dict(adjoint=diffrax.ForwardMode())


def test_terms_are_the_symplectic_gradients():
    H0 = lambda t, p, q, args: jnp.sum(p**2) * args + jnp.cos(t) * jnp.sum(p * q**2)
    noise = lambda t, p, q, args: jnp.stack([jnp.sum(q**3), args * jnp.sum(p * q)])
    drift, diffusion = ds.hamiltonian_terms(H0, noise, weak_path(2)).terms
    p, q = jnp.array([0.3, -0.5]), jnp.array([0.2, 0.9])
    t, args = 0.4, 1.7
    f, g = drift.vf(t, (p, q), args)
    np.testing.assert_allclose(f, -np.cos(t) * 2 * p * q, rtol=1e-14)
    np.testing.assert_allclose(g, 2 * args * p + np.cos(t) * q**2, rtol=1e-14)
    sigma, gamma = diffusion.vf(t, (p, q), args)
    np.testing.assert_allclose(sigma, np.stack([-3 * q**2, -args * p], 1), rtol=1e-14)
    np.testing.assert_allclose(gamma, np.stack([0 * q, args * q], 1), rtol=1e-14)
    control = jnp.array([0.7, -1.1])
    for got in (
        diffusion.vf_prod(t, (p, q), args, control),
        diffusion.prod((sigma, gamma), control),
    ):
        np.testing.assert_allclose(got[0], sigma @ control, rtol=1e-14)
        np.testing.assert_allclose(got[1], gamma @ control, rtol=1e-14)


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
        ends = [
            diffrax.diffeqsolve(terms, solver, 0.0, 0.1, 0.05, y, **_END).ys
            for solver in (ds.StrangGauss(), diffrax.Heun())
        ]
        defect = ds.symplecticity_defect(terms, ds.ImplicitMidpoint(), 0.0, 0.1, y)
        return vf, products, ends, defect

    vf, products, ends, defect = all_at_once((p, q))
    assert vf[0]["x"].shape == (1, 2, 3)
    jax.tree.map(ft.partial(np.testing.assert_allclose, atol=1e-15), *products)
    for ys in ends:
        assert jax.tree.structure(ys) == jax.tree.structure((p, q))
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(ys))
    assert defect < 1e-14


@pytest.mark.parametrize("shape", [(), (1,)])
def test_one_noise_may_be_a_scalar(shape):
    path = ds.WeakBrownianPath(shape, jr.key(0))
    H = lambda t, p, q, args: (p**2 + q**2) / 2
    terms = ds.hamiltonian_terms(H, H, path)
    y0 = (jnp.array(0.0), jnp.array(1.0))
    solve = lambda solver: (
        diffrax.diffeqsolve(terms, solver, 0.0, 0.2, 0.1, y0, **_END).ys
    )
    np.testing.assert_allclose(
        sum(x**2 for x in solve(ds.ImplicitMidpoint())), 1, rtol=1e-14
    )
    solve(diffrax.StratonovichMilstein())


@pytest.mark.parametrize("m", slow_except([3], [1, 3]))
def test_terms_work_with_diffrax_solvers(m):
    y0, args = random_problem(jr.key(0), 2, m)
    # Steps of the same size see the same increments.
    path = diffrax.UnsafeBrownianPath(
        (m,), jr.key(1), levy_area=diffrax.SpaceTimeTimeLevyArea
    )
    terms = ds.hamiltonian_terms(H0, noise, path)
    solve = lambda solver: (
        diffrax.diffeqsolve(*(terms, solver, 0.0, 0.25, 2.0**-9, y0, args), **_END).ys
    )
    expected = solve(ds.ImplicitMidpoint())
    for solver in (diffrax.Heun(), diffrax.StratonovichMilstein(), diffrax.SlowRK()):
        for a, b in zip(solve(solver), expected):
            np.testing.assert_allclose(a, b, atol=0.02)


def test_plain_diffrax_terms_give_the_same_solution():
    # It treats drift and noise differently, and so tells them apart.
    solver = ds.StrangGauss()
    y0, args = random_problem(jr.key(0), 2, 2)
    path = weak_path(2)
    terms = ds.hamiltonian_terms(H0, noise, path)
    drift, diffusion = terms.terms

    # The same vector fields on one array for the whole state.
    def on_array(vf):
        return lambda t, y, args: jnp.concatenate(vf(t, (y[:2], y[2:]), args))

    plain = diffrax.MultiTerm(
        diffrax.ODETerm(on_array(drift.vf)),
        diffrax.ControlTerm(on_array(diffusion.vf), path),
    )

    class OneNoise(diffrax.AbstractPath):
        k: int
        t0 = 0
        t1 = 1

        def evaluate(self, t0, t1=None, left=True):
            return path.evaluate(t0, t1)[self.k]

    one = lambda k: lambda t, y, args: on_array(diffusion.vf)(t, y, args)[:, k]
    separate = diffrax.MultiTerm(
        diffrax.ODETerm(on_array(drift.vf)),
        *[diffrax.ControlTerm(one(k), OneNoise(k)) for k in range(2)],
    )
    solve = lambda terms, y0: (
        diffrax.diffeqsolve(terms, solver, 0.0, 0.5, 0.1, y0, args, **_END).ys
    )
    expected = np.concatenate(solve(terms, y0), axis=1)
    for other in (plain, separate):
        got = solve(other, np.concatenate(y0))
        np.testing.assert_allclose(got, expected, atol=1e-14)


def test_without_noise_the_midpoint_rule_has_order_two():
    solver = ds.ImplicitMidpoint()
    drift = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0]) - t]))
    assert solver.order(drift) == 2
    y0 = jnp.array([1.0, 0.0])
    solve = lambda s, h: diffrax.diffeqsolve(drift, s, 0.0, 1.0, h, y0, **_END).ys[0]
    exact = solve(diffrax.Dopri5(), 1e-3)
    coarse, fine = (np.abs(solve(solver, h) - exact).max() for h in (0.1, 0.05))
    np.testing.assert_allclose(np.log2(coarse / fine), 2, atol=0.1)


@pytest.mark.slow
def test_without_noise_terms_are_the_drift():
    def harmonic(t, s, args):
        return jnp.sum(s[..., 2] ** 2) / 2

    path = weak_path(1)
    y0, args = random_problem(jr.key(0), 2, 1)
    waves = jnp.array([0.3 + 0.1j, 0.2 - 0.4j])
    spinors = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    amplitude = lambda t, psi, args: jnp.sum(jnp.abs(psi) ** 4)
    for make, energy, y, parameters in (
        (ds.hamiltonian_terms, H0, y0, args),
        (ds.spin_terms, harmonic, spinors, None),
        (ft.partial(ds.spin_terms, damping=0.1), harmonic, spinors, None),
        (ds.wave_terms, amplitude, ds.to_pair(waves), None),
        (ft.partial(ds.wave_terms, damping=0.1), amplitude, ds.to_pair(waves), None),
    ):
        both = make(energy), make(energy, energy, path)
        assert len(both[0].terms) == 1
        fields = jax.jit(
            lambda y, parameters: [x.terms[0].vf(0.0, y, parameters) for x in both]
        )
        jax.tree.map(np.testing.assert_array_equal, *fields(y, parameters))
    # One term is solved, with the solvers of this package and of Diffrax.
    for terms, y, parameters in (
        (ds.hamiltonian_terms(H0), y0, args),
        (ds.spin_terms(harmonic, damping=0.1), spinors, None),
    ):
        ends = [
            diffrax.diffeqsolve(terms, solver, 0, 1, 1 / 64, y, parameters, **_END).ys
            for solver in (ds.ImplicitMidpoint(), diffrax.Bosh3())
        ]
        jax.tree.map(ft.partial(np.testing.assert_allclose, atol=2e-3), *ends)


def test_a_hamiltonian_that_changes_its_args_changes_a_copy():
    def doubles(t, p, q, args):
        args["k"] = 2 * args["k"]
        return (p**2 + args["k"] * q**2) / 2

    plain = lambda t, p, q, args: (p**2 + 2 * args["k"] * q**2) / 2
    args, y0 = {"k": jnp.array(1.5)}, (jnp.array(0.0), jnp.array(1.0))
    solve = lambda H: (
        diffrax.diffeqsolve(
            ds.hamiltonian_terms(H, H, weak_path(1)),
            ds.ImplicitMidpoint(),
            0,
            1,
            0.1,
            y0,
            args,
            **_END,
        ).ys
    )
    jax.tree.map(np.testing.assert_array_equal, solve(doubles), solve(plain))
    assert args == {"k": 1.5}


_GAUSSIAN = diffrax.UnsafeBrownianPath(
    (1,), jr.key(0), levy_area=diffrax.SpaceTimeLevyArea
)


def test_noise_alone_can_be_solved():
    path = weak_path(1)
    term = diffrax.ControlTerm(lambda t, y, args: y[:, None], path)
    y = diffrax.diffeqsolve(
        term, ds.ImplicitMidpoint(), 0.0, 0.3, 0.1, jnp.ones(1), **_END
    ).ys[0]
    starts = 0.1 * np.arange(3)
    increments = np.asarray(jax.jit(jax.vmap(path.evaluate))(starts, starts + 0.1))
    expected = np.prod((1 + increments / 2) / (1 - increments / 2))
    np.testing.assert_allclose(y[0], expected, rtol=1e-13)


def test_a_solve_backward_in_time_returns_to_its_start():
    y0, args = random_problem(jr.key(0), 1, 1)
    terms = ds.hamiltonian_terms(H0, noise, weak_path(1))

    @jax.jit
    def solve(t0, t1, h, y):
        sol = diffrax.diffeqsolve(
            terms, ds.ImplicitMidpoint(), t0, t1, h, y, args, **_END
        )
        return jax.tree.map(lambda x: x[0], sol.ys)

    back = solve(1.0, 0.0, -0.1, solve(0.0, 1.0, 0.1, y0))
    # The midpoint rule is its own inverse, and both ways see the same increments.
    for a, b in zip(back, y0):
        np.testing.assert_allclose(a, b, atol=1e-12)


class _Network(eqx.Module):
    mlp: eqx.nn.MLP

    def __call__(self, t, p, q, args):
        return self.mlp(jnp.concatenate([p, q]))


@pytest.mark.slow
def test_hamiltonians_may_be_networks():
    make = lambda key, out: _Network(
        eqx.nn.MLP(4, out, 8, 1, activation=jnp.tanh, key=key, dtype=jnp.float64)
    )
    terms = ds.hamiltonian_terms(
        make(jr.key(0), "scalar"), make(jr.key(1), 2), weak_path(2)
    )
    y0 = (jnp.array([0.1, 0.2]), jnp.array([0.3, 0.4]))
    defect = eqx.filter_jit(ds.symplecticity_defect)
    assert defect(terms, ds.ImplicitMidpoint(), 0.0, 0.1, y0) < 1e-13

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(terms):
        ys = diffrax.diffeqsolve(terms, ds.ImplicitMidpoint(), 0.0, 0.3, 0.1, y0).ys
        return jnp.sum(ys[0] ** 2)

    leaves = jax.tree.leaves(eqx.filter(gradient(terms), eqx.is_inexact_array))
    assert len(leaves) > 0 and all(jnp.any(x != 0) for x in leaves[:2])


def test_terms_may_come_in_any_order_and_drift_in_pieces():
    y0, args = random_problem(jr.key(0), 1, 1)
    drift, diffusion = ds.hamiltonian_terms(H0, noise, weak_path(1)).terms
    friction = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], jnp.zeros_like(y[1])))
    together = diffrax.MultiTerm(diffrax.MultiTerm(drift, friction), diffusion)
    solve = lambda *terms: (
        diffrax.diffeqsolve(
            *(
                diffrax.MultiTerm(*terms),
                ds.ImplicitMidpoint(),
                0.0,
                0.3,
                0.1,
                y0,
                args,
            ),
            **_END,
        ).ys
    )
    expected = solve(*together.terms)
    for terms in ((drift, diffusion, friction), (diffusion, friction, drift)):
        for a, b in zip(solve(*terms), expected):
            np.testing.assert_allclose(a, b, rtol=1e-13)
        assert ds.StrangGauss().weak_order(diffrax.MultiTerm(*terms)) == 2


@pytest.mark.slow
def test_nested_terms_are_the_terms_within():
    # `StrangGauss` treats drift and noise differently, and so loses its order if a drift
    # is taken for noise.
    y0, args = jax.tree.map(
        lambda x: x[None], random_problem(jr.split(jr.key(0), 1)[0], 1, 1)
    )
    hamiltonian = ds.hamiltonian_terms(H0, noise, weak_path(1))
    friction = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], jnp.zeros_like(y[1])))
    nested = diffrax.MultiTerm(friction, diffrax.MultiTerm(hamiltonian))
    flat = diffrax.MultiTerm(friction, *hamiltonian.terms)
    solver = ds.StrangGauss()
    assert solver.weak_order(nested) == 2
    hs = jnp.array([0.05, 0.1])
    slopes = local_weak_orders(nested, solver, y0, args, hs, order=2)
    assert all(2.8 < measured < 3.2 for measured in slopes)

    def end(terms):
        y, a = jax.tree.map(lambda x: x[0], (y0, args))
        return diffrax.diffeqsolve(terms, solver, 0.0, 0.3, 0.1, y, a, **_END).ys

    np.testing.assert_array_equal(end(nested), end(flat))


@pytest.mark.parametrize("solver", [ds.SRKs4(), ds.PlateauVerlet()], ids=repr)
@pytest.mark.slow
def test_order_three_halves_holds_backwards_in_time(solver):
    energy = lambda t, p, q, args: jnp.sum(p**2 / 2 + q**4 / 4)
    kick = lambda t, p, q, args: -q
    y0 = (jnp.array([0.2]), jnp.array([1.0]))

    def errors(key):
        area = diffrax.SpaceTimeLevyArea
        tree = diffrax.VirtualBrownianTree(0.0, 1.0, 2.0**-13, (1,), key, area)
        plateaus = ds.PlateauBrownianPath(tree, jr.key(0))
        path = plateaus if isinstance(solver, ds.PlateauVerlet) else tree
        end = lambda h: diffrax.diffeqsolve(
            *(ds.hamiltonian_terms(energy, kick, path), solver, 1.0, 0.0, -h, y0),
            **_END,
        ).ys[1][-1, 0]
        coarse, fine, exact = jax.lax.map(end, jnp.array([1 / 8, 1 / 32, 2.0**-9]))
        return coarse - exact, fine - exact

    # At order 1 it is a factor of 4, and an error ten times as large.
    coarse, fine = jax.jit(jax.vmap(errors))(jr.split(jr.key(1), 50))
    assert jnp.sqrt(jnp.mean(coarse**2)) < 5e-3
    assert jnp.sqrt(jnp.mean(fine**2)) < jnp.sqrt(jnp.mean(coarse**2)) / 6


def test_integer_times_are_times():
    moving = lambda t, p, q, args: jnp.sum(p**2 / 2 + jnp.cos(3 * t) * q)
    terms = ds.hamiltonian_terms(
        moving, lambda t, p, q, args: -q, weak_path(1, order=3)
    )
    y0 = (jnp.array([0.2]), jnp.array([1.0]))
    value = lambda t0, t1: ds.step_expectation(
        terms, ds.AdditiveGauss(), t0, t1, y0, fn=lambda t, y, args: y[1][0]
    )
    np.testing.assert_allclose(value(0, 1), value(0.0, 1.0), rtol=1e-14)


def test_time_dependent_noise_works_in_single_precision():
    y0, args = random_problem(jr.key(0), 1, 2, jnp.float32)
    path = weak_path(2, jr.key(0), jnp.float32, two_point=True)
    terms = ds.hamiltonian_terms(H0, noise, path)
    t0, t1, h = jnp.array([0.0, 0.2, 0.1], jnp.float32)
    ys = diffrax.diffeqsolve(
        terms, ds.NinomiyaVictoir(), t0, t1, h, y0, args, **_END
    ).ys
    assert ys[0].dtype == jnp.float32 and jnp.all(jnp.isfinite(ys[0]))


@pytest.mark.parametrize("shape", [(), (2,), {"a": jax.ShapeDtypeStruct((), float)}])
def test_a_shape_stands_for_the_path_that_the_solver_needs(shape):
    H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
    noise = lambda t, p, q, args: jax.tree.map(
        lambda s: jnp.full(s.shape, 0.1) * jnp.sin(q), checked
    )
    is_tuple = isinstance(shape, tuple)
    checked = jax.ShapeDtypeStruct(shape, float) if is_tuple else shape
    terms, y0 = ds.hamiltonian_terms(H0, noise, shape), (jnp.zeros(()), jnp.ones(()))
    for want in ("weak", "strong"):
        best = ds.suggest_solver(terms, 0.0, y0, want=want)[0]
        path = best.solver.path(shape, jr.key(1), want=want)
        with_path = ds.hamiltonian_terms(H0, noise, path)
        solve = lambda terms: diffrax.diffeqsolve(terms, best.solver, 0, 1, 0.25, y0).ys
        got, expected = solve(best.terms(jr.key(1))), solve(with_path)
        assert all(jax.tree.map(jnp.array_equal, got, expected))
    for solver in (ds.StormerVerlet(), diffrax.Heun()):
        with pytest.raises(ValueError, match=r"pass `path=solver.path\(shape, key\)`"):
            diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.5, y0)


@pytest.mark.parametrize("path", [3, "path", None, ds.WeakBrownianPath, (1.5,), (-1,)])
def test_what_is_neither_a_path_nor_a_shape_is_refused(path):
    H = lambda t, p, q, args: p**2 + q**2
    with pytest.raises(ValueError, match="shape"):
        ds.hamiltonian_terms(H, H, path)
