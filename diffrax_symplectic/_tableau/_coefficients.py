"""Coefficients given by the user, checked and brought into one form."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np


# Anything that NumPy makes an array of; a read-only array of float64 once checked.
Coefficients: TypeAlias = Any
# The same for each random variable of a step, by its name. Without a name it is "W".
CoefficientsByVariable: TypeAlias = Any


def _coefficients(name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"Coefficients `{name}` must be real numbers; got dtype {array.dtype}."
        )
    array = array.astype(np.float64)
    if array.shape != shape:
        raise ValueError(
            f"Coefficients `{name}` must have shape {shape}; got shape {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"Coefficients `{name}` must be finite; got {array}.")
    array.setflags(write=False)
    return array


def check_all(tableau, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        array = _coefficients(name, getattr(tableau, name), shape)
        object.__setattr__(tableau, name, array)


def check_by_variable(tableau, **shapes: tuple[int, ...]) -> None:
    """Brings coefficients into the form of a dictionary over the random variables."""
    for name, shape in shapes.items():
        value = getattr(tableau, name)
        named = value if isinstance(value, Mapping) else {"W": value}
        checked = {
            k: _coefficients(f"{name}[{k!r}]", v, shape) for k, v in named.items()
        }
        object.__setattr__(tableau, name, checked)


def columns(
    coefficients: Mapping[str, np.ndarray], variables: list[str], shape: tuple[int, ...]
) -> np.ndarray:
    """Those for all of `variables`, side by side; zero where there are none."""
    zeros = np.zeros(shape)
    return np.concatenate([coefficients.get(v, zeros) for v in variables], axis=-1)


def variables_of(*coefficients: Mapping[str, np.ndarray]) -> list[str]:
    """All random variables, in the order of their first appearance."""
    return list(dict.fromkeys(name for c in coefficients for name in c))
