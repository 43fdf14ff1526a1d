"""The cheap iterations that normally solve a step: written out, without a safety net."""

from collections.abc import Callable
from typing import NamedTuple, TYPE_CHECKING

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from equinox.internal import ω
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from ._small_lu import SmallLU
from ._tolerance import ratio


if TYPE_CHECKING:
    from ._picard_newton import PicardNewton

_Map = Callable[[PyTree[Array]], PyTree[Array]]


class Start(NamedTuple):
    """Where the cheap iterations ended.

    - `y`: the last iterate.
    - `converged`: whether the next correction would be below the tolerance.
    - `contracting`: whether the corrections became smaller, at least by half each time, so
        that `y` is a better first guess than the one that these iterations began with.
    """

    y: PyTree[Array]
    converged: Bool[Array, ""]
    contracting: Bool[Array, ""]


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
    eps = jnp.finfo(size.dtype).eps
    stagnated = stalled & (finder.tolerance.relative(diff, scale) <= 100 * eps)
    # A fraction of the tolerance: what remains has the same sign in every step, so that
    # over many steps it adds up to a drift where rounding errors would cancel.
    following = size * jnp.where(shrink < 1, shrink, 1)
    return (following <= 1 / 8) | stagnated


def _newton(finder: "PicardNewton", phi: _Map, y: PyTree[Array], scale: _Map) -> Start:
    for _ in range(finder.warmup):
        y = phi(y)
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
    # A look at the error costs several times what an iteration does: XLA fuses no norm
    # with what its result goes into, and a loop that any path of a batch may leave early
    # selects between old and new iterate for each.
    shift = lambda _, ys: (*ys[1:], phi(ys[-1]))
    # Only of the last three iterations the iterates are kept: to move them costs time.
    kept = min(finder.sweeps, 3)
    y = lax.fori_loop(0, finder.sweeps - kept, lambda _, y: phi(y), y)
    ys = lax.fori_loop(0, kept, shift, (y,) * 4)
    diffs = [(b**ω - a**ω).ω for a, b in zip(ys, ys[1:])]
    before, last, size = [finder.tolerance.measure(d, scale(ys[-1])) for d in diffs]
    # Positions and momenta move each other, so that corrections may shrink in turns: of
    # the last two ratios the larger one is believed.
    shrink = jnp.maximum(ratio(size, last), ratio(last, before))
    stalled = size >= 0.25 * before
    done = converged(finder, diffs[-1], scale(ys[-1]), size, shrink, stalled)

    def advance(carry):
        y, _, _, before, last, step = carry
        image = phi(y)
        diff = (y**ω - image**ω).ω
        size = finder.tolerance.measure(diff, scale(image))
        shrink = jnp.maximum(ratio(size, last), ratio(last, before))
        stalled = size >= 0.25 * before
        done = converged(finder, diff, scale(image), size, shrink, stalled)
        return image, done, size < 0.25 * before, last, size, step + 1

    def proceed(carry):
        _, done, contracting, _, _, step = carry
        return ~done & contracting & (step < finder.picard_steps)

    carry = (ys[-1], done, shrink < 1, last, size, finder.sweeps)
    y, done, contracting, *_ = lax.while_loop(proceed, advance, carry)
    return Start(y, done, contracting)
