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
from ._tolerance import all_finite, converged, largest, ratio, Tolerance


_Map = Callable[[PyTree[Array]], PyTree[Array]]

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
    iteration comes nearer, whether it goes on, and how many iterations there were."""

    y: PyTree[Array]
    size: Scalar
    solved: Bool[Array, ""]
    near: Bool[Array, ""]
    going: Bool[Array, ""]
    step: IntScalarLike


class _Look(NamedTuple):
    """A look at what iteration made of its values."""

    limits: Limits
    scale: _Map
    most: int
    restore: _Map = lambda y: y

    def size(self, change: PyTree[Array], y: PyTree[Array]) -> tuple[Scalar, Scalar]:
        """The size of a change, in units of the tolerance and relative to the state."""
        tolerance = self.limits.tolerance
        return tolerance.compare(
            tolerance.sizes(self.restore(change)),
            tolerance.sizes(self.scale(self.restore(y))),
        )

    def at(self, y, change, earlier: Scalar, root: _Map, step) -> _Rounds:
        """After an iteration that was a `change`. The `root` of how much it has shrunk,
        since the one of the size `earlier`, is the rate of one iteration."""
        size, relative = self.size(change, y)
        shrink = root(ratio(size, earlier))
        stalled = size >= 0.5 * earlier
        # The norms do not tell: on CPUs XLA may return -inf as the maximum of NaNs.
        finite = all_finite(y)
        solved = finite & converged(size, relative, shrink, stalled)
        near = finite & (relative <= _NEAR) & ~stalled
        following = size * shrink**self.most
        going = ~solved & near & (step < self.limits.steps) & (following <= 1)
        return _Rounds(y, size, solved, near, going, step)


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
        return _Rounds(y, new.size, solved, near, last.going & new.going, new.step)

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
        before, swept = _fixed_point(image, y, _WARMUP)
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
    def advance(rounds: _Rounds) -> _Rounds:
        first = rounds.step == 0
        count = jnp.where(first, 1 + _FIRST, _MORE)
        before, y = _fixed_point(image, rounds.y, count)
        # The first iteration changed the values from zero to nearly what they are now. To
        # measure that in every round would take a quarter of its time.
        whole = lambda: look.size(y, y)[0]
        earlier = lax.cond(first, whole, lambda: rounds.size)
        change = (y**ω - before**ω).ω
        fourth = lambda x: jnp.sqrt(jnp.sqrt(x))
        root = lambda x: jnp.where(first, jnp.sqrt(fourth(x)), fourth(x))
        return look.at(y, change, earlier, root, rounds.step + count)

    y, solved, near = begin
    size = jnp.zeros((), jnp.result_type(*jtu.tree_leaves(y)))
    first = _Rounds(y, size, solved, near, ~solved, 0)
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
    size, _ = look.size(diff, moved)

    def advance(rounds: _Rounds) -> _Rounds:
        chord = lambda k: k + M @ (image(k) - k)
        before, k = _fixed_point(chord, rounds.y, _CHORDS)
        return look.at(k, k - before, rounds.size, jnp.sqrt, rounds.step + _CHORDS)

    first = _Rounds(moved, size, begin.solved, begin.near, ~begin.solved, 0)
    found = _while_any(advance, first)
    return found._replace(y=restore(found.y))
