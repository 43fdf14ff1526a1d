"""The iterations that normally solve a step, for all paths of a batch together."""

import functools as ft
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._batch import any_of_batch, batched_together
from .._compat import materialize, ω
from .._custom_types import IntScalarLike
from ._linear import inverse, product
from ._tolerance import converged, largest, Limits, ratio


_Map = Callable[[PyTree[Array]], PyTree[Array]]

# Where a constant has two numbers of iterations, the first is for double precision and the
# second for single precision, in which half as many reach rounding error.
#
# Up to so many unknowns chords follow four or two fixed-point iterations at once: they cost
# no more than a look at the error. The last of these may change the values by at most this
# fraction of what all of them did.
_AT_ONCE, _WARMUP, _SETTLED = 2, (4, 2), 0.5
# Fixed-point iterations before the first look at the error, and between two looks.
_FIRST, _MORE = (11, 7), (4, 2)
# The rate of one iteration is a square root of what so many do, twice or three times: any
# other power takes as long as an iteration of few unknowns. From the first iterate to the
# first look there are ten iterations, or six (five for many unknowns). Taken for eight, or
# four, they show a rate of 0.42, or 0.35, where it is 0.5. The margin of `converged` is
# many times that.
_POWER_FIRST = (8, 4)
# So many more fixed-point iterations cost as much as the Jacobian and its inverse do.
_SLOW = 24
# Above so many unknowns fixed-point iteration is accelerated. For fewer, the arithmetic of
# that costs more than the iterations that it saves.
_MANY = 24
# In single precision few iterations are left once their rate is known: it is accelerated
# where it would take more than these, the first of which come before the look at the rate.
_SLOW_FOR_MANY, _FIRST_OF_MANY = 32, 6
# Pairs of accelerated iterations before the first look at the error, and between two
# looks: more of them where fixed-point iteration would be slower than this rate. The look
# itself is one iteration more.
_FIRST_PAIRS, _PAIRS, _PAIRS_IF_SLOW, _SLOW_RATE = (4, 2), 1, 2, 0.6
# The largest rate of fixed-point iteration that this makes up for: errors then shrink by
# 0.72 in an iteration.
_FASTEST = 3.0
# Chord iterations between two looks at the error, and the most of them.
_CHORDS, _MOST_CHORDS = 2, 20
# A correction below this fraction of the state shows that iteration came near.
_NEAR = 0.1


class Found(NamedTuple):
    """Where iteration ended.

    - `y`: the last iterate.
    - `solved`: whether the next correction would be below the tolerance.
    - `near`: whether `y` is a better first guess than the one that it began with.
    """

    y: PyTree[Array]
    solved: Bool[Array, ""]
    near: Bool[Array, ""]


class _Rounds(NamedTuple):
    """The iterate, the size of its last correction, whether that was small enough, whether
    iteration comes nearer, whether it goes on, how many iterations there were, and the
    size of each leaf of the state."""

    y: PyTree[Array]
    size: Scalar
    solved: Bool[Array, ""]
    near: Bool[Array, ""]
    going: Bool[Array, ""]
    step: IntScalarLike
    scales: list[Scalar]


def sweep(limits: Limits, image: _Map, begin: Found) -> Found:
    r"""From where it `begin`s, solves $y = \Phi(y)$ by $y \leftarrow y + M (\Phi(y) - y)$:
    fixed-point iteration with $M = 1$, and where that is slow, chord iteration with
    $M = (1 - \Phi')^{-1}$, or for many unknowns an accelerated iteration."""
    n, single = sum(x.size for x in jtu.tree_leaves(begin.y)), _is_single(begin.y)
    if n <= min(limits.direct, _AT_ONCE):
        return _by_chords(limits, image, _warmed_up(limits, image, begin))
    if n <= limits.direct:
        most, first, rest = _SLOW, _FIRST[single], _by_chords
    elif n <= _MANY:
        return _by_sweeps(limits, image, begin, limits.steps, _FIRST[single])
    elif single:
        most, first, rest = _SLOW_FOR_MANY, _FIRST_OF_MANY, _by_richardson
    else:
        return _by_richardson(limits, image, begin)
    found = _by_sweeps(limits, image, begin, most, first, leave_together=True)
    others = ft.partial(rest, limits, image)
    return lax.cond(any_of_batch(~found.solved), others, lambda found: found, found)


