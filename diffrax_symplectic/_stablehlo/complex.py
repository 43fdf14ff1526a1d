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
    if is_zero(b.imag):
        # By a real number, as in many Hamiltonians.
        inverse = 1 / b.real
        return type(a)(a.real * inverse, a.imag * inverse)
    dr = drjit()
    # Scaled, so that no square overflows.
    real = dr.abs(b.real)
    imag = dr.abs(b.imag)
    size = dr.select(real > imag, real, imag)
    # Zero and infinity cannot be scaled.
    unit = dr.select((size > 0) & dr.isfinite(size), 1 / size, 1)
    scaled = type(a)(b.real * unit, b.imag * unit)
    inverse = unit / dr.squared_norm(scaled)
    product = a * dr.conj(scaled)
    return type(a)(product.real * inverse, product.imag * inverse)


def _absolute(a):
    dr = drjit()
    if is_zero(a.imag):
        return dr.abs(a.real)
    # Not scaled: the square of an amplitude beyond 1e154 overflows.
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
    # The larger part of the root is a sum, and the other follows from their product.
    size = dr.sqrt((_absolute(a) + dr.abs(a.real)) / 2)
    other = dr.select(size == 0, 0, a.imag / (2 * size))
    right = a.real >= 0
    real = dr.select(right, size, dr.abs(other))
    imag = dr.select(right, other, dr.copysign(size, a.imag))
    return type(a)(real, imag)


def _log(a):
    angle = elementwise()["atan2"](a.imag, a.real)
    return type(a)(drjit().log(_absolute(a)), angle)


def _exp(a):
    dr = drjit()
    size = dr.exp(a.real)
    sine, cosine = dr.sincos(a.imag)
    return type(a)(size * cosine, size * sine)


def exponent(a, b):
    """The logarithm of the power."""
    return b * _log(a)


def _power(a, b):
    dr = drjit()
    # The logarithm of zero is infinite, and its product with the exponent NaN.
    zero = (a.real == 0) & (a.imag == 0)
    to_the_zeroth = (b.real == 0) & (b.imag == 0)
    of_zero = dr.select(to_the_zeroth, type(a)(1), type(a)(0))
    return dr.select(zero, of_zero, _exp(exponent(a, b)))


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
