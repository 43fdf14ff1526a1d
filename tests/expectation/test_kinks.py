"""The law of the increments where phi is not smooth."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from scipy.special import ndtr

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.choose import choose
from diffrax_symplectic._expectation.kinks import may_have_kinks
from diffrax_symplectic._simulation import Problem
from diffrax_symplectic._terms import brownian_paths

from .steps import Kicks


KEY = jr.key(1)
Y0 = jnp.array(0.0), jnp.array(0.0)


def walk(path):
    """The momentum is a Brownian motion."""
    free = lambda t, p, q, args: 0.0 * p
    return ds.hamiltonian_terms(free, lambda t, p, q, args: -q, path)


def beyond(t, y, args):
    return jnp.where(y[0] > 0.5, 1.0, 0.0)


def _square_and_size(x):
    return x**2, jnp.abs(x)


def _square_after_a_loop(x):
    """The largest of the numbers is kept beside the numbers that are returned."""

    def step(carry, _):
        x, largest = carry
        return (x / 2, jnp.maximum(x, largest)), None

    (x, _), _ = jax.lax.scan(step, (x, x), length=3)
    return x**2


SMOOTH = [
    lambda x: x[1] * x[-1] ** 2,
    lambda x: jnp.exp(jnp.cos(x)) / (1 + x**2),
    # No comparison of what depends on the state.
    lambda x: jnp.clip(jnp.arange(3.0), 0, 1) * x,
    # Comparisons that no result needs.
    lambda x: (x**2, x > 3)[0],
    lambda x: jax.jit(_square_and_size)(x)[0],
    lambda x: jax.lax.cond(True, _square_and_size, _square_and_size, x)[0],
    _square_after_a_loop,
]
KINKED = [
    jnp.abs,
    lambda x: jax.jit(jnp.maximum)(x, 0),
    lambda x: jax.jit(_square_and_size)(x)[1],
    lambda x: jax.lax.cond(True, jnp.abs, jnp.sin, x),
]


def test_kinks_are_seen_in_the_operations_that_a_result_needs():
    for number, phi in enumerate(SMOOTH + KINKED):
        assert may_have_kinks(phi, jnp.ones(3)) == (phi in KINKED), number


def test_a_shape_becomes_a_gaussian_path_where_phi_jumps():
    def problem_for(want):
        given = beyond, walk(()), ds.StormerVerlet(), 0, 1, 0.25, Y0, None, None, 1
        return Problem.of(*given, key=KEY, want=want)

    given = False, KEY, None, None, None, None, jax.devices()[:1]
    problem, sampling, plan = choose(problem_for, *given)
    (path,) = brownian_paths(problem.terms)
    assert isinstance(path, ds.FixedStepBrownianPath)
    assert isinstance(sampling, ds.ArrayRQMC)
    assert "Gaussian increments" in plan.reason


def test_a_weak_method_has_no_gaussian_path():
    options = dict(key=KEY, sampling=ds.IndependentPaths(10), levels=1)
    solver = Kicks(variables=("W", "second"))
    with pytest.warns(UserWarning, match="`Kicks` has discrete increments alone"):
        estimate = ds.expectation(beyond, walk(()), solver, 0, 1, 0.5, Y0, **options)
    assert "Gaussian" not in estimate.reason


@pytest.mark.slow
def test_a_trial_with_gaussian_increments_is_made_at_long_steps_too():
    # Truncated increments of which nothing is left would not do.
    spring = lambda t, p, q, args: 0.1 * q**2 / 2
    well = lambda t, p, q, args: (p**2 + q**2) / 2
    terms = ds.hamiltonian_terms(well, spring, ds.WeakBrownianPath((), jr.key(0)))
    y0 = jnp.array(0.0), jnp.array(1.0)
    options = dict(key=KEY, sampling=ds.IndependentPaths(1000))
    kinked = lambda t, y, args: jnp.abs(y[1])
    given = kinked, terms, ds.ImplicitMidpoint(), 0, 2, 1.0, y0
    assert np.isfinite(ds.expectation(*given, **options).mean)


@pytest.mark.filterwarnings("error")
def test_a_law_that_changes_the_mean_is_told():
    def mean(path):
        few = dict(key=KEY, sampling=ds.IndependentPaths(20_000), levels=1)
        given = walk(path), ds.StormerVerlet(), 0, 1, 0.25, Y0
        return ds.expectation(beyond, *given, **few)

    with pytest.warns(UserWarning, match="changes by up to .* with Gaussian"):
        estimate = mean(ds.WeakBrownianPath((), jr.key(0)))
    # Four steps of three values each.
    assert abs(estimate.mean - ndtr(-0.5)) > 5 * estimate.std_error
    gaussian = mean(ds.FixedStepBrownianPath((), jr.key(0)))
    assert abs(gaussian.mean - ndtr(-0.5)) < 4 * gaussian.std_error
