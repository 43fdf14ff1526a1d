"""Which angles are too large for Dr.Jit's sine and cosine."""

import operator
from collections.abc import Callable
from typing import Any

from .backend import drjit
from .complex import is_complex, log_of_power


# The largest angles whose sine and cosine Dr.Jit has to a unit in the last place, for each
# size of numbers in bytes. For twice this angle they are off by 4 units in single
# precision, and by 1e138 in double.
_LARGEST_ANGLES = {4: 2.0**13, 8: 2.0**31}


def _itself(a):
    return a


# For each function, the angle whose sine or cosine it takes, as a function of its operands.
_ANGLES_OF_REAL: dict[str, Callable[..., Any]] = {
    "cosine": _itself,
    "sine": _itself,
    "tan": _itself,
}
_ANGLES_OF_COMPLEX: dict[str, Callable[..., Any]] = {
    "cosine": operator.attrgetter("real"),
    "exponential": operator.attrgetter("imag"),
    "power": lambda base, exponent: log_of_power(base, exponent).imag,
    "sine": operator.attrgetter("real"),
}


def lanes_with_too_large_angle(name: str, *operands: Any) -> Any | None:
    """The lanes in which a function, by its name in StableHLO, takes the sine or cosine of
    too large an angle; `None` if it takes none."""
    angles = _ANGLES_OF_COMPLEX if is_complex(operands[0]) else _ANGLES_OF_REAL
    if name not in angles:
        return None
    angle = angles[name](*operands)
    return drjit().abs(angle) > _LARGEST_ANGLES[drjit().itemsize_v(angle)]
