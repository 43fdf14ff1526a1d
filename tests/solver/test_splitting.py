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


KEY = jr.key(3)
HALF_KICK, HALF_FLIGHT = ds.Kick(1 / 2), ds.Flight(1 / 2)
BAOAB = ds.Splitting([HALF_KICK, HALF_FLIGHT, ds.Bath(1), HALF_FLIGHT, HALF_KICK])
ABOBA = ds.Splitting([HALF_FLIGHT, HALF_KICK, ds.Bath(1), HALF_KICK, HALF_FLIGHT])
# Two baths of different strength.
UNEQUAL = ds.Splitting([ds.Bath(0.3), HALF_KICK, ds.Flight(1), HALF_KICK, ds.Bath(0.7)])
MIDDLE = ds.Splitting([ds.Kick(1), HALF_FLIGHT, ds.Bath(1), HALF_FLIGHT])


def _quartic(t, p, q, args):
    return jnp.sum(p**2) / 2 + (1 + t) * jnp.sum(q**4) / 4


def _terms(solver, shape=(3,), **options):
    path = solver.path(shape, KEY)
    return ds.langevin_terms(
        _quartic, lambda t, q, args: 1 + q**2, 0.7, path, **options
    )


def _solve(solver, terms, y0, h=0.1):
    """The end of five steps."""

    def step(carry, t):
        y, state = carry
        y, _, _, state, _ = solver.step(terms, t, t + h, y, None, state, False)
        return (y, state), None

    begin = y0, solver.init(terms, 0.0, h, y0, None)
    return jax.lax.scan(step, begin, h * jnp.arange(5))[0][0]


START = jnp.array([0.3, -0.4, 0.1]), jnp.array([1.0, 0.2, -0.5])


def test_the_solvers_with_names_are_their_pieces():
    half = ds.Flow(1 / 2, ds.StormerVerlet(), 2)
    flows = ds.Splitting([HALF_KICK, half, ds.Bath(1), half, HALF_KICK])
    slow = lambda t, q, args: jnp.sum(jnp.cos(q))
    cases = (
        (BAOAB, ds.BAOAB(), {}),
        (MIDDLE, ds.LangevinMiddle(), {}),
        (flows, ds.BAOAB(ds.StormerVerlet(), steps=2), {"slow": slow}),
    )
    for pieces, named, options in cases:
        terms = _terms(named, **options)
        both = lambda y0, x=(pieces, named), terms=terms: [
            _solve(s, terms, y0) for s in x
        ]
        np.testing.assert_array_equal(*jax.jit(both)(START))
        assert pieces.undoes_its_steps == named.undoes_its_steps
        assert pieces.order(None) == named.order(None)
        assert pieces.variables == named.variables
        assert pieces.stage_vectors(1) == named.stage_vectors(1)
    assert UNEQUAL.order(None) == 1 and UNEQUAL.record.weak == 1


@pytest.mark.core
def test_a_rod_is_kept_by_any_order_of_the_pieces():
    rod = lambda q, args: jnp.sum(q**2, keepdims=True) - 1
    y0 = jnp.zeros(3), jnp.array([0.6, 0.0, -0.8])
    for solver in (ABOBA, OBABO):
        terms = _terms(solver, constraint=rod)
        p, q = jax.jit(lambda y0, given=(solver, terms): _solve(*given, y0))(y0)
        np.testing.assert_allclose(q @ q, 1, rtol=1e-14)
        np.testing.assert_allclose(p @ q, 0, atol=1e-14)


def test_forces_at_the_end_of_a_step_are_those_at_the_start_of_the_next_one():
    kinetic = lambda t, p, q, args: jnp.sum(p**2) / 2
    potential = lambda t, q, args: jnp.sum(jnp.sin(q))
    whole = lambda t, p, q, args: kinetic(t, p, q, args) + potential(t, q, args)
    for solver, H0, slow in (
        (OBABO, whole, None),
        (BAOAB, whole, None),
        (ABOBA, whole, None),
        # Forces beside those of a flow.
        (ds.BAOAB(ds.StormerVerlet(), steps=3), kinetic, potential),
    ):
        path = solver.path((3,), KEY)
        terms = ds.langevin_terms(H0, 0.5, 0.7, path, slow=slow)
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
