"""Whether steps are too long for a solver or for the noise, in the state `y0` in which
paths start.

Four checks, each by power iteration or eigenvalues of a derivative at `y0`: explicit steps
must be stable, some solvers must resolve the largest frequency of the drift, implicit steps
must let decaying modes decay, and noise must not turn the state far in a step. In an
oscillation of angular frequency omega, a step of length h turns the state by the angle
omega h. An angle may be NaN, as where `y0` is a singularity: it is compared by `not angle >
most`, so that there is no warning.
"""

import functools as ft

import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from .._compat import unwrapped
from .._custom_types import Terms, Y
from .._programs import compiled, once_for_each_signature
from .._simulation import Problem
from .._solver import AbstractLangevinSplitting, AbstractSymplecticSolver
from .._terms import (
    BathNoise,
    brownian_paths,
    constraint_of,
    Dependence,
    has_unknown_law,
    split_friction,
)
from .fields_in_time import (
    change_by_increments,
    depends_on_time,
    drift_rate,
    spread_evenly,
)
from .linear_maps import Growth, largest_frequency, largest_growth, linearized


# A step is unstable if it enlarges a small change of the state by more than this factor,
# and turns the change around. (Exact flows may also do both, but not in a step that
# resolves them.) On an oscillator of frequency omega the steps of `StormerVerlet` enlarge
# changes by this factor at omega h = 2.003.
_UNSTABLE = 1.1
# After this many applications of the derivative of a step, any small change of the state
# points in the most unstable direction. Its growth is measured over as many more.
_ITERATIONS_FOR_INSTABILITY = 50
# Where noise turns the state by more than this in a step, as a standard deviation, two
# levels may agree on a wrong mean. Measured for the mean square of the site of an exciton
# on 3 and 7 sites with noise, by `ImplicitMidpoint`: at 1.4 and below the mean is within
# 1.4 error bars, at 2 it is 2 to 6 bars off, and at 3.2 (by `StrangGauss`, too) 4 bars off.
# No angle is safe for all systems: for a quartic oscillator with a noisy phase the mean is
# within 1.2 bars up to 2.2, but 2.4 bars off at 1, where the error of the step changes its
# sign.
_MOST_TURNED_BY_NOISE = 1.5
# This angle is measured for so many random choices of the signs of the increments.
_NUM_DIRECTIONS = 4
# Steps that turn the state by less than this angle resolve a rotation: two levels then
# differ by more than the error of their extrapolation. Measured for a charge in a magnetic
# field by `BAOAB(ImplicitMidpoint())`: the mean is within 0.3 error bars up to an angle of
# 2.4, and 24 bars off at 4.8. For a particle on a tilted washboard by `BAOAB()`: within 2.3
# bars at 1.25, and 16 off at 1.4.
_RESOLVED = 1.2
# An implicit step that turns a mode by the angle omega h damps it by 1 + (omega h / 2)^2
# times less than the mode decays: by less than half from this angle on. Measured for an
# oscillator with friction by `ImplicitMidpoint`: two levels and a trial show the error up
# to omega h = 60, and at 200 all levels keep the energy of the start.
_TURNS_TOO_FAR_TO_DECAY = 2.0
# A mode that loses less than this part of its amplitude over the interval does not count as
# decaying.
_LEAST_DECAY = 0.01
# Rates of decay below this fraction of the largest rate may be rounding errors of it, in
# single precision.
_ROUNDING_OF_RATES = 1e-6
# The most numbers in a state whose modes are computed: the eigenvalues of 256 take 0.1 s.
_MOST_MODES = 256
# If the drift depends on time, this many steps are looked at, spread over the interval.
_NUM_TIMES = 64


