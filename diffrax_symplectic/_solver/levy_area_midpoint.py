import dataclasses
from typing import ClassVar

from .._tableau import GeneralTableau
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta
from .implicit_midpoint import ImplicitMidpoint


class LevyAreaMidpoint(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The implicit midpoint rule with Lévy areas, of strong order 1 for any number of
    noises, whether they commute or not.

    $$G = \tfrac12 (y_n + y_{n+1}), \qquad y_{n+1} = y_n + h\,a(G) + \sum_k b_k(G) I_k
      + \sum_{k<l} [b_k, b_l](G)\, A_{kl}$$

    with the Lie brackets $[b_k, b_l] = b_l' b_k - b_k' b_l$ and the Lévy areas
    $A_{kl} = \frac12 \int (w_k \,\mathrm{d}w_l - w_l \,\mathrm{d}w_k)$ of the step. This is
    one midpoint step, over unit time, of the Hamiltonian

    $$h H_0 + \sum_k I_k H_k + \sum_{k<l} A_{kl} \{H_k, H_l\}, \qquad
      \{F, G\} = \frac{\partial F}{\partial p} \cdot \frac{\partial G}{\partial q}
      - \frac{\partial F}{\partial q} \cdot \frac{\partial G}{\partial p},$$

    since the Lie bracket of two Hamiltonian vector fields is the field of their Poisson
    bracket. So it is symplectic for any Hamiltonians, and conserves every quadratic
    invariant of the system. JAX takes the derivatives. The terms need not come from
    Hamiltonians, but all noises have to be in one term.

    The areas bring the order: without them the midpoint rule has strong order 1/2. For `m`
    noises they cost `m` directional derivatives of the noise in each evaluation. With one
    noise, or noises that commute, it is [`diffrax_symplectic.ImplicitMidpoint`][] at a
    higher price. Weak order 1. Order 2 without noise. No free parameters.

    !!! warning

        The path has to be a [`diffrax_symplectic.LevyAreaBrownianPath`][] around one with
        space-time Lévy area.

    **Source:** [Milstein and Tretyakov (2021)](https://doi.org/10.1007/978-3-030-82040-4)
    for the order that Lévy areas and Lie brackets bring, which is due to Milstein. We
    know of no source for the combination with the midpoint rule, which keeps it symplectic.
    """

    tableau: ClassVar[GeneralTableau] = dataclasses.replace(
        ImplicitMidpoint.tableau, noise=("W", "A")
    )

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return 1.0

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


LevyAreaMidpoint.__init__.__doc__ = ARGUMENTS
