"""Steps are told that are too long for the forces, the noise or the friction, where two
levels agree on a wrong mean."""

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.long_steps import too_long_steps, unresolved_noise
from diffrax_symplectic._expectation.out_of_range import is_finite_at_start
from diffrax_symplectic._expectation.strong_friction import unresolved_friction

from ..problems import as_friction
from .steps import Kicks, problem_of


Y0 = jnp.array(0.0), jnp.array(1.0)


def _fault(terms, solver, h, y0, args=None, **options):
    """What `expectation` says of long steps."""
    return too_long_steps(problem_of(terms, solver, h, y0, args, **options), h)


def _is_told(*given, **options):
    return _fault(*given, **options) is not None


def _well(t, p, q, args):
    return jnp.sum(p**2 + q**2) / 2


def _pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


OSCILLATOR = ds.hamiltonian_terms(_well, lambda t, p, q, args: jnp.sin(q[0]) / 5, ())


def test_the_limit_of_stability_is_told():
    y0 = jnp.zeros(100), jnp.ones(100)
    for h in (1.99, 2.02):
        # With three levels, too: unstable steps may fit the order by chance.
        for levels in (2, 3):
            told = _is_told(OSCILLATOR, ds.StormerVerlet(), h, y0, levels=levels)
            assert told == (h > 2)
    terms = ds.langevin_terms(_pendulum, 0.5, 1.0, ())
    assert "too long for `BAOAB`" in _fault(terms, ds.BAOAB(), 8.0, Y0)


def test_a_solver_of_ones_own_keeps_its_noise():
    for h in (1.9, 2.1):
        assert _is_told(OSCILLATOR, Kicks(), h, (jnp.zeros(1), jnp.ones(1))) == (h > 2)


def test_steps_that_resolve_a_barrier_or_are_implicit_are_not_told():
    barrier = ds.langevin_terms(
        lambda t, p, q, args: p**2 / 2 + (q**2 - 1) ** 2 / 4, 5.0, 1.0, ()
    )
    top = jnp.array(0.0), jnp.array(0.0)
    assert not _is_told(barrier, ds.BAOAB(), 1.0, top)
    terms = ds.hamiltonian_terms(_pendulum, lambda t, p, q, args: jnp.sin(q) / 5, ())
    assert not _is_told(terms, ds.ImplicitMidpoint(), 4.0, Y0)
    # Strong friction turns momenta around, and does not enlarge them.
    rough = ds.langevin_terms(_pendulum, 50.0, 1.0, ())
    assert not _is_told(rough, ds.BAOAB(), 1.0, Y0)


def _coupled_by_pulses(t, psi, strength):
    """Three levels, none of which is coupled to another at the start."""
    c = jnp.conj(psi)
    first = strength * jnp.exp(-((t - 3.5) ** 2)) * c[0] * psi[1]
    second = strength * jnp.exp(-((t - 2.5) ** 2)) * c[1] * psi[2]
    return jnp.real(first + second)


def test_pulses_that_two_levels_do_not_resolve_are_told_with_their_time():
    noise = lambda t, psi, strength: 1e-6 * jnp.real(psi[2] * jnp.conj(psi[2]))
    terms = ds.wave_terms(_coupled_by_pulses, noise, ())
    y0 = ds.to_pair(jnp.array([1.0, 0.0, 0.0]) + 0j)
    strength = jnp.array(60.0)
    message = _fault(terms, ds.StrangGauss(), 0.1, y0, strength, num_steps=60)
    assert "t = 3" in message
    assert "omega h = 3.3 " in message


MASSES = jnp.array([2.0, 0.5, 4.0])
STIFFNESS = jnp.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
THREE = jnp.zeros(3), jnp.ones(3)
SCALES = 1.0, 1e-6, 1e6


def _in_unit_of_time(t, p, q, args):
    """The kinetic energy and that of springs; `args` starts with a unit of time."""
    return jnp.sum(p**2 / MASSES) / 2 + q @ STIFFNESS @ q / (2 * args[0] ** 2)


