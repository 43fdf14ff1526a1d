"""Sweeps, the iteration that normally solves a step, for all paths of a batch together."""

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
from ._tolerance import converged, Correction, log2, MARGIN, Tolerance


Map: TypeAlias = Callable[[PyTree[Array]], PyTree[Array]]

# Sweeps before the first convergence check, in double and in single precision: those that a
# short step needs. A sweep of a doubled system, y = \Phi(y) as p = \Phi(q), q = \Phi(p),
# evaluates everything twice: fewer will do.
_FIRST, _FIRST_DOUBLED = (9, 6), (6, 5)
# The most sweeps between two convergence checks. A rate near one is not known well.
_MOST = 32
# The same where corrections are as small as rounding errors.
_MOST_ROUNDED = 3
# Above this rate of convergence sweeps are relaxed. Below, that saves less than a sweep.
_SLOW = 0.3
# The relaxation factor where sweeps diverged. It is the best for a rate of 8.
_STRONGEST = 0.5
# The logarithm of the rate that is expected of relaxed sweeps. By the formula it is 0.17 or
# better for rates up to one, but later than in the first few sweeps.
_RELAXED = -2.0
# The logarithm of the rate of 0.87, above which sweeps are not taken to converge.
_STALLED = -0.2


class Halves(NamedTuple):
    """Unknowns of which each half changes mostly with the other one, such as momenta and
    positions."""

    p: PyTree[Array]
    q: PyTree[Array]


class _State(NamedTuple):
    """Where sweeps stand at a convergence check.

    - `y`: the iterate.
    - `relaxation`: the fraction of its change that a value takes in a sweep.
    - `level`: the logarithm of the size of the last correction.
    - `solved`: whether that was small enough.
    - `pending`: whether sweeps go on.
    - `done`: how many there were, for any path of the batch.
    - `ahead`: how many there are until the next check; zero at the end.
    """

    y: Halves | None
    relaxation: Scalar
    level: Scalar
    solved: Bool[Array, ""]
    pending: Bool[Array, ""]
    done: IntScalarLike
    ahead: IntScalarLike


