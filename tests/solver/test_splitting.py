"""Splittings in pieces: those of the package, and others."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import AbstractPiece

from .test_every_solver import OBABO
from .test_langevin import MASS, moment_map, ORIGIN, stationary_moments, STIFFNESS, T


KEY = jr.key(3)
HALF_KICK, HALF_FLIGHT = ds.Kick(1 / 2), ds.Flight(1 / 2)
BAOAB = ds.Splitting([HALF_KICK, HALF_FLIGHT, ds.Bath(1), HALF_FLIGHT, HALF_KICK])
ABOBA = ds.Splitting([HALF_FLIGHT, HALF_KICK, ds.Bath(1), HALF_KICK, HALF_FLIGHT])
MIDDLE = ds.Splitting([ds.Kick(1), HALF_FLIGHT, ds.Bath(1), HALF_FLIGHT])


def _quartic(t, p, q, args):
    return jnp.sum(p**2) / 2 + (1 + t) * jnp.sum(q**4) / 4


def _terms(solver, shape=(3,), **options):
    path = solver.path(shape, KEY)
    return ds.langevin_terms(
        _quartic, lambda t, q, args: 1 + q**2, 0.7, path, **options
    )


def _solve(solver, terms, y0, t1=0.5, h=0.1, **options):
    return diffrax.diffeqsolve(terms, solver, 0.0, t1, h, y0, **options).ys


START = jnp.array([0.3, -0.4, 0.1]), jnp.array([1.0, 0.2, -0.5])


def _with_flow(flow, steps=1):
    half = ds.Flow(1 / 2, flow, steps)
    return ds.Splitting([HALF_KICK, half, ds.Bath(1), half, HALF_KICK])


@pytest.mark.parametrize(
    "pieces, named, options",
    [
        (BAOAB, ds.BAOAB(), {}),
        (MIDDLE, ds.LangevinMiddle(), {}),
        (
            _with_flow(ds.StormerVerlet(), steps=2),
            ds.BAOAB(ds.StormerVerlet(), steps=2),
            {"slow": lambda t, q, args: jnp.sum(jnp.cos(q))},
        ),
    ],
    ids=["BAOAB", "LangevinMiddle", "multiple time steps"],
)
def test_the_solvers_with_names_are_their_pieces(pieces, named, options):
    terms = _terms(named, **options)
    both = lambda y0: [_solve(solver, terms, y0) for solver in (pieces, named)]
    np.testing.assert_array_equal(*jax.jit(both)(START))
    assert pieces.undoes_its_steps == named.undoes_its_steps
    assert pieces.order(None) == named.order(None)
    assert pieces.variables == named.variables
    assert pieces.stage_vectors(1) == named.stage_vectors(1)


@pytest.mark.core
def test_a_rod_is_kept_by_any_order_of_the_pieces():
    rod = lambda q, args: jnp.sum(q**2, keepdims=True) - 1
    y0 = jnp.zeros(3), jnp.array([0.6, 0.0, -0.8])
    for solver in (ABOBA, OBABO):
        terms = _terms(solver, constraint=rod)
        p, q = jax.jit(lambda y0, given=(solver, terms): _solve(*given, y0))(y0)
        np.testing.assert_allclose(q[-1] @ q[-1], 1, rtol=1e-14)
        np.testing.assert_allclose(p[-1] @ q[-1], 0, atol=1e-14)


@pytest.mark.parametrize("h", [0.2, 1.0])
def test_baths_at_the_ends_keep_the_law_of_momenta_and_those_within_others(h):
    soft = 1 - STIFFNESS / MASS * h**2 / 4
    H0 = lambda t, p, q, args: p**2 / (2 * MASS) + STIFFNESS * q**2 / 2
    terms = ds.langevin_terms(H0, 0.7, T, OBABO.path((), KEY))
    moments = stationary_moments(terms, OBABO, h, ORIGIN)
    exact = np.diag([MASS * T, T / STIFFNESS / soft])
    np.testing.assert_allclose(moments, exact, rtol=1e-12, atol=1e-13)
    moments = stationary_moments(terms, ABOBA, h, ORIGIN)
    exact = np.diag([MASS * T / soft, T / STIFFNESS])
    np.testing.assert_allclose(moments, exact, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("solver, factor", [(OBABO, 1 + 1.5**2 / 16), (ABOBA, 1)])
def test_free_particles_diffuse_too_fast_between_two_baths_by_a_known_factor(
    solver, factor
):
    rate, h = 1.0, 1.5
    free = lambda t, p, q, args: jnp.sum(p**2) / (2 * MASS)
    terms = ds.langevin_terms(free, rate * MASS, T, solver.path((), KEY))
    K = moment_map(terms, solver, h, ORIGIN)
    before = np.linalg.matrix_power(K, 80)
    # The mean square of the position, which grows by 2 D h in a step.
    grown = ((K @ before)[:, 0] - before[:, 0])[8]
    np.testing.assert_allclose(grown / (2 * h), factor * T / (rate * MASS), rtol=1e-9)


def test_shares_of_noise_are_independent_and_have_the_variances_of_their_parts():
    share, h, friction = 0.3, 0.8, 0.5
    free = lambda t, p, q, args: jnp.sum(p**2) / 2
    solver = ds.Splitting(
        [ds.Bath(share), HALF_KICK, ds.Flight(1), HALF_KICK, ds.Bath(1 - share)]
    )
    assert solver.order(None) == 1 and solver.record.weak == 1
    path = solver.path((), KEY)
    terms = ds.langevin_terms(free, friction, T, path)
    K = moment_map(terms, solver, h, ORIGIN)
    # The Maxwell distribution, which each bath keeps by itself, is kept by both only if
    # their noises are independent.
    maxwell = np.zeros(9)
    maxwell[[0, 4]] = 1, T
    np.testing.assert_allclose((K @ maxwell)[4], T, rtol=1e-13)


def test_forces_at_the_end_of_a_step_are_those_at_the_start_of_the_next_one():
    potential = lambda t, p, q, args: jnp.sum(p**2) / 2 + jnp.sum(jnp.sin(q))
    for solver in (OBABO, BAOAB, ABOBA):
        terms = ds.langevin_terms(potential, 0.5, 0.7, solver.path((3,), KEY))
        state = solver.init(terms, 0.0, 0.1, START, None)

        def step(y, state, solver=solver, terms=terms):
            return solver.step(terms, 0.0, 0.1, y, None, state, False)[0]

        compiled = jax.jit(step).lower(START, state).compile().as_text()
        assert compiled.count(" cosine(") == 1, solver


def test_pieces_that_are_no_splitting_are_refused():
    bath, flight = ds.Bath(1), ds.Flight(1)
    flow = ds.Flow(1, ds.StormerVerlet())
    refused = [
        ("must be a list", HALF_KICK),
        ("are such as `Kick", [HALF_KICK, "A", bath]),
        ("those of `Kick` add up to 0.5", [HALF_KICK, flight, bath]),
        ("those of `Flight` add up to 0", [ds.Kick(1), bath]),
        ("those of `Bath` add up to 0", [ds.Kick(1), flight]),
        ("has no `Flight`", [ds.Kick(1), HALF_FLIGHT, ds.Flow(1 / 2, flow.flow), bath]),
        ("one or two baths; got 3|got 3", [ds.Kick(1), flight, *[ds.Bath(1 / 3)] * 3]),
        ("has a bath of its own", [ds.Kick(1), ds.Flow(1, ds.BAOAB()), bath]),
    ]
    for message, pieces in refused:
        with pytest.raises(ValueError, match=message):
            ds.Splitting(pieces)
    with pytest.raises(ValueError, match="positive share"):
        ds.Bath(-1)
    with pytest.raises(ValueError, match="`share` must be a finite real number"):
        ds.Kick(np.inf)
    with pytest.raises(ValueError, match="`flow` of `Flow` must be a solver of this"):
        ds.Flow(1, diffrax.Heun())
    with pytest.raises(ValueError, match="needs space-time Lévy area"):
        weak = ds.WeakBrownianPath((3,), KEY)
        terms = ds.langevin_terms(_quartic, 1.0, 0.7, weak)
        _solve(OBABO, terms, START)


class Stretch(AbstractPiece):
    """A piece with a parameter: momenta grow at a rate."""

    rate: jax.Array

    def move(self, setting, moving, number):
        p, q = moving.y
        return moving._replace(
            y=(jnp.exp(setting.length(self.share) * self.rate) * p, q)
        )


def test_pieces_with_other_parameters_are_other_pieces():
    first = Stretch(1 / 2, jnp.array(1.0))
    last = Stretch(1 / 2, jnp.array(2.0))
    pieces = [first, HALF_KICK, HALF_FLIGHT, ds.Bath(1), HALF_FLIGHT, HALF_KICK]
    assert ds.Splitting([*pieces, first]).symmetric
    assert not ds.Splitting([*pieces, last]).symmetric
    with pytest.raises(ValueError, match="those of `Stretch` add up to 0.5"):
        ds.Splitting(pieces)
