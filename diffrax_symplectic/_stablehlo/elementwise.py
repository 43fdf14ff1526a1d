"""Elementwise operations of StableHLO, as functions of Dr.Jit arrays.

Functions are defined here where Dr.Jit differs from StableHLO (NaN, infinities, integers)
or is less accurate.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from .backend import drjit


def _maximum(a, b):
    # NaN propagates, as in JAX.
    return drjit().select((a > b) | _is_nan(a), a, b)


def _minimum(a, b):
    return drjit().select((a < b) | _is_nan(a), a, b)


def _is_nan(a):
    # In Dr.Jit, both `NaN == NaN` and `NaN != NaN` are false.
    return ~(a == a)


def _clamp(low, a, high):
    return _minimum(_maximum(a, low), high)


def _divide(a, b):
    if drjit().is_float_v(a):
        return a / b
    by, zero, _ = _divisor(a, b)
    # Dr.Jit's `//` of integers rounds to zero, as StableHLO does.
    return drjit().select(zero, ~type(a)(0), a // by)


def _divisor(a, b):
    """A safe divisor for integers, and where the given one is 0 and -1: processors trap on
    division by zero, and of the smallest integer by -1."""
    dr = drjit()
    zero = b == 0
    minus = (b == -1) if dr.is_signed_v(b) else ~zero & zero
    overflow = minus & (a == _least(a))
    return dr.select(zero | overflow, type(b)(1), b), zero, minus


def _least(a):
    bits = 8 * drjit().itemsize_v(a)
    return type(a)(-(2 ** (bits - 1)) if drjit().is_signed_v(a) else 0)


def _remainder(a, b):
    dr = drjit()
    if not dr.is_float_v(a):
        by, zero, minus = _divisor(a, b)
        return dr.select(zero, a, dr.select(minus, type(a)(0), a - (a // by) * by))
    size, by = dr.abs(a), dr.abs(b)
    rest = dr.fma(-dr.trunc(size / by), by, size)
    # Where the quotient was rounded to the next whole number.
    rest = dr.select(rest < 0, rest + by, dr.select(rest >= by, rest - by, rest))
    rest = dr.select(dr.isinf(b) & dr.isfinite(a), size, rest)
    return dr.select(dr.isfinite(a) & ~(b == 0), dr.copysign(rest, a), type(a)(np.nan))


def _sign(a):
    dr = drjit()
    if dr.is_float_v(a):
        return dr.select((a == 0) | _is_nan(a), a, dr.copysign(type(a)(1), a))
    return dr.select(a == 0, 0, dr.select(a > 0, type(a)(1), type(a)(-1)))


def _power(a, b):
    """Uses logarithms, or multiplication for small integer exponents."""
    dr, T = drjit(), type(a)
    if b.state == dr.VarState.Literal and float(b[0]).is_integer() and abs(b[0]) <= 64:
        return _integer_power(a, int(b[0]))
    size = dr.exp(dr.log(dr.abs(a)) * b)
    whole, odd = dr.floor(b) == b, dr.floor(b / 2) * 2 != b
    other = dr.select(dr.isinf(a), size, T(np.nan))
    negative = dr.select(whole, dr.select(odd, -size, size), other)
    size = dr.select(a < 0, negative, size)
    size = dr.select((a == 0) & (b > 0), T(0), size)
    return dr.select((b == 0) | (a == 1), T(1), size)


def _integer_power(a, n: int):
    out, square, left = type(a)(1), a, abs(n)
    while left:
        out = out * square if left & 1 else out
        square, left = square * square, left >> 1
    return 1 / out if n < 0 else out


def _expm1(a):
    """Kahan's formula, in which the rounding error of the exponential cancels."""
    dr = drjit()
    u = dr.exp(a)
    near = (u - 1) * a / dr.log(u)
    return dr.select(u == 1, a, dr.select(dr.abs(a) > 1, u - 1, near))


def _log1p(a):
    dr = drjit()
    u = 1 + a
    near = dr.log(u) * a / (u - 1)
    return dr.select(u == 1, a, dr.select(dr.isfinite(u), near, dr.log(u)))


def _tan(a):
    sine, cosine = drjit().sincos(a)
    return sine / cosine


def _atan(a):
    return _atan2(a, type(a)(1))


