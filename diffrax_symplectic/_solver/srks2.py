from typing import ClassVar

import numpy as np

from .._tableau import SeparableTableau
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta


def _srks2(d1: float = 0.5) -> SeparableTableau:
    """The paper's tableau, where its other parameters have no weight. The first two noise
    stages read the same point, so that `d1` cancels."""
    A = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 1 / 2]])
    return SeparableTableau(
        alpha=[0, 0, 1],
        beta={"W": [0, 0, 1], "sqrt h": [d1, -d1, 0]},
        A0=A,
        B0={"W": A, "sqrt h": [[0, 0, 0], [0, 0, 0], [d1, -d1, 0]]},
        A1=A,
    )


class SRKs2(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic method SRKs2 of Wang, Hong and Xu, of strong order 1, for
    $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    Two of the paper's three noise stages read the same point and enter with opposite
    weights. What remains is the midpoint rule on the separable system: in the form of
    [`diffrax_symplectic.SeparableTableau`][], $\alpha = \beta = 1$ and
    $A^0 = B^0 = A^1 = \frac12$.

    Strong order 1 and weak order 1. Order 2 without noise. A Hamiltonian without the
    structure is refused while tracing.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.2.
    """

    tableau: ClassVar[SeparableTableau] = _srks2()

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return 1.0

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


SRKs2.__init__.__doc__ = ARGUMENTS
