"""Newton's method that does not give up: the safety net behind the cheap iterations."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple, TYPE_CHECKING, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

from .._custom_types import BoolScalarLike
from . import _compact, _krylov, _linear
from ._start import converged, Measured
from ._tolerance import all_finite, largest, ratio


if TYPE_CHECKING:
    from ._picard_newton import PicardNewton

_T = TypeVar("_T")
_Vector: TypeAlias = Float[Array, " n"]

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
    program than a tree of arrays. `restore` makes the tree again, and `measured` says how
    large a change of it is."""

    residual: Callable[[_Vector], _Vector]
    restore: Callable[[_Vector], PyTree[Array]]
    measured: Measured


def as_vector(residual: Callable, measured: Measured, y: PyTree[Array]) -> Equations:
    """The equations for a vector in place of the tree that is like `y`."""
    restore = jfu.ravel_pytree(y)[1]
    as_flat = lambda y: jfu.ravel_pytree(residual(restore(y)))[0]
    return Equations(as_flat, restore, measured)


class State(eqx.Module):
    r"""Where the continuation stands. With the residual $r$ the equations solved for
    $s \in [0, 1]$ are $(1 - s) k + s\, r(k) = 0$, so $k = s\, \Phi(k)$: those of a step
    whose length and increments are multiplied by $s$.

    - `y`: the iterate; `anchor`: the (rough) solution at `reached`.
    - `reached`, `target`: the $s$ that was solved for, and that which is being solved for.
    - `tries`, `steps`: how many iterations there were for this target, and in all.
    - `size`: the last correction, in units of the tolerance.
    - `lost`: whether the branch of solutions that begins at $s = 0$ was given up.
    - `solved`: whether `y` solves the equations of the whole step.
    """

    y: _Vector
    anchor: _Vector
    reached: Scalar
    target: Scalar
    tries: Int[Array, ""]
    steps: Int[Array, ""]
    size: Scalar
    lost: Bool[Array, ""]
    solved: Bool[Array, ""]

    @property
    def hopeless(self) -> Bool[Array, ""]:
        """Whether even the search for any solution has left where there are values."""
        return self.lost & ~jnp.isfinite(self.size)


def begin(y: _Vector, solved: Bool[Array, ""]) -> State:
    """First all of the step at once, from the guess `y`."""
    return State(
        y=y,
        anchor=jnp.zeros_like(y),
        reached=jnp.zeros((), y.dtype),
        target=jnp.ones((), y.dtype),
        tries=jnp.array(0),
        steps=jnp.array(0),
        size=jnp.array(jnp.inf, y.dtype),
        lost=jnp.array(False),
        solved=solved,
    )


def advance(finder: "PicardNewton", equations: Equations, state: State) -> State:
    """One iteration of Newton's method."""
    if _dense(finder, state):
        return _dense_iteration(finder, equations, state)
    iterate = ft.partial(_iterate, finder, equations)
    first = iterate(
        (state, _krylov.empty(state.y.size, state.y.dtype), jnp.array(True))
    )
    state, *_ = lax.while_loop(lambda carry: ~carry[2], iterate, first)
    return state


