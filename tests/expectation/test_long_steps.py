"""Steps that are too long are told where two levels agree on a wrong mean."""

import re

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.long_steps import too_long_steps, unresolved_noise
from diffrax_symplectic._simulation import Problem

from .messages import messages


Y0 = jnp.array(0.0), jnp.array(1.0)
FEW = ds.IndependentPaths(2000)


def _pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


def _cosine(t, y, args):
    return jnp.cos(y[1])


def _is_told(terms, solver, h, y0=Y0, phi=_cosine, levels=2):
    """Whether a warning says that steps are too long."""
    told = messages(phi, terms, solver, 0, 15 * h, h, y0, levels=levels)
    return any("too long for" in message for message in told)


def test_bounded_forces_hide_steps_that_are_too_long_from_two_levels():
    terms = ds.langevin_terms(_pendulum, 0.5, 1.0, ())
    given = _cosine, terms, ds.BAOAB(), 0, 120, 8.0, Y0
    with pytest.warns(UserWarning, match="too long for `BAOAB`") as told:
        got = ds.expectation(*given, key=jr.key(1), sampling=FEW)
    # By Bessel functions.
    assert abs(got.mean - 0.44639) > 10 * got.error
    assert {x.filename for x in told if "too long" in str(x.message)} == {__file__}


OSCILLATOR = ds.hamiltonian_terms(
    lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2,
    lambda t, p, q, args: jnp.sin(q[0]) / 5,
    (),
)
Y1 = jnp.zeros(1), jnp.ones(1)


def test_unstable_steps_are_told_with_three_levels_too():
    """They may fit the order by chance."""
    terms = ds.langevin_terms(_pendulum, 0.5, 1.0, ())
    assert _is_told(terms, ds.BAOAB(), 8.0, levels=3)


@pytest.mark.parametrize("h, too_long", [(0.1, False), (1.99, False), (2.02, True)])
@pytest.mark.parametrize("size", [1, 100])
def test_the_limit_of_stability_is_told(h, too_long, size):
    y0 = jnp.zeros(size), jnp.ones(size)
    phi = lambda t, y, args: jnp.cos(y[1][0])
    assert _is_told(OSCILLATOR, ds.StormerVerlet(), h, y0, phi) is too_long


def test_one_level_promises_nothing_of_the_step_as_for_a_map():
    phi = lambda t, y, args: jnp.cos(y[1][0])
    assert not _is_told(OSCILLATOR, ds.StormerVerlet(), 2.02, Y1, phi, levels=1)


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
    assert _is_told(OSCILLATOR, _Kicks(), h, Y1, phi) is too_long


def test_steps_that_resolve_a_barrier_or_are_implicit_are_not_told():
    barrier = ds.langevin_terms(
        lambda t, p, q, args: p**2 / 2 + (q**2 - 1) ** 2 / 4, 5.0, 1.0, ()
    )
    top = jnp.array(0.0), jnp.array(0.0)
    assert not _is_told(barrier, ds.BAOAB(), 1.0, top)
    terms = ds.hamiltonian_terms(_pendulum, lambda t, p, q, args: jnp.sin(q) / 5, ())
    assert not _is_told(terms, ds.ImplicitMidpoint(), 4.0)
    # Strong friction turns momenta around, and does not enlarge them.
    rough = ds.langevin_terms(_pendulum, 50.0, 1.0, ())
    assert not _is_told(rough, ds.BAOAB(), 1.0)


def _pulse(t, center, strength):
    return strength * jnp.exp(-((t - center) ** 2))


def _coupled_by_pulses(t, psi, strength):
    """Three levels, none of which is coupled to another at the start."""
    c = jnp.conj(psi)
    first = _pulse(t, 3.5, strength) * c[0] * psi[1]
    second = _pulse(t, 2.5, strength) * c[1] * psi[2]
    return jnp.real(first + second)


def _exact_population(strength, num_steps=3000):
    """Of the third level at time 6, by exact steps of the matrix at their midpoints."""
    h = 6 / num_steps
    psi = np.array([1.0, 0.0, 0.0], complex)
    for step in range(num_steps):
        t = (step + 0.5) * h
        matrix = np.zeros((3, 3))
        matrix[0, 1] = matrix[1, 0] = strength * np.exp(-((t - 3.5) ** 2)) / 2
        matrix[1, 2] = matrix[2, 1] = strength * np.exp(-((t - 2.5) ** 2)) / 2
        values, vectors = np.linalg.eigh(matrix)
        psi = vectors @ (np.exp(-1j * h * values) * (vectors.T @ psi))
    return abs(psi[2]) ** 2


