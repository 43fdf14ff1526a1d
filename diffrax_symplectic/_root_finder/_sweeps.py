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

from .._compat import materialize, ω
from .._custom_types import IntScalarLike, RealScalarLike
from ._batch import any_of_batch
from ._linear import inverse, product
from ._tolerance import converged, largest, ratio, Tolerance


_Map = Callable[[PyTree[Array]], PyTree[Array]]

# The numbers of iterations between two looks at the error are for double precision. In
# single precision half as many reach rounding error, unless another number is given.
# Up to so many unknowns chords follow at once: they cost no more than a look at the error.
_AT_ONCE = 2
# Fixed-point iterations before these, and by how much the last of them may change the
# values, as a fraction of what all of them did.
_WARMUP, _SETTLED = 4, 0.5
# Fixed-point iterations before the first look at the error, and between two looks, in
# double and in single precision.
_FIRST, _MORE = (11, 7), (4, 2)
# The rate of one iteration is a square root of what so many do, twice or three times: any
# other power takes as long as an iteration of few unknowns. From the first iterate to the
# first look there are ten iterations, or six. Taken for eight, or four, they show too large
# a rate, which is on the safe side.
_POWER_FIRST, _POWER_MORE = (8, 4), _MORE
# So many more fixed-point iterations cost as much as the Jacobian and its inverse do.
_SLOW = 24
# Above so many unknowns fixed-point iteration is accelerated. For fewer, the arithmetic of
# that costs more than the iterations that it saves.
_MANY = 24
# In single precision few iterations are left once their rate is known: it is accelerated
# where it would take more than these, the first of which come before the look at the rate.
_SLOW_FOR_MANY, _FIRST_OF_MANY = 32, 5
# Pairs of accelerated iterations before the first look at the error, and between two
# looks: more of them where fixed-point iteration would be slower than this rate. The look
# itself is one iteration more.
_FIRST_PAIRS, _PAIRS, _PAIRS_IF_SLOW, _SLOW_RATE = 4, 1, 2, 0.6
# The largest rate of fixed-point iteration that this makes up for: errors then shrink by
# 0.72 in an iteration.
_FASTEST = 3.0
# Chord iterations between two looks at the error, as above, and the most of them.
_CHORDS, _MOST_CHORDS = 2, 20
# A correction below this fraction of the state shows that iteration came near.
_NEAR = 0.1


class Limits(NamedTuple):
    """When iteration ends.

    - `tolerance`: for the next correction.
    - `steps`: the most fixed-point iterations.
    - `direct`: the most unknowns for chord iterations.
    """

    tolerance: Tolerance
    steps: int
    direct: int


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


class _Look(NamedTuple):
    """A look at what iteration made of its values."""

    limits: Limits
    scale: _Map
    most: int
    restore: _Map = lambda y: y

    def scales(self, y: PyTree[Array]) -> list[Scalar]:
        return self.limits.tolerance.sizes(self.scale(self.restore(y)))

    def size(
        self, change: PyTree[Array], scales: list[Scalar]
    ) -> tuple[Scalar, Callable[[float], Bool[Array, ""]]]:
        """The size of a change in units of the tolerance, and whether it is below a
        fraction of the state."""
        tolerance = self.limits.tolerance
        return tolerance.compare(tolerance.sizes(self.restore(change)), scales)

    def at(
        self,
        y: PyTree[Array],
        change: PyTree[Array],
        earlier: Scalar,
        scales: list[Scalar],
        root: _Map,
        step: IntScalarLike,
        halt: RealScalarLike = 0.5,
    ) -> _Rounds:
        """After an iteration that was a `change`. The `root` of how much it has shrunk,
        since the one of the size `earlier`, is the rate of one iteration. It has stalled
        if it is not below `halt` of that."""
        size, below = self.size(change, scales)
        shrink = root(ratio(size, earlier))
        # If an entry is NaN, the size is, and all of these are false.
        stalled, shrinks = size >= halt * earlier, size < halt * earlier
        solved = converged(size, below, shrink, stalled)
        near = below(_NEAR) & shrinks
        following = size * shrink**self.most
        going = ~solved & near & (step < self.limits.steps) & (following <= 1)
        return _Rounds(y, size, solved, near, going, step, scales)


def _while_any(
    advance: Callable[[_Rounds], _Rounds], first: _Rounds, leave_together: bool = False
) -> Found:
    """Rounds until every path of the batch is solved or has left; or until the first leaves
    unsolved, where what follows costs the same for one path as for all."""

    def body(last: _Rounds) -> _Rounds:
        new = advance(last)
        # The rounds of all paths of a batch are the same, but each path has only its own.
        y, solved, near = jtu.tree_map(
            lambda a, b: jnp.where(last.going, a, b),
            new[:1] + new[2:4],
            last[:1] + last[2:4],
        )
        going = last.going & new.going
        return _Rounds(y, new.size, solved, near, going, new.step, new.scales)

    def proceed(rounds: _Rounds) -> Bool[Array, ""]:
        go = any_of_batch(rounds.going)
        if not leave_together:
            return go
        return go & ~any_of_batch(~rounds.going & ~rounds.solved)

    last = lax.while_loop(proceed, body, first)
    return Found(last.y, last.solved, last.near)


