from typing import ClassVar

import numpy as np

from .._tableau import GeneralTableau
from .._terms import strong_order_if_commutative
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta


_half = np.array([[0.5]])
_tab = GeneralTableau.strong(A=_half, B=_half, alpha=np.ones(1), beta=np.ones(1))


class ImplicitMidpoint(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The implicit midpoint rule for Stratonovich systems.

    $$G = y_n + \tfrac12 h\,a(G) + \tfrac12 \sum_k b_k(G) I_k, \qquad
      y_{n+1} = y_n + h\,a(G) + \sum_k b_k(G) I_k$$

    Symplectic for any Hamiltonians, and conserves every quadratic invariant. One stage
    vector is solved for, whatever the number of noises.

    Strong order 1/2, and 1 if there is one noise or the noises commute. Weak order 1.
    Order 2 without noise.

    **Source:** [Milstein, Repin and Tretyakov
    (2002)](https://doi.org/10.1137/S0036142901395588).
    """

    tableau: ClassVar[GeneralTableau] = _tab

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return strong_order_if_commutative(terms)

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


ImplicitMidpoint.__init__.__doc__ = ARGUMENTS
