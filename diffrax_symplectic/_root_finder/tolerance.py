"""The convergence criterion: when a correction is small enough."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar


_Flag: TypeAlias = Bool[Array, ""]

# Up to this many entries the maximum is unrolled. XLA does not fuse a reduction with the
# users of its result, and reduces short axes slowly on CPUs.
_SHORT = 4
# Longer arrays are first folded to this length, elementwise, which fuses with their
# computation. Each reduction of a longer array would need a temporary array.
_WIDE = 32


# The next correction must be below the tolerance by a factor of 64, of which this is the
# base-2 logarithm. The remaining error has the same sign in every step and would add up to
# a drift, while rounding errors cancel.
LOG2_MARGIN = 6
# Corrections below this many roundings of the whole state may be the rounding errors of all
# stages together. They count as rounding errors only if they no longer shrink.
ROUNDINGS = 100
# A correction below this fraction of the state is small: the iterate is close enough for
# Newton's method to begin with.
_SMALL = 0.01


class CorrectionSize(NamedTuple):
    """The size of a correction.

    - `size`: the largest over all leaves, in units of their tolerances: 1 is just accepted.
    - `size_of_state`: the `size` that a correction as large as the whole state would have.
    - `is_rounding`: whether it is as small as rounding errors of the whole state, which can
        keep the corrections of a comparatively small leaf above its own tolerance forever.
    - `is_small`: whether it is below a hundredth of the whole state, so that the iterate is
        worth keeping.
    """

    size: Scalar
    size_of_state: Scalar
    is_rounding: _Flag
    is_small: _Flag


class Tolerance(NamedTuple):
    """Measures corrections in units of `rtol * scale + atol`, leaf by leaf.

    - `rtol`, `atol`: as for root finders of Optimistix. An `rtol` of `None` is two units in
        the last place.
    - `norm`: the norm within a leaf.
    """

    rtol: float | None
    atol: float
    norm: Callable[[PyTree], Scalar]

    def sizes(self, y: PyTree[Array]) -> list[Scalar]:
        """The norm of each leaf."""
        # The `max_norm` of this module is the same number, from a faster program.
        norm = max_norm if self.norm is optx.max_norm else self.norm
        return [norm(leaf) for leaf in jtu.tree_leaves(y)]

    def measure(
        self, correction: PyTree[Array], scale: PyTree[Array]
    ) -> CorrectionSize:
        """The size of a correction to a state of size `scale`, in the same structure."""
        sizes = self.sizes(correction)
        scales = self.sizes(scale)
        whole_state = largest(scales)
        size = self._in_units(sizes, scales)
        size_of_state = self._in_units([whole_state], [whole_state])
        eps = float(jnp.finfo(size.dtype).eps)
        # Comparisons are strict: an infinite correction to an infinite state, whose limits
        # are infinite, too, is neither rounding nor small.
        is_rounding = largest(sizes) < ROUNDINGS * eps * whole_state
        is_small = largest(sizes) < _SMALL * whole_state
        return CorrectionSize(size, size_of_state, is_rounding, is_small)

    def _in_units(self, sizes: list[Scalar], scales: list[Scalar]) -> Scalar:
        """The largest of these sizes, each in units of its tolerance."""
        eps = jnp.finfo(jnp.result_type(*sizes)).eps
        rtol = 2 * eps if self.rtol is None else self.rtol
        # Leaves are measured one by one, so that a leaf far from zero does not hide the
        # errors of a leaf near zero.
        ratios = [
            ratio(size, rtol * scale + self.atol) for size, scale in zip(sizes, scales)
        ]
        return largest(ratios)


def max_norm(x: Array) -> Scalar:
    """The largest entry of an array by size, in few kernels; NaN if any is, and zero if
    there is none."""
    if x.size == 0:
        return jnp.zeros((), x.dtype)
    if x.size == 1:
        return jnp.abs(x).reshape(())
    # The bits of nonnegative floats, read as integers, are ordered like their values, with
    # NaNs largest. The maximum of floats may lose NaNs; with an extra test for them, steps
    # of 16 pairs took 1.1 times as long in single precision.
    integer_dtype = f"int{jnp.finfo(x.dtype).bits}"
    bits = lax.bitcast_convert_type(jnp.abs(x), integer_dtype).reshape(-1)
    final_size = 1 if x.size <= _SHORT else _WIDE
    while bits.size > final_size:
        # The halves have equal sizes. If the size is odd, both contain the middle entry.
        first = bits[: (bits.size + 1) // 2]
        second = bits[bits.size // 2 :]
        bits = jnp.maximum(first, second)
    largest_bits = bits[0] if bits.size == 1 else jnp.max(bits)
    return lax.bitcast_convert_type(largest_bits, x.dtype)


def largest(norms: list[Scalar]) -> Scalar:
    """The largest of a few numbers; NaN if any is."""
    # Stacked for `jnp.max`, they would be a reduction, which XLA does not fuse.
    return ft.reduce(jnp.maximum, norms)


def all_finite(y: PyTree[Array]) -> _Flag:
    """Whether no entry of any array is infinite or NaN."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(y)]))


def ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: a zero correction is no error."""
    return jnp.where(a == 0, 0, a / b)


def log2(x: Scalar) -> Scalar:
    """The base-2 logarithm of a positive number to within 0.09, with the mantissa as a
    linear interpolation. With the library function steps took 1.05 to 1.4 times as long.
    Zero is below all other numbers, and NaN above."""
    # The bits of 2^k (1 + m) with 0 <= m < 1, read as an integer, are the exponent `k +
    # bias`, followed by the `nmant` bits of m. Over 2^nmant, they are `k + bias + m`. The
    # logarithm is k + log2(1 + m), where m interpolates the second part linearly. The bias
    # is `1 - minexp`.
    info = jnp.finfo(x.dtype)
    bits = lax.bitcast_convert_type(jnp.abs(x), f"int{info.bits}").astype(x.dtype)
    return bits * 2.0**-info.nmant + float(info.minexp - 1)


def converged(
    log2_size: Scalar, log2_rate: Scalar, is_rounding: _Flag, has_stalled: _Flag
) -> _Flag:
    """Whether the iteration can end, since

    - the next correction will be below the tolerance by `LOG2_MARGIN`;
    - or corrections no longer shrink (`has_stalled`) and are as small as rounding errors
        (`is_rounding`).

    `log2_size` is the base-2 logarithm of the last correction, in units of the tolerance.
    `log2_rate` is that of its ratio to the previous correction.
    """
    # With linear convergence the next correction is smaller by the same ratio. A correction
    # that grew says nothing about the next one, so that it must be small itself.
    next_log2_size = log2_size + jnp.minimum(log2_rate, 0)
    return (next_log2_size <= -LOG2_MARGIN) | (has_stalled & is_rounding)
