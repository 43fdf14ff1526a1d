"""Randomized low-discrepancy points. A coordinate is a 32-bit word: an integer `w` that
stands for `w / 2**32`."""

import functools as ft

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, UInt32


# `balanced_in_sixths` balances a variable among this many consecutive points: its outer
# values have probability one sixth.
_BLOCK = 6
# The primitive polynomial and the first direction numbers of each of the first coordinates
# of Sobol' points, by Joe and Kuo (2008). The first coordinate needs neither. SciPy has
# these parameters for 21,201 coordinates, but importing it takes 2.4 s of processor time,
# where a first estimate takes 15.
_JOE_AND_KUO: tuple[tuple[int, tuple[int, ...]], ...] = (
    (0b1, ()),
    (0b11, (1,)),
    (0b111, (1, 3)),
    (0b1011, (1, 3, 1)),
    (0b1101, (1, 1, 1)),
    (0b10011, (1, 1, 3, 3)),
    (0b11001, (1, 3, 5, 13)),
    (0b100101, (1, 1, 5, 5, 17)),
    (0b101001, (1, 1, 5, 5, 5)),
    (0b101111, (1, 1, 7, 11, 19)),
    (0b110111, (1, 1, 5, 1, 1)),
    (0b111011, (1, 1, 1, 3, 11)),
    (0b111101, (1, 3, 5, 5, 31)),
)
_BITS = 32


# Only the last set of points is kept, since one may take a gigabyte.
@ft.lru_cache(maxsize=1)
def sobol_points(num_points: int, dimension: int) -> np.ndarray:
    r"""The first points of the Sobol' sequence, as 32-bit words. `num_points` is a power of
    two.

    With its index as an extra coordinate the sequence is a digital net: in every aligned
    block of $2^k$ consecutive points, each coordinate has one point in each interval of
    length $2^{-k}$.

    The direction numbers are from
    [Joe and Kuo (2008)](https://doi.org/10.1137/070709359), as in SciPy.
    """
    if dimension > len(_JOE_AND_KUO):
        return _sobol_points_of_scipy(num_points, dimension)
    rows = [_direction_numbers(*parameters) for parameters in _JOE_AND_KUO[:dimension]]
    # (d, bits)
    numbers = np.array(rows, np.uint32)
    # The points come in the order of the Gray code, as in SciPy.
    index = np.arange(num_points, dtype=np.uint32)
    gray_code = index ^ (index >> 1)
    points = np.zeros((num_points, dimension), np.uint32)
    for b in range(num_points.bit_length() - 1):
        bit = (gray_code >> b) & 1
        points ^= bit[:, None] * numbers[:, b]
    return points


