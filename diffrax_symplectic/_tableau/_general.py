"""Tableaus for systems without further structure."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ._coefficients import check_all, Coefficients
from ._flat import AbstractTableau, FlatTableau, Stage, Structure


@dataclasses.dataclass(frozen=True, eq=False)
class GeneralTableau(AbstractTableau):
    r"""Coefficients for a Stratonovich system without further structure, with `s` drift
    and `r` noise stages.

    In the form of Rößler (2007), equations (2.6)-(2.7) of Wang, Hong and Xu (2017),

    $$G^0_i = y_n + h \sum_j A^0_{ij} a(t_n + c^0_j h, G^0_j)
      + \sum_l \sum_j B^0_{ij} b_l(t_n + c^1_j h, G^l_j) I_l$$

    $$G^k_i = y_n + h \sum_j A^1_{ij} a(t_n + c^0_j h, G^0_j)
      + \sum_j B^1_{ij} b_k(t_n + c^1_j h, G^k_j) I_k
      + \sum_{l \neq k} \sum_j B^3_{ij} b_l(t_n + c^1_j h, G^l_j) I_l$$

    $$y_{n+1} = y_n + h \sum_i \alpha_i a(t_n + c^0_i h, G^0_i)
      + \sum_k \sum_i \beta_i b_k(t_n + c^1_i h, G^k_i) I_k$$

    with stage times $c^0 = A^0 e$ and $c^1 = A^1 e$. Here $B^3 = B^1$: with that choice
    the stages $G^k_i$ are the same vector for every $k$, a step costs the same whatever
    the number of noises, and the condition on $B^3$ follows from the one on $B^1$.

    **Arguments:** `alpha` of shape `(s,)`, `beta` of shape `(r,)`, `A0` of shape
    `(s, s)`, `B0` of shape `(s, r)`, `A1` of shape `(r, s)`, `B1` of shape `(r, r)`;
    `noise`, the random variables that drive the noise stages: `("W",)`, of which `"W"` is
    $I_k$, or `("W", "A")` for $\sum_k b_k I_k + \sum_{k<l} [b_k, b_l] A_{kl}$, with the
    Lie brackets $[b_k, b_l] = b_l' b_k - b_k' b_l$ and the Lévy areas $A_{kl}$ of a
    [`diffrax_symplectic.LevyAreaIncrement`][], or `("W", "L")` for
    $\sum_k b_k I_k + h \sum_k [b_k, a] H_k + \sum_{k, l} [b_k, [b_l, a]] L_{kl}$ with the
    variables of [`diffrax_symplectic.PlateauGauss`][].

    **Raises:** a `ValueError` for other shapes, or coefficients that are not finite
    real numbers.
    """

    structure: ClassVar[Structure] = "any"
    alpha: Coefficients
    beta: Coefficients
    A0: Coefficients
    B0: Coefficients
    A1: Coefficients
    B1: Coefficients
    noise: tuple[str, ...] = ("W",)

    def __post_init__(self):
        s, r = np.size(self.alpha), np.size(self.beta)
        check_all(
            self, alpha=(s,), beta=(r,), A0=(s, s), B0=(s, r), A1=(r, s), B1=(r, r)
        )

    @classmethod
    def strong(cls, A, B, alpha, beta) -> "GeneralTableau":
        r"""The form of Burrage and Burrage (2000), equations (2.14)-(2.15) of Wang,
        Hong and Xu (2017), in which drift and noise are evaluated at the same points:

        $$G_i = y_n + h \sum_j A_{ij} a(G_j) + \sum_k \sum_j B_{ij} b_k(G_j) I_k$$

        **Arguments:** `A` and `B` of shape `(s, s)`, `alpha` and `beta` of shape `(s,)`.
        """
        return cls(alpha=alpha, beta=beta, A0=A, B0=B, A1=A, B1=B)

    @property
    def c0(self) -> Float[np.ndarray, " s"]:
        """Times of the drift stages, as fractions of the step."""
        return self.A0.sum(axis=1)

    @property
    def c1(self) -> Float[np.ndarray, " r"]:
        """Times of the noise stages, as fractions of the step."""
        return self.A1.sum(axis=1)

    def flatten(self) -> FlatTableau:
        stages = [Stage(("h",), float(c), "y", "y") for c in self.c0]
        stages += [Stage(self.noise, float(c), "y", "y") for c in self.c1]
        return FlatTableau(
            stages=tuple(stages),
            matrix=np.block([[self.A0, self.B0], [self.A1, self.B1]]),
            weights=np.concatenate([self.alpha, self.beta]),
        )
