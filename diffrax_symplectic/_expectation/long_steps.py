"""Whether steps are too long for a solver or for the noise, for the state in which paths
start."""

import functools as ft
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from .._brownian import zeros_and_unravel
from .._compat import unwrapped
from .._custom_types import Y
from .._programs import compiled, once_for_each_signature
from .._simulation import Problem
from .._solver import AbstractLangevinSplitting, AbstractSymplecticSolver
from .._terms import (
    apply,
    BathNoise,
    brownian_paths,
    constraint_of,
    control_struct,
    Dependence,
    has_unknown_law,
    split_friction,
)
from .fields_in_time import depends_on_time, drift_rate, spread_evenly
from .linear_maps import Growth, largest_frequency, largest_growth, linearized


# A step that enlarges a small change of the state by more than this, and turns it around,
# is unstable. Exact flows turn changes around, too, but over a step that resolves them they
# do not enlarge them at the same time. On an oscillator of frequency omega the steps of
# `StormerVerlet` enlarge changes by this factor at omega h = 2.003.
_UNSTABLE = 1.1
# After this many steps of the tangent flow any change of the state points in the most
# unstable direction. Its growth is measured over as many more steps.
_ITERATIONS_FOR_INSTABILITY = 50
# Where noise turns the state by more than this in a step, as a standard deviation, two
# levels may agree on a wrong mean. Measured for the mean square of the site of an exciton
# on 3 and 7 sites with noise, by `ImplicitMidpoint`: at 1.4 and below the mean is within
# 1.4 bars, at 2 it is 2 to 6 bars off, and at 3.2 (by `StrangGauss`, too) it is 4 off.
# On a quartic oscillator whose phase is noisy it is within 1.2 bars up to 2.2, but at 1,
# where the error of the step changes its sign, 2.4 off: no angle is safe for all systems.
_MOST_TURNED_BY_NOISE = 1.5
# In how many random directions of the noise this angle is measured.
_NUM_DIRECTIONS = 4
# Steps that turn the state by less than this resolve a rotation: two levels then differ by
# more than what they miss. Measured for a charge in a magnetic field by
# `BAOAB(ImplicitMidpoint())`: within 0.3 bars up to an angle of 2.4, 24 off at 4.8. For a
# particle on a tilted washboard by `BAOAB()`: within 2.3 bars at 1.25, 16 off at 1.4.
_RESOLVED = 1.2
# An implicit step takes a mode that turns by the angle omega h toward its mean by
# 1 + (omega h / 2)^2 times less than its decay: less than half of it from here on. Measured
# for an oscillator with friction by `ImplicitMidpoint`: two levels and a trial see it up to
# omega h = 60, and at 200 all levels keep the energy of the start.
_TURNS_TOO_FAR_TO_DECAY = 2.0
# A mode that loses less than this part of its amplitude over the interval has no decay to
# miss.
_LEAST_DECAY = 0.01
# Rates of decay below this fraction of the largest rate may be rounding errors of it, in
# single precision.
_ROUNDING_OF_RATES = 1e-6
# The largest number of numbers in a state of which all modes are known: the eigenvalues of
# 256 take 0.1 s.
_MOST_MODES = 256
# The number of steps to look at where the drift depends on time.
_NUM_TIMES = 64


