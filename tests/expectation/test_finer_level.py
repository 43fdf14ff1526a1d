"""A trial with a third level tells where two levels agree on a wrong mean."""

import warnings

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.finer_level import (
    _caveat,
    _Changes,
    _with_finer_level,
)
from diffrax_symplectic._terms import brownian_paths

from .steps import Kicks, problem_of


def _told(*given, **options):
    """The estimate, and what is said of it by the trial."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(*given, key=jr.key(0), **options)
    messages = [str(x.message) for x in told]
    found = [x for x in messages if "a third level" in x or "by chance" in x]
    assert len(found) <= 1
    return got, found[0] if found else None


def _kepler(t, p, q, args):
    return jnp.sum(p**2) / 2 - 1 / jnp.linalg.norm(q)


def _energy_of_comet(eccentricity, steps_per_orbit, num_paths=4096, **options):
    """What is told of the energy after an orbit, and by how many bars it is off."""
    aphelion = 1 + eccentricity
    speed = ((1 - eccentricity) / aphelion) ** 0.5
    y0 = jnp.array([0, speed]), jnp.array([aphelion, 0])
    t1 = 2 * np.pi
    energy = lambda t, y, args: _kepler(t, *y, args)
    given = energy, COMET, ds.StormerVerlet(), 0, t1, t1 / steps_per_orbit, y0
    # Batches of 128 paths, so that all calls share their programs.
    sampling = ds.IndependentPaths(num_paths, 128)
    got, message = _told(*given, sampling=sampling, **options)
    exact = -0.5 + STRENGTH**2 * t1
    return abs(got.mean - exact) / got.error, message


STRENGTH = 0.01
COMET = ds.hamiltonian_terms(_kepler, lambda t, p, q, args: -STRENGTH * q, (2,))


@pytest.mark.core
def test_a_close_encounter_that_steps_miss_is_told_once():
    bars, message = _energy_of_comet(0.9, 30)
    assert bars > 5
    assert f"with steps of {2 * np.pi / 120:.3g}, changes a mean by" in message
    # Later parts are not tried again, and few paths are not worth it.
    assert _energy_of_comet(0.9, 30, first=4096)[1] is None
    assert _energy_of_comet(0.9, 30, num_paths=128)[1] is None
    # One that is resolved is not told.
    bars, message = _energy_of_comet(0.5, 100)
    assert bars < 3
    assert message is None


def test_sorted_paths_say_which_changes_their_trial_could_not_see():
    square = lambda t, y, args: y[1] ** 2
    given = square, DRIVEN, ds.StormerVerlet(), 0, 1, 0.1, (jnp.zeros(()), jnp.ones(()))
    got, message = _told(*given, sampling=ds.ArrayRQMC(256, 8))
    assert message is None
    assert "a trial with halved steps, on 512 paths, could only see" in str(got)


S = 0.1
DRIVEN = ds.hamiltonian_terms(
    lambda t, p, q, args: (p**2 + q**2) / 2, lambda t, p, q, args: -S * q, ()
)


WEAK = Kicks(variables=("W", "second"))


@pytest.mark.parametrize(
    "solver, t0, is_shared",
    [
        (ds.StormerVerlet(), 0.0, True),
        (WEAK, 0.0, False),
        (diffrax.Heun(), 0.037, False),
    ],
)
def test_levels_of_a_trial_share_their_noise_where_they_can(solver, t0, is_shared):
    problem = problem_of(DRIVEN, solver, 0.05, (jnp.zeros(()), jnp.ones(())), t0=t0)
    (path,) = brownian_paths(_with_finer_level(problem, jr.key(0)).terms)
    assert (getattr(path, "cell", None) is not None) == is_shared


def test_where_levels_cannot_share_their_noise_the_trial_has_paths_of_their_own():
    square = lambda t, y, args: y[1] ** 2
    h, time = 0.9, 32 * 0.9
    given = square, DRIVEN, WEAK, 0, time, h, (jnp.array(0.0), jnp.array(1.0))
    got, message = _told(*given, sampling=ds.IndependentPaths(8192))
    exact = np.cos(time) ** 2 + S**2 * (time / 2 - np.sin(2 * time) / 4)
    assert abs(got.mean - exact) > 5 * got.error
    assert "changes a mean by" in message


@pytest.mark.slow
def test_a_rotation_that_steps_miss_is_told_where_the_bar_is_small():
    """Near a maximum of the bias two levels agree, 24 bars off. Plain paths would not show
    the change: halved steps are taken with the same value functions."""

    def energy(t, p, q, args):
        potential = 1.5 * jnp.array([-q[1], q[0]])
        return jnp.sum((p - potential) ** 2) / 2 - 0.4 * q[0]

    terms = ds.langevin_terms(energy, 0.5, 0.8, (2,))
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    rest = jnp.zeros(2), jnp.zeros(2)
    square = lambda t, y, args: y[1][0] ** 2
    sampling = ds.ValueFunctions(degree=2, num_paths=64)
    given = square, terms, solver, 0, 24, 24 / 15, rest
    got, message = _told(*given, sampling=sampling)
    # By value functions with 240 steps.
    assert abs(got.mean - 2.46622) > 10 * got.error
    assert "changes a mean by" in message


def test_changes_that_noise_would_hide_are_told_apart_from_those_that_are_sure():
    def changes(size, noise):
        return _Changes(
            sizes=np.array([0.0, size]),
            std_errors=np.array([1e-6, noise]),
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
    # The mean is that of the Fokker-Planck equation on Fourier modes and Hermite functions.
    for h, num_paths, is_right in ((1.4, 2**17, False), (0.7, 2**14, True)):
        sampling = ds.IndependentPaths(num_paths)
        got, message = _told(square, terms, ds.BAOAB(), 0, 42, h, y0, sampling=sampling)
        assert (abs(got.mean - 1.025888) < 3 * got.error) == is_right
        assert (message is None) == is_right
    assert message is None or "may agree on a wrong mean by chance" in message
