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
from .noise import Noise, tilted_probabilities, widened_probabilities


# The relative entropy of the changed noise of a whole path with respect to its own law, in
# nats. Typical paths of the changed noise are then e^8 = 3,000 times less likely by their
# own law: rare enough to show the tails, and not so rare that no weight is left.
_NATS = 8.0
# With this tilt the largest of three outcomes, sqrt(3) times as large as the standard
# deviation, is e^7 = 1,000 times as likely next to the middle one as before: nearly all
# outcomes are the largest.
_MOST_TILTED = 4.0
# The bisection halves its interval this many times, after which only rounding errors in
# single precision remain.
_HALVINGS = 30
# The most noises that push paths to all sides: each further one doubles the trials.
_MOST_NOISES = 2

# Maps a law and the strength of a change to the probabilities that the law has after it.
_ChangeOfLaw: TypeAlias = Callable[[Discrete, float], np.ndarray]


class TrialLaw(NamedTuple):
    """A law of the noise: the `share` and, for each random variable of a step, the `tilt`
    that `Noise.draw` takes, on each level."""

    share: Float[Array | np.ndarray, "*levels"]
    tilts: Float[Array | np.ndarray, "*levels n"]


def laws_of_trials(problem: Problem) -> list[TrialLaw]:
    """The noise's own law, a wider one, and for one noise or two those in which each noise
    pushes to one side, in the order of `itertools.product`."""
    laws = Noise.of(problem, problem.level(0)).laws
    no_share = np.zeros(len(problem.levels.h), problem.dtype)
    no_tilts = np.zeros((len(no_share), len(laws)), problem.dtype)
    # With the share 1 all outcomes are equally probable.
    share = _strongest_change(problem, laws, widened_probabilities, most=1.0)
    trial_laws = [TrialLaw(no_share, no_tilts), TrialLaw(share, no_tilts)]
    num_noises = number_of_noises(problem.terms)
    if num_noises <= _MOST_NOISES:
        tilt = _strongest_change(problem, laws, _with_own_tilted, most=_MOST_TILTED)
        for sides in itertools.product((-1, 1), repeat=num_noises):
            tilts = no_tilts.copy()
            # The increments come first. The other variables, which are only in products
            # with them, are not tilted.
            tilts[:, :num_noises] = np.outer(tilt, sides)
            trial_laws.append(TrialLaw(no_share, tilts))
    return trial_laws


def _with_own_tilted(law: Discrete, tilt: float) -> np.ndarray:
    """The law's own probabilities, tilted."""
    return tilted_probabilities(law, np.array(law.probabilities), tilt)


def _strongest_change(
    problem: Problem,
    laws: tuple[Discrete, ...],
    changed_probabilities: _ChangeOfLaw,
    most: float,
) -> Float[np.ndarray, " levels"]:
    """For each level the largest strength, up to `most`, for which the probabilities
    `changed_probabilities(law, strength)` give all variables of a path, on all levels
    together, a relative entropy of at most 8 nats with respect to their own laws. (The
    relative entropy grows with the strength.)"""
    num_steps = problem.levels.num_steps
    law_counts = collections.Counter(laws)
    # Each level, which has its own number of steps, has an equal part of the entropy.
    most_nats = _NATS / len(num_steps)
    # The bisection of all levels at once.
    lower = np.zeros(len(num_steps))
    upper = np.full(len(num_steps), most)
    for _ in range(_HALVINGS):
        middle = (lower + upper) / 2
        nats_of_step = np.array(
            [
                _relative_entropy(law_counts, changed_probabilities, strength)
                for strength in middle
            ]
        )
        is_too_much = num_steps * nats_of_step > most_nats
        lower = np.where(is_too_much, lower, middle)
        upper = np.where(is_too_much, middle, upper)
    return lower.astype(problem.dtype)


def _relative_entropy(
    law_counts: collections.Counter[Discrete],
    changed_probabilities: _ChangeOfLaw,
    strength: float,
) -> float:
    """The relative entropy of the variables of a step, so many of each law, after a change
    of this strength: the sum of `changed * log(changed / own)` over the probabilities of
    all outcomes, in nats."""
    nats = 0.0
    for law, count in law_counts.items():
        own = np.array(law.probabilities)
        changed = changed_probabilities(law, strength)
        nats += count * np.sum(changed * np.log(changed / own))
    return nats


class UsualDeviations(NamedTuple):
    """The deviations that ordinary paths show, beyond which they are in the tails.

    - `center`: the mean without control.
    - `largest`: the largest deviation from it, or with control from the fitted mean.
    """

    center: Float[Array | np.ndarray, "combinations S m"]
    largest: Float[Array | np.ndarray, "combinations S m"]

    def deviations_beyond(
        self,
        deviations: Float[Array, "combinations S n m"],
        plain: Float[Array, "combinations S n m"],
        log_ratio: Float[Array, " n"],
    ) -> Float[Array, "combinations S n m"]:
        """The deviations of paths that are in the tails, times the likelihood ratios of
        these paths, and zero for others. `plain` are the values without control, and
        `log_ratio` is as from `Noise.draw`, summed over all steps."""
        # Deviations count only if they exceed rounding.
        rounding = ROUNDING * jnp.finfo(deviations.dtype).eps * jnp.abs(plain)
        is_beyond = deviations > self.largest[:, :, None] + rounding
        # The weight of a path is its probability by the own law of the noise, divided by
        # its probability by the law it is drawn by. It is at most one here: paths that are
        # likelier by the own law are seen without another one.
        weight = jnp.exp(-jnp.maximum(log_ratio, 0))[:, None]
        return jnp.where(is_beyond, weight * deviations, 0)


def largest_tails(trials: list[Expectation]) -> PyTree[np.ndarray]:
    """The largest mean deviation in the tails among trials by several laws, for each
    component."""
    mean_tails = [total(estimate.moments).mean.tails for estimate in trials]
    return jtu.tree_map(_largest, *mean_tails)


def _largest(*of_trials: np.ndarray) -> np.ndarray:
    """The largest numbers, without trials that have no value (NaN)."""
    return ft.reduce(np.fmax, of_trials)
