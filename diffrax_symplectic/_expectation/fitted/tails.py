"""Heavy tails: paths too rare to be in a sample, which matter all the same.

A trial draws the noise by another law, by which extreme paths are common, and weighs each
path by its likelihood ratio. What deviates in it by more than ordinary paths do adds to the
standard error.
"""

import collections
import functools as ft
import itertools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..._brownian import Discrete
from ..._simulation import Problem
from ..._terms import number_of_noises
from ..estimate import Expectation, total
from ..sampling import ROUNDING
from .noise import Noise, tilted, widened


# The relative entropy of the changed noise of a whole path with respect to its own law, in
# nats. Typical paths of the changed noise are then e^8 = 3,000 times less likely by their
# own law: rare enough to show the tails, and not so rare that no weight is left.
_NATS = 8.0
# With this tilt the largest of three outcomes, sqrt(3) times as large as the standard
# deviation, is e^7 = 1,000 times as likely next to the middle one as before: nearly all
# outcomes are the largest.
_MOST_TILTED = 4.0
# The halvings of an interval after which only rounding errors in single precision remain.
_HALVINGS = 30
# The most noises that push paths to all sides: each further one doubles the trials.
_MOST_NOISES = 2

# The probabilities that a law has after a change by a number.
_Change: TypeAlias = Callable[[Discrete, float], np.ndarray]


class TrialLaw(NamedTuple):
    """A law of the noise: what `Noise.draw` takes, on each level."""

    share: Float[Array | np.ndarray, "*levels"]
    tilts: Float[Array | np.ndarray, "*levels n"]


def laws_of_trials(problem: Problem) -> list[TrialLaw]:
    """The noise's own law, a wider one, and for one noise or two those in which each noise
    pushes to one side."""
    laws = Noise.of(problem, problem.level(0)).laws
    no_share = np.zeros(len(problem.levels.h), problem.dtype)
    no_tilts = np.zeros((len(no_share), len(laws)), problem.dtype)
    share = _strongest_change(problem, laws, widened, 1.0)
    trial_laws = [TrialLaw(no_share, no_tilts), TrialLaw(share, no_tilts)]
    num_noises = number_of_noises(problem.terms)
    if num_noises <= _MOST_NOISES:
        tilt = _strongest_change(problem, laws, _tilted_law, _MOST_TILTED)
        for sides in itertools.product((-1, 1), repeat=num_noises):
            tilts = no_tilts.copy()
            # The increments come first. The other variables, which are only in products
            # with them, are not tilted.
            tilts[:, :num_noises] = np.outer(tilt, sides)
            trial_laws.append(TrialLaw(no_share, tilts))
    return trial_laws


def _tilted_law(law: Discrete, tilt: float) -> np.ndarray:
    return tilted(law, np.array(law.probabilities), tilt)


def _strongest_change(
    problem: Problem, laws: tuple[Discrete, ...], change_law: _Change, most: float
) -> Float[np.ndarray, " levels"]:
    """For each level the largest `z`, up to `most`, for which the laws `change_law(law, z)`
    give all variables of a path, on all levels together, a relative entropy of at most 8
    nats with respect to their own laws."""
    num_steps = problem.levels.num_steps
    counts = collections.Counter(laws)
    # Each level, which has its own number of steps, has an equal part of the entropy.
    most_nats = _NATS / len(num_steps)
    # The bisection of all levels at once.
    lower = np.zeros(len(num_steps))
    upper = np.full(len(num_steps), most)
    for _ in range(_HALVINGS):
        middle = (lower + upper) / 2
        nats = np.array([_relative_entropy(counts, change_law, z) for z in middle])
        is_too_much = num_steps * nats > most_nats
        lower = np.where(is_too_much, lower, middle)
        upper = np.where(is_too_much, middle, upper)
    return lower.astype(problem.dtype)


def _relative_entropy(
    counts: collections.Counter[Discrete], change_law: _Change, z: float
) -> float:
    """How far the variables of a step, so many of each law, are from their own laws if
    these are changed: the sum of `q log(q / p)`, in nats."""
    nats = 0.0
    for law, count in counts.items():
        p = np.array(law.probabilities)
        q = change_law(law, z)
        nats += count * np.sum(q * np.log(q / p))
    return nats


class Usual(NamedTuple):
    """What ordinary paths show, beyond which deviations are in the tails.

    - `center`: the mean without control.
    - `largest`: the largest deviation from it, or with control from the fitted mean.
    """

    center: Float[Array | np.ndarray, "combinations S m"]
    largest: Float[Array | np.ndarray, "combinations S m"]

    def tails(
        self,
        deviations: Float[Array, "combinations S n m"],
        plain: Float[Array, "combinations S n m"],
        log_ratio: Float[Array, " n"],
    ) -> Float[Array, "combinations S n m"]:
        """The deviations of paths that are in the tails, times the likelihood ratios of
        these paths, and zero for others. `plain` are the values without control."""
        # Deviations count only if they exceed rounding.
        rounding = ROUNDING * jnp.finfo(deviations.dtype).eps * jnp.abs(plain)
        is_beyond = deviations > self.largest[:, :, None] + rounding
        # Ratios are at most one: paths that are likelier by the own law of the noise are
        # seen without another one.
        ratio = jnp.exp(-jnp.maximum(log_ratio, 0))[:, None]
        return jnp.where(is_beyond, ratio * deviations, 0)


def largest_tails(trials: list[Expectation]) -> PyTree[np.ndarray]:
    """The largest mean deviation in the tails among trials by several laws, for each
    component."""

    def largest(*tails: np.ndarray) -> np.ndarray:
        # A trial without a value is ignored.
        return ft.reduce(np.fmax, tails)

    tails = [total(estimate.moments).mean.tails for estimate in trials]
    return jtu.tree_map(largest, *tails)
