"""Integers, where Dr.Jit differs from StableHLO."""

from typing import Any

import numpy as np

from .backend import array_types, dr


def safe_divisor(a, b):
    """The integer `b`, or 1 where a processor would trap on `a / b`: if `b` is zero; or if
    it is -1 and `a` the smallest integer, whose quotient is beyond the largest."""
    traps = b == 0
    if dr.is_signed_v(b):
        smallest = type(a)(-(2 ** (8 * dr.itemsize_v(a) - 1)))
        traps = traps | ((b == -1) & (a == smallest))
    return dr.select(traps, type(b)(1), b)


# In Dr.Jit the type of a number decides whether a shift is logical or arithmetic, in
# StableHLO the operation. Numbers of bits are read without sign, so that a negative one is
# larger than the number of all bits.


def shift_left(a, num_bits):
    num_bits = _without_sign(num_bits)
    # A shift by all bits or more gives zero. LLVM leaves it undefined.
    is_by_fewer = num_bits < 8 * dr.itemsize_v(a)
    return dr.select(is_by_fewer, a << type(a)(num_bits), 0)


def logical_shift(a, num_bits):
    num_bits = _without_sign(num_bits)
    shifted = type(a)(_without_sign(a) >> num_bits)
    return dr.select(num_bits < 8 * dr.itemsize_v(a), shifted, 0)


def arithmetic_shift(a, num_bits):
    num_bits = _without_sign(num_bits)
    signed = _with_same_bits("i", a)
    # A shift by all bits or more leaves the sign in all bits, as one by all but one does.
    all_but_one = type(num_bits)(8 * dr.itemsize_v(a) - 1)
    bounded = dr.select(num_bits < all_but_one, num_bits, all_but_one)
    return type(a)(signed >> type(signed)(bounded))


def _without_sign(a):
    return _with_same_bits("ui", a)


def _with_same_bits(prefix: str, a: Any) -> Any:
    """The integer with the same bits as `a`, of a signed type (`i`) or one without sign
    (`ui`)."""
    return array_types()[f"{prefix}{8 * dr.itemsize_v(a)}"](a)


def to_integer(dtype: type, a: Any) -> Any:
    """The floating-point number `a` as an integer of this type, rounded to zero. What
    StableHLO leaves open is as in JAX: NaN becomes zero, and numbers out of range the
    smallest or the largest integer."""
    float_dtype = type(a)
    is_signed = dr.is_signed_v(dtype)
    bits = 8 * dr.itemsize_v(dtype)
    # The first whole number above the range, a power of two, and the float before it.
    end = 2 ** (bits - 1 if is_signed else bits)
    float_below_end = float(np.nextafter(end, 0, dtype=f"f{dr.itemsize_v(a)}"))
    least = -end if is_signed else 0
    below_end = dr.select(a < end, a, float_dtype(float_below_end))
    in_range = dr.select(a > least, below_end, float_dtype(least))
    # Dr.Jit has no conversion to integers of eight bits.
    integer = dtype(array_types()["i32"](in_range)) if bits < 32 else dtype(in_range)
    # If the largest integer is no float, larger numbers have become a smaller integer.
    if int(float_below_end) < end - 1:
        integer = dr.select(a < end, integer, dtype(end - 1))
    return dr.select(dr.isnan(a), dtype(0), integer)
