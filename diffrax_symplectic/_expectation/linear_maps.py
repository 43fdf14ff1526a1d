"""What a linear map does most, by power iteration, and directions without symmetries."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class Growth(NamedTuple):
    """How a linear map enlarges a change, applied to it again and again.

    - `change`: the change, scaled to length one.
    - `log_growth`: the logarithm of the factor by which it grew each time, in the mean over
        the times that count.
    - `along_itself`: the scalar product of the change after the last time with the one
        before it, of length one: the eigenvalue of largest size, if the map is symmetric.
        It is negative if the map turned the change around.
    """

    change: Float[Array, "*times n"]
    log_growth: Float[Array, "*times"]
    along_itself: Float[Array, "*times"]


def largest_growth(
    linear: Callable[[Array], Array], like: Float[Array, " n"], iterations: int
) -> Growth:
    """The growth of the change that a linear map enlarges most, by power iteration: after
    this many applications of the map, over as many more."""

    def after_map(number: Array, before: Growth) -> Growth:
        change = linear(before.change)
        # The change before the map has length one, so this is its growth.
        length = jnp.linalg.norm(change)
        counted_log = jnp.where(number < iterations, 0.0, jnp.log(length))
        log_growth = before.log_growth + counted_log / iterations
        along_itself = before.change @ change
        # Without a drift, as between two pulses, nothing is left of a change.
        scaled = jnp.where(length > 0, change / length, before.change)
        return Growth(scaled, log_growth, along_itself)

    # It contains the direction that grows most.
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
