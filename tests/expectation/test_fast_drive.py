"""Drives that steps do not resolve are told, which no level sees if its steps are multiples
of the period."""

import jax
import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.fast_drive import unresolved_drive

from .steps import problem_of


REST = jnp.array(0.0), jnp.array(0.0)
WIDTHS = 0.03, 0.01, 1e-3


def _tenfold(t):
    return jnp.cos(2 * jnp.pi * 10 * t)


def _pulse(width):
    return lambda t: jnp.exp(-(((t - 10.06) / width) ** 2) / 2) / width


FAST = {
    "its period divides all steps": _tenfold,
    "beside a slow one": lambda t: jnp.cos(t) + 0.1 * _tenfold(t),
} | {f"a pulse of {width} between stages": _pulse(width) for width in WIDTHS}
SLOW = {
    "constant": lambda t: 1.0 + 0 * t,
    "a third of a period in a step": lambda t: jnp.cos(2 * jnp.pi / 3 * t / 0.2),
    "a ramp": lambda t: t,
    "a pulse over many steps": lambda t: jnp.exp(-(((t - 10) / 2) ** 2)),
    "a quench at a step end": lambda t: jnp.where(t < 10, 0.0, 1.0),
    "a quench with a mean": lambda t: (
        jnp.where(t < 10 - 1e-9, 0.0, 0.5) + jnp.where(t < 10 + 1e-9, 0.0, 0.5)
    ),
    "a fast ripple that is too small": lambda t: 1 + 1e-6 * _tenfold(t),
}


def _message(terms, args=None, levels=2):
    """For steps of 0.4, and fractions of it."""
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    problem = problem_of(terms, solver, 0.4, REST, args, num_steps=50, levels=levels)
    return unresolved_drive(problem)


def test_only_fast_drives_are_told():
    """One program for all of them, in which a number selects the force."""
    forces = FAST | SLOW

    def energy(t, p, q, number):
        return (p**2 + q**2) / 2 - jax.lax.switch(number, [*forces.values()], t) * q

    terms = ds.langevin_terms(energy, 0.5, 0.1, ())
    for number, name in enumerate(forces):
        told = _message(terms, jnp.array(number)) is not None
        assert told == (name in FAST), name


@pytest.mark.parametrize("levels, shortest", [(2, "0.2"), (3, "0.1")])
def test_noise_that_changes_fast_is_told_with_the_shortest_steps(levels, shortest):
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: (1 + _tenfold(t)) * q
    terms = ds.hamiltonian_terms(energy, noise, ())
    message = _message(terms, levels=levels)
    assert f"steps of {shortest}, the shortest" in message


def test_flips_at_random_times_are_not_told():
    def flips(key):
        return jr.uniform(key, (8,), minval=0.0, maxval=20.0)

    def energy(t, p, q, times):
        sign = jnp.prod(jnp.where(t < times, 1.0, -1.0))
        return (p**2 + q**2) / 2 - sign * q

    assert _message(ds.langevin_terms(energy, 0.5, 0.1, ()), flips) is None
