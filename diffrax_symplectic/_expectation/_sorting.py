"""An order in which states that lie close together follow each other: along Hilbert's
curve."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32, UInt


# A coordinate is read to this many bits at most.
_COORDINATE_BITS = 16
# The range of a coordinate is estimated from this many states.
_SAMPLE = 256


def hilbert_order(
    z: Float[Array, "n d"], last: Bool[Array, " n"]
) -> Int32[Array, " n"]:
    """The numbers of the rows of `z` in the order in which Hilbert's curve meets them,
    with those of which `last` is true at the end."""
    n, d = z.shape
    index_bits = max(1, (n - 1).bit_length())
    if jax.dtypes.canonicalize_dtype(np.uint64) == np.uint64 and index_bits <= 32:
        # XLA sorts one operand of unsigned integers ten times as fast as anything else on
        # CPUs, so that the number of a row lies in the bits below its place on the curve.
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
    """The coordinates as integers of so many bits in all. Coordinates for which there is no
    bit are left out.

    The grid is three times as wide as where nearly all states are; the others lie at its
    edges. A few that are far away do not make it coarse.
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
    """The place on Hilbert's curve, by the algorithm of
    [Skilling (2004)](https://doi.org/10.1063/1.1751381)."""
    d, x = len(x), [*x]
    bits = _resolution(d, total)
    if d > 1:
        for b in range(bits - 1, 0, -1):
            bit, below = np.uint32(1 << b), np.uint32((1 << b) - 1)
            for i in range(d):
                # Inverts the lower bits of the first coordinate, or exchanges them with
                # those of this one.
                inverts = (x[i] & bit) != 0
                t = jnp.where(inverts, np.uint32(0), (x[0] ^ x[i]) & below)
                x[0] = x[0] ^ jnp.where(inverts, below, t)
                if i > 0:
                    x[i] = x[i] ^ t
        # From the Gray code.
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
