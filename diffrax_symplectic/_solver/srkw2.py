from typing import ClassVar

import numpy as np
import optimistix as optx
from diffrax import AbstractImplicitSolver

from .._root_finder import PicardNewton
from .._tableau import GeneralTableau
from ._terms import number_of_noises
from .base import AbstractSymplecticRungeKutta


_r = np.sqrt(3.0)


def _srkw2(b1: float = 0.0, b2: float = 0.0, b3: float = 0.0) -> GeneralTableau:
    """The paper's tableau. The third and fourth noise stage, and so `b1`, `b2` and `b3`,
    feed nothing."""
    return GeneralTableau(
        alpha=[1 / 4, 1 / 4, 1 / 4, 1 / 4],
        beta=[1 / 2, 1 / 2, 0, 0],
        A0=[
            [1 / 8, 0, 0, 0],
            [1 / 4, 1 / 8, 0, 0],
            [1 / 4, 1 / 4, 1 / 8, 0],
            [1 / 4, 1 / 4, 1 / 4, 1 / 8],
        ],
        B0=[
            [5 / 6 - _r / 3, -1 / 2, 0, 0],
            [-1 / 6 + _r / 3, 1 / 2, 0, 0],
            [1 / 2, 1 / 2, 0, 0],
            [-1 / 6, 1 / 2, 0, 0],
        ],
        A1=[
            [-1 / 6 + _r / 6, 1 / 3 - _r / 6, 0, 1 / 3],
            [1 / 2, 0, 0, 0],
            [0, 0, 0, 0],
            [0, 0, 0, 0],
        ],
        B1=[
            [1 / 4, 1 / 4 - _r / 6, 0, 0],
            [1 / 4 + _r / 6, 1 / 4, 0, 0],
            [b1, b2, 0, b3],
            [0, -1 / 2, 0, 0],
        ],
    )


class SRKw2(AbstractSymplecticRungeKutta, AbstractImplicitSolver):
    r"""The symplectic method SRKw2 of Wang, Hong and Xu, of weak order 2 for one noise.

    Four drift and two noise stages in the form of
    [`diffrax_symplectic.GeneralTableau`][], with the coefficients, for $r = \sqrt 3$,

    $$A^0 = \begin{pmatrix} \frac18 & & & \\ \frac14 & \frac18 & & \\
        \frac14 & \frac14 & \frac18 & \\ \frac14 & \frac14 & \frac14 & \frac18
      \end{pmatrix}, \quad
      B^0 = \begin{pmatrix} \frac56 - \frac r3 & -\frac12 \\
        -\frac16 + \frac r3 & \frac12 \\ \frac12 & \frac12 \\ -\frac16 & \frac12
      \end{pmatrix}, \quad \alpha = \begin{pmatrix} \frac14 \\ \frac14 \\ \frac14 \\
        \frac14 \end{pmatrix}$$

    $$A^1 = \begin{pmatrix} -\frac16 + \frac r6 & \frac13 - \frac r6 & 0 & \frac13 \\
        \frac12 & 0 & 0 & 0 \end{pmatrix}, \quad
      B^1 = \begin{pmatrix} \frac14 & \frac14 - \frac r6 \\
        \frac14 + \frac r6 & \frac14 \end{pmatrix}, \quad
      \beta = \begin{pmatrix} \frac12 \\ \frac12 \end{pmatrix}$$

    The paper's third and fourth noise stage, and with them its free parameters, feed
    nothing. The six stage vectors are solved for together.

    Symplectic for any Hamiltonians, and conserves every quadratic invariant. Weak order
    2 for one noise; weak order 1 for several, for which $B^3 = B^1$ keeps it symplectic.
    Order 2 without noise.

    Use with [`diffrax_symplectic.WeakBrownianPath`][].

    ??? cite "Reference"

        Section 2.1 of

        ```bibtex
        @article{wang2017construction,
            author = {Wang, Peng and Hong, Jialin and Xu, Dongsheng},
            title = {Construction of Symplectic Runge-Kutta Methods for Stochastic
                     Hamiltonian Systems},
            journal = {Communications in Computational Physics},
            volume = {21},
            number = {1},
            pages = {237--270},
            year = {2017},
            doi = {10.4208/cicp.261014.230616a},
        }
        ```
    """

    root_finder: optx.AbstractRootFinder = PicardNewton()
    root_find_max_steps: int = 20

    tableau: ClassVar[GeneralTableau] = _srkw2()

    def order(self, terms):
        del terms
        return 2

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2 if number_of_noises(terms) <= 1 else 1


SRKw2.__init__.__doc__ = """**Arguments:**

- `root_finder`: any Optimistix root finder for the stage equations.
- `root_find_max_steps`: the most iterations it may take in one step.
"""