def too_long_steps(problem: Problem, dt0: float) -> str | None:
    """A warning if steps of `dt0` are too long for the solver, in the state in which paths
    start; `None` if they are not, or for solvers of other packages. Two levels need not
    show that steps are too long.

    If the drift depends on time, steps from all over the interval are looked at, and
    otherwise the first.

    Frequencies are those at `y0` alone. To look at the states of a path without noise, too,
    did not help: it did not show that steps of a thirtieth of the period are too long on an
    ellipse of eccentricity 0.8."""
    if not _can_step_without_noise(problem):
        return None
    if not problem.is_implicit:
        return _unstable_steps(problem, dt0)
    angle, step_number = _largest_angle(problem)
    message = _unresolved_frequency(problem, dt0, step_number, angle)
    return message or _missed_decay(problem, dt0, step_number, angle)


def _unstable_steps(problem: Problem, dt0: float) -> str | None:
    """A warning if an explicit step, with increments of zero, is unstable: if it enlarges a
    small change of the state, and turns it around."""
    step_numbers = _step_numbers_to_look_at(problem)
    growth = _growth_in_steps(problem, step_numbers)
    is_unstable = growth.log_growth > np.log(_UNSTABLE)
    # The quotient is negative where the change is turned around.
    is_unstable &= growth.rayleigh_quotient < 0
    if not np.any(is_unstable):
        return None
    first_unstable = step_numbers[np.argmax(is_unstable)]
    return (
        f"{_too_long(problem, dt0, first_unstable)}: a small change of the state grows in "
        "each step, with alternating signs. Where forces are bounded, such steps leave "
        "random states, and two levels may agree on a wrong mean. Pass a smaller `dt0`."
    )


def _unresolved_frequency(
    problem: Problem, dt0: float, step_number: np.floating, angle: float
) -> str | None:
    """A warning if the drift turns the state by a larger angle than the solver resolves,
    its `Record.most_frequency`. `angle` is the largest angle, in the step with this number.
    """
    assert isinstance(problem.solver, AbstractSymplecticSolver)
    record = problem.solver.record
    most_frequency = None if record is None else record.most_frequency
    # Three levels check the order, which shows an unresolved frequency.
    is_order_checked = len(problem.levels.h) > 2
    if most_frequency is None or is_order_checked or not angle > most_frequency:
        return None
    return (
        f"{_too_long(problem, dt0, step_number)}: omega h = {angle:.3g} for the largest "
        f"frequency of the drift, and with omega h > {most_frequency:g} two levels may "
        "agree on a wrong mean. Pass a smaller `dt0`, or `levels=3`, which checks the "
        "order."
    )


def _missed_decay(
    problem: Problem, dt0: float, step_number: np.floating, angle: float
) -> str | None:
    """A warning if a mode decays, but implicit steps turn it so far that they hardly damp
    it. `angle` is the largest angle by which the drift turns the state, in the step with
    this number."""
    # If the drift turns no mode this far, it turns no decaying mode this far, and the
    # eigenvalues, which take long, are not computed.
    if not angle > _TURNS_TOO_FAR_TO_DECAY or problem.num_components > _MOST_MODES:
        return None
    decaying_angle = _decaying_angle(problem, dt0, step_number)
    if not decaying_angle > _TURNS_TOO_FAR_TO_DECAY:
        return None
    return (
        f"{_too_long(problem, dt0, step_number)}: a mode with omega h = "
        f"{decaying_angle:.3g} decays, and implicit steps that turn it by more than "
        f"{_TURNS_TOO_FAR_TO_DECAY:g} keep it, so that it relaxes far too slowly on every "
        "level. Pass a smaller `dt0`, or for Langevin terms `BAOAB(ImplicitMidpoint())`, "
        "which solves the friction by itself."
    )


def _too_long(problem: Problem, dt0: float, step_number: np.floating) -> str:
    """The beginning of a warning, with the time at which the step with this number begins
    on the first level."""
    where = "where paths start"
    if step_number != 0:
        t = float(problem.t0) + step_number * float(problem.level(0).h)
        where = f"at t = {t:.4g}, for the state in which paths start"
    solver_name = type(problem.solver).__name__
    return f"Steps of `dt0={dt0:g}` are too long for `{solver_name}` {where}"


