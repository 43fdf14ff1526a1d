"""Integers, where Dr.Jit differs from StableHLO."""

from typing import Any, NamedTuple

import numpy as np

from .backend import array_types, drjit


class SafeDivisor(NamedTuple):
    """A divisor in place of an integer, by which another can be divided.

    - `divisor`: the integer itself, or 1 where a processor would trap.
    - `is_zero`, `is_minus_one`: the masks where the integer is 0 or -1.
    """

    divisor: Any
    is_zero: Any
    is_minus_one: Any


def safe_divisor(a, b):
    """The divisor of `a` in place of `b`. Processors trap on division by zero, and of the
    smallest integer by -1, whose quotient is beyond the largest."""
    dr = drjit()
    is_zero = b == 0
    # A number without sign is never -1: the mask is false everywhere.
    is_minus_one = (b == -1) if dr.is_signed_v(b) else ~is_zero & is_zero
    overflows = is_minus_one & (a == _smallest_of_type(a))
    safe = dr.select(is_zero | overflows, type(b)(1), b)
    return SafeDivisor(safe, is_zero, is_minus_one)


def _smallest_of_type(a):
    """The smallest integer of the type of `a`."""
    bits = 8 * drjit().itemsize_v(a)
    return type(a)(-(2 ** (bits - 1)) if drjit().is_signed_v(a) else 0)


# In Dr.Jit the type of a number decides whether a shift is logical or arithmetic, in
# StableHLO the operation. Numbers of bits are read without sign, so that a negative one is
# larger than the number of all bits.


def shift_left(a, num_bits):
    num_bits = _without_sign(num_bits)
    # A shift by all bits or more gives zero. LLVM leaves it undefined.
    is_by_fewer = num_bits < 8 * drjit().itemsize_v(a)
    return drjit().select(is_by_fewer, a << type(a)(num_bits), 0)


def logical_shift(a, num_bits):
    num_bits = _without_sign(num_bits)
    shifted = type(a)(_without_sign(a) >> num_bits)
    return drjit().select(num_bits < 8 * drjit().itemsize_v(a), shifted, 0)


def arithmetic_shift(a, num_bits):
    num_bits = _without_sign(num_bits)
    signed = _with_same_bits("i", a)
    # A shift by all bits or more leaves the sign in all bits, as one by all but one does.
    all_but_one = type(num_bits)(8 * drjit().itemsize_v(a) - 1)
    bounded = drjit().select(num_bits < all_but_one, num_bits, all_but_one)
    return type(a)(signed >> type(signed)(bounded))


def _without_sign(a):
    return _with_same_bits("ui", a)


def _with_same_bits(prefix: str, a: Any) -> Any:
    """The integer with the same bits as `a`, of a signed type (`i`) or one without sign
    (`ui`)."""
    return array_types()[f"{prefix}{8 * drjit().itemsize_v(a)}"](a)


def to_integer(dtype: type, a: Any) -> Any:
    """The floating-point number `a` as an integer of this type, rounded to zero. What
    StableHLO leaves open is as in JAX: NaN becomes zero, and numbers out of range the
    smallest or the largest integer."""
    dr = drjit()
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
    is_nan = ~(a == a)
    return dr.select(is_nan, dtype(0), integer)
