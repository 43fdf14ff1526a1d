"""Operations of integers where Dr.Jit differs from StableHLO."""

from typing import Any

import numpy as np

from .backend import array_types, dr


def safe_divisor(a, b):
    """The integer `b`, or 1 where a processor would abort the program at `a / b`:

    - `b` is zero, or
    - `b` is -1 and `a` the smallest integer, so that the quotient is too large.
    """
    aborts = b == 0
    if dr.is_signed_v(b):
        smallest = type(a)(-(2 ** (8 * dr.itemsize_v(a) - 1)))
        aborts = aborts | ((b == -1) & (a == smallest))
    return dr.select(aborts, type(b)(1), b)


# Shifts by a number of bits. In StableHLO the operation decides whether a shift to the
# right is logical or arithmetic, and in Dr.Jit the type of the number. `num_bits` is read
# without sign: a negative number of bits is a very large one, as in StableHLO.


def shift_left(a, num_bits):
    num_bits = _without_sign(num_bits)
    # A shift by all bits or more gives zero. LLVM leaves its result undefined.
    is_by_fewer = num_bits < 8 * dr.itemsize_v(a)
    return dr.select(is_by_fewer, a << type(a)(num_bits), 0)


def logical_shift(a, num_bits):
    num_bits = _without_sign(num_bits)
    shifted = type(a)(_without_sign(a) >> num_bits)
    return dr.select(num_bits < 8 * dr.itemsize_v(a), shifted, 0)


def arithmetic_shift(a, num_bits):
    num_bits = _without_sign(num_bits)
    signed = _with_same_bits("i", a)
    # A shift by all bits but one copies the sign to all bits. So does a shift by more.
    all_but_one = type(num_bits)(8 * dr.itemsize_v(a) - 1)
    bounded = dr.select(num_bits < all_but_one, num_bits, all_but_one)
    return type(a)(signed >> type(signed)(bounded))


def _without_sign(a):
    return _with_same_bits("ui", a)


def _with_same_bits(prefix: str, a: Any) -> Any:
    """The integer with the bits of `a`, of a type with sign if `prefix` is `i`, and without
    sign if it is `ui`."""
    return array_types()[f"{prefix}{8 * dr.itemsize_v(a)}"](a)


def to_integer(dtype: type, a: Any) -> Any:
    """The floating-point number `a` as an integer of this type, rounded to zero. As in JAX,
    NaN becomes zero, and a number out of range the smallest or the largest integer:
    StableHLO leaves these cases open."""
    float_dtype = type(a)
    is_signed = dr.is_signed_v(dtype)
    bits = 8 * dr.itemsize_v(dtype)
    # The first integer above the range, a power of two, and the largest float below it.
    end = 2 ** (bits - 1 if is_signed else bits)
    float_below_end = float(np.nextafter(end, 0, dtype=f"f{dr.itemsize_v(a)}"))
    smallest = -end if is_signed else 0
    below_end = dr.select(a < end, a, float_dtype(float_below_end))
    in_range = dr.select(a > smallest, below_end, float_dtype(smallest))
    # Dr.Jit has no conversion to integers of eight bits.
    integer = dtype(array_types()["i32"](in_range)) if bits < 32 else dtype(in_range)
    # Numbers above the range have become `float_below_end`. For many types this is not the
    # largest integer, which no float of this type equals.
    if int(float_below_end) < end - 1:
        integer = dr.select(a < end, integer, dtype(end - 1))
    return dr.select(dr.isnan(a), dtype(0), integer)
