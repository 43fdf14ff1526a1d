"""The iterations that normally solve a step, for all paths of a batch together."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._compat import ω
from .._custom_types import IntScalarLike
from ._batch import any_of_batch
from ._linear import inverse, matrix_of
from ._tolerance import converged, largest, ratio, Tolerance


_Map = Callable[[PyTree[Array]], PyTree[Array]]

# The numbers of iterations between two looks at the error are for double precision. In
# single precision half as many reach rounding error.
# Up to so many unknowns chords follow at once: they cost no more than a look at the error.
_AT_ONCE = 2
# Fixed-point iterations before these, and by how much the last of them may change the
# values, as a fraction of what all of them did.
_WARMUP, _SETTLED = 4, 0.5
# Fixed-point iterations between the first iterate and the first look at the error, and
# then between two looks. They shrink by powers of two, so that the rate of one is a square
# root, twice or three times: any other power takes as long as an iteration of few unknowns.
_FIRST, _MORE = 8, 4
# So many more fixed-point iterations cost as much as the Jacobian and its inverse do.
_SLOW = 24
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
    ) -> tuple[Scalar, Scalar]:
        """The size of a change, in units of the tolerance and relative to the state."""
        tolerance = self.limits.tolerance
        return tolerance.compare(tolerance.sizes(self.restore(change)), scales)

    def at(self, y, change, earlier: Scalar, scales, root: _Map, step) -> _Rounds:
        """After an iteration that was a `change`. The `root` of how much it has shrunk,
        since the one of the size `earlier`, is the rate of one iteration."""
        size, relative = self.size(change, scales)
        shrink = root(ratio(size, earlier))
        stalled = size >= 0.5 * earlier
        # If an entry is NaN, the size is, and all of these are false.
        solved = converged(size, relative, shrink, stalled)
        near = (relative <= _NEAR) & ~stalled
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
    fixed-point iteration with $M = 1$, and chord iteration with $M = (1 - \Phi')^{-1}$
    where that is slow."""
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
    slow = _SLOW if direct else limits.steps
    found = _by_sweeps(_Look(limits, scale, slow), image, begin, chords_follow=direct)
    if not direct:
        return found
    rest = lambda found: _by_chords(limits, image, scale, found)
    return lax.cond(any_of_batch(~found.solved), rest, lambda found: found, found)


def _paced(times: int, y: PyTree[Array]) -> int:
    """How many of these iterations the precision of `y` takes."""
    single = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).bits < 64
    return times // 2 if single else times


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


def _by_sweeps(look: _Look, image: _Map, begin: Found, chords_follow: bool) -> Found:
    y, solved, near = begin
    num_first, num_more = _paced(_FIRST, y), _paced(_MORE, y)

    def advance(rounds: _Rounds) -> _Rounds:
        first = rounds.step == 0
        count = jnp.where(first, 1 + num_first, num_more)
        before, y = _fixed_point(image, rounds.y, count)

        def begun():
            # The first iteration changed the values from zero to nearly what they are now.
            # Nor does the size of the state change much where iteration goes on.
            scales = look.scales(y)
            return look.size(y, scales)[0], scales

        # To measure these in every round would take a quarter of its time.
        earlier, scales = lax.cond(first, begun, lambda: (rounds.size, rounds.scales))
        change = (y**ω - before**ω).ω
        root = lambda x: jnp.where(first, _root(x, num_first), _root(x, num_more))
        return look.at(y, change, earlier, scales, root, rounds.step + count)

    scales = jtu.tree_map(jnp.zeros_like, look.scales(y))
    size = jnp.zeros((), jnp.result_type(*scales))
    first = _Rounds(y, size, solved, near, ~solved, 0, scales)
    return _while_any(advance, first, leave_together=chords_follow)


def _by_chords(limits: Limits, tree_image: _Map, scale: _Map, begin: Found) -> Found:
    """From where iteration `begin`s, for paths that are not yet solved."""
    use = lambda x: jnp.where(begin.solved | begin.near, x, 0)
    k, restore = jfu.ravel_pytree(jtu.tree_map(use, begin.y))
    image = lambda k: jfu.ravel_pytree(tree_image(restore(k)))[0]
    look = _Look(limits, scale, _MOST_CHORDS, restore)
    value, jacobian = jax.linearize(image, k)
    one = jnp.eye(k.size, dtype=k.dtype)
    M = inverse(one - matrix_of(jacobian, k.size, k.dtype))
    diff = M @ (value - k)
    moved = jnp.where(begin.solved, k, k + diff)
    scales = look.scales(moved)
    size, _ = look.size(diff, scales)

    chords = _paced(_CHORDS, k)

    def advance(rounds: _Rounds) -> _Rounds:
        chord = lambda k: k + M @ (image(k) - k)
        before, k = _fixed_point(chord, rounds.y, chords)
        root = lambda x: _root(x, chords)
        step = rounds.step + chords
        return look.at(k, k - before, rounds.size, look.scales(k), root, step)

    first = _Rounds(moved, size, begin.solved, begin.near, ~begin.solved, 0, scales)
    found = _while_any(advance, first)
    return found._replace(y=restore(found.y))
