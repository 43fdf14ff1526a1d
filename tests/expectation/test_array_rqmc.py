"""Expectations by `ArrayRQMC` and what all samplings share: each path has its law, and what
is estimated is exact up to the spread that is reported."""

import functools as ft
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.sorted.array_rqmc import word_layout
from diffrax_symplectic._simulation import loop
from diffrax_symplectic._simulation.levels import level_weights

from ..families import slow_except
from ..picard import by_picard
from ..problems import kubo_terms


Y0 = (jnp.array(0.0), jnp.array(1.0))
SQUARE = lambda t, y, args: y[1] ** 2


def _midpoint_moment(n: int, h: float) -> float:
    """E(q^2) after n steps of the midpoint rule on the Kubo oscillator, in closed form: it
    turns by 2 atan((h + I) / 2)."""
    twice = 4 * np.arctan((h + np.sqrt(3 * h) * np.array([-1, 0, 1])) / 2)
    return (1 + (np.exp(1j * twice) @ np.array([1, 4, 1]) / 6) ** n).real / 2


MIDPOINT = by_picard(ds.ImplicitMidpoint())
# Made once, so that JAX compiles programs of it once.
PATH = ds.WeakBrownianPath((), jr.key(0))
KUBO = kubo_terms(PATH)


def _estimate(solver=MIDPOINT, terms=None, phi=SQUARE, **kwargs):
    terms = KUBO if terms is None else terms
    kwargs = dict(t1=1.0, dt0=0.1, y0=Y0, key=jr.key(7)) | kwargs
    kwargs = dict(num_paths=256, replicates=4, sort_by=None, levels=1) | kwargs
    t1, dt0, y0 = (kwargs.pop(name) for name in ("t1", "dt0", "y0"))
    own = [kwargs.pop(name) for name in ("num_paths", "replicates", "sort_by")]
    sampling = kwargs.pop("sampling", None) or ds.ArrayRQMC(*own)
    return ds.expectation(
        phi, terms, solver, 0.0, t1, dt0, y0, sampling=sampling, **kwargs
    )


def test_the_estimate_is_exact_up_to_the_spread_that_it_reports():
    got = _estimate(replicates=16, num_paths=2048)
    exact = _midpoint_moment(10, 0.1)
    # Student's distribution with 15 degrees of freedom is beyond 4.9 once in 5,000.
    assert abs(got.mean - exact) <= 4.9 * got.std_error
    # Of as many independent paths the standard error would be 1.9e-3.
    assert 0 < got.std_error < 6e-4
    assert (got.num_samples, got.num_paths, got.num_failed) == (16, 2**15, 0)
    assert got.bias is None and got.tol_reached is None
    low, high = got.interval(0.95)
    np.testing.assert_allclose(high - low, 2 * 2.13145 * got.std_error, rtol=1e-5)


@pytest.mark.core
@pytest.mark.slow
def test_paths_in_blocks_are_those_of_one_batch(monkeypatch):
    whole = _estimate(phi=SQUARE, levels=2)
    # Another function, so that programs are compiled anew.
    phi = lambda t, y, args: y[1] ** 2
    monkeypatch.setattr(loop, "_PATHS_AT_ONCE", 64)
    got = _estimate(phi=phi, levels=2)
    np.testing.assert_allclose(got.mean, whole.mean, rtol=1e-13)
    np.testing.assert_allclose(got.std_error, whole.std_error, rtol=1e-9)


def test_ito_solvers_are_refused_for_terms_of_stratonovich():
    for solver in (diffrax.Euler(), diffrax.ItoMilstein()):
        with pytest.raises(ValueError, match="in the sense of Ito.*`diffrax.Heun`"):
            _estimate(solver)
    with pytest.raises(ValueError, match="in the sense of Ito"):
        growing = diffrax.ControlTerm(lambda t, y, args: y, PATH)
        _estimate(diffrax.Euler(), growing, phi=lambda t, y, args: y, y0=jnp.ones(()))
    # For additive noise both senses agree.
    H0 = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: 0.1 * q
    additive = ds.hamiltonian_terms(H0, noise, PATH)
    _estimate(diffrax.Euler(), additive, num_paths=32)
    with pytest.raises(ValueError, match="in the sense of Ito"):
        _estimate(diffrax.Euler(), diffrax.MultiTerm(additive, *KUBO.terms))