def test_pulses_that_two_levels_do_not_resolve_are_told_with_their_time():
    # The noise is too weak to matter, so that all of the error is of the steps.
    noise = lambda t, psi, strength: 1e-6 * jnp.real(psi[2] * jnp.conj(psi[2]))
    terms = ds.wave_terms(_coupled_by_pulses, noise, ())
    population = lambda t, y, strength: jnp.sum(jnp.stack(y)[:, 2] ** 2) / 2
    y0 = ds.to_pair(jnp.array([1.0, 0.0, 0.0]) + 0j)
    given = population, terms, ds.StrangGauss(), 0, 6, 0.1, y0, jnp.array(60.0)
    few = ds.IndependentPaths(8)
    with pytest.warns(
        UserWarning, match=r"too long .* t = 3.*: omega h = 3.3 "
    ) as told:
        got = ds.expectation(*given, key=jr.key(1), sampling=few)
    assert abs(got.mean - _exact_population(60.0)) > 10 * got.error
    assert {x.filename for x in told if "too long" in str(x.message)} == {__file__}


def _fault(terms, solver, h, y0, args=None, num_steps=100):
    """What `expectation` says of long steps, without its samples."""
    phi = lambda t, y, args: jnp.sum(y[1])
    t1 = num_steps * h
    problem = Problem.of(phi, terms, solver, 0.0, t1, h, y0, args, None, levels=2)
    return too_long_steps(problem, h)


MASSES = jnp.array([2.0, 0.5, 4.0])
STIFFNESS = jnp.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
THREE = jnp.zeros(3), jnp.ones(3)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_strang_gauss_is_told_beyond_the_frequency_of_its_record(scale):
    # In any unit of time.
    def bonds(t, p, q, args):
        return jnp.sum(p**2 / MASSES) / 2 + q @ STIFFNESS @ q / (2 * scale**2)

    noise = lambda t, p, q, args: q[0] / scale**2
    terms = ds.hamiltonian_terms(bonds, noise, ())
    frequency = np.sqrt(np.max(np.linalg.eigvals(STIFFNESS / MASSES[:, None]).real))
    most = ds.StrangGauss().record.most_frequency
    for factor, too_long in ((0.5, False), (0.95, False), (1.05, True)):
        h = factor * most / frequency * scale
        message = _fault(terms, ds.StrangGauss(), h, THREE)
        assert (message is not None) == too_long
    assert f"omega h = {factor * most:.3g} for" in message
    # The midpoint rule has honest bars, as three levels do.
    assert _fault(terms, ds.ImplicitMidpoint(), h, THREE) is None


def test_what_does_not_oscillate_is_not_told_of_frequencies():
    solver = ds.StrangGauss()
    noise = lambda t, p, q, args: q[0]
    free = ds.hamiltonian_terms(lambda t, p, q, args: jnp.sum(p**2) / 2, noise, ())
    still = ds.hamiltonian_terms(lambda t, p, q, args: 0.0, noise, ())
    barrier = ds.hamiltonian_terms(
        lambda t, p, q, args: jnp.sum(p**2 - q**2) / 2, noise, ()
    )
    rough = ds.langevin_terms(
        lambda t, p, q, args: jnp.sum(p**2 + q**2 / 100) / 2, 50.0, 1.0, (3,)
    )
    for terms in (free, still, barrier, rough):
        assert _fault(terms, solver, 5.0, THREE) is None


@pytest.mark.parametrize("solver", [ds.StrangGauss(), ds.StormerVerlet()])
def test_a_ramp_is_told_where_it_ends_up_too_stiff(solver):
    def ramped(t, p, q, args):
        return jnp.sum(p**2) / 2 + (1 + args * t) * (1 - jnp.cos(q[0]))

    terms = ds.hamiltonian_terms(ramped, lambda t, p, q, args: q[0] / 5, ())
    # 100 steps of 0.1, to frequencies of 5 and 33.
    y0 = jnp.zeros(1), jnp.zeros(1)
    assert _fault(terms, solver, 0.1, y0, args=jnp.array(2.4)) is None
    assert "too long" in _fault(terms, solver, 0.1, y0, args=jnp.array(110.0))


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
    # There omega h = 1 at the start.
    assert "pass `dt0=0.02` or less" in message