def test_strang_gauss_is_told_beyond_the_frequency_of_its_record_in_any_unit_of_time():
    noise = lambda t, p, q, args: q[0] / args[0] ** 2
    terms = ds.hamiltonian_terms(_in_unit_of_time, noise, ())
    frequency = np.sqrt(np.max(np.linalg.eigvals(STIFFNESS / MASSES[:, None]).real))
    most = ds.StrangGauss().record.most_frequency
    for scale in SCALES:
        for factor in (0.5, 0.95, 1.05):
            h = factor * most / frequency * scale
            args = (jnp.array(scale),)
            message = _fault(terms, ds.StrangGauss(), h, THREE, args)
            assert (message is not None) == (factor > 1)
        assert f"omega h = {factor * most:.3g} for" in message
        # The midpoint rule has honest bars, as three levels do.
        assert not _is_told(terms, ds.ImplicitMidpoint(), h, THREE, args)


def test_what_does_not_oscillate_is_not_told_of_frequencies():
    noise = lambda t, p, q, args: q[0]
    free = lambda t, p, q, args: jnp.sum(p**2) / 2
    still = lambda t, p, q, args: 0.0
    barrier = lambda t, p, q, args: jnp.sum(p**2 - q**2) / 2
    loose = lambda t, p, q, args: jnp.sum(p**2 + q**2 / 100) / 2
    rough = ds.langevin_terms(loose, 50.0, 1.0, (3,))
    others = [ds.hamiltonian_terms(H0, noise, ()) for H0 in (free, still, barrier)]
    for terms in (rough, *others):
        assert not _is_told(terms, ds.StrangGauss(), 5.0, THREE)


@pytest.mark.parametrize("solver", [ds.StrangGauss(), ds.StormerVerlet()], ids=repr)
def test_a_ramp_is_told_where_it_ends_up_too_stiff(solver):
    def ramped(t, p, q, args):
        return jnp.sum(p**2) / 2 + (1 + args * t) * (1 - jnp.cos(q[0]))

    terms = ds.hamiltonian_terms(ramped, lambda t, p, q, args: q[0] / 5, ())
    # 100 steps of 0.1, to frequencies of 5 and 33.
    given = terms, solver, 0.1, (jnp.zeros(1), jnp.zeros(1))
    assert not _is_told(*given, jnp.array(2.4), num_steps=100)
    assert "too long" in _fault(*given, jnp.array(110.0), num_steps=100)


def test_a_periodic_drift_is_seen_whatever_its_period():
    def pulsed(t, p, q, args):
        within = (t / args) % 1
        return jnp.sum(p**2) / 2 + jnp.where(within > 0.8, 400.0, 0.0) * q @ q / 2

    terms = ds.hamiltonian_terms(pulsed, lambda t, p, q, args: q[0], ())
    y0 = jnp.zeros(1), jnp.zeros(1)
    for num_periods in (1, 8, 16, 32, 64, 100):
        period = jnp.array(1000 * 0.1 / num_periods)
        message = _fault(terms, ds.StrangGauss(), 0.1, y0, period, num_steps=1000)
        assert "omega h = 2 " in message


def test_a_run_in_which_all_paths_fail_names_the_step():
    H0 = lambda t, p, q, args: p**2 / 2 + 200 * q**4
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: q / 5, ())
    phi = lambda t, y, args: jnp.cos(y[1])
    given = phi, terms, ds.StormerVerlet(), 0, 30, 0.5, Y0
    options = dict(key=jr.key(1), sampling=ds.IndependentPaths(100), levels=1)
    with pytest.warns(UserWarning, match="paths failed") as told:
        ds.expectation(*given, **options)
    (message,) = [str(x.message) for x in told if "paths failed" in str(x.message)]
    assert "Most likely, steps of `dt0=0.5` are too long for `StormerVerlet`" in message
    # There omega h = 1 at the start.
    assert "pass `dt0=0.02` or less" in message
    assert "an implicit step may have no solution" not in message


def test_a_hamiltonian_that_is_not_finite_is_not_blamed_on_the_step():
    singular = lambda t, p, q, args: p**2 / 2 + jnp.sqrt(q - 2)
    terms = ds.hamiltonian_terms(singular, lambda t, p, q, args: q / 5, ())
    assert not is_finite_at_start(problem_of(terms, ds.StormerVerlet(), 0.5, Y0))


def _noise_fault(terms, y0, h, args=None, solver=None):
    solver = ds.ImplicitMidpoint() if solver is None else solver
    return unresolved_noise(problem_of(terms, solver, h, y0, args), h)


