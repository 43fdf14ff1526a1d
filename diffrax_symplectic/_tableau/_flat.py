"""What every tableau becomes: stages, one matrix between them, one vector of weights."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float


# Which structure of the Hamiltonians coefficients are for: any; `H0 = V(p) + U(t, q)` and
# `H_k = U_k(t, q)`; noise that does not depend on the state; and on time neither; or both
# the second and the last.
Structure: TypeAlias = Literal[
    "any", "separable", "additive", "constant", "separable and constant"
]


class Stage(NamedTuple):
    """One evaluation, `y -> sum over channels of (vector field times control)`.

    - `channels`: the controls that drive it: `"h"` is the drift, driven by time; any
        other name is the noise, driven by the random variable of that name among the
        attributes of the Brownian increment.
    - `c`: where in the step it is evaluated, as a fraction of the step.
    - `reads`: the part of the state it depends on, `"y"` (all), `"p"`, `"q"` or `""`.
    - `writes`: the part of the state it changes, `"y"`, `"p"` or `"q"`.
    """

    channels: tuple[str, ...]
    c: float
    reads: str
    writes: str


@dataclasses.dataclass(frozen=True, eq=False)
class FlatTableau:
    """Stage `i` is evaluated at `y0 + sum_j matrix[i, j] k_j` and has the value `k_i`;
    the step ends at `y0 + sum_i weights[i] k_i`."""

    stages: tuple[Stage, ...]
    matrix: Float[np.ndarray, "s s"]
    weights: Float[np.ndarray, " s"]

    @property
    def reads(self) -> Bool[np.ndarray, "s s"]:
        """Whether a stage reads a part of the state that another one changes."""
        reads = [b.writes in a.reads for a in self.stages for b in self.stages]
        return np.array(reads, bool).reshape(self.matrix.shape)

    def take(self, keep: list[int]) -> "FlatTableau":
        """The tableau with only the stages `keep`."""
        return FlatTableau(
            stages=tuple(self.stages[i] for i in keep),
            matrix=self.matrix[np.ix_(keep, keep)],
            weights=self.weights[keep],
        )


class AbstractTableau(abc.ABC):
    """What every tableau offers.

    - `structure`: which structure of the Hamiltonians the coefficients are for, `"any"`,
        `"separable"`, `"additive"`, `"constant"` (additive, and not dependent on time) or
        `"separable and constant"`.
        Every solve checks that its terms have it, while tracing, before its first step.
    """

    structure: ClassVar[Structure]

    @abc.abstractmethod
    def flatten(self) -> FlatTableau:
        """All stages of the tableau, unused ones included, as one matrix."""


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
