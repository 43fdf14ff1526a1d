"""Array-RQMC: all paths of a randomization step together, sorted before each step."""

import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray, PyTree, UInt32

from .._arguments import check_real, check_takes, whole_number
from .._brownian import (
    AbstractStepwisePath,
    GivenPath,
    Increment,
    stepwise,
    THREE_POINT,
)
from .._custom_types import Y
from .._terms import brownian_paths, path_numbers, replace_paths
from ._fits import Functions
from ._problem import numbers, Problem
from ._run import run
from ._steps import along, independent_steps, simulate
from ._value_functions import value_function
from .points import hilbert_order, num_seeds, randomized, sobol_points
from .polynomials import tensordot
from .sampling import AbstractSampling, Plan, ROUNDING, Samples


# SciPy has direction numbers for this many coordinates of Sobol' points.
_MAX_DIMENSION = 21201
# Fewer replicates do not estimate their variance well enough to stop.
_BEFORE_STOPPING = 8
# With fewer paths along each coordinate, neighbours are far apart. The number of replicates
# by which two ways to sort are compared.
_FEW, _TRIAL = 3, 4
# Folded into the key of a replicate to draw the starts of its paths. (Numbers of levels are
# smaller.)
_STARTS = 0xFFFFFFFF


class ArrayRQMC(AbstractSampling):
    r"""Array-RQMC: randomized quasi-Monte Carlo across all paths of a replicate.

    All paths of a replicate take each step together. Before the step they are sorted along
    Hilbert's curve, so that neighbours in this order are close in state space. Path $j$ of
    the order takes the $j$-th of a scrambled set of Sobol' points, whose coordinates become
    the random variables of the step. Neighbours thus get complementary values, and their
    sampling errors cancel. Each single path has exactly its own law, so the only bias of
    the estimate is the solver's.

    The error decreases faster than one over the square root of the number of paths, much
    faster in few dimensions: for up to four components of the state (or of `sort_by`) and
    smooth $\phi$, a replicate is as accurate as hundreds to thousands of times as many
    independent paths. For large systems with strong noise the factor is in the tens; in
    chaos after long times it falls to one, and the time spent on sorting is wasted.

    **Arguments:**

    - `num_paths`: the number of paths in each replicate, a power of two.
    - `replicates`: the number of independent randomizations; with `tol` an upper limit, of
        which at least 8 are drawn. Each device solves one at a time, so memory does not
        grow with their number.
    - `sort_by`: maps the state to a PyTree of real numbers to sort the paths by: the fewest
        that distinguish the states that matter. By default the state itself, unless it has
        so many components that neighbours would be far apart. Then, if $\phi$ is a scalar
        and the random variables are discrete, a value function fitted to
        $\mathbb E[\phi \mid y_n = y]$ is used if it does better in a short trial.

    **Source:** [L'Ecuyer, Lécot and Tuffin
    (2008)](https://doi.org/10.1287/opre.1080.0556).
    """

    num_paths: int = eqx.field(default=2**14, converter=lambda x: _power_of_two(x))
    replicates: int = eqx.field(
        default=16, converter=lambda x: whole_number("replicates", x, 2)
    )
    sort_by: Callable[[Y], PyTree[ArrayLike]] | None = None

    def prepare(self, problem, key, devices):
        words = layout(problem.terms)
        if not 0 < words.num_words <= _MAX_DIMENSION:
            raise ValueError(
                f"`terms` need {words.num_words:,} random variables in each step; "
                f"`ArrayRQMC` takes 1 to {_MAX_DIMENSION:,}, the dimensions of Sobol' "
                "points. Pass `sampling=IndependentPaths(num_paths)`."
            )
        points = jnp.asarray(sobol_points(self.num_paths, words.num_words))
        sort_by, y0 = _state if self.sort_by is None else self.sort_by, problem.y0
        check_takes("sort_by", sort_by, "y")
        check_real("sort_by", jtu.tree_leaves(eqx.filter_eval_shape(sort_by, y0)))
        sampler = lambda by: jtu.Partial(_replicates, problem, by, points, words)
        plan = Plan(
            sampler(sort_by), self.replicates, 1, self.num_paths, _BEFORE_STOPPING
        )
        dimension = jax.eval_shape(lambda: numbers(sort_by(y0))).size
        # The number of sorted paths along each coordinate.
        each = self.num_paths ** (1 / dimension)
        if each >= _FEW:
            return plan
        one_number = self.sort_by is None and problem.num_outputs == (1, 1)
        u = value_function(problem, key) if one_number else None
        if u is not None:
            other, own = plan._replace(sampler=sampler(u)), jr.fold_in(key, _TRIAL)
            few = lambda plan: run(plan._replace(num_samples=_TRIAL), own, devices)
            spread = lambda plan: float(np.sum(jtu.tree_leaves(few(plan).variance)))
            ratio = spread(plan) / spread(other)
            if ratio > 1:
                return other._replace(
                    reason="sorted by a fitted value function, which divides the variance "
                    f"of sorting by the state by {ratio:.1f}"
                )
        warnings.warn(
            f"{self.num_paths:,} paths are sorted by {dimension} coordinates, which leaves "
            f"{each:.1f} along each: neighbours are far apart, and `ArrayRQMC` gains "
            "little over `IndependentPaths`. Pass a `sort_by` that returns the few "
            "coordinates that matter most, at most "
            f"{int(math.log(self.num_paths, _FEW))}.",
            stacklevel=4,
        )
        return plan