def test_of_one_step_the_law_is_balanced_to_the_last_path():
    # Of 256 paths a sixth is 42.67, and blocks of six are cut off at either end.
    signs = lambda t, y, args: jnp.stack([y < -1e-3, y > 1e-3, jnp.abs(y) < 1e-3])
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = diffrax.ControlTerm(lambda t, y, args: jnp.ones(()), path)
    at = lambda n, seed: _estimate(
        diffrax.Heun(), terms, signs, y0=jnp.zeros(()), t1=0.1, replicates=n,
        key=jr.key(seed),
    )  # fmt: skip
    for seed in range(3):
        counts = 2 * 256 * at(2, seed).mean
        assert np.all(np.abs(counts[:2] - 2 * 256 / 6) <= 2 * 5 / 3)
        np.testing.assert_allclose(counts.sum(), 2 * 256)
    got = at(64, 0)
    assert np.all(np.abs(got.mean - [1 / 6, 1 / 6, 2 / 3]) <= 5 * got.std_error)


def test_two_levels_extrapolate_by_the_weak_order_and_tell_the_bias():
    got = _estimate(levels=2, replicates=4, num_paths=128)
    one, other = _midpoint_moment(10, 0.1), _midpoint_moment(20, 0.05)
    assert abs(got.mean - (2 * other - one)) <= 10 * got.std_error
    # Of the finer level, with its sign.
    assert abs(got.bias - (one - other)) <= 20 * got.std_error
    assert got.bias_std_error < 2 * got.std_error


def test_weights_of_levels_cancel_powers_of_the_step_size():
    for order, levels in ((1, 1), (1, 2), (2, 2), (2, 3), (3, 4)):
        weights = level_weights(order, levels)
        h = 0.5 ** np.arange(levels)
        np.testing.assert_allclose(weights[0].sum(), 1)
        for power in range(order, order + levels - 1):
            assert abs(weights[0] @ h**power) < 1e-13
        if levels > 1:
            # The finest level is the best estimate and its bias. What the last power but
            # one leaves is what the last extrapolation takes away.
            np.testing.assert_allclose(
                weights[0] + weights[1], np.eye(levels)[-1], atol=1e-13
            )
            np.testing.assert_allclose(weights[2].sum(), 0, atol=1e-13)
            before = weights[0] - weights[2]
            assert before[0] == 0 and abs(before @ h ** (order + levels - 2)) > 1e-4


