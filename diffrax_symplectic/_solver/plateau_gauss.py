import dataclasses
from typing import ClassVar

import numpy as np

from .._tableau import GeneralTableau
from .._terms import number_of_noises
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta


_r = np.sqrt(3.0)
_gauss = np.array([[1 / 4, 1 / 4 - _r / 6], [1 / 4 + _r / 6, 1 / 4]])
_half = np.array([1 / 2, 1 / 2])


class PlateauGauss(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""A symplectic method of strong order 3/2 for any Hamiltonians, with one noise or with
    noises that commute.

    A step is one step over unit time, by the Gauss method with two stages, of the field

    $$h a + \sum_k b_k W_k + h \sum_k [b_k, a] H_k + \sum_{k, l} [b_k, [b_l, a]]\, L_{kl},
      \qquad [b, a] = a' b - b' a,$$

    with the increments $W_k$, the space-time Lévy areas $H_k$, and

    $$L_{kl} = \tfrac35 h H_k H_l + \tfrac{1}{30} h^2 \delta_{kl}.$$

    If the path has space-time-time areas $K_k$, too (`diffrax.SpaceTimeTimeLevyArea`), then

    $$L_{kl} = \tfrac35 h H_k H_l + \tfrac{60}{7} h K_k K_l
      - \tfrac12 h (W_k K_l + K_k W_l) + \tfrac{3}{140} h^2 \delta_{kl}.$$

    Both are conditional expectations of the integrals that the logarithm of the solution
    contains, given these variables of the path. The second one is closer to the integrals:
    with it the errors of small steps were less than half as large.

    The brackets of Hamiltonian vector fields are fields of Hamiltonians, their Poisson
    brackets. So a step is symplectic for any Hamiltonians, and conserves every quadratic
    invariant that drift and noises share. JAX takes the derivatives: for $m$ noises, $m$
    second derivatives of the vector fields in each evaluation. Terms that do not come from
    Hamiltonians will do, and so do coefficients that depend on time: the brackets contain
    their derivatives by time, and all orders hold.

    Two stage vectors are solved for, in one system, whatever the number of noises. Strong
    order 3/2 and weak order 2 for one noise and for noises that commute with each other,
    $[b_k, b_l] = 0$. Strong order 1/2 and weak order 1 if they do not. Order 4 without
    noise. No free parameters. For noise in the forces alone,
    [`diffrax_symplectic.PlateauVerlet`][] is explicit and much cheaper.

    !!! warning

        The path has to have space-time Lévy area.

    **Source:** the field is that of the log-ODE method of [Foster, Lyons and Oberhauser
    (2020)](https://doi.org/10.1137/19M1261912), section 4. The Gauss method keeps it
    symplectic.
    """

    tableau: ClassVar[GeneralTableau] = dataclasses.replace(
        GeneralTableau.strong(A=_gauss, B=_gauss, alpha=_half, beta=_half),
        noise=("W", "L"),
    )

    def order(self, terms):
        return 4

    def strong_order(self, terms):
        return 1.5 if number_of_noises(terms) <= 1 else 0.5

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2 if number_of_noises(terms) <= 1 else 1


PlateauGauss.__init__.__doc__ = ARGUMENTS
