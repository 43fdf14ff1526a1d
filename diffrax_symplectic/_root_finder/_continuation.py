"""Newton's method that does not give up: the safety net behind the cheap iterations."""

from collections.abc import Callable
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

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


class Equations(NamedTuple):
    """The equations `residual(y) = 0` for all unknowns as one vector, which makes a shorter
    program than a tree of arrays. `restore` makes the tree again, and `scale` says how
    large the state is that is changed."""

    residual: Callable[[Float[Array, " n"]], Float[Array, " n"]]
    restore: Callable[[Float[Array, " n"]], PyTree[Array]]
    scale: Callable[[PyTree[Array]], PyTree[Array]]


def as_vector(
    residual: Callable, scale: Callable, y: PyTree[Array]
) -> tuple[Equations, Float[Array, " n"]]:
    """The equations for a vector in place of a tree, and the vector of `y`."""
    flat, restore = jfu.ravel_pytree(y)
    as_flat = lambda y: jfu.ravel_pytree(residual(restore(y)))[0]
    return Equations(as_flat, restore, scale), flat


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

    origin: Float[Array, " n"]
    y: Float[Array, " n"]
    anchor: Float[Array, " n"]
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


def begin(
    origin: Float[Array, " n"], y: Float[Array, " n"], solved: Bool[Array, ""]
) -> State:
    """First all of the step at once, from the guess `y`."""
    return State(
        origin=origin,
        y=y,
        anchor=origin,
        reached=jnp.zeros((), y.dtype),
        target=jnp.ones((), y.dtype),
        tries=jnp.array(0),
        size=jnp.array(jnp.inf, y.dtype),
        lost=jnp.array(False),
        solved=solved,
    )


def advance(finder: "PicardNewton", equations: Equations, state: State) -> State:
    """One iteration of Newton's method, and what follows from its correction."""
    s = state.target
    value, jacobian = jax.linearize(equations.residual, state.y)
    part = lambda y, r: (1 - s) * y + s * r
    moved = state.y - state.origin
    diff = _linear.solve(
        lambda x: part(x, jacobian(x)), part(moved, value), finder.linear_solver
    )
    y = state.y - diff
    tree, scale = equations.restore(diff), equations.scale(equations.restore(y))
    size = finder.tolerance.measure(tree, scale)
    shrink = jnp.where(state.tries > 0, ratio(size, state.size), 1)
    whole = s == 1
    solved = whole & converged(finder, tree, scale, size, shrink, shrink >= 0.25)

    at_once = whole & (state.reached == 0)
    patience = jnp.where(at_once, _PATIENCE, 2)
    stalled = (state.tries + 1 >= patience) & ~(shrink < _SHRINK)
    near = optx.max_norm(diff) < _LOOSE * optx.max_norm(moved)
    arrived = near & ~whole
    slow = ~whole & (state.tries + 1 >= _PATIENCE_IN_PART)
    back = (~jnp.isfinite(size) | stalled | slow) & ~arrived & ~state.lost & ~solved

    stride = s - state.reached
    reached = jnp.where(arrived, s, state.reached)
    stride = stride * jnp.where(arrived, _LONGER, jnp.where(back, _SHORTER, 1))
    lost = state.lost | (stride < _SHORTEST)
    return State(
        origin=state.origin,
        y=jnp.where(back, state.anchor, y),
        anchor=jnp.where(arrived, y, state.anchor),
        reached=reached,
        target=jnp.where(lost, 1, jnp.minimum(reached + stride, 1)),
        tries=jnp.where(arrived | back, 0, state.tries + 1),
        size=size,
        lost=lost,
        solved=solved,
    )


def finish(
    finder: "PicardNewton", residual: Callable, scale, y, solved, max_steps: int
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    """Goes on from `y` until the equations are solved, or `max_steps` iterations spent. The
    solution for no step at all is zero."""
    equations, flat = as_vector(residual, scale, y)

    def body(carry):
        state, step = carry
        return advance(finder, equations, state), step + 1

    def proceed(carry):
        state, step = carry
        return ~state.solved & ~state.hopeless & (step < max_steps)

    first = begin(jnp.zeros_like(flat), flat, solved)
    state, _ = jax.lax.while_loop(proceed, body, (first, 0))
    return equations.restore(state.y), state.solved
