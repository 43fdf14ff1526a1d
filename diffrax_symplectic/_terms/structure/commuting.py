"""Whether noises commute, by their brackets at random states."""

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
    """Whether the brackets `Db_l b_k - Db_k b_l` of all noises vanish at random states, for
    these `t0` and `args`; false if this cannot be tested. This is not a proof.

    The bracket is bilinear, so it is tested for two random combinations of the noises.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))
    struct = [control_struct(term, t0) for term in noise]
    zeros, unravel = zeros_and_unravel((jtu.tree_map(jnp.asarray, y0), struct, struct))

    @eqx.filter_jit
    @jax.vmap
    def sizes(point: Float[Array, " n"]) -> tuple[Array, Array]:
        """The sizes of `Db_z b_x` and of the bracket `Db_z b_x - Db_x b_z`, at a state `y`
        and for the combinations `x` and `z` of the noises, which are parts of `point`."""
        y, x, z = unravel(point)
        b_x = ft.partial(apply, noise, x, args, t0)
        b_z = ft.partial(apply, noise, z, args, t0)
        _, Db_z_b_x = jax.jvp(b_z, (y,), (b_x(y),))
        _, Db_x_b_z = jax.jvp(b_x, (y,), (b_z(y),))
        return largest_entry(Db_z_b_x), largest_entry((Db_z_b_x**ω - Db_x_b_z**ω).ω)

    # Four with entries of either sign, and four with entries between 0 and 1, where most
    # functions are defined.
    shape = (4, zeros.size)
    of_either_sign = jr.normal(jr.key(0), shape, zeros.dtype)
    positive = jr.uniform(jr.key(0), shape, zeros.dtype)
    points = jnp.concatenate([of_either_sign, positive])
    try:
        with jax.disable_jit(False):
            # For each point the size of a summand of the bracket, and of the bracket.
            of_summand, of_bracket = sizes(points)
            # Points at which these are not finite tell nothing; one other has to remain.
            is_finite = jnp.isfinite(of_summand) & jnp.isfinite(of_bracket)
            # A bracket that cancels leaves rounding errors of its summands.
            eps = jnp.finfo(of_summand.dtype).eps
            is_small = of_bracket <= 1e3 * eps * of_summand
            commute = jax.block_until_ready(
                jnp.any(is_finite) & jnp.all(is_small | ~is_finite)
            )
    except RuntimeError:
        # A user's `equinox.error_if` may fail at states that the user did not choose.
        return False
    # Inside `jax.jit` the result is not known.
    return not is_traced(commute) and bool(commute)
