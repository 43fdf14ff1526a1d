"""The root finder of a fused step: sweeps for one path, without a fallback.

As in `_root_finder/sweeps.py` it is decided when corrections are small enough, and when
sweeps are relaxed. The loop differs: there all paths of a batch sweep together, and checks
are rare since they cost much. In a kernel each path ends by itself, and checks after every
sweep.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._compat import ω
from .._root_finder import (
    all_finite,
    best_relaxation,
    Halves,
    LOG2_MARGIN,
    LOG2_STALLED,
    PicardNewton,
    ROUNDINGS,
    SLOW,
)
from .._solver import with_changed_stages


# A path with a step that needs more sweeps is handed back to JAX.
_MOST_SWEEPS = 48
# Sweeps diverge if a correction is larger than this, in units of the tolerance. (The number
# is finite in single precision, too.)
_DIVERGED = 1e30
# The rate is the ratio of two corrections, which may be infinite where sweeps diverge. The
# relaxation is chosen for at most this rate.
_LARGEST_RATE = 4


class _SweepState(NamedTuple):
    """The state of the loop over sweeps.

    - `y`: the iterate.
    - `size`: the size of its last correction, in units of the tolerance.
    - `is_solved`: whether the equations are solved.
    - `num_sweeps`: the number of sweeps so far.
    """

    y: Halves
    size: Scalar
    is_solved: Bool[Array, ""]
    num_sweeps: Array


def solve_one_path(
    image: Callable, scale: Callable, guess: PyTree[Array], pending: Bool[Array, ""]
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    r"""Solves $y = \Phi(y)$ from a `guess`, where $\Phi$ is the `image`, unless the path
    is not `pending`. Returns the last iterate, and whether it is a solution.

    `scale` maps an iterate to the sizes to which errors are relative. The arguments are
    those that [`diffrax_symplectic.PicardNewton`][] is called with.

    Unless the unknowns are `Halves`, the equations are doubled, to $y = \Phi(z)$, $z =
    \Phi(y)$, with the halves $y$ and $z$. They are solved when $y = z$: a cycle of period
    two fulfils them, too, with $y \neq z$.
    """
    in_halves = isinstance(guess, Halves)
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    eps = jnp.finfo(dtype).eps
    one = jnp.ones((), dtype)

    def relaxed(new: PyTree, old: PyTree, relaxation: Scalar | None) -> PyTree[Array]:
        if relaxation is None:
            return new
        return (old**ω + relaxation * (new**ω - old**ω)).ω

    # In a sweep $q$ reads the new $p$. Without a `relaxation` it takes fewer operations
    # than with a relaxation of one.
    def sweep(y: Halves, relaxation: Scalar | None = None) -> Halves:
        unrelaxed_p = image(y).p if in_halves else image(y.q)
        y = Halves(relaxed(unrelaxed_p, y.p, relaxation), y.q)
        unrelaxed_q = image(y).q if in_halves else image(y.p)
        return Halves(y.p, relaxed(unrelaxed_q, y.q, relaxation))

    first = sweep(guess if in_halves else Halves(guess, guess))
    # The tolerance is two units in the last place, leaf by leaf. It is taken once, at the
    # first iterate, up to a factor of two. And this is the largest rounding error.
    scales = _sizes(scale(first if in_halves else first.q))
    weights = [_inverse(2 * eps * x) for x in scales]
    rounding = ROUNDINGS * eps * _largest(scales)

    # The size of the last correction, in units of the tolerance, and whether sweeps have
    # converged, if the correction before had the size `size_before`.
    def check(
        old: Halves, new: Halves, size_before: Scalar
    ) -> tuple[Scalar, Bool[Array, ""]]:
        # For doubled equations the correction is the difference of the two halves, since
        # only equal halves are a solution.
        correction = (new**ω - old**ω).ω if in_halves else (new.q**ω - new.p**ω).ω
        sizes = _sizes(correction)
        size = _largest([x * weight for x, weight in zip(sizes, weights)])
        # The next correction is expected to be `size * ratio` with the last ratio, `size /
        # size_before`. If corrections grow, the ratio says nothing, and counts as one. So
        # the condition is `2^LOG2_MARGIN * size * min(ratio, 1) <= 1`, and here both sides
        # are multiplied by `size_before`, since a division takes long.
        ratio_times_size_before = jnp.where(size < size_before, size, size_before)
        is_next_small = 2.0**LOG2_MARGIN * size * ratio_times_size_before <= size_before
        # Rounding errors do not shrink any further.
        is_stalled = size >= 2.0**LOG2_STALLED * size_before
        is_rounding = _largest(sizes) <= rounding
        return size, is_next_small | (is_stalled & is_rounding)

    # Three sweeps come before the loop: they make two corrections, whose ratio is the rate
    # of convergence. Of the first correction only the size is needed: there is none before
    # to compare with.
    second = sweep(first)
    third = sweep(second)
    size_before, _ = check(first, second, one)
    size, is_solved = check(second, third, size_before)
    # The relaxation is chosen once: later rates are those of relaxed sweeps, to which its
    # formula does not apply. It is a branch, since few paths take it, and a division takes
    # as long as a sweep.
    relaxation = lax.cond(
        size > SLOW * size_before,
        lambda: best_relaxation(jnp.minimum(size / size_before, _LARGEST_RATE)),
        lambda: one,
    )

    def sweep_again(state: _SweepState) -> _SweepState:
        y = sweep(state.y, relaxation)
        size, is_solved = check(state.y, y, state.size)
        return _SweepState(y, size, is_solved, state.num_sweeps + 1)

    def goes_on(state: _SweepState) -> Bool[Array, ""]:
        may_sweep = state.num_sweeps < _MOST_SWEEPS
        return ~state.is_solved & may_sweep & (state.size < _DIVERGED)

    # A path that is not pending counts as solved, and sweeps no more.
    counts_as_solved = ~pending | is_solved
    num_sweeps = jnp.full((), 3, jnp.int32)
    state = _SweepState(third, size, counts_as_solved, num_sweeps)
    end = lax.while_loop(goes_on, sweep_again, state)
    # The halves of doubled equations differ by the last correction, which may be larger
    # than the tolerance: convergence is decided by the next one. With the new half of
    # another sweep, paths of a field with jumps were off by 0.7 units in the last place,
    # and without by 49.
    return end.y if in_halves else image(end.y.q), end.is_solved


def _inverse(x: Scalar) -> Scalar:
    """The inverse of a positive finite number up to a factor of two, from its exponent: a
    division takes as long as a sweep. The inverse of zero is large, not infinite. Numbers
    that are not finite give minus infinity, which the check at the end of the step
    finds."""
    info = jnp.finfo(x.dtype)
    integer = jnp.dtype(f"int{info.bits}")
    # Read as an integer, the bits of a float are its exponent, followed by its mantissa.
    # Shifts there and back set the mantissa to zero: a power of two is left.
    bits_of_one = int(np.asarray(1, x.dtype).view(integer))
    bits_of_power = lax.bitcast_convert_type(x, integer) >> info.nmant << info.nmant
    # The exponent of 2^k is stored as `k + offset`, and thus that of one as the offset. So
    # twice the bits of one minus those of 2^k are those of 2^-k.
    inverse = jnp.asarray(2 * bits_of_one, integer) - bits_of_power
    return lax.bitcast_convert_type(inverse, x.dtype)


def _sizes(y: PyTree[Array]) -> list[Scalar]:
    """The largest entry of each leaf, by size."""
    return [_largest([*jnp.abs(x).reshape(-1)]) for x in jtu.tree_leaves(y)]


def _largest(numbers: list[Scalar]) -> Scalar:
    largest, *others = numbers
    for x in others:
        # `jnp.maximum` propagates NaN at the price of three operations. The check at the
        # end of the step finds NaN in any case.
        largest = jnp.where(largest > x, largest, x)
    return largest


class Sweeps(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, Any]):
    """Solves the stage equations by sweeps, all in `init`: Optimistix makes no step. Its
    state is the solution and whether it is one. Fails if sweeps do not converge."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        del fn, f_struct, aux_struct, tags
        zeros = jtu.tree_map(jnp.zeros_like, y)
        return options["solve_blocks"](args, solve_one_path, zeros, all_finite(y))

    def step(self, fn, y, args, options, state, tags):
        del fn, args, options, tags
        return y, state, None

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        _, is_solved = state
        return is_solved, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, y, args, options, tags, result
        solution, _ = state
        return solution, aux, {}


def by_sweeps_alone(solver: Any) -> Any:
    """The solver, and all solvers in it, with `Sweeps` in place of `PicardNewton`: without
    Newton's method. Paths that fail are simulated again by JAX. Raises a `ValueError`
    unless the tolerance is the default, rounding error."""

    def with_sweeps(implicit: Any) -> Any:
        # Limits on the numbers of steps are not compared: they hold for JAX, which
        # simulates the paths that are not solved here.
        for name in ("rtol", "atol", "norm"):
            value = getattr(implicit.root_finder, name)
            if value != getattr(PicardNewton(), name):
                raise ValueError(
                    '`engine="drjit"` solves each step to rounding error; got '
                    f"`PicardNewton({name}={value})`. Leave this out, or pass "
                    '`engine="jax"`.'
                )
        # Optimistix makes no iterations: `Sweeps` solves the equations before the first.
        return eqx.tree_at(
            lambda solver: (solver.root_finder, solver.root_find_max_steps),
            implicit,
            (Sweeps(), 0),
        )

    return with_changed_stages(solver, with_sweeps)
