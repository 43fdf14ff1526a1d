"""The vector fields of a problem as functions of time, each as one vector."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._brownian import zeros_and_unravel
from .._custom_types import Args, Terms, Y
from .._programs import once_for_each_signature
from .._simulation import Problem
from .._terms import (
    apply,
    control_struct,
    Dependence,
    rate,
    split_terms,
    without_constraint,
)
from .linear_maps import arbitrary_direction


# The fractional parts of the multiples of this number fill the interval from 0 to 1 evenly,
# without a period that a drive might have, too.
_GOLDEN_RATIO = (1 + 5**0.5) / 2

# A vector field at a time and a state: a `jax.tree_util.Partial` of one of the functions
# below, so that the terms in it are arguments of programs.
Field = Callable[[Array, Y], Float[Array, " n"]]


def drift_rate(drift: Terms, args: Args, t: Array, y: Y) -> Float[Array, " n"]:
    """The rate of the state by the drift."""
    return jfu.ravel_pytree(rate(drift, t, y, args))[0]


def forces(drift: Terms, args: Args, t: Array, y: Y) -> Float[Array, " n"]:
    """The rate of the momenta by the drift."""
    force, _ = rate(drift, t, y, args)
    return jfu.ravel_pytree(force)[0]


def noise_change(noise: Terms, args: Args, t: Array, y: Y) -> Float[Array, " n"]:
    """The change of the state by noise, for arbitrary increments of about size one."""
    change, zeros = change_by_increments(noise, args, t)
    increments = arbitrary_direction(zeros.size, zeros.dtype)
    return jfu.ravel_pytree(change(y, increments))[0]


def change_by_increments(
    noise: Terms, args: Args, t: Any
) -> tuple[Callable[[Y, Array], Y], Float[Array, " m"]]:
    """The function from a state and the increments of the noise, as one vector, to the
    change of the state; and a vector of increments that are zero."""
    zeros, unravel = zeros_and_unravel([control_struct(term, t) for term in noise])

    def change(y: Y, increments: Float[Array, " m"]) -> Y:
        return apply(noise, unravel(increments), args, t, y)

    return change, zeros


def all_fields(problem: Problem) -> Field:
    """The rate of the drift with its friction, and the change by noise, as one field."""
    drift, noise = split_terms(without_constraint(problem.terms))
    return jtu.Partial(_all_fields, drift, noise, problem.args)


def _all_fields(
    drift: Terms, noise: Terms, args: Args, t: Array, y: Y
) -> Float[Array, " n"]:
    fields = []
    if drift:
        fields.append(drift_rate(drift, args, t, y))
    if noise:
        fields.append(noise_change(noise, args, t, y))
    return jnp.concatenate(fields)


@once_for_each_signature
def depends_on_time(field: Field, t0: Float[Array | np.ndarray, ""], y0: Y) -> bool:
    """Whether a field depends on time, by whether its program reads the time. (Its values
    at several times might be equal by chance.)"""
    dependence = Dependence(lambda t: field(t, y0), t0)
    return not dependence.independent(lambda t: t)


def at_both_states(
    field: Field, y0: Y
) -> Callable[[Float[Array, " times"]], Float[Array, "times n"]]:
    """A function of times that returns the values of the field at two states, joined to one
    vector for each time. The states are `y0`, and an arbitrary state about as far from `y0`
    as `y0` is from zero. (At `y0` alone a change may not show: in a trap that is stiffened,
    the force on a particle at its centre is always zero.)"""

    def with_moved(x: PyTree[Array]) -> Array:
        """An array of `y0`, and the array of the other state, along a leading axis."""
        x = jnp.asarray(x)
        largest = jnp.max(jnp.abs(x), initial=0)
        size = jnp.where(largest > 0, largest, 1)
        direction = arbitrary_direction(x.size, x.dtype)
        return jnp.stack([x, x + size * direction.reshape(x.shape)])

    both_states = jtu.tree_map(with_moved, y0)

    def at_both(t: Array) -> Float[Array, " n"]:
        return jax.vmap(field, in_axes=(None, 0))(t, both_states).reshape(-1)

    return jax.vmap(at_both)


def spread_evenly(number: int) -> Float[np.ndarray, " number"]:
    """This many points, spread evenly from 0 to 1, in no order. The first is 0."""
    return np.arange(number) * _GOLDEN_RATIO % 1
