"""Complex numbers, as pairs of Dr.Jit arrays: their functions, where these are not those of
real numbers, and their constants.

Dr.Jit folds operations with constant zeros, so that a real number that JAX converts to a
complex one costs as little as before.
"""

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from .backend import drjit
from .elementwise import elementwise


def is_complex(a: Any) -> bool:
    return drjit().is_complex_v(a)


def _is_zero(a: Any) -> bool:
    """Whether it is zero for all paths, known while the kernel is recorded."""
    return a.state == drjit().VarState.Literal and a[0] == 0


def _divide(a, b):
    if _is_zero(b.imag):
        inverse = 1 / b.real
        return type(a)(a.real * inverse, a.imag * inverse)
    dr = drjit()
    # Scaled, so that no square overflows.
    real, imag = dr.abs(b.real), dr.abs(b.imag)
    size = dr.select(real > imag, real, imag)
    unit = dr.select((size > 0) & dr.isfinite(size), 1 / size, 1)
    scaled = type(a)(b.real * unit, b.imag * unit)
    inverse = unit / dr.squared_norm(scaled)
    product = a * dr.conj(scaled)
    return type(a)(product.real * inverse, product.imag * inverse)


def _absolute(a):
    dr = drjit()
    if _is_zero(a.imag):
        return dr.abs(a.real)
    return dr.sqrt(dr.fma(a.real, a.real, a.imag * a.imag))


def _sign(a):
    dr = drjit()
    size = _absolute(a)
    inverse = dr.select(size == 0, 0, 1 / size)
    return type(a)(a.real * inverse, a.imag * inverse)


def _square_root(a):
    """The root with a real part that is not negative, without cancellation."""
    dr = drjit()
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


def _power(a, b):
    dr = drjit()
    zero = (a.real == 0) & (a.imag == 0)
    one = (b.real == 0) & (b.imag == 0)
    at_zero = dr.select(one, type(a)(1), type(a)(0))
    return dr.select(zero, at_zero, _exp(b * _log(a)))


def _sine(a):
    real = elementwise()
    sine, cosine = drjit().sincos(a.real)
    return type(a)(sine * real["cosh"](a.imag), cosine * real["sinh"](a.imag))


def _cosine(a):
    real = elementwise()
    sine, cosine = drjit().sincos(a.real)
    return type(a)(cosine * real["cosh"](a.imag), -sine * real["sinh"](a.imag))


def equal(a, b):
    return (a.real == b.real) & (a.imag == b.imag)


def complex_functions() -> dict[str, Callable[..., Any]]:
    """The elementwise functions of complex numbers, by their names in StableHLO."""
    dr = drjit()
    return {
        "abs": _absolute,
        "add": lambda a, b: a + b,
        "cosine": _cosine,
        "divide": _divide,
        "exponential": _exp,
        "imag": lambda a: a.imag,
        "is_finite": lambda a: dr.isfinite(a.real) & dr.isfinite(a.imag),
        "log": _log,
        "multiply": lambda a, b: a * b,
        "negate": lambda a: -a,
        "power": _power,
        "real": lambda a: a.real,
        "select": dr.select,
        "sign": _sign,
        "sine": _sine,
        "sqrt": _square_root,
        "square": lambda a: a * a,
        "subtract": lambda a, b: a - b,
    }


def values(op: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The values of a complex constant. JAX's interface to the program gives those of real
    constants only, so that these are read from its text."""
    text = str(op)
    size = 8 if "complex<f64>" in text else 4
    if found := re.search(r'dense<"0x([0-9A-F]+)">', text):
        numbers = np.frombuffer(bytes.fromhex(found[1]), f"<f{size}")
    else:
        parts = re.findall(r"\(([^(),]+),([^(),]+)\)", text.split(" : ")[0])
        numbers = np.array([_number(x, size) for pair in parts for x in pair])
    pairs = numbers.reshape(-1, 2)
    whole = pairs[:, 0] + 0j
    whole.imag = pairs[:, 1]
    return np.resize(whole, shape)


def _number(text: str, size: int) -> float:
    """A number as MLIR prints it: as hexadecimal bits if it is not finite."""
    text = text.strip()
    if not text.startswith("0x"):
        return float(text)
    return float(np.array(int(text, 16), f"<u{size}").view(f"<f{size}"))
