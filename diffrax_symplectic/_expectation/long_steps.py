"""Whether steps are too long for a solver or for the noise, for the state in which paths
start."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .._brownian import zeros_and_unravel
from .._compat import unwrapped
from .._custom_types import Terms
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
    rate,
    split_friction,
)
from .fields_in_time import depends_on_time, drift_field, spread_evenly
from .linear_maps import derivative_at, Growth, largest_growth


# A step that enlarges a small change of the state by more than this, and turns it around,
# is unstable. Exact flows turn changes around, too, but over a step that resolves them they
# do not enlarge them at the same time. On an oscillator of frequency omega the steps of
# `StormerVerlet` enlarge changes by this factor at omega h = 2.003.
_UNSTABLE = 1.1
# After this many steps of the tangent flow any change of the state points in the most
# unstable direction. Its growth is measured over as many more steps.
_ITERATIONS_FOR_INSTABILITY = 50
# The same for the square of the largest frequency, which need not be known as well.
_ITERATIONS_FOR_FREQUENCY = 15
# The fraction of `dt0` that is surely short enough. If such a step fails, too, the length
# of steps is not the cause.
_SURELY_SHORT_FRACTION = 1e-6
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
    if _is_explicit(problem):
        return _instability(problem, dt0)
    record = solver.record
    most_frequency = None if record is None else record.most_frequency
    # Three levels are checked for the order, which shows this.
    is_order_checked = len(problem.levels.h) > 2
    if most_frequency is not None and not is_order_checked:
        message = _unresolved_frequency(problem, dt0, most_frequency)
        if message is not None:
            return message
    return _lost_decay(problem, dt0)


def _instability(problem: Problem, dt0: float) -> str | None:
    """`too_long_steps` for an explicit solver."""
    step_numbers = _step_numbers_to_look_at(problem)
    growth = _quick_growth(problem, step_numbers)
    is_unstable = growth.log_growth > np.log(_UNSTABLE)
    is_unstable &= growth.rayleigh_quotient < 0
    if not np.any(is_unstable):
        return None
    first_unstable = step_numbers[np.argmax(is_unstable)]
    where = _where_step_begins(problem, first_unstable)
    return (
        f"Steps of `dt0={dt0:g}` are too long for `{type(problem.solver).__name__}` "
        f"{where}: a small change of the state grows in each step, with alternating signs. "
        "Where forces are bounded, such steps leave random states, and two levels may "
        "agree on a wrong mean. Pass a smaller `dt0`."
    )


def _unresolved_frequency(
    problem: Problem, dt0: float, most_frequency: float
) -> str | None:
    """`too_long_steps` for an implicit solver with this `Record.most_frequency`, which is
    the largest omega h that it resolves."""
    angle, step_number = _largest_angle(problem)
    if not angle > most_frequency:
        return None
    return (
        f"Steps of `dt0={dt0:g}` are too long for `{type(problem.solver).__name__}` "
        f"{_where_step_begins(problem, step_number)}: omega h = {angle:.3g} for the "
        f"largest frequency of the drift, and with omega h > {most_frequency:g} two levels "
        "may agree on a wrong mean. Pass a smaller `dt0`, or `levels=3`, which checks the "
        "order."
    )


def _lost_decay(problem: Problem, dt0: float) -> str | None:
    """`too_long_steps` for an implicit solver, if a mode should decay, but turns so far in
    a step that the step keeps its amplitude, on every level."""
    largest_angle, step_number = _largest_angle(problem)
    if not largest_angle > _TURNS_TOO_FAR_TO_DECAY:
        return None
    if problem.num_components > _MOST_MODES:
        return None
    # Of the part of the drift that the equations of a step contain, at `y0`.
    jacobian = np.asarray(_quick_jacobian(problem, step_number), float)
    # A mode decays with the negative real part of its eigenvalue, and turns with the
    # imaginary part.
    eigenvalues = np.linalg.eigvals(jacobian)
    decay_rates = -eigenvalues.real
    duration = float(problem.level(0).num_steps) * dt0
    rounding = _ROUNDING_OF_RATES * np.max(np.abs(eigenvalues))
    least_rate = max(_LEAST_DECAY / duration, rounding)
    turns_too_far = np.abs(eigenvalues.imag) * dt0 > _TURNS_TOO_FAR_TO_DECAY
    is_wrongly_kept = turns_too_far & (decay_rates > least_rate)
    # Without friction, modes grow and decay in pairs, and these rates add up to zero.
    is_dissipative = np.sum(decay_rates) > least_rate
    if not np.any(is_wrongly_kept) or not is_dissipative:
        return None
    angle = np.max(np.abs(eigenvalues.imag[is_wrongly_kept])) * dt0
    return (
        f"Steps of `dt0={dt0:g}` are too long for `{type(problem.solver).__name__}` "
        f"{_where_step_begins(problem, step_number)}: a mode with "
        f"omega h = {angle:.3g} decays, and implicit steps that turn it by more than "
        f"{_TURNS_TOO_FAR_TO_DECAY:g} keep it, so that it relaxes far too slowly on every "
        "level. Pass a smaller `dt0`, or for Langevin terms `BAOAB(ImplicitMidpoint())`, "
        "which solves the friction by itself."
    )


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
    frequencies = np.asarray(_quick_frequencies(problem, step_numbers))
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
    angle = float(_quick_noise_frequency(problem)) * dt0**0.5
    if not angle > _MOST_TURNED_BY_NOISE:
        return None
    return (
        f"Steps of `dt0={dt0:g}` do not resolve the noise: where paths start, it turns the "
        f"state by {angle:.3g} in a step, as a standard deviation, and above "
        f"{_MOST_TURNED_BY_NOISE} two levels may agree on a wrong mean. Pass a smaller "
        "`dt0`, or `levels=3`, which checks the order."
    )


def _noise_of_user(problem: Problem) -> Terms:
    """The noise terms but those of heat baths, whose noise acts on momenta alone."""
    _, _, noise = split_friction(problem.terms)
    return tuple(term for term in noise if not isinstance(unwrapped(term), BathNoise))


@once_for_each_signature
def _noise_reads_state(problem: Problem) -> bool:
    """Whether the change of the state by noise depends on the state, apart from the noise
    of heat baths. Its program is looked at, not its derivative, which may be zero at
    `y0`."""
    noise = _noise_of_user(problem)
    if not noise:
        return False
    controls, unravel = _zero_controls(problem, noise)

    def change(y: PyTree[Array], controls: Float[Array, " m"]) -> PyTree[Array]:
        return apply(noise, unravel(controls), problem.args, problem.t0, y)

    dependence = Dependence(change, problem.y0, controls)
    return not dependence.independent(lambda y, controls: y)


def _zero_controls(
    problem: Problem, noise: Terms
) -> tuple[Float[Array, " m"], Callable[[Array], Any]]:
    """The increments of all noise terms as one vector, zero, and its inverse."""
    return zeros_and_unravel([control_struct(term, problem.t0) for term in noise])


def _step_numbers_to_look_at(problem: Problem) -> Float[np.ndarray, " times"]:
    """The numbers of the steps to look at: the first alone if the drift does not depend on
    time."""
    drift, _, _ = split_friction(problem.terms)
    field = drift_field(drift, problem.args)
    if not drift or not depends_on_time(field, problem, problem.y0):
        return np.zeros(1, problem.dtype)
    num_steps = int(problem.level(0).num_steps)
    return np.floor(spread_evenly(_NUM_TIMES) * num_steps).astype(problem.dtype)


def _where_step_begins(problem: Problem, step_number: float | np.floating) -> str:
    """Where a step on the first level begins, for messages."""
    if step_number == 0:
        return "where paths start"
    t = float(problem.t0) + step_number * float(problem.level(0).h)
    return f"at t = {t:.4g}, for the state in which paths start"


def may_be_too_long(problem: Problem) -> bool:
    """Whether the length of steps is the likely cause if most paths fail: for an explicit
    solver whose step without noise succeeds from `y0` if it is very short, with a finite
    `phi` after it."""
    if not _is_explicit(problem) or not _has_step_without_noise(problem):
        return False
    return bool(_quick_short_step_succeeds(problem))


def _is_explicit(problem: Problem) -> bool:
    """Whether the solver is known to be explicit: one of this package without implicit
    stages, or an explicit Runge-Kutta method of Diffrax."""
    solver = problem.solver
    if isinstance(solver, AbstractSymplecticSolver):
        return not solver.stage_vectors(1)
    return isinstance(solver, diffrax.AbstractERK)


def _has_step_without_noise(problem: Problem) -> bool:
    """Whether increments can be set to zero."""
    if constraint_of(problem.terms) is not None:
        return False
    return not any(map(has_unknown_law, brownian_paths(problem.terms)))


def _terms_without_noise(problem: Problem, h: Any) -> PyTree:
    """The terms with increments of zero."""
    variables = problem.variables(h)
    return variables.terms_with(jnp.zeros(len(variables.laws)))


def _short_step_succeeds(problem: Problem) -> Bool[Array, ""]:
    """Whether a very short step without noise succeeds, with a finite `phi` after it."""
    h = _SURELY_SHORT_FRACTION * problem.level(0).h
    terms = _terms_without_noise(problem, h)
    state = problem.init(terms, 0, h, problem.y0)
    y, _, success = problem.step(terms, 0, h, problem.y0, state)
    return success & jnp.all(jnp.isfinite(problem.values(problem.t0, y)))


def _growth(problem: Problem, numbers: Float[Array, " times"]) -> Growth:
    """For each of the steps with these numbers, started from `y0`: the growth of the change
    of `y0` that the derivative of the step enlarges most."""
    h = problem.level(0).h
    terms = _terms_without_noise(problem, h)
    flat_y0, unravel = jfu.ravel_pytree(problem.y0)

    def growth_in_step(number: Float[Array, ""]) -> Growth:
        def step(x: Array) -> Array:
            y = unravel(x)
            state = problem.init(terms, number, h, y)
            y1, *_ = problem.step(terms, number, h, y, state)
            return jfu.ravel_pytree(y1)[0]

        derivative = derivative_at(step, flat_y0)
        return largest_growth(derivative, flat_y0, _ITERATIONS_FOR_INSTABILITY)

    # This compiles faster than `jax.vmap`, and takes less memory.
    return lax.map(growth_in_step, numbers)


def _frequencies(
    problem: Problem, numbers: Float[Array, " times"]
) -> Float[Array, " times"]:
    """The largest angular frequency of the drift without friction at `y0`, at the starts of
    the steps with these numbers; zero where growth without oscillation is faster."""
    h = problem.level(0).h
    drift, _, _ = split_friction(problem.terms)
    if not drift:
        return jnp.zeros_like(numbers)
    flat_y0, unravel = jfu.ravel_pytree(problem.y0)

    def frequency(number: Float[Array, ""]) -> Float[Array, ""]:
        t = problem.t0 + number * h

        def rate_of_drift(x: Array) -> Array:
            dy = rate(drift, t, unravel(x), problem.args)
            return jfu.ravel_pytree(dy)[0]

        return _frequency_of(rate_of_drift, flat_y0)

    return lax.map(frequency, numbers)


def _jacobian(problem: Problem, step_number: Float[Array, ""]) -> Float[Array, "n n"]:
    """The derivative at `y0`, at the start of the step with this number, of the drift that
    the implicit equations of a step contain: with the friction, except for splittings,
    which solve the friction by itself."""
    drift, friction, _ = split_friction(problem.terms)
    if isinstance(problem.solver, AbstractLangevinSplitting):
        friction = ()
    t = problem.t0 + step_number * problem.level(0).h
    flat_y0, unravel = jfu.ravel_pytree(problem.y0)

    def rate_of_drift(x: Array) -> Array:
        dy = rate((*drift, *friction), t, unravel(x), problem.args)
        return jfu.ravel_pytree(dy)[0]

    return jax.jacfwd(rate_of_drift)(flat_y0)


def _noise_frequency(problem: Problem) -> Float[Array, ""]:
    """The angle by which noise turns a change of the state at `y0` within time 1, as a
    standard deviation: the largest over some random directions of the noise, in which all
    increments have the size of their standard deviation."""
    noise = _noise_of_user(problem)
    flat_y0, unravel = jfu.ravel_pytree(problem.y0)
    zeros, unravel_controls = _zero_controls(problem, noise)

    def frequency(key: PRNGKeyArray) -> Float[Array, ""]:
        controls = unravel_controls(jr.rademacher(key, zeros.shape, zeros.dtype))

        def change_by_noise(x: Array) -> Array:
            dy = apply(noise, controls, problem.args, problem.t0, unravel(x))
            return jfu.ravel_pytree(dy)[0]

        return _frequency_of(change_by_noise, flat_y0)

    return jnp.max(lax.map(frequency, jr.split(jr.key(0), _NUM_DIRECTIONS)))


def _frequency_of(
    rate_of: Callable[[Array], Array], x: Float[Array, " n"]
) -> Float[Array, ""]:
    """The largest angular frequency of the equation `dx/dt = rate_of(x)` near `x`; zero
    where growth without oscillation is faster."""
    derivative = derivative_at(rate_of, x)

    # The derivative has the eigenvalues i omega and -i omega of an oscillation, for which
    # power iteration does not converge. Its square has -omega^2 for all directions in the
    # plane of the oscillation.
    def derivative_twice(change: Array) -> Array:
        # A loop, so that the derivative is compiled once.
        return lax.fori_loop(0, 2, lambda _, change: derivative(change), change)

    growth = largest_growth(derivative_twice, x, _ITERATIONS_FOR_FREQUENCY)
    oscillates = growth.rayleigh_quotient < 0
    # Each application multiplies by omega^2, so omega is the root of the growth.
    return jnp.where(oscillates, jnp.exp(growth.log_growth / 2), 0)


_quick_growth = compiled(_growth, quickly=True)
_quick_frequencies = compiled(_frequencies, quickly=True)
_quick_jacobian = compiled(_jacobian, quickly=True)
_quick_noise_frequency = compiled(_noise_frequency, quickly=True)
_quick_short_step_succeeds = compiled(_short_step_succeeds, quickly=True)
