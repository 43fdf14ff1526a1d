"""Power iteration: what becomes of a vector to which a linear map is applied again and
again. The maps are derivatives of vector fields."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._custom_types import Y


# This many applications of power iteration find the direction of the largest frequency, and
# as many more measure the frequency.
_ITERATIONS_FOR_FREQUENCY = 15


def linearized(
    field: Callable[[Any, Y], PyTree[Array]], t: Any, y0: Y
) -> tuple[Callable[[Array], Array], Float[Array, " n"]]:
    """The derivative of `field(t, y)` by the state at `y0`, as a linear map of vectors, and
    `y0` as a vector."""
    flat_y0, unravel = jfu.ravel_pytree(y0)

    def flat_field(x: Array) -> Array:
        return jfu.ravel_pytree(field(t, unravel(x)))[0]

    def derivative(change: Array) -> Array:
        return jax.jvp(flat_field, (flat_y0,), (change,))[1]

    return derivative, flat_y0


class Growth(NamedTuple):
    """What becomes of a direction `x` to which a linear map `A` is applied repeatedly.

    - `direction`: the direction after the last application, scaled to length one.
    - `log_growth`: the logarithm of the factor by which one application changes the length,
        averaged over the second half of the applications.
    - `rayleigh_quotient`: `x @ A(x)` for the direction `x` before the last application,
        scaled to length one. It is negative if the map turns the direction around. For a
        symmetric map it is the eigenvalue of largest size.
    """

    direction: Float[Array, "*times n"]
    log_growth: Float[Array, "*times"]
    rayleigh_quotient: Float[Array, "*times"]


def largest_growth(
    linear: Callable[[Array], Array], like: Float[Array, " n"], iterations: int
) -> Growth:
    """The growth of the direction that a linear map enlarges most, by power iteration:
    `iterations` applications of the map find the direction, and as many more measure its
    growth. `like` is any vector that the map takes."""

    def after_map(iteration: Array, before: Growth) -> Growth:
        mapped = linear(before.direction)
        # The direction has length one, so this is the factor by which the length grows.
        length = jnp.linalg.norm(mapped)
        # The first half of the applications does not count.
        counted_log = jnp.where(iteration < iterations, 0.0, jnp.log(length))
        log_growth = before.log_growth + counted_log / iterations
        rayleigh_quotient = before.direction @ mapped
        # The map may be zero, as without a drift between two pulses. The direction then
        # stays the same.
        scaled = jnp.where(length > 0, mapped / length, before.direction)
        return Growth(scaled, log_growth, rayleigh_quotient)

    # This direction is a sum of all eigenvectors. The one that grows most outgrows the
    # others.
    direction = arbitrary_direction(like.size, like.dtype)
    zero = jnp.zeros((), like.dtype)
    start = Growth(direction / jnp.linalg.norm(direction), zero, zero)
    return lax.fori_loop(0, 2 * iterations, after_map, start)


def largest_frequency(
    field: Callable[[Any, Y], PyTree[Array]], t: Any, y0: Y
) -> Float[Array, ""]:
    """The largest angular frequency of the equation `dy/dt = field(t, y)` near `y0`; zero
    where growth without oscillation is faster."""
    derivative, flat_y0 = linearized(field, t, y0)

    # The derivative has the eigenvalues i omega and -i omega for an oscillation, with which
    # power iteration does not converge. Applied twice, it multiplies every direction in the
    # plane of the oscillation by -omega^2.
    def derivative_twice(change: Array) -> Array:
        # A loop, so that the derivative is compiled once.
        return lax.fori_loop(0, 2, lambda _, change: derivative(change), change)

    growth = largest_growth(derivative_twice, flat_y0, _ITERATIONS_FOR_FREQUENCY)
    oscillates = growth.rayleigh_quotient < 0
    # Each application multiplies by omega^2, so omega is the root of the growth.
    return jnp.where(oscillates, jnp.exp(growth.log_growth / 2), 0)


def arbitrary_direction(size: int, dtype: Any) -> Float[Array, " size"]:
    """A direction without the symmetries that a problem may have."""
    return jnp.cos(1.0 + jnp.arange(size, dtype=dtype))
