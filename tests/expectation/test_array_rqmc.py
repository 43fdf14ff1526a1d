"""Expectations by `ArrayRQMC`, its points and their order, and what all samplings share:
each path has its law, and what is estimated is exact up to the spread that is reported."""

import functools as ft
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.sorted.array_rqmc import word_layout
from diffrax_symplectic._expectation.sorted.hilbert import (
    _places_on_curve,
    hilbert_order,
)
from diffrax_symplectic._expectation.sorted.points import (
    _JOE_AND_KUO,
    _sobol_points_of_scipy,
    balanced_in_sixths,
    num_seeds,
    scrambled,
    sobol_points,
)
from diffrax_symplectic._simulation import loop
from diffrax_symplectic._terms import brownian_paths

from . import cells
from .steps import problem_of, sampled


Y0 = (jnp.array(0.0), jnp.array(1.0))
VERLET = ds.StormerVerlet()
SQUARE = lambda t, y, args: y[1] ** 2
TERMS = cells.TERMS["multiplicative"]
PATH = ds.WeakBrownianPath((), jr.key(0))
NOISE = diffrax.ControlTerm(lambda t, y, args: jnp.ones(()), PATH)
GROWING = diffrax.ControlTerm(lambda t, y, args: y, PATH)


def _mean_square(steps: int) -> float:
    """Of the position after these steps up to 1, in closed form."""
    return cells.moment(cells.Cell("multiplicative", 1.0, 1.0, steps), 2)[4]


def _estimate(solver=VERLET, terms=TERMS, phi=SQUARE, **kwargs):
    kwargs = dict(t1=1.0, dt0=0.1, y0=Y0, key=jr.key(7)) | kwargs
    kwargs = dict(num_paths=256, replicates=4, sort_by=None, levels=1) | kwargs
    t1, dt0, y0 = (kwargs.pop(name) for name in ("t1", "dt0", "y0"))
    own = [kwargs.pop(name) for name in ("num_paths", "replicates", "sort_by")]
    given = phi, terms, solver, 0.0, t1, dt0, y0, 1.0
    return ds.expectation(*given, sampling=ds.ArrayRQMC(*own), **kwargs)


def test_two_levels_extrapolate_and_are_exact_up_to_the_spread_that_they_report():
    given = ds.ArrayRQMC(256, 16), TERMS, VERLET, 0.1, Y0, 1.0
    got = sampled(*given, num_steps=10, phi=SQUARE, key=jr.key(7))
    one, other = _mean_square(10), _mean_square(20)
    # Student's distribution with 15 degrees of freedom is beyond 4.9 once in 5,000.
    assert abs(got.mean - (2 * other - one)) <= 4.9 * got.std_error
    # Of the finer level, with its sign.
    assert abs(got.bias - (one - other)) <= 4.9 * got.bias_std_error
    assert got.bias_std_error < got.std_error
    # Of as many independent paths it would be 1.2e-2.
    assert 0 < got.std_error < 4e-3


@pytest.mark.core
@pytest.mark.slow
def test_paths_in_blocks_are_those_of_one_batch(monkeypatch):
    whole = _estimate(levels=2)
    # Another program, which is compiled anew.
    phi = lambda t, y, args: y[1] * y[1]
    monkeypatch.setattr(loop, "_PATHS_AT_ONCE", 64)
    got = _estimate(phi=phi, levels=2)
    np.testing.assert_allclose(got.mean, whole.mean, rtol=1e-13)
    np.testing.assert_allclose(got.std_error, whole.std_error, rtol=1e-9)


def test_ito_solvers_are_refused_for_terms_of_stratonovich():
    for terms in (GROWING, diffrax.MultiTerm(NOISE, GROWING)):
        with pytest.raises(ValueError, match="in the sense of Ito.*`diffrax.Heun`"):
            problem_of(terms, diffrax.Euler(), 0.1, jnp.ones(()))


def test_of_one_step_the_law_is_balanced_to_the_last_path():
    # Of 256 paths a sixth is 42.67, and blocks of six are cut off at either end.
    signs = lambda t, y, args: jnp.stack([y < -1e-3, y > 1e-3, jnp.abs(y) < 1e-3])
    at = lambda replicates, seed: sampled(
        ds.ArrayRQMC(256, replicates), NOISE, diffrax.Heun(), 0.1, jnp.zeros(()),
        num_steps=1, levels=1, phi=signs, key=jr.key(seed),
    )  # fmt: skip
    for seed in range(3):
        counts = 2 * 256 * at(2, seed).mean
        assert np.all(np.abs(counts[:2] - 2 * 256 / 6) <= 2 * 5 / 3)
        np.testing.assert_allclose(counts.sum(), 2 * 256)
    got = at(64, 0)
    assert np.all(np.abs(got.mean - [1 / 6, 1 / 6, 2 / 3]) <= 5 * got.std_error)