def _decaying_angle(problem: Problem, dt0: float, step_number: np.floating) -> float:
    """The largest angle by which the step with this number turns a mode that decays; zero
    if none decays. The modes are those of the drift in the implicit equations of the step,
    at `y0`. A mode with the eigenvalue `-rate + i omega` decays at `rate`, and a step turns
    it by the angle `|omega| dt0`."""
    jacobian = np.asarray(_jacobian_of_step(problem, step_number), float)
    eigenvalues = np.linalg.eigvals(jacobian)
    decay_rates = -eigenvalues.real
    duration = float(problem.level(0).num_steps) * dt0
    rounding = _ROUNDING_OF_RATES * np.max(np.abs(eigenvalues))
    # Modes with lower rates do not count as decaying.
    least_rate = max(_LEAST_DECAY / duration, rounding)
    # Without friction, each mode that decays is paired with one that grows as fast, so that
    # the rates add up to zero.
    if not np.sum(decay_rates) > least_rate:
        return 0.0
    angles = np.abs(eigenvalues.imag[decay_rates > least_rate]) * dt0
    return float(np.max(angles, initial=0.0))


def unresolved_angle(problem: Problem) -> float | None:
    """The largest angle in radians by which a step turns the state in which paths start;
    `None` if steps resolve the rotation, or for terms with a constraint."""
    if constraint_of(problem.terms) is not None:
        return None
    angle, _ = _largest_angle(problem)
    return angle if angle > _RESOLVED else None


def _largest_angle(problem: Problem) -> tuple[float, np.floating]:
    """The largest angle in radians by which the drift without friction turns the state in
    which paths start, in a step on the first level; and the number of this step."""
    step_numbers = _step_numbers_to_look_at(problem)
    frequencies = np.asarray(drift_frequencies(problem, step_numbers))
    largest = np.argmax(frequencies)
    angle = float(frequencies[largest]) * float(problem.level(0).h)
    return angle, step_numbers[largest]


def unresolved_noise(problem: Problem, dt0: float) -> str | None:
    """A warning if noise that depends on the state turns it far in a step of `dt0`, where
    paths start; `None` if it does not, or for solvers of other packages."""
    if not _can_step_without_noise(problem) or not _noise_reads_state(problem):
        return None
    angle = float(_noise_frequency(problem)) * dt0**0.5
    if not angle > _MOST_TURNED_BY_NOISE:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve the noise: where paths start, it turns the "
        f"state by {angle:.3g} in a step, as a standard deviation, and above "
        f"{_MOST_TURNED_BY_NOISE} two levels may agree on a wrong mean. Pass a smaller "
        "`dt0`, or `levels=3`, which checks the order."
    )


def _can_step_without_noise(problem: Problem) -> bool:
    """Whether a solver of this package takes the steps, without a constraint, and with
    increments that may be set to zero."""
    is_own = isinstance(problem.solver, AbstractSymplecticSolver)
    if not is_own or constraint_of(problem.terms) is not None:
        return False
    return not any(map(has_unknown_law, brownian_paths(problem.terms)))


def _step_numbers_to_look_at(problem: Problem) -> Float[np.ndarray, " times"]:
    """The numbers of the steps to look at: some from all over the interval if the drift
    depends on time, and otherwise only the first."""
    drift, _, _ = split_friction(problem.terms)
    field = jtu.Partial(drift_rate, drift, problem.args)
    if not drift or not depends_on_time(field, problem.t0, problem.y0):
        return np.zeros(1, problem.dtype)
    num_steps = int(problem.level(0).num_steps)
    return np.floor(spread_evenly(_NUM_TIMES) * num_steps).astype(problem.dtype)


def _noise_of_user(problem: Problem) -> Terms:
    """The noise without the noise of heat baths, which acts on momenta alone."""
    _, _, noise = split_friction(problem.terms)
    return tuple(term for term in noise if not isinstance(unwrapped(term), BathNoise))


