from typing import get_args, Literal, TypeAlias

import equinox as eqx
import numpy as np

from .._tableau import SeparableTableau
from ._implicit import AbstractImplicitStages, ROOT_FINDER
from .base import AbstractSymplecticRungeKutta


Variant: TypeAlias = Literal["a", "b", "c", "d", "e", "f"]

# variant: (beta, A1, B0)
_coefficients = {
    "a": (1, 1 / 2, 1 / 2),
    "b": (1, 1, 0),
    "c": (1, 0, 1),
    "d": (-1, 1 / 2, -1 / 2),
    "e": (-1, 1, 0),
    "f": (-1, 0, -1),
}


def _srkw3(variant: Variant) -> SeparableTableau:
    beta, A1, B0 = _coefficients[variant]
    half = np.array([[0.5]])
    return SeparableTableau(alpha=[1], beta=[beta], A0=half, B0=[[B0]], A1=[[A1]])


class SRKw3(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The one-stage symplectic methods SRKw3a to SRKw3f of Wang, Hong and Xu, of weak
    order 1, for $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    In the form of [`diffrax_symplectic.SeparableTableau`][], $\alpha = 1$,
    $A^0 = 1/2$, and

    | | a | b | c | d | e | f |
    |---|---|---|---|---|---|---|
    | $\beta$ | 1 | 1 | 1 | -1 | -1 | -1 |
    | $A^1$ | 1/2 | 1 | 0 | 1/2 | 1 | 0 |
    | $B^0$ | 1/2 | 0 | 1 | -1/2 | 0 | -1 |

    `"a"` is the midpoint rule; `"b"` a midpoint step of the drift, then a kick by the
    noise; `"c"`, the default, a kick, then a midpoint step. Kicks are explicit. `"d"`,
    `"e"` and `"f"` are these with the increments negated, which have the same law.

    Weak order 1 for any number of noises. Order 2 without noise. A Hamiltonian without
    the structure is refused while tracing.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.1.
    """

    variant: Variant = eqx.field(default="c", static=True)

    def __check_init__(self):
        if self.variant not in get_args(Variant):
            raise ValueError(
                f"`variant` must be one of {get_args(Variant)}; got {self.variant!r}."
            )

    @property
    def tableau(self) -> SeparableTableau:
        return _srkw3(self.variant)

    def order(self, terms):
        return 2

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 1


SRKw3.__init__.__doc__ = f"""**Arguments:**

- `variant`: one of `"a"` to `"f"`.
{ROOT_FINDER}
**Raises:** a `ValueError` if `variant` is not one of these letters.
"""