def sweep_blocks(
    limits: Limits,
    blocks: Sequence[Callable[[list[PyTree[Array]]], _Map]],
    begin: Found,
) -> Found:
    """The same for equations in blocks, of which each reads those before it. For each there
    is a function that makes its `image` from the values of all."""
    solved = near = jnp.array(True)
    y = list(begin.y)
    for i, block in enumerate(blocks):
        if len(y[i]) == 0:
            continue
        own = lambda k, i=i: limits.scale([*y[:i], k, *y[i + 1 :]])[i]
        found = sweep(limits._replace(scale=own), block(y), begin._replace(y=y[i]))
        y[i] = found.y
        solved, near = solved & found.solved, near & (found.solved | found.near)
    return Found(y, solved, near)


def _rounds(
    advance: Callable[[_Rounds], _Rounds], first: _Rounds, leave_together: bool = False
) -> Found:
    """Rounds until every path of the batch is solved or has left; or until the first leaves
    unsolved, where what follows costs the same for one path as for all."""

    def body(last: _Rounds) -> _Rounds:
        new = advance(last)
        # The rounds of all paths of a batch are the same, but each path has only its own.
        kept = lambda x: (x.y, x.solved, x.near)
        select = lambda a, b: jnp.where(last.going, a, b)
        y, solved, near = jtu.tree_map(select, kept(new), kept(last))
        going = last.going & new.going
        return new._replace(y=y, solved=solved, near=near, going=going)

    def proceed(rounds: _Rounds) -> Bool[Array, ""]:
        go = any_of_batch(rounds.going)
        left = ~rounds.going & ~rounds.solved
        return go & ~any_of_batch(left) if leave_together else go

    # All but the number of iterations, which all paths have in common.
    first = batched_together(first._replace(step=()))._replace(step=first.step)
    last = lax.while_loop(proceed, body, first)
    return Found(last.y, last.solved, last.near)


def _judged(
    limits: Limits,
    rounds: _Rounds,
    change: PyTree[Array],
    earlier: Scalar,
    root: _Map,
    most: int,
    halt: Scalar | float = 0.5,
) -> _Rounds:
    """What follows from the last `change` of `rounds`. The `root` of how much it has
    shrunk, since the one of the size `earlier`, is the rate of one iteration, of which
    there may be `most`. It has stalled if it is not below `halt` of that."""
    size, below = limits.compare(change, rounds.scales)
    shrink = root(ratio(size, earlier))
    # If an entry is NaN, the size is, and all of these are false.
    stalled, shrinks = size >= halt * earlier, size < halt * earlier
    solved = converged(size, below, shrink, stalled)
    near = below(_NEAR) & shrinks
    going = near & ~solved & (rounds.step < limits.steps) & (size * shrink**most <= 1)
    return rounds._replace(size=size, solved=solved, near=near, going=going)


def _first(limits: Limits, begin: Found, y: PyTree[Array]) -> _Rounds:
    """Before the first round."""
    scales = jtu.tree_map(jnp.zeros_like, limits.scales(begin.y))
    size = jnp.zeros((), jnp.result_type(*scales))
    return _Rounds(y, size, begin.solved, begin.near, ~begin.solved, 0, scales)


def _begun(limits: Limits, y: PyTree[Array]) -> tuple[Scalar, list[Scalar]]:
    """The size of the first change, and that of the state, known after the first round."""
    # The first iteration changed the values from zero to nearly what they are now. Nor
    # does the size of the state change much where iteration goes on.
    scales = limits.scales(y)
    return limits.compare(y, scales)[0], scales


