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
    flat, unravel = zeros_and_unravel((jtu.tree_map(jnp.asarray, y0), struct, struct))

    @eqx.filter_jit
    @jax.vmap
    def sizes(point: Float[Array, " n"]) -> tuple[Array, Array]:
        """The sizes of `Db_x b_z` and of the bracket, at a state and two combinations."""
        y, x, z = unravel(point)
        along_x = ft.partial(apply, noise, x, args, t0)
        along_z = ft.partial(apply, noise, z, args, t0)
        _, first = jax.jvp(along_z, (y,), (along_x(y),))
        _, second = jax.jvp(along_x, (y,), (along_z(y),))
        return largest_entry(first), largest_entry((first**ω - second**ω).ω)

    try:
        with jax.disable_jit(False):
            size, bracket = sizes(_random_points(flat))
            finite = jnp.isfinite(size) & jnp.isfinite(bracket)
            # What is left of brackets that cancel are rounding errors of their summands.
            small = bracket <= 1e3 * jnp.finfo(size.dtype).eps * size
            found = jax.block_until_ready(jnp.any(finite) & jnp.all(small | ~finite))
    except RuntimeError:
        # From a user's `equinox.error_if`, at states that the user did not choose.
        return False
    # Inside `jax.jit` the result is not known.
    return not is_traced(found) and bool(found)


def _random_points(flat: Float[Array, " n"]) -> Float[Array, "8 n"]:
    """Four points of either sign, and four between 0 and 1, where most functions are
    defined."""
    shape = (4, *flat.shape)
    anywhere = jr.normal(jr.key(0), shape, flat.dtype)
    positive = jr.uniform(jr.key(0), shape, flat.dtype)
    return jnp.concatenate([anywhere, positive])
