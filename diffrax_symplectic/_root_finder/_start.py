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
from .._custom_types import IntScalarLike
from ._small_lu import SmallLU
from ._tolerance import ratio


if TYPE_CHECKING:
    from ._picard_newton import PicardNewton

# A correction below this fraction of the state shows that iteration came near.
_NEAR = 0.1

_Map = Callable[[PyTree[Array]], PyTree[Array]]


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


def start(finder: "PicardNewton", phi: _Map, y: PyTree[Array], scale: _Map) -> Start:
    """Solves `y = phi(y)` as a step that resolves the dynamics allows."""
    if size_of(y) <= finder.direct:
        return _newton(finder, phi, y, scale)
    return _picard(finder, phi, y, scale)


def converged(
    finder: "PicardNewton",
    diff: PyTree,
    scale: PyTree,
    size: Scalar,
    shrink: Scalar,
    stalled: Bool[Array, ""],
) -> Bool[Array, ""]:
    """Whether the correction that would follow `diff` is below the tolerance, when `diff`
    was `shrink` times as large as the one before, or corrections have `stalled`."""
    # Rounding errors can keep the corrections to a leaf that is small next to the others
    # above `rtol` for ever. Then they no longer shrink, and all of them are tiny.
    stagnated = stalled & rounded(finder.tolerance.relative(diff, scale))
    # A fraction of the tolerance: what remains has the same sign in every step, so that
    # over many steps it adds up to a drift where rounding errors would cancel.
    following = size * jnp.where(shrink < 1, shrink, 1)
    return (following <= 1 / 8) | stagnated


def rounded(relative: Scalar) -> Bool[Array, ""]:
    """Whether a correction, relative to the iterate, can be due to rounding errors."""
    return relative <= 100 * jnp.finfo(relative.dtype).eps


def _newton(finder: "PicardNewton", phi: _Map, y: PyTree[Array], scale: _Map) -> Start:
    y = lax.fori_loop(0, finder.warmup, lambda _, y: phi(y), y)
    value, jacobian = jax.linearize(phi, y)
    operator = lx.FunctionLinearOperator(
        lambda x: (x**ω - jacobian(x) ** ω).ω, jax.eval_shape(lambda: y)
    )
    solver = finder.linear_solver or SmallLU()
    factors = solver.init(operator, {})
    diff, size, shrink = y, jnp.array(jnp.inf), jnp.array(jnp.inf)
    for i in range(finder.chords + 1):
        residual = (y**ω - (value if i == 0 else phi(y)) ** ω).ω
        diff, *_ = solver.compute(factors, residual, {})
        y = (y**ω - diff**ω).ω
        before, size = size, finder.tolerance.measure(diff, scale(y))
        shrink = jnp.ones_like(size) if i == 0 else ratio(size, before)
    done = converged(finder, diff, scale(y), size, shrink, shrink >= 0.25)
    return Start(y, done, shrink < 0.5)


def _picard(finder: "PicardNewton", phi: _Map, y: PyTree[Array], scale: _Map) -> Start:
    # A look at the error costs as much as an iteration does, and a loop that any path of a
    # batch may leave selects between its old and its new iterate. So both come only after
    # several iterations, which are a loop of their own: XLA makes faster code of it than of
    # iterations written out.
    advance = lambda _, ys: (ys[1], phi(ys[1]))

    def some(carry: _Rounds) -> _Rounds:
        before, y = lax.fori_loop(0, finder.sweeps, advance, (carry.y, carry.y))
        diff = (y**ω - before**ω).ω
        size = finder.tolerance.measure(diff, scale(y))
        relative = finder.tolerance.relative(diff, scale(y))
        stalled = size >= 0.5 * carry.size
        # If so many iterations brought the corrections down to the tolerance, each made
        # them smaller by a large factor: the next one is far below it. What rounding errors
        # make of a small leaf does not become smaller.
        done = (size <= 1) | (stalled & rounded(relative))
        near = (relative <= _NEAR) & ~stalled
        return _Rounds(y, size, done, near, carry.step + finder.sweeps)

    def proceed(carry: _Rounds):
        return ~carry.done & carry.near & (carry.step < finder.picard_steps)

    dtype = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).dtype
    no, yes = jnp.array(False), jnp.array(True)
    first = _Rounds(y, jnp.array(jnp.inf, dtype), no, yes, 0)
    last = lax.while_loop(proceed, some, first)
    return Start(last.y, last.done, last.near)


class _Rounds(NamedTuple):
    """The iterate, the size of its last correction, whether that was small enough, whether
    iteration comes nearer, and how many iterations there were."""

    y: PyTree[Array]
    size: Scalar
    done: Bool[Array, ""]
    near: Bool[Array, ""]
    step: IntScalarLike
