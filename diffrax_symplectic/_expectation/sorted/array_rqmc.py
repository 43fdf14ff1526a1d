"""Array-RQMC: all paths of a replicate take each step together, and are sorted before it.

A replicate is one randomization of a set of quasi-random points, with one point for each
path. A coordinate of a point is a random word: a uniformly distributed integer of 32 bits,
from which a Brownian path computes a random variable of the step.
"""

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
    PathStates,
    Problem,
    real_vector,
    simulate,
    Simulated,
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


# The most coordinates of Sobol' points: SciPy has direction numbers for this many.
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
        coordinates = jtu.tree_leaves(jax.eval_shape(sort_by, problem.y0))
        check_real("sort_by", coordinates)
        num_coordinates = sum(leaf.size for leaf in coordinates)
        check_memory("num_paths", self.num_paths, problem.bytes_of_state, devices[0])
        _warn_if_far_apart(self.num_paths, num_coordinates)

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
        # Halved steps need no other program, so they are always offered.
        finer_sampler = sampler_for(problem.with_halved_steps())
        with_halved_steps = ft.partial(plan._replace, sampler=finer_sampler)
        return plan._replace(with_halved_steps=with_halved_steps)


def _warn_if_far_apart(num_paths: int, num_coordinates: int) -> None:
    """Warns if neighbours in the order of the paths are far apart, since there are too few
    paths for the number of coordinates by which they are sorted."""
    # The number of paths along each edge of a cube that all paths fill evenly.
    num_along_coordinate = num_paths ** (1 / num_coordinates)
    if num_along_coordinate < _FEWEST_ALONG_COORDINATE:
        most_coordinates = int(math.log(num_paths, _FEWEST_ALONG_COORDINATE))
        warnings.warn(
            f"{num_paths:,} paths are sorted by {num_coordinates} coordinates, which "
            f"leaves {num_along_coordinate:.1f} along each: neighbours are far apart, and "
            "`ArrayRQMC` gains little over `IndependentPaths`. Pass a `sort_by` that "
            f"returns the few coordinates that matter most, at most {most_coordinates}.",
            # To the code that calls `expectation`.
            stacklevel=7,
        )


def _samples_of_replicate(
    problem: Problem,
    sort_by: Callable[[Y], PyTree[Array]],
    points: UInt32[Array, "n d"],
    layout: "WordLayout",
    keys: Key[Array, "1"],
) -> Samples:
    """Takes one sample: the mean over all paths of a replicate, by algorithm 1 of
    [L'Ecuyer, Lécot and Tuffin (2008)](https://doi.org/10.1287/opre.1080.0556).

    - `sort_by`: maps the state to the numbers by which paths are sorted.
    - `points`: from `sobol_points`, one for each path, with a coordinate for each random
        word of a step.
    - `layout`: which of these words each Brownian path of `terms` takes.
    - `keys`: the random key of the replicate.
    """
    n, d = points.shape
    (replicate_key,) = keys
    # Each outer value of a three-point variable has probability 1/6, but a sixth of the
    # points, whose number is a power of two, is not a whole number. So a single three-point
    # variable is balanced in blocks of six points instead.
    is_in_sixths = layout.is_one_three_point_variable
    randomized = balanced_in_sixths if is_in_sixths else scrambled
    # Starts are independent, rather than from Sobol' points, since a function of a key may
    # draw any number of random variables.
    start_keys = jr.split(jr.fold_in(replicate_key, _KEY_OF_STARTS), n)
    starts = jax.vmap(problem.draw_start)(start_keys)

    def motion_on(level: Level) -> Motion:
        """The motion of all paths on a level: sorting before each step, and the step."""

        def words_of_step(i: Any) -> UInt32[Array, "n d"]:
            """The random words of step `i`, with a row for each path."""
            # The points are randomized anew on each level and in each step.
            key = jr.fold_in(jr.fold_in(replicate_key, level.index), i)
            seeds = jr.bits(key, (num_seeds(d),), jnp.uint32)
            return randomized(points, seeds)

        # Paths with given words move independently of each other.
        unsorted_motion = independent_motion(
            problem,
            level,
            starts,
            terms_of=lambda words: with_words(problem.terms, layout, words),
            randomness_of_step=words_of_step,
        )

        def sort_and_step(i: Any, paths: PathStates) -> PathStates:
            coordinates = jax.vmap(lambda y: real_vector(sort_by(y)))(paths.y)
            order = hilbert_order(coordinates, is_last=paths.failed)
            # Path `j` in this order takes row `j` of the words.
            sorted_paths = jtu.tree_map(lambda x: x[order], paths)
            return unsorted_motion.step(i, sorted_paths)

        return Motion(sort_and_step, unsorted_motion.start)

    return _sample_of(problem, simulate(problem, motion_on, measure=_statistics))


