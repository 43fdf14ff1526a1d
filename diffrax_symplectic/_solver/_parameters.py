"""Free parameters of the tableaus of some solvers."""

import functools as ft
import math
from typing import Any

import equinox as eqx


def free_parameter(name: str, default: float) -> Any:
    """The field of a solver for the parameter of this name, which becomes a Python float.
    Parameters decide which stages are used, so they have to be known while tracing."""
    converter = ft.partial(real_number, name)
    return eqx.field(default=default, static=True, converter=converter)


def real_number(name: str, value: Any) -> float:
    """Raises a `ValueError` unless `value` is a finite real number."""
    try:
        number = math.nan if isinstance(value, complex) else float(value)
    except Exception:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(
            f"`{name}` must be a finite real number, known before tracing (a Python "
            f"float, not a traced array); got {value!r}."
        )
    return number