@once_for_each_signature
def _noise_reads_state(problem: Problem) -> bool:
    """Whether the change of the state by noise depends on the state, apart from the noise
    of heat baths. This is whether its program reads the state: the derivative may be zero
    at `y0`."""
    noise = _noise_of_user(problem)
    change, zeros = change_by_increments(noise, problem.args, problem.t0)
    if zeros.size == 0:
        return False
    dependence = Dependence(change, problem.y0, zeros)
    return not dependence.independent(lambda y, increments: y)


@ft.partial(compiled, quickly=True)
def _growth_in_steps(problem: Problem, step_numbers: Float[Array, " times"]) -> Growth:
    """For each of the steps with these numbers, taken from `y0` with increments of zero:
    the growth of the small change of `y0` that the step enlarges most."""
    h = problem.level(0).h
    variables = problem.variables(h)
    terms = variables.terms_with(jnp.zeros(len(variables.laws)))

    def step(step_number: Float[Array, ""], y: Y) -> Y:
        state = problem.init(terms, step_number, h, y)
        y1, *_ = problem.step(terms, step_number, h, y, state)
        return y1

    def growth_in_step(step_number: Float[Array, ""]) -> Growth:
        derivative, flat_y0 = linearized(step, step_number, problem.y0)
        return largest_growth(derivative, flat_y0, _ITERATIONS_FOR_INSTABILITY)

    # This compiles faster than `jax.vmap`, and takes less memory.
    return lax.map(growth_in_step, step_numbers)


@ft.partial(compiled, quickly=True)
def drift_frequencies(
    problem: Problem, step_numbers: Float[Array, " times"]
) -> Float[Array, " times"]:
    """The largest angular frequency of the drift without friction, at `y0` and the start
    of each of the steps with these numbers; zero where growth without oscillation is
    faster."""
    drift, _, _ = split_friction(problem.terms)
    if not drift:
        return jnp.zeros_like(step_numbers)
    field = jtu.Partial(drift_rate, drift, problem.args)

    def frequency(step_number: Float[Array, ""]) -> Float[Array, ""]:
        t = problem.t0 + step_number * problem.level(0).h
        return largest_frequency(field, t, problem.y0)

    return lax.map(frequency, step_numbers)


@ft.partial(compiled, quickly=True)
def _jacobian_of_step(
    problem: Problem, step_number: Float[Array, ""]
) -> Float[Array, "n n"]:
    """The derivative at `y0` of the drift in the implicit equations of the step with this
    number, as a matrix. The drift contains the friction, except for splittings, which solve
    the friction by itself."""
    drift, friction, _ = split_friction(problem.terms)
    if isinstance(problem.solver, AbstractLangevinSplitting):
        friction = ()
    t = problem.t0 + step_number * problem.level(0).h
    field = jtu.Partial(drift_rate, (*drift, *friction), problem.args)
    derivative, flat_y0 = linearized(field, t, problem.y0)
    unit_vectors = jnp.eye(flat_y0.size, dtype=flat_y0.dtype)
    return jax.vmap(derivative, out_axes=1)(unit_vectors)


@ft.partial(compiled, quickly=True)
def _noise_frequency(problem: Problem) -> Float[Array, ""]:
    """The angle by which noise turns a small change of the state at `y0` within time 1, as
    a standard deviation. This is the largest angle over some random choices of the signs of
    the increments, each of which has the size of its standard deviation."""
    noise = _noise_of_user(problem)
    change, zeros = change_by_increments(noise, problem.args, problem.t0)

    def frequency(key: PRNGKeyArray) -> Float[Array, ""]:
        increments = jr.rademacher(key, zeros.shape, zeros.dtype)

        def field(_, y: Y) -> Y:
            return change(y, increments)

        return largest_frequency(field, problem.t0, problem.y0)

    return jnp.max(lax.map(frequency, jr.split(jr.key(0), _NUM_DIRECTIONS)))