def test_the_step_that_is_named_for_a_run_that_fails_is_stable():
    terms = ds.hamiltonian_terms(_stiff, lambda t, p, q, args: q / 5, ())
    given = _cosine, terms, ds.StormerVerlet(), 0, 1.2, 0.02, Y0
    assert ds.expectation(*given, key=jr.key(1), sampling=FEW).num_failed == 0


def test_a_hamiltonian_that_is_not_finite_is_not_blamed_on_the_step():
    singular = lambda t, p, q, args: p**2 / 2 + jnp.sqrt(q - 2)
    assert "Most likely" not in _failures(singular, ds.StormerVerlet(), 0.5)


def _meeting(t, p, q, args):
    """Two vortices, whose velocities grow without limit where they meet."""
    squared_distance = (p[0] - p[1]) ** 2 + (q[0] - q[1]) ** 2
    return -2 * jnp.log(squared_distance)


def test_implicit_steps_without_a_solution_are_named_where_paths_fail():
    apart = jnp.zeros(2), jnp.array([0.5, -0.5])
    scattered = lambda t, p, q, args: 0.8 * jnp.concatenate([p, -q])
    phi = lambda t, y, args: y[1][0]
    terms = ds.hamiltonian_terms(_meeting, scattered, (4,))
    given = phi, terms, ds.ImplicitMidpoint(), 0, 2, 0.2, apart
    with pytest.warns(UserWarning, match="paths failed") as told:
        ds.expectation(*given, key=jr.key(1), sampling=ds.IndependentPaths(200))
    (message,) = [str(x.message) for x in told if "paths failed" in str(x.message)]
    assert "an implicit step may have no solution" in message
    assert "pass a smaller `dt0`, or an explicit solver" in message
    assert "root_finder=PicardNewton" in message
    assert "implicit step" not in _failures(_stiff, ds.StormerVerlet(), 0.5)


def _hops(t, psi, args):
    return 2 * jnp.sum(jnp.real(jnp.conj(psi[:-1]) * psi[1:]))


def _sites(t, psi, args):
    return jnp.sqrt(args) * jnp.real(psi * jnp.conj(psi))


def test_noise_that_steps_do_not_resolve_is_told():
    # The mean square of the site of an exciton that starts at one end of three sites with
    # white noise. The exact value is that of the Lindblad equation with the rate 10.
    terms = ds.wave_terms(_hops, _sites, (3,))
    y0 = ds.to_pair(jnp.eye(3)[0] + 0j)

    def squared_site(t, y, args):
        psi = ds.from_pair(y)
        return jnp.arange(3.0) ** 2 @ jnp.real(psi * jnp.conj(psi))

    text = "do not resolve the noise.* by 3.16 in a step"
    given = squared_site, terms, ds.ImplicitMidpoint(), 0, 4, 1.0, y0, 10.0
    sampling = ds.IndependentPaths(16_384)
    with pytest.warns(UserWarning, match=text):
        estimate = ds.expectation(*given, key=jr.key(0), sampling=sampling)
    assert abs(estimate.mean - 0.793187) > 3 * estimate.error
    told = messages(squared_site, terms, ds.StrangGauss(), 0, 4, 1.0, y0, 10.0)
    assert re.search(text, " ".join(told))


def _noise_told(terms, y0, h, args=None):
    """What is said of the noise, by the midpoint rule in steps of `h`."""
    phi = lambda t, y, args: jnp.sum(y[1])
    problem = Problem.of(
        phi, terms, ds.ImplicitMidpoint(), 0, 4 * h, h, y0, args, None, 2
    )
    return unresolved_noise(problem, h)


@pytest.mark.parametrize("rate, told", [(2.0, False), (3.0, True)])
def test_the_limit_of_noise_is_an_angle_of_one_step(rate, told):
    # Each of the noises turns its own site: their number does not matter.
    for sites in (1, 3, 40):
        terms = ds.wave_terms(_hops, _sites, (sites,))
        y0 = ds.to_pair(jnp.ones(sites) + 0j)
        for h in (1.0, 1e-3):
            assert (_noise_told(terms, y0, h, rate / h) is not None) is told


