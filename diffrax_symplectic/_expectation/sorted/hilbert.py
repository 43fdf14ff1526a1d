"""The order of states along Hilbert's curve, in which neighbours are close to each other in
state space."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32, UInt, UInt32


# The most bits of a coordinate that sorting uses: 16 bits are 65,536 cells along each axis,
# four times the default number of paths. Each bit costs some operations on all paths.
_COORDINATE_BITS = 16
# The range of a coordinate is estimated from about this many states, of which this share is
# left out at either end. It need not be accurate, since the grid is three times as wide.
_SAMPLE_SIZE = 256
_SHARE_OF_OUTLIERS = 1 / 50


def hilbert_order(
    z: Float[Array, "n d"], is_last: Bool[Array, " n"]
) -> Int32[Array, " n"]:
    """The indices of the rows of `z`, the coordinates of states, in order along Hilbert's
    curve, with the rows marked `is_last` at the end."""
    n, num_coordinates = z.shape
    rows = jnp.arange(n, dtype=jnp.int32)
    has_64_bits = jnp.result_type(float) == np.float64
    dtype = np.uint64 if has_64_bits else np.uint32
    row_bits = (n - 1).bit_length() if has_64_bits else 0
    # The highest bit marks the rows at the end.
    total_bits = np.iinfo(dtype).bits - 1 - row_bits
    # Coordinates for which no bit is left are dropped.
    d = min(num_coordinates, total_bits)
    bits = min(_COORDINATE_BITS, total_bits // d)
    places = _places_on_curve(_cells(z[:, :d], bits), bits, dtype)
    # Beyond all places on the curve.
    places = jnp.where(is_last, dtype(2**total_bits), places)
    if not has_64_bits:
        _, order = lax.sort((places, rows), num_keys=1)
        return order
    # On CPUs XLA sorts a single array of unsigned integers ten times as fast as anything
    # else, so the row's number is packed into the bits below its place on the curve.
    packed = jnp.sort((places << dtype(row_bits)) | rows.astype(dtype))
    return (packed & dtype(2**row_bits - 1)).astype(jnp.int32)


def _cells(z: Float[Array, "n d"], bits: int) -> list[UInt32[Array, " n"]]:
    """The coordinates of points as integers of so many bits, the cells of a grid.

    The grid is three times as wide as the range of nearly all states, and outliers are
    clipped to its edges, so that they do not coarsen it.
    """
    z = jnp.nan_to_num(z)
    # Some states at equal distances in `z`, of which each coordinate is sorted by itself.
    stride = max(1, len(z) // _SAMPLE_SIZE)
    sample = jnp.sort(z[::stride], axis=0)
    num_outliers = int(len(sample) * _SHARE_OF_OUTLIERS)
    low = sample[num_outliers]
    high = sample[-1 - num_outliers]
    width = jnp.where(high > low, high - low, 1)
    # The distance from the lower edge of the grid, in thirds of the grid: 1 at `low`, and 2
    # at `high`.
    thirds = (z - low) / width + 1
    positions = thirds * np.asarray(2.0**bits / 3, z.dtype)
    # Integers of at most 16 bits are exact in single precision.
    cells = jnp.clip(positions, 0, 2.0**bits - 1).astype(jnp.uint32)
    return [cells[:, i] for i in range(z.shape[1])]


def _places_on_curve(
    cells: list[UInt32[Array, " n"]], bits: int, dtype: Any
) -> UInt[Array, " n"]:
    """The place along Hilbert's curve of each cell, whose coordinates have so many bits, as
    an integer of this dtype, by the algorithm of [Skilling
    (2004)](https://doi.org/10.1063/1.1751381)."""
    # In one dimension the curve is the line itself.
    transposed = cells if len(cells) == 1 else _transposed_place(cells, bits)
    # The bits of the place are dealt out in turn to the numbers in `transposed`, the
    # highest first. Here they are collected again.
    places = jnp.zeros(transposed[0].shape, dtype)
    for b in range(bits - 1, -1, -1):
        for number in transposed:
            bit = ((number >> np.uint32(b)) & np.uint32(1)).astype(dtype)
            places = (places << np.asarray(1, dtype)) | bit
    return places


def _transposed_place(
    cells: list[UInt32[Array, " n"]], bits: int
) -> list[UInt32[Array, " n"]]:
    """The place along the curve in Skilling's transposed form: one number of `bits` bits
    for each coordinate, to which the bits of the place are dealt out in turn. (This is
    `AxestoTranspose` of the paper, with `x` for its `X`, `bit` for `Q`, `below` for `P` and
    `flips` for `t`.)"""
    x = [*cells]
    for b in range(bits - 1, 0, -1):
        bit = np.uint32(1 << b)
        below = np.uint32((1 << b) - 1)
        for i in range(len(x)):
            # Invert the lower bits of the first coordinate, or exchange them with the lower
            # bits of this one.
            is_inverted = (x[i] & bit) != 0
            exchanged = jnp.where(is_inverted, np.uint32(0), (x[0] ^ x[i]) & below)
            x[0] = x[0] ^ jnp.where(is_inverted, below, exchanged)
            if i > 0:
                x[i] = x[i] ^ exchanged
    # Decode the Gray code.
    for i in range(1, len(x)):
        x[i] = x[i] ^ x[i - 1]
    flips = jnp.zeros_like(x[0])
    for b in range(bits - 1, 0, -1):
        below = np.uint32((1 << b) - 1)
        is_set = (x[-1] & np.uint32(1 << b)) != 0
        # The bits of the last number flip all lower bits of all numbers.
        flips = flips ^ jnp.where(is_set, below, np.uint32(0))
    return [coordinate ^ flips for coordinate in x]
