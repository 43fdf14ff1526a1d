"""The loop over fixed steps that all samplings share."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from .._custom_types import Y
from .._root_finder import all_finite
from .problem import Level, Problem


class Paths(eqx.Module):
    """Paths, along the first axis of each array."""

    y: Y
    solver_state: PyTree[Array]
    # A failed path stays failed, and continues from `y0`: otherwise stage equations without
    # a solution would hold up the other paths in every later step.
    failed: Bool[Array, " n"]
    # The arrays of `args`, if each path has its own.
    args: PyTree[Array]
    # The control variate, if any.
    control: Any

    @staticmethod
    def start(
        p: Problem, y: Y, args: PyTree, state: PyTree[Array], control=None
    ) -> "Paths":
        """Paths that start at `y` with these `args`, both from `Problem.drawn`."""
        failed = ~jax.vmap(all_finite)(y)
        keep = lambda new, old: jnp.where(along(failed, new), old, new)
        return Paths(jtu.tree_map(keep, y, p.y0), state, failed, args, control)

    def moved(self, p: Problem, y, state, success, control=None) -> "Paths":
        """The paths after a step to `y`, with failed paths reset."""
        failed = self.failed | ~success
        keep = lambda new, old: jnp.where(along(failed, new), old, new)
        state = jtu.tree_map(keep, state, self.solver_state)
        y = jtu.tree_map(keep, y, p.y0)
        return Paths(y, state, failed, self.args, control)


def simulate(
    p: Problem,
    begin: Callable[[Level], tuple[Callable, Paths]],
    measure: Callable[[Array, Bool[Array, " n"]], Array] = lambda phi, failed: phi,
) -> tuple[Float[Array, "levels S ..."], Bool[Array, "levels n"], Any]:
    """Solves all levels. For each level `begin` returns `step(i, paths)` and the initial
    paths. Returns `measure(phi, failed)` after each saved step, which paths have failed at
    the end, and their control variates."""

    def on_level(level):
        step, paths = begin(level)
        n, (saves, m) = len(paths.failed), p.num_outputs

        def recorded(i, paths: Paths, saved):
            def record():
                value = lambda y, args: p.with_args(args).values(p.t0 + i * level.h, y)
                phi = jax.vmap(value)(paths.y, paths.args)
                failed = paths.failed | ~jax.vmap(all_finite)(phi)
                here = along(level.saved_steps == i, saved)
                return failed, jnp.where(here, measure(phi, failed), saved)

            # One predicate for all paths, so that `phi` is evaluated only after saved
            # steps.
            here = jnp.any(level.saved_steps == i)
            failed, saved = lax.cond(here, record, lambda: (paths.failed, saved))
            return eqx.tree_at(lambda e: e.failed, paths, failed), saved

        def body(i, carry):
            paths, saved = carry
            return recorded(i + 1, step(i, paths), saved)

        dtype = jax.eval_shape(lambda: p.values(p.t0, p.y0)).dtype
        phi = jax.ShapeDtypeStruct((n, m), dtype)
        shape = jax.eval_shape(measure, phi, paths.failed).shape
        carry = recorded(0, paths, jnp.zeros((saves, *shape), dtype))
        paths, saved = lax.fori_loop(0, level.num_steps, body, carry)
        return saved, paths.failed, paths.control

    if len(p.levels.h) == 1:
        return jtu.tree_map(lambda x: x[None], on_level(p.level(0)))
    # All levels share one compiled program.
    return lax.map(on_level, p.levels)


def independent_steps(
    p: Problem,
    level: Level,
    drawn: tuple[Y, PyTree],
    terms_of: Callable,
    randomness: Callable,
) -> tuple[Callable[[Any, Paths], Paths], Paths]:
    """The step of independent paths, and these paths at the start, `drawn` by
    `Problem.drawn`. In step `i` each path has the terms `terms_of(r)`, with `r` its own row
    of `randomness(i)`."""

    def step(i, paths):
        def one(random, y, state, args):
            return p.with_args(args).step(terms_of(random), i, level.h, y, state)

        random = randomness(i)
        new = jax.vmap(one)(random, paths.y, paths.solver_state, paths.args)
        return paths.moved(p, *new)

    def start(random, y, args):
        return p.with_args(args).init(terms_of(random), 0, level.h, y)

    y, args = drawn
    state = jax.vmap(start)(randomness(0), y, args)
    return step, Paths.start(p, y, args, state)


def along(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask of the first axis, broadcastable against `x`."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))
