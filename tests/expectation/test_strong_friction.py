"""Warnings of steps that do not resolve the friction."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..problems import as_friction
from .messages import messages


FEW = ds.IndependentPaths(64)
MASSES = jnp.array([2.0, 0.5, 4.0])
STIFFNESS = jnp.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])


def _well(t, p, q, args):
    return jnp.sum(p**2 / MASSES) / 2 + q @ STIFFNESS @ q / 2


def _square_of_q(t, y, args):
    return jnp.sum(y[1] ** 2)


def _is_told(terms, solver, h, y0, args=None, levels=2):
    """Whether a warning tells of the friction."""
    told = messages(_square_of_q, terms, solver, 0, 8 * h, h, y0, args, levels)
    return any("do not resolve" in message for message in told)


def _estimate(terms, solver, h, y0, phi, num_paths=64):
    """The estimate, and whether a warning tells of the friction."""
    given = phi, terms, solver, 0, 8 * h, h, y0
    sampling = ds.IndependentPaths(num_paths)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(*given, key=jr.key(0), sampling=sampling)
    return got, any("do not resolve" in str(x.message) for x in told)


REST = jnp.zeros(3), jnp.zeros(3)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_solvers_with_friction_in_the_drift_are_told_beyond_their_limit(scale):
    # In any unit of time. The largest decay rate is 0.8 / 0.5 for the friction 0.8.
    def energy(t, p, q, args):
        return jnp.sum(p**2 / MASSES) / 2 + q @ STIFFNESS @ q / (2 * scale**2)

    terms = ds.langevin_terms(energy, 0.8 / scale, 1.0, (3,))
    for solver, most in ((ds.AdditiveGauss(), 2.0), (ds.SRKw5(), 0.5)):
        for factor in (0.9, 1.1):
            h = factor * most * 0.5 / 0.8 * scale
            assert _is_told(terms, solver, h, REST) == (factor > 1)


def test_a_bead_is_too_hot_on_both_levels_and_told():
    H0 = lambda t, p, q, args: p**2 / 2 + 50 * q**2
    terms = ds.langevin_terms(H0, 1000.0, 1.0, ())
    y0 = jnp.array(0.0), jnp.array(0.0)
    phi = lambda t, y, args: y[1] ** 2
    got, told = _estimate(terms, ds.AdditiveGauss(), 2.0, y0, phi, 1000)
    # The exact mean is at most 0.01, in equilibrium.
    assert got.mean - 2 * got.error > 0.02
    assert told


def test_a_flow_that_keeps_overdamped_positions_where_they_are_is_told():
    # The relaxation time is 1: after 4 of it <q^2> is 0.00044.
    G = k = 1e4
    H0 = lambda t, p, q, args: p**2 / 2 + k * q**2 / 2
    terms = ds.langevin_terms(H0, G, 1.0, ())
    y0 = jnp.array(0.0), jnp.array(1.0)
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    got, told = _estimate(terms, solver, 0.5, y0, _square_of_q)
    assert got.mean - 10 * got.error > 0.1
    assert told
    # Plain midpoint steps relax, and steps that resolve the vibration do.
    assert not _is_told(terms, ds.ImplicitMidpoint(), 0.5, y0)
    assert not _is_told(terms, solver, 0.015, y0)


@pytest.mark.parametrize(
    "solver", [ds.BAOAB(), ds.LangevinMiddle(), ds.ImplicitMidpoint(), ds.SRKw1()]
)
def test_solvers_for_every_friction_are_not_told(solver):
    terms = ds.langevin_terms(_well, 100.0, 1.0, (3,))
    assert not _is_told(terms, solver, 0.2, REST)


def test_stiff_modes_with_weak_friction_keep_their_law_and_are_not_told():
    H0 = lambda t, p, q, args: p**2 / 2 + 1e4 * q**2 / 2
    terms = ds.langevin_terms(H0, 1.0, 1.0, ())
    y0 = jnp.array(0.0), jnp.array(0.0)
    assert not _is_told(terms, ds.BAOAB(ds.ImplicitMidpoint()), 0.5, y0)


def test_friction_that_depends_on_positions_masses_and_args_is_that_of_the_start():
    H0 = lambda t, p, q, args: (p**2 * jnp.exp(-q) + q**2) / 2
    friction = lambda t, q, args: args * jnp.exp(q)  # a rate
    terms = ds.langevin_terms(H0, friction, 1.0, ())
    y0 = {"near": (0.0, 0.0), "far": (0.0, 2.0)}
    for start in y0.values():
        start = jax.tree.map(jnp.array, start)
        for rate in (4.0, 6.0):  # h = 0.1 and the limit 0.5
            told = _is_told(terms, ds.StrangGauss(), 0.1, start, jnp.array(rate))
            assert told == (rate > 5)


def _turning(t, q, args):
    """Friction 10 times as strong along one axis, which turns with the position."""
    strong, turns = args
    c, s = jnp.cos(turns * q[0]), jnp.sin(turns * q[0])
    turn = jnp.array([[c, -s], [s, c]])
    return as_friction(strong * turn @ jnp.diag(jnp.array([1.0, 0.1])) @ turn.T)


def _free(t, p, q, args):
    return jnp.sum(p**2) / 2


PLANE = jnp.zeros(2), jnp.zeros(2)


@pytest.mark.parametrize("solver", [ds.BAOAB(), ds.BAOAB(ds.ImplicitMidpoint())])
def test_friction_that_turns_far_in_a_step_is_told(solver):
    terms = ds.langevin_terms(_free, _turning, 1.0, (2,))

    def told(strong, turns, h=1.0):
        args = jnp.array(strong), jnp.array(turns)
        return _is_told(terms, solver, h, PLANE, args)

    assert told(5.0, 2.0)
    assert not told(5.0, 0.1)
    # The same steps for half of the way.
    assert not told(5.0, 2.0, h=0.1)
    # Weak friction averages over many directions.
    assert not told(0.5, 2.0)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_friction_that_turns_is_told_in_any_unit_of_time_and_from_rest(scale):
    # The thermal velocities are 1 / `scale`: what turns the tensor is the bath alone.
    def energy(t, p, q, args):
        return jnp.sum(p**2) / (2 * scale**2)

    terms = ds.langevin_terms(energy, _turning, 1.0, (2,))
    for turns in (0.1, 2.0):
        args = jnp.array(5.0 * scale), jnp.array(turns)
        assert _is_told(terms, ds.BAOAB(), scale, PLANE, args=args) == (turns > 1)


def test_friction_that_changes_its_size_is_told_and_constant_friction_is_not():
    wall = lambda t, q, args: 5.0 * (1 + args * jnp.tanh(q) ** 2)
    terms = ds.langevin_terms(_free, wall, 1.0, (2,))
    assert _is_told(terms, ds.BAOAB(), 1.0, PLANE, args=jnp.array(10.0))
    assert not _is_told(terms, ds.BAOAB(), 1.0, PLANE, args=jnp.array(0.1))
    # Masses change, and the friction does not.
    heavier = lambda t, p, q, args: jnp.sum(p**2 * jnp.exp(-3 * q)) / 2
    terms = ds.langevin_terms(heavier, 5.0, 1.0, (2,))
    assert not _is_told(terms, ds.BAOAB(ds.ImplicitMidpoint()), 0.2, PLANE)


@pytest.mark.slow
def test_two_levels_of_friction_that_turns_far_agree_on_a_wrong_diffusion():
    terms = ds.langevin_terms(_free, _turning, 1.0, (2,))
    args = jnp.array(5.0), jnp.array(2.4)
    phi = lambda t, y, args: jnp.sum(y[1] ** 2)
    start = lambda key: (jr.normal(key, (2,)), jnp.zeros(2))
    given = dict(key=jr.key(0), sampling=ds.IndependentPaths(2**13))
    with pytest.warns(UserWarning, match="how the friction changes with positions"):
        long = ds.expectation(phi, terms, ds.BAOAB(), 0, 40, 1.0, start, args, **given)
    short = ds.expectation(phi, terms, ds.BAOAB(), 0, 40, 1 / 32, start, args, **given)
    assert long.mean - 3 * long.error > short.mean + 3 * short.error


def test_with_three_levels_the_order_is_checked_instead():
    terms = ds.langevin_terms(_well, 8.0, 1.0, (3,))
    assert _is_told(terms, ds.SRKw5(), 0.2, REST)
    assert not _is_told(terms, ds.SRKw5(), 0.2, REST, levels=3)
    assert not _is_told(terms, ds.SRKw5(), 0.2, REST, levels=1)


KICK = ds.noise_terms(lambda t, p, q, args: 0.1 * q, ())
DISPLACED = jnp.array(1.0), jnp.array(0.5)


def _is_told_of_drift(matrix, h, solver):
    """Whether a warning tells of the decay by a linear drift with this matrix."""

    def drift(t, y, args):
        p, q = jnp.array(matrix) @ jnp.stack(y)
        return p, q

    terms = diffrax.MultiTerm(diffrax.ODETerm(drift), KICK)
    return _is_told(terms, solver, h, DISPLACED)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("solver, most", [(ds.AdditiveGauss(), 2.0), (ds.SRKw5(), 0.5)])
def test_a_loss_that_is_a_term_of_its_own_is_told_beyond_the_same_limit(
    scale, solver, most
):
    for matrix in ([[-1.0, 0.0], [0.0, -1.0]], [[-1.0, -0.1], [0.1, -1.0]]):
        rates = np.array(matrix) / scale
        assert not _is_told_of_drift(rates, 0.9 * most * scale, solver)
        assert _is_told_of_drift(rates, 1.1 * most * scale, solver)


@pytest.mark.parametrize(
    "matrix",
    [
        [[0.0, -1.0], [1.0, 0.0]],
        [[0.0, -1e4], [1.0, 0.0]],
        [[0.0, -1.0], [1e4, 0.0]],
        [[-0.1, -100.0], [1.0, 0.0]],
        [[0.0, 100.0], [1.0, 0.0]],
        [[0.0, 0.0], [1.0, 0.0]],
    ],
    ids=["oscillator", "stiff", "light", "damped", "saddle", "free"],
)
def test_oscillations_and_growth_are_no_decay(matrix):
    frequency = max(np.abs(np.linalg.eigvals(np.array(matrix)))) or 1.0
    assert not _is_told_of_drift(matrix, 3 / frequency, ds.AdditiveGauss())


def test_a_lossy_mode_is_far_too_hot_on_both_levels_and_told():
    rate, T = 1e4, 0.01
    kick = ds.noise_terms(lambda t, p, q, args: jnp.sqrt(2 * rate * T) * q, ())
    loss = diffrax.ODETerm(lambda t, y, args: (-rate * y[0], -rate * y[1]))
    phi = lambda t, y, args: y[0] ** 2
    terms = diffrax.MultiTerm(loss, kick)
    got, is_told = _estimate(terms, ds.AdditiveGauss(), 1.0, DISPLACED, phi, 8192)
    assert got.mean - T > 10 * got.error
    assert is_told


def test_the_warning_names_the_line_of_the_user():
    terms = ds.langevin_terms(_well, 8.0, 1.0, (3,))
    phi = lambda t, y, args: jnp.sum(y[1] ** 2)
    given = phi, terms, ds.SRKw5(), 0, 2, 0.2, REST
    with pytest.warns(UserWarning, match="do not resolve the friction") as told:
        ds.expectation(*given, key=jr.key(1), sampling=FEW)
    where = {x.filename for x in told if "do not resolve" in str(x.message)}
    assert where == {__file__}
