"""Steps that do not resolve the friction, or another decay, are told."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.strong_friction import unresolved_friction

from ..problems import as_friction
from .steps import problem_of


MASSES = jnp.array([2.0, 0.5, 4.0])
STIFFNESS = jnp.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
SPACE = jnp.zeros(3), jnp.zeros(3)
PLANE = jnp.zeros(2), jnp.zeros(2)
LINE = jnp.array(0.0), jnp.array(1.0)
# The largest products of step and decay rate.
LIMITS = (ds.AdditiveGauss(), 2.0), (ds.SRKw5(), 0.5)
SCALES = 1.0, 1e-6, 1e6
BAOAB = ds.BAOAB()
IMPLICIT_BAOAB = ds.BAOAB(ds.ImplicitMidpoint())


def _is_told(terms, solver, h, y0, args=None):
    return unresolved_friction(problem_of(terms, solver, h, y0, args), h) is not None


def _in_unit_of_time(t, p, q, args):
    """The kinetic energy and that of springs; `args` starts with a unit of time."""
    return jnp.sum(p**2 / MASSES) / 2 + q @ STIFFNESS @ q / (2 * args[0] ** 2)


def test_solvers_with_friction_in_the_drift_are_told_beyond_their_limit():
    # The largest decay rate is 0.8 / 0.5 for the friction 0.8.
    friction = lambda t, q, args: 0.8 / args[0]
    terms = ds.langevin_terms(_in_unit_of_time, friction, 1.0, (3,))
    for solver, most in LIMITS:
        for scale in SCALES:
            for factor in (0.9, 1.1):
                h = factor * most * 0.5 / 0.8 * scale
                is_told = _is_told(terms, solver, h, SPACE, (jnp.array(scale),))
                assert is_told == (factor > 1)


def test_a_flow_that_keeps_overdamped_positions_where_they_are_is_told():
    # The relaxation time is 1.
    H0 = lambda t, p, q, args: p**2 / 2 + 1e4 * q**2 / 2
    terms = ds.langevin_terms(H0, 1e4, 1.0, ())
    assert _is_told(terms, IMPLICIT_BAOAB, 0.5, LINE)
    # Plain midpoint steps relax, and steps that resolve the vibration do.
    assert not _is_told(terms, ds.ImplicitMidpoint(), 0.5, LINE)
    assert not _is_told(terms, IMPLICIT_BAOAB, 0.015, LINE)
    # With weak friction, stiff modes keep their law.
    terms = ds.langevin_terms(H0, 1.0, 1.0, ())
    assert not _is_told(terms, IMPLICIT_BAOAB, 0.5, LINE)


def test_solvers_for_every_friction_are_not_told():
    terms = ds.langevin_terms(_in_unit_of_time, 100.0, 1.0, (3,))
    args = (jnp.array(1.0),)
    for solver in (BAOAB, ds.LangevinMiddle(), ds.ImplicitMidpoint(), ds.SRKw1()):
        assert not _is_told(terms, solver, 0.2, SPACE, args)


def test_friction_that_depends_on_positions_masses_and_args_is_that_of_the_start():
    H0 = lambda t, p, q, args: (p**2 * jnp.exp(-q) + q**2) / 2
    friction = lambda t, q, args: args * jnp.exp(q)  # a rate
    terms = ds.langevin_terms(H0, friction, 1.0, ())
    for position in (0.0, 2.0):
        start = jnp.array(0.0), jnp.array(position)
        for rate in (4.0, 6.0):  # h = 0.1 and the limit 0.5
            told = _is_told(terms, ds.StrangGauss(), 0.1, start, jnp.array(rate))
            assert told == (rate > 5)


def _free_in_unit_of_time(t, p, q, args):
    """From rest the bath alone moves positions, by about 1 in a unit of time."""
    return jnp.sum(p**2) / (2 * args[0] ** 2)


def _turning(t, q, args):
    """Friction 10 times as strong along one axis, which turns with the position."""
    scale, strong, turns = args
    c, s = jnp.cos(turns * q[0]), jnp.sin(turns * q[0])
    turn = jnp.array([[c, -s], [s, c]])
    return as_friction(strong * scale * turn @ jnp.diag(jnp.array([1.0, 0.1])) @ turn.T)


@pytest.mark.parametrize("solver", [BAOAB, IMPLICIT_BAOAB], ids=repr)
def test_friction_that_turns_far_in_a_step_is_told_in_any_unit_of_time(solver):
    terms = ds.langevin_terms(_free_in_unit_of_time, _turning, 1.0, (2,))

    def is_told(strong, turns, h, scale=1.0):
        args = jnp.array(scale), jnp.array(strong), jnp.array(turns)
        return _is_told(terms, solver, h * scale, PLANE, args)

    for scale in SCALES:
        assert is_told(5.0, 2.0, 1.0, scale)
    # Too little of a turn, or the same steps for a part of the way.
    assert not is_told(5.0, 0.1, 1.0, 1e-6)
    assert not is_told(5.0, 2.0, 0.1)
    # Weak friction averages over many directions.
    assert not is_told(0.5, 2.0, 1.0)


def test_friction_that_changes_its_size_is_told_and_constant_friction_is_not():
    wall = lambda t, q, args: 5.0 * (1 + args[1] * jnp.tanh(q) ** 2)
    terms = ds.langevin_terms(_free_in_unit_of_time, wall, 1.0, (2,))
    for change in (0.1, 10.0):
        args = jnp.array(1.0), jnp.array(change)
        assert _is_told(terms, BAOAB, 1.0, PLANE, args) == (change > 1)
    # Masses change, and the friction does not.
    heavier = lambda t, p, q, args: jnp.sum(p**2 * jnp.exp(-3 * q)) / 2
    terms = ds.langevin_terms(heavier, 5.0, 1.0, (2,))
    assert not _is_told(terms, IMPLICIT_BAOAB, 0.2, PLANE)


def _is_told_of_drift(matrix, h, solver):
    """Whether a warning tells of the decay by a linear drift with this matrix."""
    drift = diffrax.ODETerm(lambda t, y, args: tuple(args @ jnp.stack(y)))
    kick = ds.noise_terms(lambda t, p, q, args: 0.1 * q, ())
    y0 = jnp.array(1.0), jnp.array(0.5)
    terms = diffrax.MultiTerm(drift, kick)
    return _is_told(terms, solver, h, y0, jnp.asarray(matrix))


def test_a_loss_that_is_a_term_of_its_own_is_told_beyond_the_same_limit():
    for solver, most in LIMITS:
        for scale in SCALES:
            for matrix in ([[-1.0, 0.0], [0.0, -1.0]], [[-1.0, -0.1], [0.1, -1.0]]):
                rates = np.array(matrix) / scale
                assert not _is_told_of_drift(rates, 0.9 * most * scale, solver)
                assert _is_told_of_drift(rates, 1.1 * most * scale, solver)


def test_oscillations_and_growth_are_no_decay():
    matrices = {
        "oscillator": [[0.0, -1.0], [1.0, 0.0]],
        "stiff": [[0.0, -1e4], [1.0, 0.0]],
        "light": [[0.0, -1.0], [1e4, 0.0]],
        "damped": [[-0.1, -100.0], [1.0, 0.0]],
        "saddle": [[0.0, 100.0], [1.0, 0.0]],
        "free": [[0.0, 0.0], [1.0, 0.0]],
    }
    for name, matrix in matrices.items():
        frequency = max(np.abs(np.linalg.eigvals(np.array(matrix)))) or 1.0
        assert not _is_told_of_drift(matrix, 3 / frequency, ds.AdditiveGauss()), name
