"""Elementwise operations of StableHLO, as functions of Dr.Jit arrays.

Functions are defined here where Dr.Jit differs from StableHLO (NaN, infinities, integers)
or is less accurate.
"""

import functools as ft
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly

from .._compat import is_literal
from .backend import dr
from .integers import arithmetic_shift, logical_shift, safe_divisor, shift_left


# Powers with whole exponents up to this size are products, of at most twelve factors, which
# have no logarithm of a negative number. Larger ones are computed by logarithms.
_MOST_MULTIPLIED = 64
# The series of the complementary error function maps this number to the middle of its
# range, and zero and infinity to the ends. Its degree depends on the size of numbers in
# bytes. The first coefficients left out are 2e-9 and 7e-17. With a middle of 4 they are as
# small, with 2 larger.
_ERFC_MIDDLE = 3.0
_ERFC_DEGREES = {4: 11, 8: 23}
# The complementary error function is zero in both precisions from here on.
_ERFC_END = 30.0


# Of truth values StableHLO has sums, products and extremes. Dr.Jit has `|` and `&` only.


def _add(a, b):
    return a | b if dr.is_mask_v(a) else a + b


def is_zero(a: Any) -> bool:
    """Whether a number is zero for all paths, and this is known while the kernel is
    recorded."""
    return is_literal(a) and a[0] == 0


def _multiply(a, b):
    if dr.is_mask_v(a):
        return a & b
    if dr.is_float_v(a):
        # Dr.Jit takes each product with a known zero for zero. With infinity it is NaN.
        if is_zero(a) and not is_literal(b):
            return _times_zero(b, a)
        if is_zero(b) and not is_literal(a):
            return _times_zero(a, b)
    return a * b


def _times_zero(a, zero):
    """The product of a number that is not known while the kernel is recorded and a zero
    that is."""
    # `a - a` is zero, too, but NaN where `a` is infinite or NaN, and so is the product. And
    # Dr.Jit does not fold it, so that it computes the product.
    unknown_zero = a - a
    return a * (-unknown_zero if np.signbit(zero[0]) else unknown_zero)


# Dr.Jit's own maximum and minimum of floats abort the process with LLVM 15 and 16, which
# cannot compile them, and lose NaN.


def _maximum(a, b):
    if dr.is_mask_v(a):
        return a | b
    # NaN propagates, as in JAX.
    return dr.select((a > b) | dr.isnan(a), a, b)


def _minimum(a, b):
    if dr.is_mask_v(a):
        return a & b
    return dr.select((a < b) | dr.isnan(a), a, b)


def _clamp(low, a, high):
    return _minimum(_maximum(a, low), high)


