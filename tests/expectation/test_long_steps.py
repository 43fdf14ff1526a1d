"""Explicit steps beyond their limit are told where two levels agree on a wrong mean."""

import warnings

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds


Y0 = jnp.array(0.0), jnp.array(1.0)
FEW = ds.IndependentPaths(2000)


def _pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


def _cosine(t, y, args):
    return jnp.cos(y[1])


def _told(terms, solver, h, y0=Y0, phi=_cosine, **options):
    """The estimate, and whether it says that steps are too long."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(
            phi, terms, solver, 0, 15 * h, h, y0, key=jr.key(1), sampling=FEW, **options
        )
    return got, any("too long for" in str(x.message) for x in told)


def test_bounded_forces_hide_steps_that_are_too_long_from_two_levels():
    terms = ds.langevin_terms(_pendulum, 0.5, 1.0, ())
    got, told = _told(terms, ds.BAOAB(), 8.0)
    # By Bessel functions.
    assert abs(got.mean - 0.44639) > 10 * got.error
    assert told


OSCILLATOR = ds.hamiltonian_terms(
    lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
    lambda t, p, q, args: jnp.sin(q[0]) / 5,
    (),
)
Y1 = jnp.zeros(1), jnp.ones(1)


@pytest.mark.parametrize("h, too_long", [(0.1, False), (1.99, False), (2.02, True)])
@pytest.mark.parametrize("size", [1, 100])
def test_the_limit_of_stability_is_told(h, too_long, size):
    y0 = jnp.zeros(size), jnp.ones(size)
    phi = lambda t, y, args: jnp.cos(y[1][0])
    assert _told(OSCILLATOR, ds.StormerVerlet(), h, y0, phi)[1] is too_long


def test_one_level_promises_nothing_of_the_step_as_for_a_map():
    phi = lambda t, y, args: jnp.cos(y[1][0])
    assert not _told(OSCILLATOR, ds.StormerVerlet(), 2.02, Y1, phi, levels=1)[1]


class _Kicks(ds.AbstractSymplecticSolver):
    """A kick and a drift, by a user who knows that there are a drift and a noise."""

    structure = "separable"
    variables = ("W",)
    interpolation_cls = diffrax.LocalLinearInterpolation

    def stage_vectors(self, num_noises):
        return ()

    def order(self, terms):
        return 1

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        drift, noise = terms.terms
        p, q = y0
        force, _ = drift.vf(t0, y0, args)
        kick, _ = noise.vf_prod(t0, y0, args, noise.contr(t0, t1))
        p = p + (t1 - t0) * force + kick
        y1 = p, q + (t1 - t0) * p
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful


@pytest.mark.parametrize("h, too_long", [(1.9, False), (2.1, True)])
def test_a_solver_of_ones_own_keeps_its_noise(h, too_long):
    phi = lambda t, y, args: jnp.cos(y[1][0])
    assert _told(OSCILLATOR, _Kicks(), h, Y1, phi)[1] is too_long


def test_steps_that_resolve_a_barrier_or_are_implicit_are_not_told():
    barrier = ds.langevin_terms(
        lambda t, p, q, args: p**2 / 2 + (q**2 - 1) ** 2 / 4, 5.0, 1.0, ()
    )
    top = jnp.array(0.0), jnp.array(0.0)
    assert not _told(barrier, ds.BAOAB(), 1.0, top)[1]
    terms = ds.hamiltonian_terms(_pendulum, lambda t, p, q, args: jnp.sin(q) / 5, ())
    assert not _told(terms, ds.ImplicitMidpoint(), 4.0)[1]
    # Strong friction turns momenta around, and does not enlarge them.
    rough = ds.langevin_terms(_pendulum, 50.0, 1.0, ())
    assert not _told(rough, ds.BAOAB(), 1.0)[1]


def test_the_warning_names_the_line_of_the_user():
    terms = ds.langevin_terms(_pendulum, 0.5, 1.0, ())
    given = _cosine, terms, ds.BAOAB(), 0, 32, 8.0, Y0
    with pytest.warns(UserWarning, match="too long for `BAOAB`") as told:
        got = ds.expectation(*given, key=jr.key(1), sampling=FEW)
    assert np.isfinite(got.mean)
    assert {x.filename for x in told if "too long" in str(x.message)} == {__file__}


def _stiff(t, p, q, args):
    return p**2 / 2 + 200 * q**4


def _failures(H0, solver, h, y0=Y0):
    """The warning of failed paths."""
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: q / 5, ())
    with pytest.warns(UserWarning, match="paths failed") as told:
        ds.expectation(
            _cosine, terms, solver, 0, 60 * h, h, y0, key=jr.key(1), sampling=FEW
        )
    (found,) = [str(x.message) for x in told if "paths failed" in str(x.message)]
    return found


@pytest.mark.parametrize("solver", [ds.StormerVerlet(), diffrax.Heun()])
def test_a_run_in_which_all_paths_fail_names_the_step(solver):
    message = _failures(_stiff, solver, 0.5)
    name = type(solver).__name__
    assert f"Most likely, steps of `dt0=0.5` are too long for `{name}`" in message
    assert "pass `dt0=0.125` or less" in message


def test_a_hamiltonian_that_is_not_finite_is_not_blamed_on_the_step():
    singular = lambda t, p, q, args: p**2 / 2 + jnp.sqrt(q - 2)
    assert "Most likely" not in _failures(singular, ds.StormerVerlet(), 0.5)
