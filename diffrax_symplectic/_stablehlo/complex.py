"""Complex numbers, as pairs of Dr.Jit arrays: their functions, where these are not those of
real numbers.

Dr.Jit folds operations with constant zeros, so that a real number that JAX converts to a
complex one costs as little as before.
"""

import operator
from collections.abc import Callable
from typing import Any

from .backend import drjit
from .elementwise import elementwise, is_zero


def is_complex(a: Any) -> bool:
    return drjit().is_complex_v(a)


def _divide(a, b):
    """`a conj(b) / |b|^2`, scaled so that no square overflows."""
    if is_zero(b.imag):
        # By a real number, as in many Hamiltonians.
        inverse = 1 / b.real
        return type(a)(a.real * inverse, a.imag * inverse)
    dr = drjit()
    real_size = dr.abs(b.real)
    imag_size = dr.abs(b.imag)
    size = dr.select(real_size > imag_size, real_size, imag_size)
    # Zero and infinity cannot be scaled.
    scale = dr.select((size > 0) & dr.isfinite(size), 1 / size, 1)
    scaled_b = type(a)(b.real * scale, b.imag * scale)
    inverse = scale / dr.squared_norm(scaled_b)
    product = a * dr.conj(scaled_b)
    return type(a)(product.real * inverse, product.imag * inverse)


def _absolute(a):
    dr = drjit()
    if is_zero(a.imag):
        return dr.abs(a.real)
    # Unlike in a division, nothing is scaled here: in double precision the squares of
    # numbers beyond 1e154 overflow.
    return dr.sqrt(dr.fma(a.real, a.real, a.imag * a.imag))


def _sign(a):
    """The number divided by its absolute value."""
    dr = drjit()
    size = _absolute(a)
    inverse = dr.select(size == 0, 0, 1 / size)
    return type(a)(a.real * inverse, a.imag * inverse)


def _square_root(a):
    """The root with a real part that is not negative, without cancellation."""
    dr = drjit()
    # The square of `x + i y` is `x^2 - y^2 + 2 i x y`, of absolute value `x^2 + y^2`. So
    # the larger of `x^2` and `y^2` is `(|a| + |Re a|) / 2`, a sum without cancellation, and
    # the other part of the root follows from `2 x y = Im a`.
    larger = dr.sqrt((_absolute(a) + dr.abs(a.real)) / 2)
    smaller = dr.select(larger == 0, 0, a.imag / (2 * larger))
    # If `Re a`, which is `x^2 - y^2`, is not negative, the real part is the larger one.
    is_real_larger = a.real >= 0
    real = dr.select(is_real_larger, larger, dr.abs(smaller))
    imag = dr.select(is_real_larger, smaller, dr.copysign(larger, a.imag))
    return type(a)(real, imag)


def _log(a):
    angle = elementwise()["atan2"](a.imag, a.real)
    return type(a)(drjit().log(_absolute(a)), angle)


def _exp(a):
    dr = drjit()
    size = dr.exp(a.real)
    sine, cosine = dr.sincos(a.imag)
    return type(a)(size * cosine, size * sine)


def log_of_power(base, exponent):
    """The logarithm of `base**exponent`."""
    return exponent * _log(base)


def _power(base, exponent):
    dr = drjit()
    # The logarithm of zero is infinite, and its product with the exponent NaN.
    is_zero_base = (base.real == 0) & (base.imag == 0)
    is_zeroth_power = (exponent.real == 0) & (exponent.imag == 0)
    power_of_zero = dr.select(is_zeroth_power, type(base)(1), type(base)(0))
    power = _exp(log_of_power(base, exponent))
    return dr.select(is_zero_base, power_of_zero, power)


def _sine(a):
    sine, cosine = drjit().sincos(a.real)
    cosh = elementwise()["cosh"](a.imag)
    sinh = elementwise()["sinh"](a.imag)
    return type(a)(sine * cosh, cosine * sinh)


def _cosine(a):
    sine, cosine = drjit().sincos(a.real)
    cosh = elementwise()["cosh"](a.imag)
    sinh = elementwise()["sinh"](a.imag)
    return type(a)(cosine * cosh, -sine * sinh)


def _is_finite(a):
    return drjit().isfinite(a.real) & drjit().isfinite(a.imag)


def _square(a):
    return a * a


def equal(a, b):
    """Whether both parts are equal."""
    return (a.real == b.real) & (a.imag == b.imag)


def complex_functions() -> dict[str, Callable[..., Any]]:
    """The elementwise functions of complex numbers, by their names in StableHLO."""
    return {
        "abs": _absolute,
        "add": operator.add,
        "cosine": _cosine,
        "divide": _divide,
        "exponential": _exp,
        "imag": operator.attrgetter("imag"),
        "is_finite": _is_finite,
        "log": _log,
        "multiply": operator.mul,
        "negate": operator.neg,
        "power": _power,
        "real": operator.attrgetter("real"),
        "select": drjit().select,
        "sign": _sign,
        "sine": _sine,
        "sqrt": _square_root,
        "square": _square,
        "subtract": operator.sub,
    }
