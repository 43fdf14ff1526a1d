"""Fitted value functions: they never change the mean, and where a fit can be exact nothing
random is left."""

import contextlib

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.choose import choose, sampling_for
from diffrax_symplectic._expectation.estimate.estimate import combined_results
from diffrax_symplectic._expectation.fitted import value_functions
from diffrax_symplectic._expectation.fitted.bases import CovarianceFrame, Hermite
from diffrax_symplectic._expectation.fitted.basis_choice import chosen_basis
from diffrax_symplectic._expectation.fitted.grid import Grid
from diffrax_symplectic._expectation.fitted.mixture import (
    log_ratios_of_outcomes,
    Mixture,
)
from diffrax_symplectic._expectation.fitted.noise import Noise
from diffrax_symplectic._expectation.fitted.polynomials import (
    exponents,
    hermite,
    least_squares,
)
from diffrax_symplectic._expectation.run import run
from diffrax_symplectic._expectation.sampling import (
    Averaged,
    Outputs,
    Samples,
    SamplingPlan,
)
from diffrax_symplectic._simulation.levels import Combination
from diffrax_symplectic._terms import outcomes, step_variables

from ..families import slow_except
from ..picard import by_picard
from ..problems import kubo_terms, RecordingMeter
from .steps import problem_of, sampled


KEY = jr.key(0)
Y0 = (jnp.array(0.0), jnp.array(1.0))
SQUARE = lambda t, y, args: y[1] ** 2
VERLET = ds.StormerVerlet()
WEAK = ds.WeakBrownianPath((), KEY)
MIDPOINT = ds.ImplicitMidpoint()
PENDULUM = ds.hamiltonian_terms(
    lambda t, p, q, args: p**2 / 2 - jnp.cos(q),
    lambda t, p, q, args: 0.4 * jnp.cos(q) + 0.1 * q,
    WEAK,
)
KICK = diffrax.ControlTerm(lambda t, y, args: jnp.ones(()), WEAK)
FEW = ds.ValueFunctions(3, 128, 64)


def _estimate(sampling, terms=PENDULUM, solver=VERLET, phi=SQUARE, **kwargs):
    kwargs = dict(t1=1.0, dt0=0.25, y0=Y0, key=jr.key(7), levels=1) | kwargs
    t1, dt0, y0 = (kwargs.pop(name) for name in ("t1", "dt0", "y0"))
    return ds.expectation(
        phi, terms, solver, 0.0, t1, dt0, y0, sampling=sampling, **kwargs
    )


def _enumerated(terms, solver, y, phi, h: float, steps: int):
    """The mean over all sequences of outcomes."""
    step = step_variables(terms, h)
    points, p = outcomes(step.laws, 1)

    @jax.jit
    def ends(y):
        def end(x):
            own = step.terms_with(x)
            state = solver.init(own, 0.0, h, y, None)
            return solver.step(own, 0.0, h, y, None, state, False)[0]

        return jax.vmap(end)(points)

    ys, w = jax.tree.map(lambda x: np.asarray(x)[None], y), np.ones(1)
    for _ in range(steps):
        new = [ends(jax.tree.map(lambda x: x[i], ys)) for i in range(len(w))]
        ys, w = (
            jax.tree.map(lambda *xs: np.concatenate(xs), *new),
            np.outer(w, p).ravel(),
        )
    return w @ phi(0.0, ys, None)


@pytest.mark.slow
def test_rare_paths_that_leave_the_grid_do_not_move_the_mean():
    # Of probability 1e-6: they are not among the paths, and so not in the standard error.
    quartic = lambda t, p, q, args: (p**2 + q**2) / 2 + 0.1 * (p**4 + q**4)
    noise = lambda t, p, q, args: 0.3 * jnp.stack([p * q, (q**2 - p**2) / 2])
    path = ds.WeakBrownianPath((2,), KEY, two_point=True)
    terms = ds.hamiltonian_terms(quartic, noise, path)
    solver = ds.NinomiyaVictoir()
    got = _estimate(ds.ValueFunctions(), terms, solver, t1=0.75, key=KEY)
    exact = _enumerated(terms, solver, Y0, SQUARE, 0.25, 3)
    assert got.std_error <= 3e-9
    assert abs(got.mean - exact) <= 4.5 * got.std_error


