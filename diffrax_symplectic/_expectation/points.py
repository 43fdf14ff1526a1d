"""Randomized low-discrepancy points, as random 32-bit words, and the sorting of states
along Hilbert's curve."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32, UInt, UInt32


# The most bits of a coordinate that sorting uses.
_COORDINATE_BITS = 16
# The number of states from which the range of a coordinate is estimated.
_SAMPLE = 256
# The number of consecutive points among which a single three-point variable is balanced.
_BLOCK = 6


# A set may take a gigabyte.
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
    # Imported here because it takes most of a second.
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=False, bits=32)
    points = sequence.random_base2(num_points.bit_length() - 1)
    return (points * 2.0**32).astype(np.uint32)


def nested_scramble(x: UInt32[Array, "..."], seed: UInt32[Array, "..."]):
    """Owen's nested uniform scrambling of 32-bit words, by a hash: each bit is flipped or
    not at random, as a function of the bits above it. For each seed this is a bijection
    which maps intervals of length `2^-k` to such intervals, for all `k`.

    Section 4 of [Laine and Karras (2011)](https://doi.org/10.1111/j.1467-8659.2011.01978.x)
    and [Burley (2020)](https://jcgt.org/published/0009/04/01/), with the constants of
    Vegdahl (2021).
    """
    # With the bits reversed, the flip of a bit must depend on lower bits only, as the
    # carries of sums and products do.
    x = _reverse_bits(x)
    x = x ^ (x * np.uint32(0x3D20ADEA))
    x = x + seed
    x = x * ((seed >> np.uint32(16)) | np.uint32(1))
    x = x ^ (x * np.uint32(0x05526C56))
    x = x ^ (x * np.uint32(0x53A22864))
    return _reverse_bits(x)


def _reverse_bits(x: UInt32[Array, "..."]) -> UInt32[Array, "..."]:
    for shift, mask in (
        (1, 0x55555555),
        (2, 0x33333333),
        (4, 0x0F0F0F0F),
        (8, 0x00FF00FF),
    ):
        s, m = np.uint32(shift), np.uint32(mask)
        x = ((x >> s) & m) | ((x & m) << s)
    return (x >> np.uint32(16)) | (x << np.uint32(16))


def num_seeds(dimension: int) -> int:
    """The number of random words that `randomized` needs."""
    return 3 + 2 * dimension


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
    if not sixths or n < _BLOCK:
        return _scrambled(points, jnp.arange(n, dtype=jnp.uint32), seeds)
    # Blocks of six and points both start at random, so each point has the same law, and is
    # the smallest of its block with probability 1/6.
    start, offset = seeds[-2], seeds[-1] % np.uint32(_BLOCK)
    blocks = n // _BLOCK + 2
    number = jnp.arange(_BLOCK * blocks, dtype=jnp.uint32) + start
    words = _scrambled(points, number & np.uint32(n - 1), seeds)
    words = words.reshape(blocks, _BLOCK)
    smallest = words == jnp.min(words, axis=1, keepdims=True)
    largest = words == jnp.max(words, axis=1, keepdims=True)
    words = jnp.where(largest, np.uint32(2**32 - 1), np.uint32(2**31))
    words = jnp.where(smallest, np.uint32(0), words).reshape(-1, d)
    return lax.dynamic_slice_in_dim(words, offset.astype(jnp.int32), n)


def _scrambled(
    points: UInt32[Array, "n d"], number: UInt32[Array, " m"], seeds
) -> UInt32[Array, "m d"]:
    n, d = points.shape
    bits = np.uint32(33 - n.bit_length())
    number = nested_scramble(number << bits, seeds[0]) >> bits
    words = nested_scramble(points[number.astype(jnp.int32)], seeds[1 : 1 + d])
    # The hash of one seed is not quite uniform; a digital shift makes it so.
    return words ^ seeds[1 + d : 1 + 2 * d]


def hilbert_order(
    z: Float[Array, "n d"], last: Bool[Array, " n"]
) -> Int32[Array, " n"]:
    """The indices of the rows of `z` in order along Hilbert's curve, with the rows marked
    `last` at the end."""
    n, d = z.shape
    index_bits = (n - 1).bit_length()
    if jax.dtypes.canonicalize_dtype(np.uint64) == np.uint64:
        # On CPUs XLA sorts a single array of unsigned integers ten times as fast as
        # anything else, so the row's index is packed into the bits below its curve index.
        key = _curve(_on_grid(z, 63 - index_bits), 63 - index_bits, jnp.uint64)
        key = jnp.where(last, np.uint64(2 ** (63 - index_bits)), key)
        packed = (key << np.uint64(index_bits)) | jnp.arange(n, dtype=jnp.uint64)
        packed = jnp.sort(packed)
        return (packed & np.uint64(2**index_bits - 1)).astype(jnp.int32)
    key = _curve(_on_grid(z, 31), 31, jnp.uint32)
    key = jnp.where(last, np.uint32(2**31), key)
    return lax.sort((key, jnp.arange(n, dtype=jnp.int32)), num_keys=1)[1]


def _resolution(d: int, total: int) -> int:
    return max(1, min(_COORDINATE_BITS, total // d))


def _on_grid(z: Float[Array, "n d"], total: int) -> list[UInt[Array, " n"]]:
    """The coordinates as integers of `total` bits together. Coordinates for which no bit is
    left are dropped.

    The grid is three times as wide as the range of nearly all states, and outliers are
    clipped to its edges, so that they do not coarsen it.
    """
    n, d = z.shape
    d, bits = min(d, total), _resolution(d, total)
    z = jnp.nan_to_num(z[:, :d])
    sample = jnp.sort(z[:: max(1, n // _SAMPLE)], axis=0)
    k = len(sample) // 50
    low, high = sample[k], sample[-1 - k]
    width = jnp.where(high > low, high - low, 1)
    x = ((z - low) / width + 1) * np.asarray(2.0**bits / 3, z.dtype)
    x = jnp.clip(x, 0, 2.0**bits - 1).astype(jnp.uint32)
    return [x[:, i] for i in range(d)]


def _curve(x: list[UInt[Array, " n"]], total: int, dtype) -> UInt[Array, " n"]:
    """The index along Hilbert's curve, by the algorithm of
    [Skilling (2004)](https://doi.org/10.1063/1.1751381)."""
    d, x = len(x), [*x]
    bits = _resolution(d, total)
    if d > 1:
        for b in range(bits - 1, 0, -1):
            bit, below = np.uint32(1 << b), np.uint32((1 << b) - 1)
            for i in range(d):
                # Invert the lower bits of the first coordinate, or exchange them with the
                # lower bits of this one.
                inverts = (x[i] & bit) != 0
                t = jnp.where(inverts, np.uint32(0), (x[0] ^ x[i]) & below)
                x[0] = x[0] ^ jnp.where(inverts, below, t)
                if i > 0:
                    x[i] = x[i] ^ t
        # Decode the Gray code.
        for i in range(1, d):
            x[i] = x[i] ^ x[i - 1]
        t = jnp.zeros_like(x[0])
        for b in range(bits - 1, 0, -1):
            ones = np.uint32((1 << b) - 1)
            t = t ^ jnp.where((x[-1] & np.uint32(1 << b)) != 0, ones, np.uint32(0))
        x = [v ^ t for v in x]
    key = jnp.zeros(x[0].shape, dtype)
    for b in range(bits - 1, -1, -1):
        for v in x:
            bit = ((v >> np.uint32(b)) & np.uint32(1)).astype(dtype)
            key = (key << np.asarray(1, dtype)) | bit
    return key
