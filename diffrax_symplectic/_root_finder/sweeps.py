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
from .tolerance import converged, Correction, log2, MARGIN, Tolerance


Map: TypeAlias = Callable[[PyTree[Array]], PyTree[Array]]

# Sweeps before the first convergence check, in double and single precision, as needed for a
# short step. For a doubled system (y = \Phi(y) as p = \Phi(q), q = \Phi(p)) a sweep
# evaluates everything twice, so fewer suffice.
_FIRST, _FIRST_DOUBLED = (9, 6), (6, 5)
# The most sweeps between two convergence checks: rates near one are not known accurately.
_MOST = 32
# The same when corrections are as small as rounding errors.
_MOST_ROUNDED = 3
# Sweeps with a slower rate of convergence are under-relaxed. Faster ones would gain less
# than one sweep.
_SLOW = 0.3
# The relaxation factor after divergence, which is optimal for a rate of 8.
_STRONGEST = 0.5
# The base-2 logarithm of the rate expected of relaxed sweeps. By the formula the rate is
# 0.17 or better for rates up to one, but only after the first few sweeps.
_RELAXED = -2.0
# The base-2 logarithm of 0.87, the rate above which sweeps count as not converging.
_STALLED = -0.2


class Halves(NamedTuple):
    """Unknowns in two halves, each of which depends mostly on the other, such as momenta
    and positions."""

    p: PyTree[Array]
    q: PyTree[Array]


class _State(NamedTuple):
    """The state of the sweeps at a convergence check.

    - `y`: the iterate.
    - `relaxation`: the relaxation factor.
    - `level`: the base-2 logarithm of the size of the last correction.
    - `solved`: whether it was small enough.
    - `pending`: whether to continue.
    - `done`: the number of sweeps so far, for any path of the batch.
    - `ahead`: the number of sweeps until the next check; zero at the end.
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
    value_of = lambda y: y if in_halves else y.q
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    first = (_FIRST if in_halves else _FIRST_DOUBLED)[jnp.finfo(dtype).bits < 64]

    def step(state: _State) -> _State:
        change, y = _iterate(image, state, in_halves)
        correction = tolerance.measure(change, scale(value_of(y)))
        # The first correction is bounded by the size of the state.
        earlier = jnp.minimum(state.level, log2(correction.bound))
        level = log2(correction.size)
        check = ft.partial(_check, state, level, earlier, correction, first, most)
        # Without `materialize` the result would be recomputed wherever it is used: steps of
        # small systems took 1.3 to 2.8 times as long. The logarithms are inside, so that
        # only one kernel reads them: otherwise ten arrays took 1.1 times as long.
        new, back = materialize(check)
        # All paths of a batch sweep together, but each keeps only its own sweeps.
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
    """The last correction after all sweeps until the next check, and the iterate."""
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
        # The halves may converge to different solutions of y = \Phi(\Phi(y)); only their
        # difference shows that.
        return (y.q**ω - y.p**ω).ω, y
    # A loop that also carried the previous iterate would copy it in each sweep: steps of 64
    # pairs took 1.1 to 1.4 times as long, although the program was a tenth shorter.
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
    """The next state, except for the iterate, and whether to go back to the guess. The
    base-2 logarithms of the last and an earlier correction are `level` and `earlier`."""
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
    # Corrections as small as rounding errors show no rate.
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