@pytest.mark.parametrize("degree", slow_except([3], [3, None]))
def test_means_are_those_over_all_outcomes_however_the_fit_is(degree):
    # The quartic is no polynomial of this degree after four steps. Four kicks in one
    # direction lead to the event: three in 4,096 paths of the own law.
    def phi(t, y, args):
        return jnp.stack([y[1] ** 4 + y[0], jnp.where(y[1] > 0.976, 1.0, 0.0)], -1)

    given = ds.ValueFunctions(degree), PENDULUM, VERLET, 0.25, Y0
    got = sampled(*given, num_steps=4, levels=1, phi=phi, key=jr.key(5))
    exact = _enumerated(PENDULUM, VERLET, Y0, phi, 0.25, 4)
    assert exact[1] == pytest.approx(1 / 6**4)
    assert np.all(np.abs(got.mean - exact) <= 4.5 * got.std_error)
    # Of as many independent paths they would be 2e-2 and more than half of the mean.
    assert 0 < got.std_error[0] < {3: 1e-4, None: 1e-9}[degree]
    assert 0 < got.std_error[1] < exact[1] / 8
    assert (got.num_paths, got.num_failed) == (4096, 0)


def _turned(power: int) -> complex:
    """The mean of exp(i power angle) after ten steps of the midpoint rule on the Kubo
    oscillator, which turns by 2 atan((h + I) / 2) in a step."""
    turn = 2 * np.arctan((0.1 + np.sqrt(0.3) * np.array([-1, 0, 1])) / 2)
    return (np.exp(1j * power * turn) @ np.array([1, 4, 1]) / 6) ** 10


@pytest.mark.parametrize(
    "dtype", slow_except([jnp.float64], [jnp.float32, jnp.float64])
)
def test_linear_systems_and_quadratic_functions_are_closed(dtype):
    shape = jax.ShapeDtypeStruct((), dtype)
    terms = kubo_terms(ds.WeakBrownianPath(shape, KEY))
    # Squares of states of this size underflow in single precision.
    size = 2.0**-70
    y0 = tuple((size * x).astype(dtype) for x in Y0)
    rounding = 50 * np.finfo(dtype).eps

    def phi(t, y, args):
        p, q = y[0] / size, y[1] / size
        return {"q2": q**2, "both": jnp.stack([p, p * q])}

    # In single precision rounding is the larger error, which is told.
    told = pytest.warns(UserWarning, match="over 10 steps in float32")
    with told if dtype == jnp.float32 else contextlib.nullcontext():
        got = _estimate(
            ds.ValueFunctions(2, 600), terms, by_picard(MIDPOINT, size * rounding / 50),
            phi, dt0=0.1, y0=y0, ts=[0.0, 1.0],
        )  # fmt: skip
    assert got.num_failed == 0
    # From (p, q) = (0, 1) the oscillator is at (-sin, cos) of the angle.
    one, two = _turned(1), _turned(2)
    np.testing.assert_allclose(got.mean["q2"], [1.0, (1 + two.real) / 2], atol=rounding)
    expected = [[0.0, 0.0], [-one.imag, -two.imag / 2]]
    np.testing.assert_allclose(got.mean["both"], expected, atol=rounding)
    assert max(map(np.max, jax.tree.leaves(got.std_error))) < rounding


def _harmonic(n: int, m: int):
    """A chain of oscillators with m constant noises."""
    share = np.sin(1.0 + np.arange(m)[:, None] * (1 + np.arange(n)))
    return ds.hamiltonian_terms(
        lambda t, p, q, args: (p @ p + q @ q + jnp.sum(jnp.diff(q) ** 2)) / 2,
        lambda t, p, q, args: 0.3 * jnp.asarray(share) @ q,
        ds.WeakBrownianPath((m,), KEY),
    )


