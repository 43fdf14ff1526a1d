"""What every tableau becomes: stages, one matrix between them, one vector of weights."""

import abc
import dataclasses
from typing import ClassVar, Literal, NamedTuple, TypeAlias

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