def sweep(limits: Limits, image: _Map, begin: Found, scale: _Map) -> Found:
    r"""From where it `begin`s, solves $y = \Phi(y)$ by $y \leftarrow y + M (\Phi(y) - y)$:
    fixed-point iteration with $M = 1$, and where that is slow, chord iteration with
    $M = (1 - \Phi')^{-1}$, or for many unknowns an accelerated iteration."""
    y = begin.y
    n = sum(x.size for x in jtu.tree_leaves(y))
    direct = n <= limits.direct
    if direct and n <= _AT_ONCE:
        # Not even a look at the error pays.
        before, swept = _fixed_point(image, y, _paced(_WARMUP, y))
        # Where these go away from the solution, Newton's method begins at the guess.
        sizes = limits.tolerance.sizes
        last, whole = sizes((swept**ω - before**ω).ω), sizes((swept**ω - y**ω).ω)
        settled = largest(last) < _SETTLED * largest(whole)
        y = jtu.tree_map(lambda a, b: jnp.where(settled, a, b), swept, y)
        return _by_chords(limits, image, scale, begin._replace(y=y))
    most, first, rest = limits.steps, _FIRST[_is_single(y)], None
    if direct:
        most, rest = _SLOW, ft.partial(_by_chords, limits, image, scale)
    elif n > _MANY:
        rest = ft.partial(_by_richardson, _Look(limits, scale, limits.steps), image)
        if not _is_single(y):
            return rest(begin)
        most, first = _SLOW_FOR_MANY, _FIRST_OF_MANY
    look = _Look(limits, scale, most)
    found = _by_sweeps(look, image, begin, first, leave_together=rest is not None)
    if rest is None:
        return found
    return lax.cond(any_of_batch(~found.solved), rest, lambda found: found, found)


def _paced(times: int, y: PyTree[Array]) -> int:
    """How many of these iterations the precision of `y` takes."""
    return times // 2 if _is_single(y) else times


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


def sweep_blocks(
    limits: Limits,
    blocks: Sequence[Callable[[list[PyTree[Array]]], _Map]],
    begin: Found,
    scale: _Map,
) -> Found:
    """The same for equations in blocks, of which each reads those before it. For each there
    is a function that makes its `image` from the values of all."""
    solved = near = jnp.array(True)
    y = list(begin.y)
    for i, block in enumerate(blocks):
        if len(y[i]) == 0:
            continue
        own = lambda k, i=i: scale([*y[:i], k, *y[i + 1 :]])[i]
        found = sweep(limits, block(y), begin._replace(y=y[i]), own)
        y[i] = found.y
        solved, near = solved & found.solved, near & (found.solved | found.near)
    return Found(y, solved, near)


def _by_sweeps(
    look: _Look, image: _Map, begin: Found, num_first: int, leave_together: bool
) -> Found:
    precision = int(_is_single(begin.y))
    num_more = _MORE[precision]
    power_first, power_more = _POWER_FIRST[precision], _POWER_MORE[precision]
    # The same rate in either precision: a slower one has not stalled in fewer iterations.
    halt = 0.5 ** (num_more / _MORE[0])

    def advance(rounds: _Rounds) -> _Rounds:
        first = rounds.step == 0
        count = jnp.where(first, num_first, num_more)
        before, y = _fixed_point(image, rounds.y, count)

        begun = lambda: _begun(look, y)
        # To measure these in every round would take a quarter of its time.
        earlier, scales = lax.cond(first, begun, lambda: (rounds.size, rounds.scales))
        change = (y**ω - before**ω).ω
        root = lambda x: jnp.where(first, _root(x, power_first), _root(x, power_more))
        step = rounds.step + count
        return look.at(y, change, earlier, scales, root, step, halt)

    return _while_any(advance, _first(look, begin), leave_together)


def _first(look: _Look, begin: Found) -> _Rounds:
    """Before the first round."""
    y, solved, near = begin
    scales = jtu.tree_map(jnp.zeros_like, look.scales(y))
    size = jnp.zeros((), jnp.result_type(*scales))
    return _Rounds(y, size, solved, near, ~solved, 0, scales)


def _begun(look: _Look, y: PyTree[Array]) -> tuple[Scalar, list[Scalar]]:
    """The size of the first change, and that of the state, known after the first round."""
    # The first iteration changed the values from zero to nearly what they are now. Nor
    # does the size of the state change much where iteration goes on.
    scales = look.scales(y)
    return look.size(y, scales)[0], scales


