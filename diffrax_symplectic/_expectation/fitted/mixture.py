"""The laws by which paths with a control variate draw their noise.

A fit is worst where paths seldom come, and the few paths that come there may carry most of
the variance, or much of the mean. So half of the paths draw their noise by other laws, by
which such paths are common. Each path is weighted by its likelihood ratio: the probability
of its noise by the own law of the noise, divided by the probability by the mixture of all
laws ([Hesterberg (1995)](https://doi.org/10.1080/00401706.1995.10484303)).
"""

import collections
import dataclasses
import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from ..._brownian import Discrete, random_words
from ..._simulation import Problem
from ..._terms import number_of_noises
from .noise import cuts_of, Noise, padded


# The share of the paths that draw by other laws than the own one. Weights are then at most
# 1 / (1 - share). For the mean of exp(q) of three oscillators, errors in units of the error
# bar were 0.98 to 1.10 in the root mean square. With a share of a quarter they were 1.14 to
# 1.17, since the few paths in the tails told less of the variance there.
_SHARE_OF_OTHERS = 1 / 2
# The relative entropy of another law of the noise of a whole path with respect to the own
# law, in nats. Typical paths by the other law are then e^4 = 55 times less likely by the
# own law. (With 8 nats the standard errors were 1.1 times larger.)
_NATS = 4.0
# The largest tilt of a law. Of three outcomes, the largest is sqrt(3) standard deviations,
# and the middle one zero. This tilt multiplies the probability of the largest, relative to
# that of the middle one, by e^(4 sqrt(3)) = 1,000: nearly all draws are then the largest.
_MOST_TILT = 4.0
# How often the bisection for the strength of a change halves its interval. After that only
# rounding errors in single precision remain.
_HALVINGS = 30
# With at most this many noises there is a law for each choice of a side to which each noise
# is pushed. Each further noise would double the number of laws.
_MOST_NOISES_PUSHED = 2


class Mixture(eqx.Module):
    """The laws by which paths draw their noise. Law number 0 is the noise's own.

    - `shares`: the probability with which a path draws by each law.
    - `cuts`: for each level and law, the `cuts` of the random words for `Noise.draw`.
    - `log_ratios`: for each level, law, random variable and outcome, the logarithm of the
        probability of the outcome by the law divided by the probability by the own law.
    """

    shares: Float[Array | np.ndarray, " laws"]
    cuts: UInt32[Array | np.ndarray, "levels laws n cuts"]
    log_ratios: Float[Array | np.ndarray, "levels laws n outcomes"]

    @staticmethod
    def of(problem: Problem) -> "Mixture":
        """The mixture of the noise's own law, a wider one, and for one noise or two also
        the laws by which each noise pushes to one side."""
        laws = Noise.of(problem, problem.level(0)).laws
        own = [np.array(law.probabilities) for law in laws]
        padded_own = padded(own)
        num_noises = number_of_noises(problem.terms)
        all_signs = []
        if num_noises <= _MOST_NOISES_PUSHED:
            all_signs = [*itertools.product((-1, 1), repeat=num_noises)]
        # The increments of the noises come first. The other variables, which appear only in
        # products with increments, are not tilted.
        not_tilted = [0] * (len(laws) - num_noises)

        cuts = []
        log_ratios = []
        num_steps = problem.levels.num_steps
        # The strength of a change of laws on a level follows from the relative entropy that
        # one of its steps may have. All levels have equal parts of the whole entropy, and
        # so have the steps of a level.
        for nats_of_step in _NATS / len(num_steps) / num_steps:
            width = _strongest_change(laws, _widened, 1.0, nats_of_step)
            largest_tilt = _strongest_change(laws, _tilted, _MOST_TILT, nats_of_step)
            # For each law of the mixture, a list with the probabilities of the outcomes of
            # each variable: the own law, the wider one, and those that push to a side.
            probabilities = [own, [_widened(law, width) for law in laws]]
            for signs in all_signs:
                tilts = [largest_tilt * sign for sign in (*signs, *not_tilted)]
                probabilities.append([*map(_tilted, laws, tilts)])
            cuts.append([cuts_of(of_law) for of_law in probabilities])
            log_ratios.append(
                [np.log(padded(of_law) / padded_own) for of_law in probabilities]
            )
        num_others = 1 + len(all_signs)
        shares = np.full(1 + num_others, _SHARE_OF_OTHERS / num_others, problem.dtype)
        shares[0] = 1 - _SHARE_OF_OTHERS
        return Mixture(
            shares=shares,
            cuts=np.array(cuts),
            log_ratios=np.array(log_ratios, problem.dtype),
        )

    def own_law_alone(self) -> "Mixture":
        """The mixture in which all paths draw by their own law."""
        shares = np.zeros_like(self.shares)
        shares[0] = 1
        return dataclasses.replace(self, shares=shares)

    def draw_law(self, key: PRNGKeyArray) -> Int[Array, ""]:
        """The number of the law by which the path with this key draws, on all levels."""
        # These two numbers take the place of a step and a level. No level has this number,
        # so the words are independent of the words of the noise.
        place = jnp.array(0), jnp.array(len(self.cuts))
        (words,) = random_words(key, place, 1, 1)
        uniform = words.astype(self.shares.dtype) / 2.0**32
        # Not `>=`: in single precision the largest words are rounded to one, and would
        # choose the last law even if its share is zero.
        return jnp.sum(uniform > jnp.cumsum(self.shares)[:-1])

    def weights(self, log_ratios: Float[Array, "paths laws"]) -> Float[Array, " paths"]:
        """The likelihood ratios of paths: the probability of the noise of a path by the own
        law, divided by the probability by the mixture. `log_ratios` are those of the
        outcomes of all variables, steps and levels, summed."""
        log_shares = jnp.log(jnp.asarray(self.shares))
        return jnp.exp(-jax.nn.logsumexp(log_shares + log_ratios, axis=1))


