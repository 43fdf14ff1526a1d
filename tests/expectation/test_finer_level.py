"""A trial with a third level tells where two levels agree on a wrong mean."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.finer_level import _caveat, _Changes


def _told(*given, **options):
    """The estimate, and what is said of it by the trial."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(*given, key=jr.key(0), **options)
    messages = [str(x.message) for x in told]
    found = [x for x in messages if "a third level" in x or "by chance" in x]
    assert len(found) <= 1
    return got, found[0] if found else None


def _square_of_q(t, y, args):
    return y[1] ** 2


def _oscillator(t, p, q, args):
    return (p**2 + q**2) / 2


S = 0.2
DRIVEN = ds.hamiltonian_terms(_oscillator, lambda t, p, q, args: -S * q, ())
DISPLACED = jnp.array(0.0), jnp.array(1.0)


def _exact(t):
    """The mean square of the position of the driven oscillator."""
    return jnp.cos(t) ** 2 + S**2 * (t / 2 - jnp.sin(2 * t) / 4)


def _of_oscillator(h, t1=50, **options):
    given = _square_of_q, DRIVEN, ds.ImplicitMidpoint(), 0, t1, h, DISPLACED
    return _told(*given, **options)


def test_lost_phases_are_told_where_two_levels_agree_by_chance():
    got, message = _of_oscillator(1.0, sampling=ds.IndependentPaths(8192))
    assert abs(got.mean - _exact(50.0)) > 3 * got.error
    assert "with steps of 0.25, changes a mean by" in message


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {"sampling": ds.IndependentPaths(8192)},
    ],
)
def test_resolved_phases_are_not_told(options):
    got, message = _of_oscillator(0.1, **options)
    assert abs(got.mean - _exact(50.0)) < 3 * got.error
    assert message is None


def _kepler(t, p, q, args):
    return jnp.sum(p**2) / 2 - 1 / jnp.linalg.norm(q)


def _energy_of_comet(eccentricity, steps_per_orbit):
    strength = 0.01
    noise = lambda t, p, q, args: -strength * q
    terms = ds.hamiltonian_terms(_kepler, noise, (3,))
    aphelion = 1 + eccentricity
    speed = ((1 - eccentricity) / aphelion) ** 0.5
    y0 = jnp.array([0, speed, 0]), jnp.array([aphelion, 0, 0])
    t1 = 2 * jnp.pi
    energy = lambda t, y, args: _kepler(t, *y, args)
    given = energy, terms, ds.StormerVerlet(), 0, t1, t1 / steps_per_orbit, y0
    got, message = _told(*given, sampling=ds.IndependentPaths(20_000))
    exact = -0.5 + 1.5 * strength**2 * t1
    return got, message, exact


@pytest.mark.parametrize("eccentricity, steps_per_orbit", [(0.9, 30), (0.95, 50)])
def test_a_close_encounter_that_steps_miss_is_told(eccentricity, steps_per_orbit):
    got, message, exact = _energy_of_comet(eccentricity, steps_per_orbit)
    assert abs(got.mean - exact) > 5 * got.error
    assert message is not None


def test_a_resolved_encounter_is_not_told():
    got, message, exact = _energy_of_comet(0.5, 100)
    assert abs(got.mean - exact) < 3 * got.error
    assert message is None


@pytest.mark.parametrize(
    "solver, friction",
    [(ds.BAOAB(), 1e5), (ds.ImplicitMidpoint(), 1e4)],
    ids=["BAOAB", "ImplicitMidpoint"],
)
def test_momenta_that_steps_hardly_damp_are_told(solver, friction):
    # The friction of microseconds, with steps of seconds.
    free = lambda t, p, q, args: p**2 / 2
    terms = ds.langevin_terms(free, friction, 0.01, ())
    given = lambda t, y, args: y[0] ** 2, terms, solver, 0, 20, 1
    y0 = jnp.array(1.0), jnp.array(0.0)
    got, message = _told(*given, y0, sampling=ds.IndependentPaths(8192))
    assert abs(got.mean - 0.01) > 5 * got.error
    assert message is not None


@pytest.mark.slow
def test_errors_that_change_their_sign_between_the_levels_are_told():
    # Noise turns the momenta of an oscillator in a plane, and the error of order 1 is zero
    # between both steps. With value functions the trial sees that on a handful of paths.
    def turned(t, y, args):
        turned_p = jnp.stack([-y[0][1], y[0][0]])
        kick = lambda w: (turned_p * w, jnp.zeros(2))
        return lx.FunctionLinearOperator(kick, jax.ShapeDtypeStruct((), float))

    path = ds.WeakBrownianPath((), jr.key(0))
    drift = diffrax.ODETerm(lambda t, y, args: (-y[1], y[0]))
    terms = diffrax.MultiTerm(drift, diffrax.ControlTerm(turned, path))
    kinetic = lambda t, y, args: jnp.sum(y[0] ** 2) / 2
    given = kinetic, terms, ds.ImplicitMidpoint(), 0, 2.5, 0.25
    y0 = jnp.array([1.5, 0.0]), jnp.zeros(2)
    exactly = ds.ValueFunctions(degree=2, num_paths=64)
    got, message = _told(*given, y0, sampling=exactly)
    # The exponential of the equations of the moments.
    assert abs(got.mean - 0.5997523) > 4 * got.error
    assert "on 8 paths" in message