def test_the_limit_of_noise_is_an_angle_of_one_step():
    # Each of the noises turns its own site: their number does not matter.
    hops = lambda t, psi, args: 2 * jnp.sum(jnp.real(jnp.conj(psi[:-1]) * psi[1:]))
    noises = lambda t, psi, rate: jnp.sqrt(rate) * jnp.real(psi * jnp.conj(psi))
    for sites in (1, 40):
        terms = ds.wave_terms(hops, noises, (sites,))
        y0 = ds.to_pair(jnp.ones(sites) + 0j)
        for rate in (2.0, 10.0):
            for h in (1.0, 1e-3):
                message = _noise_fault(terms, y0, h, rate / h)
                assert (message is not None) == (rate > 3)
        assert "do not resolve the noise" in message
        assert "by 3.16 in a step" in message
    assert _noise_fault(terms, y0, 1.0, 10.0, ds.StrangGauss()) is not None


def test_noise_that_turns_nothing_is_always_resolved():
    one = jnp.zeros(1), jnp.ones(1)
    forces = lambda t, p, q, args: -100.0 * jnp.sum(q)
    springs = lambda t, p, q, args: 100.0 * jnp.sum(q**2)
    bath = ds.langevin_terms(_well, 100.0, 10.0, (1,))
    others = [ds.hamiltonian_terms(_well, noise, ()) for noise in (forces, springs)]
    for terms in (bath, *others):
        assert _noise_fault(terms, one, 1.0) is None


FREQUENCY = 200.0


def test_implicit_steps_that_keep_what_decays_are_told_in_every_unit_of_time():
    well, loss = lambda t, p, q, args: args * (p**2 + q**2) / 2, 0.04
    bath = ds.langevin_terms(well, loss / FREQUENCY, FREQUENCY, ())
    # The drift of the same oscillator with its loss written into it.
    drift = lambda t, y, args: (-args * y[1] - loss * y[0], args * y[0])
    kick = ds.noise_terms(lambda t, p, q, args: -((2 * loss) ** 0.5) * q, ())
    written = diffrax.MultiTerm(diffrax.ODETerm(drift), kick)
    y0 = jnp.array(0.0), jnp.array(5.0)
    slowly = "relaxes far too slowly"
    midpoint = ds.ImplicitMidpoint()
    assert slowly in _fault(written, midpoint, 1.0, y0, FREQUENCY, num_steps=100)
    for levels in (2, 3):
        for scale in (1.0, 1e-9, 1e6):
            given = bath, midpoint, scale, y0, FREQUENCY / scale
            assert slowly in _fault(*given, num_steps=100, levels=levels)
    # A splitting solves the friction apart.
    splitting = ds.BAOAB(midpoint)
    assert not _is_told(bath, splitting, 1.0, y0, FREQUENCY, num_steps=100)


def test_rounding_and_a_turning_saddle_are_no_decay():
    def turning_saddle(t, p, q, args):
        # The rates of its modes are (+-1 +- 3 i) args: what decays also grows.
        return args * (p @ q + 3 * p[0] * q[1] - 3 * p[1] * q[0])

    kick = lambda t, p, q, args: q[0] / 100
    fast_pair = lambda t, p, q, args: args * (p @ p + q @ q) / 2 + q[0] * q[1]
    y0 = jnp.zeros(2, jnp.float32), jnp.ones(2, jnp.float32)
    for H0 in (turning_saddle, fast_pair):
        terms = ds.hamiltonian_terms(H0, kick, ())
        given = terms, ds.ImplicitMidpoint(), 1.0, y0, FREQUENCY
        assert not _is_told(*given, num_steps=10_000)


PLANE = jnp.zeros(2), jnp.zeros(2)
# The largest products of step and decay rate.
LIMITS = (ds.AdditiveGauss(), 2.0), (ds.SRKw5(), 0.5)
BAOAB = ds.BAOAB()
IMPLICIT_BAOAB = ds.BAOAB(ds.ImplicitMidpoint())


def _is_told_of_friction(terms, solver, h, y0, args=None):
    return unresolved_friction(problem_of(terms, solver, h, y0, args), h) is not None


def test_solvers_with_friction_in_the_drift_are_told_beyond_their_limit():
    # The largest decay rate is 0.8 / 0.5 for the friction 0.8.
    friction = lambda t, q, args: 0.8 / args[0]
    terms = ds.langevin_terms(_in_unit_of_time, friction, 1.0, (3,))
    for solver, most in LIMITS:
        for scale in SCALES:
            for factor in (0.9, 1.1):
                h = factor * most * 0.5 / 0.8 * scale
                given = terms, solver, h, THREE, (jnp.array(scale),)
                assert _is_told_of_friction(*given) == (factor > 1)
    # Others are for every friction.
    terms = ds.langevin_terms(_in_unit_of_time, 100.0, 1.0, (3,))
    for solver in (BAOAB, ds.LangevinMiddle(), ds.ImplicitMidpoint(), ds.SRKw1()):
        given = terms, solver, 0.2, THREE, (jnp.array(1.0),)
        assert not _is_told_of_friction(*given)


