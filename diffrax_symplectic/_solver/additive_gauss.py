from typing import ClassVar

import numpy as np

from .._tableau import AdditiveTableau
from ._implicit import AbstractImplicitStages, ARGUMENTS
from .base import AbstractSymplecticRungeKutta


_r = np.sqrt(3.0)
_s = np.sqrt(1 / 6)
_tab = AdditiveTableau(
    alpha=[1 / 2, 1 / 2],
    beta={"W": [1]},
    A=[[1 / 4, 1 / 4 - _r / 6], [1 / 4 + _r / 6, 1 / 4]],
    B={
        "W": [[1 / 2 - _r / 6], [1 / 2 + _r / 6]],
        "second": [[_s], [0]],
        "third": [[0], [_s]],
    },
    c1=[0],
    constant=True,
)


class AdditiveGauss(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""A symplectic method of weak order 3 for any number of noises that depend neither on
    the state nor on time: the Gauss method of two stages, with three random variables for
    each noise.

    For any $H_0$ and $H_k = -\sigma_k \cdot q + \gamma_k \cdot p$, or any
    $\mathrm{d}y = a(t, y)\,\mathrm{d}t + \sum_k b_k\,\mathrm{d}w_k$ with constant $b_k$,
    and with $A$, $\alpha$ and $c$ those of the Gauss method,

    $$G_i = y_n + h \sum_j A_{ij} a(t_n + c_j h, G_j) + \sum_k b_k \xi_{ki}, \qquad
      \xi_{ki} = c_i \hat W_k + \sqrt{\tfrac16}\, \eta_{ki}$$

    $$y_{n+1} = y_n + h \sum_i \alpha_i a(t_n + c_i h, G_i) + \sum_k b_k \hat W_k$$

    where $\hat W_k$ is the four-point variable with seven moments of $\mathcal N(0, h)$ and
    $\eta_{k1}$, $\eta_{k2}$ are independent three-point variables of variance $h$. The
    variances $c_i^2 h + h / 6 = c_i h$ of $\xi_{ki}$ are those of the Brownian motion at
    the time $c_i h$, since $c_i - c_i^2 = 1/6$.

    Order 4 without noise. Noise without the structure is refused while tracing. Wang,
    Hong and Xu (2017) report that they found no symplectic method of weak order 3 with
    fewer than seven stages (remark 4.2).

    !!! warning

        The path has to be `WeakBrownianPath(..., order=3)`.

    **Source:** [Debrabant (2010)](https://doi.org/10.1007/s10543-010-0276-2) for the
    conditions.
    """

    tableau: ClassVar[AdditiveTableau] = _tab

    def order(self, terms):
        return 4

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 3


AdditiveGauss.__init__.__doc__ = ARGUMENTS
