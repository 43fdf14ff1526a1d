"""Newton's method that does not give up, for the few paths that are left."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from ._linear import correction, Solver
from ._tolerance import all_finite, converged, largest, Limits, log2, max_norm, ratio


_Vector: TypeAlias = Float[Array, " n"]
# `Progress` in one array: a loop selects, gathers and scatters each array of its state by
# kernels of their own.
Packed: TypeAlias = Float[Array, " m"]

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


class Progress(NamedTuple):
    r"""Where the continuation stands. With the residual $r$ and the guess $k_0$ the
    equations solved for $s \in [0, 1]$ are $(1 - s) (k - k_0) + s\, r(k) = 0$. From zero
    these are $k = s\, \Phi(k)$: those of a step whose length and increments are multiplied
    by $s$.

    - `k`: the iterate; `anchor`: the (rough) solution at `reached`.
    - `reached`, `target`: the $s$ that was solved for, and that which is being solved for.
        Beyond 1 the target says that `k` solves the equations of the whole step; and what
        was reached is negative once the branch of solutions from $s = 0$ was given up.
    - `tries`: how many iterations there were for this target.
    - `size`: the last correction, in units of the tolerance.
    """

    k: _Vector
    target: Scalar
    reached: Scalar
    tries: Scalar
    size: Scalar
    anchor: _Vector

    @property
    def solved(self) -> Bool[Array, ""]:
        return self.target > 1

    @property
    def hopeless(self) -> Bool[Array, ""]:
        """Whether even the search for any solution has left where there are values."""
        return (self.reached < 0) & ~jnp.isfinite(self.size)

    @property
    def ended(self) -> Bool[Array, ""]:
        return self.solved | self.hopeless

    def packed(self) -> Packed:
        return jnp.concatenate([self.k, jnp.stack(self[1:5]), self.anchor])

    @staticmethod
    def unpacked(x: Packed) -> "Progress":
        n = (x.size - 4) // 2
        target, reached, tries, size = x[n : n + 4]
        return Progress(x[:n], target, reached, tries, size, x[n + 4 :])


# What stands in place of a target, and of what was reached.
_SOLVED, _LOST = 2, -1


def begin(k: _Vector, solved: Bool[Array, ""], guess: _Vector) -> Packed:
    """First all of the step at once, from `k`; and where that fails, from the `guess`."""
    target = jnp.where(solved, _SOLVED, 1).astype(k.dtype)
    return jnp.concatenate([k, target[None], jnp.zeros(3, k.dtype), guess])


def advance(
    limits: Limits,
    linear_solver: Solver,
    residual: Callable[[_Vector], _Vector],
    restore: Callable[[_Vector], PyTree[Array]],
    guess: _Vector,
    packed: Packed,
) -> Packed:
    """One iteration of Newton's method for the `residual` of a vector. Limits know the
    PyTree that it is `restore`d to."""
    progress = Progress.unpacked(packed)
    s, whole = progress.target, progress.target == 1
    part = lambda k: (1 - s) * (k - guess) + s * residual(k)
    value, diff, exact = correction(part, progress.k, linear_solver)

    k = progress.k - diff
    scales = limits.scales(restore(k))
    size, rounded, _ = limits.compare(restore(diff), scales)
    shrink = jnp.where(progress.tries > 0, ratio(size, progress.size), 1)
    solved = whole & converged(log2(size), log2(shrink), rounded, shrink >= 0.25)
    # Far from all solutions rounding errors of a large Jacobian hide the unknowns that it
    # multiplies least. Then corrections are small where residuals are larger than states.
    moved = max_norm(progress.k)
    state_size = jnp.maximum(largest(scales), moved) + limits.atol
    solved &= exact & (max_norm(value) <= state_size) & all_finite(k)

    at_once = whole & (progress.reached == 0)
    patience = jnp.where(at_once, _PATIENCE, 2)
    # No correction at all, if that is not the solution, is no progress either.
    shrinks = (shrink < _SHRINK) & (size > 0)
    stalled = (progress.tries + 1 >= patience) & ~shrinks
    near = max_norm(diff) < _LOOSE * moved
    arrived = near & ~whole
    slow = ~whole & (progress.tries + 1 >= _PATIENCE_IN_PART)
    on_branch = progress.reached >= 0
    back = (~jnp.isfinite(size) | stalled | slow) & ~arrived & on_branch & ~solved

    # Each of these is simple, so that XLA computes once which of them it is.
    going = progress._replace(k=k, tries=progress.tries + 1, size=size)
    zero, stride = jnp.zeros_like(s), s - progress.reached
    longer = jnp.minimum(s + _LONGER * stride, 1)
    onward = Progress(k, longer, s, zero, size, anchor=k)
    shorter = progress.reached + _SHORTER * stride
    turned = _SHORTER * stride < _SHORTEST
    target = jnp.where(turned, 1, shorter)
    reached = jnp.where(turned, _LOST, progress.reached)
    retry = Progress(progress.anchor, target, reached, zero, size, progress.anchor)
    done = going._replace(target=zero + _SOLVED)
    new = going.packed()
    for case, then in (arrived, onward), (back, retry), (solved, done):
        new = jnp.where(case, then.packed(), new)
    return new
