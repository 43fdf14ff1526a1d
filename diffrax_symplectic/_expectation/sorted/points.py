"""Randomized low-discrepancy points, as random 32-bit words."""

import functools as ft

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, UInt32


# The number of consecutive points among which a single three-point variable is balanced:
# its outer values have probability one sixth.
_SIX = 6


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
    # SciPy is imported here because that takes most of a second.
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=False, bits=32)
    points = sequence.random_base2(num_points.bit_length() - 1)
    return (points * 2.0**32).astype(np.uint32)


def nested_scramble(
    words: UInt32[Array, "..."], seed: UInt32[Array, "..."]
) -> UInt32[Array, "..."]:
    """Owen's nested uniform scrambling of 32-bit words, by a hash: each bit is flipped or
    not at random, as a function of the bits above it. For each seed this is a bijection
    which maps intervals of length `2^-k` to such intervals, for all `k`.

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
    """The number of random words that `randomized` needs."""
    for_indices = 1
    # One to scramble each coordinate, and one to shift it.
    for_coordinates = 2 * dimension
    # One for the first block of six, and one for the place in it.
    for_blocks = 2
    return for_indices + for_coordinates + for_blocks


def randomized(
    points: UInt32[Array, "n d"], seeds: UInt32[Array, " s"], sixths: bool = False
) -> UInt32[Array, "n d"]:
    """The points of `sobol_points`, scrambled. Each word is exactly uniform.

    The indices of the points are scrambled as well as their coordinates. Otherwise
    neighbours would have complementary coordinates in the same order everywhere, and errors
    that alternate along the sorted paths would add up.

    `sixths` is for a single coordinate of which only the first sixth, the last sixth and
    the range between are told apart. A power of two is not divisible by six, so of each six
    consecutive points the smallest becomes the first word of the range, the largest the
    last, and the others the middle.
    """
    n, d = points.shape
    if not sixths or n < _SIX:
        return _scrambled(points, jnp.arange(n, dtype=jnp.uint32), seeds)
    # The first point and its place in its block are random. So each point has the same law,
    # and is the smallest of its block with probability 1/6.
    start = seeds[-2]
    offset = seeds[-1] % np.uint32(_SIX)
    # `n` points are in at most `n // 6 + 2` blocks, wherever the first one begins.
    num_blocks = n // _SIX + 2
    numbers = jnp.arange(_SIX * num_blocks, dtype=jnp.uint32) + start
    # The points in turn, beginning again after the last (`n` is a power of two).
    words = _scrambled(points, numbers & np.uint32(n - 1), seeds)
    words = words.reshape(num_blocks, _SIX)
    is_smallest = words == jnp.min(words, axis=1, keepdims=True)
    is_largest = words == jnp.max(words, axis=1, keepdims=True)
    words = jnp.where(is_largest, np.uint32(2**32 - 1), np.uint32(2**31))
    words = jnp.where(is_smallest, np.uint32(0), words).reshape(-1, d)
    return lax.dynamic_slice_in_dim(words, offset.astype(jnp.int32), n)


def _scrambled(
    points: UInt32[Array, "n d"],
    numbers: UInt32[Array, " m"],
    seeds: UInt32[Array, " s"],
) -> UInt32[Array, "m d"]:
    """The points with these numbers, both the numbers and the points scrambled."""
    n, d = points.shape
    # Numbers below `n`, a power of two, have `n.bit_length() - 1` of the 32 bits of a word.
    # They are scrambled as the leading bits.
    unused_bits = np.uint32(33 - n.bit_length())
    numbers = nested_scramble(numbers << unused_bits, seeds[0]) >> unused_bits
    scrambling_seeds = seeds[1 : 1 + d]
    shifts = seeds[1 + d : 1 + 2 * d]
    words = nested_scramble(points[numbers.astype(jnp.int32)], scrambling_seeds)
    # The hash of one seed is not quite uniform; a digital shift makes it so.
    return words ^ shifts
