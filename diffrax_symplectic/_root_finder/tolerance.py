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


class Correction(NamedTuple):
    """The size of a correction.

    - `size`: the largest over all leaves, in units of their tolerances: 1 is just accepted.
    - `bound`: the `size` of a correction as large as the whole state.
    - `rounded`: whether it is as small as rounding errors of the whole state, which can
        keep the corrections of a comparatively small leaf above its own tolerance forever.
    - `small`: whether it is below a hundredth of the whole state.
    """

    size: Scalar
    bound: Scalar
    rounded: _Flag
    small: _Flag


class Tolerance(NamedTuple):
    """Measures corrections in units of `rtol * scale + atol`, leaf by leaf. An `rtol` of
    `None` is two units in the last place."""

    rtol: float | None
    atol: float
    norm: Callable[[PyTree], Scalar]

    def sizes(self, y: PyTree[Array]) -> list[Scalar]:
        """The norm of each leaf."""
        norm = max_norm if self.norm is optx.max_norm else self.norm
        return [norm(x) for x in jtu.tree_leaves(y)]

    def measure(self, change: PyTree[Array], scale: PyTree[Array]) -> Correction:
        sizes, scales = self.sizes(change), self.sizes(scale)
        whole = largest(scales)
        size, bound = self._in_units(sizes, scales), self._in_units([whole], [whole])
        # Strictly below, so that an infinite correction to an infinite state is neither.
        eps = float(jnp.finfo(size.dtype).eps)
        below = lambda fraction: largest(sizes) < fraction * whole
        return Correction(size, bound, below(100 * eps), below(0.01))

    def _in_units(self, sizes: list[Scalar], scales: list[Scalar]) -> Scalar:
        eps = jnp.finfo(jnp.result_type(*sizes)).eps
        rtol = 2 * eps if self.rtol is None else self.rtol
        each = [ratio(a, rtol * b + self.atol) for a, b in zip(sizes, scales)]
        return largest(each)


def max_norm(x: Array) -> Scalar:
    if x.size == 0:
        return jnp.zeros((), x.dtype)
    if x.size == 1:
        return jnp.abs(x).reshape(())
    # The bits of nonnegative floats, read as integers, are ordered like their values, with
    # NaNs largest. The maximum of floats may lose NaNs; with an extra test for them, steps
    # of 16 pairs took 1.1 times as long in single precision.
    kind = f"int{jnp.finfo(x.dtype).bits}"
    bits = lax.bitcast_convert_type(jnp.abs(x), kind).reshape(-1)
    while (n := bits.size) > (1 if x.size <= _SHORT else _WIDE):
        bits = jnp.maximum(bits[: (n + 1) // 2], bits[n // 2 :])
    return lax.bitcast_convert_type(bits[0] if n == 1 else jnp.max(bits), x.dtype)


def largest(norms: list[Scalar]) -> Scalar:
    return ft.reduce(jnp.maximum, norms)


def all_finite(y: PyTree[Array]) -> _Flag:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(y)]))


def ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: a zero correction is no error."""
    return jnp.where(a == 0, 0, a / b)


def log2(x: Scalar) -> Scalar:
    """The base-2 logarithm of a positive number to within 0.09, with the mantissa as a
    linear interpolation. With the library function steps took 1.05 to 1.4 times as long.
    Zero is below all other numbers, and NaN above."""
    info = jnp.finfo(x.dtype)
    bits = lax.bitcast_convert_type(jnp.abs(x), f"int{info.bits}").astype(x.dtype)
    return bits * 2.0**-info.nmant + float(info.minexp - 1)


# The base-2 logarithm of 64, the factor by which the next correction must be below the
# tolerance. The remaining error has the same sign in every step and would add up to a
# drift, while rounding errors cancel.
MARGIN = 6


def converged(level: Scalar, rate: Scalar, rounded: _Flag, stalled: _Flag) -> _Flag:
    """Whether the next correction will be below the tolerance; or corrections have
    `stalled` at rounding errors. `level` and `rate` are the base-2 logarithms of the last
    correction, in units of the tolerance, and of its ratio to the previous one."""
    return (level + jnp.minimum(rate, 0) <= -MARGIN) | (stalled & rounded)
