"""Values that are computed once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffrax_symplectic._batch import materialize


class _Printed(eqx.Module):
    """Counts how often it is printed. (JAX goes on if printing raises an error.)"""

    x: jax.Array
    prints: list = eqx.field(static=True)

    def doubled(self):
        return 2 * self.x

    def __repr__(self):
        self.prints.append(1)
        return "printed"


def test_what_a_bound_method_is_bound_to_is_not_printed():
    prints = []
    got = jax.jit(lambda x: materialize(_Printed(x, prints).doubled))(jnp.arange(3.0))
    np.testing.assert_array_equal(got, [0.0, 2.0, 4.0])
    assert prints == []