def _divide(a, b):
    if dr.is_float_v(a):
        return a / b
    # Dr.Jit's `//` of integers rounds to zero, as StableHLO does. By zero, the quotient has
    # all bits set, as in XLA.
    return dr.select(b == 0, ~type(a)(0), a // safe_divisor(a, b))


def _remainder(a, b):
    """`a - trunc(a / b) b`, which has the sign of `a`."""
    if dr.is_float_v(a):
        return _remainder_of_floats(a, b)
    safe = safe_divisor(a, b)
    return dr.select(b == 0, a, a - (a // safe) * safe)


def _remainder_of_floats(a, b):
    size = dr.abs(a)
    divisor = dr.abs(b)
    nearly_rest = dr.fma(-dr.trunc(size / divisor), divisor, size)
    # Where the quotient was rounded to the next whole number, this is off by one divisor.
    is_negative = nearly_rest < 0
    one_more = nearly_rest + divisor
    at_most_one_less = dr.select(
        nearly_rest >= divisor, nearly_rest - divisor, nearly_rest
    )
    finite_rest = dr.select(is_negative, one_more, at_most_one_less)
    # A finite number is its own rest by an infinite divisor: the product above is NaN.
    rest = dr.select(dr.isinf(b) & dr.isfinite(a), size, finite_rest)
    return dr.select(dr.isfinite(a) & ~(b == 0), dr.copysign(rest, a), type(a)(np.nan))


def _sign(a):
    if dr.is_float_v(a):
        # Zero keeps its sign, and NaN is itself.
        return dr.select((a == 0) | dr.isnan(a), a, dr.copysign(type(a)(1), a))
    return dr.select(a == 0, 0, dr.select(a > 0, type(a)(1), type(a)(-1)))


def _power(base, exponent):
    """By multiplication for small whole exponents that are known while the kernel is
    recorded, and otherwise by logarithms."""
    if is_literal(exponent):
        value = exponent[0]
        if float(value).is_integer() and abs(value) <= _MOST_MULTIPLIED:
            power = dr.power(base, abs(int(value)))
            return 1 / power if value < 0 else power
    return _power_by_logarithm(base, exponent)


def _power_by_logarithm(base, exponent):
    """The power for any exponent. The last of the cases below that applies prevails."""
    dtype = type(base)
    power_of_size = dr.exp(dr.log(dr.abs(base)) * exponent)
    # A negative number has real powers for whole exponents only, negative for odd ones.
    is_whole = dr.floor(exponent) == exponent
    is_odd = dr.floor(exponent / 2) * 2 != exponent
    negative_to_whole = dr.select(is_odd, -power_of_size, power_of_size)
    # As in JAX, minus infinity has powers for other exponents, too.
    negative_to_fraction = dr.select(dr.isinf(base), power_of_size, dtype(np.nan))
    power_of_negative = dr.select(is_whole, negative_to_whole, negative_to_fraction)
    by_logarithm = dr.select(base < 0, power_of_negative, power_of_size)
    # The product of logarithm and exponent may be infinity times zero, which is NaN: for a
    # base of zero or one, and for an exponent of zero.
    power = dr.select((base == 0) & (exponent > 0), dtype(0), by_logarithm)
    return dr.select((exponent == 0) | (base == 1), dtype(1), power)


def _expm1(a):
    """Kahan's formula `(e - 1) a / log(e)` with `e = exp(a)`, in which the rounding error
    of the exponential cancels."""
    exp = dr.exp(a)
    near_zero = (exp - 1) * a / dr.log(exp)
    # The formula is 0 / 0 where the exponential is rounded to one, and NaN of infinity.
    return dr.select(exp == 1, a, dr.select(dr.abs(a) > 1, exp - 1, near_zero))


def _log1p(a):
    """Kahan's formula `log(s) a / (s - 1)` with `s = 1 + a`, in which the rounding error of
    the sum cancels."""
    total = 1 + a
    log = dr.log(total)
    near_zero = log * a / (total - 1)
    return dr.select(total == 1, a, dr.select(dr.isfinite(total), near_zero, log))


def _tan(a):
    # Dr.Jit's own in double precision is off by up to 5e-9 of the value, for angles between
    # 4e-8 and 1e-4. The quotient is right to three units in the last place.
    sine, cosine = dr.sincos(a)
    return sine / cosine


def _atan(a):
    return _atan2(a, type(a)(1))


def _atan2(y, x):
    """By the arcsine of an angle of at most 45 degrees. Dr.Jit's own takes a maximum that
    LLVM 15 and 16 cannot compile: they abort the process."""
    dtype = type(y)
    steep = dr.abs(y) > dr.abs(x)
    shorter = dr.select(steep, dr.abs(x), dr.abs(y))
    longer = dr.select(steep, dr.abs(y), dr.abs(x))
    # The quotient of two infinities would be NaN: they count as equal.
    slope = dr.select(shorter == longer, dtype(1), shorter / longer)
    in_eighth = dr.asin(slope / dr.sqrt(1 + slope * slope))
    # From one eighth of the circle to a quarter, a half, and all of it.
    in_quarter = dr.select(steep, np.pi / 2 - in_eighth, in_eighth)
    # Two zeros counted as equal, too, but their angle is 0.
    in_quarter_or_zero = dr.select(y == 0, dtype(0), in_quarter)
    # The sign of `x` counts, also where it is zero: the angle of (0, -0) is pi.
    is_left = dr.copysign(dtype(1), x) < 0
    in_half = dr.select(is_left, np.pi - in_quarter_or_zero, in_quarter_or_zero)
    return dr.select(dr.isnan(y) | dr.isnan(x), y + x, dr.copysign(in_half, y))


def _erf(a):
    return dr.select(dr.isnan(a), a, dr.erf(a))


def _erfc(a):
    r"""In the tail `1 - erf(a)` has no digits left. So for $x = |a|$ it is computed as
    $e^{-x^2} g(x) / (1 + 2 x)$, with a polynomial for $g$."""
    dtype = type(a)
    # The size is bounded, since the next quotient would be NaN for infinity.
    size = _minimum(dr.abs(a), dtype(_ERFC_END))
    variable = (size - _ERFC_MIDDLE) / (size + _ERFC_MIDDLE)
    g = dtype(0)
    for coefficient in reversed(_erfc_coefficients(_ERFC_DEGREES[dr.itemsize_v(a)])):
        g = dr.fma(g, variable, coefficient)
    # With the square rounded, `size^2 = square + rounded_off`, where the last number is
    # small, so `exp(-size^2) = exp(-square) (1 - rounded_off)`. Near a size of 26 it is
    # half a unit in the last place of 676, or 256 of one.
    square = size * size
    rounded_off = dr.fma(size, size, -square)
    tail = dr.exp(-square) * (1 - rounded_off) * g / (1 + 2 * size)
    return dr.select(dr.isnan(a), a, dr.select(a < 0, 2 - tail, tail))


@ft.cache
def _erfc_coefficients(degree: int) -> list[float]:
    """Coefficients of a polynomial for `(1 + 2 x) exp(x^2) erfc(x)`, in the variable
    `(x - middle) / (x + middle)`, which goes from -1 to 1 as `x` goes from 0 to infinity.

    The function changes from 1 to `2 / sqrt(pi)` only, without the exponential's decay, so
    that a polynomial has it to rounding.
    """
    from scipy.fft import dct
    from scipy.special import erfcx

    # An interpolation at Chebyshev's nodes, so many that only rounding is left in the
    # coefficients that are kept. NumPy's `chebinterpolate` rounds more.
    num_nodes = 64
    angles = (np.arange(num_nodes) + 0.5) * np.pi / num_nodes
    # Here the variable of the polynomials is the cosine of these angles.
    x = _ERFC_MIDDLE / np.tan(angles / 2) ** 2
    # `erfcx(x)` is `exp(x^2) erfc(x)`. The polynomial of degree n is `cos(n angle)`, so
    # that a cosine transform gives the coefficients, the first one doubled.
    series = np.asarray(dct((1 + 2 * x) * erfcx(x))) / num_nodes
    series[0] /= 2
    # Coefficients shrink faster than those of Chebyshev's polynomials grow, so that powers
    # round as little, and are summed in half the operations.
    return cheb2poly(series[: degree + 1]).tolist()


def _rsqrt(a):
    # Dr.Jit's own is an approximation in single precision.
    return 1 / dr.sqrt(a)


# Dr.Jit's own versions of `sinh`, `cosh` and `tanh` have single precision on GPUs.


def _half_exp(a):
    """Half of the exponential, which is finite also where the exponential overflows."""
    # The error of the root counts twice, so this serves only where the exponential
    # overflows.
    root = dr.exp(a / 2)
    return root / 2 * root


def _sinh(a):
    size = dr.abs(a)
    expm1 = _expm1(size)
    overflows = dr.isinf(expm1)
    after_overflow = _half_exp(size)
    # With `e` for `expm1`, exp(x) is e + 1 and exp(-x) is 1 - e / (e + 1). Where the
    # exponential overflows, this quotient is NaN.
    difference = expm1 + expm1 / (expm1 + 1)
    value = dr.select(overflows, after_overflow, difference / 2)
    return dr.copysign(value, a)


def _cosh(a):
    size = dr.abs(a)
    exp = dr.exp(size)
    return dr.select(dr.isinf(exp), _half_exp(size), exp / 2 + 0.5 / exp)


def _tanh(a):
    # On CPUs Dr.Jit's own is as accurate, but gives 0 for -0, and in single precision -1
    # and 1 have different values. Of a negative number the exponential does not overflow.
    expm1 = _expm1(-2 * dr.abs(a))
    return dr.copysign(-expm1 / (expm1 + 2), a)


def _atanh(a):
    # On CPUs Dr.Jit's own is right to 1.2 units in the last place, and this to 2. On GPUs
    # Dr.Jit's has not been measured, and this passes the tests.
    return (_log1p(a) - _log1p(-a)) / 2


def _logistic(a):
    return 1 / (1 + dr.exp(-a))


def _erf_inv(a):
    """In double precision Dr.Jit's version has at most the digits of single precision. Each
    step of Halley's method triples their number."""
    start = dr.erfinv(a)
    if dr.itemsize_v(a) < 8:
        return start
    y = start
    for _ in range(2):
        # For `f(y) = erf(y) - a`, Newton's step is `f / f'`. Halley's method divides it by
        # `1 - (f / f') f'' / (2 f')`, and `f'' / f'` is `-2 y`.
        newton_step = (dr.erf(y) - a) * (np.sqrt(np.pi) / 2) * dr.exp(y * y)
        y = y - newton_step / (1 + y * newton_step)
    # At the ends, and beyond them, the inverse is infinite or NaN, and `start` is right.
    return dr.select(dr.abs(a) < 1, y, start)


def _round_half_away(a):
    whole = dr.trunc(a)
    next_whole = whole + dr.copysign(type(a)(1), a)
    # The fraction is exact. The sum of `a` and one half would be rounded.
    fraction = dr.abs(a - whole)
    return dr.select(fraction >= 0.5, next_whole, whole)


@ft.cache
def elementwise() -> dict[str, Callable[..., Any]]:
    """The functions, by their names in StableHLO and CHLO."""
    of_same_name = (
        "abs acos acosh asin asinh cbrt ceil floor log popcnt sqrt square".split()
    )
    return {name: getattr(dr, name) for name in of_same_name} | {
        "add": _add,
        "and": operator.and_,
        "atan": _atan,
        "atan2": _atan2,
        "atanh": _atanh,
        "clamp": _clamp,
        "cosh": _cosh,
        "cosine": dr.cos,
        "count_leading_zeros": dr.lzcnt,
        "divide": _divide,
        "erf": _erf,
        "erf_inv": _erf_inv,
        "erfc": _erfc,
        "exponential": dr.exp,
        "exponential_minus_one": _expm1,
        "is_finite": dr.isfinite,
        "log_plus_one": _log1p,
        "logistic": _logistic,
        "maximum": _maximum,
        "minimum": _minimum,
        "multiply": _multiply,
        "negate": operator.neg,
        "not": operator.invert,
        "or": operator.or_,
        "power": _power,
        "remainder": _remainder,
        "round_nearest_afz": _round_half_away,
        "round_nearest_even": dr.round,
        "rsqrt": _rsqrt,
        "shift_left": shift_left,
        "shift_right_arithmetic": arithmetic_shift,
        "shift_right_logical": logical_shift,
        "sign": _sign,
        "sine": dr.sin,
        "sinh": _sinh,
        "subtract": operator.sub,
        "tan": _tan,
        "tanh": _tanh,
        "xor": operator.xor,
    }
