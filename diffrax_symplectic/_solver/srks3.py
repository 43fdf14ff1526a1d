import numpy as np

from .._tableau import SeparableTableau
from ._implicit import AbstractImplicitStages, ROOT_FINDER
from ._parameters import free_parameter
from .base import AbstractSymplecticRungeKutta


def _srks3(a: float, b1_plus_b2: float = 1.0) -> SeparableTableau:
    """The paper's tableau. Both noise stages read the same point, so that the weights
    against the second variable, and with them `b1` and `b2`, cancel."""
    alpha = np.array([2 * a, 1 - 2 * a])
    return SeparableTableau(
        alpha=alpha,
        beta={
            "W": [1 / 2, 1 / 2],
            "I_kk / sqrt h": np.array([1, -1]) / (2 * b1_plus_b2),
        },
        A0=[[a, 0], [2 * a, 1 / 2 - a]],
        B0=np.zeros((2, 2)),
        A1=[alpha, alpha],
    )


class SRKs3(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic methods SRKs3 of Wang, Hong and Xu, of strong order 1 for any
    number of noises, for $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    In the form of [`diffrax_symplectic.SeparableTableau`][], $B^0 = 0$ and

    $$A^0 = \begin{pmatrix} a & 0 \\ 2a & \frac12 - a \end{pmatrix}, \quad
      \alpha = (2a,\; 1 - 2a), \quad
      A^1 = \begin{pmatrix} 2a & 1 - 2a \\ 2a & 1 - 2a \end{pmatrix}, \quad
      \beta = (\tfrac12, \tfrac12).$$

    Two midpoint steps of the drift over the fractions $2a$ and $1 - 2a$ of the step, then
    the kick $\sum_k \sigma_k(t_{n+1}, Q_1) I_k$. The default $a = 0$ makes one midpoint
    step: over six problems $a$ changed the strong error by 3% at most, and any other value
    but 1/2 costs twice as much. The paper's second noise weight, and
    with it its other parameters, cancels, since both noise stages read $Q_1$.

    Strong order 1 and weak order 1. Order 2 without noise. A Hamiltonian without the
    structure is refused while tracing.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.2.
    """

    a: float = free_parameter("a", 0.0)

    @property
    def tableau(self) -> SeparableTableau:
        return _srks3(self.a)

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return 1.0

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


SRKs3.__init__.__doc__ = f"""**Arguments:**

- `a`: the free parameter, a Python float.
{ROOT_FINDER}
**Raises:** a `ValueError` if `a` is not a finite real number.
"""
