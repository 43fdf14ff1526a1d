"""Forces that jump at step ends are told where they make `BAOAB` first order."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds


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


def _told(H0, solver, h, t1=2, y0=DISPLACED, args=None, **options):
    """The estimate, and the warning of jumps, if there is one."""
    terms = ds.langevin_terms(H0, 0.5, 1.0, ())
    options = dict(key=jr.key(0), sampling=FEW) | options
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = ds.expectation(_square, terms, solver, 0, t1, h, y0, args, **options)
    found = [str(x.message) for x in told if "jump at step ends" in str(x.message)]
    assert len(found) <= 1
    return got, found[0] if found else None


def _is_told(*given, **options):
    return _told(*given, **options)[1] is not None


def _quench(t):
    return jnp.where(t < 1, 1.0, 4.0)


def _quench_by_mean(t):
    return (_quench(t - 1e-9) + _quench(t + 1e-9)) / 2


# Of the mean square at time 2, by the equations of the moments before and after time 1.
EXACT = 0.7037


def test_a_quench_at_a_step_end_is_told_and_beyond_the_error_bar():
    got, message = _told(_trap(_quench), ds.BAOAB(), 0.125, sampling=EXACTLY)
    assert abs(got.mean - EXACT) > got.error
    assert "such as t=1, and `BAOAB` takes one side" in message
    assert "pass `BAOAB(ImplicitMidpoint())`" in message


@pytest.mark.parametrize(
    "stiffness, solver",
    [(_quench_by_mean, ds.BAOAB()), (_quench, ds.BAOAB(ds.ImplicitMidpoint()))],
    ids=["mean of both sides", "forces within steps"],
)
def test_both_cures_give_the_right_mean_and_are_not_told(stiffness, solver):
    got, message = _told(_trap(stiffness), solver, 0.125, sampling=EXACTLY)
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
    given = _square, terms, ds.BAOAB(flow), 0, 2, 0.25, REST
    with pytest.warns(UserWarning, match="mean of both sides at a jump\\.$"):
        ds.expectation(*given, key=jr.key(0), sampling=FEW)


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
    "within steps": lambda t: jnp.where(t < 1.03, 1.0, 4.0),
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
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            given = _square, terms, ds.BAOAB(), t0, t0 + 2, 0.25, y0
            ds.expectation(*given, key=jr.key(0), sampling=FEW)
        return any("jump at step ends" in str(x.message) for x in told)

    assert is_told(lambda t: jnp.where(t < t0 + 1, 1.0, 4.0))
    assert not is_told(lambda t: 1 + jnp.sin(3 * t) / 2)
    assert not is_told(lambda t: 1 + jnp.tanh(20 * (t - t0 - 0.9)) / 2)


def test_three_levels_check_the_order_themselves():
    assert not _is_told(_trap(_quench), ds.BAOAB(), 0.25, levels=3)


def test_flips_at_random_times_are_within_steps():
    def flips(key):
        return jr.uniform(key, (), minval=0.0, maxval=2.0)

    def energy(t, p, q, time):
        return p**2 / 2 + jnp.where(t < time, 1.0, 4.0) * q**2 / 2

    sampling = ds.IndependentPaths(64)
    assert not _is_told(energy, ds.BAOAB(), 0.25, args=flips, sampling=sampling)


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
    with pytest.warns(UserWarning, match="jump at step ends, such as t=1,"):
        ds.expectation(
            _square, terms, ds.BAOAB(), 0, 2, 0.1, y0, key=jr.key(0), sampling=FEW
        )
