"""The laws of scalar random variables, for a step of size 1: their variance, what a
quadrature over them needs, and samples of them from random words."""

import abc
import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, UInt32


class AbstractLaw(abc.ABC):
    """The law of a scalar random variable. Laws are constants, compared by value."""

    @property
    @abc.abstractmethod
    def variance(self) -> float:
        """The mean is zero for each law here."""

    @abc.abstractmethod
    def outcomes(self, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        """Values and their probabilities: those of a discrete law, or quadrature points
        and weights that integrate polynomials of degree `2 nodes - 1` exactly."""

    @abc.abstractmethod
    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        """A sample for each uniformly distributed word of 32 bits."""


@dataclasses.dataclass(frozen=True)
class Discrete(AbstractLaw):
    """Takes `values[i]` with probability `probabilities[i]`, for words from `cuts[i - 1]`
    on and below `cuts[i]`."""

    values: tuple[float, ...]
    probabilities: tuple[float, ...]
    cuts: tuple[int, ...]

    @property
    def variance(self) -> float:
        return sum(p * v**2 for v, p in zip(self.values, self.probabilities))

    def outcomes(self, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.values), np.array(self.probabilities)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        values = [np.asarray(value, dtype) for value in self.values]
        sample = jnp.full(words.shape, values[-1])
        for cut, value in reversed([*zip(self.cuts, values)]):
            sample = jnp.where(words < np.uint32(cut), value, sample)
        return sample


@dataclasses.dataclass(frozen=True)
class Gaussian(AbstractLaw):
    """The normal distribution of mean zero. One word makes one sample, a monotone function
    of it."""

    variance: float = 1.0  # pyright: ignore[reportIncompatibleMethodOverride]

    def outcomes(self, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        points, weights = np.polynomial.hermite_e.hermegauss(nodes)
        return np.sqrt(self.variance) * points, weights / np.sqrt(2 * np.pi)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        sample = normal_from_words(words, dtype)
        if self.variance == 1:
            return sample
        return sample * np.asarray(np.sqrt(self.variance), dtype)


def normal_from_words(words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
    """The inverse of the normal distribution function at the middle of the interval of
    length `2^-32` that each word stands for."""
    # A word and its complement have samples of opposite sign.
    distance = jnp.where(words < np.uint32(2**31), ~words, words) - np.uint32(2**31)
    x = (distance.astype(dtype) + np.asarray(0.5, dtype)) * np.asarray(2.0**-31, dtype)
    x = np.asarray(np.sqrt(2), dtype) * lax.erf_inv(x)
    return jnp.where(words < np.uint32(2**31), -x, x)


# Up to 2^-32 the probability 1/6, and the values +-sqrt(3) equally likely.
_SIXTH = 2**32 // 6
# Half of the words are negative; of each half the rare ones have the large size.
_RARE = round(2**32 * (3 - np.sqrt(6)) / 12)
_SMALL, _LARGE = (float(np.sqrt(3 + s * np.sqrt(6))) for s in (-1, 1))
_LESS, _MORE = (float((3 + s * np.sqrt(6)) / 12) for s in (-1, 1))

# Moments 1 to 5 of the normal distribution.
THREE_POINT = Discrete(
    values=(-float(np.sqrt(3.0)), 0.0, float(np.sqrt(3.0))),
    probabilities=(1 / 6, 2 / 3, 1 / 6),
    cuts=(_SIXTH, 2**32 - _SIXTH),
)
# Moments 1 to 7.
FOUR_POINT = Discrete(
    values=(-_LARGE, -_SMALL, _LARGE, _SMALL),
    probabilities=(_LESS, _MORE, _LESS, _MORE),
    cuts=(_RARE, 2**31, 2**31 + _RARE),
)


def two_point(variance: float = 1.0) -> Discrete:
    """A fair sign."""
    size = float(np.sqrt(variance))
    return Discrete((-size, size), (1 / 2, 1 / 2), (2**31,))
