"""The root finder of a fused step: sweeps for one path, without a fallback.

When corrections are small enough, and when sweeps are relaxed, is decided as in
`_root_finder/sweeps.py`. The loop is another: there all paths of a batch sweep together,
and checks are rare since they cost much. In a kernel each path ends by itself, and checks
after every sweep.
"""

import functools as ft
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
    MARGIN,
    PicardNewton,
    ROUNDINGS,
    SLOW,
    STALLED,
)
from .._solver import with_changed_stages


# A path with a step that needs more sweeps is handed back to JAX.
_MOST_SWEEPS = 48
# Beyond a correction of so many tolerances sweeps diverge. (It is finite in single
# precision, too.)
_HUGE = 1e30
# Sweeps that diverge are relaxed as for this rate at most: their own may be infinite.
_FASTEST_GROWTH = 4


class _Equations(NamedTuple):
    r"""The equations $y = \Phi(y)$ of a step, in two halves.

    - `image`: the map $\Phi$.
    - `in_halves`: whether unknowns are `Halves`. Otherwise these are the doubled system
        $y = \Phi(z)$, $z = \Phi(y)$. It is solved when $y = z$: a cycle of period two
        solves it, too, with $y \neq z$.
    """

    image: Callable[[PyTree[Array]], PyTree[Array]]
    in_halves: bool

    def start(self, guess: PyTree[Array]) -> Halves:
        return guess if self.in_halves else Halves(guess, guess)

    def sweep(self, y: Halves, relaxation: Scalar | None = None) -> Halves:
        """The iterate after a sweep, in which $q$ reads the new $p$. `None` is no
        relaxation, and no operation."""
        new_p = self.image(y).p if self.in_halves else self.image(y.q)
        y = Halves(_relaxed(new_p, y.p, relaxation), y.q)
        new_q = self.image(y).q if self.in_halves else self.image(y.p)
        return Halves(y.p, _relaxed(new_q, y.q, relaxation))

    def value(self, y: Halves) -> PyTree[Array]:
        """An iterate in the structure of the unknowns."""
        return y if self.in_halves else y.q

    def correction(self, old: Halves, new: Halves) -> PyTree[Array]:
        """How far an iterate is from a solution, by the last sweep."""
        return (new**ω - old**ω).ω if self.in_halves else (new.q**ω - new.p**ω).ω


def _relaxed(new: PyTree, old: PyTree, relaxation: Scalar | None) -> PyTree[Array]:
    if relaxation is None:
        return new
    return (old**ω + relaxation * (new**ω - old**ω)).ω


class _Criterion(NamedTuple):
    """When a correction is small enough.

    - `weights`: for each leaf, the inverse of its tolerance.
    - `rounding`: the largest correction that may be a rounding error.
    """

    weights: list[Scalar]
    rounding: Scalar

    def measure(
        self, correction: PyTree[Array], before: Scalar
    ) -> tuple[Scalar, Bool[Array, ""]]:
        """The size of a correction that follows one of size `before`, in units of the
        tolerance, and whether sweeps have converged."""
        sizes = _sizes(correction)
        size = _largest([x * weight for x, weight in zip(sizes, self.weights)])
        # The next correction is smaller by the same ratio, `size / before`: without the
        # division. A growing correction says nothing about the next.
        smaller = jnp.where(size < before, size, before)
        below = 2.0**MARGIN * size * smaller <= before
        stalled = size >= 2.0**STALLED * before
        return size, below | (stalled & (_largest(sizes) <= self.rounding))


class _State(NamedTuple):
    """The state of the loop over sweeps.

    - `y`: the iterate.
    - `size`: the size of its last correction, in units of the tolerance.
    - `is_solved`: whether the equations are solved.
    - `done`: the number of sweeps.
    """

    y: Halves
    size: Scalar
    is_solved: Bool[Array, ""]
    done: Array


