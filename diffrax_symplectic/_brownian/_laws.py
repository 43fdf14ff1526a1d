"""The laws of scalar random variables, for a step of size 1: what a quadrature over them
needs, and samples of them from random words."""

import abc
import dataclasses
import functools as ft

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, UInt32


class AbstractLaw(abc.ABC):
    """The law of a scalar random variable with mean zero. Laws are compared by value."""

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

    variance: float = 1.0

    def outcomes(self, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        points, weights = np.polynomial.hermite_e.hermegauss(nodes)
        return np.sqrt(self.variance) * points, weights / np.sqrt(2 * np.pi)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        sample = normal_from_words(words, dtype)
        if self.variance == 1:
            return sample
        return sample * np.asarray(np.sqrt(self.variance), dtype)


# With p the distance of a probability from the nearer of 0 and 1, and q = 1/2 - p, the
# normal quantile is q F(-log(4 p (1 - p))), where F is smooth, growing, and so well
# approximated by one ratio of polynomials that no branch is needed. These (lowest degree
# first) are the best of degrees 6 and 5 for p from 2^-33 on, found by weighted least
# squares: the largest relative error is 9.7e-9. All are positive, so that nothing cancels.
_NUMERATOR = (
    2.506628250602876,
    0.894851053435387,
    0.18198359950254517,
    0.025040486604300607,
    0.002275143781368971,
    0.00011854314661164789,
    3.8177635593160345e-07,
)
_DENOMINATOR = (
    1.0,
    0.09519425299621843,
    0.034648399059640025,
    0.0023108827187771457,
    0.00024829960535979235,
    3.7341501976265963e-06,
)


def normal_from_words(words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
    """The inverse of the normal distribution function, at the middle of the interval of
    length `2^-32` that each word stands for."""
    constant = lambda x: np.asarray(x, dtype)
    half, unit = constant(0.5), constant(2.0**-31)
    # Signed integers, which processors convert to numbers faster.
    signed = lax.bitcast_convert_type(words ^ np.uint32(2**31), np.int32)
    # 2 q with its sign, and 2 p: one of them is precise where the other is not.
    two_q = (signed.astype(dtype) + half) * unit
    tail = lax.bitcast_convert_type(jnp.minimum(words, ~words), np.int32)
    two_p = (tail.astype(dtype) + half) * unit
    w = -jnp.log(two_p * (2 - two_p))
    polynomial = lambda c: ft.reduce(lambda s, a: s * w + constant(a), reversed(c))
    return two_q * half * polynomial(_NUMERATOR) / polynomial(_DENOMINATOR)


# The probability of each large value is 1/6, up to 2^-32, and the same for both signs.
_SIXTH = 2**32 // 6
# Words below 2^31 stand for negative values. The lowest of each half stand for the large
# values, which are rare.
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
