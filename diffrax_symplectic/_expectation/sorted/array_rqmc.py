"""Array-RQMC: all paths of a randomization step together, sorted before each step."""

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PRNGKeyArray, PyTree, UInt32

from ..._arguments import check_real, check_takes, whole_number
from ..._brownian import (
    AbstractStepwisePath,
    checked_stepwise,
    GivenPath,
    Increment,
    THREE_POINT,
)
from ..._custom_types import Y
from ..._simulation import (
    combinations,
    independent_steps,
    Level,
    mask_like,
    Motion,
    PathStates,
    Problem,
    real_vector,
    simulate,
)
from ..._terms import brownian_paths, path_numbers, replace_paths
from ..estimate import heaviness
from ..sampling import (
    AbstractSampling,
    Averaged,
    ROUNDING,
    Samples,
    SamplingPlan,
    saved_by_name,
)
from .hilbert import hilbert_order
from .points import num_seeds, randomized, sobol_points


# SciPy has direction numbers for this many coordinates of Sobol' points.
_MAX_DIMENSION = 21201
# Fewer replicates do not estimate their variance well enough to stop: the error bar of
# eight is uncertain by a quarter.
_BEFORE_STOPPING = 8
# With fewer paths along each coordinate, neighbours are far apart: nearly all paths are at
# an edge of the cloud.
_FEWEST_ALONG_COORDINATE = 3
# Folded into the key of a replicate to draw the starts of its paths. (Numbers of levels are
# smaller.)
_KEY_OF_STARTS = 0xFFFFFFFF


@saved_by_name
class ArrayRQMC(AbstractSampling):
    r"""Array-RQMC: randomized quasi-Monte Carlo across all paths of a replicate.

    All paths of a replicate take each step together. Before the step they are sorted along
    Hilbert's curve, so that neighbours in this order are close in state space. Path $j$ of
    the order takes the $j$-th of a scrambled set of Sobol' points, whose coordinates become
    the random variables of the step. Neighbours thus get complementary values, and their
    sampling errors cancel. Each single path has exactly its own law, so the only bias of
    the estimate is the solver's.

    The error decreases faster than one over the square root of the number of paths, much
    faster for [few coordinates and smooth
    $\phi$](benchmarks/sampling.md#gains-of-arrayrqmc); in chaos after long times it does
    not.

    **Arguments:**

    - `num_paths`: the number of paths in each replicate, a power of two.
    - `replicates`: the number of independent randomizations; with `tol` an upper limit, of
        which at least 8 are drawn. Each device solves one at a time, so memory does not
        grow with their number.
    - `sort_by`: maps the state to a PyTree of real numbers to sort the paths by: the fewest
        that distinguish the states that matter. By default the state itself. Warns if
        there are so many numbers that neighbours would be far apart.

    **Source:** [L'Ecuyer, Lécot and Tuffin
    (2008)](https://doi.org/10.1287/opre.1080.0556).
    """

    num_paths: int = eqx.field(default=2**14, converter=lambda x: _power_of_two(x))
    replicates: int = eqx.field(
        default=16, converter=lambda x: whole_number("replicates", x, 2)
    )
    sort_by: Callable[[Y], PyTree[ArrayLike]] | None = None

    def prepare(self, problem, key, devices):
        words = step_words(problem.terms)
        if not 0 < words.number <= _MAX_DIMENSION:
            raise ValueError(
                f"`terms` need {words.number:,} random variables in each step; "
                f"`ArrayRQMC` takes 1 to {_MAX_DIMENSION:,}, the dimensions of Sobol' "
                "points. Pass `sampling=IndependentPaths(num_paths)`."
            )
        sort_by = _state if self.sort_by is None else self.sort_by
        check_takes("sort_by", sort_by, "y")
        sorted_by = eqx.filter_eval_shape(sort_by, problem.y0)
        check_real("sort_by", jtu.tree_leaves(sorted_by))
        dimension = jax.eval_shape(lambda: real_vector(sort_by(problem.y0))).size
        points = jnp.asarray(sobol_points(self.num_paths, words.number))

        along_coordinate = self.num_paths ** (1 / dimension)
        if along_coordinate < _FEWEST_ALONG_COORDINATE:
            warnings.warn(
                f"{self.num_paths:,} paths are sorted by {dimension} coordinates, which "
                f"leaves {along_coordinate:.1f} along each: neighbours are far apart, and "
                "`ArrayRQMC` gains little over `IndependentPaths`. Pass a `sort_by` that "
                "returns the few coordinates that matter most, at most "
                f"{int(math.log(self.num_paths, _FEWEST_ALONG_COORDINATE))}.",
                stacklevel=5,
            )
        return SamplingPlan(
            jtu.Partial(_replicates, problem, sort_by, points, words),
            num_samples=self.replicates,
            # All paths of a replicate are solved at once, which is a batch already.
            batch_size=1,
            paths=self.num_paths,
            levels=len(problem.levels.h),
            least=_BEFORE_STOPPING,
        )