@pytest.mark.parametrize("n, m", [(1, 5), (8, 2)])
@pytest.mark.slow
def test_many_noises_and_many_dimensions_are_closed_where_they_can_be(n, m):
    # 243 outcomes: by derivatives. 16 dimensions: by mean derivatives.
    terms, y0 = _harmonic(n, m), (jnp.zeros(n), jnp.ones(n))
    phi = lambda t, y, args: y[1] @ y[1]
    got = _estimate(ds.ValueFunctions(2, 256), terms, phi=phi, dt0=0.125, y0=y0)
    plain = _estimate(ds.IndependentPaths(20_000), terms, phi=phi, dt0=0.125, y0=y0)
    assert abs(got.mean - plain.mean) <= 4 * plain.std_error
    assert got.std_error < 1e-12


@pytest.mark.slow
def test_the_degree_is_chosen_for_each_number_by_fresh_paths_and_never_worse_than_plain():
    got = _estimate(ds.ValueFunctions(), phi=_jumps)
    plain = _estimate(ds.ValueFunctions(0), phi=_jumps)
    for a, b in zip(got.std_error, plain.std_error):
        assert a <= 1.05 * b
    assert got.std_error[2] < 1e-9 and "64, chosen among 0, 64" in got.reason


def _jumps(t, y, args):
    """A jump, which no polynomial is close to; and what polynomials leave nothing of."""
    p, q = y
    return q > 0.5, jnp.cos(40 * q), q


@pytest.mark.parametrize("factor", [-1.0, np.nan])
def test_a_fit_that_is_worse_than_none_is_not_used(factor, monkeypatch):
    fits, run = value_functions._fits, value_functions.run
    spoiled = lambda u: eqx.tree_at(
        lambda u: u.coefficients, u, replace_fn=lambda c: factor * c
    )
    trials = []

    def recorded(plan, key, devices):
        trials.append(key)
        return run(plan, key, devices)

    monkeypatch.setattr(value_functions, "_fits", lambda *args: spoiled(fits(*args)))
    monkeypatch.setattr(value_functions, "run", recorded)
    with pytest.warns(UserWarning, match="`degree=3` is no better"):
        got = _estimate(FEW)
    assert got.reason == "degree: 0, chosen among 0, 3"
    best = combined_results(got, Combination.BEST)
    assert got.std_error == best.plain_std_error
    assert not best.dropped
    # The paths that choose are not those that estimate.
    sample = lambda key, i: jr.key_data(jr.fold_in(jr.fold_in(key, 0), i))
    keys = lambda key: {tuple(map(int, sample(key, i))) for i in range(128)}
    (trial,) = trials
    assert keys(jr.key(7)).isdisjoint(keys(trial))


def test_wider_noise_knows_its_likelihood_and_its_entropy():
    two = lambda t, p, q, args: jnp.stack([q, q**2])
    path = ds.WeakBrownianPath((2,), KEY)
    terms = ds.hamiltonian_terms(lambda t, p, q, args: (p**2 + q**2) / 2, two, path)
    problem = problem_of(terms, VERLET, 0.05, Y0, num_steps=20, levels=1)
    noise = Noise.of(problem, problem.level(0))
    p = {-1: 1 / 6, 0: 2 / 3, 1: 1 / 6}
    own = lambda x: np.array([p[k] for k in np.sign(x)])
    mixture = Mixture.of(problem)
    (cuts,) = mixture.cuts
    (log_ratios,) = mixture.log_ratios
    # The own law, the wide one, and the first noise pushed up and the second down.
    for law in (0, 1, 4):
        draw = jax.jit(jax.vmap(lambda key: noise.draw(key, jnp.array(0), cuts[law])))
        x, has_outcome = map(np.asarray, draw(jr.split(jr.key(1), 4000)))
        log_ratio = np.sum(log_ratios[law] * has_outcome, axis=(1, 2))
        pairs = {tuple(np.sign(a)): b for a, b in zip(x, log_ratio)}
        assert len(pairs) == 9
        likely = np.array([own(a).prod() * np.exp(b) for a, b in pairs.items()])
        assert abs(likely.sum() - 1) <= 1e-12
        entropy = likely @ np.array([*pairs.values()])
        assert abs(problem.finest_steps * entropy - (4 if law else 0)) <= 1e-6
        # Four standard errors.
        mean = likely @ np.array([*pairs])
        assert np.all(np.abs(np.sign(x).mean(0) - mean) <= 4 / np.sqrt(len(x)))
        assert mean[0] > 0.2 > -0.2 > mean[1] if law == 4 else np.allclose(mean, 0)


