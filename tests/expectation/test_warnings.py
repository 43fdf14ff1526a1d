"""Every warning names the user's line, not one of the package."""

import sys
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.fitted import value_functions

from ..drjit_here import needs_drjit
from .steps import problem_of


# The function of the same name hides its module.
EXPECTATION = sys.modules["diffrax_symplectic._expectation.expectation"]


def here(call: Callable, message: str) -> None:
    """Asserts that `call` warns with this message, once, and in its own lines."""
    with pytest.warns(UserWarning, match=message) as told:
        call()
    (found,) = [w for w in told if message in str(w.message)]
    lines = {line for _, _, line in call.__code__.co_lines()}
    assert found.filename == __file__ and found.lineno in lines


ONE = jnp.array(0.0), jnp.array(1.0)
KEY = jr.key(1)


def walk(noise, path) -> diffrax.AbstractTerm:
    """Terms without drift: these compile fastest."""
    return diffrax.ControlTerm(noise, path)


WEAK = walk(lambda t, y, args: y, ds.WeakBrownianPath((), jr.key(0)))
GAUSSIAN = walk(lambda t, y, args: y, ds.FixedStepBrownianPath((), jr.key(0)))
FEW = ds.IndependentPaths(100)


def mean(phi, terms=WEAK, y0=None, sampling=FEW, **options) -> Callable:
    """A call of the user's, in a line of this file."""
    y0 = jnp.ones(1) if y0 is None else y0
    given = phi, terms, diffrax.Heun(), 0, 1, 0.5, y0
    return lambda: ds.expectation(*given, key=KEY, sampling=sampling, **options)


def first(t, y, args):
    return y[0]


def test_of_the_loop_over_batches():
    here(mean(first, tol=1e-9), "was not reached")
    same = lambda key: jnp.ones(())
    here(lambda: ds.monte_carlo(same, key=KEY, num_paths=10), "samples are equal")


def test_of_steps():
    energy = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
    terms = ds.langevin_terms(energy, 0.5, 1.0, ())
    cosine = lambda t, y, args: jnp.cos(y[1])
    given = cosine, terms, ds.BAOAB(), 0, 120, 8.0, ONE
    here(lambda: ds.expectation(*given, key=KEY, sampling=FEW), "too long for `BAOAB`")


def test_with_three_levels_fewer_looks_are_taken_and_with_one_none(monkeypatch):
    def said(levels):
        for name in looks:
            monkeypatch.setattr(EXPECTATION, name, lambda *given, name=name: name)
        if levels is None:
            monkeypatch.setattr(EXPECTATION, "jumps_within_steps", lambda *given: None)
        terms = ds.hamiltonian_terms(
            lambda t, p, q, args: q, lambda t, p, q, args: q, ()
        )
        solver = ds.StormerVerlet()
        problem = problem_of(terms, solver, 0.5, ONE, levels=levels or 2)
        return {*EXPECTATION.messages_on_steps(problem, 0.5)}

    on_three = {"jumps_within_steps", "too_long_steps"}
    on_two = {
        "unresolved_noise",
        "unresolved_friction",
        "jumps_at_step_ends",
    } | on_three
    looks = {"unresolved_drive"} | on_two
    assert said(1) == set()
    assert said(2) == on_two
    assert said(3) == on_three
    # Of a field that jumps nobody looks whether it changes too fast.
    assert said(None) == looks - {"jumps_within_steps"}


def test_of_rounding():
    y0 = jnp.ones(1, jnp.float32)
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((), jnp.float32), jr.key(0))
    terms = walk(lambda t, y, args: 1e-6 * y, path)
    here(mean(first, terms, y0), "Rounding errors may be larger")


def test_of_coordinates_to_sort_by():
    sampling = ds.ArrayRQMC(256, 2)
    here(
        mean(first, GAUSSIAN, jnp.ones(8), sampling, levels=1),
        "sorted by 8 coordinates, which leaves 2.0",
    )


@pytest.mark.slow
def test_of_a_fit_that_takes_long(monkeypatch):
    monkeypatch.setattr(value_functions, "_MOST_WITHOUT_WARNING", 1)
    sampling = ds.ValueFunctions(2, 64)
    here(
        mean(first, WEAK, jnp.ones(2), sampling),
        "The fit of `ValueFunctions` takes as long",
    )


@pytest.mark.slow
def test_of_a_fit_that_is_no_better(monkeypatch):
    comparison = value_functions._comparison

    def none_is_better(*given):
        choice, remainder = comparison(*given)
        return np.zeros_like(choice), remainder

    monkeypatch.setattr(value_functions, "_comparison", none_is_better)
    here(mean(first, sampling=ds.ValueFunctions(2, 64)), "is no better than")


def follow(terms, solver, t1, dt0, **options) -> Callable:
    return lambda: ds.ensemble(
        terms, solver, 0, t1, dt0, ONE, key=KEY, num_paths=60, **options
    )


def test_of_failed_paths():
    singular = lambda t, p, q, args: p**2 / 2 + jnp.sqrt(q)
    path = ds.FixedStepBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(singular, lambda t, p, q, args: 2 * q**2, path)
    here(
        follow(terms, ds.StormerVerlet(), 4, 0.25),
        "`temperature` or `friction` that is negative",
    )


def test_of_implicit_steps_without_a_solution():
    # dq/dt = q^2 has no midpoint step from q = 1 that is longer than 1/2.
    explosive = lambda t, p, q, args: p * q**2
    weak = lambda t, p, q, args: 0.01 * q
    terms = ds.hamiltonian_terms(explosive, weak, ())
    few = follow(terms, ds.ImplicitMidpoint(), 0.9, 0.9)
    here(few, "meet: pass a smaller `dt0`, or an explicit solver")


@needs_drjit
def test_of_stragglers():
    stiff = lambda t, p, q, args: p**2 / 2 + 20 * q**4
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(stiff, lambda t, p, q, args: 0.2 * q, path)
    solver = ds.ImplicitMidpoint()
    here(follow(terms, solver, 4, 0.8, engine="drjit"), "were simulated again")
    square = lambda t, y, args: y[1] ** 2
    given = square, terms, solver, 0, 4, 0.8, ONE
    few = ds.IndependentPaths(60)
    options = dict(key=KEY, sampling=few, engine="drjit", levels=1)
    here(lambda: ds.expectation(*given, **options), "were simulated again")


def test_of_truncated_increments():
    spring = lambda t, p, q, args: 0.5 * q**2 / 2
    well = lambda t, p, q, args: (p**2 + q**2) / 2
    solver = ds.ImplicitMidpoint()
    terms = ds.hamiltonian_terms(well, spring, solver.path((), jr.key(0)))
    here(follow(terms, solver, 0.5, 0.5), "lose 16.2% of their variance")
    kinked = lambda t, y, args: jnp.abs(y[1])
    given = kinked, terms, solver, 0, 1, 0.5, ONE
    options = dict(key=KEY, sampling=FEW, levels=1)
    here(lambda: ds.expectation(*given, **options), "lose 16.2% of their")