def _replicates(
    p: Problem,
    sort_by: Callable[[Y], PyTree[Array]],
    points: UInt32[Array, "n d"],
    words: "StepWords",
    keys: Key[Array, "1"],
) -> Samples:
    """A sample is the mean over all paths of a replicate. Algorithm 1 of
    [L'Ecuyer, Lécot and Tuffin (2008)](https://doi.org/10.1287/opre.1080.0556).

    `points` come from `sobol_points`, with a coordinate for each random variable of a step.
    """
    n, _ = points.shape
    (replicate,) = keys
    # Not from quasi-random points, since a function of a key takes any number of them.
    start_keys = jr.split(jr.fold_in(replicate, _KEY_OF_STARTS), n)
    drawn = jax.vmap(p.draw_start)(start_keys)

    def begin(level: Level) -> Motion:
        motion = independent_steps(
            p,
            level,
            drawn,
            lambda own_words: with_words(p.terms, words, own_words),
            lambda i: _words_of_step(replicate, level, i, points, words.sixths),
        )

        def step(i, paths):
            return motion.step(i, _in_order(sort_by, paths))

        return Motion(step, motion.start)

    done = simulate(p, begin, _mean_of_good)
    # An axis for the samples, of which there is one.
    means, heavy, largest = jnp.moveaxis(done.saved[:, :, :, None], 2, 0)
    means = p.combinations(means)
    # The largest over all levels.
    heavy = jnp.broadcast_to(jnp.max(heavy, axis=0), means.shape)
    # A path may fail on any level.
    largest = combinations(abs(p.weights), largest)
    averaged = Averaged(
        p.shaped(means), heaviness=p.shaped(heavy), largest=p.shaped(largest)
    )
    lost = jnp.sum(done.failed, axis=1, keepdims=True)
    return Samples(averaged, jnp.ones(1, bool), lost)


def _words_of_step(
    replicate: PRNGKeyArray,
    level: Level,
    i: Any,
    points: UInt32[Array, "n d"],
    sixths: bool,
) -> UInt32[Array, "n d"]:
    """The random words of all paths in step `i`: the points, scrambled anew."""
    key = jr.fold_in(jr.fold_in(replicate, level.index), i)
    _, d = points.shape
    return randomized(points, jr.bits(key, (num_seeds(d),), jnp.uint32), sixths)


def _in_order(sort_by: Callable[[Y], PyTree[Array]], paths: PathStates) -> PathStates:
    """The paths, sorted, with those that failed at the end."""
    coordinates = jax.vmap(lambda y: real_vector(sort_by(y)))(paths.y)
    order = hilbert_order(coordinates, paths.failed)
    return jtu.tree_map(lambda x: x[order], paths)


def _mean_of_good(x: Array, failed: Bool[Array, " n"]) -> Float[Array, "3 ..."]:
    """The mean over the paths that have not failed, the `r` of these paths as in
    `Expectation.std_error`, and the largest deviation of one of them."""
    mask = mask_like(~failed, x)
    count = jnp.sum(~failed).astype(x.dtype)

    def mean(x: Array) -> Array:
        # In two stages, so that rounding errors in single precision do not add up.
        rows = 1 << ((len(x).bit_length() - 1) // 2)
        x = jnp.where(mask, x, 0)
        total = jnp.sum(jnp.sum(x.reshape(rows, -1, *x.shape[1:]), axis=0), axis=0)
        return total / count

    center = mean(x)
    deviations = jnp.where(mask, jnp.abs(x - center), 0)
    largest = jnp.max(deviations, axis=0)
    # In units of the largest deviation, so that squares neither overflow nor underflow.
    s = jnp.sqrt(mean((deviations / jnp.where(largest > 0, largest, 1)) ** 2))
    # Rounding errors can have heavy tails, too.
    is_random = largest > ROUNDING * jnp.finfo(x.dtype).eps * jnp.abs(center)
    r = jnp.where(is_random, heaviness(1, s, count, jnp), 0)
    return jnp.stack([center, r, largest])


class StepWords(NamedTuple):
    """Which random words of a step each path in `terms` takes.

    - `slices`: the first word of each path, and one past the last.
    - `number`: the number of all words.
    - `sixths`: whether there is only a single three-point variable, as in `randomized`.
    """

    slices: tuple[tuple[int, int], ...]
    number: int
    sixths: bool


def step_words(terms: PyTree[diffrax.AbstractTerm]) -> StepWords:
    """The words of a step. Equal paths are one Brownian motion, and take the same words.
    Raises a `ValueError` for a path whose increments cannot be computed from words."""
    paths = [checked_stepwise(path) for path in brownian_paths(terms)]
    starts: dict[int, int] = {}
    slices: list[tuple[int, int]] = []
    end = 0
    for number, path in zip(path_numbers(paths), paths):
        start = starts.setdefault(number, end)
        slices.append((start, start + path.num_words(use_levy=True)))
        end = max(end, slices[-1][1])
    sixths = end == 1 and paths[0].laws == {"W": THREE_POINT}
    return StepWords(tuple(slices), end, sixths)


def with_words(
    terms: PyTree[diffrax.AbstractTerm],
    step: StepWords,
    words: UInt32[Array, " number"],
) -> PyTree[diffrax.AbstractTerm]:
    """The terms, with paths whose increments are computed from these words."""
    slices = iter(step.slices)

    def given(path: diffrax.AbstractBrownianPath) -> GivenPath:
        start, end = next(slices)
        make = jtu.Partial(_from_words, path, words[start:end])
        return GivenPath(make=make, levy_area=path.levy_area)

    return replace_paths(terms, given)


def _from_words(
    path: AbstractStepwisePath,
    words: UInt32[Array, " number"],
    t0: Any,
    t1: Any,
    use_levy: bool,
) -> Increment:
    """The increment of the path, computed from the first of these words."""
    return path.increment(words[: path.num_words(use_levy)], t0, t1, use_levy)


def _state(y: Y) -> Y:
    """The default of `sort_by`."""
    return y


def _power_of_two(value: Any) -> int:
    whole = whole_number("num_paths", value, 2)
    if whole & (whole - 1):
        raise ValueError(
            "`num_paths` must be a power of two, for which Sobol' points are balanced; got "
            f"{whole}. Pass {2 ** (whole.bit_length() - 1)} or {2 ** whole.bit_length()}."
        )
    return whole
