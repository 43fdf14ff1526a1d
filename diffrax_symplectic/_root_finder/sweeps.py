r"""Sweeps: the iteration that usually solves a step, for all paths of a batch together.

A sweep updates the momenta by a fixed-point iteration, then the positions with the new
momenta. Convergence checks take much of the time of small systems, so there are few: each
check tells how many sweeps come before the next one.

Unknowns that are not momenta and positions are doubled: $y = \Phi(y)$ becomes $p =
\Phi(q)$, $q = \Phi(p)$, with two halves $p$ and $q$ that agree at the solution.
"""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._batch import batched_like, largest_in_batch, materialize
from .._compat import ω
from .._custom_types import IntScalarLike
from .tolerance import converged, CorrectionSize, log2, LOG2_MARGIN, Tolerance


Map: TypeAlias = Callable[[PyTree[Array]], PyTree[Array]]

# Sweeps before the first convergence check, in double and in single precision, as needed
# for a short step, whose error shrinks by a factor of about 60 in each: 60^9 is 1e16, for
# the digits of double precision, and 60^6 is beyond the 1e8 of single precision.
_FIRST_SWEEPS = (9, 6)
# The same for a doubled system. Fewer sweeps suffice, since each evaluates everything
# twice.
_FIRST_SWEEPS_DOUBLED = (6, 5)
# The most sweeps between two convergence checks: rates near one are not known accurately.
_MOST_BETWEEN_CHECKS = 32
# The most sweeps until the next check when corrections are as small as rounding errors.
_MOST_AT_ROUNDING = 3
# Sweeps with a slower rate of convergence are under-relaxed. Faster ones would gain less
# than one sweep.
SLOW = 0.3
# The relaxation factor after divergence. It is the best one for sweeps whose corrections
# grow by a factor of 8: 2 / (1 + sqrt(1 + 8)).
_STRONGEST_RELAXATION = 0.5
# The base-2 logarithm of a quarter, the rate expected of relaxed sweeps. By Young's formula
# relaxed sweeps converge at a rate of 0.17 or better if the rate without relaxation is one
# or less. The first few converge more slowly.
_LOG2_RELAXED_RATE = -2.0
# The base-2 logarithm of 0.87, the rate above which sweeps count as not converging.
LOG2_STALLED = -0.2


class Halves(NamedTuple):
    """Unknowns in two halves, each of which depends mostly on the other, such as momenta
    and positions."""

    p: PyTree[Array]
    q: PyTree[Array]


class _SweepState(NamedTuple):
    """The state of the sweeps at a convergence check.

    - `y`: the iterate.
    - `relaxation`: the relaxation factor.
    - `log2_size`: the base-2 logarithm of the size of the last correction, in units of the
        tolerance.
    - `is_solved`: whether the path has converged.
    - `pending`: whether the path needs further sweeps, and they may help.
    - `num_done`: the number of sweeps so far, the same for all paths of the batch.
    - `num_ahead`: the number of sweeps until the next check, the same for all paths; zero
        once no path is pending.
    """

    y: Halves | None
    relaxation: Scalar
    log2_size: Scalar
    is_solved: Bool[Array, ""]
    pending: Bool[Array, ""]
    num_done: IntScalarLike
    num_ahead: IntScalarLike