def too_long_steps(problem: Problem, dt0: float) -> str | None:
    """What is wrong with steps of `dt0` for the state in which paths start, as a sentence;
    `None` if nothing is, or for solvers of others. Two levels need not show it.

    Explicit solvers must be stable, with increments of zero. A solver with a
    `Record.most_frequency` must resolve the frequencies of the drift, and every implicit
    one those that decay. If the drift depends on time, this looks at steps from all over
    the interval, and otherwise at the first.

    This sees the frequencies at `y0` alone. A look at the states of a path without noise,
    too, did not find steps of a thirtieth of the period too long on an ellipse of
    eccentricity 0.8."""
    solver = problem.solver
    if not isinstance(solver, AbstractSymplecticSolver):
        return None
    if not _has_step_without_noise(problem):
        return None
    beginning = f"Steps of `dt0={dt0:g}` are too long for `{type(solver).__name__}`"
    if not problem.is_implicit:
        step_numbers = _step_numbers_to_look_at(problem)
        growth = _growth_in_steps(problem, step_numbers)
        is_unstable = growth.log_growth > np.log(_UNSTABLE)
        is_unstable &= growth.rayleigh_quotient < 0
        if not np.any(is_unstable):
            return None
        where = _where_step_begins(problem, step_numbers[np.argmax(is_unstable)])
        return (
            f"{beginning} {where}: a small change of the state grows in each step, with "
            "alternating signs. Where forces are bounded, such steps leave random states, "
            "and two levels may agree on a wrong mean. Pass a smaller `dt0`."
        )
    angle, step_number = _largest_angle(problem)
    where = _where_step_begins(problem, step_number)
    most_frequency = None if solver.record is None else solver.record.most_frequency
    # Three levels are checked for the order, which shows this.
    is_order_checked = len(problem.levels.h) > 2
    if most_frequency is not None and angle > most_frequency and not is_order_checked:
        return (
            f"{beginning} {where}: omega h = {angle:.3g} for the largest frequency of the "
            f"drift, and with omega h > {most_frequency:g} two levels may agree on a wrong "
            "mean. Pass a smaller `dt0`, or `levels=3`, which checks the order."
        )
    if not angle > _TURNS_TOO_FAR_TO_DECAY or problem.num_components > _MOST_MODES:
        return None
    decaying_angle = _largest_decaying_angle(problem, step_number, dt0)
    if not decaying_angle > _TURNS_TOO_FAR_TO_DECAY:
        return None
    return (
        f"{beginning} {where}: a mode with omega h = {decaying_angle:.3g} decays, and "
        "implicit steps that turn it by more than "
        f"{_TURNS_TOO_FAR_TO_DECAY:g} keep it, so that it relaxes far too slowly on every "
        "level. Pass a smaller `dt0`, or for Langevin terms `BAOAB(ImplicitMidpoint())`, "
        "which solves the friction by itself."
    )


def _largest_decaying_angle(
    problem: Problem, step_number: np.floating, dt0: float
) -> float:
    """The largest angle by which a mode that decays turns in a step, by the part of the
    drift that the equations of the step with this number contain, at `y0`; zero if none
    decays. Steps on every level keep its amplitude if it is large."""
    # A mode decays with the negative real part of its eigenvalue, and turns with the
    # imaginary part.
    jacobian = np.asarray(_jacobian_of_step(problem, step_number), float)
    eigenvalues = np.linalg.eigvals(jacobian)
    decay_rates = -eigenvalues.real
    duration = float(problem.level(0).num_steps) * dt0
    rounding = _ROUNDING_OF_RATES * np.max(np.abs(eigenvalues))
    least_rate = max(_LEAST_DECAY / duration, rounding)
    # Without friction, modes grow and decay in pairs, and these rates add up to zero.
    if not np.sum(decay_rates) > least_rate:
        return 0.0
    angles = np.abs(eigenvalues.imag[decay_rates > least_rate]) * dt0
    return float(np.max(angles, initial=0.0))


def unresolved_angle(problem: Problem) -> float | None:
    """The largest angle by which a step turns the state in which paths start, in radians;
    `None` if steps resolve it, and two levels differ by more than what they miss."""
    if constraint_of(problem.terms) is not None:
        return None
    angle, _ = _largest_angle(problem)
    return angle if angle > _RESOLVED else None


def _largest_angle(problem: Problem) -> tuple[float, np.floating]:
    """The largest angle by which a step on the first level turns the state in which paths
    start, by the drift without friction, in radians; and the number of this step."""
    step_numbers = _step_numbers_to_look_at(problem)
    frequencies = np.asarray(drift_frequencies(problem, step_numbers))
    largest = np.argmax(frequencies)
    angle = float(frequencies[largest]) * float(problem.level(0).h)
    return angle, step_numbers[largest]


def unresolved_noise(problem: Problem, dt0: float) -> str | None:
    """What is wrong with steps of `dt0` for noise that depends on the state in which paths
    start, as a sentence; `None` if nothing is, or for solvers of others."""
    if not isinstance(problem.solver, AbstractSymplecticSolver):
        return None
    if not _has_step_without_noise(problem) or not _noise_reads_state(problem):
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


def _has_step_without_noise(problem: Problem) -> bool:
    """Whether increments can be set to zero."""
    if constraint_of(problem.terms) is not None:
        return False
    return not any(map(has_unknown_law, brownian_paths(problem.terms)))


