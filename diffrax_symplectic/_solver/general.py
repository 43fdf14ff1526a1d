"""Solvers for any Hamiltonians: the midpoint rule, and methods of Wang, Hong and Xu."""

from typing import ClassVar

import numpy as np

from .._tableau import GeneralTableau
from .base import (
    AbstractImplicitStages,
    AbstractSymplecticRungeKutta,
    free_parameter,
)
from .record import Record


class ImplicitMidpoint(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The implicit midpoint rule for Stratonovich systems.

    $$G = y_n + \tfrac12 h\,a(G) + \tfrac12 \sum_k b_k(G) I_k, \qquad
      y_{n+1} = y_n + h\,a(G) + \sum_k b_k(G) I_k$$

    A step solves for one stage vector, for any number of noises. Strong order 1/2, or
    strong order 1 if there is one noise or the noises commute. Weak order 1.

    **Source:** [Milstein, Repin and Tretyakov
    (2002)](https://doi.org/10.1137/S0036142901395588).
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=(1, 1 / 2),
        choose="A good first choice: one stage vector for any number of noises.",
        stationary=("qq", "pq", "pp"),
        right_energy_unresolved=False,
    )
    tableau: ClassVar[GeneralTableau] = GeneralTableau.strong(
        A=[[1 / 2]], B=[[1 / 2]], alpha=[1], beta=[1]
    )


class SRKs1(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The two-stage symplectic methods SRKs1 of Wang, Hong and Xu.

    $$A = B = \begin{pmatrix} a & 0 \\ 2a & \tfrac12 - a \end{pmatrix}, \qquad
      \alpha = \beta = (2a,\; 1 - 2a)$$

    These are two steps of the midpoint rule, over the fractions $2a$ and $1 - 2a$ of the
    step and of its increment. The default $a = 1/4$ has the smallest strong errors: a
    quarter of the midpoint rule's error if the drift dominates it, but no gain if the noise
    does.

    Strong order 1/2, or strong order 1 if there is one noise or the noises commute. Weak
    order 1.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 2.2.
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=(1, 1 / 2),
        choose="Two midpoint substeps, for errors dominated by the drift.",
        right_energy_unresolved=False,
    )
    a: float = free_parameter("a", 0.25)

    @property
    def tableau(self) -> GeneralTableau:
        # Drift and noise have the same coefficients, so that each stage is one midpoint
        # evaluation of both.
        A = [[self.a, 0], [2 * self.a, 1 / 2 - self.a]]
        alpha = [2 * self.a, 1 - 2 * self.a]
        return GeneralTableau.strong(A=A, B=A, alpha=alpha, beta=alpha)


class SRKw1(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The one-stage symplectic methods SRKw1 of Wang, Hong and Xu, of weak order 1.

    $$G^0 = y_n + \tfrac12 h\,a(G^0) + b \sum_k b_k(G^1) \hat I_k, \qquad
      G^1 = y_n + (1 - b) h\,a(G^0) + \tfrac12 \sum_k b_k(G^1) \hat I_k$$

    $$y_{n+1} = y_n + h\,a(G^0) + \sum_k b_k(G^1) \hat I_k$$

    For the default $b = 1/2$, $G^0 = G^1$ and this is the midpoint rule, with one stage
    vector to solve for. For $b = 0$ and $b = 1$ it is a midpoint step of the drift followed
    by one of the noise, or vice versa: two small systems, solved one after the other. Any
    other value couples the two. Weak order 1 for any number of noises.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 2.1.
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=None,
        choose="The midpoint rule for expectations. Cheap, for low accuracy.",
        stationary=("qq", "pq", "pp"),
        right_energy_unresolved=False,
    )
    b: float = free_parameter("b", 0.5)

    @property
    def tableau(self) -> GeneralTableau:
        # Symplectic for any b: with one stage of each kind the conditions are
        # alpha^2 = 2 alpha A0, beta^2 = 2 beta B1 and alpha beta = alpha B0 + beta A1.
        return GeneralTableau(
            alpha=[1],
            beta=[1],
            A0=[[1 / 2]],
            B0=[[self.b]],
            A1=[[1 - self.b]],
            B1=[[1 / 2]],
        )


_ROOT3 = np.sqrt(3)
# The Gauss method with two stages, of order 4. Its times are the sums of the rows.
GAUSS = np.array([[1 / 4, 1 / 4 - _ROOT3 / 6], [1 / 4 + _ROOT3 / 6, 1 / 4]])


class SRKw2(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic method SRKw2 of Wang, Hong and Xu, of weak order 2 for one noise.

    It has four drift and two noise stages in the form of
    [`diffrax_symplectic.GeneralTableau`][], with the coefficients, for $r = \sqrt 3$,

    $$A^0 = \begin{pmatrix} \frac18 & & & \\ \frac14 & \frac18 & & \\
        \frac14 & \frac14 & \frac18 & \\ \frac14 & \frac14 & \frac14 & \frac18
      \end{pmatrix}, \quad
      B^0 = \begin{pmatrix} \frac56 - \frac r3 & -\frac12 \\ -\frac16 & \frac12 \\
        -\frac16 + \frac r3 & \frac12 \\ \frac12 & \frac12
      \end{pmatrix}, \quad \alpha = \begin{pmatrix} \frac14 \\ \frac14 \\ \frac14 \\
        \frac14 \end{pmatrix}$$

    $$A^1 = \begin{pmatrix} -\frac16 + \frac r6 & \frac13 & \frac13 - \frac r6 & 0 \\
        \frac12 & 0 & 0 & 0 \end{pmatrix}, \quad
      B^1 = \begin{pmatrix} \frac14 & \frac14 - \frac r6 \\
        \frac14 + \frac r6 & \frac14 \end{pmatrix}, \quad
      \beta = \begin{pmatrix} \frac12 \\ \frac12 \end{pmatrix}$$

    The paper's third and fourth noise stages, and its free parameters, have no effect. All
    conditions hold for any permutation of the rows of $B^0$ (and the columns of $A^1$).
    With this one, rows 1, 4, 2, 3 of the paper, a step solves for five stage vectors
    together and then for one; with the paper's, for six together. It has the smallest local
    weak error of all permutations, 4% below the paper's with strong noise.

    Weak order 2 for one noise or noises that commute; otherwise weak order 1.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 2.1.
    """

    record: ClassVar[Record] = Record(
        weak=(2, 1),
        strong=None,
        choose="Six stage vectors. `StrangGauss` is cheaper.",
        noises="commuting",
    )
    tableau: ClassVar[GeneralTableau] = GeneralTableau(
        alpha=np.full(4, 1 / 4),
        beta=[1 / 2, 1 / 2],
        # Four midpoint steps of a quarter each.
        A0=np.eye(4) / 8 + np.tril(np.full((4, 4), 1 / 4), -1),
        B0=[
            [5 / 6 - _ROOT3 / 3, -1 / 2],
            [-1 / 6, 1 / 2],
            [-1 / 6 + _ROOT3 / 3, 1 / 2],
            [1 / 2, 1 / 2],
        ],
        A1=[[-1 / 6 + _ROOT3 / 6, 1 / 3, 1 / 3 - _ROOT3 / 6, 0], [1 / 2, 0, 0, 0]],
        B1=GAUSS,
    )
