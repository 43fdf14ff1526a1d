"""The vector fields of a problem as functions of time, each as one vector."""

from collections.abc import Callable

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


# The fractional parts of its multiples fill the interval from 0 to 1 evenly, and fall into
# step with no period.
_GOLDEN_RATIO = (1 + 5**0.5) / 2

# A vector field at a time and a state. (A `jax.tree_util.Partial`, so that the terms in it
# are arguments of programs.)
Field = Callable[[Array, Y], Float[Array, " n"]]


def all_fields(problem: Problem, args: Args) -> Field:
    """The rate of the drift with its friction, and the change by noise."""
    drift, noise = split_terms(without_constraint(problem.terms))
    return jtu.Partial(_all_fields, drift, noise, args)


def drift_field(drift: Terms, args: Args) -> Field:
    """The rate of the state by the drift."""
    return jtu.Partial(_drift_field, drift, args)


def force_field(drift: Terms, args: Args) -> Field:
    """The rate of the momenta by the drift."""
    return jtu.Partial(_force_field, drift, args)


def noise_field(noise: Terms, args: Args) -> Field:
    """The change of the state by noise, for arbitrary increments of size one."""
    return jtu.Partial(_noise_field, noise, args)


def depends_on_time(field: Field, problem: Problem, y0: Y) -> bool:
    """Whether a field depends on time: whether its program reads the time. (Its values at
    several times might be equal by chance.)"""
    return _depends_on_time(field, jnp.asarray(problem.t0), y0)


@once_for_each_signature
def _depends_on_time(field: Field, t0: Array, y0: Y) -> bool:
    dependence = Dependence(lambda t: field(t, y0), t0)
    return not dependence.independent(lambda t: t)


def at_both_states(field: Field, y0: Y) -> Callable[[Array], Float[Array, " n"]]:
    """The function from a time to the field at two states, as one vector: at `y0`, and at
    an arbitrary state. (At `y0` alone a change may not show: in a trap that is stiffened,
    the force on a particle at its centre is always zero.)"""
    y0_and_moved = jtu.tree_map(lambda *leaves: jnp.stack(leaves), y0, _moved(y0))

    def at_both(t: Array) -> Float[Array, " n"]:
        return jax.vmap(field, in_axes=(None, 0))(t, y0_and_moved).reshape(-1)

    return at_both


def spread_evenly(number: int) -> Float[np.ndarray, " number"]:
    """So many points from 0 to 1, the first of which is 0. They are not in order."""
    return np.arange(number) * _GOLDEN_RATIO % 1


def _force_field(terms: Terms, args: Args, t: Array, y: Y) -> Float[Array, " n"]:
    force, _ = rate(terms, t, y, args)
    return jfu.ravel_pytree(force)[0]


def _drift_field(terms: Terms, args: Args, t: Array, y: Y) -> Float[Array, " n"]:
    return jfu.ravel_pytree(rate(terms, t, y, args))[0]


def _noise_field(terms: Terms, args: Args, t: Array, y: Y) -> Float[Array, " n"]:
    zeros, unravel = zeros_and_unravel([control_struct(term, t) for term in terms])
    controls = unravel(arbitrary_direction(zeros.size, zeros.dtype))
    return jfu.ravel_pytree(apply(terms, controls, args, t, y))[0]


def _all_fields(
    drift: Terms, noise: Terms, args: Args, t: Array, y: Y
) -> Float[Array, " n"]:
    fields = []
    if drift:
        fields.append(_drift_field(drift, args, t, y))
    if noise:
        fields.append(_noise_field(noise, args, t, y))
    return jnp.concatenate(fields)


def _moved(y0: Y) -> Y:
    """An arbitrary state, about as far from `y0` as `y0` is from zero."""

    def moved_leaf(x: PyTree[Array]) -> Array:
        x = jnp.asarray(x)
        largest = jnp.max(jnp.abs(x), initial=0)
        size = jnp.where(largest > 0, largest, 1)
        direction = arbitrary_direction(x.size, x.dtype)
        return x + size * direction.reshape(x.shape)

    return jtu.tree_map(moved_leaf, y0)
