from collections.abc import Callable

import diffrax
import equinox as eqx
import jax.numpy as jnp

from .._custom_types import RealScalarLike
from ._stepwise import Increment


class GivenPath(diffrax.AbstractBrownianPath):
    """A path whose increments come from elsewhere: that of the step from `t0` to `t1` is
    `make(t0, t1, use_levy)`."""

    make: Callable[[RealScalarLike, RealScalarLike | None, bool], Increment]
    levy_area: type = eqx.field(static=True)

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del left
        return self.make(t0, t1, use_levy)
