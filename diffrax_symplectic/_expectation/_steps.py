"""Paths that take fixed steps together: the loop that all samplings share, and the paths
that are independent of each other."""

import abc
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .._custom_types import Args, RealScalarLike, Y
from .._terms import brownian_paths, replace_paths


class Level(eqx.Module):
    """One step size: which one, counted from the coarsest, how many steps there are, and
    after which of them to average."""

    index: Int[Array, ""]
    h: Float[Array, ""]
    num_steps: Int[Array, ""]
    saved_steps: Int[Array, " saves"]


class Problem(eqx.Module):
    """What is asked for: the arguments of `expectation` of the same names, and the levels,
    along a leading axis."""

    phi: Callable[[RealScalarLike, Y, Args], PyTree[Array]]
    terms: PyTree[diffrax.AbstractTerm]
    solver: diffrax.AbstractSolver
    t0: Float[Array, ""]
    y0: Y
    args: Args
    levels: Level
    # Whether there is one time at which to average, without an axis for it.
    at_end: bool = eqx.field(static=True)
    # Steps of the finest level. (An array has to know its size when it is compiled.)
    max_steps: int = eqx.field(static=True)

    def level(self, index: int) -> Level:
        return jtu.tree_map(lambda x: x[index], self.levels)

    def init(self, terms, h: Float[Array, ""]) -> PyTree:
        return self.solver.init(terms, self.t0, self.t0 + h, self.y0, self.args)

    def step(self, terms, i, h, y: Y, state) -> tuple[Y, PyTree, Bool[Array, ""]]:
        """One step of one path, and whether it succeeded."""
        t, next_t = self.t0 + i * h, self.t0 + (i + 1) * h
        y, _, _, state, result = self.solver.step(
            terms, t, next_t, y, self.args, state, made_jump=False
        )
        return y, state, diffrax.is_okay(result) & is_finite(y)

    def outputs(self) -> list[jax.ShapeDtypeStruct]:
        """Shapes of `phi`, and the dtypes in which it is averaged."""
        shapes = jtu.tree_leaves(jax.eval_shape(self.phi, self.t0, self.y0, self.args))
        return [jax.ShapeDtypeStruct(s.shape, real(s.dtype)) for s in shapes]


class Ensemble(eqx.Module):
    """Paths, along the first axis of each array."""

    y: Y
    # The arrays of the solver's state. The rest of it does not change.
    solver_state: PyTree[Any]
    # A path that failed counts as failed until the end. It goes on from `y0`: an equation
    # without a solution would keep the other paths waiting in each step to come.
    failed: Bool[Array, " n"]


def ensemble_of(p: Problem, n: int, state: PyTree) -> Ensemble:
    """`n` paths at the start."""
    y = jtu.tree_map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), p.y0)
    return Ensemble(y, state, jnp.zeros(n, bool))


def moved(p: Problem, ensemble: Ensemble, y, state, success) -> Ensemble:
    """The paths after a step to `y`, with those that failed put back."""
    failed = ensemble.failed | ~success
    keep = lambda new, old: jnp.where(along(failed, new), old, new)
    return Ensemble(
        jtu.tree_map(keep, y, p.y0),
        jtu.tree_map(keep, state, ensemble.solver_state),
        failed,
    )


def simulate(
    p: Problem,
    level: Level,
    ensemble: Ensemble,
    step: Callable[[Int[Array, ""], Ensemble, Any], tuple[Ensemble, Any]],
    carried: Any,
    measure: Callable[[Array, Bool[Array, " n"]], Array],
) -> tuple[PyTree[Array], Ensemble, Any]:
    """Takes all steps of a level by `step(i, ensemble, carried)`. Returns what `measure`
    makes of the values of `phi` and of which paths have failed, with an axis in front for
    the saved steps; and the paths and what was carried along at the end."""

    def recorded(ensemble: Ensemble, saved, i):
        t = p.t0 + i * level.h

        def record():
            phi = jax.vmap(lambda y: p.phi(t, y, p.args))(ensemble.y)
            phi = jtu.tree_map(lambda x: x.astype(real(x.dtype)), phi)
            failed = ensemble.failed | ~jax.vmap(is_finite)(phi)
            here = level.saved_steps == i
            put = lambda old, x: jnp.where(along(here, old), measure(x, failed), old)
            return failed, jtu.tree_map(put, saved, phi)

        # A conditional with one predicate for all paths: `phi` is not evaluated otherwise.
        here = jnp.any(level.saved_steps == i)
        failed, saved = lax.cond(here, record, lambda: (ensemble.failed, saved))
        return Ensemble(ensemble.y, ensemble.solver_state, failed), saved

    def body(i, carry):
        ensemble, carried, saved = carry
        ensemble, carried = step(i, ensemble, carried)
        ensemble, saved = recorded(ensemble, saved, i + 1)
        return ensemble, carried, saved

    n, saves = len(ensemble.failed), len(level.saved_steps)

    def empty(s):
        one = jax.ShapeDtypeStruct((n, *s.shape), real(s.dtype))
        shape = jax.eval_shape(measure, one, ensemble.failed)
        return jnp.zeros((saves, *shape.shape), shape.dtype)

    saved = jtu.tree_map(empty, jax.eval_shape(p.phi, p.t0, p.y0, p.args))
    ensemble, saved = recorded(ensemble, saved, 0)
    carry = ensemble, carried, saved
    ensemble, carried, saved = lax.fori_loop(0, level.num_steps, body, carry)
    return saved, ensemble, carried


