import numpy as np

from .._tableau import GeneralTableau
from ._implicit import AbstractImplicitStages, ROOT_FINDER
from ._parameters import free_parameter
from .base import AbstractSymplecticRungeKutta


def _srkw1(b: float) -> GeneralTableau:
    one, half = np.ones(1), np.array([[0.5]])
    return GeneralTableau(alpha=one, beta=one, A0=half, B0=[[b]], A1=[[1 - b]], B1=half)


class SRKw1(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The one-stage symplectic methods SRKw1 of Wang, Hong and Xu, of weak order 1.

    $$G^0 = y_n + \tfrac12 h\,a(G^0) + b \sum_k b_k(G^1) \hat I_k, \qquad
      G^1 = y_n + (1 - b) h\,a(G^0) + \tfrac12 \sum_k b_k(G^1) \hat I_k$$

    $$y_{n+1} = y_n + h\,a(G^0) + \sum_k b_k(G^1) \hat I_k$$

    The parameter matters. At $b = 1/2$, the default, $G^0 = G^1$ and this is the
    midpoint rule, with one stage vector to solve for. At $b = 0$ and $b = 1$ it is a
    midpoint step of the drift followed by one of the noise, or the other way round: two
    small systems one after the other. Any other value couples the two.

    Symplectic for any Hamiltonians, and conserves every quadratic invariant. Weak order
    1 for any number of noises. Order 2 without noise.

    Use with [`diffrax_symplectic.WeakBrownianPath`][].

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 2.1.
    """

    b: float = free_parameter("b", 0.5)

    @property
    def tableau(self) -> GeneralTableau:
        return _srkw1(self.b)

    def order(self, terms):
        return 2

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


SRKw1.__init__.__doc__ = f"""**Arguments:**

- `b`: the free parameter, a Python float.
{ROOT_FINDER}
**Raises:** a `ValueError` if `b` is not a finite real number.
"""