def solve_one_path(
    image: Callable, scale: Callable, guess: PyTree[Array], pending: Bool[Array, ""]
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    r"""Solves $y = \Phi(y)$ from a `guess`, if it is `pending`. Returns the last iterate,
    and whether it is a solution.

    The arguments are those that [`diffrax_symplectic.PicardNewton`][] is called with.
    """
    equations = _Equations(image, isinstance(guess, Halves))
    dtype = jnp.result_type(*jtu.tree_leaves(guess))
    # Three sweeps before the loop: they make two corrections, whose ratio is the rate of
    # convergence.
    first = equations.sweep(equations.start(guess))
    criterion = _criterion(scale(equations.value(first)), dtype)
    second = equations.sweep(first)
    third = equations.sweep(second)
    one = jnp.ones((), dtype)
    before, _ = criterion.measure(equations.correction(first, second), one)
    size, is_solved = criterion.measure(equations.correction(second, third), before)

    # Relaxed once: later rates are those of relaxed sweeps, to which the formula does not
    # apply. A branch, since few paths take it, and a division takes as long as a sweep.
    relaxation = lax.cond(
        size > SLOW * before,
        lambda: best_relaxation(jnp.minimum(size / before, _FASTEST_GROWTH)),
        lambda: one,
    )

    def sweep_again(last: _State) -> _State:
        y = equations.sweep(last.y, relaxation)
        correction = equations.correction(last.y, y)
        size, is_solved = criterion.measure(correction, last.size)
        return _State(y, size, is_solved, last.done + 1)

    def goes_on(last: _State) -> Bool[Array, ""]:
        return ~last.is_solved & (last.done < _MOST_SWEEPS) & (last.size < _HUGE)

    state = _State(third, size, ~pending | is_solved, jnp.full((), 3, jnp.int32))
    last = lax.while_loop(goes_on, sweep_again, state)
    return equations.value(last.y), last.is_solved


def _criterion(scale: PyTree[Array], dtype: Any) -> _Criterion:
    """The criterion for a state of size `scale`: corrections below two units in the last
    place, leaf by leaf."""
    # The tolerance is taken once, at the first sweep.
    eps = jnp.finfo(dtype).eps
    scales = _sizes(scale)
    weights = [_inverse(2 * eps * x) for x in scales]
    return _Criterion(weights, ROUNDINGS * eps * _largest(scales))


def _inverse(x: Scalar) -> Scalar:
    """The inverse of a positive finite number up to a factor of two, from its exponent: a
    division takes as long as a sweep. The inverse of zero is large, not infinite. Others
    give minus infinity, which the check at the end finds."""
    info = jnp.finfo(x.dtype)
    kind = jnp.dtype(f"int{info.bits}")
    # Read as an integer, the bits of a float are its exponent, followed by its mantissa,
    # which is cut off. The difference of two such integers subtracts exponents.
    one = int(np.asarray(1, x.dtype).view(kind))
    power = lax.bitcast_convert_type(x, kind) >> info.nmant << info.nmant
    return lax.bitcast_convert_type(jnp.asarray(2 * one, kind) - power, x.dtype)


def _sizes(y: PyTree[Array]) -> list[Scalar]:
    """The largest entry of each leaf, by size."""
    return [_largest([*jnp.abs(x).reshape(-1)]) for x in jtu.tree_leaves(y)]


def _largest(numbers: list[Scalar]) -> Scalar:
    return ft.reduce(_larger, numbers)


def _larger(a: Scalar, b: Scalar) -> Scalar:
    # `jnp.maximum` propagates NaN at the price of three operations. The check at the end of
    # the step finds NaN in any case.
    return jnp.where(a > b, a, b)


class Sweeps(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, Any]):
    """Solves the stage equations by sweeps, in `init`; fails if they do not converge."""

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
        return state[1], optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, y, args, options, tags, result
        return state[0], aux, {}


def without_rescue(solver: Any) -> Any:
    """The solver, and all solvers in it, with `Sweeps` in place of `PicardNewton`."""

    def with_sweeps(x: Any) -> Any:
        _check_tolerance(x.root_finder)
        # No iterations of Optimistix: `Sweeps` solves the equations before the first.
        fields = lambda stages: (stages.root_finder, stages.root_find_max_steps)
        return eqx.tree_at(fields, x, (Sweeps(), 0))

    return with_changed_stages(solver, with_sweeps)


def _check_tolerance(finder: PicardNewton) -> None:
    """Raises a `ValueError` for another tolerance than rounding error. (Numbers of steps
    are those of JAX, which takes the paths that are not solved here.)"""
    usual = PicardNewton()
    for name in ("rtol", "atol", "norm"):
        if getattr(finder, name) != getattr(usual, name):
            raise ValueError(
                '`engine="drjit"` solves each step to rounding error; got '
                f"`PicardNewton({name}={getattr(finder, name)})`. Leave it out, or pass "
                '`engine="jax"`.'
            )
