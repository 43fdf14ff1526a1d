"""Random words for a step, as a function of a key and of the position of the step; and the
laws of scalar random variables, which are computed from random words.

A word is a uniformly distributed 32-bit integer, from which one random variable is
computed. JAX's generator Threefry makes words in pairs, one pair from each hash of a
counter.
"""

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


# The position of a step on the time axis, from `place_of`: the number `count` of units of
# time from time zero to the step, and the `exponent` of the unit, which is `2^exponent`.
Place: TypeAlias = tuple[Integer[Array, ""], Integer[Array, ""]]

# The pairs of words of a step are numbered. There are three ranges of this many numbers:
# one for a path, and one for each of the two kinds of wrappers that draw words. The ranges
# fit into the 20 bits that a counter has for the number of a pair.
_MOST_PAIRS = 2**18
# The first pairs of wrappers have these numbers. The first pair of a path has the number 0.
PLATEAU_WORDS = _MOST_PAIRS
AREA_WORDS = 2 * _MOST_PAIRS


def random_words(
    key: PRNGKeyArray, place: Place, num_sets: int, set_size: int, first_pair: int = 0
) -> UInt32[Array, "num_sets set_size"]:
    """Random words for a step at `place`: `num_sets` sets, the rows of an array, of
    `set_size` words each. The first sets are the same for any number of sets. Raises a
    `ValueError` for an array of keys.

    `first_pair` is the number of the first pair of words: 0 for a path, and `PLATEAU_WORDS`
    or `AREA_WORDS` for a wrapper around a path. So the words of a path and of its wrappers
    are independent, even if they share a key.
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
    # JAX draws the words if the generator is not Threefry, and if there are no words or
    # more than a range of numbers allows. Each set has a key of its own, so that the first
    # sets are the same for any number of sets.
    count, exponent = place
    step_key = jr.fold_in(jr.fold_in(key, count), exponent)
    set_keys = [jr.fold_in(step_key, first_pair + i) for i in range(num_sets)]
    return jnp.stack(
        [jr.bits(set_key, (set_size,), jnp.uint32) for set_key in set_keys]
    )


def _words_from_counters(
    key: PRNGKeyArray, place: Place, num_words: int, first_pair: int
) -> UInt32[Array, " num_words"]:
    """Words from hashes of counters by Threefry, a pair from each hash. A counter consists
    of the place of the step and the number of the pair. (Folding the place into the key, as
    is usual in JAX, would take three hashes for the first word.)"""
    count, exponent = place
    num_pairs = (num_words + 1) // 2
    pair_numbers = np.arange(first_pair, first_pair + num_pairs, dtype=np.uint32)
    # A counter consists of two words: the count, and a word with the exponent in its upper
    # 12 bits and the number of the pair in the 20 bits below.
    count_word = count.astype(jnp.uint32)
    pair_word = (exponent.astype(jnp.uint32) << 20) + pair_numbers

    def hash_counters() -> tuple[Array, ...]:
        pair = _threefry(jr.key_data(key), count_word, pair_word)
        # If only one word is needed, the second one is not computed.
        return pair[:num_words]

    # Without `materialize`, XLA would compute each word of a pair in a separate kernel.
    words = jnp.stack(materialize(hash_counters), axis=1)
    return words.reshape(-1)[:num_words]


# The numbers of bits by which Threefry-2x32 rotates in a group of four rounds. Groups use
# the first and the second row in turns.
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
# A constant of Threefry, from which it makes its third key.
_PARITY = np.uint32(0x1BD11BDA)


def _threefry(
    key: UInt32[Array, "2"], count_word: Array, pair_word: Array
) -> tuple[Array, Array]:
    """Threefry-2x32 with 20 rounds, by Salmon et al. (SC'11, doi:10.1145/2063384.2063405):
    the words of JAX's generator for this key and the counters `(count_word, pair_word)`.

    JAX's own version is a loop, of eighty kernels on CPUs. This one is unrolled: three
    words for each of 512 paths take 3 ns per path instead of 16.
    """
    keys = [key[0], key[1], key[0] ^ key[1] ^ _PARITY]
    first = count_word + keys[0]
    second = pair_word + keys[1]
    # Five groups of four rounds. After each group, two of the three keys are added, in
    # turns.
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
    """Whether `x` is a random key, or an array of keys. A key from `jax.random.PRNGKey` is
    an array of integers: it is recognized by its dtype and the length of its last axis."""
    dtype = getattr(x, "dtype", None)
    if dtype == jnp.uint32:
        return x.shape[-1:] == jax.eval_shape(jr.PRNGKey, 0).shape
    return dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)


def typed_key(key: PRNGKeyArray | UInt32[Array, "..."]) -> PRNGKeyArray:
    """Converts a key from `jax.random.PRNGKey` to a key as from `jax.random.key`. Leaves
    other keys as they are."""
    return jr.wrap_key_data(key) if key.dtype == jnp.uint32 else key


def derived_key(key: PRNGKeyArray, old_key: Array) -> Array:
    """A key to replace `old_key`, derived from `key` and `old_key`. It has the dtype and
    shape of `old_key`. Equal old keys are replaced by equal keys."""
    old_words = jr.key_data(typed_key(old_key))
    for word in old_words.reshape(-1):
        key = jr.fold_in(key, word)
    new_words = jr.bits(key, old_words.shape, jnp.uint32)
    if old_key.dtype == jnp.uint32:
        # A key from `jax.random.PRNGKey` consists of its words.
        return new_words
    return jr.wrap_key_data(new_words, impl=jr.key_impl(old_key))


# `place_of` multiplies the size of a step by this factor and rounds the product down to a
# power of two. It adds this shift to the middle of the step and rounds the sum down to an
# integer. The factor and the shift are not round numbers. So if times are round numbers,
# the product and the sum are never so close to a jump that rounding errors change a result.
_SIZE_FACTOR = 1.37
_COUNT_SHIFT = 0.29


def place_of(t0: Array, t1: Array) -> Place:
    r"""The position of a step as two integers, the count $n$ and the exponent $e$, which do
    not change if times are rounded:

    $$ n = \Bigl\lfloor \frac{t_0 + t_1}{2 \cdot 2^e} + 0.29 \Bigr\rfloor, \qquad
    e = \lfloor \log_2(1.37\, |t_1 - t_0|) \rfloor - 1. $$

    So the middle of the step is counted in units of $2^e$. A unit is between a third and
    0.7 of the step (1.37 times a quarter and a half). Two steps with the same integers
    overlap: their middles are less than one unit apart, and both are longer than one unit.
    """
    units_per_time, exponent = _inverse_power_of_two(jnp.abs(t1 - t0) * _SIZE_FACTOR)
    # In units, the middle is the start plus half a step. It is not computed as one number:
    # late in a long float32 solve, the middles of two steps may be rounded to the same
    # number. So the count is `whole + rest`, where `whole` is the integer part of the start
    # and is exact.
    start = t0 * units_per_time
    half_step = (t1 - t0) / 2 * units_per_time
    whole = jnp.floor(start)
    rest = jnp.floor(start - whole + half_step + _COUNT_SHIFT)
    # Conversion to 32-bit integers is defined only below 2^31. So the count wraps around
    # after 2^31 units, or fewer in half precision, whose range is smaller.
    period = 2.0 ** min(31, jnp.finfo(whole.dtype).maxexp - 1)
    whole = whole - period * jnp.trunc(whole / period)
    return whole.astype(jnp.int32) + rest.astype(jnp.int32), exponent


def _inverse_power_of_two(x: Array) -> tuple[Array, Integer[Array, ""]]:
    """`2^-e` and `e = floor(log2(x)) - 1`, for `x > 0`. Both are read off the bits of `x`:
    `jnp.frexp` and `jnp.ldexp` would take as long as drawing a random word."""
    info = jnp.finfo(x.dtype)
    bits = lax.bitcast_convert_type(x, f"int{info.bits}")
    # The bits of `x = 2^k (1 + m)` with `0 <= m < 1` are, from the highest to the lowest,
    # the sign, which is zero, the number `k + bias`, and the mantissa `m`.
    k_plus_bias = bits >> info.nmant
    bias = 2 ** (info.nexp - 1) - 1
    # The bits of `2^-k` are those of `-k + bias`, which is `2 bias - (k + bias)`, and a
    # mantissa of zeros. Since `e = k - 1`, `2^-e` is twice `2^-k`.
    bits_of_inverse = (2 * bias - k_plus_bias) << info.nmant
    inverse = lax.bitcast_convert_type(bits_of_inverse, x.dtype) * 2
    exponent = k_plus_bias.astype(jnp.int32) - (bias + 1)
    # The size `x` of an empty step is zero. Such a step has no noise, so any unit will do.
    return jnp.where(k_plus_bias > 0, inverse, 1), exponent


class AbstractLaw(abc.ABC):
    """The law of a scalar random variable with mean zero. Laws with the same values are
    equal."""

    @abc.abstractmethod
    def outcomes(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        """For a discrete law, all values and their probabilities. For a continuous law,
        `num_nodes` quadrature points and their weights, which integrate polynomials of
        degree `2 num_nodes - 1` exactly."""

    @abc.abstractmethod
    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        """A sample for each uniformly distributed 32-bit word."""


@dataclasses.dataclass(frozen=True)
class Discrete(AbstractLaw):
    """A discrete law: the value `values[i]` has probability `probabilities[i]`, and is the
    sample for the words `w` with `cuts[i - 1] <= w < cuts[i]`. (There is no cut below the
    words of the first value, nor above those of the last one.)"""

    values: tuple[float, ...]
    probabilities: tuple[float, ...]
    cuts: tuple[int, ...]

    def outcomes(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.values), np.array(self.probabilities)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        values = [np.asarray(value, dtype) for value in self.values]
        sample = jnp.full(words.shape, values[-1])
        # Each round sets the samples of all words below a cut, and overwrites what earlier
        # rounds have set. The largest cut comes first, so that in the end each word has the
        # value of the lowest cut above it. (To look values up in a table would need a
        # gather, which is slow on CPUs.)
        for cut, value in zip(reversed(self.cuts), reversed(values[:-1])):
            sample = jnp.where(words < np.uint32(cut), value, sample)
        return sample


@dataclasses.dataclass(frozen=True)
class Gaussian(AbstractLaw):
    """The normal distribution with mean zero. A sample increases with its word."""

    variance: float = 1.0

    def outcomes(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        points, weights = np.polynomial.hermite_e.hermegauss(num_nodes)
        return np.sqrt(self.variance) * points, weights / np.sqrt(2 * np.pi)

    def from_words(self, words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
        sample = normal_from_words(words, dtype)
        # XLA would not remove a multiplication by one.
        if self.variance == 1:
            return sample
        return sample * np.asarray(np.sqrt(self.variance), dtype)


# Let `p` be the distance of a probability from the nearer of 0 and 1, and `q = 1/2 - p`. Up
# to its sign, the normal quantile at the probability is `q F(-log(4 p (1 - p)))` with a
# smooth function `F`. These are the coefficients of a rational approximation of `F`, lowest
# degree first. They were fitted by weighted least squares for `p >= 2^-33`: the largest
# relative error is 9.7e-9. All are positive, so that no digits are lost to cancellation.
_NUMERATOR = (
    2.506628250602876, 0.894851053435387, 0.18198359950254517, 0.025040486604300607,
    0.002275143781368971, 0.00011854314661164789, 3.8177635593160345e-07,
)  # fmt: skip
_DENOMINATOR = (
    1.0, 0.09519425299621843, 0.034648399059640025, 0.0023108827187771457,
    0.00024829960535979235, 3.7341501976265963e-06,
)  # fmt: skip


def normal_from_words(words: UInt32[Array, "..."], dtype) -> Float[Array, "..."]:
    """Standard normal samples: the inverse of the normal distribution function at the
    probability `(word + 1/2) / 2^32`. In the notation above `_NUMERATOR` a sample is
    `q F(-log(4 p (1 - p)))`, where here `q` has the sign of the sample."""
    half = np.asarray(0.5, dtype)
    scale = np.asarray(2.0**-31, dtype)
    # Integers are converted to floats as signed ones, which is faster.
    #
    # `2 q` is twice the probability, minus 1: `(word - 2^31 + 1/2) / 2^31`. Flipping the
    # highest bit subtracts 2^31 if the result is read as a signed integer.
    word_minus_half_range = lax.bitcast_convert_type(words ^ np.uint32(2**31), np.int32)
    two_q = (word_minus_half_range.astype(dtype) + half) * scale
    # `2 p` is twice the distance of the probability from the nearer of 0 and 1. This is the
    # number of words from this one to the nearer end, plus 1/2, over 2^31. (In the tails
    # `1 - abs(two_q)` would not be accurate.) `~words` is `2^32 - 1 - words`.
    words_to_end = lax.bitcast_convert_type(jnp.minimum(words, ~words), np.int32)
    two_p = (words_to_end.astype(dtype) + half) * scale
    # `4 p (1 - p)` is `2 p (2 - 2 p)`.
    argument = -jnp.log(two_p * (2 - two_p))
    numerator = two_q * half * _polynomial(_NUMERATOR, argument)
    return numerator / _polynomial(_DENOMINATOR, argument)


def _polynomial(coefficients: tuple[float, ...], x: Array) -> Array:
    """The value at `x` of the polynomial with these coefficients, lowest degree first, by
    Horner's rule."""
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

# Matches moments 1 to 5 of the normal distribution. Odd moments vanish exactly, since
# equally many words give the positive and the negative value.
THREE_POINT = Discrete(
    values=(-_ROOT3, 0.0, _ROOT3),
    probabilities=(1 / 6, 2 / 3, 1 / 6),
    cuts=(_SIXTH_OF_WORDS, 2**32 - _SIXTH_OF_WORDS),
)
# Matches moments 1 to 7 of the normal distribution. Words below 2^31 give negative values.
FOUR_POINT = Discrete(
    values=(-_LARGE, -_SMALL, _LARGE, _SMALL),
    probabilities=(_P_LARGE, _P_SMALL, _P_LARGE, _P_SMALL),
    cuts=(_WORDS_OF_LARGE, 2**31, 2**31 + _WORDS_OF_LARGE),
)

# A fair sign.
TWO_POINT = Discrete(values=(-1.0, 1.0), probabilities=(1 / 2, 1 / 2), cuts=(2**31,))