def _by_richardson(look: _Look, image: _Map, begin: Found) -> Found:
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
    num_first = _paced(_FIRST_PAIRS, begin.y)

    def advance(rounds: _Rounds) -> _Rounds:
        first, (before, y, a, begins) = rounds.step == 0, rounds.y
        weight = _weight(a)

        def pair(_, ys):
            # Two iterations, each of which overwrites the older values.
            before, y = ys
            before = _toward(before, image(y), weight)
            return before, _toward(y, image(before), weight)

        slow = any_of_batch(rounds.going & (a > _SLOW_RATE))
        later = jnp.where(slow, _PAIRS_IF_SLOW, _PAIRS)
        pairs = jnp.where(first, num_first, later)
        before, y = lax.fori_loop(0, pairs, pair, (before, y))
        # It is read several times.
        end = materialize(lambda: image(y))
        step = rounds.step + 2 * pairs + 1

        def judged() -> tuple[_Rounds, Scalar, Scalar, Bool[Array, ""]]:
            # On its way back from where iteration led away, the state's size changes much.
            whole, scales = _begun(look, end)
            earlier = jnp.where(begins, whole, rounds.size)
            root = lambda x: x ** (1 / (2 * pairs + jnp.where(first, 0, 1)))
            # Fast oscillations shrink unevenly from round to round.
            halt = jnp.where(a > 1, 0.9, 0.5)
            change = (end**ω - y**ω).ω
            new = look.at((), change, earlier, scales, root, step, halt)

            rate, damped = root(ratio(new.size, earlier)), 1 - weight
            # Where iteration leads away, it begins once more at zero, with the new weight.
            anew = ~(new.size < earlier)
            # If an entry is NaN, so is the rate, and all of these are true.
            wrong = ~(rate**2 <= damped) & (anew | (rounds.step <= 2 * num_first + 1))
            other = jnp.where(wrong, (rate + damped / rate) / weight, a)
            lost = anew & ~(other <= _FASTEST)
            going = ~new.solved & ~lost & (step < look.limits.steps)
            return new._replace(going=going), other, _weight(other), anew

        # It decides over every array of the state.
        new, a, weight, anew = materialize(judged)
        ahead = _toward(before, end, weight)
        pick = lambda x, y: jnp.where(new.solved, x, jnp.where(anew, 0, y))
        before = jtu.tree_map(lambda y: jnp.where(anew, 0, y), y)
        y = jtu.tree_map(pick, end, ahead)
        return new._replace(y=(before, y, a, anew))

    first, from_here = _first(look, begin), begin.solved | begin.near
    y = jtu.tree_map(lambda y: jnp.where(from_here, y, 0), begin.y)
    y = y, y, first.size, jnp.array(True)
    found = _while_any(advance, first._replace(y=y))
    return found._replace(y=found.y[1])


def _weight(a: Scalar) -> Scalar:
    return 2 / (1 + jnp.sqrt(1 + a**2))


def _toward(a: PyTree[Array], b: PyTree[Array], weight: Scalar) -> PyTree[Array]:
    return jtu.tree_map(lambda a, b: a + weight.astype(a.dtype) * (b - a), a, b)


def _by_chords(limits: Limits, tree_image: _Map, scale: _Map, begin: Found) -> Found:
    """From where iteration `begin`s, for paths that are not yet solved.

    All of it is written out in scalars. Of arrays with two or three entries for each path
    XLA makes slow loops: with these a step of one oscillator takes a fifth longer.
    """
    restore = ft.partial(_from_scalars, begin.y)
    image = lambda k: _scalars(tree_image(restore(k)))
    look = _Look(limits, scale, _MOST_CHORDS, restore)
    k = [jnp.where(begin.solved | begin.near, x, 0) for x in _scalars(begin.y)]
    value, jacobian = jax.linearize(image, k)
    one = np.eye(len(k), dtype=k[0].dtype)
    columns = [(list(unit) ** ω - jacobian(list(unit)) ** ω).ω for unit in one]
    M = inverse([list(row) for row in zip(*columns)])
    diff = product(M, (value**ω - k**ω).ω)
    moved = [jnp.where(begin.solved, x, x + y) for x, y in zip(k, diff)]
    scales = look.scales(moved)
    size, _ = look.size(diff, scales)

    chords = _paced(_CHORDS, k)
    chord = lambda k: (k**ω + product(M, (image(k) ** ω - k**ω).ω) ** ω).ω

    def advance(rounds: _Rounds) -> _Rounds:
        before, k = _fixed_point(chord, rounds.y, chords)
        root = lambda x: _root(x, chords)
        step, change = rounds.step + chords, (k**ω - before**ω).ω
        return look.at(k, change, rounds.size, look.scales(k), root, step)

    first = _Rounds(moved, size, begin.solved, begin.near, ~begin.solved, 0, scales)
    found = _while_any(advance, first)
    return found._replace(y=restore(found.y))


def _scalars(y: PyTree[Array]) -> list[Scalar]:
    return [x for leaf in jtu.tree_leaves(y) for x in jnp.ravel(leaf)]


def _from_scalars(like: PyTree[Array], scalars: list[Scalar]) -> PyTree[Array]:
    rest = iter(scalars)
    leaf = lambda x: jnp.stack([next(rest) for _ in range(x.size)]).reshape(x.shape)
    return jtu.tree_map(leaf, like)
