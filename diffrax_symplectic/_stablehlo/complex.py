"""Elementwise operations of complex numbers, which are pairs of Dr.Jit arrays.

Dr.Jit leaves out operations with constant zeros. So a real number that JAX converts to a
complex one, with an imaginary part of zero, costs no more than before.
"""

import functools as ft
import operator
from collections.abc import Callable
from typing import Any

from .backend import dr
from .elementwise import elementwise, is_zero


def _divide(a, b):
    """`a / b`, as `a conj(s b) s / |s b|^2` with a scale `s` by which no square
    overflows."""
    if is_zero(b.imag):
        # Many Hamiltonians divide by a real number.
        inverse = 1 / b.real
        return type(a)(a.real * inverse, a.imag * inverse)
    real_size = dr.abs(b.real)
    imag_size = dr.abs(b.imag)
    size = dr.select(real_size > imag_size, real_size, imag_size)
    # `b` is divided by its larger part, unless this part is zero or infinite.
    scale = dr.select((size > 0) & dr.isfinite(size), 1 / size, 1)
    scaled_b = type(a)(b.real * scale, b.imag * scale)
    inverse = scale / dr.squared_norm(scaled_b)
    product = a * dr.conj(scaled_b)
    return type(a)(product.real * inverse, product.imag * inverse)


def _sign(a):
    """The number divided by its absolute value, or zero for zero."""
    size = dr.abs(a)
    inverse = dr.select(size == 0, 0, 1 / size)
    return type(a)(a.real * inverse, a.imag * inverse)


def _log(a):
    angle = elementwise()["atan2"](a.imag, a.real)
    return type(a)(dr.log(dr.abs(a)), angle)


def log_of_power(base, exponent):
    """The logarithm of `base**exponent`."""
    return exponent * _log(base)


def _power(base, exponent):
    # The logarithm of zero is infinite, and its product with the exponent NaN.
    is_zero_base = (base.real == 0) & (base.imag == 0)
    is_zeroth_power = (exponent.real == 0) & (exponent.imag == 0)
    power_of_zero = dr.select(is_zeroth_power, type(base)(1), type(base)(0))
    power = dr.exp(log_of_power(base, exponent))
    return dr.select(is_zero_base, power_of_zero, power)


def _sine(a):
    sine, cosine = dr.sincos(a.real)
    cosh = elementwise()["cosh"](a.imag)
    sinh = elementwise()["sinh"](a.imag)
    return type(a)(sine * cosh, cosine * sinh)


def _cosine(a):
    sine, cosine = dr.sincos(a.real)
    cosh = elementwise()["cosh"](a.imag)
    sinh = elementwise()["sinh"](a.imag)
    return type(a)(cosine * cosh, -sine * sinh)


def equal(a, b):
    """Whether two complex numbers are equal: both parts are."""
    return (a.real == b.real) & (a.imag == b.imag)


@ft.cache
def complex_functions() -> dict[str, Callable[..., Any]]:
    """The elementwise functions of complex numbers, by their names in StableHLO."""
    return {
        "abs": dr.abs,
        "add": operator.add,
        "cosine": _cosine,
        "divide": _divide,
        "exponential": dr.exp,
        "imag": operator.attrgetter("imag"),
        "is_finite": dr.isfinite,
        "log": _log,
        "multiply": operator.mul,
        "negate": operator.neg,
        "power": _power,
        "real": operator.attrgetter("real"),
        "sign": _sign,
        "sine": _sine,
        "sqrt": dr.sqrt,
        "square": dr.square,
        "subtract": operator.sub,
    }
