"""Forces and noise that jump in time are told where two levels do not show their error."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from .messages import messages


FEW = ds.IndependentPaths(16)
# Means of squares without a sampling error.
EXACTLY = ds.ValueFunctions(degree=2, num_paths=64)
REST = jnp.array(0.0), jnp.array(0.0)
DISPLACED = jnp.array(0.0), jnp.array(2.0)


def _square(t, y, args):
    return jnp.sum(y[1] ** 2)


def _trap(stiffness):
    """The Hamiltonian of a trap with this function of time."""
    return lambda t, p, q, args: jnp.sum(p**2) / 2 + stiffness(t) * jnp.sum(q**2) / 2


def _found(told):
    """The warning of jumps among others, if there is one."""
    found = [message for message in told if "jump" in message]
    assert len(found) <= 1
    return found[0] if found else None


def _bath(H0, T=1.0):
    return ds.langevin_terms(H0, 0.5, T, ())


def _message(H0, solver, h, t1=2, y0=DISPLACED, args=None, terms=None, levels=2):
    """What is said of jumps."""
    terms = _bath(H0) if terms is None else terms
    return _found(messages(_square, terms, solver, 0, t1, h, y0, args, levels))


def _is_told(*given, **options):
    return _message(*given, **options) is not None


def _estimate(H0, solver, h, t1=2, T=1.0, terms=None, **options):
    """The estimate, without a sampling error, and what is said of jumps."""
    terms = _bath(H0, T) if terms is None else terms
    given = _square, terms, solver, 0, t1, h, DISPLACED
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(*given, key=jr.key(0), sampling=EXACTLY, **options)
    return got, _found([str(x.message) for x in told])


def _quench(t):
    return jnp.where(t < 1, 1.0, 4.0)


def _quench_by_mean(t):
    return (_quench(t - 1e-9) + _quench(t + 1e-9)) / 2


# Of the mean square at time 2, by the equations of the moments before and after time 1.
EXACT = 0.7037


def test_a_quench_at_a_step_end_is_told_and_beyond_the_error_bar():
    got, message = _estimate(_trap(_quench), ds.BAOAB(), 0.125)
    assert abs(got.mean - EXACT) > got.error
    assert "such as t=1, and `BAOAB` takes one side" in message
    assert "pass `BAOAB(ImplicitMidpoint())`" in message


@pytest.mark.parametrize(
    "stiffness, solver",
    [
        (_quench_by_mean, ds.BAOAB()),
        pytest.param(_quench, ds.BAOAB(ds.ImplicitMidpoint()), marks=pytest.mark.slow),
    ],
    ids=["mean of both sides", "forces within steps"],
)
def test_both_cures_give_the_right_mean_and_are_not_told(stiffness, solver):
    got, message = _estimate(_trap(stiffness), solver, 0.125)
    assert abs(got.mean - EXACT) < got.error
    assert got.error < 0.02
    assert message is None


def test_a_mean_at_the_very_time_of_the_jump_is_a_cure():
    by_equality = lambda t: jnp.where(t == 1, 2.5, _quench(t))
    assert not _is_told(_trap(by_equality), ds.BAOAB(), 0.125)


def test_a_jump_in_the_middle_of_the_longest_steps_is_told():
    # t = 1 is the middle of a step of 0.4.
    assert _is_told(_trap(_quench), ds.BAOAB(), 0.4)


@pytest.mark.parametrize("y0", [REST, DISPLACED], ids=["at rest", "displaced"])
def test_a_force_that_vanishes_where_paths_start_is_told(y0):
    assert _is_told(_trap(_quench), ds.BAOAB(), 0.25, y0=y0)


@pytest.mark.parametrize("size", [1e-4, 1e4])
def test_jumps_of_any_size_are_told(size):
    push = lambda t: jnp.where(t < 1, -size, size)
    pushed = lambda t, p, q, args: (p**2 + q**2) / 2 - push(t) * q
    assert _is_told(pushed, ds.BAOAB(), 0.25)


def test_times_that_are_rounded_to_either_side_are_told():
    # The end of the third step is 0.30000000000000004.
    for time in (0.3, 0.1 + 0.2, np.nextafter(0.1 + 0.2, 1)):
        stiffness = lambda t: jnp.where(t < time, 1.0, 4.0)
        assert _is_told(_trap(stiffness), ds.BAOAB(), 0.1)


def test_a_slow_force_that_jumps_is_told_its_own_cure():
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    slow = lambda t, q, args: -jnp.where(t < 1, 0.0, 1.0) * q
    terms = ds.langevin_terms(energy, 0.5, 1.0, (), slow=slow)
    flow = ds.linear_flow(jnp.array([[1.0]]).reshape(()))
    message = _message(None, ds.BAOAB(flow), 0.25, y0=REST, terms=terms)
    assert message.endswith("mean of both sides at a jump.")


def test_the_warning_names_the_line_of_the_user():
    terms = ds.langevin_terms(_trap(_quench), 0.5, 1.0, ())
    with pytest.warns(UserWarning, match="jump at step ends") as told:
        ds.expectation(
            _square, terms, ds.BAOAB(), 0, 2, 0.25, REST, key=jr.key(0), sampling=FEW
        )
    assert {x.filename for x in told if "jump" in str(x.message)} == {__file__}


SMOOTH = {
    "constant": lambda t: 1.0,
    "constant by values": lambda t: 1 + 0 * t,
    "periodic": lambda t: 1 + jnp.sin(3 * t) / 2,
    "fast": lambda t: 1 + jnp.sin(1000 * t) / 2,
    "a pulse with its peak at a step end": lambda t: (
        1 + jnp.exp(-(((t - 1) * 300) ** 2))
    ),
    "a pulse with its flank at a step end": lambda t: 1 + jnp.tanh((t - 1) * 1000) / 2,
    "a ramp": lambda t: jnp.interp(t, jnp.array([0.5, 0.51]), jnp.array([1.0, 4.0])),
    "a peak": lambda t: 1 + jnp.abs(t - 1),
    "from the start": lambda t: jnp.where(t <= 0, 0.0, 1.0),
    "until the end": lambda t: jnp.where(t <= 2, 1.0, 4.0),
    "a sign, which is zero between": lambda t: 2 + jnp.sign(t - 1),
    "the mean of both sides near a step end": _quench_by_mean,
}


@pytest.mark.parametrize("stiffness", SMOOTH.values(), ids=SMOOTH)
def test_other_forces_are_not_told(stiffness):
    assert not _is_told(_trap(stiffness), ds.BAOAB(), 0.25)


@pytest.mark.parametrize("t0", [0.0, 100.0])
def test_single_precision_tells_of_jumps_and_not_of_smooth_forces(t0):
    y0 = jnp.zeros((), jnp.float32), jnp.full((), 2.0, jnp.float32)
    noise = jax.ShapeDtypeStruct((), jnp.float32)

    def is_told(stiffness):
        terms = ds.langevin_terms(_trap(stiffness), 0.5, 1.0, noise)
        told = messages(_square, terms, ds.BAOAB(), t0, t0 + 2, 0.25, y0)
        return _found(told) is not None

    assert is_told(lambda t: jnp.where(t < t0 + 1, 1.0, 4.0))
    assert not is_told(lambda t: 1 + jnp.sin(3 * t) / 2)
    assert not is_told(lambda t: 1 + jnp.tanh(20 * (t - t0 - 0.9)) / 2)


def test_three_levels_check_the_order_themselves():
    assert not _is_told(_trap(_quench), ds.BAOAB(), 0.25, levels=3)


WITHIN = 1.03
# Of the mean square at time 2, by the equations of the moments before and after `WITHIN`:
# if the stiffness jumps from 1 to 4, and if the temperature jumps from 1 to 10.
EXACT_WITHIN = {"stiffness": 0.649278, "temperature": 2.286610}


def _within_steps(what):
    """The Hamiltonian and the temperature."""
    if what == "stiffness":
        return _trap(lambda t: jnp.where(t < WITHIN, 1.0, 4.0)), 1.0
    return _trap(lambda t: 1.0), lambda t, q, args: jnp.where(t < WITHIN, 1.0, 10.0)


@pytest.mark.parametrize(
    "what, solver",
    [
        ("stiffness", ds.ImplicitMidpoint()),
        pytest.param(
            "temperature", ds.BAOAB(ds.ImplicitMidpoint()), marks=pytest.mark.slow
        ),
    ],
    ids=EXACT_WITHIN,
)
def test_a_jump_within_a_step_is_told_and_beyond_the_error_bar(what, solver):
    H0, T = _within_steps(what)
    got, message = _estimate(H0, solver, 0.25, T=T)
    assert abs(got.mean - EXACT_WITHIN[what]) > 3 * got.error
    assert "jump within a step, such as at t=1.03." in message


@pytest.mark.slow
def test_steps_that_end_at_the_jump_give_the_right_mean_and_are_not_told():
    H0, T = _within_steps("temperature")
    # As many steps before the jump as fit, up to a start that is a little earlier.
    h = WITHIN / 5
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    got, message = _estimate(H0, solver, h, t1=10 * h, T=T)
    finer, _ = _estimate(H0, solver, h / 4, t1=10 * h, T=T)
    assert abs(got.mean - finer.mean) < got.error
    assert message is None


@pytest.mark.slow
def test_three_levels_tell_of_jumps_within_steps_too():
    H0, T = _within_steps("temperature")
    got, message = _estimate(H0, ds.BAOAB(), 0.25, T=T, levels=3)
    assert abs(got.mean - EXACT_WITHIN["temperature"]) > 3 * got.error
    assert "jump within a step" in message


def test_one_level_does_not_tell_since_its_bar_leaves_out_the_error_of_the_step():
    assert not _is_told(_within_steps("stiffness")[0], ds.BAOAB(), 0.125, levels=1)


@pytest.mark.parametrize(
    "solver", [ds.StormerVerlet(), diffrax.Heun()], ids=["StormerVerlet", "Heun"]
)
@pytest.mark.parametrize("what", ["forces", "noise"])
def test_jumps_within_steps_are_told_for_any_solver(what, solver):
    jumping = lambda t: jnp.where(t < WITHIN, 1.0, 4.0)
    H0 = _trap(jumping if what == "forces" else lambda t: 1.0)
    noise = lambda t, p, q, args: q * (jumping(t) if what == "noise" else 1.0)
    terms = ds.hamiltonian_terms(H0, noise, ())
    assert "jump within a step" in _message(None, solver, 0.25, terms=terms)


def test_a_small_jump_beside_a_large_smooth_drive_is_found():
    drive = lambda t: 30 * jnp.sin(2 * t) + jnp.where(t < WITHIN, 0.0, 3.0)
    driven = lambda t, p, q, args: (p**2 + q**2) / 2 - drive(t) * q
    message = _message(driven, ds.BAOAB(), 0.25)
    assert "such as at t=1.03." in message


def test_a_jump_at_the_same_time_of_all_paths_is_told_where_args_are_drawn():
    size = lambda key: jr.uniform(key, (), minval=1.0, maxval=4.0)
    energy = lambda t, p, q, size: (
        p**2 / 2 + jnp.where(t < WITHIN, 1.0, size) * q**2 / 2
    )
    assert _is_told(energy, ds.BAOAB(), 0.25, args=size)


def test_jumps_at_random_times_are_not_told():
    def flips(key):
        return jr.uniform(key, (), minval=0.0, maxval=2.0)

    def energy(t, p, q, time):
        return p**2 / 2 + jnp.where(t < time, 1.0, 4.0) * q**2 / 2

    assert not _is_told(energy, ds.BAOAB(), 0.25, args=flips)


# The mean square at time 2 of an oscillator, first at (0, 2), whose noise jumps from 1 to 3
# at time 1.
EXACT_WITH_NOISE = 4.063318


WITH_JUMPING_NOISE = ds.hamiltonian_terms(
    _trap(lambda t: 1.0), lambda t, p, q, args: jnp.where(t < 1, 1.0, 3.0) * q, ()
)


def test_noise_that_jumps_at_a_step_end_is_told_and_beyond_the_error_bar():
    got, message = _estimate(None, ds.SRKw4(), 0.25, terms=WITH_JUMPING_NOISE)
    assert abs(got.mean - EXACT_WITH_NOISE) > 2 * got.error
    assert "The noise jumps at step ends, such as t=1, and `SRKw4`" in message


@pytest.mark.parametrize("solver", [ds.SRKs4(), ds.PlateauVerlet()], ids=repr)
def test_noise_that_jumps_at_a_step_end_is_told_for_solvers_that_take_it_there(solver):
    message = _message(None, solver, 0.25, terms=WITH_JUMPING_NOISE)
    assert f"and `{type(solver).__name__}`" in message


@pytest.mark.parametrize(
    "solver", [ds.ImplicitMidpoint(), ds.StormerVerlet()], ids=repr
)
@pytest.mark.slow
def test_solvers_that_take_noise_within_steps_are_right_where_it_jumps(solver):
    got, message = _estimate(None, solver, 0.25, terms=WITH_JUMPING_NOISE)
    assert abs(got.mean - EXACT_WITH_NOISE) < got.error
    assert message is None


def _hanging(t, p, q, args):
    return jnp.sum(p**2) / 2 + _quench(t) * q[1]


def _free(t, p, q, args):
    return jnp.sum(p**2) / 2


def _switched_on(t, y, args):
    return jnp.where(t < 1, 0.0, 1.0) * jnp.ones(2), jnp.zeros(2)


ROD = ds.langevin_terms(
    _hanging,
    0.5,
    1.0,
    (2,),
    constraint=lambda q, args: jnp.sum(q**2, keepdims=True) - 1,
)
PUSHED = diffrax.MultiTerm(
    *ds.langevin_terms(_free, 0.5, 1.0, (2,)).terms, diffrax.ODETerm(_switched_on)
)


@pytest.mark.parametrize("terms", [ROD, PUSHED], ids=["constraint", "further term"])
def test_forces_under_a_constraint_or_in_a_further_term_are_told(terms):
    y0 = jnp.zeros(2), jnp.array([0.0, -1.0])
    message = _message(None, ds.BAOAB(), 0.1, y0=y0, terms=terms)
    assert "jump at step ends, such as t=1," in message