def test_means_are_taken_at_the_times_given_over_paths_that_have_not_failed():
    def drift(t, y, args):
        # All go up by one in the first step. What is also kicked downwards fails later, in
        # one step, and stays failed.
        lost = (t > 0.15) & (t < 0.25) & (y < 0.9)
        return jnp.where(t < 0.05, 10.0, jnp.where(lost, jnp.nan, 0.0))

    path = ds.WeakBrownianPath((), jr.key(0))
    kick = diffrax.ControlTerm(lambda t, y, args: jnp.where(t < 0.05, 1.0, 0.0), path)
    terms = diffrax.MultiTerm(diffrax.ODETerm(drift), kick)
    got = _estimate(
        diffrax.EulerHeun(), terms, lambda t, y, args: {"t": t, "y": y}, y0=jnp.zeros(()),
        ts=[0.4, 0.0, 0.1], t1=0.4, num_paths=64,
    )  # fmt: skip
    np.testing.assert_allclose(got.mean["t"], [0.4, 0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(got.mean["y"][1], 0.0)
    # 10 or 11 of 64 go down, as many go up, and these stay where they are.
    assert 4 * 10 <= got.num_failed <= 4 * 11
    up = 1 + np.sqrt(0.3) * np.array([10 / 54, 11 / 53])
    assert up[0] - 1e-12 <= got.mean["y"][0] <= up[1] + 1e-12


def test_it_stops_at_the_tolerance_with_the_replicates_of_the_whole():
    whole = _estimate(replicates=8)
    got = _estimate(replicates=12, tol=1.0)
    assert got.tol_reached and got.num_samples == 8
    assert (got.mean, got.std_error) == (whole.mean, whole.std_error)
    with pytest.warns(UserWarning, match="`tol=1e-12` was not reached"):
        never = _estimate(replicates=3, tol=1e-12)
    assert never.tol_reached is False and never.num_samples == 3
    # It goes on where it stopped.
    rest = _estimate(replicates=8, start=never)
    np.testing.assert_allclose(rest.mean, whole.mean, rtol=1e-14)


def test_solvers_of_diffrax_work_in_single_precision():
    dtype = jnp.float32
    shape, area = jax.ShapeDtypeStruct((1,), dtype), diffrax.SpaceTimeLevyArea
    path = ds.FixedStepBrownianPath(shape, jr.key(0), levy_area=area)
    drift = diffrax.ODETerm(lambda t, y, args: -y)
    noise = diffrax.ControlTerm(lambda t, y, args: jnp.full((1, 1), 0.5, dtype), path)
    terms = diffrax.MultiTerm(drift, noise)
    square = lambda t, y, args: y[0] ** 2
    y0 = jnp.zeros(1, dtype)
    got = _estimate(diffrax.ShARK(), terms, square, y0=y0, num_paths=512)
    # An Ornstein-Uhlenbeck process, up to the error of the steps.
    assert abs(got.mean - 0.125 * (1 - np.exp(-2))) <= 1e-3
    assert got.std_error < 5e-4
    assert got.mean.dtype == np.float64


PROGRAM = """
import sys
import types
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
from tests.expectation.test_array_rqmc import _numbers
print(_numbers())
"""


def _numbers() -> list[str]:
    """Of each sampling, to the last bit."""
    samplings = (
        ds.ArrayRQMC(64, 5),
        ds.ValueFunctions(2, 96, 16),
        ds.ValueFunctions(None, 96, 16),
        ds.IndependentPaths(96, 16),
    )
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: (p**2 + q**4) / 2,
        lambda t, p, q, args: jnp.cos(q) / 2,
        ds.WeakBrownianPath((), jr.key(0)),
    )
    each = [
        _estimate(ds.StormerVerlet(), terms, sampling=s, dt0=0.25, levels=2)
        for s in samplings
    ]
    return [float(x).hex() for e in each for x in (e.mean, e.bias, e.std_error)]


@pytest.mark.slow
def test_one_device_and_eight_give_the_same_numbers():
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": root}
    out = subprocess.run(
        [sys.executable, "-c", PROGRAM, "8"],
        env=environment, cwd=root, stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    assert eval(out.stdout.splitlines()[-1]) == _numbers()


def test_equal_paths_are_one_brownian_motion():
    path = ds.WeakBrownianPath((2,), jr.key(0), two_point=True)
    other = ds.WeakBrownianPath((2,), jr.key(1), two_point=True)
    term = lambda path: diffrax.ControlTerm(lambda t, y, args: y, path)
    terms = diffrax.MultiTerm(term(path), term(other), term(path))
    assert word_layout(terms) == (((0, 4), (4, 8), (0, 4)), 8, False)


@pytest.mark.parametrize(
    "message, kwargs",
    [
        ("`num_paths` must be a power of two", dict(num_paths=1000)),
        ("`num_paths` must be an integer", dict(num_paths=1)),
        ("`replicates` must be an integer, 2 or larger", dict(replicates=1)),
        ("Pass fewer levels", dict(levels=31)),
        ("`tol` must be a positive number", dict(tol="1e-3")),
        ("`start` must be what `expectation` returned", dict(start=3)),
        ("`dt0` must be numbers; got dt0='0.1'", dict(dt0="0.1")),
        ("`dt0` must be numbers; got", dict(dt0=Y0)),
        ("and `t1` after `t0`; got dt0=0.1, t0=0.0, t1=inf", dict(t1=np.inf)),
        ("whole number of steps", dict(ts=[0.25])),
        ("whole number of steps", dict(t1=0.95)),
        ("all between `t0` and `t1`", dict(ts=[1.1])),
        ("must be positive, and `t1` after", dict(t1=-1.0)),
        ("`phi` must return real arrays", dict(phi=lambda t, y, a: 1j * y[0])),
        ("`phi` must return real arrays", dict(phi=lambda t, y, a: "q")),
        ("`sort_by` must return real arrays", dict(sort_by=lambda y: None)),
        (
            "`phi` must return real arrays; it returned none",
            dict(phi=lambda t, y, a: None),
        ),
        (r"called as `phi\(t, y, args\)`; got .* `\(y\)`", dict(phi=lambda y: y[0])),
        (r"called as `sort_by\(y\)`", dict(sort_by=lambda t, y, args: y)),
        (r"a solver, such as `StormerVerlet\(\)`", dict(solver=ds.StormerVerlet)),
        ("`dt0` must be a number", dict(dt0=None)),
        ("`y0` must hold finite", dict(y0=(jnp.array(jnp.nan), jnp.array(0.0)))),
        ("`expectation` needs a state.*`wave_terms.*to_pair", dict(y0=jnp.array(1j))),
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
            _estimate(terms=kubo_terms(path))
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


def test_the_state_of_a_solver_goes_along_with_its_path():
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = diffrax.ControlTerm(lambda t, y, args: jnp.ones(()), path)
    square = lambda t, y, args: y**2
    got = _estimate(_Remembering(), terms, square, y0=jnp.asarray(0.0), replicates=16)
    assert got.num_failed == 0
    assert abs(got.mean - 1) <= 5 * got.std_error < 0.1


def test_a_path_fails_by_its_result_its_state_or_its_phi():
    # One of the three alone, by `args`, in one program; a sixth of the paths goes down in
    # the first of two steps.
    of = {by: jnp.array(number) for number, by in enumerate(("result", "state", "phi"))}
    is_lost = lambda by, y, args: (args == of[by]) & (y[0] < -1e-3)
    spoil = lambda t, y, args: jnp.where(
        is_lost("state", y, args), jnp.array([0.0, jnp.nan]), 0.0
    )
    path = ds.WeakBrownianPath((), jr.key(0))
    noise = diffrax.ControlTerm(lambda t, y, args: jnp.array([1.0, 0.0]), path)
    terms = diffrax.MultiTerm(diffrax.ODETerm(spoil), noise)
    solver = _Remembering(ft.partial(is_lost, "result"))
    phi = lambda t, y, args: jnp.where(is_lost("phi", y, args), jnp.nan, 1.0)
    for by, number in of.items():
        got = _estimate(
            solver, terms, phi, y0=jnp.zeros(2), t1=0.2, num_paths=64,
            sort_by=lambda y: y[0], args=number,
        )  # fmt: skip
        assert 4 * 10 <= got.num_failed <= 4 * (11 if by != "phi" else 24)
        np.testing.assert_allclose(got.mean, 1.0)


EXPLICIT = ds.StormerVerlet(), diffrax.Heun()


@pytest.mark.parametrize("solver", slow_except(EXPLICIT[:1], EXPLICIT))
def test_a_shape_stands_for_the_path_that_the_solver_needs(solver):
    H0 = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: 0.3 * q
    phi, y0 = lambda t, y, args: y[0] ** 2, (jnp.array(0.0), jnp.array(1.0))
    make = lambda path: ds.hamiltonian_terms(H0, noise, path)
    own = isinstance(solver, ds.AbstractSymplecticSolver)
    path = ds.FixedStepBrownianPath((), jr.key(0), diffrax.SpaceTimeLevyArea)
    path = solver.path((), jr.key(0), want="weak") if own else path
    options = dict(key=jr.key(1), levels=1, sampling=ds.IndependentPaths(64))
    got, expected = (
        ds.expectation(phi, make(x), solver, 0.0, 1.0, 0.25, y0, **options)
        for x in ((), path)
    )
    assert got.mean == expected.mean