def finish(
    finder: "PicardNewton", residual: Callable, measured: Measured, y, solved, most: int
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    """Goes on from `y` until the equations are solved, or `most` iterations spent. The
    solution for no step at all is zero."""
    equations = as_vector(residual, measured, y)
    going = lambda s: ~s.solved & ~s.hopeless & (s.steps < most)
    first = begin(jfu.ravel_pytree(y)[0], solved)
    if _dense(finder, first):
        iterate = ft.partial(_dense_iteration, finder, equations)
        state = lax.while_loop(going, iterate, first)
    else:
        # The loop of Newton's method and that of GMRES are one, so that the equations occur
        # in the program only once.
        iterate = ft.partial(_iterate, finder, equations)
        carry = first, _krylov.empty(first.y.size, first.y.dtype), jnp.array(True)
        state, *_ = _compact.while_loop(lambda c: going(c[0]), iterate, carry)
    return equations.restore(state.y), state.solved


def _dense(finder: "PicardNewton", state: State) -> bool:
    return finder.linear_solver is not None or state.y.size <= _linear.MAX_DENSE


def _part(s: Scalar, y: _Vector, r: _Vector) -> _Vector:
    return (1 - s) * y + s * r


def _dense_iteration(finder: "PicardNewton", equations: Equations, state: State):
    s = state.target
    value, jacobian = jax.linearize(equations.residual, state.y)
    apply = lambda x: _part(s, x, jacobian(x))
    rhs = _part(s, state.y, value)
    diff, exact = _linear.solve_by(finder.linear_solver, apply, rhs)
    return _correct(finder, equations, state, value, diff, exact)


def _iterate(
    finder: "PicardNewton",
    equations: Equations,
    carry: tuple[State, _krylov.Krylov, Bool[Array, ""]],
) -> tuple[State, _krylov.Krylov, Bool[Array, ""]]:
    """One evaluation: the product that GMRES needs next, or for a `fresh` iterate the
    residual with which it begins. A correction follows when it has ended."""
    state, krylov, fresh = carry
    s = state.target
    value, image = jax.jvp(equations.residual, (state.y,), (krylov.p,))
    vector = _part(s, *_where(fresh, (state.y, value), (krylov.p, image)))
    krylov = _krylov.extend(krylov, vector, fresh)
    corrected = _correct(
        finder, equations, state, value, krylov.solution, krylov.reduced
    )
    return _where(krylov.done, corrected, state), krylov, krylov.done


def _where(which: Bool[Array, ""], a: _T, b: _T) -> _T:
    return jtu.tree_map(lambda a, b: jnp.where(which, a, b), a, b)


def _correct(
    finder: "PicardNewton",
    equations: Equations,
    state: State,
    residual: _Vector,
    diff: _Vector,
    exact: BoolScalarLike,
) -> State:
    """What follows from the correction `diff` for a residual; `exact` says whether its
    linear system was solved."""
    s, y = state.target, state.y - diff
    extent, scale = equations.measured
    # In one array, for a shorter program.
    change, moved, residuals, scales = finder.tolerance.norms(
        *(extent(equations.restore(x)) for x in (diff, state.y, residual)),
        scale(equations.restore(y)),
    )
    size, relative = finder.tolerance.compare(change, scales)
    shrink = jnp.where(state.tries > 0, ratio(size, state.size), 1)
    whole = s == 1
    solved = whole & converged(size, relative, shrink, shrink >= 0.25)
    # Far from all solutions rounding errors of a large Jacobian hide the unknowns that it
    # multiplies least. Then corrections are small where residuals are larger than states.
    state_size = jnp.maximum(largest(scales), largest(moved)) + finder.tolerance.atol
    solved &= exact & (largest(residuals) <= state_size) & all_finite(y)

    at_once = whole & (state.reached == 0)
    patience = jnp.where(at_once, _PATIENCE, 2)
    # No correction at all, if that is not the solution, is no progress either.
    shrinks = (shrink < _SHRINK) & (size > 0)
    stalled = (state.tries + 1 >= patience) & ~shrinks
    near = largest(change) < _LOOSE * largest(moved)
    arrived = near & ~whole
    slow = ~whole & (state.tries + 1 >= _PATIENCE_IN_PART)
    back = (~jnp.isfinite(size) | stalled | slow) & ~arrived & ~state.lost & ~solved

    stride = s - state.reached
    reached = jnp.where(arrived, s, state.reached)
    stride = stride * jnp.where(arrived, _LONGER, jnp.where(back, _SHORTER, 1))
    lost = state.lost | (stride < _SHORTEST)
    return State(
        y=jnp.where(back, state.anchor, y),
        anchor=jnp.where(arrived, y, state.anchor),
        reached=reached,
        target=jnp.where(lost, 1, jnp.minimum(reached + stride, 1)),
        tries=jnp.where(arrived | back, 0, state.tries + 1),
        steps=state.steps + 1,
        size=size,
        lost=lost,
        solved=solved,
    )
