"""The cheap iterations that normally solve a step: written out, without a safety net."""

from collections.abc import Callable
from typing import NamedTuple, TYPE_CHECKING

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._compat import ω
from .._custom_types import BoolScalarLike, IntScalarLike
from ._batch import any_of_batch
from ._small_lu import SmallLU
from ._tolerance import all_finite, largest, ratio


if TYPE_CHECKING:
    from ._picard_newton import PicardNewton

# A correction below this fraction of the state shows that iteration came near.
_NEAR = 0.1
# Of the fixed-point iterations before Newton's method the last may change the values by no
# more than this fraction of what all of them did.
_SETTLED = 0.5

_Map = Callable[[PyTree[Array]], PyTree[Array]]


class Measured(NamedTuple):
    """How unknown values are measured: the `extent` of a change of them, and the `scale` of
    the state that they change, in the same leaves."""

    extent: _Map
    scale: _Map


class Sweep(NamedTuple):
    """What one round of cheap iterations makes of unknown values.

    - `y`: the values after it.
    - `before`, `after`: the last two iterates of those found by fixed-point iteration.
    - `converged`, `near`: as in `Start`, for those found by Newton's method.
    """

    y: PyTree[Array]
    before: PyTree[Array]
    after: PyTree[Array]
    converged: BoolScalarLike
    near: BoolScalarLike


class Start(NamedTuple):
    """Where the cheap iterations ended.

    - `y`: the last iterate.
    - `converged`: whether the next correction would be below the tolerance.
    - `near`: whether `y` is a better first guess than the one that they began with.
    """

    y: PyTree[Array]
    converged: Bool[Array, ""]
    near: Bool[Array, ""]


def size_of(y: PyTree) -> int:
    return sum(x.size for x in jtu.tree_leaves(y))


def improve(
    finder: "PicardNewton",
    phi: _Map,
    y: PyTree[Array],
    measured: Measured,
    sweeps: IntScalarLike,
) -> Sweep:
    """One round for one system `y = phi(y)`: if iterations, `sweeps` of them."""
    if size_of(y) <= finder.direct:
        found = _newton(finder, phi, y, measured)
        return Sweep(found.y, [], [], found.converged, found.near)
    # A look at the error costs as much as an iteration does. So it comes only after several
    # of them.
    before, after = _fixed_point(phi, y, sweeps)
    return Sweep(after, before, after, True, True)


def _fixed_point(
    phi: _Map, y: PyTree[Array], times: IntScalarLike
) -> tuple[PyTree[Array], PyTree[Array]]:
    """The last two iterates. XLA makes faster code of a loop than of iterations written
    out."""
    return lax.fori_loop(0, times, lambda _, ys: (ys[1], phi(ys[1])), (y, y))


def start(
    finder: "PicardNewton",
    improve_all: Callable[[list[PyTree[Array]], IntScalarLike], Sweep],
    y: list[PyTree[Array]],
    measured: Measured,
) -> Start:
    """From the guess zero: repeats rounds until all systems `y` of a step are solved, or
    corrections do not shrink. `improve_all` is one round, of so many iterations."""
    if all(size_of(system) <= finder.direct for system in y):
        once = improve_all(y, 0)
        return _if_finite(once.y, once.converged, once.near)

    def one_round(carry: _Rounds) -> _Rounds:
        first = carry.step == 0
        sweeps = jnp.where(first, finder.sweeps, finder.more_sweeps)
        new, before, after, newton, near = improve_all(carry.y, sweeps)
        diff, change, scale = finder.tolerance.norms(
            measured.extent((after**ω - before**ω).ω),
            measured.extent(after),
            measured.scale(after),
        )
        size, relative = finder.tolerance.compare(diff, scale)
        # The first iteration changed the values from zero to nearly what they are now.
        whole, _ = finder.tolerance.compare(change, scale)
        earlier = jnp.where(first, whole, carry.size)
        shrink = ratio(size, earlier) ** (1 / sweeps)
        stalled = size >= 0.5 * earlier
        done = converged(size, relative, shrink, stalled) & newton
        near &= (relative <= _NEAR) & ~stalled
        step = carry.step + sweeps
        going = ~done & near & (step < finder.picard_steps)
        # The rounds of all paths of a batch are the same, but each path has only its own.
        y, done, near = jtu.tree_map(
            lambda a, b: jnp.where(carry.going, a, b),
            (new, done, near),
            (carry.y, carry.done, carry.near),
        )
        return _Rounds(y, size, done, near, carry.going & going, step)

    dtype = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).dtype
    no, yes = jnp.array(False), jnp.array(True)
    first = _Rounds(y, jnp.array(jnp.inf, dtype), no, yes, yes, 0)
    last = lax.while_loop(lambda carry: any_of_batch(carry.going), one_round, first)
    return _if_finite(last.y, last.done, last.near)