@pytest.mark.core
def test_the_weights_of_a_mixture_have_mean_one_and_are_those_of_all_laws():
    problem = problem_of(PENDULUM, VERLET, 0.25, Y0, num_steps=4)
    mixture = Mixture.of(problem)
    alone = mixture.own_law_alone()

    @jax.jit
    def drawn(keys):
        laws = jax.vmap(mixture.draw_law)(keys)
        log_ratios = 0.0
        for level in (0, 1):
            noise = Noise.of(problem, problem.level(level))

            def of_step(i, key, law, noise=noise, level=level):
                cuts = jnp.asarray(mixture.cuts)[level, law]
                _, has_outcome = noise.draw(key, i, cuts)
                return log_ratios_of_outcomes(mixture.log_ratios[level], has_outcome)

            of_paths = jax.vmap(of_step, in_axes=(None, 0, 0))
            steps = jnp.arange(4 * (level + 1))
            of_steps = jax.vmap(of_paths, in_axes=(0, None, None))(steps, keys, laws)
            log_ratios += jnp.sum(of_steps, axis=0)
        return laws, log_ratios, jax.vmap(alone.draw_law)(keys)

    laws, log_ratios, laws_alone = map(np.asarray, drawn(jr.split(jr.key(2), 4000)))
    counts = np.bincount(laws, minlength=4)
    assert np.all(np.abs(counts - 4000 * mixture.shares) <= 4 * np.sqrt(counts))
    weights = mixture.weights(jnp.asarray(log_ratios))
    expected = 1 / (np.exp(log_ratios) @ mixture.shares)
    np.testing.assert_allclose(weights, expected, rtol=1e-12)
    assert np.max(weights) <= 2
    assert abs(np.mean(weights) - 1) <= 4 * np.std(weights) / np.sqrt(4000)
    assert not np.any(laws_alone)
    np.testing.assert_array_equal(alone.weights(jnp.asarray(log_ratios)), 1)


class _Counting(diffrax.AbstractSolver):
    """Moves by the number of steps that it remembers, and by the noise, and fails where
    noise has moved it far up in eight steps."""

    term_structure = diffrax.AbstractTerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 1

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        return jnp.zeros(())

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = y0 + solver_state + terms.contr(t0, t1)
        ok = diffrax.RESULTS.successful
        lost = diffrax.RESULTS.internal_error
        result = diffrax.RESULTS.where(y1 > sum(range(8)) + 3.9, lost, ok)
        return y1, None, dict(y0=y0, y1=y1), solver_state + 1, result


def test_paths_that_fail_by_another_law_alone_are_reported_and_do_not_count():
    # The own law leads there twice in a hundred thousand paths, a push upward often.
    problem = problem_of(KICK, _Counting(), 0.125, jnp.zeros(()), levels=1)
    plan = ds.ValueFunctions(1, 256, 256).prepare(problem, KEY, jax.devices()[:1])
    samples = jax.jit(plan.sampler)(jr.split(jr.key(3), 1000))
    assert np.sum(samples.also_failed) > 10
    assert not np.any(samples.num_failed) and np.all(samples.good)
    # The solver goes on with its own state, and the fit is exact.
    values = samples.averaged.value
    assert np.all(np.isfinite(values))
    assert abs(np.mean(values) - sum(range(8))) < 1e-12


def _newton_steps(problem, keys):
    """Samples of the number of Newton's steps, of which none count as failed."""
    newton_steps = problem.solver.root_finder.newton_steps
    ones = jnp.ones(len(keys), bool)
    return Samples(
        Averaged(jnp.full((1, len(keys), 1), float(newton_steps))),
        good=ones,
        num_failed=jnp.zeros((1, len(keys)), bool),
        also_failed=ones if newton_steps == 0 else ~ones,
    )


def test_newtons_method_takes_part_where_paths_fail_that_do_not_count():
    problem = problem_of(PENDULUM, MIDPOINT, 0.25, Y0, levels=1)
    sampler = jax.tree_util.Partial(_newton_steps, problem)
    plan = SamplingPlan(sampler, Outputs.of(problem), num_samples=8, batch_size=4)
    got = run(plan, KEY, tuple(jax.devices()[:1]))
    assert got.mean == MIDPOINT.root_finder.newton_steps > 0