def _sample_of(problem: Problem, simulated: Simulated) -> Samples:
    """The sample of a replicate, from the `_statistics` of its simulated paths."""
    # The saved array has the shape (levels, S, 3, m), with the three rows of `_statistics`.
    # They become the first axis, and the only sample gets an axis of its own:
    # (3, levels, S, 1, m).
    statistics = jnp.moveaxis(simulated.saved[:, :, :, None], 2, 0)
    # (levels, 1, numbers) each.
    mean_on_levels, heaviness_on_levels, largest_on_levels = map(as_vectors, statistics)
    mean = combinations(problem.weights, mean_on_levels)
    averaged = Averaged(
        mean,
        # All combinations of levels get the greatest heaviness on any level.
        heaviness=jnp.broadcast_to(jnp.max(heaviness_on_levels, axis=0), mean.shape),
        # An upper bound of the deviation of a path in a combination of levels. It is
        # reached if one path has the largest deviation on all levels.
        largest=combinations(abs(problem.weights), largest_on_levels),
    )
    _, num_paths = simulated.failed.shape
    num_failed = jnp.sum(simulated.failed, axis=1, keepdims=True)
    # A level on which all paths fail has no mean.
    has_mean = jnp.all(num_failed < num_paths, axis=0)
    return Samples(averaged, good=has_mean, num_failed=num_failed)


def _statistics(phi: Float[Array, "n m"], failed: Bool[Array, " n"]) -> Array:
    """Three statistics of the paths that have not failed, as three rows of shape `(m,)`:

    - the mean of `phi`;
    - the `heaviness` of the tails of `phi`;
    - the largest deviation of a path from the mean.

    The number `n` of paths is a power of two.
    """
    is_good = mask_like(~failed, phi)
    num_good = jnp.sum(~failed).astype(phi.dtype)

    def mean_of_good(x: Float[Array, "n m"]) -> Float[Array, " m"]:
        # The sum has two stages, of about `sqrt(n)` terms each: in single precision the
        # rounding errors of a single sum of `n` terms would add up.
        num_rows = 2 ** ((len(x).bit_length() - 1) // 2)
        rows = jnp.where(is_good, x, 0).reshape(num_rows, -1, *x.shape[1:])
        return jnp.sum(jnp.sum(rows, axis=0), axis=0) / num_good

    mean = mean_of_good(phi)
    deviations = jnp.where(is_good, jnp.abs(phi - mean), 0)
    largest = jnp.max(deviations, axis=0)
    # The heaviness is the same in any units. With the largest deviation as the unit,
    # squares neither overflow nor underflow.
    scaled_deviations = deviations / jnp.where(largest > 0, largest, 1)
    scaled_std = jnp.sqrt(mean_of_good(scaled_deviations**2))
    heaviness_of_phi = heaviness(largest=1, s=scaled_std, n=num_good, numpy=jnp)
    # Deviations that are only rounding errors, or zero, do not count as heavy tails.
    is_random = largest > ROUNDING * jnp.finfo(phi.dtype).eps * jnp.abs(mean)
    return jnp.stack([mean, jnp.where(is_random, heaviness_of_phi, 0), largest])


class WordLayout(NamedTuple):
    """Which of the random words of a step each Brownian path in `terms` takes.

    - `slices`: for each path, the indices of its first word and of one past its last.
    - `num_words`: the number of words in a step.
    - `is_one_three_point_variable`: whether a step has a single random variable, with three
        values.
    """

    slices: tuple[tuple[int, int], ...]
    num_words: int
    is_one_three_point_variable: bool


def word_layout(terms: PyTree[diffrax.AbstractTerm]) -> WordLayout:
    """The layout of the words of a step. Equal paths in `terms` are one Brownian motion,
    and take the same words. Raises a `ValueError` for a path whose increments cannot be
    computed from words."""
    paths = [checked_stepwise(path) for path in brownian_paths(terms)]
    # The index of the first word of each Brownian motion, by the number of the motion.
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
    """The terms for one step of one path, with Brownian paths whose increments are computed
    from the words of this step."""
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
    """The increment of the path from `t0` to `t1`, computed from its words of this step.
    With `use_levy=False` only the first of the words may be needed."""
    return path.increment(words[: path.num_words(use_levy)], t0, t1, use_levy)


def _state_itself(y: Y) -> Y:
    """The function `sort_by` that is used by default: it returns the state."""
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