def _if_finite(y: PyTree[Array], done: BoolScalarLike, near: BoolScalarLike) -> Start:
    # The norms do not tell: on CPUs XLA may return -inf as the maximum of NaNs.
    finite = all_finite(y)
    return Start(y, finite & done, finite & near)


def converged(
    size: Scalar, relative: Scalar, shrink: Scalar, stalled: Bool[Array, ""]
) -> Bool[Array, ""]:
    """Whether the next correction is below the tolerance, when the last one was of this
    `size` in units of it, and `shrink` times as large as the one before, or corrections
    have `stalled`."""
    # Rounding errors can keep the corrections to a leaf that is small next to the others
    # above `rtol` for ever. Then they no longer shrink, and all of them are tiny.
    stagnated = stalled & rounded(relative)
    # A fraction of the tolerance: what remains has the same sign in every step, so that
    # over many steps it adds up to a drift where rounding errors would cancel.
    following = size * jnp.where(shrink < 1, shrink, 1)
    return (following <= 1 / 8) | stagnated


def rounded(relative: Scalar) -> Bool[Array, ""]:
    """Whether a correction, relative to the iterate, can be due to rounding errors."""
    return relative <= 100 * jnp.finfo(relative.dtype).eps


def _newton(
    finder: "PicardNewton", phi: _Map, y: PyTree[Array], measured: Measured
) -> Start:
    guess = y
    before, y = _fixed_point(phi, guess, finder.warmup)
    if finder.warmup > 1:
        # Where iteration goes away from the solution, Newton's method begins at the guess.
        changes = [(y**ω - x**ω).ω for x in (before, guess)]
        norms = finder.tolerance.norms(*map(measured.extent, changes))
        last, whole = map(largest, norms)
        comes_near = last < _SETTLED * whole
        y = jtu.tree_map(lambda a, b: jnp.where(comes_near, a, b), y, guess)
    value, jacobian = jax.linearize(phi, y)
    operator = lx.FunctionLinearOperator(
        lambda x: (x**ω - jacobian(x) ** ω).ω, jax.eval_shape(lambda: y)
    )
    solver = finder.linear_solver or SmallLU()
    factors = solver.init(operator, {})
    size = relative = shrink = jnp.array(jnp.inf)
    for i in range(finder.chords + 1):
        residual = (y**ω - (value if i == 0 else phi(y)) ** ω).ω
        diff, *_ = solver.compute(factors, residual, {})
        y = (y**ω - diff**ω).ω
        before = size
        sizes = finder.tolerance.norms(measured.extent(diff), measured.scale(y))
        size, relative = finder.tolerance.compare(*sizes)
        shrink = jnp.ones_like(size) if i == 0 else ratio(size, before)
    done = converged(size, relative, shrink, shrink >= 0.25)
    return Start(y, done, (shrink < 0.5) & (relative <= _NEAR))


class _Rounds(NamedTuple):
    """The iterate, the size of its last correction, whether that was small enough, whether
    iteration comes nearer, whether it goes on, and how many iterations there were."""

    y: PyTree[Array]
    size: Scalar
    done: Bool[Array, ""]
    near: Bool[Array, ""]
    going: Bool[Array, ""]
    step: IntScalarLike
