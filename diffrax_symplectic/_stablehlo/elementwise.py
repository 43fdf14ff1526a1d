"""Elementwise operations of StableHLO, as functions of Dr.Jit arrays.

Where Dr.Jit has the right function, the table at the end refers to it. Functions are
defined here where Dr.Jit differs from StableHLO, for NaN, infinities or integers, or is
less accurate.
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


# Powers with whole exponents up to this size are computed by at most twelve
# multiplications, and others by logarithms.
_MOST_MULTIPLIED = 64
# The complementary error function is computed by a polynomial in a variable that goes from
# -1 to 1 (see `_erfc_coefficients`). For this argument the variable is zero.
_ERFC_MIDDLE = 3.0
# The degree of the polynomial for each size of numbers in bytes. The first coefficients
# that are left out are 2e-9 in single and 7e-17 in double precision. (With a middle of 4
# they are as small, and with 2 larger.)
_ERFC_DEGREES = {4: 11, 8: 23}
# From this argument on the complementary error function is zero in both precisions.
_ERFC_END = 30.0


# StableHLO adds, multiplies and compares truth values, too. For these Dr.Jit has only `|`
# and `&`.


def _add(a, b):
    return a | b if dr.is_mask_v(a) else a + b


def is_zero(a: Any) -> bool:
    """Whether a number is a constant zero, for all paths: this is known while the kernel is
    recorded."""
    return is_literal(a) and a[0] == 0


def _multiply(a, b):
    if dr.is_mask_v(a):
        return a & b
    if dr.is_float_v(a):
        # Dr.Jit replaces each product with a constant zero by zero, although the product of
        # zero and infinity, or zero and NaN, is NaN. (It is right for two constants.)
        if is_zero(a) and not is_literal(b):
            return _times_zero(b, a)
        if is_zero(b) and not is_literal(a):
            return _times_zero(a, b)
    return a * b


def _times_zero(a, zero):
    """The product of `a`, which is not a constant, and a constant zero."""
    # `a - a` serves as the zero, which Dr.Jit does not know to be one. It is NaN where `a`
    # is infinite or NaN, and so is the product there.
    unknown_zero = a - a
    return a * (-unknown_zero if np.signbit(zero[0]) else unknown_zero)


# Dr.Jit's own maximum and minimum of floats are not used: they do not propagate NaN, and
# abort the process with LLVM 15 and 16, which cannot compile them.


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
    # Dr.Jit's `//` of integers rounds to zero, as StableHLO does. A quotient by zero has
    # all bits set, as in XLA.
    return dr.select(b == 0, ~type(a)(0), a // safe_divisor(a, b))


def _remainder(a, b):
    """The remainder `a - trunc(a / b) b`, which has the sign of `a`."""
    if dr.is_float_v(a):
        return _remainder_of_floats(a, b)
    safe = safe_divisor(a, b)
    return dr.select(b == 0, a, a - (a // safe) * safe)


def _remainder_of_floats(a, b):
    """`|a| - trunc(|a| / |b|) |b|`, with the sign of `a`. It is NaN if `b` is zero or `a`
    infinite. (Lanes with a very large quotient fail, by a limit in `operations.py`.)"""
    size = dr.abs(a)
    divisor = dr.abs(b)
    nearly_rest = dr.fma(-dr.trunc(size / divisor), divisor, size)
    # The rest lies in [0, divisor). Where rounding has moved the quotient to the next whole
    # number, `nearly_rest` is off by one divisor.
    is_negative = nearly_rest < 0
    one_more = nearly_rest + divisor
    at_most_one_less = dr.select(
        nearly_rest >= divisor, nearly_rest - divisor, nearly_rest
    )
    finite_rest = dr.select(is_negative, one_more, at_most_one_less)
    # For an infinite divisor and a finite number, the product in `nearly_rest` is NaN, but
    # the remainder is the number itself.
    rest = dr.select(dr.isinf(b) & dr.isfinite(a), size, finite_rest)
    return dr.select(dr.isfinite(a) & ~(b == 0), dr.copysign(rest, a), type(a)(np.nan))


def _sign(a):
    if dr.is_float_v(a):
        # Zero keeps its sign, and NaN is itself.
        return dr.select((a == 0) | dr.isnan(a), a, dr.copysign(type(a)(1), a))
    return dr.select(a == 0, 0, dr.select(a > 0, type(a)(1), type(a)(-1)))


def _power(base, exponent):
    """`base**exponent`: by multiplication if the exponent is a small whole number that is
    known while the kernel is recorded, and otherwise by logarithms."""
    if is_literal(exponent):
        value = exponent[0]
        if float(value).is_integer() and abs(value) <= _MOST_MULTIPLIED:
            power = dr.power(base, abs(int(value)))
            return 1 / power if value < 0 else power
    return _power_by_logarithm(base, exponent)


def _power_by_logarithm(base, exponent):
    """`base**exponent` for any real exponent: `exp(exponent log|base|)`, with the sign or
    the special value that follows from the two numbers."""
    dtype = type(base)
    power_of_size = dr.exp(dr.log(dr.abs(base)) * exponent)
    # A negative number has real powers for whole exponents only. For odd exponents the
    # power is negative.
    is_whole = dr.floor(exponent) == exponent
    is_odd = dr.floor(exponent / 2) * 2 != exponent
    negative_to_whole = dr.select(is_odd, -power_of_size, power_of_size)
    # As in JAX, minus infinity has powers for fractional exponents, too.
    negative_to_fraction = dr.select(dr.isinf(base), power_of_size, dtype(np.nan))
    power_of_negative = dr.select(is_whole, negative_to_whole, negative_to_fraction)
    by_logarithm = dr.select(base < 0, power_of_negative, power_of_size)
    # In these special cases the result so far may be NaN. For example, in `0**0` the
    # product of logarithm and exponent is infinity times zero.
    power = dr.select((base == 0) & (exponent > 0), dtype(0), by_logarithm)
    return dr.select((exponent == 0) | (base == 1), dtype(1), power)


def _expm1(a):
    """`exp(a) - 1`, near zero by Kahan's formula `(e - 1) a / log(e)` with `e = exp(a)`, in
    which the rounding error of the exponential cancels."""
    exp = dr.exp(a)
    near_zero = (exp - 1) * a / dr.log(exp)
    # The formula is 0 / 0 where the exponential is rounded to one. There the result is `a`.
    return dr.select(exp == 1, a, dr.select(dr.abs(a) > 1, exp - 1, near_zero))


def _log1p(a):
    """`log(1 + a)` by Kahan's formula `log(s) a / (s - 1)` with `s = 1 + a`, in which the
    rounding error of the sum cancels."""
    total = 1 + a
    log = dr.log(total)
    by_formula = log * a / (total - 1)
    # The formula is 0 / 0 where the sum is rounded to one, and NaN for infinity.
    return dr.select(total == 1, a, dr.select(dr.isfinite(total), by_formula, log))


def _tan(a):
    # In double precision Dr.Jit's own tangent has relative errors of up to 5e-9 for angles
    # between 4e-8 and 1e-4. The quotient is right to three units in the last place.
    sine, cosine = dr.sincos(a)
    return sine / cosine


def _atan(a):
    return _atan2(a, type(a)(1))


def _atan2(y, x):
    """The angle of the point (x, y), by the arcsine for an angle of at most 45 degrees.
    Dr.Jit's own `atan2` takes a maximum that LLVM 15 and 16 cannot compile: they abort the
    process."""
    dtype = type(y)
    steep = dr.abs(y) > dr.abs(x)
    shorter = dr.select(steep, dr.abs(x), dr.abs(y))
    longer = dr.select(steep, dr.abs(y), dr.abs(x))
    # Two infinities have the slope 1, as in JAX. Their quotient would be NaN.
    slope = dr.select(shorter == longer, dtype(1), shorter / longer)
    in_eighth = dr.asin(slope / dr.sqrt(1 + slope * slope))
    # By symmetry, the angle of (|x|, |y|), which lies in a quarter of the circle, follows.
    # Then that of (x, |y|), which lies in a half, and that of (x, y).
    in_quarter = dr.select(steep, np.pi / 2 - in_eighth, in_eighth)
    # Two zeros have been given the slope 1, too, but the angle of (0, 0) is 0.
    in_quarter_or_zero = dr.select(y == 0, dtype(0), in_quarter)
    # The sign of `x` counts also if `x` is zero: the angle of (-0, 0) is pi.
    is_left = dr.copysign(dtype(1), x) < 0
    in_half = dr.select(is_left, np.pi - in_quarter_or_zero, in_quarter_or_zero)
    return dr.select(dr.isnan(y) | dr.isnan(x), y + x, dr.copysign(in_half, y))


def _erf(a):
    return dr.select(dr.isnan(a), a, dr.erf(a))


def _erfc(a):
    r"""The complementary error function. For $x = |a|$ it is $e^{-x^2} g(x) / (1 + 2 x)$,
    with a polynomial for $g$, and for negative $a$ it is $2$ minus its value at $x$. (For
    large $a$, the difference `1 - erf(a)` would have no correct digits.)"""
    dtype = type(a)
    # The size $x$ is bounded, since for infinity the next quotient would be NaN.
    size = _minimum(dr.abs(a), dtype(_ERFC_END))
    variable = (size - _ERFC_MIDDLE) / (size + _ERFC_MIDDLE)
    # Horner's scheme, from the highest power down.
    g = dtype(0)
    for coefficient in reversed(_erfc_coefficients(_ERFC_DEGREES[dr.itemsize_v(a)])):
        g = dr.fma(g, variable, coefficient)
    # With `size^2 = square + rounded_off`, to rounding error `exp(-size^2)` is
    # `exp(-square) (1 - rounded_off)`. Without this correction, the rounding error of the
    # square becomes a relative error of the exponential: for a size of 26 it may be half a
    # unit in the last place of 676, which is 256 units in the last place of 1.
    square = size * size
    rounded_off = dr.fma(size, size, -square)
    tail = dr.exp(-square) * (1 - rounded_off) * g / (1 + 2 * size)
    return dr.select(dr.isnan(a), a, dr.select(a < 0, 2 - tail, tail))


@ft.cache
def _erfc_coefficients(degree: int) -> list[float]:
    """Coefficients of a polynomial for `(1 + 2 x) exp(x^2) erfc(x)`, in the variable
    `(x - middle) / (x + middle)`, which goes from -1 to 1 as `x` goes from 0 to infinity.

    This function of `x` does not decay: it goes from 1 to `2 / sqrt(pi)`. So a polynomial
    can approximate it to rounding error.
    """
    from scipy.fft import dct
    from scipy.special import erfcx

    # 1. Interpolate the function at Chebyshev's nodes, cosines of equidistant angles. With
    # this many nodes, the coefficients that are kept have rounding errors only. (NumPy's
    # `chebinterpolate` has larger ones.)
    num_nodes = 64
    angles = (np.arange(num_nodes) + 0.5) * np.pi / num_nodes
    # The variable is `cos(angle)` at `x = middle (1 + cos) / (1 - cos)`, which is the same
    # as `middle / tan(angle / 2)^2`.
    x = _ERFC_MIDDLE / np.tan(angles / 2) ** 2
    # 2. Chebyshev's polynomial of degree n is the cosine of `n angle`, so that a cosine
    # transform gives the coefficients, the first one doubled. (`erfcx(x)` is
    # `exp(x^2) erfc(x)`.)
    series = np.asarray(dct((1 + 2 * x) * erfcx(x))) / num_nodes
    series[0] /= 2
    # 3. Convert to powers of the variable: a sum over powers takes half the operations of a
    # sum over Chebyshev's polynomials. Its rounding errors are as small, since the
    # coefficients decrease fast.
    return cheb2poly(series[: degree + 1]).tolist()


def _rsqrt(a):
    # In single precision Dr.Jit's own `rsqrt` is an approximation.
    return 1 / dr.sqrt(a)


# Dr.Jit's own versions of `sinh`, `cosh` and `tanh` have single precision on GPUs.


def _half_exp(a):
    """`exp(a) / 2` for an `a` at which `exp(a)` overflows, but its half may be finite."""
    # The rounding error of the root counts twice. So this function is not used for smaller
    # numbers.
    root = dr.exp(a / 2)
    return root / 2 * root


def _sinh(a):
    """`sinh(x) = (exp(x) - exp(-x)) / 2` for `x = |a|`, with the sign of `a`. It is
    computed as `(e + e / (e + 1)) / 2` from `e = exp(x) - 1`, which keeps its digits near
    zero: `exp(x)` is `1 + e`, and `exp(-x)` is `1 - e / (e + 1)`."""
    x = dr.abs(a)
    e = _expm1(x)
    # Where the exponential overflows, the quotient is NaN, but `sinh(x)` may be finite.
    overflows = dr.isinf(e)
    after_overflow = _half_exp(x)
    value = dr.select(overflows, after_overflow, (e + e / (e + 1)) / 2)
    return dr.copysign(value, a)


def _cosh(a):
    """`(exp(x) + exp(-x)) / 2` for `x = |a|`."""
    size = dr.abs(a)
    exp = dr.exp(size)
    return dr.select(dr.isinf(exp), _half_exp(size), exp / 2 + 0.5 / exp)


def _tanh(a):
    """`tanh(x) = (1 - exp(-2 x)) / (1 + exp(-2 x))` for `x = |a|`, with the sign of `a`. It
    is computed as `-e / (e + 2)` from `e = exp(-2 x) - 1`."""
    # On CPUs Dr.Jit's own `tanh` is as accurate, but gives 0 for -0, and in single
    # precision its values at -1 and 1 differ in size. The argument of `_expm1` is negative,
    # so that the exponential does not overflow.
    expm1 = _expm1(-2 * dr.abs(a))
    return dr.copysign(-expm1 / (expm1 + 2), a)


def _atanh(a):
    """`(log(1 + a) - log(1 - a)) / 2`."""
    # On CPUs Dr.Jit's own `atanh` is right to 1.2 units in the last place, and this formula
    # to 2. On GPUs Dr.Jit's own has not been measured, and this formula passes the tests.
    return (_log1p(a) - _log1p(-a)) / 2


def _logistic(a):
    return 1 / (1 + dr.exp(-a))


def _erf_inv(a):
    """The inverse of the error function. Dr.Jit's own is right to at most the digits of
    single precision. So in double precision two steps of Halley's method follow, each of
    which triples the number of correct digits."""
    start = dr.erfinv(a)
    if dr.itemsize_v(a) < 8:
        return start
    y = start
    for _ in range(2):
        # The equation is `f(y) = erf(y) - a = 0`, with `f' = 2 / sqrt(pi) exp(-y^2)` and
        # `f'' = -2 y f'`. Newton's step is `n = f / f'`. Halley's method divides it by
        # `1 - n f'' / (2 f')`, which is `1 + n y`.
        newton_step = (dr.erf(y) - a) * (np.sqrt(np.pi) / 2) * dr.exp(y * y)
        y = y - newton_step / (1 + y * newton_step)
    # At -1 and 1 the inverse is infinite, and beyond them NaN. There `start` is right.
    return dr.select(dr.abs(a) < 1, y, start)


def _round_half_away(a):
    """The nearest whole number; of two, the one that is further from zero."""
    whole = dr.trunc(a)
    next_whole = whole + dr.copysign(type(a)(1), a)
    # This difference is exact. The sum of `a` and one half would be rounded.
    fraction = dr.abs(a - whole)
    return dr.select(fraction >= 0.5, next_whole, whole)


@ft.cache
def elementwise() -> dict[str, Callable[..., Any]]:
    """The elementwise functions of real numbers, integers and truth values, by their names
    in StableHLO and CHLO."""
    # Functions that have the same name in Dr.Jit.
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
