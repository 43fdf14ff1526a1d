import numpy as np

from .._tableau import GeneralTableau
from .._terms import strong_order_if_commutative
from ._implicit import AbstractImplicitStages, ROOT_FINDER
from ._parameters import free_parameter
from .base import AbstractSymplecticRungeKutta


def _srks1(a: float) -> GeneralTableau:
    A = np.array([[a, 0.0], [2 * a, 0.5 - a]])
    alpha = np.array([2 * a, 1 - 2 * a])
    return GeneralTableau.strong(A=A, B=A, alpha=alpha, beta=alpha)


class SRKs1(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The two-stage symplectic methods SRKs1 of Wang, Hong and Xu.

    $$A = B = \begin{pmatrix} a & 0 \\ 2a & \tfrac12 - a \end{pmatrix}, \qquad
      \alpha = \beta = (2a,\; 1 - 2a)$$

    These are two steps of the midpoint rule, over the fractions $2a$ and $1 - 2a$ of the
    step and of its increment. For $a = 0$ and $a = 1/2$ this is the midpoint rule itself,
    with one stage vector to solve for. For any other value there are two, solved one after
    the other. The default $a = 1/4$ makes two half steps and has the smallest strong
    errors. Where the error of the drift dominates, it is a quarter of the midpoint rule's.
    Where that of the noise dominates, nothing is gained.

    Symplectic for any Hamiltonians, and conserves every quadratic invariant. Strong
    order 1/2, and 1 if there is one noise or the noises commute. Weak order 1. Order 2
    without noise.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 2.2.
    """

    a: float = free_parameter("a", 0.25)

    @property
    def tableau(self) -> GeneralTableau:
        return _srks1(self.a)

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return strong_order_if_commutative(terms)

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


SRKs1.__init__.__doc__ = f"""**Arguments:**

- `a`: the free parameter, a Python float.
{ROOT_FINDER}
**Raises:** a `ValueError` if `a` is not a finite real number.
"""
