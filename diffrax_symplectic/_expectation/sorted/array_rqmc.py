"""Array-RQMC: all paths of a randomization step together, sorted before each step."""

import functools as ft
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
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PyTree, UInt32

from ..._arguments import check_memory, check_real, check_takes, whole_number
from ..._brownian import (
    AbstractStepwisePath,
    checked_stepwise,
    GivenPath,
    Increment,
    THREE_POINT,
)
from ..._custom_types import Y
from ..._programs import traced
from ..._simulation import (
    as_vectors,
    combinations,
    independent_motion,
    Level,
    mask_like,
    Motion,
    Problem,
    real_vector,
    simulate,
)
from ..._terms import brownian_paths, motion_numbers, replace_paths
from ..estimate import heaviness
from ..sampling import (
    AbstractSampling,
    Averaged,
    Outputs,
    ROUNDING,
    Samples,
    SamplingPlan,
    saved_by_name,
)
from .hilbert import hilbert_order
from .points import balanced_in_sixths, num_seeds, scrambled, sobol_points


# SciPy has direction numbers for this many coordinates of Sobol' points.
_MAX_DIMENSION = 21201
# The fewest replicates after which an estimate with `tol` may stop. Fewer do not estimate
# their variance well enough: the error bar of eight is uncertain by a quarter.
_LEAST_REPLICATES = 8
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

    The error decreases faster than one over the square root of the number of paths, [much
    faster](expectation.md#choosing-the-arguments-of-arrayrqmc) for few coordinates and
    smooth $\phi$; in chaos after long times it does not.

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

    num_paths: int = eqx.field(default=2**14, converter=lambda x: _checked_num_paths(x))
    replicates: int = eqx.field(
        default=16, converter=lambda x: whole_number("replicates", x, 2)
    )
    sort_by: Callable[[Y], PyTree[ArrayLike]] | None = None

    def prepare(self, problem, key, devices):
        layout = word_layout(problem.terms)
        if not 0 < layout.num_words <= _MAX_DIMENSION:
            raise ValueError(
                f"`terms` need {layout.num_words:,} random variables in each step; "
                f"`ArrayRQMC` takes 1 to {_MAX_DIMENSION:,}, the dimensions of Sobol' "
                "points. Pass `sampling=IndependentPaths(num_paths)`."
            )
        sort_function = _state_itself if self.sort_by is None else self.sort_by
        check_takes("sort_by", sort_function, "y")
        sort_by = traced(sort_function, problem.y0)
        coordinates = jax.eval_shape(sort_by, problem.y0)
        check_real("sort_by", jtu.tree_leaves(coordinates))
        num_coordinates = jax.eval_shape(lambda: real_vector(sort_by(problem.y0))).size
        check_memory("num_paths", self.num_paths, problem.bytes_of_state, devices[0])
        # If the paths fill a cube, with equal distances along all coordinates.
        num_along_coordinate = self.num_paths ** (1 / num_coordinates)
        if num_along_coordinate < _FEWEST_ALONG_COORDINATE:
            most_coordinates = int(math.log(self.num_paths, _FEWEST_ALONG_COORDINATE))
            warnings.warn(
                f"{self.num_paths:,} paths are sorted by {num_coordinates} coordinates, "
                f"which leaves {num_along_coordinate:.1f} along each: neighbours are far "
                "apart, and `ArrayRQMC` gains little over `IndependentPaths`. Pass a "
                "`sort_by` that returns the few coordinates that matter most, at most "
                f"{most_coordinates}.",
                stacklevel=6,
            )
        points = jnp.asarray(sobol_points(self.num_paths, layout.num_words))

        def sampler_for(problem: Problem) -> jtu.Partial:
            return jtu.Partial(_samples_of_replicate, problem, sort_by, points, layout)

        plan = SamplingPlan(
            sampler_for(problem),
            Outputs.of(problem),
            num_samples=self.replicates,
            # All paths of a replicate are solved at once, which is a batch already.
            batch_size=1,
            paths_per_sample=self.num_paths,
            least_samples=_LEAST_REPLICATES,
        )
        # With halved steps the program is the same.
        finer_sampler = sampler_for(problem.with_halved_steps())
        with_halved_steps = ft.partial(plan._replace, sampler=finer_sampler)
        return plan._replace(with_halved_steps=with_halved_steps)


def _samples_of_replicate(
    problem: Problem,
    sort_by: Callable[[Y], PyTree[Array]],
    points: UInt32[Array, "n d"],
    layout: "WordLayout",
    keys: Key[Array, "1"],
) -> Samples:
    """A sample is the mean over all paths of a replicate, by algorithm 1 of
    [L'Ecuyer, Lécot and Tuffin (2008)](https://doi.org/10.1287/opre.1080.0556).

    `points` come from `sobol_points`, one for each path, with a coordinate for each random
    variable of a step.
    """
    n, d = points.shape
    (replicate_key,) = keys
    # Starts are independent, rather than from Sobol' points, since a function of a key may
    # draw any number of random variables.
    start_keys = jr.split(jr.fold_in(replicate_key, _KEY_OF_STARTS), n)
    starts = jax.vmap(problem.draw_start)(start_keys)

    def motion_on(level: Level) -> Motion:
        """The motion of all paths, which are sorted before each step."""

        def words_of_paths(i: Any) -> UInt32[Array, "n d"]:
            # The points are scrambled anew on each level and in each step.
            key = jr.fold_in(jr.fold_in(replicate_key, level.index), i)
            seeds = jr.bits(key, (num_seeds(d),), jnp.uint32)
            # The outer values of this variable have probability 1/6 each, but a sixth of a
            # power of two of points is not a whole number.
            if layout.is_one_three_point_variable:
                return balanced_in_sixths(points, seeds)
            return scrambled(points, seeds)

        # Given their words, paths move independently. Only the words are coupled: a sorted
        # path gets those of its place in the order.
        motion = independent_motion(
            problem,
            level,
            starts,
            terms_of=lambda words: with_words(problem.terms, layout, words),
            randomness_of_step=words_of_paths,
        )

        def step(i, paths):
            coordinates = jax.vmap(lambda y: real_vector(sort_by(y)))(paths.y)
            # Failed paths come last.
            order = hilbert_order(coordinates, paths.failed)
            return motion.step(i, jtu.tree_map(lambda x: x[order], paths))

        return Motion(step, motion.start)

    simulated = simulate(problem, motion_on, _statistics)
    # From (levels, S, 3, m), with the three numbers of `_statistics`, to (3, levels, S, 1,
    # m), with an axis for the only sample.
    statistics = jnp.moveaxis(simulated.saved[:, :, :, None], 2, 0)
    # (levels, 1, numbers)
    mean_on_levels, r, largest = map(as_vectors, statistics)
    mean = combinations(problem.weights, mean_on_levels)
    averaged = Averaged(
        mean,
        # The largest `r` on any level, for all combinations.
        heaviness=jnp.broadcast_to(jnp.max(r, axis=0), mean.shape),
        # An upper bound of how far a path deviates in a combination of levels, which is
        # reached if one path has the largest deviation on all of them.
        largest=combinations(abs(problem.weights), largest),
    )
    num_failed = jnp.sum(simulated.failed, axis=1, keepdims=True)
    # A level on which all paths fail has no mean.
    has_mean = jnp.all(num_failed < n, axis=0)
    return Samples(averaged, good=has_mean, num_failed=num_failed)


def _statistics(phi: Float[Array, "n m"], failed: Bool[Array, " n"]) -> Array:
    """The mean over the paths that have not failed, their `heaviness`, and the largest
    deviation of one of them from the mean, along a leading axis. The number of paths is a
    power of two."""
    is_good = mask_like(~failed, phi)
    num_good = jnp.sum(~failed).astype(phi.dtype)

    def mean_of_good(x: Float[Array, "n m"]) -> Float[Array, " m"]:
        # The sum has two stages, so that rounding errors in single precision do not add up.
        # About the root of the number of paths are summed in each.
        num_rows = 2 ** ((len(x).bit_length() - 1) // 2)
        rows = jnp.where(is_good, x, 0).reshape(num_rows, -1, *x.shape[1:])
        return jnp.sum(jnp.sum(rows, axis=0), axis=0) / num_good

    mean = mean_of_good(phi)
    deviations = jnp.where(is_good, jnp.abs(phi - mean), 0)
    largest = jnp.max(deviations, axis=0)
    # The standard deviation is in units of the largest deviation, which is then 1, so that
    # squares neither overflow nor underflow.
    scaled = deviations / jnp.where(largest > 0, largest, 1)
    s = jnp.sqrt(mean_of_good(scaled**2))
    # Deviations that are rounding errors can have heavy tails, too, which do not count.
    is_random = largest > ROUNDING * jnp.finfo(phi.dtype).eps * jnp.abs(mean)
    r = jnp.where(is_random, heaviness(1, s, num_good, jnp), 0)
    return jnp.stack([mean, r, largest])


class WordLayout(NamedTuple):
    """Which random words of a step each Brownian path in `terms` takes.

    - `slices`: the first word of each path, and one past the last.
    - `num_words`: the number of all words.
    - `is_one_three_point_variable`: whether nothing else is drawn. Then the words are
        `balanced_in_sixths`.
    """

    slices: tuple[tuple[int, int], ...]
    num_words: int
    is_one_three_point_variable: bool


def word_layout(terms: PyTree[diffrax.AbstractTerm]) -> WordLayout:
    """The layout of the words of a step. Equal paths are one Brownian motion, and take the
    same words. Raises a `ValueError` for a path whose increments cannot be computed from
    words."""
    paths = [checked_stepwise(path) for path in brownian_paths(terms)]
    # The first word of each Brownian motion, by its number.
    first_words: dict[int, int] = {}
    slices: list[tuple[int, int]] = []
    num_words = 0
    for motion_number, path in zip(motion_numbers(paths), paths):
        # A Brownian motion that was met before keeps its words; a new one takes the next.
        start = first_words.setdefault(motion_number, num_words)
        end = start + path.num_words(use_levy=True)
        slices.append((start, end))
        num_words = max(num_words, end)
    is_one_three_point = num_words == 1 and paths[0].laws == {"W": THREE_POINT}
    return WordLayout(tuple(slices), num_words, is_one_three_point)


def with_words(
    terms: PyTree[diffrax.AbstractTerm],
    layout: WordLayout,
    words: UInt32[Array, " num_words"],
) -> PyTree[diffrax.AbstractTerm]:
    """The terms, with paths whose increments are computed from these words of one step."""
    # `replace_paths` visits paths in the order of `brownian_paths`.
    slices = iter(layout.slices)

    def path_from_words(path: diffrax.AbstractBrownianPath) -> GivenPath:
        start, end = next(slices)
        make = jtu.Partial(_increment_from_words, path, words[start:end])
        return GivenPath(make=make, levy_area=path.levy_area)

    return replace_paths(terms, path_from_words)


def _increment_from_words(
    path: AbstractStepwisePath,
    words: UInt32[Array, " num_words"],
    t0: Any,
    t1: Any,
    use_levy: bool,
) -> Increment:
    """The increment of the path, computed from the first of these words."""
    return path.increment(words[: path.num_words(use_levy)], t0, t1, use_levy)


def _state_itself(y: Y) -> Y:
    """The default of `sort_by`."""
    return y


def _checked_num_paths(value: Any) -> int:
    """The value as an integer. Raises a `ValueError` unless it is a power of two."""
    num_paths = whole_number("num_paths", value, 2)
    power_below = 2 ** (num_paths.bit_length() - 1)
    if num_paths != power_below:
        raise ValueError(
            "`num_paths` must be a power of two, for which Sobol' points are balanced; got "
            f"{num_paths}. Pass {power_below} or {2 * power_below}."
        )
    return num_paths
