"""Random words for a step, as a function of a key and of the position of the step; and the
laws of the scalar random variables computed from them."""

import abc
import dataclasses
import math
from typing import Any, cast, TypeAlias

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Integer, PRNGKeyArray, UInt32

from .._batch import materialize
from .._compat import is_threefry


# The position of a step, in units of a power of two, and the exponent of that power.
Place: TypeAlias = tuple[Integer[Array, ""], Integer[Array, ""]]

# The number of pairs of words that a path, and each wrapper around it, may draw in a step.
# Above it, three ranges of numbers would not fit below the exponent of the step's size,
# which takes the upper 12 bits of a counter.
_MOST_PAIRS = 2**18
# Pairs of words of a step are numbered. The pairs of wrappers begin at these numbers.
PLATEAU_WORDS = _MOST_PAIRS
AREA_WORDS = 2 * _MOST_PAIRS


def random_words(
    key: PRNGKeyArray, place: Place, num_sets: int, set_size: int, first_pair: int = 0
) -> UInt32[Array, "num_sets set_size"]:
    """Random words for a step at `place`, in `num_sets` sets of `set_size` words each. More
    sets leave the first ones unchanged. Raises a `ValueError` for an array of keys.

    `first_pair` is 0 for a path, and `PLATEAU_WORDS` or `AREA_WORDS` for a wrapper around
    it: their words are independent, so that they may share a key.
    """
    key = typed_key(key)
    if key.ndim > 0:
        raise ValueError(
            "A Brownian path needs one random key; got an array of keys of shape "
            f"{key.shape}. Use `jax.vmap` over it."
        )
    num_words = num_sets * set_size
    if is_threefry(key) and 0 < num_words <= 2 * _MOST_PAIRS:
        words = _words_from_counters(key, place, num_words, first_pair)
        return words.reshape(num_sets, set_size)
    # Each set has a key of its own, so that more sets leave the first ones unchanged.
    count, exponent = place
    step_key = jr.fold_in(jr.fold_in(key, count), exponent)
    set_keys = [jr.fold_in(step_key, first_pair + i) for i in range(num_sets)]
    return jnp.stack(
        [jr.bits(set_key, (set_size,), jnp.uint32) for set_key in set_keys]
    )


def _words_from_counters(
    key: PRNGKeyArray, place: Place, num_words: int, first_pair: int
) -> UInt32[Array, " num_words"]:
    """Words of Threefry, of which each hash of a counter yields a pair. The counter is the
    place and the number of the pair: folding and splitting keys would take three hashes for
    the first word."""
    count, exponent = place
    num_pairs = (num_words + 1) // 2
    pair_numbers = np.arange(first_pair, first_pair + num_pairs, dtype=np.uint32)
    # A counter consists of two words. In the second one the exponent fills the upper 12
    # bits, and the number of the pair the 20 bits below.
    count_word = count.astype(jnp.uint32)
    pair_word = (exponent.astype(jnp.uint32) << 20) + pair_numbers

    def hash_counters() -> tuple[Array, ...]:
        pair = _threefry(jr.key_data(key), count_word, pair_word)
        # A single word needs only the first of its pair.
        return pair[:num_words]

    # XLA would compute each of the two words in a separate kernel.
    words = jnp.stack(materialize(hash_counters), axis=1)
    return words.reshape(-1)[:num_words]


# Threefry-2x32 rotates by these numbers of bits, in turns, four times before it adds keys.
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)


def _threefry(
    key: UInt32[Array, "2"], count_word: Array, pair_word: Array
) -> tuple[Array, Array]:
    """Threefry-2x32 with 20 rounds, by Salmon et al. (SC'11, doi:10.1145/2063384.2063405):
    the words of JAX's generator for this key and counters `(count_word, pair_word)`.
    Unrolled, since JAX's version is a loop of eighty kernels on CPUs: three words for each
    of 512 paths take 3 ns per path instead of 16."""
    keys = [key[0], key[1], key[0] ^ key[1] ^ _PARITY]
    first = count_word + keys[0]
    second = pair_word + keys[1]
    # Five groups of four rounds, after each of which two of the keys are added, in turns.
    for group in range(5):
        for bits in _ROTATIONS[group % 2]:
            first = first + second
            second = first ^ ((second << bits) | (second >> (32 - bits)))
        first = first + keys[(group + 1) % 3]
        second = second + keys[(group + 2) % 3] + np.uint32(group + 1)
    return first, second


def check_key(key: Any, caller_name: str) -> None:
    """Raises a `ValueError` unless `key` is a random key (from `jax.random.key` or
    `jax.random.PRNGKey`) or an array of keys, to be used with `jax.vmap`."""
    if not is_key(key):
        raise ValueError(
            f"`{caller_name}` needs a random key, such as `jax.random.key(0)`; got {key!r}."
        )


