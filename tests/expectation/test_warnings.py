"""Every warning names the user's line, not one of the package."""

import sys
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
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
START = jnp.ones(1)
KEY = jr.key(1)


# Terms without drift: these compile fastest.
WEAK = diffrax.ControlTerm(lambda t, y, args: y, ds.WeakBrownianPath((), jr.key(0)))
GAUSSIAN_PATH = ds.FixedStepBrownianPath((), jr.key(0))
GAUSSIAN = diffrax.ControlTerm(lambda t, y, args: y, GAUSSIAN_PATH)
FEW = ds.IndependentPaths(100)


def first(t, y, args):
    return y[0]


def mean(terms=WEAK, y0=START, sampling=FEW, **options) -> Callable:
    """A call of the user's, in a line of this file."""
    given = first, terms, diffrax.Heun(), 0, 1, 0.5, y0
    return lambda: ds.expectation(*given, key=KEY, sampling=sampling, **options)


def follow(terms, solver, t1=1, dt0=0.5, y0=START, **options) -> Callable:
    return lambda: ds.ensemble(
        terms, solver, 0, t1, dt0, y0, key=KEY, num_paths=60, **options
    )


def test_of_the_loop_over_batches():
    here(mean(tol=1e-9), "was not reached")
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
        problem = problem_of(WEAK, diffrax.Heun(), 0.5, START, levels=levels or 2)
        return {*EXPECTATION.messages_on_steps(problem, 0.5)}

    on_three = {"jumps_within_steps", "too_long_steps"}
    on_two = on_three | {
        "unresolved_noise", "unresolved_friction", "jumps_at_step_ends",
    }  # fmt: skip
    looks = {"unresolved_drive"} | on_two
    assert said(1) == set()
    assert said(2) == on_two
    assert said(3) == on_three
    # Of a field that jumps nobody looks whether it changes too fast.
    assert said(None) == looks - {"jumps_within_steps"}


def test_of_rounding():
    y0 = jnp.ones(1, jnp.float32)
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((), jnp.float32), jr.key(0))
    terms = diffrax.ControlTerm(lambda t, y, args: 1e-6 * y, path)
    here(mean(terms, y0), "Rounding errors may be larger")


def test_of_coordinates_to_sort_by():
    sampling = ds.ArrayRQMC(256, 2)
    call = mean(GAUSSIAN, jnp.ones(8), sampling, levels=1)
    here(call, "sorted by 8 coordinates, which leaves 2.0")


@pytest.mark.slow
def test_of_a_fit_that_takes_long(monkeypatch):
    monkeypatch.setattr(value_functions, "_MOST_WITHOUT_WARNING", 1)
    call = mean(WEAK, jnp.ones(2), ds.ValueFunctions(2, 64))
    here(call, "The fit of `ValueFunctions` takes as long")


def test_of_failed_paths():
    lost = diffrax.ControlTerm(
        lambda t, y, args: jnp.where(y > 1.5, jnp.nan, y), GAUSSIAN_PATH
    )
    here(follow(lost, diffrax.Heun()), "`temperature` or `friction` that is negative")


@needs_drjit
def test_of_stragglers():
    # Dr.Jit's sine is not for such angles.
    driven = lambda t, p, q, args: p**2 / 2 + q * jnp.sin(jnp.where(q < 0.9, 3e9, 1.0))
    terms = ds.hamiltonian_terms(driven, lambda t, p, q, args: 0.2 * q, ())
    solver = ds.StormerVerlet()
    here(follow(terms, solver, y0=ONE, engine="drjit"), "were simulated again")
    position = lambda t, y, args: y[1]
    given = position, terms, solver, 0, 1, 0.5, ONE
    options = dict(key=KEY, sampling=FEW, engine="drjit", levels=1)
    here(lambda: ds.expectation(*given, **options), "were simulated again")


def test_of_truncated_increments():
    terms = diffrax.ControlTerm(
        lambda t, y, args: y, ds.TruncatedBrownianPath(GAUSSIAN_PATH)
    )
    here(follow(terms, diffrax.Heun()), "lose 16.2% of their variance")
    here(mean(terms, levels=1), "lose 16.2% of their variance")
