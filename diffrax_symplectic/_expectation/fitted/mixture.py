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


class Mixture(eqx.Module):
    """The laws of the noise of paths, of which the first one is its own.

    - `shares`: the probability with which a path draws by each law.
    - `cuts`: the cuts between the random words that choose outcomes, as for `Noise.draw`,
        for each level and law.
    - `log_ratios`: for each level, law and random variable the logarithm of the probability
        of each outcome by the law, divided by that by the own law.
    """

    shares: Float[Array | np.ndarray, " laws"]
    cuts: UInt32[Array | np.ndarray, "levels laws n cuts"]
    log_ratios: Float[Array | np.ndarray, "levels laws n outcomes"]

    @staticmethod
    def of(problem: Problem) -> "Mixture":
        """The noise's own law, a wider one, and for one noise or two those in which each
        noise pushes to one side, in the order of `itertools.product`."""
        laws = Noise.of(problem, problem.level(0)).laws
        own = [np.array(law.probabilities) for law in laws]
        num_noises = number_of_noises(problem.terms)
        all_signs = []
        if num_noises <= _MOST_NOISES_PUSHED:
            all_signs = [*itertools.product((-1, 1), repeat=num_noises)]
        # The increments come first. The other variables, which are only in products with
        # them, are not tilted.
        not_tilted = [0] * (len(laws) - num_noises)

        cuts = []
        log_ratios = []
        num_steps = problem.levels.num_steps
        # Each level, which has its own number of steps, has an equal part of the entropy.
        for most_nats in _NATS / len(num_steps) / num_steps:
            # With a width of 1 all outcomes are equally probable.
            width = _strongest_change(laws, _widened, 1.0, most_nats)
            # By law of the path and variable: the probabilities of outcomes.
            probabilities = [own, [_widened(law, width) for law in laws]]
            tilt = _strongest_change(laws, _tilted, _MOST_TILT, most_nats)
            for signs in all_signs:
                signed_laws = zip([*signs, *not_tilted], laws)
                probabilities.append([_tilted(law, k * tilt) for k, law in signed_laws])
            cuts.append([cuts_of(of_law) for of_law in probabilities])
            log_ratios.append(
                [
                    padded([np.log(p / p_own) for p, p_own in zip(of_law, own)])
                    for of_law in probabilities
                ]
            )
        num_others = 1 + len(all_signs)
        shares_of_others = np.full(num_others, _SHARE_OF_OTHERS / num_others)
        return Mixture(
            shares=np.append(1 - _SHARE_OF_OTHERS, shares_of_others).astype(
                problem.dtype
            ),
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
        # In place of the numbers of a draw and of a level. No level has this number, so the
        # noise of steps has other words.
        place = jnp.array(0), jnp.array(len(self.cuts))
        (words,) = random_words(key, place, 1, 1)
        uniform = words.astype(self.shares.dtype) / 2.0**32
        # Not `>=`, since in single precision the largest words are rounded to one.
        return jnp.sum(uniform > jnp.cumsum(self.shares)[:-1])

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
    laws: Sequence[Discrete],
    changed_probabilities: Callable[[Discrete, float], np.ndarray],
    most: float,
    most_nats: float,
) -> float:
    """The largest strength, up to `most`, for which the probabilities
    `changed_probabilities(law, strength)` give the variables of a step together a relative
    entropy of at most `most_nats` with respect to their own laws: the sum of
    `changed * log(changed / own)` over all outcomes, which grows with the strength."""
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
