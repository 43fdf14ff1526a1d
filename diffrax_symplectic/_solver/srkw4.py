import numpy as np

from .._tableau import SeparableTableau
from ._implicit import AbstractImplicitStages, ROOT_FINDER
from ._parameters import free_parameter
from .base import AbstractSymplecticRungeKutta


def _srkw4(
    a21: float, a31: float = 0.0, a32: float = 0.0, b33: float = 0.0, b: float = 0.0
) -> SeparableTableau:
    """The paper's tableau. A step depends on none of its parameters but `a21`: the third
    drift stage is unused, and the second and third noise stage are at the same point, so
    that `b` cancels."""
    return SeparableTableau(
        alpha=[1 / 2, 1 / 2, 0],
        beta={
            "W": [1 / 2, 1 / 4 - b, 1 / 4 + b],
            "I_11 / sqrt h": [0, 1 / 2, -1 / 2],
        },
        A0=[[1 / 4, 1 / 2 - a21, 0], [a21, 1 / 4, 0], [a31, a32, 0]],
        B0={"W": [[1, 0, 0], [0, 0, 0], [1, 1, b33]]},
        A1=[[-1 / 2, 1 / 2, 0], [1 / 2, 1 / 2, 0], [1 / 2, 1 / 2, 0]],
    )


class SRKw4(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic methods SRKw4 of Wang, Hong and Xu, of weak order 2, for
    $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    In the form of [`diffrax_symplectic.SeparableTableau`][], $\alpha = \beta =
    (\frac12, \frac12)$ and

    $$A^0 = \begin{pmatrix} \frac14 & \frac12 - a_{21} \\ a_{21} & \frac14
      \end{pmatrix}, \quad B^0 = \begin{pmatrix} 1 & 0 \\ 0 & 0 \end{pmatrix}, \quad
      A^1 = \begin{pmatrix} -\frac12 & \frac12 \\ \frac12 & \frac12 \end{pmatrix}.$$

    These are the coefficients that a step depends on. The paper's third drift stage has
    weight 0, its second and third noise stages are at the same point, and its other
    parameters belong to these. For $a_{21} = 0$ and $1/2$ the matrix $A^0$ is triangular;
    $\frac14 \pm \frac{\sqrt 3}{6}$ make it that of the Gauss method, of order 4 without
    noise.

    Weak order 2: in the paper for one noise, and measured for two and three. A Hamiltonian
    without the structure is refused while tracing.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.1.
    """

    a21: float = free_parameter("a21", 0.5)

    @property
    def tableau(self) -> SeparableTableau:
        return _srkw4(self.a21)

    def order(self, terms):
        gauss = abs(abs(self.a21 - 1 / 4) - np.sqrt(3) / 6) < 1e-14
        return 4 if gauss else 2

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2


SRKw4.__init__.__doc__ = f"""**Arguments:**

- `a21`: the free parameter, a Python float.
{ROOT_FINDER}
**Raises:** a `ValueError` if `a21` is not a finite real number.
"""