def test_noise_that_turns_nothing_is_always_resolved():
    one = jnp.zeros(1), jnp.ones(1)
    oscillator = lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2
    forces = lambda t, p, q, args: -100.0 * jnp.sum(q)
    springs = lambda t, p, q, args: 100.0 * jnp.sum(q**2)
    for noise in (forces, springs):
        assert (
            _noise_told(ds.hamiltonian_terms(oscillator, noise, ()), one, 1.0) is None
        )
    bath = ds.langevin_terms(oscillator, 100.0, 10.0, (1,))
    assert _noise_told(bath, one, 1.0) is None


OMEGA = 200.0
LOSS = 0.04


def _fast_energy(t, p, q, args):
    return args * (p**2 + q**2) / 2


def _with_loss(t, y, args):
    """The drift of the same oscillator with its loss written into it."""
    p, q = y
    return -args * q - LOSS * p, args * p


def _energy(t, y, args):
    p, q = y
    return (p**2 + q**2) / 2


def _call(terms, solver, scale=1.0):
    """The arguments for the mean energy after 100 steps from an energy of 12.5. In units of
    energy in which the temperature is one."""
    y0 = jnp.array(0.0), jnp.array(5.0)
    return _energy, terms, solver, 0, 100 * scale, scale, y0, OMEGA / scale


def _is_told_of_decay(*given, levels=2):
    told = messages(*given, levels=levels)
    return any("relaxes far too slowly" in message for message in told)


# By the matrix exponential of the drift, to all of these digits.
RIGHT_ENERGY = 1.2106
BATH = ds.langevin_terms(_fast_energy, LOSS / OMEGA, OMEGA, ())


@pytest.mark.parametrize("levels", [2, 3])
def test_implicit_steps_that_keep_what_decays_are_told(levels):
    assert _is_told_of_decay(*_call(BATH, ds.ImplicitMidpoint()), levels=levels)


def test_a_loss_written_into_the_drift_is_told():
    noise = lambda t, p, q, args: -((2 * LOSS) ** 0.5) * q
    kick = ds.noise_terms(noise, ())
    terms = diffrax.MultiTerm(diffrax.ODETerm(_with_loss), kick)
    given = _call(terms, ds.ImplicitMidpoint())
    with pytest.warns(UserWarning, match="relaxes far too slowly"):
        got = ds.expectation(*given, key=jr.key(3), sampling=FEW)
    assert got.mean > 10 * RIGHT_ENERGY


@pytest.mark.parametrize("scale", [1e-9, 1e6])
def test_decay_of_a_fast_mode_is_told_in_every_unit_of_time(scale):
    assert _is_told_of_decay(*_call(BATH, ds.ImplicitMidpoint(), scale))


@pytest.mark.slow
def test_friction_that_a_splitting_solves_apart_is_right_and_not_told():
    given = _call(BATH, ds.BAOAB(ds.ImplicitMidpoint()))
    sampling = ds.IndependentPaths(500)
    got = ds.expectation(*given, key=jr.key(3), sampling=sampling)
    assert abs(got.mean - RIGHT_ENERGY) < 4 * got.error
    assert not _is_told_of_decay(*given)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_rounding_and_a_turning_saddle_are_no_decay(dtype):
    def turning_saddle(t, p, q, args):
        # The rates of its modes are (+-1 +- 3 i) args: what decays also grows.
        return args * (p @ q + 3 * p[0] * q[1] - 3 * p[1] * q[0])

    kick = lambda t, p, q, args: q[0] / 100
    fast_pair = lambda t, p, q, args: args * (p @ p + q @ q) / 2 + q[0] * q[1]
    y0 = jnp.zeros(2, dtype), jnp.ones(2, dtype)
    for H0 in (turning_saddle, fast_pair):
        terms = ds.hamiltonian_terms(H0, kick, ())
        problem = Problem.of(
            lambda t, y, args: y[1][0],
            terms,
            ds.ImplicitMidpoint(),
            0,
            1e4,
            1.0,
            y0,
            OMEGA,
            None,
            2,
        )
        assert too_long_steps(problem, 1.0) is None
