"""Which angles are too large for Dr.Jit's sine and cosine."""

import operator
from collections.abc import Callable
from typing import Any

from .backend import drjit
from .complex import exponent, is_complex


# The largest angles, for each size of numbers in bytes, whose sine and cosine Dr.Jit has to
# a unit in the last place. Of twice these they are off by 4 units, and by 1e138.
_LARGEST = {4: 2.0**13, 8: 2.0**31}


def _itself(a):
    return a


# The angle of which functions take the sine or cosine.
_OF_REAL: dict[str, Callable[..., Any]] = {
    "cosine": _itself,
    "sine": _itself,
    "tan": _itself,
}
_OF_COMPLEX: dict[str, Callable[..., Any]] = {
    "cosine": operator.attrgetter("real"),
    "exponential": operator.attrgetter("imag"),
    "power": lambda a, b: exponent(a, b).imag,
    "sine": operator.attrgetter("real"),
}


def too_large(name: str, *operands: Any) -> Any | None:
    """The lanes in which a function, by its name in StableHLO, takes the sine or cosine of
    too large an angle; `None` if it takes none."""
    angles = _OF_COMPLEX if is_complex(operands[0]) else _OF_REAL
    if name not in angles:
        return None
    angle = angles[name](*operands)
    return drjit().abs(angle) > _LARGEST[drjit().itemsize_v(angle)]
