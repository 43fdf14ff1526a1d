"""Tableaus for additive noise."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ._coefficients import (
    check_all,
    check_by_variable,
    Coefficients,
    CoefficientsByVariable,
    columns,
    variables_of,
)
from ._flat import AbstractTableau, FlatTableau, Stage, Structure


@dataclasses.dataclass(frozen=True, eq=False)
class AdditiveTableau(AbstractTableau):
    r"""Coefficients for noise that does not depend on the state, $b_k(t)$, with `s` drift
    stages and `r` times at which the noise is read.

    With several random variables $\xi^\nu_k$ in a step, equations (4.4)-(4.5) and
    (4.8)-(4.9) of Wang, Hong and Xu (2017) are

    $$G_i = y_n + h \sum_j A_{ij} a(t_n + c^0_j h, G_j)
      + \sum_\nu \sum_k \sum_j B^\nu_{ij} b_k(t_n + c^1_j h)\, \xi^\nu_k$$

    $$y_{n+1} = y_n + h \sum_i \alpha_i a(t_n + c^0_i h, G_i)
      + \sum_\nu \sum_k \sum_j \beta^\nu_j b_k(t_n + c^1_j h)\, \xi^\nu_k$$

    with stage times $c^0 = A e$. Symplecticity asks nothing of $B$ and $\beta$.

    **Arguments:** `alpha` of shape `(s,)`, `A` of shape `(s, s)`, `c1` of shape `(r,)`;
    `beta` and `B`, dictionaries from the names of random variables (attributes of the
    Brownian increment, of which `"W"` is $I_k$) to arrays of shape `(r,)` and `(s, r)`, or
    just such an array for `"W"`; `constant`, whether the noise must not depend on time
    either.

    **Raises:** a `ValueError` for other shapes, or coefficients that are not finite
    real numbers.
    """

    alpha: Coefficients
    beta: CoefficientsByVariable
    A: Coefficients
    B: CoefficientsByVariable
    c1: Coefficients
    constant: bool = False

    def __post_init__(self):
        s, r = np.size(self.alpha), np.size(self.c1)
        check_all(self, alpha=(s,), A=(s, s), c1=(r,))
        check_by_variable(self, beta=(r,), B=(s, r))

    @property
    def structure(self) -> Structure:
        return "constant" if self.constant else "additive"

    @property
    def c0(self) -> Float[np.ndarray, " s"]:
        """Times of the drift stages, as fractions of the step."""
        return self.A.sum(axis=1)

    def flatten(self) -> FlatTableau:
        s, r = len(self.alpha), len(self.c1)
        variables = variables_of(self.B, self.beta)
        B = columns(self.B, variables, (s, r))
        stages = [Stage(("h",), float(c), "y", "y") for c in self.c0]
        stages += [Stage((v,), float(c), "", "y") for v in variables for c in self.c1]
        n = len(variables) * r
        return FlatTableau(
            stages=tuple(stages),
            matrix=np.block([[self.A, B], [np.zeros((n, s + n))]]),
            weights=np.concatenate([self.alpha, columns(self.beta, variables, (r,))]),
        )