def test_means_are_taken_at_the_times_given_over_paths_that_have_not_failed():
    def drift(t, y, args):
        # All go up by one in the first step. What is also kicked downwards fails later, in
        # one step, and stays failed.
        lost = (t > 0.15) & (t < 0.25) & (y < 0.9)
        return jnp.where(t < 0.05, 10.0, jnp.where(lost, jnp.nan, 0.0))

    kick = diffrax.ControlTerm(lambda t, y, args: jnp.where(t < 0.05, 1.0, 0.0), PATH)
    terms = diffrax.MultiTerm(diffrax.ODETerm(drift), kick)
    got = sampled(
        ds.ArrayRQMC(64, 4), terms, diffrax.EulerHeun(), 0.1, jnp.zeros(()),
        num_steps=4, levels=1, phi=lambda t, y, args: {"t": t, "y": y}, ts=[0.4, 0.0, 0.1],
    )  # fmt: skip
    np.testing.assert_allclose(got.mean["t"], [0.4, 0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(got.mean["y"][1], 0.0)
    # 10 or 11 of 64 go down, as many go up, and these stay where they are.
    assert 4 * 10 <= got.num_failed <= 4 * 11
    up = 1 + np.sqrt(0.3) * np.array([10 / 54, 11 / 53])
    assert up[0] - 1e-12 <= got.mean["y"][0] <= up[1] + 1e-12


def test_it_stops_at_the_tolerance_with_the_replicates_of_the_whole():
    whole = _estimate(replicates=16)
    assert abs(whole.mean - _mean_square(10)) <= 4.9 * whole.std_error
    assert (whole.num_samples, whole.num_paths, whole.num_failed) == (16, 2**12, 0)
    assert whole.bias is None and whole.tol_reached is None
    low, high = whole.interval(0.95)
    np.testing.assert_allclose(high - low, 2 * 2.13145 * whole.std_error, rtol=1e-5)
    got = _estimate(replicates=12, tol=1.0)
    eight = _estimate(replicates=8)
    assert got.tol_reached and got.num_samples == 8
    assert (got.mean, got.std_error) == (eight.mean, eight.std_error)
    with pytest.warns(UserWarning, match="`tol=1e-12` was not reached"):
        never = _estimate(replicates=3, tol=1e-12)
    assert never.tol_reached is False and never.num_samples == 3
    # It goes on where it stopped.
    rest = _estimate(replicates=16, start=never)
    np.testing.assert_allclose(rest.mean, whole.mean, rtol=1e-14)


def test_solvers_of_diffrax_work_in_single_precision():
    dtype = jnp.float32
    shape, area = jax.ShapeDtypeStruct((1,), dtype), diffrax.SpaceTimeLevyArea
    path = ds.FixedStepBrownianPath(shape, jr.key(0), levy_area=area)
    drift = diffrax.ODETerm(lambda t, y, args: -y)
    noise = diffrax.ControlTerm(lambda t, y, args: jnp.full((1, 1), 0.5, dtype), path)
    terms = diffrax.MultiTerm(drift, noise)
    given = terms, diffrax.ShARK(), 0.1, jnp.zeros(1, dtype)
    square = lambda t, y, args: y[0] ** 2
    got = sampled(ds.ArrayRQMC(512, 4), *given, num_steps=10, levels=1, phi=square)
    # An Ornstein-Uhlenbeck process, up to the error of the steps.
    assert abs(got.mean - 0.125 * (1 - np.exp(-2))) <= 1e-3
    assert got.std_error < 5e-4
    assert got.mean.dtype == np.float64


def test_equal_paths_are_one_brownian_motion():
    path = ds.WeakBrownianPath((2,), jr.key(0), two_point=True)
    other = ds.WeakBrownianPath((2,), jr.key(1), two_point=True)
    term = lambda path: diffrax.ControlTerm(lambda t, y, args: y, path)
    terms = diffrax.MultiTerm(term(path), term(other), term(path))
    assert word_layout(terms) == (((0, 4), (4, 8), (0, 4)), 8, False)
    assert word_layout(NOISE) == (((0, 1),), 1, True)


@pytest.mark.parametrize(
    "message, kwargs",
    [
        ("`num_paths` must be a power of two", dict(num_paths=1000)),
        ("`num_paths` must be an integer", dict(num_paths=1)),
        ("`replicates` must be an integer, 2 or larger", dict(replicates=1)),
        ("Pass fewer levels", dict(levels=31)),
        ("`start` must be what `expectation` returned", dict(start=3)),
        ("`dt0` must be numbers; got dt0='0.1'", dict(dt0="0.1")),
        ("`dt0` must be numbers; got", dict(dt0=Y0)),
        ("and `t1` after `t0`; got dt0=0.1, t0=0.0, t1=inf", dict(t1=np.inf)),
        ("all between `t0` and `t1`", dict(ts=[1.1])),
        ("must be positive, and `t1` after", dict(t1=-1.0)),
        ("`phi` must return real arrays", dict(phi=lambda t, y, a: 1j * y[0])),
        ("`sort_by` must return real arrays", dict(sort_by=lambda y: None)),
        (
            "`phi` must return real arrays; it returned none",
            dict(phi=lambda t, y, a: None),
        ),
        (r"called as `phi\(t, y, args\)`; got .* `\(y\)`", dict(phi=lambda y: y[0])),
        (r"called as `sort_by\(y\)`", dict(sort_by=lambda t, y, args: y)),
        ("`dt0` must be a number", dict(dt0=None)),
    ],
)
def test_bad_input_is_told_what_to_pass(message, kwargs):
    with pytest.raises(ValueError, match=message):
        _estimate(**kwargs)


@pytest.mark.parametrize(
    "traced", [dict(dt0=0.1), dict(t1=1.0), dict(y0=Y0), dict(key=jr.key(0))]
)
def test_within_a_jax_program_there_is_no_estimate(traced):
    with pytest.raises(ValueError, match="cannot run inside JAX.*`monte_carlo`"):
        jax.jit(lambda x: _estimate(**x).mean)(traced)


def test_paths_whose_words_cannot_be_chosen_are_refused():
    tree = diffrax.VirtualBrownianTree(0.0, 1.0, 1e-3, (), jr.key(0))
    for path in (tree, diffrax.UnsafeBrownianPath((), jr.key(0))):
        with pytest.raises(ValueError, match="FixedStepBrownianPath"):
            terms = diffrax.ControlTerm(lambda t, y, args: y, path)
            _estimate(diffrax.Heun(), terms, y0=jnp.ones(2))
    with pytest.raises(ValueError, match="no Brownian path, so nothing is random"):
        _estimate(terms=diffrax.ODETerm(lambda t, y, args: y))
    many = diffrax.ControlTerm(
        lambda t, y, args: jnp.zeros((1, 30_000)),
        ds.WeakBrownianPath((30_000,), jr.key(0)),
    )
    with pytest.raises(ValueError, match="30,000 random variables in each step"):
        _estimate(diffrax.Heun(), many, y0=jnp.ones(1))


class _Remembering(diffrax.AbstractSolver):
    """Takes Euler's steps, and fails where its state is not that of the same path, or where
    `lost` says so."""

    lost: Callable = lambda y, args: False

    term_structure = diffrax.AbstractTerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 1

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        return y0

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = y0 + terms.vf_prod(t0, y0, args, terms.contr(t0, t1))
        ok = diffrax.RESULTS.successful
        lost = diffrax.RESULTS.internal_error
        # What is no number is not taken for another state.
        same = jnp.all((y0 == solver_state) | ~jnp.isfinite(y0))
        good = same & ~jnp.asarray(self.lost(y0, args))
        result = diffrax.RESULTS.where(good, ok, lost)
        return y1, None, dict(y0=y0, y1=y1), y1, result


def test_a_path_fails_by_its_result_its_state_or_its_phi():
    # One of the three alone, by `args`, in one program; a sixth of the paths goes down in
    # the first of two steps. Where the state of the solver did not go along with its path,
    # more would fail.
    of = {by: jnp.array(number) for number, by in enumerate(("result", "state", "phi"))}
    is_lost = lambda by, y, args: (args == of[by]) & (y[0] < -1e-3)
    spoil = lambda t, y, args: jnp.where(
        is_lost("state", y, args), jnp.array([0.0, jnp.nan]), 0.0
    )
    noise = diffrax.ControlTerm(lambda t, y, args: jnp.array([1.0, 0.0]), PATH)
    terms = diffrax.MultiTerm(diffrax.ODETerm(spoil), noise)
    solver = _Remembering(ft.partial(is_lost, "result"))
    phi = lambda t, y, args: jnp.where(is_lost("phi", y, args), jnp.nan, 1.0)
    sampling = ds.ArrayRQMC(64, 4, sort_by=lambda y: y[0])
    for by, number in of.items():
        given = terms, solver, 0.1, jnp.zeros(2), number
        got = sampled(sampling, *given, num_steps=2, levels=1, phi=phi)
        assert 4 * 10 <= got.num_failed <= 4 * (11 if by != "phi" else 24)
        np.testing.assert_allclose(got.mean, 1.0)


@pytest.mark.parametrize("solver", [ds.StormerVerlet(), ds.SRKw5(), diffrax.Heun()])
def test_a_shape_stands_for_the_path_that_the_solver_needs(solver):
    terms = ds.hamiltonian_terms(lambda t, p, q, args: q, lambda t, p, q, args: q, ())
    (path,) = brownian_paths(problem_of(terms, solver, 0.25, Y0).terms)
    if isinstance(solver, ds.AbstractSymplecticSolver):
        expected = solver.path((), path.key, want="weak")
    else:
        area = diffrax.SpaceTimeLevyArea
        expected = ds.FixedStepBrownianPath((), path.key, area)
    assert eqx.tree_equal(path, expected)


@pytest.mark.parametrize("n", [2, 2**14])
def test_direction_numbers_are_those_of_scipy(n):
    for d in (1, len(_JOE_AND_KUO), len(_JOE_AND_KUO) + 1):
        points = _sobol_points_of_scipy(n, d)
        np.testing.assert_array_equal(sobol_points(n, d), points)


def test_points_are_a_digital_net_after_scrambling():
    n, d = 256, 2
    seeds = jr.bits(jr.key(0), (50, num_seeds(d)), jnp.uint32)
    points = jnp.asarray(sobol_points(n, d))
    words = np.asarray(jax.jit(jax.vmap(lambda s: scrambled(points, s)))(seeds))
    for k in range(1, 9):
        # 2^k consecutive points, and 2^k intervals for each coordinate.
        cells = (words >> np.uint32(32 - k)).reshape(50, -1, 2**k, d)
        cells = np.sort(cells, axis=2)
        assert np.all(cells == np.arange(2**k)[:, None])
    # The two coordinates together are one, too: 16 boxes by 16.
    boxes = (words[..., 0] >> np.uint32(28)) * 16 + (words[..., 1] >> np.uint32(28))
    assert np.all(np.sort(boxes, axis=1) == np.arange(n))
    assert len(np.unique(words[:, 0, 0])) == 50


def test_one_three_point_variable_is_balanced_among_any_six():
    n = 256
    seeds = jr.bits(jr.key(0), (4000, num_seeds(1)), jnp.uint32)
    points = jnp.asarray(sobol_points(n, 1))
    sixths = jax.jit(jax.vmap(lambda s: balanced_in_sixths(points, s)))
    words = np.asarray(sixths(seeds))[..., 0].astype(np.int64)
    signs = (words >= 2**32 - 2**32 // 6).astype(int) - (words < 2**32 // 6)
    for sign in (-1, 1):
        # Only the blocks that are cut off at the ends are not balanced.
        count = np.cumsum(signs == sign, axis=1)
        excess = np.abs(count - np.arange(1, n + 1) / 6)
        assert excess.max() <= 2
        # At each place the probability is a sixth: 4.5 standard errors of 4,000.
        at_place = np.mean(signs == sign, axis=0)
        assert np.abs(at_place - 1 / 6).max() <= 4.5 * np.sqrt(5 / 36 / 4000)
    # The seeds give different arrangements.
    assert len(np.unique(signs, axis=0)) > 3990


@pytest.mark.parametrize("d, bits", [(2, 4), (3, 3), (5, 2)])
def test_the_curve_meets_each_cell_once_and_goes_on_to_its_neighbour(d, bits):
    axes = np.meshgrid(*[np.arange(2**bits)] * d, indexing="ij")
    cells = np.stack(axes, -1).reshape(-1, d).astype(np.uint32)
    place = np.asarray(_places_on_curve([*jnp.asarray(cells).T], bits, jnp.uint64))
    np.testing.assert_array_equal(np.sort(place), np.arange(len(cells)))
    moves = np.diff(cells[np.argsort(place)].astype(int), axis=0)
    assert np.all(np.abs(moves).sum(axis=1) == 1)


@pytest.mark.parametrize("x64", [True, False])
def test_sorting_is_a_permutation_by_place_with_the_failed_ones_last(x64):
    jax.config.update("jax_enable_x64", x64)
    try:
        z = jr.normal(jr.key(0), (1000, 1), float)
        # Neither what is far away nor what is no number disturbs the others.
        z = z.at[3].set(1e30).at[5].set(jnp.nan)
        last = jnp.zeros(1000, bool).at[jnp.array([3, 5, 77])].set(True)
        order = np.asarray(jax.jit(hilbert_order)(z, last))
    finally:
        jax.config.update("jax_enable_x64", True)
    np.testing.assert_array_equal(np.sort(order), np.arange(1000))
    assert set(order[-3:]) == {3, 5, 77}
    good = np.clip(np.asarray(z)[order[:-3], 0], -2, 2)
    assert np.all(np.diff(good) > -1e-3)