def log_ratios_of_outcomes(
    log_ratios: Float[Array | np.ndarray, "laws n outcomes"],
    has_outcome: Bool[Array, "n outcomes"],
) -> Float[Array, " laws"]:
    """For each law, the logarithm of the probability of a step's outcomes by the law
    divided by the probability by the own law. `log_ratios` are those of a level in a
    `Mixture`."""
    return jnp.sum(jnp.where(has_outcome, log_ratios, 0), axis=(1, 2))


def _widened(law: Discrete, width: float) -> np.ndarray:
    """The probabilities of a wider law: the law's own for a `width` of 0, equal ones for a
    `width` of 1, and weighted averages of both in between."""
    own = np.array(law.probabilities)
    return (1 - width) * own + width / len(own)


def _tilted(law: Discrete, tilt: float) -> np.ndarray:
    """The probabilities of an exponentially tilted law, proportional to the probabilities
    of the law times `exp(tilt * value)`."""
    weights = np.array(law.probabilities) * np.exp(tilt * np.array(law.values))
    return weights / np.sum(weights)


def _strongest_change(
    laws: Sequence[Discrete],
    changed_probabilities: Callable[[Discrete, float], np.ndarray],
    most: float,
    most_nats: float,
) -> float:
    """The largest strength of a change of laws, up to `most`, for which the variables of a
    step together have a relative entropy of at most `most_nats` with respect to their own
    laws. A changed law has the probabilities `changed_probabilities(law, strength)`. The
    relative entropy is the sum of `changed * log(changed / own)` over all outcomes. It
    grows with the strength, so the strength is found by bisection."""
    # Equal laws have equal entropies, which are computed once.
    law_counts = collections.Counter(laws)
    lower = 0.0
    upper = most
    for _ in range(_HALVINGS):
        middle = (lower + upper) / 2
        nats = 0.0
        for law, count in law_counts.items():
            changed = changed_probabilities(law, middle)
            nats += count * np.sum(changed * np.log(changed / law.probabilities))
        if nats > most_nats:
            upper = middle
        else:
            lower = middle
    return lower
