"""Types for annotations."""

from typing import Any, TYPE_CHECKING, TypeAlias

import diffrax
import numpy as np
from jaxtyping import Array, ArrayLike, Int, PyTree, Real, Shaped


if TYPE_CHECKING:
    IntScalarLike: TypeAlias = int | Array | np.ndarray
    RealScalarLike: TypeAlias = int | float | Array | np.ndarray
else:
    IntScalarLike = Int[ArrayLike, ""]
    RealScalarLike = Real[ArrayLike, ""]

Args: TypeAlias = PyTree[Any]
Y: TypeAlias = PyTree[Shaped[ArrayLike, "?*y"], "Y"]
BM: TypeAlias = PyTree[Shaped[ArrayLike, "?*bm"], "BM"]
# Several terms, such as all terms of the drift.
Terms: TypeAlias = tuple[diffrax.AbstractTerm, ...]
# Instances of `jax.Device`, which type checkers do not take for a type.
Devices: TypeAlias = tuple[Any, ...]