def _by_sweeps(
    limits: Limits,
    image: _Map,
    begin: Found,
    most: int,
    num_first: int,
    leave_together: bool = False,
) -> Found:
    """Fixed-point iteration, as long as `most` further ones would do."""
    single = _is_single(begin.y)
    powers = _POWER_FIRST[single], _MORE[single]
    # The same rate in either precision: a slower one has not stalled in fewer iterations.
    halt = 0.5 ** (_MORE[single] / _MORE[0])

    def advance(rounds: _Rounds) -> _Rounds:
        first = rounds.step == 0
        count = jnp.where(first, num_first, _MORE[single])
        before, y = _fixed_point(image, rounds.y, count)
        # To measure these in every round would take a quarter of its time.
        last = lambda: (rounds.size, rounds.scales)
        earlier, scales = lax.cond(first, lambda: _begun(limits, y), last)
        change = (y**ω - before**ω).ω
        root = lambda x: jnp.where(first, *(_root(x, power) for power in powers))
        new = rounds._replace(y=y, step=rounds.step + count, scales=scales)
        return _judged(limits, new, change, earlier, root, most, halt)

    return _rounds(advance, _first(limits, begin, begin.y), leave_together)


def _by_richardson(limits: Limits, image: _Map, begin: Found) -> Found:
    r"""Solves $y = \Phi(y)$ by $y_{m+1} = y_{m-1} + w (\Phi(y_m) - y_{m-1})$.

    Where a Hamiltonian system oscillates, the eigenvalues of $\Phi'$ for the midpoint rule
    are imaginary, $\pm ib$ with $b \le a$. With $w = 2 / (1 + \sqrt{1 + a^2})$ errors
    shrink by $\sqrt{1 - w} = a / (1 + \sqrt{1 + a^2})$ in an iteration, where those of
    fixed-point iteration ($w = 1$) shrink by $a$, or grow. The first round is fixed-point
    iteration and shows $a$, and the second corrects it. Real eigenvalues are no obstacle,
    but errors then shrink more slowly than by $a$.

    This is the "second order Richardson" method of Golub and Varga (Numerische Mathematik
    3, 1961, 147-156), for imaginary eigenvalues.
    """
    num_first = _FIRST_PAIRS[_is_single(begin.y)]

    def advance(rounds: _Rounds) -> _Rounds:
        first, (before, y, a, begins) = rounds.step == 0, rounds.y
        weight, slow = _weight(a), any_of_batch(rounds.going & (a > _SLOW_RATE))
        pairs = jnp.where(slow, _PAIRS_IF_SLOW, _PAIRS)
        pairs = jnp.where(first, num_first, pairs)

        def pair(_, ys):
            # Two iterations, each of which overwrites the older values.
            before, y = ys
            before = _toward(before, image(y), weight)
            return before, _toward(y, image(before), weight)

        before, y = lax.fori_loop(0, pairs, pair, (before, y))
        # It is read several times.
        end = materialize(lambda: image(y))

        def decided():
            # On its way back from where iteration led away, the state's size changes much.
            whole, scales = _begun(limits, end)
            earlier = jnp.where(begins, whole, rounds.size)
            root = lambda x: x ** (1 / (2 * pairs + jnp.where(first, 0, 1)))
            step, change = rounds.step + 2 * pairs + 1, (end**ω - y**ω).ω
            # Fast oscillations shrink unevenly from round to round.
            halt = jnp.where(a > 1, 0.9, 0.5)
            new = rounds._replace(y=(), step=step, scales=scales)
            new = _judged(limits, new, change, earlier, root, 0, halt)

            rate, damped = root(ratio(new.size, earlier)), 1 - weight
            # Where iteration leads away, it begins once more at zero, with the new weight.
            anew = ~(new.size < earlier)
            # If an entry is NaN, so is the rate, and all of these are true.
            wrong = ~(rate**2 <= damped) & (anew | (rounds.step <= 2 * num_first + 1))
            other = jnp.where(wrong, (rate + damped / rate) / weight, a)
            lost = anew & ~(other <= _FASTEST)
            going = ~new.solved & ~lost & (step < limits.steps)
            return new._replace(going=going), other, _weight(other), anew

        # It decides over every array of the state.
        new, a, weight, anew = materialize(decided)
        ahead = _toward(before, end, weight)
        pick = lambda x, y: jnp.where(new.solved, x, jnp.where(anew, 0, y))
        before = jtu.tree_map(lambda y: jnp.where(anew, 0, y), y)
        y = before, jtu.tree_map(pick, end, ahead), a, anew
        return new._replace(y=y)

    from_here = begin.solved | begin.near
    y = jtu.tree_map(lambda y: jnp.where(from_here, y, 0), begin.y)
    first = _first(limits, begin, ())
    found = _rounds(advance, first._replace(y=(y, y, first.size, jnp.array(True))))
    return found._replace(y=found.y[1])