def is_key(x: Any) -> bool:
    """Whether this is a random key, or an array of keys. The words of a key from
    `jax.random.PRNGKey` are told from other integers by their number."""
    dtype = getattr(x, "dtype", None)
    if dtype == jnp.uint32:
        return x.shape[-1:] == jax.eval_shape(jr.PRNGKey, 0).shape
    return dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)


def typed_key(key: PRNGKeyArray | UInt32[Array, "..."]) -> PRNGKeyArray:
    """The key as one from `jax.random.key`."""
    return jr.wrap_key_data(key) if key.dtype == jnp.uint32 else key


def derived_key(key: PRNGKeyArray, old_key: Array) -> Array:
    """A key derived from `key` to take the place of `old_key`, of the same kind and shape.
    Equal old keys get the same new one."""
    old_words = jr.key_data(typed_key(old_key))
    for word in old_words.reshape(-1):
        key = jr.fold_in(key, word)
    new_words = jr.bits(key, old_words.shape, jnp.uint32)
    if old_key.dtype == jnp.uint32:
        # A key from `jax.random.PRNGKey` consists of its words.
        return new_words
    return jr.wrap_key_data(new_words, impl=jr.key_impl(old_key))


# `place_of` rounds the sizes of steps, times this factor, to powers of two, and their
# middles, plus this shift, to integers. Neither is a round number: for steps of round
# numbers, no rounding error can then change the result.
_SIZE_FACTOR = 1.37
_COUNT_SHIFT = 0.29


def place_of(t0: Array, t1: Array) -> Place:
    r"""The position of a step as two integers, which do not change if times are rounded:

    $$ n = \Bigl\lfloor \frac{t_0 + t_1}{2 \cdot 2^e} + 0.29 \Bigr\rfloor, \qquad
    e = \lfloor \log_2(1.37\, |t_1 - t_0|) \rfloor - 1. $$

    So the middle of the step is counted in units of $2^e$, which is between a third and 0.7
    of the step (1.37 times a quarter and a half). Two steps with the same integers have
    middles less than one unit apart, and are longer than that, so they overlap.
    """
    units_per_time, exponent = _inverse_power_of_two(jnp.abs(t1 - t0) * _SIZE_FACTOR)
    # Late in a long float32 solve, two steps may round to the same middle. So the integer
    # part of the start, which is exact, is split off before adding half a step.
    start = t0 * units_per_time
    half = (t1 - t0) / 2 * units_per_time
    whole = jnp.floor(start)
    rest = jnp.floor(start - whole + half + _COUNT_SHIFT)
    # The count wraps around after 2^31 units, or fewer in half precision.
    period = 2.0 ** min(31, jnp.finfo(whole.dtype).maxexp - 1)
    whole = whole - period * jnp.trunc(whole / period)
    return whole.astype(jnp.int32) + rest.astype(jnp.int32), exponent


def _inverse_power_of_two(x: Array) -> tuple[Array, Integer[Array, ""]]:
    """`2^-e` and the exponent `e`, where `2^e` is the power of two that is more than a
    quarter and at most half of `x > 0`. They come from the bits of `x`: `jnp.frexp` and
    `jnp.ldexp` would take as long as a random word."""
    info = jnp.finfo(x.dtype)
    bits = lax.bitcast_convert_type(x, f"int{info.bits}")
    # The bits of `x = 2^k (1 + m)` with `0 <= m < 1` are a sign of zero, the number
    # `k + bias`, and the mantissa `m`.
    k_plus_bias = bits >> info.nmant
    bias = 2 ** (info.nexp - 1) - 1
    # `2^-k` has the number `-k + bias` and a mantissa of zeros. Since `2^e` is half of
    # `2^k`, its inverse is twice `2^-k`.
    bits_of_inverse = (2 * bias - k_plus_bias) << info.nmant
    inverse = lax.bitcast_convert_type(bits_of_inverse, x.dtype) * 2
    exponent = k_plus_bias.astype(jnp.int32) - (bias + 1)
    # For an empty step, in which a path has no noise, any unit will do.
    return jnp.where(k_plus_bias > 0, inverse, 1), exponent