@pytest.mark.parametrize(
    "state, noises, steps, gaussian, kind",
    [
        (2, 1, 4, False, ds.ValueFunctions),
        (2, 1, 2**14, False, ds.ArrayRQMC),
        (2, 4, 4, False, ds.ArrayRQMC),
        (2, 1, 4, True, ds.ArrayRQMC),
        (4, 1, 4, False, ds.ArrayRQMC),
        (6, 1, 4, False, ds.IndependentPaths),
    ],
)
def test_the_sampling_follows_from_dimension_outcomes_and_steps(
    state, noises, steps, gaussian, kind
):
    path = (ds.FixedStepBrownianPath if gaussian else ds.WeakBrownianPath)(
        (noises,), KEY
    )
    H0 = lambda t, p, q, args: (p @ p + q @ q) / 2
    noise = lambda t, p, q, args: jnp.arange(1.0, noises + 1) * jnp.sum(q)
    terms = ds.hamiltonian_terms(H0, noise, path)
    y0 = (jnp.zeros(state // 2), jnp.ones(state // 2))
    problem = problem_of(terms, VERLET, 1 / steps, y0, num_steps=steps, levels=1)
    for tol in (None, 1e-3):
        sampling, reason = sampling_for(problem, tol)
        assert type(sampling) is kind
        assert f"{state} components of the state, {steps:,} steps" in reason
    # Paths that cannot be made of given words.
    other = ds.hamiltonian_terms(H0, noise, diffrax.UnsafeBrownianPath((noises,), KEY))
    problem = problem_of(other, VERLET, 1 / steps, y0, num_steps=steps, levels=1)
    assert type(sampling_for(problem, None)[0]) is ds.IndependentPaths


@pytest.mark.slow
def test_the_default_is_the_same_each_time_and_goes_on_with_itself():
    estimate = lambda **kwargs: _estimate(None, levels=None, **kwargs)
    got = estimate(tol=1e-6)
    assert isinstance(got.sampling, ds.ValueFunctions) and got.tol_reached
    # Three levels: two leave more of the discretization error.
    assert got.reason.startswith(
        "value functions for 2 components of the state, 60 steps of 3"
    )
    again, more = estimate(tol=1e-6), estimate(start=got)
    assert (again.mean, again.std_error) == (got.mean, got.std_error)
    assert more.reason == got.reason and more.num_paths == got.num_paths


def test_a_fit_that_would_take_long_is_coarser():
    at = lambda steps: problem_of(
        PENDULUM, VERLET, 1 / steps, Y0, num_steps=steps, levels=1
    )
    sites = [
        chosen_basis(at(steps), None).basis.num_sites
        for steps in (100, 10_000, 100_000)
    ]
    assert sites == sorted(sites, reverse=True) and len(set(sites)) == 3
    assert 100_000 * 3 * sites[-1] < 2**27


def test_a_meter_is_shown_before_the_trials_and_closed_if_they_fail(monkeypatch):
    calls = []

    def fails(*args):
        assert calls == ["init"]
        raise RuntimeError("a trial")

    monkeypatch.setattr(ds.ValueFunctions, "prepare", fails)
    with pytest.raises(RuntimeError, match="a trial"):
        _estimate(ds.ValueFunctions(), progress_meter=RecordingMeter(calls))
    assert calls == ["init", ("closed after", 0)]


def test_bad_input_is_told_what_to_pass():
    gaussian = kubo_terms(ds.FixedStepBrownianPath((), KEY))
    with pytest.raises(ValueError, match="Use a `WeakBrownianPath` in place"):
        _estimate(ds.ValueFunctions(2), gaussian, ds.ImplicitMidpoint())
    many = _harmonic(32, 2)
    y0 = (jnp.zeros(32), jnp.ones(32))
    with pytest.raises(ValueError, match=r"has 47,905 polynomials in 64 dimensions"):
        _estimate(ds.ValueFunctions(3), many, y0=y0)
    with pytest.raises(ValueError, match="`degree` must be an integer, 0 or larger"):
        _estimate(ds.ValueFunctions(-1))
    with pytest.raises(ValueError, match="`num_paths` must be an integer, 2 or larger"):
        ds.ValueFunctions(2, 0)
    fitted = _estimate(FEW)
    with pytest.raises(ValueError, match="was sampled by ValueFunctions"):
        _estimate(ds.IndependentPaths(1000), start=fitted)
    with pytest.raises(ValueError, match="`sampling` must be an instance of"):
        _estimate(1000)


@pytest.mark.slow
def test_a_fit_whose_steps_are_too_long_for_sweeps_is_made_by_newtons_method():
    got = _estimate(ds.ValueFunctions(2), kubo_terms(WEAK), MIDPOINT, t1=16.0, dt0=8.0)
    assert got.num_failed == 0
    assert got.std_error <= 1e-12


@pytest.mark.slow
def test_the_default_sorts_paths_where_a_fit_leaves_much():
    indicator = lambda t, y, args: jnp.where(y[1] > 0.6, 1.0, 0.0)
    got = _estimate(None, phi=indicator)
    fitted = _estimate(ds.ValueFunctions(), phi=indicator)
    assert isinstance(got.sampling, ds.ArrayRQMC)
    assert "leave" in got.reason
    assert got.std_error < fitted.std_error / 5
    # A smooth function keeps its fit.
    assert isinstance(_estimate(None).sampling, ds.ValueFunctions)


def test_the_default_ends_where_the_error_of_the_steps_is_far_larger(monkeypatch):
    problem = problem_of(PENDULUM, VERLET, 0.25, Y0, num_steps=4, phi=SQUARE)
    devices = tuple(jax.devices()[:1])
    given = lambda sampling: (
        lambda want: problem, True, KEY, sampling, None, None, None, devices
    )  # fmt: skip
    _, sampling, plan = choose(*given(None))
    got = run(plan, KEY, devices)
    assert isinstance(sampling, ds.ValueFunctions) and got.num_paths == 1024
    assert got.std_error < 0.1 * got.discretization_error
    # As many as the user asks for.
    unlimited = plan._replace(least_beside_steps=None)
    monkeypatch.setattr(ds.ValueFunctions, "prepare", lambda *given: unlimited)
    assert choose(*given(sampling))[2].least_beside_steps is None


def test_polynomials_are_orthonormal_and_fits_nested():
    x, w = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    weights = np.outer(w, w).ravel() / (2 * np.pi)
    B = np.asarray(jax.jit(jax.vmap(lambda z: jnp.stack(hermite(z, 4))))(grid))
    assert B.shape[1] == len(exponents(2, 4)) == 15
    np.testing.assert_allclose((B.T * weights) @ B, np.eye(15), atol=1e-12)
    values = np.random.default_rng(0).normal(size=(144, 2))
    values[:, 1] = B[:, :6] @ np.ones(6)
    fit = jax.jit(least_squares, static_argnums=2)
    got = fit(B, values, (3, 6))
    expected = np.linalg.lstsq(B[:, :3], values, rcond=None)[0]
    np.testing.assert_allclose(got[:3, 0], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got[:, 1, 1], [1] * 6 + [0] * 9, atol=1e-9)
    # Of two columns that are one, none explodes.
    twice = np.concatenate([B[:, :3], B[:, 2:3]], axis=1)
    got = fit(twice, values[:, 1:], (4,))
    smallest = np.linalg.lstsq(twice, values[:, 1:], rcond=None)[0]
    np.testing.assert_allclose(got[:, 0], smallest, atol=1e-3)


def test_points_whose_values_overflow_are_left_out_of_a_fit():
    basis, good = Hermite(2, 2), jnp.ones(200, bool)
    points = np.random.default_rng(0).normal(size=(200, 2))
    values = (points[:, 0] ** 2 - points[:, 1])[:, None, None]
    spoiled = values.copy()
    spoiled[:5], spoiled[5] = np.inf, np.nan

    @jax.jit
    def fitted(values):
        frame = CovarianceFrame.of(points, good, jnp.ones(2))
        return basis.least_squares_fits(values, frame, points, good, [2])

    np.testing.assert_allclose(fitted(spoiled), fitted(values), atol=1e-9)


def test_a_grid_interpolates_with_degree_five_and_is_zero_beyond():
    grid, axis = Grid(2, 12), np.linspace(-1, 1, 12)
    fn = lambda x, y: (x**5 - x) * (y**5 + y**2)
    c = jnp.asarray(fn(*np.meshgrid(axis, axis, indexing="ij"))).reshape(-1, 1)
    # Two points at least are to lie on either side.
    inner = axis[9]
    x = np.random.default_rng(0).uniform(-inner, inner, size=(50, 2))
    at = jax.jit(jax.vmap(lambda x: grid.interpolate(x, c)[0]))
    np.testing.assert_allclose(at(x), fn(*x.T), atol=1e-13)
    assert not np.any(at(np.where(np.abs(x) < inner / 2, x + np.sign(x), 2 * x)))


def test_what_a_grid_corrects_is_exact_at_its_points_and_falls_to_zero_at_its_edge():
    grid, good = Grid(2, 16), jnp.ones(1000, bool)
    points = np.random.default_rng(0).normal(size=(1000, 2))
    axis = np.linspace(-1, 1, 16)
    fn = lambda y: jnp.exp(y[0] - y[1] / 2)
    inner = np.stack(np.meshgrid(axis[3:-3], axis[3:-3]), -1).reshape(-1, 2)

    @jax.jit
    def fitted(points):
        frame = grid.frame(points, good, jnp.ones(2))
        value = lambda y: fn(y)[None, None]
        c = grid.coefficients(value, frame, points, good, None)
        nodes = frame.states(inner)
        at_nodes = jax.vmap(lambda y: grid.value_at(frame, y, c)[0, 0])(nodes)
        return c[-(16**2) :].reshape(16, 16), at_nodes, jax.vmap(fn)(nodes)

    correction, got, expected = fitted(points)
    np.testing.assert_allclose(got, expected, rtol=1e-9)
    rim = np.pad(np.zeros((14, 14), bool), 1, constant_values=True)
    assert np.all(correction[rim] == 0) and np.all(correction[~rim] != 0)


@pytest.mark.parametrize("heavy", [False, True])
def test_a_grid_is_even_where_most_states_are_and_holds_all(heavy):
    points = np.random.default_rng(0).normal(size=(2000, 2))
    points = np.sign(points) * np.expm1(3 * np.abs(points)) if heavy else points
    points = points @ np.array([[1.0, 2.0], [0.0, 0.1]])

    @jax.jit
    def there_and_back(points):
        grid = Grid(2, 64).frame(points, jnp.ones(2000, bool), jnp.ones(2))
        x = grid.coordinates(points)
        return x, grid.states(x)

    x, back = there_and_back(points)
    assert 0.5 < np.abs(x).max() < (1 if heavy else 0.75)
    np.testing.assert_allclose(back, points, rtol=1e-9, atol=1e-9)
    # Between the quartiles there are ten points, at least.
    between = np.diff(np.quantile(x, [0.25, 0.75], axis=0), axis=0)
    assert np.all(between > 3 * 2 / 63), between * 63 / 2


def test_frames_do_not_depend_on_units_and_leave_out_what_does_not_move():
    mixed = np.array([[3.0, 1, 0], [0, 2, 0], [1, 0, 1]])
    points = np.random.default_rng(0).normal(size=(500, 3)) @ mixed

    @jax.jit
    def in_frame(points, scale):
        frame = CovarianceFrame.of(points, jnp.ones(500, bool), scale)
        z = frame.coordinates(points)
        return z, frame.states(z), frame.perturbed(points)

    z, back, _ = map(np.asarray, in_frame(points, np.ones(3)))
    np.testing.assert_allclose(z.T @ z / 500, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(back, points, atol=1e-12)
    scale = np.array([1.0, 2.0**90, 2.0**-90])
    np.testing.assert_array_equal(in_frame(points * scale, scale)[0], z)
    still = np.append(points, np.full((500, 1), 7e-30), axis=1)
    z, _, perturbed = in_frame(still, np.array([1.0, 1, 1, 0]))
    np.testing.assert_array_equal(perturbed[:, 3], still[:, 3])
    assert np.all(np.isfinite(z))
