"""Sweeps: the iteration that usually solves a step, for all paths of a batch together."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._batch import batched_like, materialize, most_of_batch
from .._compat import ω
from .._custom_types import IntScalarLike
from .tolerance import converged, CorrectionSize, log2, MARGIN, Tolerance


Map: TypeAlias = Callable[[PyTree[Array]], PyTree[Array]]

# Sweeps before the first convergence check, as needed for a short step, whose error shrinks
# by a factor of about 60 in each: 60^9 is 1e16, for the digits of double precision, and
# 60^6 is beyond the 1e8 of single precision.
_FIRST_IN_DOUBLE = 9
_FIRST_IN_SINGLE = 6
# The same for a doubled system (y = \Phi(y) as p = \Phi(q), q = \Phi(p)), where fewer
# sweeps suffice, since each evaluates everything twice.
_FIRST_DOUBLED_IN_DOUBLE = 6
_FIRST_DOUBLED_IN_SINGLE = 5
# The most sweeps between two convergence checks: rates near one are not known accurately.
_MOST_BETWEEN_CHECKS = 32
# The most sweeps until the next check when corrections are as small as rounding errors.
_MOST_ROUNDED = 3
# Sweeps with a slower rate of convergence are under-relaxed. Faster ones would gain less
# than one sweep.
SLOW = 0.3
# The relaxation factor after divergence, which is optimal for a rate of 8:
# 2 / (1 + sqrt(1 + 8)).
_STRONGEST = 0.5
# The base-2 logarithm of the rate expected of relaxed sweeps, a quarter. By Young's formula
# the rate is 0.17 or better for rates up to one, but only after the first few sweeps.
_RELAXED = -2.0
# The base-2 logarithm of 0.87, the rate above which sweeps count as not converging.
STALLED = -0.2


class Halves(NamedTuple):
    """Unknowns in two halves, each of which depends mostly on the other, such as momenta
    and positions."""

    p: PyTree[Array]
    q: PyTree[Array]


class _SweepState(NamedTuple):
    """The state of the sweeps at a convergence check.

    - `y`: the iterate.
    - `relaxation`: the relaxation factor.
    - `level`: the base-2 logarithm of the size of the last correction.
    - `is_solved`: whether it was small enough.
    - `pending`: whether to continue.
    - `done`: the number of sweeps so far, shared by all paths of the batch.
    - `ahead`: the number of sweeps until the next check, shared by them; zero at the end.
    """

    y: Halves | None
    relaxation: Scalar
    level: Scalar
    is_solved: Bool[Array, ""]
    pending: Bool[Array, ""]
    done: IntScalarLike
    ahead: IntScalarLike


class _AfterSweeps(NamedTuple):
    """The result of the sweeps between two checks.

    - `change`: the last correction.
    - `y`: the iterate.
    """

    change: PyTree[Array]
    y: Halves


class _Decision(NamedTuple):
    """The decision at a convergence check.

    - `state`: the next state, except for the iterate.
    - `back`: whether to go back to the guess.
    """

    state: _SweepState
    back: Bool[Array, ""]


def solve_by_sweeps(
    tolerance: Tolerance,
    most: int,
    image: Map,
    scale: Map,
    guess: PyTree[Array],
    pending: Bool[Array, ""],
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    r"""Solves $y = \Phi(y)$ from a `guess` for all `pending` paths of a batch, with at most
    `most` sweeps, until each path has converged or is seen not to converge. Returns the
    iterate (the guess if sweeps diverged), and whether it is a solution.

    In a sweep $q$ is updated with the new $p$ (Gauss--Seidel). For an oscillating
    Hamiltonian system this reduces the error as much as two evaluations of both halves, for
    the cost of one if $H = T(p) + V(q)$. Unknowns other than `Halves` are iterated by
    Gauss--Seidel on the doubled system.

    Each convergence check measures the rate at which corrections shrink, and from it the
    number of sweeps that the slowest path needs before the next check. For an oscillation a
    rate $a$ belongs to an eigenvalue $-a$. With the relaxation factor $\omega = 2 / (1 +
    \sqrt{1 + a})$ sweeps then converge at the rate $1 - \omega$ (D. M. Young, Transactions
    of the American Mathematical Society 76, 1954, 92-111; for doubled systems G. H. Golub
    and R. S. Varga, Numerische Mathematik 3, 1961, 147-156). Sweeps that diverged are
    started again with strong under-relaxation.
    """
    in_halves = isinstance(guess, Halves)
    start = guess if in_halves else Halves(guess, guess)
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    first = _first_sweeps(dtype, in_halves)

    # The halves of a doubled system agree in the end.
    def value_of(y: PyTree[Array]) -> PyTree[Array]:
        return y if in_halves else y.q

    def sweep_and_check(state: _SweepState) -> _SweepState:
        change, y = _sweep_until_check(image, state, in_halves)
        correction = tolerance.measure(change, scale(value_of(y)))
        # The first correction is bounded by the size of the state.
        earlier = jnp.minimum(state.level, log2(correction.bound))
        level = log2(correction.size)
        check = ft.partial(_check, state, level, earlier, correction, first, most)
        # Without `materialize` the result would be recomputed wherever it is used: steps of
        # small systems took 1.3 to 2.8 times as long. The logarithms are inside, so that
        # only one kernel reads them: otherwise ten arrays took 1.1 times as long.
        new, back = materialize(check)

        # All paths of a batch sweep together, but a path that has ended stays where it was.
        def next_iterate(y: Array, start: Array, old: Array) -> Array:
            return jnp.where(state.pending, jnp.where(back, start, y), old)

        return new._replace(y=jtu.tree_map(next_iterate, y, start, state.y))

    one = jnp.ones((), dtype)
    inf = jnp.full((), jnp.inf, dtype)
    no = jnp.array(False)
    # The check batches these values in any case. If they were not batched here, JAX would
    # trace the loop again to find that out.
    start, pending, one, inf, no = batched_like((start, pending, one, inf, no), guess)
    state = _SweepState(
        y=start,
        relaxation=one,
        level=inf,
        is_solved=no,
        pending=pending,
        # The batch shares the counts, so that the loops keep unbatched lengths.
        done=0,
        ahead=first,
    )
    state = lax.while_loop(lambda state: state.ahead > 0, sweep_and_check, state)
    return value_of(state.y), state.is_solved


def _first_sweeps(dtype, in_halves: bool) -> int:
    """The number of sweeps before the first convergence check, for unknowns of this dtype,
    in halves or as a doubled system."""
    if jnp.finfo(dtype).bits < 64:
        return _FIRST_IN_SINGLE if in_halves else _FIRST_DOUBLED_IN_SINGLE
    return _FIRST_IN_DOUBLE if in_halves else _FIRST_DOUBLED_IN_DOUBLE


def _sweep_until_check(image: Map, state: _SweepState, in_halves: bool) -> _AfterSweeps:
    """The iterate after all sweeps until the next check, and the last correction."""

    # Each half is taken from an evaluation of its own. XLA drops what an evaluation
    # computes for the other half.
    def new_p(y: Halves) -> PyTree[Array]:
        return image(y).p if in_halves else image(y.q)

    def new_q(y: Halves) -> PyTree[Array]:
        return image(y).q if in_halves else image(y.p)

    def relaxed(new: PyTree[Array], old: PyTree[Array]) -> PyTree[Array]:
        def relaxed_leaf(new: Array, old: Array) -> Array:
            return old + state.relaxation.astype(new.dtype) * (new - old)

        return jtu.tree_map(relaxed_leaf, new, old)

    def sweep(_, y: Halves) -> Halves:
        # The positions are updated with the new momenta.
        y = Halves(relaxed(new_p(y), y.p), y.q)
        return Halves(y.p, relaxed(new_q(y), y.q))

    if not in_halves:
        y = lax.fori_loop(0, state.ahead, sweep, state.y)
        # The halves may converge to different solutions of y = \Phi(\Phi(y)). Only their
        # difference shows that, so it serves as the correction.
        return _AfterSweeps((y.q**ω - y.p**ω).ω, y)
    # A loop that also carried the previous iterate would copy it in each sweep: steps of 64
    # pairs took 1.1 to 1.4 times as long, although the program was a tenth shorter.
    before = lax.fori_loop(0, state.ahead - 1, sweep, state.y)
    y = sweep(None, before)
    return _AfterSweeps((y**ω - before**ω).ω, y)


def _check(
    state: _SweepState,
    level: Scalar,
    earlier: Scalar,
    last: CorrectionSize,
    first: int,
    most: int,
) -> _Decision:
    """What to do next. The base-2 logarithms of the `last` and an earlier correction are
    `level` and `earlier`. `first` is the number of sweeps before the first check, and
    `most` the most in all."""
    # The rate is a base-2 logarithm, so that the number of further sweeps is a quotient.
    rate = (level - earlier) / state.ahead
    done = state.done + state.ahead
    stalled = rate >= STALLED
    is_solved = converged(level, rate, last.rounded, stalled)
    # Sweeps that diverged get one more try. If it stalls, Newton's method takes over.
    again = stalled & (state.relaxation > _STRONGEST)
    ratio = jnp.exp2(rate)
    # The relaxation is tuned once, at the first check: later rates are those of relaxed
    # sweeps, to which the formula does not apply.
    tuned = (state.done == 0) & (ratio > SLOW) & ~stalled
    # After so many sweeps the level is at `-MARGIN`.
    further = (level + MARGIN) / jnp.where(tuned, -_RELAXED, -rate)
    # Sweeps that would not end in time end now, before they cost anything.
    in_time = again | (~stalled & (done + further < most))
    pending = state.pending & ~is_solved & in_time & (done < most)
    # Newton's method begins where the sweeps ended if that is near a solution, or else at
    # the guess.
    near = ~stalled & (last.small | pending)
    count = jnp.where(again, first, further)
    # Corrections as small as rounding errors show no rate.
    count = jnp.where(last.rounded, jnp.minimum(count, _MOST_ROUNDED), count)
    count = jnp.ceil(jnp.where(pending, count, 0)).astype(int)
    relaxation = jnp.where(tuned, best_relaxation(ratio), state.relaxation)
    new = _SweepState(
        y=None,
        relaxation=jnp.where(again, _STRONGEST, relaxation),
        level=jnp.where(again, jnp.inf, level),
        is_solved=jnp.where(state.pending, is_solved, state.is_solved),
        pending=pending,
        done=done,
        ahead=jnp.minimum(most_of_batch(count), _MOST_BETWEEN_CHECKS),
    )
    return _Decision(new, ~(near | is_solved))


def best_relaxation(rate: Scalar) -> Scalar:
    """The relaxation factor for an oscillation whose sweeps converge at this rate."""
    return 2 / (1 + jnp.sqrt(1 + rate))
