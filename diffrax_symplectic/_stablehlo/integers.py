"""Integers, where Dr.Jit differs from StableHLO."""

from typing import Any

import numpy as np

from .backend import array_types, drjit


def safe_divisor(a, b):
    """A safe divisor for integers, and where the given one is 0 and -1: processors trap on
    division by zero, and of the smallest integer by -1."""
    dr = drjit()
    zero = b == 0
    # A number without sign is never -1.
    minus_one = (b == -1) if dr.is_signed_v(b) else ~zero & zero
    overflow = minus_one & (a == _least(a))
    return dr.select(zero | overflow, type(b)(1), b), zero, minus_one


def _least(a):
    """The smallest integer of its type."""
    bits = 8 * drjit().itemsize_v(a)
    return type(a)(-(2 ** (bits - 1)) if drjit().is_signed_v(a) else 0)


# Dr.Jit shifts by the type of a number, StableHLO by the operation. A number of bits below
# zero counts as a large one: without sign it is.


def shift_left(a, b):
    b = _without_sign(b)
    # By all bits or more it gives zero. LLVM leaves that undefined.
    return drjit().select(b < 8 * drjit().itemsize_v(a), a << type(a)(b), 0)


def logical_shift(a, b):
    b = _without_sign(b)
    shifted = type(a)(_without_sign(a) >> b)
    return drjit().select(b < 8 * drjit().itemsize_v(a), shifted, 0)


def arithmetic_shift(a, b):
    b = _without_sign(b)
    signed = _integer("i", a)
    # By all bits or more it leaves the sign.
    most = type(b)(8 * drjit().itemsize_v(a) - 1)
    return type(a)(signed >> type(signed)(drjit().select(b < most, b, most)))


def _without_sign(a):
    return _integer("ui", a)


def _integer(name: str, a: Any) -> Any:
    """The integer of the same bits, signed (`i`) or not (`ui`)."""
    return array_types()[f"{name}{8 * drjit().itemsize_v(a)}"](a)


def to_integer(kind: type, a: Any) -> Any:
    """Rounded to zero. What StableHLO leaves open is as in JAX: NaN becomes zero, and
    numbers out of range the smallest or the largest integer."""
    dr = drjit()
    dtype = type(a)
    signed = dr.is_signed_v(kind)
    bits = 8 * dr.itemsize_v(kind)
    # The first whole number beyond the range, a power of two, and the float before it.
    end = 2 ** (bits - 1 if signed else bits)
    below = float(np.nextafter(end, 0, dtype=f"f{dr.itemsize_v(a)}"))
    low = -end if signed else 0
    inside = dr.select(a > low, dr.select(a < end, a, dtype(below)), dtype(low))
    # Dr.Jit has no conversion to integers of eight bits.
    whole = kind(array_types()["i32"](inside)) if bits < 32 else kind(inside)
    if int(below) < end - 1:
        whole = dr.select(a < end, whole, kind(end - 1))
    return dr.select(~(a == a), kind(0), whole)
