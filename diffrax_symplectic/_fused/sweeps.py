"""The root finder of a fused step: sweeps for one path, without a fallback.

A *sweep* is one iteration of Gauss--Seidel over two halves $p$ and $q$ of the unknowns: it
computes $p$ from the old $q$, then $q$ from the new $p$. The same sweeps solve a step in
`_root_finder/sweeps.py`. There all paths of a batch sweep together, and checks for
convergence are rare since they cost much. Here each path ends by itself, and checks after
every sweep. Sweeps are relaxed, and count as converged, under the same conditions as there.
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


# The most sweeps of a step. A path that needs more is handed back to JAX.
_MOST_SWEEPS = 48
# Sweeps count as divergent if a correction is larger than this, in units of the tolerance.
# (The number is finite also in single precision.)
_DIVERGED = 1e30
# The relaxation is chosen for at most this rate of convergence. The rate is the ratio of
# two corrections, which may be infinite where sweeps diverge.
_LARGEST_RATE = 4


class _SweepState(NamedTuple):
    """The state of the loop over sweeps.

    - `y`: the iterate.
    - `size`: the size of the last correction, in units of the tolerance.
    - `is_solved`: whether sweeps have converged.
    - `num_sweeps`: the number of sweeps so far.
    """

    y: Halves
    size: Scalar
    is_solved: Bool[Array, ""]
    num_sweeps: Array


class _Tolerance(NamedTuple):
    """How large the last *correction*, the change of the unknowns by a sweep, may be when
    sweeps have converged.

    - `weights`: for each leaf of a correction, the inverse of the tolerance.
    - `rounding`: the largest correction that may consist of rounding errors alone.
    """

    weights: list[Scalar]
    rounding: Scalar

    def check(
        self, correction: PyTree[Array], size_before: Scalar
    ) -> tuple[Scalar, Bool[Array, ""]]:
        """The size of a correction, in units of the tolerance, and whether sweeps have
        converged. The correction before had the size `size_before`."""
        sizes = _sizes(correction)
        size = _largest([x * weight for x, weight in zip(sizes, self.weights)])
        # 1. Sweeps have converged if the next correction is expected to be small. It is
        # expected to be `size * ratio` with the last ratio, `size / size_before`. If
        # corrections grow, the ratio says nothing, and counts as one. So the condition is
        # `2^LOG2_MARGIN * size * min(ratio, 1) <= 1`. Here both sides are multiplied by
        # `size_before`, since a division takes long.
        ratio_times_size_before = jnp.where(size < size_before, size, size_before)
        is_next_small = 2.0**LOG2_MARGIN * size * ratio_times_size_before <= size_before
        # 2. They have also converged if corrections consist of rounding errors, so that
        # they do not shrink any further.
        is_stalled = size >= 2.0**LOG2_STALLED * size_before
        is_rounding = _largest(sizes) <= self.rounding
        return size, is_next_small | (is_stalled & is_rounding)


def solve_one_path(
    image: Callable, scale: Callable, guess: PyTree[Array], pending: Bool[Array, ""]
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    r"""Solves $y = \Phi(y)$ from a `guess`, where $\Phi$ is the `image`. Returns the last
    iterate, and whether it is a solution. A path that is not `pending` counts as solved.

    1. Three sweeps make an iterate and two corrections.
    2. If the ratio of these corrections shows slow convergence, further sweeps are relaxed.
    3. Sweeps follow until they have converged or diverged, or are too many.

    `scale` maps an iterate to the sizes to which errors are relative. The arguments are
    those that [`diffrax_symplectic.PicardNewton`][] is called with.

    Unless the unknowns are `Halves`, the equations are doubled, to $p = \Phi(q)$ and $q =
    \Phi(p)$, with the halves $p$ and $q$. These equations also hold for a cycle of period
    two, in which $p \neq q$. So they are solved only when $p = q$.
    """
    in_halves = isinstance(guess, Halves)
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    eps = jnp.finfo(dtype).eps
    one = jnp.ones((), dtype)

    def sweep(y: Halves, relaxation: Scalar | None = None) -> Halves:
        """Computes $p$ from $q$, then $q$ from the new $p$."""
        unrelaxed_p = image(y).p if in_halves else image(y.q)
        y = Halves(_relaxed(unrelaxed_p, y.p, relaxation), y.q)
        unrelaxed_q = image(y).q if in_halves else image(y.p)
        return Halves(y.p, _relaxed(unrelaxed_q, y.q, relaxation))

    def correction(old: Halves, new: Halves) -> PyTree[Array]:
        """The change by a sweep. For doubled equations it is the difference of the two
        halves, since only equal halves are a solution."""
        return (new**ω - old**ω).ω if in_halves else (new.q**ω - new.p**ω).ω

    first = sweep(guess if in_halves else Halves(guess, guess))
    # The tolerance of each leaf is two units in the last place, up to a factor of two. It
    # is computed once, from the sizes at the first iterate.
    scales = _sizes(scale(first if in_halves else first.q))
    tolerance = _Tolerance(
        weights=[_rough_inverse(2 * eps * x) for x in scales],
        rounding=ROUNDINGS * eps * _largest(scales),
    )
    # Two more sweeps before the loop make two corrections, whose ratio is the rate of
    # convergence. The first correction has none before it to be compared with: `one` stands
    # in, and only the size is used.
    second = sweep(first)
    third = sweep(second)
    size_before, _ = tolerance.check(correction(first, second), size_before=one)
    size, is_solved = tolerance.check(correction(second, third), size_before)
    # The relaxation is chosen once: later rates are those of relaxed sweeps, to which its
    # formula does not apply. A relaxation of one changes nothing. The formula stands in a
    # branch, since few paths need it, and its division takes as long as a sweep.
    relaxation = lax.cond(
        size > SLOW * size_before,
        lambda: best_relaxation(jnp.minimum(size / size_before, _LARGEST_RATE)),
        lambda: one,
    )

    def sweep_again(state: _SweepState) -> _SweepState:
        y = sweep(state.y, relaxation)
        size, is_solved = tolerance.check(correction(state.y, y), state.size)
        return _SweepState(y, size, is_solved, state.num_sweeps + 1)

    def goes_on(state: _SweepState) -> Bool[Array, ""]:
        may_sweep = state.num_sweeps < _MOST_SWEEPS
        return ~state.is_solved & may_sweep & (state.size < _DIVERGED)

    # A path that is not pending counts as solved, so that it makes no more sweeps.
    counts_as_solved = ~pending | is_solved
    num_sweeps = jnp.full((), 3, jnp.int32)
    state = _SweepState(third, size, counts_as_solved, num_sweeps)
    end = lax.while_loop(goes_on, sweep_again, state)
    # For doubled equations one more image is taken, as half a sweep: the halves differ by
    # the last correction, which may be larger than the tolerance, since convergence is
    # decided by the expected next correction. With this image, paths of a field with jumps
    # were off by 0.7 units in the last place, and without it by 49.
    return end.y if in_halves else image(end.y.q), end.is_solved


def _relaxed(new: PyTree, old: PyTree, relaxation: Scalar | None) -> PyTree[Array]:
    """The `new` values, or if there is a `relaxation`, `old + relaxation * (new - old)`.
    (Without one, this takes fewer operations than with a relaxation of one.)"""
    if relaxation is None:
        return new
    return (old**ω + relaxation * (new**ω - old**ω)).ω


def _rough_inverse(x: Scalar) -> Scalar:
    """The inverse of a positive finite number `x`, up to a factor of two: `2^-k` for
    `2^k <= x < 2^(k + 1)`. It is found from the bits of `x`, since a division takes as long
    as a sweep.

    The inverse of zero is a large finite number. A number that is not finite gives minus
    infinity, and the check at the end of the step finds that the step failed.
    """
    info = jnp.finfo(x.dtype)
    integer = jnp.dtype(f"int{info.bits}")
    # Read as an integer, the bits of a float are its exponent, followed by the `nmant` bits
    # of its mantissa. Shifts there and back set the mantissa to zero: `2^k` is left.
    bits_of_one = int(np.asarray(1, x.dtype).view(integer))
    bits_of_power = lax.bitcast_convert_type(x, integer) >> info.nmant << info.nmant
    # The exponent of 2^k is stored as `k + offset`, that of 1 as `offset`, and that of 2^-k
    # as `2 offset - (k + offset)`.
    inverse = jnp.asarray(2 * bits_of_one, integer) - bits_of_power
    return lax.bitcast_convert_type(inverse, x.dtype)


def _sizes(y: PyTree[Array]) -> list[Scalar]:
    """The largest absolute value in each leaf."""
    return [_largest([*jnp.abs(x).reshape(-1)]) for x in jtu.tree_leaves(y)]


def _largest(numbers: list[Scalar]) -> Scalar:
    largest, *others = numbers
    for x in others:
        # `jnp.maximum` would take three more operations to propagate NaN. This is not
        # needed: the check at the end of the step finds NaN in any case.
        largest = jnp.where(largest > x, largest, x)
    return largest


class Sweeps(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, Any]):
    """Solves the stage equations by sweeps, and fails if sweeps do not converge. `init`
    makes all sweeps, and Optimistix makes no step. The state of the root finder is what
    `solve_one_path` returns: the last iterate, and whether it is a solution."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        del fn, f_struct, aux_struct, tags
        # The stages are solved block by block, where the equations of a block do not depend
        # on later ones. The guess `y` is zero, or NaN for a path that failed before.
        # Constant zeros in its place need no registers.
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
    """Replaces each `PicardNewton` in a solver, and in the solvers in it, by `Sweeps`,
    which do not fall back to Newton's method. Raises a `ValueError` unless the tolerance is
    the default, rounding error."""

    def with_sweeps(implicit_solver: Any) -> Any:
        # The other fields of `PicardNewton` may have any value. JAX uses them when it
        # simulates the paths that are not solved here.
        for name in ("rtol", "atol", "norm"):
            value = getattr(implicit_solver.root_finder, name)
            if value != getattr(PicardNewton(), name):
                raise ValueError(
                    '`engine="drjit"` solves each step to rounding error; got '
                    f"`PicardNewton({name}={value})`. Leave this out, or pass "
                    '`engine="jax"`.'
                )
        # `Sweeps` solves the equations in `init`, so no steps are needed.
        return eqx.tree_at(
            lambda x: (x.root_finder, x.root_find_max_steps),
            implicit_solver,
            (Sweeps(), 0),
        )

    return with_changed_stages(solver, with_sweeps)
