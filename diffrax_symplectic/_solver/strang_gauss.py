from typing import ClassVar

import numpy as np

from .._tableau import GeneralTableau
from .._terms import number_of_noises
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta


_r = np.sqrt(3.0)
_tab = GeneralTableau(
    alpha=[1 / 2, 1 / 2],
    beta=[1 / 2, 1 / 2],
    A0=[[1 / 4, 0], [1 / 2, 1 / 4]],
    B0=[[0, 0], [1 / 2, 1 / 2]],
    A1=[[1 / 2, 0], [1 / 2, 0]],
    B1=[[1 / 4, 1 / 4 - _r / 6], [1 / 4 + _r / 6, 1 / 4]],
)


class StrangGauss(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""A symplectic method of weak order 2 for one noise or noises that commute: the drift
    over half of the step by the midpoint rule, the noise by the Gauss method of order 4,
    and the drift over the other half.

    In the form of [`diffrax_symplectic.GeneralTableau`][], with $r = \sqrt 3$,

    $$A^0 = \begin{pmatrix} \frac14 & 0 \\ \frac12 & \frac14 \end{pmatrix}, \quad
      B^0 = \begin{pmatrix} 0 & 0 \\ \frac12 & \frac12 \end{pmatrix}, \quad
      A^1 = \begin{pmatrix} \frac12 & 0 \\ \frac12 & 0 \end{pmatrix},$$

    $$B^1 = \begin{pmatrix} \frac14 & \frac14 - \frac r6 \\
        \frac14 + \frac r6 & \frac14 \end{pmatrix}, \quad
      \alpha = \beta = (\tfrac12, \tfrac12).$$

    It satisfies all 17 conditions that [`diffrax_symplectic.SRKw2`][] does, with four
    stage vectors in place of six, solved in three small systems one after the other: the
    cheaper of the two, and the more accurate in our tests.

    Any Hamiltonians, and any Stratonovich system: quadratic invariants that drift and
    noise share are conserved. Weak order 2 for one noise and for noises that commute, weak
    order 1 for others.
    Order 2 without noise. No free parameters.

    **Source:** [Strang (1968)](https://doi.org/10.1137/0705041) for the splitting.
    """

    tableau: ClassVar[GeneralTableau] = _tab

    def order(self, terms):
        return 2

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2 if number_of_noises(terms) <= 1 else 1


StrangGauss.__init__.__doc__ = ARGUMENTS
