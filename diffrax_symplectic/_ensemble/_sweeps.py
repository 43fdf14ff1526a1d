"""The root finder of a fused step: sweeps of one path, and no rescue."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._root_finder import PicardNewton
from .._solver import AbstractImplicitStages


_Map: TypeAlias = Callable[[PyTree[Array]], PyTree[Array]]
_Halves: TypeAlias = tuple[PyTree[Array], PyTree[Array]]

# Where this many do not solve a step, the path is left to JAX's program.
_MOST_SWEEPS = 48
# Above this rate of convergence they are damped.
_SLOW = 0.3
# The next correction is below two units in the last place by this factor: what is left out
# has the same sign in every step, and adds up.
_MARGIN = 64.0
# Corrections of so many units of the largest value that no longer shrink are rounding.
_ROUNDING = 50.0
# Corrections beyond this many units lead nowhere.
_HUGE = 1e30


class Limits(NamedTuple):
    """`scale(y)` is how large the state is that unknown values `y` change."""

    scale: Callable[[PyTree[Array]], PyTree[Array]] = lambda y: y


class Found(NamedTuple):
    """Where sweeps ended, and whether they solved the equations: they are `near` only if
    they did."""

    y: PyTree[Array]
    solved: Bool[Array, ""]
    near: Bool[Array, ""]


class _Progress(NamedTuple):
    """The iterate, as two halves that read each other; the size of its last correction in
    units of the tolerance; whether the equations are solved; how many sweeps there were."""

    y: _Halves
    size: Scalar
    solved: Bool[Array, ""]
    count: Array


class _Pairs(NamedTuple):
    """Unknown values that are a list of pairs `(p, q)`. In a sweep `q` reads what `p` has
    become (Gauss--Seidel)."""

    image: _Map

    def split(self, y: PyTree[Array]) -> _Halves:
        p, q = zip(*y)
        return list(p), list(q)

    def join(self, y: _Halves) -> PyTree[Array]:
        return list(zip(*y))

    def first(self, y: _Halves) -> PyTree[Array]:
        return self.split(self.image(self.join(y)))[0]

    def second(self, y: _Halves) -> PyTree[Array]:
        return self.split(self.image(self.join(y)))[1]

    def change(self, old: _Halves, new: _Halves) -> PyTree[Array]:
        return _difference(self.join(new), self.join(old))


class _Copies(NamedTuple):
    """Of other unknown values two copies read each other."""

    image: _Map

    def split(self, y: PyTree[Array]) -> _Halves:
        return y, y

    def join(self, y: _Halves) -> PyTree[Array]:
        return y[1]

    def first(self, y: _Halves) -> PyTree[Array]:
        return self.image(y[1])

    def second(self, y: _Halves) -> PyTree[Array]:
        return self.image(y[0])

    def change(self, old: _Halves, new: _Halves) -> PyTree[Array]:
        # Copies that no longer move may still differ: then neither is a solution.
        del old
        return _difference(new[1], new[0])


def sweep(limits: Limits, image: _Map, begin: Found) -> Found:
    r"""Solves $y = \Phi(y)$ from `begin` on, or reports that sweeps do not.

    After the third sweep values stay behind by a fraction of their change where that makes
    sweeps converge faster, as in [`diffrax_symplectic.PicardNewton`][]. In a fused kernel
    each path ends by itself, and to look at the error after each sweep costs little.
    """
    is_pair = lambda x: type(x) is tuple and len(x) == 2
    pairs = type(begin.y) is list and all(map(is_pair, begin.y))
    halves = _Pairs(image) if pairs else _Copies(image)

    def once(y: _Halves, damping: Scalar) -> _Halves:
        stay = lambda new, old: jtu.tree_map(
            lambda a, b: a + damping * (b - a), new, old
        )
        y = stay(halves.first(y), y[0]), y[1]
        return y[0], stay(halves.second(y), y[1])

    zero = jnp.zeros((), jnp.result_type(*jtu.tree_leaves(begin.y)))
    start = halves.split(begin.y)
    first = once(start, zero)
    # The tolerance is that of the state after the first sweep, which there is in any case.
    scales = _sizes(limits.scale(halves.join(first)))
    weights = [_inverse(2 * jnp.finfo(zero.dtype).eps * x) for x in scales]
    rounding = _ROUNDING * 2 * jnp.finfo(zero.dtype).eps * _largest(scales)

    def judge(
        old: _Halves, new: _Halves, before: Scalar
    ) -> tuple[Scalar, Bool[Array, ""]]:
        """The size of a correction, after one of size `before`, and whether it is the last
        that is needed."""
        gaps = _sizes(halves.change(old, new))
        size = _largest([x * weight for x, weight in zip(gaps, weights)])
        below = _MARGIN * size * jnp.where(size < before, size, before) <= before
        stays = (size >= 0.9 * before) & (_largest(gaps) <= rounding)
        return size, below | stays

    second = once(first, zero)
    third = once(second, zero)
    before, _ = judge(first, second, zero)
    size, solved = judge(second, third, before)

    def damped() -> Scalar:
        """For the rate at which the sweeps converge."""
        return 1 - 2 / (1 + jnp.sqrt(1 + jnp.minimum(size / before, 4)))

    damping = lax.cond(size > _SLOW * before, damped, lambda: zero)

    def advance(last: _Progress) -> _Progress:
        y = once(last.y, damping)
        size, solved = judge(last.y, y, last.size)
        return _Progress(y, size, solved, last.count + 1)

    def going(last: _Progress) -> Bool[Array, ""]:
        on = (last.count < _MOST_SWEEPS) & (last.size < _HUGE)
        return ~last.solved & on

    count = jnp.full((), 3, jnp.int32)
    begun = _Progress(third, size, begin.solved | solved, count)
    last = lax.while_loop(going, advance, begun)
    return Found(halves.join(last.y), last.solved, last.solved)


def _inverse(x: Scalar) -> Scalar:
    """Of a positive number, to within a factor of two: by its exponent, since a division
    takes as long as a sweep. That of zero is large, not infinite."""
    info = jnp.finfo(x.dtype)
    kind = jnp.dtype(f"int{info.bits}")
    one = int(np.asarray(1, x.dtype).view(kind))
    exponent = lax.bitcast_convert_type(x, kind) >> info.nmant << info.nmant
    return lax.bitcast_convert_type(jnp.asarray(2 * one, kind) - exponent, x.dtype)


def _difference(a: PyTree[Array], b: PyTree[Array]) -> PyTree[Array]:
    return jtu.tree_map(lambda a, b: a - b, a, b)


def _sizes(y: PyTree[Array]) -> list[Scalar]:
    return [_largest([*jnp.abs(x).reshape(-1)]) for x in jtu.tree_leaves(y)]


def _largest(x: list[Scalar]) -> Scalar:
    return ft.reduce(_larger, x)


def _larger(a: Scalar, b: Scalar) -> Scalar:
    # `jnp.maximum` would keep what is not a number, for the price of three operations. The
    # end of the step shows that, too.
    return jnp.where(a > b, a, b)


class Sweeps(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, Found]):
    """Sweeps, and a failure where they do not solve the stage equations. All is done in
    `init`: there are no steps after it."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Found:
        del fn, args, f_struct, aux_struct, tags
        zeros = jtu.tree_map(jnp.zeros_like, y)
        begun = Found(zeros, solved=options["lost"], near=options["lost"])
        return options["sweep"](Limits(), begun, sweep)

    def step(self, fn, y, args, options, state, tags):
        del fn, args, options, tags
        return y, state, None

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.solved, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, y, args, options, tags, result
        return state.y, aux, {}


def without_rescue(solver: Any) -> Any:
    """The same solver, and within it each that has a `PicardNewton`, with sweeps alone."""
    is_implicit = lambda x: isinstance(x, AbstractImplicitStages)

    def replace(x: Any) -> Any:
        if not (is_implicit(x) and isinstance(x.root_finder, PicardNewton)):
            return x
        fields = lambda s: (s.root_finder, s.root_find_max_steps)
        return eqx.tree_at(fields, x, (Sweeps(), 0))

    return jtu.tree_map(replace, solver, is_leaf=is_implicit)