def _weight(a: Scalar) -> Scalar:
    return 2 / (1 + jnp.sqrt(1 + a**2))


def _toward(a: PyTree[Array], b: PyTree[Array], weight: Scalar) -> PyTree[Array]:
    return jtu.tree_map(lambda a, b: a + weight.astype(a.dtype) * (b - a), a, b)


def _warmed_up(limits: Limits, image: _Map, begin: Found) -> Found:
    """After a few fixed-point iterations; or where these go away from the solution, as it
    was before."""
    y, sizes = begin.y, limits.sizes
    before, swept = _fixed_point(image, y, _WARMUP[_is_single(y)])
    last, whole = sizes((swept**ω - before**ω).ω), sizes((swept**ω - y**ω).ω)
    settled = largest(last) < _SETTLED * largest(whole)
    y = jtu.tree_map(lambda a, b: jnp.where(settled, a, b), swept, y)
    return begin._replace(y=y)


def _by_chords(limits: Limits, image: _Map, begin: Found) -> Found:
    """From where iteration `begin`s, for paths that are not yet solved.

    All of it is written out in scalars. Of arrays with two or three entries for each path
    XLA makes slow loops: with these a step of one oscillator takes a fifth longer.
    """

    def restore(scalars: list[Scalar]) -> PyTree[Array]:
        rest = iter(scalars)
        leaf = lambda x: jnp.stack([next(rest) for _ in range(x.size)]).reshape(x.shape)
        return jtu.tree_map(leaf, begin.y)

    ravel = lambda y: [x for leaf in jtu.tree_leaves(y) for x in jnp.ravel(leaf)]
    rhs = lambda k: ravel(image(restore(k)))
    k = [jnp.where(begin.solved | begin.near, x, 0) for x in ravel(begin.y)]
    value, jacobian = jax.linearize(rhs, k)
    one = np.eye(len(k), dtype=k[0].dtype)
    columns = [(list(unit) ** ω - jacobian(list(unit)) ** ω).ω for unit in one]
    M = inverse([list(row) for row in zip(*columns)])
    diff = product(M, (value**ω - k**ω).ω)
    moved = [jnp.where(begin.solved, x, x + y) for x, y in zip(k, diff)]
    chord = lambda k: (k**ω + product(M, (rhs(k) ** ω - k**ω).ω) ** ω).ω

    def advance(rounds: _Rounds) -> _Rounds:
        before, k = _fixed_point(chord, rounds.y, _CHORDS)
        scales, change = limits.scales(restore(k)), restore((k**ω - before**ω).ω)
        new = rounds._replace(y=k, step=rounds.step + _CHORDS, scales=scales)
        root = lambda x: _root(x, _CHORDS)
        return _judged(limits, new, change, rounds.size, root, _MOST_CHORDS)

    scales = limits.scales(restore(moved))
    size, _ = limits.compare(restore(diff), scales)
    first = _first(limits, begin, moved)._replace(size=size, scales=scales)
    found = _rounds(advance, first)
    return found._replace(y=restore(found.y))


def _is_single(y: PyTree[Array]) -> bool:
    return jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).bits < 64


def _root(x: Scalar, power: int) -> Scalar:
    """For powers of two."""
    return x if power == 1 else _root(jnp.sqrt(x), power // 2)


def _fixed_point(
    image: _Map, y: PyTree[Array], times: IntScalarLike
) -> tuple[PyTree[Array], PyTree[Array]]:
    """The last two iterates. XLA makes faster code of a loop than of iterations written
    out."""
    return lax.fori_loop(0, times, lambda _, ys: (ys[1], image(ys[1])), (y, y))