def _replicates(
    p: Problem,
    sort_by: Callable[[Y], PyTree[Array]] | Functions,
    points: UInt32[Array, "n d"],
    layout: "Layout",
    keys: PRNGKeyArray,
) -> Samples:
    """A sample is the mean over all paths of a replicate. Algorithm 1 of
    [L'Ecuyer, Lécot and Tuffin (2008)](https://doi.org/10.1287/opre.1080.0556).

    `points` come from `sobol_points`, with a coordinate for each random variable of a step.
    """
    n, d = points.shape
    terms_of = lambda words: with_words(p.terms, layout, words)
    (replicate,) = keys
    # Not from quasi-random points, since a function of a key takes any number of them.
    each = jr.split(jr.fold_in(replicate, _STARTS), n)
    drawn = jax.vmap(p.drawn)(each)

    def begin(level):
        key = jr.fold_in(replicate, level.index)

        def words(i):
            seeds = jr.bits(jr.fold_in(key, i), (num_seeds(d),), jnp.uint32)
            return randomized(points, seeds, layout.sixths)

        def step(i, paths):
            by = sort_by
            if isinstance(by, Functions):
                u = jtu.tree_map(lambda x: x[level.index], by)
                by = lambda y: u(i - 1, y)
            z = jax.vmap(lambda y: numbers(by(y)))(paths.y)
            order = hilbert_order(z, paths.failed)
            return advance(i, jtu.tree_map(lambda x: x[order], paths))

        advance, paths = independent_steps(p, level, drawn, terms_of, words)
        return step, paths

    saved, failed, _ = simulate(p, begin, _mean_of_good)
    means, heavy, largest = jnp.moveaxis(saved[:, :, :, None], 2, 0)
    means = p.combined(means)
    # The largest over all levels.
    heavy = jnp.broadcast_to(jnp.max(heavy, axis=0), means.shape)
    # A path may fail on any level.
    largest = tensordot(jnp.abs(p.weights).astype(largest.dtype), largest, 1)
    kinds = [means, heavy, largest]
    return Samples(p.averaged(kinds), jnp.ones(1, bool), jnp.sum(failed)[None])


def _mean_of_good(x: Array, failed: Bool[Array, " n"]) -> Float[Array, "3 ..."]:
    """The mean over the paths that have not failed, the `r` of these paths as in
    `Expectation.std_error`, and the largest deviation of one of them."""
    keep = along(~failed, x)
    count = jnp.sum(~failed).astype(x.dtype)

    def mean(x):
        # In two stages, so that rounding errors in single precision do not add up.
        x, rows = jnp.where(keep, x, 0), 1 << ((len(x).bit_length() - 1) // 2)
        total = jnp.sum(jnp.sum(x.reshape(rows, -1, *x.shape[1:]), axis=0), axis=0)
        return total / count

    own = mean(x)
    off = jnp.where(keep, jnp.abs(x - own), 0)
    most = jnp.max(off, axis=0)
    # In units of the largest deviation.
    s = jnp.sqrt(mean((off / jnp.where(most > 0, most, 1)) ** 2))
    beyond = jnp.maximum(1 - s * jnp.sqrt(4.5 * jnp.log(jnp.maximum(count, 2))), 0)
    # Rounding errors can have heavy tails, too.
    some = most > ROUNDING * jnp.finfo(x.dtype).eps * jnp.abs(own)
    r = jnp.where(some, beyond / (s * jnp.sqrt(count)), 0)
    return jnp.stack([own, r, most])


class Layout(NamedTuple):
    """Which words of a step each path in `terms` takes, the number of words, and whether
    there is only a single three-point variable."""

    slices: tuple[tuple[int, int], ...]
    num_words: int
    sixths: bool


def layout(terms: PyTree[diffrax.AbstractTerm]) -> Layout:
    """The layout of the words. Equal paths are one Brownian motion, and take the same
    words. Raises a `ValueError` for a path whose increments cannot be computed from words.
    """
    paths = [stepwise(path) for path in brownian_paths(terms)]
    starts, slices, end = {}, [], 0
    for number, path in zip(path_numbers(paths), paths):
        start = starts.setdefault(number, end)
        slices.append((start, start + path.num_words(use_levy=True)))
        end = max(end, slices[-1][1])
    sixths = end == 1 and paths[0].laws == {"W": THREE_POINT}
    return Layout(tuple(slices), end, sixths)


def with_words(
    terms: PyTree[diffrax.AbstractTerm],
    layout: Layout,
    words: UInt32[Array, " num_words"],
) -> PyTree[diffrax.AbstractTerm]:
    """The terms, with paths whose increments are computed from these words."""
    slices = iter(layout.slices)

    def given(path: diffrax.AbstractBrownianPath) -> GivenPath:
        start, end = next(slices)
        make = jtu.Partial(_from_words, path, words[start:end])
        return GivenPath(make=make, levy_area=path.levy_area)

    return replace_paths(terms, given)


def _from_words(path: AbstractStepwisePath, words, t0, t1, use_levy: bool) -> Increment:
    """The increment of the path, computed from the first of these words."""
    return path.increment(words[: path.num_words(use_levy)], t0, t1, use_levy)


def _state(y: Y) -> Y:
    return y


def _power_of_two(value) -> int:
    whole = whole_number("num_paths", value, 2)
    if whole & (whole - 1):
        raise ValueError(
            "`num_paths` must be a power of two, for which Sobol' points are balanced; got "
            f"{whole}. Pass {2 ** (whole.bit_length() - 1)} or {2 ** whole.bit_length()}."
        )
    return whole
