"""Structures that a user asserts, compared with the values of the terms at one state."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from ..._brownian import raveled
from ..._compat import is_traced
from ..._custom_types import Args, RealScalarLike, Y
from ..drift_and_noise import control_struct


# Random directions of the state and of the control. A derivative that is not zero vanishes
# along one of them with probability zero; the others are there for rounding errors.
_DIRECTIONS = 4


def contradicted(
    structure: str,
    is_noise: bool,
    term: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> bool:
    """Whether derivatives of a term at the state `y0` contradict its asserted structure.

    What is found is a proof, since rounding errors are far smaller than what counts. The
    converse does not hold: at other states the structure may be another. `False` if any
    value is traced, as in every program of a solve.
    """
    if any(map(is_traced, jtu.tree_leaves((term, t0, y0, args)))):
        return False
    t0 = jnp.asarray(t0, jnp.result_type(float))
    y0 = jtu.tree_map(jnp.asarray, y0)
    # Not eagerly, operation by operation, where the user debugs under `jax.disable_jit()`.
    with jax.disable_jit(False):
        found = _contradicts(structure, is_noise, term, t0, y0, args)
    # Traced, if these values are constants of a program of the user's.
    return not is_traced(found) and bool(found)


@eqx.filter_jit
def _contradicts(
    structure: str,
    is_noise: bool,
    term: diffrax.AbstractTerm,
    t0: Array,
    y0: Y,
    args: Args,
) -> Bool[Array, ""]:
    """Whether a derivative that the structure forbids is larger than rounding errors, along
    any of some random directions."""
    flat, unravel = raveled((y0, control_struct(term, t0)))
    # Between rounding errors, also of long sums, and any mistake of the user's. Times may
    # have more digits than the state.
    eps = float(jnp.finfo(jnp.result_type(*jtu.tree_leaves(y0))).eps)
    rounding = eps ** (2 / 3)

    def along(direction: Array) -> Bool[Array, ""]:
        (dp, dq), control = unravel(direction)
        zero = jtu.tree_map(jnp.zeros_like, dp)

        def change(t: Array, y: Y) -> Y:
            return term.vf_prod(t, y, args, control)

        def derivative(dt: Any, dy: Y) -> Y:
            tangents = (jnp.full_like(t0, dt), dy)
            return jax.jvp(change, (t0, y0), tangents)[1]

        value = change(t0, y0)
        by_p = derivative(0, (dp, zero))
        by_q = derivative(0, (zero, dq))
        by_t = derivative(1, (zero, zero))
        if structure == "additive":
            forbidden = by_p, by_q
        elif is_noise:
            # All changes of the position, and those of the momentum that depend on it.
            forbidden = value[1], by_p, by_q[1], by_t[1]
        else:
            # The mixed derivative of H0, and that of dH0/dp by the time.
            forbidden = by_p[0], by_q[1], by_t[1]
        everything = value, by_p, by_q, by_t
        # Values that are not finite compare as false: they tell nothing.
        return largest(forbidden) > rounding * largest(everything)

    directions = jr.normal(jr.key(0), (_DIRECTIONS, flat.size), flat.dtype)
    return jnp.any(jax.vmap(along)(directions))


def largest(tree: PyTree[Array]) -> Array:
    """The largest entry of all arrays, without its sign."""
    flat, _ = jfu.ravel_pytree(tree)
    return jnp.max(jnp.abs(flat))
