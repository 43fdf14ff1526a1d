"""The root finder of a fused step: sweeps for one path, without a fallback."""

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

from .._root_finder import all_finite, Halves, PicardNewton
from .._solver import AbstractImplicitStages


# A path with a step that needs more sweeps is handed back to JAX.
_MOST_SWEEPS = 48
# Sweeps that converge at a slower rate are under-relaxed.
_SLOW = 0.3
# Sweeps end when the expected next correction is below two units in the last place by this
# factor: the remaining error has the same sign in every step, and accumulates.
_MARGIN = 64.0
# Corrections below this many units of the largest value that no longer shrink are rounding.
_ROUNDING = 50.0
# Corrections beyond this many units: the sweeps diverge.
_HUGE = 1e30


class _State(NamedTuple):
    """The iterate, the size of its last correction in units of the tolerance, whether the
    equations are solved, and the number of sweeps."""

    y: Halves
    size: Scalar
    solved: Bool[Array, ""]
    done: Array


def sweep(image: Callable, scale: Callable, guess: PyTree, pending: Bool[Array, ""]):
    r"""Solves $y = \Phi(y)$ from a `guess`. Returns the last iterate, and whether it is a
    solution.

    The sweeps are those of [`diffrax_symplectic.PicardNewton`][]. In a fused kernel each
    path ends by itself, so that a convergence check after each sweep costs little.
    """
    paired = isinstance(guess, Halves)
    # Without halves: Gauss-Seidel on the doubled system y = \Phi(z), z = \Phi(y). It is
    # solved when y = z: a cycle of period two solves it, too, with y != z.
    start = guess if paired else Halves(guess, guess)
    p = lambda y: image(y).p if paired else image(y.q)
    q = lambda y: image(y).q if paired else image(y.p)
    value = lambda y: y if paired else y.q
    minus = lambda y, z: jtu.tree_map(lambda a, b: a - b, y, z)
    correction = lambda old, new: minus(new, old) if paired else minus(new.q, new.p)
    one = jnp.ones((), jnp.result_type(*jtu.tree_leaves(guess)))
    unit = 2 * jnp.finfo(one.dtype).eps

    def once(y: Halves, omega: Scalar) -> Halves:
        behind = lambda x, old: jtu.tree_map(lambda a, b: b + omega * (a - b), x, old)
        relaxed = (lambda x, _: x) if omega is one else behind
        y = Halves(relaxed(p(y), y.p), y.q)
        return Halves(y.p, relaxed(q(y), y.q))

    first = once(start, one)
    # The tolerance is taken at the first sweep, which is needed in any case.
    scales = _sizes(scale(value(first)))
    weights = [_inverse(unit * x) for x in scales]
    rounding = _ROUNDING * unit * _largest(scales)

    def check(
        old: Halves, new: Halves, before: Scalar
    ) -> tuple[Scalar, Bool[Array, ""]]:
        """The size of a correction that follows one of size `before`, and whether the
        sweeps have converged."""
        gaps = _sizes(correction(old, new))
        size = _largest([x * weight for x, weight in zip(gaps, weights)])
        below = _MARGIN * size * jnp.where(size < before, size, before) <= before
        return size, below | ((size >= 0.9 * before) & (_largest(gaps) <= rounding))

    second = once(first, one)
    third = once(second, one)
    before, _ = check(first, second, one)
    size, solved = check(second, third, before)

    def best() -> Scalar:
        """The relaxation factor for the observed rate of convergence."""
        return 2 / (1 + jnp.sqrt(1 + jnp.minimum(size / before, 4)))

    omega = lax.cond(size > _SLOW * before, best, lambda: one)

    def step(last: _State) -> _State:
        y = once(last.y, omega)
        size, solved = check(last.y, y, last.size)
        return _State(y, size, solved, last.done + 1)

    def going(last: _State) -> Bool[Array, ""]:
        return ~last.solved & (last.done < _MOST_SWEEPS) & (last.size < _HUGE)

    state = _State(third, size, ~pending | solved, jnp.full((), 3, jnp.int32))
    last = lax.while_loop(going, step, state)
    return value(last.y), last.solved


def _inverse(x: Scalar) -> Scalar:
    """The inverse of a positive number up to a factor of two, from its exponent: a division
    takes as long as a sweep. The inverse of zero is large, not infinite."""
    info = jnp.finfo(x.dtype)
    kind = jnp.dtype(f"int{info.bits}")
    one = int(np.asarray(1, x.dtype).view(kind))
    exponent = lax.bitcast_convert_type(x, kind) >> info.nmant << info.nmant
    return lax.bitcast_convert_type(jnp.asarray(2 * one, kind) - exponent, x.dtype)


def _sizes(y: PyTree[Array]) -> list[Scalar]:
    return [_largest([*jnp.abs(x).reshape(-1)]) for x in jtu.tree_leaves(y)]


def _largest(x: list[Scalar]) -> Scalar:
    # `jnp.maximum` propagates NaN at the price of three operations. The check at the end of
    # the step finds NaN in any case.
    return ft.reduce(lambda a, b: jnp.where(a > b, a, b), x)


class Sweeps(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, Any]):
    """Solves the stage equations by sweeps, in `init`; fails if they do not converge."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        del fn, f_struct, aux_struct, tags
        zeros = jtu.tree_map(jnp.zeros_like, y)
        return options["solve_blocks"](args, sweep, zeros, all_finite(y))

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
    is_implicit = lambda x: isinstance(x, AbstractImplicitStages)

    def replace(x: Any) -> Any:
        if not (is_implicit(x) and isinstance(x.root_finder, PicardNewton)):
            return x
        _check_tolerance(x.root_finder)
        fields = lambda s: (s.root_finder, s.root_find_max_steps)
        return eqx.tree_at(fields, x, (Sweeps(), 0))

    return jtu.tree_map(replace, solver, is_leaf=is_implicit)


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
