"""Randomized low-discrepancy points, as random 32-bit words."""

import functools as ft

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, UInt32


# The number of consecutive points among which a single three-point variable is balanced:
# its outer values have probability one sixth.
_BLOCK = 6
# The primitive polynomials and the first direction numbers of the first coordinates of
# Sobol' points, by Joe and Kuo (2008). The first coordinate needs neither. SciPy has
# 21,201, but importing it takes 2.4 s of processor time, where a first estimate takes 15.
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
    numbers = [_direction_numbers(*parameters) for parameters in _JOE_AND_KUO]
    # (bits, d)
    numbers = np.array(numbers[:dimension], np.uint32).T
    # Neighbours in the order of the Gray code differ in one bit.
    index = np.arange(num_points, dtype=np.uint32)
    gray_code = index ^ (index >> 1)
    points = np.zeros((num_points, dimension), np.uint32)
    for b in range(num_points.bit_length() - 1):
        bit = (gray_code >> b) & 1
        points ^= bit[:, None] * numbers[b]
    return points


def _sobol_points_of_scipy(num_points: int, dimension: int) -> np.ndarray:
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=False, bits=_BITS)
    points = sequence.random_base2(num_points.bit_length() - 1)
    return (points * 2.0**_BITS).astype(np.uint32)


def _direction_numbers(polynomial: int, first: tuple[int, ...]) -> list[int]:
    """The direction numbers of a coordinate, each of 32 bits, from the coefficients of a
    primitive polynomial, as bits, and the first numbers."""
    degree = polynomial.bit_length() - 1
    # The numbers `m` of section 2 of Joe and Kuo: odd, and the k-th of them below `2^k`.
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
    """Owen's nested uniform scrambling of 32-bit words, by a hash: each bit is flipped or
    not at random, as a function of the bits above it. For each seed this is a bijection
    which maps intervals of length `2^-k` to such intervals, for all `k`.

    It is a bijection since each of its parts is one: a sum; a product with an odd number;
    and `x ^ (x * c)` with an even `c`, where a bit of the result is the same bit of `x`,
    flipped or not by the bits below it.

    Section 4 of [Laine and Karras (2011)](https://doi.org/10.1111/j.1467-8659.2011.01978.x)
    and [Burley (2020)](https://jcgt.org/published/0009/04/01/), with the constants of
    Vegdahl (2021).
    """
    # With the bits reversed, the flip of a bit must depend on lower bits only, as the
    # carries of sums and products do.
    words = _reverse_bits(words)
    words = words ^ (words * np.uint32(0x3D20ADEA))
    words = words + seed
    words = words * ((seed >> np.uint32(16)) | np.uint32(1))
    words = words ^ (words * np.uint32(0x05526C56))
    words = words ^ (words * np.uint32(0x53A22864))
    return _reverse_bits(words)


def _reverse_bits(words: UInt32[Array, "..."]) -> UInt32[Array, "..."]:
    """The words with their bits in opposite order."""
    # Neighbours are exchanged: single bits, then pairs, and so on up to halves of the word.
    # A mask selects the lower one of each two neighbours.
    masks = {1: 0x55555555, 2: 0x33333333, 4: 0x0F0F0F0F, 8: 0x00FF00FF}
    for width, lower_ones in masks.items():
        shift = np.uint32(width)
        mask = np.uint32(lower_ones)
        words = ((words >> shift) & mask) | ((words & mask) << shift)
    return (words >> np.uint32(16)) | (words << np.uint32(16))


def num_seeds(dimension: int) -> int:
    """The number of random words that a randomization needs. In this order: one scrambles
    the indices of the points; one for each coordinate scrambles it, and one for each shifts
    it; and for `balanced_in_sixths`, one is the index of the first point, and one the place
    of this point in its block."""
    return 1 + 2 * dimension + 2


def scrambled(
    points: UInt32[Array, "n d"], seeds: UInt32[Array, " s"]
) -> UInt32[Array, "n d"]:
    """The points of `sobol_points`, scrambled, with `num_seeds(d)` random words for seeds.
    Each word is exactly uniform.

    The indices of the points are scrambled as well as their coordinates. Otherwise
    neighbours would have complementary coordinates in the same order everywhere, and errors
    that alternate along the sorted paths would add up.
    """
    indices = jnp.arange(len(points), dtype=jnp.uint32)
    return _scrambled_points(points, indices, seeds)


def balanced_in_sixths(
    points: UInt32[Array, "n 1"], seeds: UInt32[Array, " s"]
) -> UInt32[Array, "n 1"]:
    """As `scrambled`, for a single coordinate of which only the first sixth, the last sixth
    and the range between are told apart. Up to rounding, 1e-9, these have the probabilities
    1/6, 1/6 and 2/3.

    A power of two is not divisible by six, so of each six consecutive points the smallest
    becomes the first word of the range, the largest the last, and the others the middle.
    """
    n, d = points.shape
    if n < _BLOCK:
        return scrambled(points, seeds)
    # The first point and its place in its block are random. So each point has the same law,
    # and is the smallest of its block with probability 1/6.
    first_index, place = seeds[-2:]
    place_in_block = place % np.uint32(_BLOCK)
    # `n` points are in at most `n // 6 + 2` blocks, wherever the first one begins.
    num_blocks = n // _BLOCK + 2
    places = jnp.arange(_BLOCK * num_blocks, dtype=jnp.uint32)
    # The points in turn, beginning again after the last (`n` is a power of two).
    indices = (places + first_index) & np.uint32(n - 1)
    words = _scrambled_points(points, indices, seeds)
    blocks = words.reshape(num_blocks, _BLOCK)
    is_smallest = blocks == jnp.min(blocks, axis=1, keepdims=True)
    is_largest = blocks == jnp.max(blocks, axis=1, keepdims=True)
    middle_or_last = jnp.where(is_largest, np.uint32(2**32 - 1), np.uint32(2**31))
    balanced = jnp.where(is_smallest, np.uint32(0), middle_or_last).reshape(-1, d)
    return lax.dynamic_slice_in_dim(balanced, place_in_block.astype(jnp.int32), n)


def _scrambled_points(
    points: UInt32[Array, "n d"],
    indices: UInt32[Array, " k"],
    seeds: UInt32[Array, " s"],
) -> UInt32[Array, "k d"]:
    """The points with these indices, with both the indices and the points scrambled."""
    n, d = points.shape
    # Indices below `n`, a power of two, have `n.bit_length() - 1` of the 32 bits of a word.
    # They are scrambled as the leading bits.
    unused_bits = np.uint32(33 - n.bit_length())
    leading = nested_scramble(indices << unused_bits, seeds[0])
    scrambled_indices = leading >> unused_bits
    chosen_points = points[scrambled_indices.astype(jnp.int32)]
    words = nested_scramble(chosen_points, seeds[1 : d + 1])
    # The hash of one seed is not quite uniform; a digital shift makes it so.
    return words ^ seeds[d + 1 : 2 * d + 1]
