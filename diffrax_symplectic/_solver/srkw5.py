from typing import ClassVar

from .._tableau import AdditiveTableau
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta


_tab = AdditiveTableau(
    alpha=[1],
    beta={"W": [1]},
    A=[[1 / 2]],
    B={"W": [[1 / 2]], "second": [[1 / 2]]},
    c1=[0],
    constant=True,
)


class SRKw5(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic method SRKw5 of Wang, Hong and Xu, of weak order 2 for any number of
    noises that depend neither on the state nor on time.

    For any $H_0$ and $H_k = -\sigma_k \cdot q + \gamma_k \cdot p$, or any
    $\mathrm{d}y = a(t, y)\,\mathrm{d}t + \sum_k b_k\,\mathrm{d}w_k$ with constant $b_k$,

    $$G = y_n + \frac h2 a(t_n + \tfrac h2, G)
      + \sum_k b_k \frac{\hat I_k + \hat I_{k+m}}{2}, \qquad
      y_{n+1} = y_n + h\, a(t_n + \tfrac h2, G) + \sum_k b_k \hat I_k.$$

    One stage vector is solved for, as in the midpoint rule. The second order comes from the
    second, independent variable $\hat I_{k+m}$. No free parameters.

    Order 2 without noise. Noise without the structure is refused while tracing.

    !!! warning

        The path has to be `WeakBrownianPath(..., second=True)`.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 4.2.
    """

    tableau: ClassVar[AdditiveTableau] = _tab

    def order(self, terms):
        return 2

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2


SRKw5.__init__.__doc__ = ARGUMENTS
