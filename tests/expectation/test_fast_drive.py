"""Drives that steps do not resolve are told, which no level sees if its steps are multiples
of the period."""

import warnings

import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds

from .messages import messages


REST = jnp.array(0.0), jnp.array(0.0)


def _position(t, y, args):
    return y[1]


def _driven(force):
    """An oscillator in a bath that is driven by this force."""
    energy = lambda t, p, q, args: (p**2 + q**2) / 2 - force(t) * q
    return ds.langevin_terms(energy, 0.5, 0.1, ())


def _found(told):
    """The warning of the drive among others, if there is one."""
    found = [message for message in told if "change in time too fast" in message]
    assert len(found) <= 1
    return found[0] if found else None


def _message(terms, solver, h, t1=20, args=None):
    """What is said of the drive."""
    return _found(messages(_position, terms, solver, 0, t1, h, REST, args))


def _estimate(terms, solver, h, t1=20, **options):
    """The estimate, without a sampling error, and what is said of the drive."""
    exactly = ds.ValueFunctions(degree=1, num_paths=64)
    given = _position, terms, solver, 0, t1, h, REST
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(*given, key=jr.key(0), sampling=exactly, **options)
    return got, _found([str(x.message) for x in told])


def _tenfold(t):
    return jnp.cos(2 * jnp.pi * 10 * t)


# Of the mean position at time 20, by the response at frequency 20 pi.
EXACT = -0.00025


@pytest.mark.parametrize(
    "h, levels",
    [
        (0.4, 2),
        pytest.param(0.2, 2, marks=pytest.mark.slow),
        pytest.param(0.4, 3, marks=pytest.mark.slow),
    ],
)
def test_a_drive_whose_period_divides_all_steps_is_told(h, levels):
    got, message = _estimate(_driven(_tenfold), ds.BAOAB(), h, levels=levels)
    assert abs(got.mean - EXACT) > 1000 * got.error
    assert f"steps of {h / 2 ** (levels - 1):g}, the shortest" in message


@pytest.mark.slow
def test_a_drive_that_steps_resolve_is_right_and_not_told():
    got, message = _estimate(_driven(_tenfold), ds.BAOAB(), 0.02, t1=2)
    finer, _ = _estimate(_driven(_tenfold), ds.BAOAB(), 0.005, t1=2)
    assert abs(got.mean - finer.mean) < got.error
    assert message is None


def test_a_fast_drive_beside_a_slow_one_is_told():
    force = lambda t: jnp.cos(t) + 0.1 * _tenfold(t)
    assert _message(_driven(force), ds.ImplicitMidpoint(), 0.4) is not None


@pytest.mark.parametrize("width", [0.03, 0.01, 1e-3])
def test_a_pulse_that_falls_between_the_stages_is_told(width):
    struck = lambda t: jnp.exp(-(((t - 10.06) / width) ** 2) / 2) / width
    assert _message(_driven(struck), ds.ImplicitMidpoint(), 0.4) is not None


def test_noise_that_changes_fast_is_told():
    strength = lambda t: 1 + jnp.cos(2 * jnp.pi * 10 * t)
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: strength(t) * q
    terms = ds.hamiltonian_terms(energy, noise, ())
    assert _message(terms, ds.ImplicitMidpoint(), 0.4) is not None


SLOW = {
    "constant": lambda t: 1.0,
    "a third of a period in a step": lambda t: jnp.cos(2 * jnp.pi / 3 * t / 0.2),
    "a ramp": lambda t: t,
    "a pulse over many steps": lambda t: jnp.exp(-(((t - 10) / 2) ** 2)),
    "a quench at a step end": lambda t: jnp.where(t < 10, 0.0, 1.0),
    "a quench with a mean": lambda t: (
        jnp.where(t < 10 - 1e-9, 0.0, 0.5) + jnp.where(t < 10 + 1e-9, 0.0, 0.5)
    ),
    "a fast ripple that is too small": lambda t: 1 + 1e-6 * _tenfold(t),
}


@pytest.mark.parametrize("force", SLOW.values(), ids=SLOW)
def test_slow_drives_are_not_told(force):
    assert _message(_driven(force), ds.ImplicitMidpoint(), 0.4) is None


def test_flips_at_random_times_are_not_told():
    def flips(key):
        return jr.uniform(key, (8,), minval=0.0, maxval=20.0)

    def energy(t, p, q, times):
        sign = jnp.prod(jnp.where(t < times, 1.0, -1.0))
        return (p**2 + q**2) / 2 - sign * q

    terms = ds.langevin_terms(energy, 0.5, 0.1, ())
    assert _message(terms, ds.ImplicitMidpoint(), 0.4, args=flips) is None
