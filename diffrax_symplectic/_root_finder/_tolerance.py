"""When a correction is small enough."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar


_Flag: TypeAlias = Bool[Array, ""]

# Up to this many entries the maximum is written out. XLA fuses no reduction with what its
# result goes into, and on CPUs it reduces short axes slowly.
_SHORT = 4
# Longer ones are folded to this length, by what fuses with the program that makes them. Of
# what is longer XLA keeps another array for each maximum.
_WIDE = 32


class Correction(NamedTuple):
    """How large a correction is.

    - `size`: in units of the tolerance, leaf by leaf: 1 is just accepted.
    - `bound`: what its `size` would be if it were as large as the whole state.
    - `rounded`: whether it is as small as rounding errors of the whole state. These can
        keep the corrections to a leaf that is small next to the others above its own
        tolerance for ever.
    - `small`: whether it is below a hundredth of the whole state.
    """

    size: Scalar
    bound: Scalar
    rounded: _Flag
    small: _Flag


class Tolerance(NamedTuple):
    """A correction is measured in units of `rtol * scale + atol`, leaf by leaf. `rtol` of
    `None` stands for two units in the last place."""

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
        # An infinite correction to an infinite state is neither.
        eps = float(jnp.finfo(size.dtype).eps)
        below = lambda fraction: largest(sizes) < fraction * whole
        return Correction(size, bound, below(100 * eps), below(0.01))

    def _in_units(self, sizes: list[Scalar], scales: list[Scalar]) -> Scalar:
        eps = jnp.finfo(jnp.result_type(*sizes)).eps
        rtol = 2 * eps if self.rtol is None else self.rtol
        each = [ratio(a, rtol * b + self.atol) for a, b in zip(sizes, scales)]
        return largest(each)


def max_norm(x: Array) -> Scalar:
    if x.size == 1:
        return jnp.abs(x).reshape(())
    # The bits of floats that are not negative, read as integers, have the order of the
    # values, and NaNs are the largest. The maximum of floats may lose these; together with
    # a test for them, steps of 16 pairs took 1.1 times as long in single precision.
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
    """`a / b`, with `0 / 0 = 0`: no correction at all is no error at all."""
    return jnp.where(a == 0, 0, a / b)


def log2(x: Scalar) -> Scalar:
    """The logarithm of a positive number to within 0.09: the exponent, and the mantissa as
    a straight line. With that of a library steps took 1.05 to 1.4 times as long. Zero has
    that of a number below all others, and NaN one above all."""
    info = jnp.finfo(x.dtype)
    bits = lax.bitcast_convert_type(jnp.abs(x), f"int{info.bits}").astype(x.dtype)
    return bits * 2.0**-info.nmant + float(info.minexp - 1)


# The next correction has to be below the tolerance by a factor of 64, of which this is the
# logarithm. What is left out has the same sign in every step. Over many steps it adds up to
# a drift, where rounding errors cancel.
MARGIN = 6


def converged(level: Scalar, rate: Scalar, rounded: _Flag, stalled: _Flag) -> _Flag:
    """Whether the next correction is below the tolerance, when logarithms of the size of
    the last one, in units of it, and of its ratio to the one before, are `level` and
    `rate`; or corrections have `stalled`, and all of them are tiny."""
    return (level + jnp.minimum(rate, 0) <= -MARGIN) | (stalled & rounded)