class AbstractLaw(abc.ABC):
    """The law of a scalar random variable with mean zero. Laws are compared by value."""

    @abc.abstractmethod
    def outcomes(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        """Values and probabilities of a discrete law, or quadrature points and weights that
        integrate polynomials of degree `2 num_nodes - 1` exactly."""

    @abc.abstractmethod
    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        """A sample for each uniformly distributed 32-bit word."""


@dataclasses.dataclass(frozen=True)
class Discrete(AbstractLaw):
    """Takes `values[i]` with probability `probabilities[i]`, for words `w` with
    `cuts[i - 1] <= w < cuts[i]`."""

    values: tuple[float, ...]
    probabilities: tuple[float, ...]
    cuts: tuple[int, ...]

    def outcomes(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.values), np.array(self.probabilities)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        values = [np.asarray(value, dtype) for value in self.values]
        sample = jnp.full(words.shape, values[-1])
        # Each selection sets the values of all words below its cut, and overwrites earlier
        # ones. So the largest cut comes first: in the end a word has the value of the
        # lowest cut above it. A table of values would need a gather, which is slow on CPUs.
        for cut, value in zip(reversed(self.cuts), reversed(values[:-1])):
            sample = jnp.where(words < np.uint32(cut), value, sample)
        return sample


@dataclasses.dataclass(frozen=True)
class Gaussian(AbstractLaw):
    """The centred normal distribution. A sample is a monotone function of its word."""

    variance: float = 1.0

    def outcomes(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        points, weights = np.polynomial.hermite_e.hermegauss(num_nodes)
        return np.sqrt(self.variance) * points, weights / np.sqrt(2 * np.pi)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        sample = normal_from_words(words, dtype)
        # XLA would not remove a product with one.
        if self.variance == 1:
            return sample
        return sample * np.asarray(np.sqrt(self.variance), dtype)


# With p the distance of a probability from the nearer of 0 and 1, and q = 1/2 - p, the
# normal quantile is q F(-log(4 p (1 - p))) with a smooth F. The coefficients of this
# rational approximation of F, lowest degree first, were fitted by weighted least squares
# for p >= 2^-33: the largest relative error is 9.7e-9. All are positive, so nothing
# cancels.
_NUMERATOR = (
    2.506628250602876, 0.894851053435387, 0.18198359950254517, 0.025040486604300607,
    0.002275143781368971, 0.00011854314661164789, 3.8177635593160345e-07,
)  # fmt: skip
_DENOMINATOR = (
    1.0, 0.09519425299621843, 0.034648399059640025, 0.0023108827187771457,
    0.00024829960535979235, 3.7341501976265963e-06,
)  # fmt: skip


def normal_from_words(words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
    """The inverse of the normal distribution function, at the middle of each word's
    interval of length `2^-32`."""
    half = np.asarray(0.5, dtype)
    two_intervals = np.asarray(2.0**-31, dtype)
    # Processors convert signed integers to floats faster than unsigned ones.
    signed = lax.bitcast_convert_type(words ^ np.uint32(2**31), np.int32)
    # With p and q as for `_NUMERATOR`, 2 q with its sign, which is accurate where q is near
    # zero; and 2 p, which is accurate in the tails, where p is near zero. Half an interval
    # more is the middle of it.
    two_q = (signed.astype(dtype) + half) * two_intervals
    tail = lax.bitcast_convert_type(jnp.minimum(words, ~words), np.int32)
    two_p = (tail.astype(dtype) + half) * two_intervals
    argument = -jnp.log(two_p * (2 - two_p))
    product = two_q * half * _polynomial(_NUMERATOR, argument)
    return product / _polynomial(_DENOMINATOR, argument)


def _polynomial(coefficients: tuple[float, ...], x: Array) -> Array:
    """A polynomial at `x`, by Horner's rule; the lowest degree comes first."""
    highest, *others = reversed(coefficients)
    value = highest
    for coefficient in others:
        value = value * x + np.asarray(coefficient, x.dtype)
    return cast(Array, value)


_ROOT3 = math.sqrt(3)
_SIXTH_OF_WORDS = 2**32 // 6
# The four-point law is the Gauss-Hermite rule with four nodes: two values and their
# negatives, of which the larger one is less probable.
_LARGE = math.sqrt(3 + math.sqrt(6))
_SMALL = math.sqrt(3 - math.sqrt(6))
_P_LARGE = (3 - math.sqrt(6)) / 12
_P_SMALL = (3 + math.sqrt(6)) / 12
_WORDS_OF_LARGE = round(2**32 * _P_LARGE)

# This law matches moments 1 to 5 of the normal distribution. Odd moments vanish exactly,
# since as many words give one sign as the other.
THREE_POINT = Discrete(
    values=(-_ROOT3, 0.0, _ROOT3),
    probabilities=(1 / 6, 2 / 3, 1 / 6),
    cuts=(_SIXTH_OF_WORDS, 2**32 - _SIXTH_OF_WORDS),
)
# This law matches moments 1 to 7. Words below 2^31 give negative values.
FOUR_POINT = Discrete(
    values=(-_LARGE, -_SMALL, _LARGE, _SMALL),
    probabilities=(_P_LARGE, _P_SMALL, _P_LARGE, _P_SMALL),
    cuts=(_WORDS_OF_LARGE, 2**31, 2**31 + _WORDS_OF_LARGE),
)

# A fair sign.
TWO_POINT = Discrete(values=(-1.0, 1.0), probabilities=(1 / 2, 1 / 2), cuts=(2**31,))
