"""The order of states along Hilbert's curve, in which neighbours are close to each other in
state space.

A grid of cells covers nearly all states. The curve visits each cell once, and the place of
a cell is its number along the curve. States are sorted by the places of their cells.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32, UInt, UInt32


# There are at most `2**_COORDINATE_BITS` cells along each axis: 65,536, which is four times
# the default number of paths. Each bit costs some operations on all paths.
_COORDINATE_BITS = 16
# The range of each coordinate is estimated from about this many states, of which this share
# is left out at either end. The estimate need not be accurate, since the grid is three
# times as wide as the range.
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
    # On CPUs XLA sorts a single array of unsigned integers ten times as fast as anything
    # else. So with 64 bits one integer holds both the place of a state and its row.
    row_bits = (n - 1).bit_length() if has_64_bits else 0
    # The lowest bits hold the row and the highest bit marks the rows at the end, so a place
    # has the bits between.
    place_bits = np.iinfo(dtype).bits - 1 - row_bits
    # Coordinates for which no bit is left are dropped.
    d = min(num_coordinates, place_bits)
    bits = min(_COORDINATE_BITS, place_bits // d)
    places = _places_on_curve(_cells(z[:, :d], bits), bits, dtype)
    # This number is beyond all places on the curve.
    places = jnp.where(is_last, dtype(2**place_bits), places)
    if not has_64_bits:
        _, order = lax.sort((places, rows), num_keys=1)
        return order
    # The number of the row is packed into the bits below its place.
    packed = jnp.sort((places << dtype(row_bits)) | rows.astype(dtype))
    return (packed & dtype(2**row_bits - 1)).astype(jnp.int32)


def _cells(z: Float[Array, "n d"], bits: int) -> list[UInt32[Array, " n"]]:
    """The cell of each state: for each coordinate, the number of the cell along this axis,
    an integer of `bits` bits.

    The grid is three times as wide as the range of nearly all states. Outliers are clipped
    to its edges, so that they do not make the cells larger.
    """
    z = jnp.nan_to_num(z)
    # A sample of equally spaced rows, in which each coordinate is sorted by itself.
    stride = max(1, len(z) // _SAMPLE_SIZE)
    sample = jnp.sort(z[::stride], axis=0)
    num_outliers = int(len(sample) * _SHARE_OF_OUTLIERS)
    low = sample[num_outliers]
    high = sample[-1 - num_outliers]
    width = jnp.where(high > low, high - low, 1)
    # The distance from the lower edge of the grid, in thirds of its width: 1 at `low`, and
    # 2 at `high`.
    thirds = (z - low) / width + 1
    positions = thirds * np.asarray(2.0**bits / 3, z.dtype)
    # Integers of at most 16 bits are exact in single precision.
    cells = jnp.clip(positions, 0, 2.0**bits - 1).astype(jnp.uint32)
    return [cells[:, i] for i in range(z.shape[1])]


def _places_on_curve(
    cells: list[UInt32[Array, " n"]], bits: int, dtype: Any
) -> UInt[Array, " n"]:
    """The place of each cell along Hilbert's curve, as an integer of this dtype, by the
    algorithm of [Skilling (2004)](https://doi.org/10.1063/1.1751381). `cells` has for each
    coordinate the numbers of the cells along its axis, integers of `bits` bits."""
    # In one dimension the curve is a line, so the place is the coordinate.
    transposed = cells if len(cells) == 1 else _transposed_place(cells, bits)
    # Collect the bits of the place, the highest first, from all coordinates in turn.
    places = jnp.zeros(transposed[0].shape, dtype)
    for b in range(bits - 1, -1, -1):
        for coordinate in transposed:
            bit = ((coordinate >> np.uint32(b)) & np.uint32(1)).astype(dtype)
            places = (places << np.asarray(1, dtype)) | bit
    return places


def _transposed_place(
    cells: list[UInt32[Array, " n"]], bits: int
) -> list[UInt32[Array, " n"]]:
    """The place along the curve in Skilling's transposed form: one number of `bits` bits
    for each coordinate. The bits of the place, from the highest to the lowest, are those of
    these numbers in turn: the highest bit of each, then the second bit of each, and so on.
    (This is `AxestoTranspose` of the paper, with `x` for its `X`, `bit` for `Q`, `below`
    for `P` and `flips` for `t`.)"""
    x = [*cells]
    for b in range(bits - 1, 0, -1):
        bit = np.uint32(1 << b)
        below = np.uint32((1 << b) - 1)
        for i in range(len(x)):
            # If this bit of `x[i]` is set, invert the lower bits of `x[0]`. Otherwise
            # exchange them with the lower bits of `x[i]`.
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
        # Each bit that is set in the last number flips all lower bits of all numbers.
        flips = flips ^ jnp.where(is_set, below, np.uint32(0))
    return [coordinate ^ flips for coordinate in x]
