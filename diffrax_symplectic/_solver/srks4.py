from typing import Any

import equinox as eqx
import numpy as np

from .._tableau import AdditiveTableau
from ._implicit import AbstractImplicitStages, ROOT_FINDER
from ._parameters import free_parameter, real_number
from .base import AbstractSymplecticRungeKutta


def _srks4(beta1: float, beta2: float, b: float, sign: int) -> AdditiveTableau:
    rows = 1 + sign / np.sqrt(2), 1 - sign / np.sqrt(2)
    B = np.array([[rows[0], 0], [rows[1] - b, b]])
    weights = beta2 * np.array([1, -1])
    # I_k0 / h = W / 2 + H, in the variables of Diffrax.
    return AdditiveTableau(
        alpha=[1 / 2, 1 / 2],
        beta={"W": np.array([beta1, 1 - beta1]) + weights / 2, "H": weights},
        A=[[1 / 4, 0], [1 / 2, 1 / 4]],
        B={"W": B / 2, "H": B},
        c1=[1 + (beta1 - 1) / beta2, 1 + beta1 / beta2],
    )


def _nonzero(value: Any) -> float:
    beta2 = real_number("beta2", value)
    if beta2 == 0:
        raise ValueError(
            "`beta2` must not be 0: the noise is read at the times 1 + (beta1 - 1) / "
            "beta2 and 1 + beta1 / beta2 of the step. The default is 1."
        )
    return beta2


def _sign(value: Any) -> int:
    if isinstance(value, bool) or value not in (-1, 1):
        raise ValueError(f"`sign` must be 1 or -1; got {value!r}.")
    return int(value)


class SRKs4(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic methods SRKs4 of Wang, Hong and Xu, of strong order 3/2 for any
    number of noises that do not depend on the state.

    For any $H_0$ and $H_k = -\sigma_k(t) \cdot q + \gamma_k(t) \cdot p$, or any
    $\mathrm{d}y = a(t, y)\,\mathrm{d}t + \sum_k b_k(t)\,\mathrm{d}w_k$. With
    $I_k = \int \mathrm{d}w_k$ and $I_{k0} = \int (w_k(s) - w_k(t_n))\,\mathrm{d}s$ over
    the step, the drift is read at $c^0 = (\frac14, \frac34)$, the noise at
    $c^1 = (1 + \frac{\beta_1 - 1}{\beta_2},\; 1 + \frac{\beta_1}{\beta_2})$, and

    $$G_1 = y_n + \tfrac h4 a(G_1) + \sum_k (1 + \tfrac{s}{\sqrt 2})\, b_k(c^1_1)
      \frac{I_{k0}}{h}$$

    $$G_2 = y_n + \tfrac h2 a(G_1) + \tfrac h4 a(G_2) + \sum_k \big( (1 -
      \tfrac{s}{\sqrt 2} - b)\, b_k(c^1_1) + b\, b_k(c^1_2) \big) \frac{I_{k0}}{h}$$

    $$y_{n+1} = y_n + \tfrac h2 (a(G_1) + a(G_2)) + \sum_k \Big( \big(\beta_1 I_k + \beta_2
      \tfrac{I_{k0}}{h}\big) b_k(c^1_1) + \big((1 - \beta_1) I_k - \beta_2
      \tfrac{I_{k0}}{h}\big) b_k(c^1_2) \Big).$$

    Two stage vectors are solved for, one after the other. If the noise is constant, only
    the sign $s$ matters. The paper has $s = +1$. The default here is $s = -1$: over six
    problems with two noises its strong error at $h = 1/16$ was half as large as for
    $s = +1$, and 0.7 times as large with weak noise. The conditions leave $\beta_1$,
    $\beta_2 \neq 0$ and $b$ free. They decide at which times the noise is evaluated: with
    the defaults $\beta_1 = b = 0$, $\beta_2 = 1$, at both ends of the step.

    Order 2 without noise. Noise without the structure is refused while tracing.

    !!! warning

        The path has to provide space-time Lévy area, from which $I_{k0}$ follows: for
        example `FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 4.1.
    """

    beta1: float = free_parameter("beta1", 0.0)
    beta2: float = eqx.field(default=1.0, static=True, converter=_nonzero)
    b: float = free_parameter("b", 0.0)
    sign: int = eqx.field(default=-1, static=True, converter=_sign)

    @property
    def tableau(self) -> AdditiveTableau:
        return _srks4(self.beta1, self.beta2, self.b, self.sign)

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return 1.5

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2


SRKs4.__init__.__doc__ = f"""**Arguments:**

- `beta1`, `beta2`, `b`: the free parameters, Python floats; `beta2` not 0.
- `sign`: the sign $s$, 1 or -1.
{ROOT_FINDER}
**Raises:** a `ValueError` if a parameter is not a finite real number, if `beta2` is 0, or
if `sign` is not 1 or -1. While tracing, if the path has no space-time Lévy area.
"""
