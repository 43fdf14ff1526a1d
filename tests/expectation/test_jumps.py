"""Forces and noise that jump in time, or change too fast for the steps, are told where two
levels do not show their error."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.fast_drive import unresolved_drive
from diffrax_symplectic._expectation.jumps import jumps_at_step_ends, jumps_within_steps

from .steps import problem_of


REST = jnp.array(0.0), jnp.array(0.0)
DISPLACED = jnp.array(0.0), jnp.array(2.0)
BAOAB = ds.BAOAB()
WITHIN = 1.03


def _quench(t, time=1.0):
    return jnp.where(t < time, 1.0, 4.0)


def _quench_by_mean(t):
    return (_quench(t - 1e-9) + _quench(t + 1e-9)) / 2


def _trap(stiffness):
    """The Hamiltonian of a trap with this function of time."""
    return lambda t, p, q, args: jnp.sum(p**2) / 2 + stiffness(t) * jnp.sum(q**2) / 2


def _bath(H0, T=1.0, noise=(), **options):
    return ds.langevin_terms(H0, 0.5, T, noise, **options)


def _driven(stiffness, strength):
    noise = lambda t, p, q, args: strength(t) * q
    return ds.hamiltonian_terms(_trap(stiffness), noise, ())


def _constant(t):
    return 1.0


def _at_ends(terms, solver=BAOAB, h=0.25, y0=DISPLACED, **options):
    return jumps_at_step_ends(problem_of(terms, solver, h, y0, **options))


def _within(terms, solver=BAOAB, h=0.25, y0=DISPLACED, args=None):
    return jumps_within_steps(problem_of(terms, solver, h, y0, args))


SMOOTH = {
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
    "the mean of both sides at it": lambda t: jnp.where(t == 1, 2.5, _quench(t)),
}

QUENCHES = {"a quench": _quench, "a quench on a slope": lambda t: _quench(t) + 100 * t}


def test_only_jumps_are_told():
    """One program for all of them, in which a number selects the function of time."""

    def H0(t, p, q, number):
        functions = [*SMOOTH.values(), *QUENCHES.values()]
        stiffness = jax.lax.switch(number, functions, t)
        return jnp.sum(p**2) / 2 + stiffness * jnp.sum(q**2) / 2

    for number, name in enumerate([*SMOOTH, *QUENCHES]):
        problem = problem_of(_bath(H0), BAOAB, 0.25, DISPLACED, jnp.array(number))
        assert jumps_within_steps(problem) is None, name
        assert (jumps_at_step_ends(problem) is None) == (name in SMOOTH), name


def test_what_does_not_depend_on_time_is_not_told():
    assert _at_ends(_bath(_trap(_constant))) is None
    assert _within(_bath(_trap(_constant))) is None


def test_a_jump_at_a_step_end_is_told_with_its_time_and_a_cure():
    message = _at_ends(_bath(_trap(_quench)), h=0.125, num_steps=16)
    assert "The forces jump at step ends, such as t=1, and `BAOAB` takes one" in message
    assert "pass `BAOAB(ImplicitMidpoint())`" in message
    kick = ds.Kick(1 / 2)
    flight = ds.Flight(1 / 2)
    in_the_middle = ds.Splitting([flight, kick, ds.Bath(1), kick, flight])
    for within_steps in (ds.BAOAB(ds.ImplicitMidpoint()), in_the_middle):
        assert _at_ends(_bath(_trap(_quench)), within_steps) is None
    # t = 1 is the middle of a step of 0.4.
    assert _at_ends(_bath(_trap(_quench)), h=0.4) is not None
    # At rest the force vanishes.
    assert _at_ends(_bath(_trap(_quench)), y0=REST) is not None


def test_jumps_of_any_size_at_times_rounded_to_either_side_are_told():
    # The end of the third step is 0.30000000000000004.
    H0 = lambda t, p, q, args: (
        (p**2 + q**2) / 2 - jnp.where(t < args[0], -1.0, 1.0) * args[1] * q
    )
    cases = [(0.3, 1.0), (0.1 + 0.2, 1.0), (np.nextafter(0.1 + 0.2, 1), 1.0)]
    for time, size in [*cases, (0.4, 1e-4), (0.4, 1e4)]:
        args = jnp.array(time), jnp.array(size)
        problem = problem_of(_bath(H0), BAOAB, 0.1, DISPLACED, args)
        assert jumps_at_step_ends(problem) is not None


def test_a_slow_force_that_jumps_is_told_its_own_cure():
    slow = lambda t, q, args: -jnp.where(t < 1, 0.0, 1.0) * q
    flow = ds.linear_flow(jnp.array(1.0))
    terms = _bath(_trap(_constant), slow=slow)
    message = _at_ends(terms, ds.BAOAB(flow), y0=REST)
    assert message.endswith("mean of both sides at a jump.")


def test_forces_under_a_constraint_or_in_a_further_term_are_told():
    y0 = jnp.zeros(2), jnp.array([0.0, -1.0])
    hanging = lambda t, p, q, args: jnp.sum(p**2) / 2 + _quench(t) * q[1]
    on_circle = lambda q, args: jnp.sum(q**2, keepdims=True) - 1
    constrained = _bath(hanging, noise=(2,), constraint=on_circle)
    switched_on = lambda t, y, args: (_quench(t) * jnp.ones(2), jnp.zeros(2))
    further = diffrax.ODETerm(switched_on)
    plain = _bath(_trap(_constant), noise=(2,)).terms
    for terms in (constrained, diffrax.MultiTerm(*plain, further)):
        assert "jump at step ends, such as t=1," in _at_ends(terms, y0=y0)


def test_noise_that_jumps_at_a_step_end_is_told_for_solvers_that_take_it_there():
    terms = _driven(_constant, _quench)
    for solver in (ds.SRKw4(), ds.SRKs4(), ds.PlateauVerlet()):
        name = type(solver).__name__
        assert f"noise jumps at step ends, such as t=1, and `{name}`" in _at_ends(
            terms, solver
        )
    for solver in (ds.ImplicitMidpoint(), ds.StormerVerlet()):
        assert _at_ends(terms, solver) is None


def test_single_precision_tells_of_jumps_and_not_of_smooth_forces():
    t0 = 100.0
    y0 = jnp.zeros((), jnp.float32), jnp.full((), 2.0, jnp.float32)

    def is_told(stiffness):
        noise = jax.ShapeDtypeStruct((), jnp.float32)
        terms = _bath(_trap(stiffness), noise=noise)
        problem = problem_of(terms, BAOAB, 0.25, y0, t0=t0)
        return (jumps_within_steps(problem) or jumps_at_step_ends(problem)) is not None

    assert is_told(lambda t: _quench(t, t0 + 1))
    assert not is_told(lambda t: 1 + jnp.tanh(20 * (t - t0 - 0.9)) / 2)


def _late_quench(t):
    return _quench(t, WITHIN)


def _pushed(t, p, q, args):
    return (p**2 + q**2) / 2 - (30 * jnp.sin(2 * t) + _late_quench(t)) * q


WITHIN_A_STEP = {
    "stiffness": (_bath(_trap(_late_quench)), ds.ImplicitMidpoint()),
    "temperature": (
        _bath(_trap(_constant), lambda t, q, args: _late_quench(t)),
        ds.BAOAB(ds.ImplicitMidpoint()),
    ),
    "forces": (_driven(_late_quench, _constant), diffrax.Heun()),
    "noise": (_driven(_constant, _late_quench), ds.StormerVerlet()),
    "beside a large smooth drive": (_bath(_pushed), BAOAB),
}


@pytest.mark.parametrize("terms, solver", WITHIN_A_STEP.values(), ids=WITHIN_A_STEP)
def test_a_jump_within_a_step_is_told_with_its_time_for_any_solver(terms, solver):
    assert "jump within a step, such as at t=1.03." in _within(terms, solver)


def test_jumps_at_a_random_time_of_each_path_are_not_told_and_others_are():
    drawn = lambda key: jr.uniform(key, (), minval=0.5, maxval=2.0)

    def at_one_time(t, p, q, size):
        return p**2 / 2 + (1 + size * (t > WITHIN)) * q**2 / 2

    def at_random_times(t, p, q, time):
        return p**2 / 2 + _quench(t, time) * q**2 / 2

    assert _within(_bath(at_one_time), args=drawn) is not None
    assert _within(_bath(at_random_times), args=drawn) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "stiffness, is_right",
    [(_quench, False), (_quench_by_mean, True)],
    ids=["one side", "the mean of both sides"],
)
def test_two_levels_agree_on_a_wrong_mean_unless_the_cure_is_taken(stiffness, is_right):
    square = lambda t, y, args: y[1] ** 2
    given = square, _bath(_trap(stiffness)), BAOAB, 0, 2, 0.125, DISPLACED
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sampling = ds.ValueFunctions(degree=2, num_paths=64)
        got = ds.expectation(*given, key=jr.key(0), sampling=sampling)
    # By the equations of the moments before and after time 1.
    assert (abs(got.mean - 0.7037) < got.error) == is_right


WIDTHS = 0.03, 0.01, 1e-3


def _tenfold(t):
    return jnp.cos(2 * jnp.pi * 10 * t)


def _pulse(width):
    return lambda t: jnp.exp(-(((t - 10.06) / width) ** 2) / 2) / width


UNRESOLVED = {
    "its period divides all steps": _tenfold,
    "beside a slow one": lambda t: jnp.cos(t) + 0.1 * _tenfold(t),
} | {f"a pulse of {width} between stages": _pulse(width) for width in WIDTHS}
RESOLVED = {
    "constant": lambda t: 1.0 + 0 * t,
    "a third of a period in a step": lambda t: jnp.cos(2 * jnp.pi / 3 * t / 0.2),
    "a ramp": lambda t: t,
    "a pulse over many steps": lambda t: jnp.exp(-(((t - 10) / 2) ** 2)),
    "a quench at a step end": lambda t: jnp.where(t < 10, 0.0, 1.0),
    "a quench with a mean": lambda t: (
        jnp.where(t < 10 - 1e-9, 0.0, 0.5) + jnp.where(t < 10 + 1e-9, 0.0, 0.5)
    ),
    "a fast ripple that is too small": lambda t: 1 + 1e-6 * _tenfold(t),
}


def _message(terms, args=None, levels=2):
    """For steps of 0.4, and fractions of it."""
    solver = ds.BAOAB(ds.ImplicitMidpoint())
    problem = problem_of(terms, solver, 0.4, REST, args, num_steps=50, levels=levels)
    return unresolved_drive(problem)


def test_only_fast_drives_are_told():
    """One program for all of them, in which a number selects the force."""
    forces = UNRESOLVED | RESOLVED

    def energy(t, p, q, number):
        return (p**2 + q**2) / 2 - jax.lax.switch(number, [*forces.values()], t) * q

    terms = ds.langevin_terms(energy, 0.5, 0.1, ())
    for number, name in enumerate(forces):
        told = _message(terms, jnp.array(number)) is not None
        assert told == (name in UNRESOLVED), name


@pytest.mark.parametrize("levels, shortest", [(2, "0.2"), (3, "0.1")])
def test_noise_that_changes_fast_is_told_with_the_shortest_steps(levels, shortest):
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: (1 + _tenfold(t)) * q
    terms = ds.hamiltonian_terms(energy, noise, ())
    message = _message(terms, levels=levels)
    assert f"steps of {shortest}, the shortest" in message


def test_flips_at_random_times_are_not_told():
    def flips(key):
        return jr.uniform(key, (8,), minval=0.0, maxval=20.0)

    def energy(t, p, q, times):
        sign = jnp.prod(jnp.where(t < times, 1.0, -1.0))
        return (p**2 + q**2) / 2 - sign * q

    assert _message(ds.langevin_terms(energy, 0.5, 0.1, ()), flips) is None
