"""Newton's method with continuation, for the stragglers."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from .._batch import batched_like
from .._custom_types import IntScalarLike
from ._linear import correction
from ._tolerance import all_finite, converged, largest, log2, max_norm, ratio, Tolerance


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


class Progress(NamedTuple):
    r"""Where the continuation stands. With the residual $r$ and the guess $k_0$ the
    equations solved for $s \in [0, 1]$ are $(1 - s) (k - k_0) + s\, r(k) = 0$. From zero
    these are $k = s\, \Phi(k)$: those of a step whose length and increments are multiplied
    by $s$.

    - `anchor`: the (rough) solution at `reached`.
    - `reached`, `target`: the $s$ that was solved for, and the one being solved for.
    - `tries`: how many iterations there were for this target.
    - `size`: the last correction, in units of the tolerance.
    - `searching`: whether the branch of solutions from $s = 0$ was given up. Then any
        solution of the whole equations will do.
    - `solved`: whether the whole equations are solved.
    """

    anchor: _Vector
    reached: Scalar
    target: Scalar
    tries: IntScalarLike
    size: Scalar
    searching: Bool[Array, ""]
    solved: Bool[Array, ""]


class Newton(optx.AbstractRootFinder[_Vector, _Vector, Any, Progress]):
    """Newton's method with continuation, for a vector: first for the whole equations at
    once; and where that fails, part by part from `start`. Corrections are measured in the
    PyTree that a vector is `restore`d to."""

    start: _Vector
    restore: Callable[[_Vector], PyTree[Array]]

    rtol: float | None
    atol: float
    norm: Callable[[PyTree], Scalar]
    linear_solver: lx.AbstractLinearSolver | None

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Progress:
        del fn, args, options, f_struct, aux_struct, tags
        zero, no = jnp.zeros((), self.start.dtype), jnp.array(False)
        begun = Progress(self.start, zero, zero + 1, jnp.array(0), zero, no, no)
        return batched_like(begun, y)

    def step(self, fn, y, args, options, state, tags):
        del tags
        tolerance = Tolerance(self.rtol, self.atol, self.norm)
        scale = options.get("scale", lambda k: k)
        s, whole = state.target, state.target == 1

        def part(k):
            value, aux = fn(k, args)
            return (1 - s) * (k - self.start) + s * value, aux

        value, diff, found, aux = correction(part, y, self.linear_solver)
        moved, k = max_norm(y), y - diff
        states = scale(self.restore(k))
        measured = tolerance.measure(self.restore(diff), states)
        size, tries = measured.size, state.tries + 1
        shrink = jnp.where(state.tries > 0, ratio(size, state.size), 1)
        solved = converged(log2(size), log2(shrink), measured.rounded, shrink >= 0.25)
        # Far from all solutions rounding errors of a large Jacobian hide the unknowns that
        # it multiplies least. Then corrections are small where residuals are larger than
        # states.
        whole_state = largest([max_norm(x) for x in jtu.tree_leaves(states)])
        state_size = jnp.maximum(whole_state, moved) + self.atol
        solved &= whole & found & (max_norm(value) <= state_size) & all_finite(k)

        at_once = whole & (state.reached == 0) & ~state.searching
        patience = jnp.where(at_once, _PATIENCE, 2)
        # No correction at all, if that is not the solution, is no progress either.
        stalled = (tries >= patience) & ~((shrink < _SHRINK) & (size > 0))
        slow = ~whole & (tries >= _PATIENCE_IN_PART)
        arrived = (max_norm(diff) < _LOOSE * moved) & ~whole
        failed = (~jnp.isfinite(size) | stalled | slow) & ~arrived & ~solved
        state = state._replace(tries=tries, size=size, solved=solved)
        k, state = _next_target(state, k, arrived, failed & ~state.searching)
        return k, state, aux

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        R = optx.RESULTS
        # Even the search for any solution has left where there are values.
        hopeless = state.searching & ~jnp.isfinite(state.size)
        return state.solved, R.where(hopeless, R.nonfinite, R.successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}


def _next_target(
    progress: Progress, k: _Vector, arrived: Bool[Array, ""], failed: Bool[Array, ""]
) -> tuple[_Vector, Progress]:
    """Onward where the target was reached, and back where Newton's method `failed`."""
    s, stride = progress.target, progress.target - progress.reached
    turned = failed & (_SHORTER * stride < _SHORTEST)
    longer = jnp.minimum(s + _LONGER * stride, 1)
    shorter = jnp.where(turned, 1, progress.reached + _SHORTER * stride)
    k = jnp.where(failed, progress.anchor, k)
    return k, progress._replace(
        anchor=jnp.where(arrived, k, progress.anchor),
        reached=jnp.where(arrived, s, progress.reached),
        target=jnp.where(arrived, longer, jnp.where(failed, shorter, s)),
        tries=jnp.where(arrived | failed, 0, progress.tries),
        searching=progress.searching | turned,
    )
