"""Solvers for any H0 and noise that does not depend on the state."""

from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from .._tableau import AdditiveTableau
from .base import (
    AbstractImplicitStages,
    AbstractSymplecticRungeKutta,
    free_parameter,
    real_number,
)
from .general import GAUSS
from .record import Record


def _checked_beta2(value: Any) -> float:
    """`beta2` as a float. Raises a `ValueError` unless it is a finite real number other
    than zero."""
    beta2 = real_number("beta2", value)
    if beta2 == 0:
        raise ValueError(
            "`beta2` must not be 0: the noise is evaluated at the fractions 1 + (beta1 - "
            "1) / beta2 and 1 + beta1 / beta2 of the step. The default is 1."
        )
    return beta2


def _checked_sign(value: Any) -> int:
    """`sign` as an integer. Raises a `ValueError` unless it is 1 or -1."""
    # `True == 1`, but a boolean says nothing about a sign.
    if isinstance(value, bool) or value not in (-1, 1):
        raise ValueError(f"`sign` must be 1 or -1; got {value!r}.")
    return int(value)


class SRKs4(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic methods SRKs4 of Wang, Hong and Xu, of strong order 3/2 for any
    number of noises that do not depend on the state.

    For any $H_0$ and $H_k = -\sigma_k(t) \cdot q + \gamma_k(t) \cdot p$, or any
    $\mathrm{d}y = a(t, y)\,\mathrm{d}t + \sum_k b_k(t)\,\mathrm{d}w_k$. With
    $I_k = \int \mathrm{d}w_k$ and $I_{k0} = \int (w_k(s) - w_k(t_n))\,\mathrm{d}s$ over
    the step, the drift is evaluated at $c^0 = (\frac14, \frac34)$, the noise at
    $c^1 = (1 + \frac{\beta_1 - 1}{\beta_2},\; 1 + \frac{\beta_1}{\beta_2})$, and

    $$G_1 = y_n + \tfrac h4 a(G_1) + \sum_k (1 + \tfrac{s}{\sqrt 2})\, b_k(c^1_1)
      \frac{I_{k0}}{h}$$

    $$G_2 = y_n + \tfrac h2 a(G_1) + \tfrac h4 a(G_2) + \sum_k \big( (1 -
      \tfrac{s}{\sqrt 2} - b)\, b_k(c^1_1) + b\, b_k(c^1_2) \big) \frac{I_{k0}}{h}$$

    $$y_{n+1} = y_n + \tfrac h2 (a(G_1) + a(G_2)) + \sum_k \Big( \big(\beta_1 I_k + \beta_2
      \tfrac{I_{k0}}{h}\big) b_k(c^1_1) + \big((1 - \beta_1) I_k - \beta_2
      \tfrac{I_{k0}}{h}\big) b_k(c^1_2) \Big).$$

    A step solves for two stage vectors, one after the other. If the noise is constant, only
    `sign`, the sign $s = \pm 1$, matters. The paper has $s = +1$. The default here is
    $s = -1$: in six problems with two noises its strong error at $h = 1/16$ was half as
    large as for $s = +1$, or 0.7 times as large with weak noise. The parameters $\beta_1$,
    $\beta_2 \neq 0$ and $b$ determine the times at which the noise is evaluated: with the
    defaults $\beta_1 = b = 0$, $\beta_2 = 1$, at both ends of the step.

    Strong order 3/2 and weak order 2. The path needs space-time Lévy area, which determines
    $I_{k0}$.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 4.1.
    """

    record: ClassVar[Record] = Record(
        weak=2,
        strong=3 / 2,
        choose="Accurate paths; the noise may depend on time. Two stage vectors, one after "
        "the other.",
        right_energy_unresolved=True,
        most_friction=1.0,
    )
    beta1: float = free_parameter("beta1", 0.0)
    beta2: float = eqx.field(default=1.0, static=True, converter=_checked_beta2)
    b: float = free_parameter("b", 0.0)
    sign: int = eqx.field(default=-1, static=True, converter=_checked_sign)

    @property
    def tableau(self) -> AdditiveTableau:
        # In the stages, `factor * I_k0 / h` replaces the Brownian motion, whose variance in
        # the mean over the step is h / 2. I_k0 / h has the variance h / 3. So the mean of
        # both squared factors is 3 / 2.
        first_factor = 1 + self.sign / np.sqrt(2)
        second_factor = 1 - self.sign / np.sqrt(2)
        # The coefficients of I_k and I_k0 / h in the formulas above.
        B_of_I_k0 = np.array([[first_factor, 0], [second_factor - self.b, self.b]])
        beta_of_I_k = np.array([self.beta1, 1 - self.beta1])
        beta_of_I_k0 = np.array([self.beta2, -self.beta2])
        # In Diffrax's variables, I_k = W and I_k0 / h = W / 2 + H.
        return AdditiveTableau(
            alpha=[1 / 2, 1 / 2],
            beta={"W": beta_of_I_k + beta_of_I_k0 / 2, "H": beta_of_I_k0},
            A=[[1 / 4, 0], [1 / 2, 1 / 4]],
            B={"W": B_of_I_k0 / 2, "H": B_of_I_k0},
            c1=[1 + (self.beta1 - 1) / self.beta2, 1 + self.beta1 / self.beta2],
        )


class SRKw5(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic method SRKw5 of Wang, Hong and Xu, of weak order 2 for any number of
    noises that depend neither on the state nor on time.

    For any $H_0$ and $H_k = -\sigma_k \cdot q + \gamma_k \cdot p$, or any
    $\mathrm{d}y = a(t, y)\,\mathrm{d}t + \sum_k b_k\,\mathrm{d}w_k$ with constant $b_k$,

    $$G = y_n + \frac h2 a(t_n + \tfrac h2, G)
      + \sum_k b_k \frac{\hat I_k + \hat I_{k+m}}{2}, \qquad
      y_{n+1} = y_n + h\, a(t_n + \tfrac h2, G) + \sum_k b_k \hat I_k.$$

    A step solves for one stage vector, as in the midpoint rule. Order 2 needs the second,
    independent variable $\hat I_{k+m}$, from `WeakBrownianPath(..., second=True)`.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 4.2.
    """

    record: ClassVar[Record] = Record(
        weak=2,
        strong=None,
        choose="As cheap as the midpoint rule, for low accuracy.",
        right_energy_unresolved=True,
        most_friction=0.5,
    )
    tableau: ClassVar[AdditiveTableau] = AdditiveTableau(
        alpha=[1],
        beta={"W": [1]},
        A=[[1 / 2]],
        B={"W": [[1 / 2]], "second": [[1 / 2]]},
        c1=[0],
        constant=True,
    )


# The coefficient of the variables eta in the stages of `AdditiveGauss`.
_ETA = np.sqrt(1 / 6)


class AdditiveGauss(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""A symplectic method of weak order 3 for any number of noises that depend neither on
    the state nor on time: the Gauss method of two stages, with three random variables for
    each noise.

    For any $H_0$ and $H_k = -\sigma_k \cdot q + \gamma_k \cdot p$, or any
    $\mathrm{d}y = a(t, y)\,\mathrm{d}t + \sum_k b_k\,\mathrm{d}w_k$ with constant $b_k$,
    and with $A$, $\alpha$ and $c$ of the Gauss method,

    $$G_i = y_n + h \sum_j A_{ij} a(t_n + c_j h, G_j) + \sum_k b_k \xi_{ki}, \qquad
      \xi_{ki} = c_i \hat W_k + \sqrt{\tfrac16}\, \eta_{ki}$$

    $$y_{n+1} = y_n + h \sum_i \alpha_i a(t_n + c_i h, G_i) + \sum_k b_k \hat W_k$$

    where $\hat W_k$ is the four-point variable with seven moments of $\mathcal N(0, h)$ and
    $\eta_{k1}$, $\eta_{k2}$ are independent three-point variables of variance $h$, from
    `WeakBrownianPath(..., order=3)`. Since $c_i - c_i^2 = 1/6$, $\xi_{ki}$ has the variance
    $c_i^2 h + h / 6 = c_i h$ of Brownian motion at time $c_i h$.

    Wang, Hong and Xu (2017) found no symplectic method of weak order 3 with fewer than
    seven stages (remark 4.2).

    **Source:** [Debrabant (2010)](https://doi.org/10.1007/s10543-010-0276-2) for the
    conditions.
    """

    record: ClassVar[Record] = Record(
        weak=3,
        strong=None,
        choose="The smallest errors by far for constant noise; two stage vectors. Not for "
        "long steps, omega h > 1, for stationary laws of linear systems (the midpoint rule "
        "has them exactly), or for `ValueFunctions` in strongly nonlinear systems (36 "
        "outcomes per step).",
        right_energy_unresolved=True,
        most_friction=2.0,
    )
    tableau: ClassVar[AdditiveTableau] = AdditiveTableau(
        alpha=[1 / 2, 1 / 2],
        beta={"W": [1]},
        A=GAUSS,
        B={
            "W": GAUSS.sum(axis=1, keepdims=True),
            # Each stage has a variable of its own, so that stages correlate through `W`.
            "second": [[_ETA], [0]],
            "third": [[0], [_ETA]],
        },
        c1=[0],
        constant=True,
    )