class Samples(eqx.Module):
    """Samples along the first axis: their values, which of them are good, and how many
    paths failed in each."""

    values: PyTree[Array]
    good: Bool[Array, " n"]
    failed: Int[Array, " n"]


class AbstractSampler(eqx.Module):
    """Makes samples of random keys: paths, or whatever else estimates of the mean can be
    averaged."""

    @abc.abstractmethod
    def __call__(self, keys: PRNGKeyArray) -> Samples:
        """One sample for each key."""


class AbstractLevelSampler(AbstractSampler):
    """Estimates the means of a problem on each level. Their combinations with `weights`,
    along a new axis in front, are what is averaged."""

    problem: eqx.AbstractVar[Problem]
    weights: eqx.AbstractVar[Float[np.ndarray, "combinations levels"]]

    @abc.abstractmethod
    def on_level(
        self, keys: PRNGKeyArray, level: Level
    ) -> tuple[PyTree[Array], Bool[Array, " n"], Bool[Array, " n"] | Int[Array, " n"]]:
        """Values of `phi` with axes in front for the saved steps and the samples; which
        samples are good; how many paths failed in each, or whether the only one did."""

    def __call__(self, keys: PRNGKeyArray) -> Samples:
        levels = self.problem.levels
        one = lambda level: self.on_level(keys, level)
        if len(levels.h) == 1:
            out = jtu.tree_map(lambda x: x[None], one(self.problem.level(0)))
        else:
            # One program for all levels.
            out = lax.map(one, levels)
        values, good, failed = out

        def combined(x):
            x = jnp.tensordot(jnp.asarray(self.weights, x.dtype), x, 1)
            return jnp.moveaxis(x, 2, 0)

        values = jtu.tree_map(combined, values)
        if self.problem.at_end:
            values = jtu.tree_map(lambda x: x[:, :, 0], values)
        # A path fails once, on however many levels.
        total = jnp.any if failed.dtype == bool else jnp.sum
        return Samples(values, jnp.all(good, axis=0), total(failed, axis=0).astype(int))


class IndependentPathsSampler(AbstractLevelSampler):
    """A sample is a path, on all levels with the same random key."""

    problem: Problem
    weights: Float[np.ndarray, "combinations levels"]

    def on_level(self, keys, level):
        p, n = self.problem, len(keys)
        keys = jax.vmap(lambda key: path_keys(p.terms, key))(keys)
        start = lambda keys: p.init(with_keys(p.terms, keys), level.h)
        state = eqx.filter_vmap(start)(keys)
        state, static = eqx.partition(state, eqx.is_array)

        def step(i, ensemble, carried):
            def one(keys, y, state):
                terms, state = with_keys(p.terms, keys), eqx.combine(state, static)
                y, state, success = p.step(terms, i, level.h, y, state)
                return y, eqx.filter(state, eqx.is_array), success

            out = jax.vmap(one)(keys, ensemble.y, ensemble.solver_state)
            return moved(p, ensemble, *out), carried

        ensemble = ensemble_of(p, n, state)
        saved, ensemble, _ = simulate(p, level, ensemble, step, None, lambda x, _: x)
        return saved, ~ensemble.failed, ensemble.failed


def path_keys(terms: PyTree[diffrax.AbstractTerm], key: PRNGKeyArray) -> list[Array]:
    """New random keys for the paths in `terms`, made from `key`. Paths that had the same
    key get the same one again."""
    new = []
    for x in filter(is_key, jtu.tree_leaves(brownian_paths(terms))):
        typed = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        words = jr.key_data(x) if typed else x
        own = key
        for word in words.reshape(-1):
            own = jr.fold_in(own, word)
        data = jr.bits(own, words.shape, jnp.uint32)
        new.append(jr.wrap_key_data(data, impl=jr.key_impl(x)) if typed else data)
    return new


def with_keys(terms: PyTree[diffrax.AbstractTerm], keys: list[Array]) -> PyTree:
    """The terms with paths that have these keys."""
    left = iter(keys)
    replaced = lambda x: next(left) if is_key(x) else x
    return replace_paths(terms, lambda path: jtu.tree_map(replaced, path))


def is_key(x) -> bool:
    """Whether an array of a Brownian path is its random key."""
    dtype = getattr(x, "dtype", None)
    return dtype is not None and (
        jnp.issubdtype(dtype, jax.dtypes.prng_key) or dtype == jnp.uint32
    )


def mean_of_good(x: Array, failed: Bool[Array, " n"]) -> Float[Array, "..."]:
    """The mean over the paths that have not failed."""
    x = jnp.where(along(~failed, x), x, 0)
    # In two stages, so that rounding errors in single precision do not add up.
    rows = 1 << ((len(x).bit_length() - 1) // 2)
    total = jnp.sum(jnp.sum(x.reshape(rows, -1, *x.shape[1:]), axis=0), axis=0)
    return total / jnp.sum(~failed).astype(total.dtype)


def along(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask of the first axis, to go with an array."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))


def is_finite(tree: PyTree[Array]) -> Bool[Array, ""]:
    leaves = [jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(tree)]
    return jnp.all(jnp.stack(leaves))


def real(dtype) -> Any:
    return jnp.result_type(dtype, float)