def test_a_solver_with_discrete_increments_alone_is_tried_without_common_noise():
    given = _square_of_q, DRIVEN, ds.SRKw5(), 0, 50, 1.0, DISPLACED
    got, message = _told(*given, sampling=ds.IndependentPaths(8192))
    assert abs(got.mean - _exact(50.0)) > 3 * got.error
    assert message is not None


def test_the_trial_takes_any_start_time_and_solvers_of_diffrax():
    given = _square_of_q, DRIVEN, diffrax.Heun(), 0.037, 2.037, 0.05, DISPLACED
    got, message = _told(*given, sampling=ds.IndependentPaths(1024))
    assert abs(got.mean - _exact(2.0)) < 3 * got.error
    assert message is None


@pytest.mark.slow
def test_many_means_do_not_raise_a_false_alarm():
    def moments(t, y, args):
        p, q = y
        return jnp.stack([jnp.cos(k * q) + jnp.sin(k * p) for k in range(1, 5)])

    given = moments, DRIVEN, ds.ImplicitMidpoint(), 0, 20, 0.1, DISPLACED
    for number in range(5):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ds.expectation(
                *given,
                key=jr.key(number),
                ts=jnp.arange(1, 21),
                sampling=ds.IndependentPaths(4096),
            )


def test_three_levels_and_few_paths_take_no_trial():
    few = ds.IndependentPaths(64)
    assert _of_oscillator(1.0, levels=3, sampling=few)[1] is None
    assert _of_oscillator(1.0, sampling=few)[1] is None


def test_later_parts_are_not_tried_again():
    sampling = ds.IndependentPaths(8192)
    assert _of_oscillator(1.0, sampling=sampling)[1] is not None
    assert _of_oscillator(1.0, sampling=sampling, first=8192)[1] is None


def _rotating(steps, **options):
    """The mean square of the position of a charge in crossed fields in a bath, with this
    many steps."""

    def energy(t, p, q, args):
        potential = 1.5 * jnp.array([-q[1], q[0]])
        return jnp.sum((p - potential) ** 2) / 2 - 0.4 * q[0]

    terms = ds.langevin_terms(energy, 0.5, 0.8, (2,))
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    rest = jnp.zeros(2), jnp.zeros(2)
    first = lambda t, y, args: y[1][0] ** 2
    return _told(first, terms, solver, 0, 24, 24 / steps, rest, **options)


# By value functions with 240 steps.
MEAN_OF_ROTATION = 2.46622
FITTED = ds.ValueFunctions(degree=2, num_paths=64)


@pytest.mark.slow
def test_a_rotation_that_steps_miss_is_told_where_the_bar_is_small():
    """Near a maximum of the bias two levels agree, 24 bars off. Plain paths would not show
    the change."""
    got, message = _rotating(15, sampling=FITTED)
    assert abs(got.mean - MEAN_OF_ROTATION) > 10 * got.error
    assert "changes a mean by" in message


@pytest.mark.slow
def test_a_rotation_that_steps_resolve_is_not_told():
    got, message = _rotating(60, sampling=FITTED)
    assert abs(got.mean - MEAN_OF_ROTATION) < got.error
    assert message is None


def test_changes_that_noise_would_hide_are_told_apart_from_those_that_are_sure():
    def changes(size, noise):
        return _Changes(
            sizes=np.array([0.0, size]),
            noise=np.array([1e-6, noise]),
            errors=np.array([0.01, 0.01]),
            num_paths=512,
        )

    seen = changes(0.2, 0.01)
    hidden = changes(0.02, 0.02)
    small = changes(0.005, 0.001)
    assert seen.are_sure
    assert not hidden.are_sure and hidden.are_hidden
    assert not small.are_sure and not small.are_hidden
    pair = ds.monte_carlo(lambda key: jr.normal(key, 2), key=jr.key(0), num_paths=16)
    # 3.2 standard errors, for the larger of two changes.
    said = "on 512 paths, could only see a change of the mean ([1]) above 6.4e-02"
    assert said in _caveat(pair, hidden)


@pytest.mark.slow
def test_means_that_cross_by_chance_are_told_where_the_trial_is_too_noisy():
    washboard = lambda t, p, q, args: p**2 / 2 - jnp.cos(q) - 0.6 * q
    terms = ds.langevin_terms(washboard, 0.5, 0.5, ())
    y0 = jnp.array(0.0), jnp.array(0.0)
    square = lambda t, y, args: y[0] ** 2
    sampling = ds.IndependentPaths(2**17)
    given = square, terms, ds.BAOAB(), 0
    got, message = _told(*given, 42, 1.4, y0, sampling=sampling)
    # By the Fokker-Planck equation on Fourier modes and Hermite functions.
    assert abs(got.mean - 1.025888) > 4 * got.error
    assert "may agree on a wrong mean by chance" in message
    got, message = _told(*given, 42, 0.7, y0, sampling=ds.IndependentPaths(2**14))
    assert abs(got.mean - 1.025888) < 3 * got.error
    assert message is None