def sweep(
    tolerance: Tolerance,
    most: int,
    image: Map,
    scale: Map,
    guess: PyTree[Array],
    pending: Bool[Array, ""],
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    r"""Solves $y = \Phi(y)$ from a `guess` for all paths of a batch that are `pending`,
    until each is solved or does not converge, by at most so many sweeps. Returns what was
    found, and whether that is a solution. Where sweeps diverged it is the guess.

    In a sweep $q$ reads the new $p$ (Gauss--Seidel). Where a Hamiltonian system oscillates,
    the error after that is the one after two evaluations of both, for the price of one
    where $H = T(p) + V(q)$. Unknowns that are no `Halves` are iterated as a doubled system.

    Each convergence check shows the rate at which corrections shrink, and from that, how
    many sweeps the slowest path needs before the next check. For an oscillation the rate
    $a$ is that of an eigenvalue $-a$: then sweeps with the relaxation factor $2 / (1 +
    \sqrt{1 + a})$ converge at the rate of one minus that (D. M. Young, Transactions of the
    American Mathematical Society 76, 1954, 92-111; for doubled systems G. H. Golub and
    R. S. Varga, Numerische Mathematik 3, 1961, 147-156). Where sweeps diverged, they begin
    once more, relaxed like this.
    """
    in_halves = isinstance(guess, Halves)
    start = guess if in_halves else Halves(guess, guess)
    value_of = lambda y: y if in_halves else y.q
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    first = (_FIRST if in_halves else _FIRST_DOUBLED)[jnp.finfo(dtype).bits < 64]

    def step(state: _State) -> _State:
        change, y = _iterate(image, state, in_halves)
        correction = tolerance.measure(change, scale(value_of(y)))
        # The first of the sweeps changed the values by no more than the state is.
        earlier = jnp.minimum(state.level, log2(correction.bound))
        level = log2(correction.size)
        check = ft.partial(_check, state, level, earlier, correction, first, most)
        # What follows reads it several times, and would compute it as often: steps of small
        # systems took 1.3 to 2.8 times as long. So would the logarithms if more than one
        # kernel read them: 1.1 times for ten arrays.
        new, back = materialize(check)
        # The sweeps of all paths of a batch are the same, but each path has only its own.
        restart = lambda y, start: jnp.where(back, start, y)
        own = lambda y, start, old: jnp.where(state.pending, restart(y, start), old)
        return new._replace(y=jtu.tree_map(own, y, start, state.y))

    one, inf, no = jnp.ones((), dtype), jnp.full((), jnp.inf, dtype), jnp.array(False)
    start, pending, one, inf, no = batched_like((start, pending, one, inf, no), guess)
    state = _State(start, one, inf, no, pending, done=0, ahead=first)
    state = lax.while_loop(lambda state: state.ahead > 0, step, state)
    return value_of(state.y), state.solved


def _iterate(
    image: Map, state: _State, in_halves: bool
) -> tuple[PyTree[Array], Halves]:
    """How far the halves are from a solution after all sweeps until the next check, and
    these halves."""
    p_of = lambda y: image(y).p if in_halves else image(y.q)
    q_of = lambda y: image(y).q if in_halves else image(y.p)

    def relaxed(new: PyTree[Array], old: PyTree[Array]) -> PyTree[Array]:
        omega = lambda x: state.relaxation.astype(x.dtype)
        return jtu.tree_map(lambda x, y: y + omega(x) * (x - y), new, old)

    def once(_, y: Halves) -> Halves:
        y = Halves(relaxed(p_of(y), y.p), y.q)
        return Halves(y.p, relaxed(q_of(y), y.q))

    if not in_halves:
        y = lax.fori_loop(0, state.ahead, once, state.y)
        # Where both solve y = \Phi(\Phi(y)), only their difference shows it.
        return (y.q**ω - y.p**ω).ω, y
    # A loop that also kept the iterate before would copy it in each sweep: steps of 64
    # pairs took 1.1 to 1.4 times as long, though the program was a tenth shorter.
    before = lax.fori_loop(0, state.ahead - 1, once, state.y)
    y = once(None, before)
    return (y**ω - before**ω).ω, y


def _check(
    state: _State,
    level: Scalar,
    earlier: Scalar,
    last: Correction,
    first: int,
    most: int,
) -> tuple[_State, Bool[Array, ""]]:
    """What the last correction says of convergence, for all but the iterate, and whether
    that goes back to the guess. The logarithm of its size is `level`, and was `earlier`."""
    rate, done = (level - earlier) / state.ahead, state.done + state.ahead
    stalled = rate >= _STALLED
    solved = converged(level, rate, last.rounded, stalled)
    again = stalled & (state.relaxation > _STRONGEST)
    a = jnp.exp2(rate)
    tuned = (state.done == 0) & (a > _SLOW) & ~stalled
    further = (level + MARGIN) / jnp.where(tuned, -_RELAXED, -rate)
    in_time = again | (~stalled & (done + further < most))
    pending = state.pending & ~solved & in_time & (done < most)
    near = ~stalled & (last.small | pending)
    count = jnp.where(again, first, further)
    # What is as small as rounding errors shows no rate.
    count = jnp.where(last.rounded, jnp.minimum(count, _MOST_ROUNDED), count)
    count = jnp.ceil(jnp.where(pending, count, 0)).astype(int)
    relaxation = jnp.where(tuned, 2 / (1 + jnp.sqrt(1 + a)), state.relaxation)
    new = _State(
        y=None,
        relaxation=jnp.where(again, _STRONGEST, relaxation),
        level=jnp.where(again, jnp.inf, level),
        solved=jnp.where(state.pending, solved, state.solved),
        pending=pending,
        done=done,
        ahead=jnp.minimum(most_of_batch(count), _MOST),
    )
    return new, ~(near | solved)
