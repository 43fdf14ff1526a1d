"""Loops that all paths of a batch run through together."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


@jax.custom_batching.custom_vmap
def any_of_batch(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether `flag` holds for any path of a batch: one answer for all of them. As the
    condition of a loop it leaves what is the same for all paths the same, and the body
    selects which paths it changes."""
    return flag


@any_of_batch.def_vmap
def _any_of_axis(size, in_batched, flag):
    del size
    return any_of_batch(jnp.any(flag, 0) if in_batched[0] else flag), False
