"""The laws by which paths with a control variate draw their noise.

A fit is worst where paths seldom come, and the few that do may carry most of the variance,
or much of the mean. So half of the paths draw wider noise, by which such paths are common,
and each path counts by its likelihood ratio: the probability of its noise by its own law,
divided by its probability by the mixture of laws ([Hesterberg
(1995)](https://doi.org/10.1080/00401706.1995.10484303)).
"""

import collections
import dataclasses
import itertools
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from ..._brownian import Discrete, random_words
from ..._simulation import Problem
from ..._terms import number_of_noises
from .noise import cuts_by, cuts_of, Noise, padded


# The share of the paths that draw by other laws. Weights are then at most
# 1 / (1 - share). For the mean of exp(q) of three oscillators, errors in units of the error
# bar were 0.98 to 1.10 in the root mean square; with a share of a quarter 1.14 to 1.17,
# since the few paths in the tails told less of the variance there.
_SHARE_OF_OTHERS = 1 / 2
# The relative entropy of the changed noise of a whole path with respect to its own law, in
# nats. Typical paths of the changed noise are then e^4 = 55 times less likely by their own
# law. (With 8 nats the standard errors were 1.1 times larger.)
_NATS = 4.0
# The largest tilt. It multiplies the probability of the largest of three outcomes, sqrt(3)
# standard deviations, by e^(4 sqrt(3)) = 1,000 relative to that of the middle one, zero:
# nearly all outcomes are then the largest.
_MOST_TILT = 4.0
# The bisection halves its interval this many times, after which only rounding errors in
# single precision remain.
_HALVINGS = 30
# With at most this many noises there is a law for each way to push each of them to one side
# or the other. Each further noise would double the number of laws.
_MOST_NOISES_PUSHED = 2

# Maps a law and the strength of a change to the probabilities that the law has after it.
_ChangeOfLaw: TypeAlias = Callable[[Discrete, float], np.ndarray]


class Mixture(eqx.Module):
    """The laws of the noise of paths, of which the first one is its own.

    - `shares`: the probability with which a path draws by each law.
    - `cuts_of_laws`: the cuts between the random words that choose the laws.
    - `cuts`: the cuts between the random words that choose outcomes, as for `Noise.draw`,
        for each level and law.
    - `log_ratios`: for each level, law and random variable the logarithm of the probability
        of each outcome by the law, divided by that by the own law.
    """

    shares: Float[Array | np.ndarray, " laws"]
    cuts_of_laws: UInt32[Array | np.ndarray, "1 cuts_of_laws"]
    cuts: UInt32[Array | np.ndarray, "levels laws n cuts"]
    log_ratios: Float[Array | np.ndarray, "levels laws n outcomes"]

    @staticmethod
    def of(problem: Problem) -> "Mixture":
        """The noise's own law, a wider one, and for one noise or two those in which each
        noise pushes to one side, in the order of `itertools.product`."""
        laws = Noise.of(problem, problem.level(0)).laws
        own = [np.array(law.probabilities) for law in laws]
        # For each level. With a width of 1 all outcomes are equally probable.
        widths = _strongest_change(problem, laws, _widened, most=1.0)
        # By level, other law and variable: arrays of the probabilities of outcomes.
        others = [[[_widened(law, width) for law in laws]] for width in widths]
        num_noises = number_of_noises(problem.terms)
        if num_noises <= _MOST_NOISES_PUSHED:
            tilts = _strongest_change(problem, laws, _tilted, most=_MOST_TILT)
            # The increments come first. The other variables, which are only in products
            # with them, are not tilted.
            not_tilted = [0] * (len(laws) - num_noises)
            for signs in itertools.product((-1, 1), repeat=num_noises):
                signs_of_laws = [*signs, *not_tilted]
                for of_level, tilt in zip(others, tilts):
                    pairs = zip(laws, signs_of_laws)
                    of_level.append([_tilted(law, sign * tilt) for law, sign in pairs])

        def log_ratios(probabilities: list[np.ndarray]) -> np.ndarray:
            return padded([np.log(p / p_own) for p, p_own in zip(probabilities, own)])

        num_others = len(others[0])
        shares = np.append(
            1 - _SHARE_OF_OTHERS, np.full(num_others, _SHARE_OF_OTHERS / num_others)
        )
        return Mixture(
            shares=shares.astype(problem.dtype),
            cuts_of_laws=cuts_by([shares]),
            cuts=np.array(
                [[cuts_of(laws), *map(cuts_by, of_level)] for of_level in others]
            ),
            log_ratios=np.array(
                [[*map(log_ratios, [own, *of_level])] for of_level in others],
                problem.dtype,
            ),
        )

    def own_law_alone(self) -> "Mixture":
        """The mixture in which all paths draw by their own law."""
        shares = np.zeros_like(self.shares)
        shares[0] = 1
        return dataclasses.replace(self, shares=shares, cuts_of_laws=cuts_by([shares]))

    def draw_law(self, key: PRNGKeyArray) -> Int[Array, ""]:
        """The number of the law by which the path with this key draws, on all levels."""
        # In place of the numbers of a draw and of a level. No level has this number, so the
        # noise of steps has other words.
        place = jnp.array(0), jnp.array(len(self.cuts))
        (words,) = random_words(key, place, 1, 1)
        return jnp.sum(words >= self.cuts_of_laws)

    def weights(self, log_ratios: Float[Array, "paths laws"]) -> Float[Array, " paths"]:
        """The likelihood ratios of paths: the probability of their noise by its own law,
        divided by that by the mixture. `log_ratios` are summed over all variables, steps
        and levels."""
        log_shares = jnp.log(jnp.asarray(self.shares))
        return jnp.exp(-jax.nn.logsumexp(log_shares + log_ratios, axis=1))


def log_ratios_of_outcomes(
    log_ratios: Float[Array | np.ndarray, "laws n outcomes"],
    has_outcome: Bool[Array, "n outcomes"],
) -> Float[Array, " laws"]:
    """The logarithms of the probabilities of a step's outcomes by each law, divided by
    those by the own law."""
    return jnp.sum(jnp.where(has_outcome, log_ratios, 0), axis=(1, 2))


def _widened(law: Discrete, width: float) -> np.ndarray:
    """The law's probabilities for a `width` of 0, equal ones for 1, and averages of both in
    between."""
    own = np.array(law.probabilities)
    return (1 - width) * own + width / len(own)


def _tilted(law: Discrete, tilt: float) -> np.ndarray:
    """The law's probabilities times the exponential of `tilt` times the outcome,
    normalized."""
    weights = np.array(law.probabilities) * np.exp(tilt * np.array(law.values))
    return weights / np.sum(weights)


def _strongest_change(
    problem: Problem,
    laws: tuple[Discrete, ...],
    changed_probabilities: _ChangeOfLaw,
    most: float,
) -> Float[np.ndarray, " levels"]:
    """For each level the largest strength, up to `most`, for which the probabilities
    `changed_probabilities(law, strength)` give all variables of a path, on all levels
    together, a relative entropy of at most `_NATS` with respect to their own laws. (The
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
    return lower


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