def solve_by_sweeps(
    tolerance: Tolerance,
    max_sweeps: int,
    image: Map,
    scale: Map,
    guess: PyTree[Array],
    pending: Bool[Array, ""],
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    r"""Solves $y = \Phi(y)$ from a `guess` for all `pending` paths of a batch, with at most
    `max_sweeps`, until each path has converged or is seen not to converge. Returns the
    iterate (the guess if sweeps diverged), and whether it is a solution.

    In a sweep $q$ is updated with the new $p$ (Gauss--Seidel). For an oscillating
    Hamiltonian system this reduces the error as much as two evaluations of both halves, for
    the cost of one if $H = T(p) + V(q)$.

    Each convergence check (see `_decide`) measures the rate at which corrections shrink.
    From the rate follow the number of sweeps that the slowest path needs before the next
    check, and once, after the first check, the relaxation factor: for an oscillation, a
    rate $a$ belongs to an eigenvalue $-a$, and with the factor $\omega = 2 / (1 + \sqrt{1 +
    a})$ sweeps converge at the rate $1 - \omega$ (D. M. Young, Transactions of the American
    Mathematical Society 76, 1954, 92-111; for doubled systems G. H. Golub and R. S. Varga,
    Numerische Mathematik 3, 1961, 147-156). Sweeps that diverged are started again with
    strong under-relaxation.
    """
    in_halves = isinstance(guess, Halves)
    start = guess if in_halves else Halves(guess, guess)
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    in_double, in_single = _FIRST_SWEEPS if in_halves else _FIRST_SWEEPS_DOUBLED
    first_sweeps = in_single if jnp.finfo(dtype).bits < 64 else in_double

    def value_of(y: PyTree[Array]) -> PyTree[Array]:
        """The unknowns. For a doubled system either half would do."""
        return y if in_halves else y.q

    def sweep_and_check(state: _SweepState) -> _SweepState:
        correction, y = _sweep_until_check(image, state, in_halves)
        size = tolerance.measure(correction, scale(value_of(y)))
        # The first check has no earlier correction to compare with: `state.log2_size` is
        # infinite. The size of the state takes its place.
        last_log2_size = jnp.minimum(state.log2_size, log2(size.size_of_state))
        log2_size = log2(size.size)
        check = ft.partial(
            _decide, state, log2_size, last_log2_size, size, first_sweeps, max_sweeps
        )
        # Without `materialize` XLA would compute the decision again wherever it is used:
        # steps of small systems took 1.3 to 2.8 times as long.
        next_state, goes_back = materialize(check)

        # All paths of a batch sweep together. A path that is no longer pending keeps its
        # iterate.
        def next_iterate(new: Array, guess: Array, old: Array) -> Array:
            return jnp.where(state.pending, jnp.where(goes_back, guess, new), old)

        return next_state._replace(y=jtu.tree_map(next_iterate, y, start, state.y))

    one = jnp.ones((), dtype)
    inf = jnp.full((), jnp.inf, dtype)
    false = jnp.array(False)
    # After a check each path of a batch has its own values of these. JAX would trace the
    # loop a second time if they were not batched from the beginning.
    initial_values = (start, pending, one, inf, false)
    start, pending, one, inf, false = batched_like(initial_values, guess)
    state = _SweepState(
        y=start,
        relaxation=one,
        log2_size=inf,
        is_solved=false,
        pending=pending,
        # These two are the same for all paths, so that loops have one length for all.
        num_done=0,
        num_ahead=first_sweeps,
    )
    state = lax.while_loop(lambda state: state.num_ahead > 0, sweep_and_check, state)
    return value_of(state.y), state.is_solved


def _sweep_until_check(
    image: Map, state: _SweepState, in_halves: bool
) -> tuple[PyTree[Array], Halves]:
    """Makes the sweeps until the next check. Returns the correction by the last of them,
    and the iterate after it."""

    # Each half has an evaluation of its own, from which XLA drops what only the other half
    # needs.
    def new_p(y: Halves) -> PyTree[Array]:
        return image(y).p if in_halves else image(y.q)

    def new_q(y: Halves) -> PyTree[Array]:
        return image(y).q if in_halves else image(y.p)

    def relaxed(new: Array, old: Array) -> Array:
        return old + state.relaxation.astype(new.dtype) * (new - old)

    def sweep(_, y: Halves) -> Halves:
        p = jtu.tree_map(relaxed, new_p(y), y.p)
        # The positions are updated with the new momenta.
        q = jtu.tree_map(relaxed, new_q(Halves(p, y.q)), y.q)
        return Halves(p, q)

    if not in_halves:
        y = lax.fori_loop(0, state.num_ahead, sweep, state.y)
        # The halves may converge to two different solutions of y = \Phi(\Phi(y)), neither
        # of which solves y = \Phi(y). Their difference shows that, so it serves as the
        # correction.
        return (y.q**ω - y.p**ω).ω, y
    # A loop that also carried the previous iterate would copy it in each sweep: steps of 64
    # pairs took 1.1 to 1.4 times as long, although the program was a tenth shorter.
    before_last = lax.fori_loop(0, state.num_ahead - 1, sweep, state.y)
    y = sweep(None, before_last)
    return (y**ω - before_last**ω).ω, y


def _decide(
    state: _SweepState,
    log2_size: Scalar,
    last_log2_size: Scalar,
    size: CorrectionSize,
    first_sweeps: int,
    max_sweeps: int,
) -> tuple[_SweepState, Bool[Array, ""]]:
    """A convergence check: decides from the size of the last correction how a path goes on.

    - If it has converged, it ends as solved.
    - If it converges too slowly to be solved in time, it ends, for Newton's method.
    - If it does not converge, it starts again from its guess with strong under-relaxation,
        or if it did so before, ends, for Newton's method.
    - Otherwise it makes as many sweeps as its rate of convergence asks for.

    Returns the next state, with `None` for the iterate, and whether the path goes back to
    its guess.

    - `log2_size`, `last_log2_size`: the base-2 logarithms of the sizes of the corrections
        at this check and at the one before.
    - `size`: the size of the correction at this check.
    - `first_sweeps`, `max_sweeps`: the number of sweeps before the first check, and the
        most in all.
    """
    # The rate is the factor by which a correction shrinks in one sweep. With logarithms its
    # powers are products.
    log2_rate = (log2_size - last_log2_size) / state.num_ahead
    num_done = state.num_done + state.num_ahead
    has_stalled = log2_rate >= LOG2_STALLED
    has_converged = converged(log2_size, log2_rate, size.is_rounding, has_stalled)
    # Sweeps that do not converge are started again, once, with the strongest relaxation. If
    # those do not converge either, Newton's method takes over.
    starts_again = has_stalled & (state.relaxation > _STRONGEST_RELAXATION)
    rate = jnp.exp2(log2_rate)
    # The relaxation is tuned once, at the first check. The formula does not apply to the
    # rates of relaxed sweeps.
    is_tuned_now = (state.num_done == 0) & (rate > SLOW) & ~has_stalled
    # After so many more sweeps, `log2_size` has come down to `-LOG2_MARGIN`.
    num_needed = (log2_size + LOG2_MARGIN) / jnp.where(
        is_tuned_now, -_LOG2_RELAXED_RATE, -log2_rate
    )
    # A path that would need too many sweeps ends now, so that the batch does not wait.
    in_time = starts_again | (~has_stalled & (num_done + num_needed < max_sweeps))
    pending = state.pending & ~has_converged & in_time & (num_done < max_sweeps)
    # Newton's method begins where the sweeps ended if that is near a solution, and
    # otherwise at the guess.
    keeps_iterate = ~has_stalled & (size.is_small | pending)
    num_ahead = jnp.where(starts_again, first_sweeps, num_needed)
    # Corrections as small as rounding errors show no rate.
    num_ahead = jnp.where(
        size.is_rounding, jnp.minimum(num_ahead, _MOST_AT_ROUNDING), num_ahead
    )
    num_ahead = jnp.ceil(jnp.where(pending, num_ahead, 0)).astype(int)
    relaxation = jnp.where(is_tuned_now, best_relaxation(rate), state.relaxation)
    next_state = _SweepState(
        y=None,
        relaxation=jnp.where(starts_again, _STRONGEST_RELAXATION, relaxation),
        log2_size=jnp.where(starts_again, jnp.inf, log2_size),
        is_solved=jnp.where(state.pending, has_converged, state.is_solved),
        pending=pending,
        num_done=num_done,
        # The path of the batch that needs the most sweeps decides for all.
        num_ahead=jnp.minimum(largest_in_batch(num_ahead), _MOST_BETWEEN_CHECKS),
    )
    return next_state, ~(keeps_iterate | has_converged)


def unknowns_themselves(k: PyTree[Array]) -> PyTree[Array]:
    """The `scale` of corrections if there is no other: the unknowns."""
    return k


def best_relaxation(rate: Scalar) -> Scalar:
    """The relaxation factor for an oscillation whose sweeps converge at this rate."""
    return 2 / (1 + jnp.sqrt(1 + rate))
