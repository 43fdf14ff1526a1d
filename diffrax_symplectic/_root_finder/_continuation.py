"""Newton's method that does not give up: the safety net behind the cheap iterations."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from equinox.internal import ω
from jaxtyping import Array, Bool, Int, PyTree, Scalar

from . import _linear
from ._start import converged
from ._tolerance import ratio


if TYPE_CHECKING:
    from ._picard_newton import PicardNewton

# How many iterations Newton's method for all of the step has before corrections must
# shrink. From a poor guess the first few may well grow and the method still converge.
_PATIENCE = 8
# The same for a part of the step, which begins near a solution: there it converges soon
# or not at all.
_PATIENCE_IN_PART = 4
# The most by which a correction may be longer than this multiple of the one before.
_SHRINK = 0.5
# Corrections below this fraction of the iterate end the solution of a part of the step,
# which only serves as the first guess for the next part.
_LOOSE = 0.1
# After a part that was solved the next is twice as long, after one that was not a quarter.
_LONGER, _SHORTER = 2.0, 0.25
# Parts this short mean that the branch of solutions turns back: there is none beyond that
# begins at the start of the step. From here on Newton's method looks for any solution.
_SHORTEST = 1e-3


class State(eqx.Module):
    r"""Where the continuation stands. With the residual $r$ and the origin $k_0$ the
    equations solved for $s \in [0, 1]$ are $(1 - s)(k - k_0) + s\, r(k) = 0$. For $k_0 = 0$
    that is $k = s\, \Phi(k)$: those of a step whose length and increments are multiplied by
    $s$.

    - `origin`: the solution for $s = 0$.
    - `y`: the iterate; `anchor`: the (rough) solution at `reached`.
    - `reached`, `target`: the $s$ that was solved for, and that which is being solved for.
    - `tries`: how many iterations this target has had.
    - `size`: the last correction, in units of the tolerance.
    - `lost`: whether the branch of solutions that begins at $s = 0$ was given up.
    - `solved`: whether `y` solves the equations of the whole step.
    """

    origin: PyTree[Array]
    y: PyTree[Array]
    anchor: PyTree[Array]
    reached: Scalar
    target: Scalar
    tries: Int[Array, ""]
    size: Scalar
    lost: Bool[Array, ""]
    solved: Bool[Array, ""]

    @property
    def hopeless(self) -> Bool[Array, ""]:
        """Whether even the search for any solution has left where there are values."""
        return self.lost & ~jnp.isfinite(self.size)


def begin(origin: PyTree[Array], y: PyTree[Array], solved: Bool[Array, ""]) -> State:
    """First all of the step at once, from the guess `y`."""
    dtype = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).dtype
    return State(
        origin=origin,
        y=y,
        anchor=origin,
        reached=jnp.zeros((), dtype),
        target=jnp.ones((), dtype),
        tries=jnp.array(0),
        size=jnp.array(jnp.inf, dtype),
        lost=jnp.array(False),
        solved=solved,
    )


def advance(finder: "PicardNewton", residual: Callable, scale, state: State) -> State:
    """One iteration of Newton's method, and what follows from its correction."""
    s = state.target
    value, jacobian = jax.linearize(residual, state.y)
    part = lambda y, r: ((1 - s) * y**ω + s * r**ω).ω
    moved = (state.y**ω - state.origin**ω).ω
    diff = _linear.solve(
        lambda x: part(x, jacobian(x)), part(moved, value), finder.linear_solver
    )
    y = (state.y**ω - diff**ω).ω
    size = finder.tolerance.measure(diff, scale(y))
    shrink = jnp.where(state.tries > 0, ratio(size, state.size), 1)
    whole = s == 1
    solved = whole & converged(finder, diff, scale(y), size, shrink, shrink >= 0.25)

    at_once = whole & (state.reached == 0)
    patience = jnp.where(at_once, _PATIENCE, 2)
    stalled = (state.tries + 1 >= patience) & ~(shrink < _SHRINK)
    near = finder.tolerance.relative(diff, moved) < _LOOSE
    arrived = near & ~whole
    slow = ~whole & (state.tries + 1 >= _PATIENCE_IN_PART)
    back = (~jnp.isfinite(size) | stalled | slow) & ~arrived & ~state.lost & ~solved

    stride = s - state.reached
    reached = jnp.where(arrived, s, state.reached)
    stride = stride * jnp.where(arrived, _LONGER, jnp.where(back, _SHORTER, 1))
    lost = state.lost | (stride < _SHORTEST)
    target = jnp.where(lost, 1, jnp.minimum(reached + stride, 1))
    choose = lambda a, b: jnp.where(back, a, b)
    fresh = arrived | back
    return State(
        origin=state.origin,
        y=jtu.tree_map(choose, state.anchor, y),
        anchor=jtu.tree_map(lambda a, b: jnp.where(arrived, a, b), y, state.anchor),
        reached=reached,
        target=target,
        tries=jnp.where(fresh, 0, state.tries + 1),
        size=size,
        lost=lost,
        solved=solved,
    )


def finish(
    finder: "PicardNewton", residual: Callable, scale, y, solved, max_steps: int
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    """Goes on from `y` until the equations are solved, or `max_steps` iterations spent. The
    solution for no step at all is zero."""

    def body(carry):
        state, step = carry
        return advance(finder, residual, scale, state), step + 1

    def proceed(carry):
        state, step = carry
        return ~state.solved & ~state.hopeless & (step < max_steps)

    zero = jtu.tree_map(jnp.zeros_like, y)
    state, _ = jax.lax.while_loop(proceed, body, (begin(zero, y, solved), 0))
    return state.y, state.solved
