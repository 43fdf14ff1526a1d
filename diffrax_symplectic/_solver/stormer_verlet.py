from typing import ClassVar

from .._tableau import PartitionedTableau
from .base import AbstractSymplecticRungeKutta


_tab = PartitionedTableau(
    alpha=[1],
    alpha_hat=[1 / 2, 1 / 2],
    beta=[1],
    # The momenta before and after the kick.
    A=[[0], [1]],
    A_hat=[[1 / 2, 0]],
    B0=[[0], [1]],
    A1=[[1 / 2, 0]],
)


class StormerVerlet(AbstractSymplecticRungeKutta):
    r"""The Störmer--Verlet method with the noise in its kick: explicit, symplectic, of weak
    order 2 and strong order 1 for any number of noises, for $H_0 = V(p) + U_0(t, q)$ and
    $H_k = U_k(t, q)$.

    $$\bar q = Q + \tfrac h2 g(P), \qquad
      P_1 = P + h f(t_n + \tfrac h2, \bar q)
        + \sum_k \sigma_k(t_n + \tfrac h2, \bar q) I_k, \qquad
      Q_1 = \bar q + \tfrac h2 g(P_1)$$

    in the notation of [`diffrax_symplectic.SeparableTableau`][]. Force and noise are
    evaluated at the same $q$, so that the kick is the exact flow of both together. A
    symmetric splitting of the generator has weak order 2. A step takes one evaluation of
    the forces, and no equation is solved.

    Order 2 without noise. No free parameters. A Hamiltonian without the structure is
    refused while tracing. As explicit methods are, it is limited to steps that resolve the
    fastest frequency $\omega$ of $H_0$: $\omega h < 2$.

    Any Brownian path will do: a [`diffrax_symplectic.WeakBrownianPath`][] for expectations,
    one of Diffrax's for paths.

    **Source:** [Strang (1968)](https://doi.org/10.1137/0705041) for the splitting;
    [Ninomiya and Victoir (2008)](https://doi.org/10.1080/13504860701413958) for the weak
    order of symmetric splittings.
    """

    tableau: ClassVar[PartitionedTableau] = _tab

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return 1.0

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2
