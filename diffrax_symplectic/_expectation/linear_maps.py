"""The direction that a linear map enlarges most, by power iteration, and directions without
symmetries."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class Growth(NamedTuple):
    """What becomes of a direction `x` to which a linear map `A` is applied repeatedly.

    - `direction`: the direction after the last application, scaled to length one.
    - `log_growth`: the logarithm of the factor by which one application changes the length,
        averaged over the second half of them.
    - `rayleigh_quotient`: `x @ A(x)` for the direction `x` before the last application, of
        length one. For a symmetric map this is the eigenvalue of largest size. It is
        negative if the map turns the direction around.
    """

    direction: Float[Array, "*times n"]
    log_growth: Float[Array, "*times"]
    rayleigh_quotient: Float[Array, "*times"]


def largest_growth(
    linear: Callable[[Array], Array], like: Float[Array, " n"], iterations: int
) -> Growth:
    """The growth of the direction that a linear map enlarges most, by power iteration: this
    many applications of the map find the direction, and as many more measure its growth."""

    def after_map(number: Array, before: Growth) -> Growth:
        mapped = linear(before.direction)
        # Before the map the length is one, so this is the factor by which it grows.
        length = jnp.linalg.norm(mapped)
        counted_log = jnp.where(number < iterations, 0.0, jnp.log(length))
        log_growth = before.log_growth + counted_log / iterations
        rayleigh_quotient = before.direction @ mapped
        # The map may be zero, as without a drift between two pulses.
        scaled = jnp.where(length > 0, mapped / length, before.direction)
        return Growth(scaled, log_growth, rayleigh_quotient)

    # It is a sum of all eigenvectors. The one that grows most outgrows the others.
    direction = arbitrary_direction(like.size, like.dtype)
    zero = jnp.zeros((), like.dtype)
    start = Growth(direction / jnp.linalg.norm(direction), zero, zero)
    return lax.fori_loop(0, 2 * iterations, after_map, start)


def derivative_at(
    fn: Callable[[Array], Array], x: Float[Array, " n"]
) -> Callable[[Array], Array]:
    """The derivative of a function at `x`, as a linear map of changes of `x`."""

    def derivative(change: Array) -> Array:
        return jax.jvp(fn, (x,), (change,))[1]

    return derivative


def arbitrary_direction(size: int, dtype: Any) -> Float[Array, " size"]:
    """A direction without the symmetries that a problem may have."""
    return jnp.cos(1.0 + jnp.arange(size, dtype=dtype))