def test_a_flow_that_keeps_overdamped_positions_where_they_are_is_told():
    # The relaxation time is 1.
    H0 = lambda t, p, q, args: p**2 / 2 + 1e4 * q**2 / 2
    terms = ds.langevin_terms(H0, 1e4, 1.0, ())
    assert _is_told_of_friction(terms, IMPLICIT_BAOAB, 0.5, Y0)
    # Plain midpoint steps relax, and steps that resolve the vibration do.
    assert not _is_told_of_friction(terms, ds.ImplicitMidpoint(), 0.5, Y0)
    assert not _is_told_of_friction(terms, IMPLICIT_BAOAB, 0.015, Y0)
    # With weak friction, stiff modes keep their law.
    terms = ds.langevin_terms(H0, 1.0, 1.0, ())
    assert not _is_told_of_friction(terms, IMPLICIT_BAOAB, 0.5, Y0)


def test_friction_that_depends_on_positions_masses_and_args_is_that_of_the_start():
    H0 = lambda t, p, q, args: (p**2 * jnp.exp(-q) + q**2) / 2
    friction = lambda t, q, args: args * jnp.exp(q)  # a rate
    terms = ds.langevin_terms(H0, friction, 1.0, ())
    for position in (0.0, 2.0):
        start = jnp.array(0.0), jnp.array(position)
        for rate in (4.0, 6.0):  # h = 0.1 and the limit 0.5
            given = terms, ds.StrangGauss(), 0.1, start, jnp.array(rate)
            assert _is_told_of_friction(*given) == (rate > 5)


def _free_in_unit_of_time(t, p, q, args):
    """From rest the bath alone moves positions, by about 1 in a unit of time."""
    return jnp.sum(p**2) / (2 * args[0] ** 2)


def _turning(t, q, args):
    """Friction 10 times as strong along one axis, which turns with the position."""
    scale, strong, turns = args
    c, s = jnp.cos(turns * q[0]), jnp.sin(turns * q[0])
    turn = jnp.array([[c, -s], [s, c]])
    return as_friction(strong * scale * turn @ jnp.diag(jnp.array([1.0, 0.1])) @ turn.T)


def test_friction_that_turns_far_in_a_step_is_told_in_any_unit_of_time():
    terms = ds.langevin_terms(_free_in_unit_of_time, _turning, 1.0, (2,))

    def is_told(strong, turns, h, scale=1.0):
        args = jnp.array(scale), jnp.array(strong), jnp.array(turns)
        return _is_told_of_friction(terms, BAOAB, h * scale, PLANE, args)

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
        assert _is_told_of_friction(terms, BAOAB, 1.0, PLANE, args) == (change > 1)
    # Masses change, and the friction does not.
    heavier = lambda t, p, q, args: jnp.sum(p**2 * jnp.exp(-3 * q)) / 2
    terms = ds.langevin_terms(heavier, 5.0, 1.0, (2,))
    assert not _is_told_of_friction(terms, IMPLICIT_BAOAB, 0.2, PLANE)


def _is_told_of_decay(matrix, h, solver):
    """Whether a warning tells of the decay by a linear drift with this matrix."""
    drift = diffrax.ODETerm(lambda t, y, args: tuple(args @ jnp.stack(y)))
    kick = ds.noise_terms(lambda t, p, q, args: 0.1 * q, ())
    y0 = jnp.array(1.0), jnp.array(0.5)
    terms = diffrax.MultiTerm(drift, kick)
    return _is_told_of_friction(terms, solver, h, y0, jnp.asarray(matrix))


def test_a_loss_that_is_a_term_of_its_own_is_told_beyond_the_same_limit():
    for solver, most in LIMITS:
        for scale in SCALES:
            for matrix in ([[-1.0, 0.0], [0.0, -1.0]], [[-1.0, -0.1], [0.1, -1.0]]):
                rates = np.array(matrix) / scale
                assert not _is_told_of_decay(rates, 0.9 * most * scale, solver)
                assert _is_told_of_decay(rates, 1.1 * most * scale, solver)


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
        assert not _is_told_of_decay(matrix, 3 / frequency, ds.AdditiveGauss()), name
