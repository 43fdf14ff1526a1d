"""The order of states along Hilbert's curve, in which neighbours are close to each other in
state space."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32, UInt, UInt32


# The most bits of a coordinate that sorting uses: 65,536 cells along each axis, four times
# the default number of paths. Each bit costs some operations on all paths.
_COORDINATE_BITS = 16
# About how many states the range of a coordinate is estimated from, and the share of them
# that is left out at either end. The range need not be accurate: the grid is three times as
# wide.
_SAMPLE = 256
_OUTLIERS = 1 / 50
# The bits of an unsigned integer, less one that marks the rows at the end.
_BITS_OF_64 = 63
_BITS_OF_32 = 31


def hilbert_order(
    z: Float[Array, "n d"], last: Bool[Array, " n"]
) -> Int32[Array, " n"]:
    """The indices of the rows of `z` in order along Hilbert's curve, with the rows marked
    `last` at the end."""
    n, _ = z.shape
    has_64_bits = jnp.result_type(float) == np.float64
    if not has_64_bits:
        key = _curve(_on_grid(z, _BITS_OF_32), _BITS_OF_32, jnp.uint32)
        key = jnp.where(last, np.uint32(2**_BITS_OF_32), key)
        return lax.sort((key, jnp.arange(n, dtype=jnp.int32)), num_keys=1)[1]
    # On CPUs XLA sorts a single array of unsigned integers ten times as fast as anything
    # else, so the row's index is packed into the bits below its curve index.
    index_bits = (n - 1).bit_length()
    bits = _BITS_OF_64 - index_bits
    key = _curve(_on_grid(z, bits), bits, jnp.uint64)
    key = jnp.where(last, np.uint64(2**bits), key)
    packed = (key << np.uint64(index_bits)) | jnp.arange(n, dtype=jnp.uint64)
    packed = jnp.sort(packed)
    return (packed & np.uint64(2**index_bits - 1)).astype(jnp.int32)


def _resolution(d: int, total: int) -> int:
    """The bits of each of `d` coordinates, if there are `total` bits together."""
    return max(1, min(_COORDINATE_BITS, total // d))


def _on_grid(z: Float[Array, "n d"], total: int) -> list[UInt32[Array, " n"]]:
    """The coordinates as integers of `total` bits together. Coordinates for which no bit is
    left are dropped.

    The grid is three times as wide as the range of nearly all states, and outliers are
    clipped to its edges, so that they do not coarsen it.
    """
    n, d = z.shape
    d = min(d, total)
    bits = _resolution(d, total)
    z = jnp.nan_to_num(z[:, :d])
    sample = jnp.sort(z[:: max(1, n // _SAMPLE)], axis=0)
    outliers = int(len(sample) * _OUTLIERS)
    low = sample[outliers]
    high = sample[-1 - outliers]
    width = jnp.where(high > low, high - low, 1)
    x = ((z - low) / width + 1) * np.asarray(2.0**bits / 3, z.dtype)
    # At most 16 bits each, which are exact in single precision.
    x = jnp.clip(x, 0, 2.0**bits - 1).astype(jnp.uint32)
    return [x[:, i] for i in range(d)]


def _curve(x: list[UInt32[Array, " n"]], total: int, dtype: Any) -> UInt[Array, " n"]:
    """The index along Hilbert's curve, by the algorithm of
    [Skilling (2004)](https://doi.org/10.1063/1.1751381)."""
    bits = _resolution(len(x), total)
    # In one dimension the curve is the line itself.
    if len(x) > 1:
        x = _transposed_index(x, bits)
    # Its bits are dealt out in turn to the numbers in `x`, the highest first.
    index = jnp.zeros(x[0].shape, dtype)
    for b in range(bits - 1, -1, -1):
        for coordinate in x:
            bit = ((coordinate >> np.uint32(b)) & np.uint32(1)).astype(dtype)
            index = (index << np.asarray(1, dtype)) | bit
    return index


def _transposed_index(
    x: list[UInt32[Array, " n"]], bits: int
) -> list[UInt32[Array, " n"]]:
    """The index as as many numbers as there are coordinates, of `bits` bits each."""
    x = [*x]
    for b in range(bits - 1, 0, -1):
        bit = np.uint32(1 << b)
        below = np.uint32((1 << b) - 1)
        for i in range(len(x)):
            # Invert the lower bits of the first coordinate, or exchange them with the lower
            # bits of this one.
            inverts = (x[i] & bit) != 0
            exchanged = jnp.where(inverts, np.uint32(0), (x[0] ^ x[i]) & below)
            x[0] = x[0] ^ jnp.where(inverts, below, exchanged)
            if i > 0:
                x[i] = x[i] ^ exchanged
    # Decode the Gray code.
    for i in range(1, len(x)):
        x[i] = x[i] ^ x[i - 1]
    flips = jnp.zeros_like(x[0])
    for b in range(bits - 1, 0, -1):
        below = np.uint32((1 << b) - 1)
        is_set = (x[-1] & np.uint32(1 << b)) != 0
        flips = flips ^ jnp.where(is_set, below, np.uint32(0))
    return [coordinate ^ flips for coordinate in x]
