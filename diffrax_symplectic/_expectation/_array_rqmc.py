"""All paths of one randomization, sorted before each step: array-RQMC."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt32

from .._brownian import (
    AbstractStepwisePath,
    GivenPath,
    Increment,
    stepwise,
    THREE_POINT,
)
from .._custom_types import Y
from .._terms import brownian_paths, replace_paths
from ._point_set import MAX_DIMENSION, num_seeds, randomized, sobol_points
from ._sorting import hilbert_order
from ._steps import (
    AbstractLevelSampler,
    ensemble_of,
    mean_of_good,
    moved,
    Problem,
    real,
    simulate,
)


class ArrayRQMCSampler(AbstractLevelSampler):
    """A sample is the mean over all paths of a replicate. Algorithm 1 of
    [L'Ecuyer, Lécot and Tuffin (2008)](https://doi.org/10.1287/opre.1080.0556).

    `points` are those of `sobol_points`, with a coordinate for each random variable of a
    step."""

    problem: Problem
    weights: Float[np.ndarray, "combinations levels"]
    sort_by: Callable[[Y], PyTree[Array]]
    points: UInt32[Array, "n d"]
    layout: "Layout" = eqx.field(static=True)

    def on_level(self, keys, level):
        # (A batch is one replicate.)
        replicates = [self._replicate(key, level) for key in keys]
        values, good, failed = zip(*replicates)
        values = jtu.tree_map(lambda *xs: jnp.stack(xs, axis=1), *values)
        return values, jnp.stack(good), jnp.stack(failed)

    def _replicate(self, key, level):
        p, n = self.problem, len(self.points)
        key = jr.fold_in(key, level.index)

        def words(step):
            count = num_seeds(self.points.shape[1])
            seeds = jr.bits(jr.fold_in(key, step), (count,), jnp.uint32)
            return randomized(self.points, seeds, self.layout.sixths)

        def terms_of(words):
            return with_words(p.terms, self.layout, words)

        def step(i, ensemble, carried):
            order = hilbert_order(
                coordinates(self.sort_by, ensemble.y), ensemble.failed
            )
            ensemble = jtu.tree_map(lambda x: x[order], ensemble)

            def one(words, y, state):
                state = eqx.combine(state, static)
                y, state, success = p.step(terms_of(words), i, level.h, y, state)
                return y, eqx.filter(state, eqx.is_array), success

            out = jax.vmap(one)(words(i), ensemble.y, ensemble.solver_state)
            return moved(p, ensemble, *out), carried

        start = eqx.filter_vmap(lambda words: p.init(terms_of(words), level.h))(
            words(0)
        )
        state, static = eqx.partition(start, eqx.is_array)
        ensemble = ensemble_of(p, n, state)
        saved, ensemble, _ = simulate(p, level, ensemble, step, None, mean_of_good)
        return saved, jnp.array(True), jnp.sum(ensemble.failed)


def coordinates(sort_by, y: Y) -> Float[Array, "n d"]:
    """What the paths are sorted by, as one array."""
    leaves = jtu.tree_leaves(jax.vmap(sort_by)(y))
    columns = [jnp.reshape(leaf, (len(leaf), -1)) for leaf in leaves]
    return jnp.concatenate([x.astype(real(x.dtype)) for x in columns], axis=1)


def points_for(terms, num_paths: int) -> tuple["Layout", np.ndarray]:
    """Which random variables a step has, and points with a coordinate for each."""
    words = layout(terms)
    if not 0 < words.num_words <= MAX_DIMENSION:
        raise ValueError(
            f"`terms` need {words.num_words:,} random variables in each step. There have "
            f"to be some, and at most {MAX_DIMENSION:,}, as Sobol' points have. Pass "
            "`sampling=IndependentPaths(num_paths)`."
        )
    return words, sobol_points(num_paths, words.num_words)


class Layout(NamedTuple):
    """Which of the words of a step each path in `terms` takes, how many there are, and
    whether there is but one three-point variable."""

    slices: tuple[tuple[int, int], ...]
    num_words: int
    sixths: bool


def layout(terms: PyTree[diffrax.AbstractTerm]) -> Layout:
    """Equal paths are one Brownian motion, and take the same words. Raises a `ValueError`
    for a path whose increments cannot be made of given words."""
    paths = [stepwise(path) for path in brownian_paths(terms)]
    slices, end = [], 0
    for i, path in enumerate(paths):
        same = [j for j in range(i) if eqx.tree_equal(paths[j], path)]
        start = slices[same[0]][0] if same else end
        slices.append((start, start + path.num_words(use_levy=True)))
        end = max(end, slices[-1][1])
    sixths = end == 1 and paths[0].laws == {"W": THREE_POINT}
    return Layout(tuple(slices), end, sixths)


def with_words(
    terms: PyTree[diffrax.AbstractTerm],
    layout: Layout,
    words: UInt32[Array, " num_words"],
) -> PyTree[diffrax.AbstractTerm]:
    """The terms, with paths whose increments are made of these words."""
    slices = iter(layout.slices)

    def given(path: diffrax.AbstractBrownianPath) -> GivenPath:
        start, end = next(slices)
        make = jtu.Partial(_from_words, path, words[start:end])
        return GivenPath(make=make, levy_area=path.levy_area)

    return replace_paths(terms, given)


def _from_words(path: AbstractStepwisePath, words, t0, t1, use_levy: bool) -> Increment:
    """The increment of the path that is made of the first of these words."""
    return path.increment(words[: path.num_words(use_levy)], t0, t1, use_levy)
