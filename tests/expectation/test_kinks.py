"""The law of the increments where phi is not smooth."""

import warnings

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from scipy.special import ndtr

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.kinks import may_have_kinks

from ..picard import by_picard


Y0 = jnp.array(0.0), jnp.array(0.0)
STEPS = 4


def walk(path):
    """The momentum is a Brownian motion."""
    free = lambda t, p, q, args: 0.0 * p
    return ds.hamiltonian_terms(free, lambda t, p, q, args: -q, path)


def beyond(t, y, args):
    return jnp.where(y[0] > 0.5, 1.0, 0.0)


def mean(phi, terms, **kwargs):
    solver = ds.StormerVerlet()
    return ds.expectation(
        phi, terms, solver, 0, 1, 1 / STEPS, Y0, key=jr.key(1), **kwargs
    )


@pytest.mark.parametrize(
    "phi, kinks",
    [
        (lambda y: y[0][1] * y[1][-1] ** 2, False),
        (lambda y: jnp.exp(jnp.cos(y[0])) / (1 + y[1] ** 2), False),
        (lambda y: jnp.abs(y[0]), True),
        (lambda y: jax.jit(jnp.maximum)(y[0], 0), True),
        (lambda y: jax.lax.cond(True, jnp.abs, jnp.sin, y[0]), True),
        (lambda y: jnp.clip(jnp.arange(3.0), 0, 1) * y[0], False),
    ],
)
def test_kinks_are_seen_in_the_operations(phi, kinks):
    assert may_have_kinks(phi, (jnp.zeros(3), jnp.ones(3))) == kinks


def _square_and_size(x):
    return x**2, jnp.abs(x)


def _square_after_a_loop(x):
    """The largest of the numbers is kept beside the numbers that are returned."""

    def step(carry, _):
        x, largest = carry
        return (x / 2, jnp.maximum(x, largest)), None

    (x, _), _ = jax.lax.scan(step, (x, x), length=3)
    return x**2


def _square_of_some(x):
    message_needs = x > 3
    del message_needs
    return x**2


@pytest.mark.parametrize(
    "phi, kinks",
    [
        (_square_of_some, False),
        (lambda x: _square_and_size(x)[0], False),
        (lambda x: jax.jit(_square_and_size)(x)[0], False),
        (lambda x: jax.jit(_square_and_size)(x)[1], True),
        (_square_after_a_loop, False),
        (lambda x: jax.lax.cond(True, _square_and_size, _square_and_size, x)[0], False),
        (lambda x: jax.jit(_square_of_some)(x), False),
    ],
)
def test_a_comparison_that_no_result_needs_is_no_kink(phi, kinks):
    assert may_have_kinks(phi, jnp.ones(3)) == kinks


def test_a_shape_becomes_a_gaussian_path_where_phi_jumps():
    estimate = mean(beyond, walk(()))
    assert isinstance(estimate.sampling, ds.ArrayRQMC)
    assert "Gaussian increments" in estimate.reason
    assert abs(estimate.mean - ndtr(-0.5)) < 4 * estimate.std_error < 2e-3


def test_a_weak_method_has_no_gaussian_path():
    options = dict(key=jr.key(1), sampling=ds.IndependentPaths(10))
    solver = by_picard(ds.SRKw5())
    with pytest.warns(UserWarning, match="`SRKw5` has discrete increments alone"):
        estimate = ds.expectation(beyond, walk(()), solver, 0, 1, 0.5, Y0, **options)
    assert "Gaussian" not in estimate.reason


@pytest.mark.slow
def test_a_trial_with_gaussian_increments_is_made_at_long_steps_too():
    # Truncated increments of which nothing is left would not do.
    spring = lambda t, p, q, args: 0.1 * q**2 / 2
    well = lambda t, p, q, args: (p**2 + q**2) / 2
    terms = ds.hamiltonian_terms(well, spring, ds.WeakBrownianPath((), jr.key(0)))
    y0 = jnp.array(0.0), jnp.array(1.0)
    options = dict(key=jr.key(1), sampling=ds.IndependentPaths(1000))
    solver = ds.ImplicitMidpoint()
    kinked = lambda t, y, args: jnp.abs(y[1])
    estimate = ds.expectation(kinked, terms, solver, 0, 2, 1.0, y0, **options)
    assert np.isfinite(estimate.mean)


def test_a_law_that_changes_the_mean_is_told():
    few = dict(sampling=ds.IndependentPaths(20_000), levels=1)
    weak = walk(ds.WeakBrownianPath((), jr.key(0)))
    with pytest.warns(UserWarning, match="changes by up to .* with Gaussian"):
        estimate = mean(beyond, weak, **few)
    # Four steps of three values each.
    assert abs(estimate.mean - ndtr(-0.5)) > 5 * estimate.std_error
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mean(lambda t, y, args: y[0] ** 2, weak, **few)
        gaussian = walk(ds.FixedStepBrownianPath((), jr.key(0)))
        assert np.isfinite(mean(beyond, gaussian, **few).mean)