def _atan2(a, b):
    """By the arcsine of an angle of at most 45 degrees. Dr.Jit's own takes a maximum that
    LLVM 15 and 16 cannot compile: they abort the process."""
    dr, T = drjit(), type(a)
    steep = dr.abs(a) > dr.abs(b)
    small = dr.select(steep, dr.abs(b), dr.abs(a))
    large = dr.select(steep, dr.abs(a), dr.abs(b))
    # Two infinities count as equal.
    slope = dr.select(small == large, T(1), small / large)
    angle = dr.asin(slope / dr.sqrt(1 + slope * slope))
    angle = dr.select(steep, np.pi / 2 - angle, angle)
    angle = dr.select(a == 0, T(0), angle)
    angle = dr.select(dr.copysign(T(1), b) < 0, np.pi - angle, angle)
    return dr.select(_is_nan(a) | _is_nan(b), a + b, dr.copysign(angle, a))


def _erf(a):
    return drjit().select(_is_nan(a), a, drjit().erf(a))


def _rsqrt(a):
    return 1 / drjit().sqrt(a)


# Dr.Jit's own versions of these three have single precision on GPUs.


def _sinh(a):
    u = _expm1(drjit().abs(a))
    return drjit().copysign(
        drjit().select(drjit().isinf(u), u, (u + u / (u + 1)) / 2), a
    )


def _cosh(a):
    u = drjit().exp(drjit().abs(a))
    return u / 2 + 0.5 / u


def _tanh(a):
    u = _expm1(-2 * drjit().abs(a))
    return drjit().copysign(-u / (u + 2), a)


def _atanh(a):
    return (_log1p(a) - _log1p(-a)) / 2


def _logistic(a):
    return 1 / (1 + drjit().exp(-a))


def _erf_inv(a):
    """In double precision Dr.Jit's version has at most the digits of single precision. Each
    step of Halley's method triples their number."""
    dr = drjit()
    start = y = dr.erfinv(a)
    if dr.itemsize_v(a) < 8:
        return y
    for _ in range(2):
        newton = (dr.erf(y) - a) * (np.sqrt(np.pi) / 2) * dr.exp(y * y)
        y = y - newton / (1 + y * newton)
    return dr.select(dr.abs(a) < 1, y, start)


def _shifted(shift: Callable) -> Callable:
    """A shift by all bits or more gives zero."""

    def fn(a, b):
        return drjit().select(b < 8 * drjit().itemsize_v(a), shift(a, b), 0)

    return fn


def _arithmetic(a, b):
    bits = 8 * drjit().itemsize_v(a)
    return a >> drjit().minimum(b, bits - 1)


def _not(a):
    return ~a


def elementwise() -> dict[str, Callable[..., Any]]:
    """The functions, by their names in StableHLO and CHLO."""
    dr = drjit()
    return {
        "abs": dr.abs,
        "acos": dr.acos,
        "acosh": dr.acosh,
        "add": lambda a, b: a | b if dr.is_mask_v(a) else a + b,
        "and": lambda a, b: a & b,
        "asin": dr.asin,
        "asinh": dr.asinh,
        "atan": _atan,
        "atan2": _atan2,
        "atanh": _atanh,
        "cbrt": dr.cbrt,
        "ceil": dr.ceil,
        "clamp": _clamp,
        "cosh": _cosh,
        "cosine": dr.cos,
        "count_leading_zeros": dr.lzcnt,
        "divide": _divide,
        "erf": _erf,
        "erf_inv": _erf_inv,
        "exponential": dr.exp,
        "exponential_minus_one": _expm1,
        "floor": dr.floor,
        "is_finite": dr.isfinite,
        "log": dr.log,
        "log_plus_one": _log1p,
        "logistic": _logistic,
        "maximum": lambda a, b: a | b if dr.is_mask_v(a) else _maximum(a, b),
        "minimum": lambda a, b: a & b if dr.is_mask_v(a) else _minimum(a, b),
        "multiply": lambda a, b: a & b if dr.is_mask_v(a) else a * b,
        "negate": lambda a: -a,
        "not": _not,
        "or": lambda a, b: a | b,
        "popcnt": dr.popcnt,
        "power": _power,
        "remainder": _remainder,
        "round_nearest_afz": lambda a: dr.trunc(a + dr.copysign(type(a)(0.5), a)),
        "round_nearest_even": dr.round,
        "rsqrt": _rsqrt,
        "select": dr.select,
        "shift_left": _shifted(lambda a, b: a << b),
        "shift_right_arithmetic": _arithmetic,
        "shift_right_logical": _shifted(lambda a, b: a >> b),
        "sign": _sign,
        "sine": dr.sin,
        "sinh": _sinh,
        "sqrt": dr.sqrt,
        "square": lambda a: a * a,
        "subtract": lambda a, b: a - b,
        "tan": _tan,
        "tanh": _tanh,
        "xor": lambda a, b: a ^ b,
    }
