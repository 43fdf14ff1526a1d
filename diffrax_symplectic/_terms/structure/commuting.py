"""Whether noises commute, tested by their Lie brackets at random states."""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ..._brownian import zeros_and_unravel
from ..._compat import is_traced, ω
from ..._custom_types import Args, RealScalarLike, Terms, Y
from ..drift_and_noise import control_struct
from ..vector_fields import apply
from .assertion import largest_entry


def noises_commute(noise: Terms, t0: RealScalarLike, y0: Y, args: Args) -> bool:
    """Whether the Lie brackets `Db_l b_k - Db_k b_l` of the vector fields of all noises
    vanish at some random states, for these `t0` and `args`. This is a test and not a proof.
    False if values are traced, or if no state can be tested.

    `Db_l` is the derivative of the vector field `b_l` by the state. The bracket is
    bilinear. So a single bracket, of two random linear combinations of the noises, tests
    all pairs of noises. At each of a few random states, this function

    1. computes the bracket of two random linear combinations;
    2. compares its largest entry with the rounding errors of its two summands.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))
    # A point holds a state, and the coefficients of two linear combinations of the noises,
    # each in the structure of the controls that multiply the noises.
    coefficients = [control_struct(term, t0) for term in noise]
    point_struct = (jtu.tree_map(jnp.asarray, y0), coefficients, coefficients)
    zeros, unravel = zeros_and_unravel(point_struct)

    @eqx.filter_jit
    @jax.vmap
    def sizes(point: Float[Array, " n"]) -> tuple[Array, Array]:
        """The sizes of `Db_z b_x` and of the bracket `Db_z b_x - Db_x b_z`, where `b_x` and
        `b_z` are the linear combinations with the coefficients `x` and `z`."""
        y, x, z = unravel(point)
        b_x = ft.partial(apply, noise, x, args, t0)
        b_z = ft.partial(apply, noise, z, args, t0)
        _, Db_z_b_x = jax.jvp(b_z, (y,), (b_x(y),))
        _, Db_x_b_z = jax.jvp(b_x, (y,), (b_z(y),))
        return largest_entry(Db_z_b_x), largest_entry((Db_z_b_x**ω - Db_x_b_z**ω).ω)

    # Half of the points have entries of either sign. The others have entries between 0 and
    # 1, since roots and logarithms are not defined for negative numbers.
    shape = (4, zeros.size)
    of_either_sign = jr.normal(jr.key(0), shape, zeros.dtype)
    positive = jr.uniform(jr.key(0), shape, zeros.dtype)
    points = jnp.concatenate([of_either_sign, positive])
    try:
        # Always compiled, even if the user debugs under `jax.disable_jit()`: operation by
        # operation this would be slow.
        with jax.disable_jit(False):
            size_of_summand, size_of_bracket = sizes(points)
            # Points at which the sizes are not finite do not count.
            is_finite = jnp.isfinite(size_of_summand) & jnp.isfinite(size_of_bracket)
            # A bracket that is zero is computed as a rounding error of its two summands,
            # which then have the same size.
            eps = jnp.finfo(size_of_summand.dtype).eps
            is_zero = size_of_bracket <= 1e3 * eps * size_of_summand
            commute = jnp.any(is_finite) & jnp.all(is_zero | ~is_finite)
            # An error while the program runs is raised here at the latest.
            commute = jax.block_until_ready(commute)
    except RuntimeError:
        # A user's `equinox.error_if` may fail at states that the user did not choose.
        return False
    # Within a `jax.jit` of the user's the result is traced.
    return not is_traced(commute) and bool(commute)