def _step_numbers_to_look_at(problem: Problem) -> Float[np.ndarray, " times"]:
    """The numbers of the steps to look at: the first alone if the drift does not depend on
    time."""
    drift, _, _ = split_friction(problem.terms)
    field = jtu.Partial(drift_rate, drift, problem.args)
    if not drift or not depends_on_time(field, problem.t0, problem.y0):
        return np.zeros(1, problem.dtype)
    num_steps = int(problem.level(0).num_steps)
    return np.floor(spread_evenly(_NUM_TIMES) * num_steps).astype(problem.dtype)


def _where_step_begins(problem: Problem, step_number: np.floating) -> str:
    """Where a step on the first level begins, for messages."""
    if step_number == 0:
        return "where paths start"
    t = float(problem.t0) + step_number * float(problem.level(0).h)
    return f"at t = {t:.4g}, for the state in which paths start"


def _noise_of_user(
    problem: Problem,
) -> tuple[Callable[[Y, Array], Y], Float[Array, " m"]]:
    """The change of a state by increments of the noise but that of heat baths, which acts
    on momenta alone; and these increments as one vector, zero."""
    _, _, noise = split_friction(problem.terms)
    noise = tuple(term for term in noise if not isinstance(unwrapped(term), BathNoise))
    structs = [control_struct(term, problem.t0) for term in noise]
    zeros, unravel = zeros_and_unravel(structs)

    def change(y: Y, controls: Float[Array, " m"]) -> Y:
        return apply(noise, unravel(controls), problem.args, problem.t0, y)

    return change, zeros


@once_for_each_signature
def _noise_reads_state(problem: Problem) -> bool:
    """Whether the change of the state by noise depends on the state, apart from the noise
    of heat baths. Its program is looked at, not its derivative, which may be zero at
    `y0`."""
    change, controls = _noise_of_user(problem)
    if controls.size == 0:
        return False
    dependence = Dependence(change, problem.y0, controls)
    return not dependence.independent(lambda y, controls: y)


@ft.partial(compiled, quickly=True)
def _growth_in_steps(problem: Problem, numbers: Float[Array, " times"]) -> Growth:
    """For each of the steps with these numbers, started from `y0`: the growth of the change
    of `y0` that the derivative of the step enlarges most."""
    h = problem.level(0).h
    # With increments of zero.
    variables = problem.variables(h)
    terms = variables.terms_with(jnp.zeros(len(variables.laws)))

    def step(number: Float[Array, ""], y: Y) -> Y:
        state = problem.init(terms, number, h, y)
        y1, *_ = problem.step(terms, number, h, y, state)
        return y1

    def growth_in_step(number: Float[Array, ""]) -> Growth:
        derivative, flat_y0 = linearized(step, number, problem.y0)
        return largest_growth(derivative, flat_y0, _ITERATIONS_FOR_INSTABILITY)

    # This compiles faster than `jax.vmap`, and takes less memory.
    return lax.map(growth_in_step, numbers)


@ft.partial(compiled, quickly=True)
def drift_frequencies(
    problem: Problem, numbers: Float[Array, " times"]
) -> Float[Array, " times"]:
    """The largest angular frequency of the drift without friction at `y0`, at the starts of
    the steps with these numbers; zero where growth without oscillation is faster."""
    drift, _, _ = split_friction(problem.terms)
    if not drift:
        return jnp.zeros_like(numbers)

    def frequency(number: Float[Array, ""]) -> Float[Array, ""]:
        t = problem.t0 + number * problem.level(0).h
        field = jtu.Partial(drift_rate, drift, problem.args)
        return largest_frequency(field, t, problem.y0)

    return lax.map(frequency, numbers)


@ft.partial(compiled, quickly=True)
def _jacobian_of_step(
    problem: Problem, step_number: Float[Array, ""]
) -> Float[Array, "n n"]:
    """The derivative at `y0`, at the start of the step with this number, of the drift that
    the implicit equations of a step contain: with the friction, except for splittings,
    which solve the friction by itself."""
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
    """The angle by which noise turns a change of the state at `y0` within time 1, as a
    standard deviation: the largest over some random directions of the noise, in which all
    increments have the size of their standard deviation."""
    change, zeros = _noise_of_user(problem)

    def frequency(key: PRNGKeyArray) -> Float[Array, ""]:
        controls = jr.rademacher(key, zeros.shape, zeros.dtype)

        def field(t: Array, y: Y) -> Y:
            del t
            return change(y, controls)

        return largest_frequency(field, problem.t0, problem.y0)

    return jnp.max(lax.map(frequency, jr.split(jr.key(0), _NUM_DIRECTIONS)))