def _sobol_points_of_scipy(num_points: int, dimension: int) -> np.ndarray:
    """The same points as `sobol_points`, for any dimension that SciPy has."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=False, bits=_BITS)
    points = sequence.random_base2(num_points.bit_length() - 1)
    return (points * 2.0**_BITS).astype(np.uint32)


def _direction_numbers(polynomial: int, first: tuple[int, ...]) -> list[int]:
    """The direction numbers of a coordinate, each of 32 bits. The bits of `polynomial` are
    the coefficients of its primitive polynomial, and `first` are the first of its numbers
    `m` of section 2 of Joe and Kuo: the k-th is odd and less than `2^k`."""
    degree = polynomial.bit_length() - 1
    # The first coordinate, which needs no numbers, has all of them equal to one.
    m = [*first] if first else [1] * _BITS
    for k in range(len(m), _BITS):
        next_number = m[k - degree]
        for j in range(1, degree + 1):
            coefficient = (polynomial >> (degree - j)) & 1
            next_number ^= coefficient * (m[k - j] << j)
        m.append(next_number)
    return [m_k << (_BITS - 1 - k) for k, m_k in enumerate(m)]


def nested_scramble(
    words: UInt32[Array, "..."], seed: UInt32[Array, "..."]
) -> UInt32[Array, "..."]:
    """Owen's nested uniform scrambling of 32-bit words, by a hash. Each bit is flipped or
    kept at random, as a function of the bits above it and of the seed. For each seed the
    scrambling is a bijection, which for all `k` maps intervals of length `2^-k` to
    intervals of length `2^-k`.

    It is a bijection since each of its parts is one: a sum, a product with an odd number,
    and `x ^ (x * c)` with an even `c`. In the last of these, a bit of the result is the
    same bit of `x`, flipped or kept as the bits below it say.

    Section 4 of [Laine and Karras (2011)](https://doi.org/10.1111/j.1467-8659.2011.01978.x)
    and [Burley (2020)](https://jcgt.org/published/0009/04/01/), with the constants of
    Vegdahl (2021).
    """
    # Sums and products carry to higher bits only. So the bits are reversed, for flips that
    # depend on higher bits.
    words = _reverse_bits(words)
    words = words ^ (words * np.uint32(0x3D20ADEA))
    words = words + seed
    words = words * ((seed >> np.uint32(16)) | np.uint32(1))
    words = words ^ (words * np.uint32(0x05526C56))
    words = words ^ (words * np.uint32(0x53A22864))
    return _reverse_bits(words)


def _reverse_bits(words: UInt32[Array, "..."]) -> UInt32[Array, "..."]:
    """The words with their bits in opposite order."""
    # Neighbouring single bits are exchanged, then neighbouring pairs of bits, and so on up
    # to the halves of the word. A mask selects the lower one of each two neighbours.
    masks = {1: 0x55555555, 2: 0x33333333, 4: 0x0F0F0F0F, 8: 0x00FF00FF}
    for width, lower_ones in masks.items():
        shift = np.uint32(width)
        mask = np.uint32(lower_ones)
        words = ((words >> shift) & mask) | ((words & mask) << shift)
    return (words >> np.uint32(16)) | (words << np.uint32(16))


def num_seeds(dimension: int) -> int:
    """The number of seeds that a randomization of points needs. Seeds are random words, in
    this order:

    - one to scramble the indices of the points;
    - one for each coordinate, to scramble it;
    - one for each coordinate, to shift it;
    - two that only `balanced_in_sixths` uses: one for the index of the first point, and one
        for the position of this point in its block.
    """
    return 1 + 2 * dimension + 2


def scrambled(
    points: UInt32[Array, "n d"],
    seeds: UInt32[Array, " s"],
    indices: UInt32[Array, " k"] | None = None,
) -> UInt32[Array, "k d"]:
    """Scrambles the points of `sobol_points` by the seeds, which are `num_seeds(d)` random
    words. Each word of the result is uniformly distributed. By `indices`, row `k` of the
    result is point `indices[k]` of the scrambled ones.

    The indices of the points are scrambled first, and then the coordinates of the points
    with these indices. Otherwise neighbours would have complementary coordinates in the
    same order everywhere, and errors that alternate along the sorted paths would add up.
    """
    if indices is None:
        indices = jnp.arange(len(points), dtype=jnp.uint32)
    n, d = points.shape
    # An index below `n`, a power of two, has `n.bit_length() - 1` of the 32 bits of a word.
    # Scrambling keeps it below `n` if its bits are the leading ones.
    unused_bits = np.uint32(33 - n.bit_length())
    leading = nested_scramble(indices << unused_bits, seeds[0])
    scrambled_indices = leading >> unused_bits
    chosen_points = points[scrambled_indices.astype(jnp.int32)]
    words = nested_scramble(chosen_points, seeds[1 : d + 1])
    # The hash alone is not exactly uniform over all seeds. A digital shift makes it so.
    return words ^ seeds[d + 1 : 2 * d + 1]


def balanced_in_sixths(
    points: UInt32[Array, "n 1"], seeds: UInt32[Array, " s"]
) -> UInt32[Array, "n 1"]:
    """Scrambles points as `scrambled` does, for a single variable with three values: the
    first sixth of all words stands for one value, the last sixth for another, and the words
    between for the third. Up to rounding, 1e-9, the values have the probabilities 1/6, 1/6
    and 2/3.

    A power of two is not divisible by six. So the values are balanced in blocks of six
    consecutive points: the smallest of a block becomes the first of all words, the largest
    the last one, and the other four the middle one.
    """
    n = len(points)
    if n < _BLOCK:
        return scrambled(points, seeds)
    # The first point and its position in its block are random, by the two seeds that
    # `scrambled` leaves. So each point has the same law, and is the smallest of its block
    # with probability 1/6.
    first_index, position = seeds[-2:]
    position_in_block = position % np.uint32(_BLOCK)
    # `n` points are in at most `n // 6 + 2` blocks, wherever in its block the first one is.
    num_blocks = n // _BLOCK + 2
    positions = jnp.arange(_BLOCK * num_blocks, dtype=jnp.uint32)
    # The points in turn, beginning again after the last. (`n` is a power of two.)
    indices = (positions + first_index) & np.uint32(n - 1)
    words = scrambled(points, seeds, indices)
    blocks = words.reshape(num_blocks, _BLOCK)
    is_smallest = blocks == jnp.min(blocks, axis=1, keepdims=True)
    is_largest = blocks == jnp.max(blocks, axis=1, keepdims=True)
    middle_or_last = jnp.where(is_largest, np.uint32(2**32 - 1), np.uint32(2**31))
    balanced = jnp.where(is_smallest, np.uint32(0), middle_or_last).reshape(-1, 1)
    return lax.dynamic_slice_in_dim(balanced, position_in_block.astype(jnp.int32), n)
