"""Structures that a user asserts, compared with derivatives of the terms at the start and
near it."""

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from ..._brownian import zeros_and_unravel
from ..._compat import is_traced
from ..._custom_types import Args, RealScalarLike, Y
from ..drift_and_noise import control_struct
from ..symplectic_gradients import AssertedStructure


# The number of random directions of the state and of the control. A derivative that is not
# zero vanishes along a random direction with probability zero, but it may be as small as
# rounding errors. Hence several directions.
_NUM_DIRECTIONS = 4
# Derivatives are also taken at this distance from the start, relative to the largest number
# of the state, since a forbidden derivative may vanish at the start alone.
_RELATIVE_DISTANCE = 1e-3


def contradicts_assertion(
    term: diffrax.AbstractTerm,
    structure: AssertedStructure,
    is_noise: bool,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> bool:
    """Whether derivatives of a term at the state `y0`, or near it, contradict its asserted
    structure.

    If true, the assertion is wrong: rounding errors are far smaller than what counts as a
    contradiction. If false, the term may have another structure at other states. Always
    false if any value is traced, as in every program of a solve.
    """
    if any(map(is_traced, jtu.tree_leaves((term, t0, y0, args)))):
        return False
    t0 = jnp.asarray(t0, jnp.result_type(float))
    y0 = jtu.tree_map(jnp.asarray, y0)
    # Always compiled, even if the user debugs under `jax.disable_jit()`: operation by
    # operation this would be slow.
    with jax.disable_jit(False):
        is_broken = _breaks_structure(term, structure, is_noise, t0, y0, args)
    # Within a `jax.jit` of the user's the result is traced, even if no input is.
    return not is_traced(is_broken) and bool(is_broken)


@eqx.filter_jit
def _breaks_structure(
    term: diffrax.AbstractTerm,
    structure: AssertedStructure,
    is_noise: bool,
    t0: Array,
    y0: Y,
    args: Args,
) -> Bool[Array, ""]:
    """Whether a value or derivative that the structure forbids is larger than rounding
    errors, for any of some random directions of the state and controls, at `y0` or at a
    state nearby.

    The change of the state by the term, its vector field times a control, is (dp, dq). The
    structures forbid:

    - "additive": derivatives of dp and dq by p and q;
    - "separable", for noise: dq with all its derivatives, and derivatives of dp by p;
    - "separable", for a drift: derivatives of dp by p, and of dq by q and t.
    """
    zeros, unravel = zeros_and_unravel((y0, control_struct(term, t0)))
    # What counts as larger than rounding errors, as a fraction of the largest value or
    # derivative. The threshold lies above the errors of long sums, and below what a mistake
    # gives. `eps` is that of the dtype of the state, since times may have more digits.
    eps = float(jnp.finfo(jnp.result_type(*jtu.tree_leaves(y0))).eps)
    threshold = eps ** (2 / 3)

    # The distance of the state nearby, in each direction.
    largest = largest_entry(y0)
    distance = _RELATIVE_DISTANCE * jnp.where(largest > 0, largest, 1)

    def is_broken_at(y: Y, dy: Y, control: PyTree[Array]) -> Bool[Array, ""]:
        # `dp_by_q` is the derivative of dp along the direction `along_q`, and so on.
        along_p, along_q = dy
        zero = jtu.tree_map(jnp.zeros_like, along_p)

        def change_of_state(t: Array, y: Y) -> Y:
            return term.vf_prod(t, y, args, control)

        def derivative(along_t: float, along_y: Y) -> Y:
            tangents = (jnp.full_like(t0, along_t), along_y)
            return jax.jvp(change_of_state, (t0, y), tangents)[1]

        dp, dq = change_of_state(t0, y)
        dp_by_p, dq_by_p = derivative(0.0, (along_p, zero))
        dp_by_q, dq_by_q = derivative(0.0, (zero, along_q))
        dp_by_t, dq_by_t = derivative(1.0, (zero, zero))
        if structure == "additive":
            forbidden = [dp_by_p, dq_by_p, dp_by_q, dq_by_q]
        elif is_noise:
            # `dq` may vanish at this state alone, so its derivatives are tested, too.
            forbidden = [dq, dq_by_p, dq_by_q, dq_by_t, dp_by_p]
        else:
            forbidden = [dp_by_p, dq_by_q, dq_by_t]
        # The forbidden ones are compared with all values and derivatives.
        of_p = [dp, dp_by_p, dp_by_q, dp_by_t]
        of_q = [dq, dq_by_p, dq_by_q, dq_by_t]
        # False for NaN, or for infinity on both sides: then nothing is known.
        return largest_entry(forbidden) > threshold * largest_entry([of_p, of_q])

    def is_broken_along(direction: Array) -> Bool[Array, ""]:
        dy, control = unravel(direction)
        nearby = jtu.tree_map(lambda x, dx: x + distance * dx, y0, dy)
        return is_broken_at(y0, dy, control) | is_broken_at(nearby, dy, control)

    directions = jr.normal(jr.key(0), (_NUM_DIRECTIONS, zeros.size), zeros.dtype)
    return jnp.any(jax.vmap(is_broken_along)(directions))


def largest_entry(tree: PyTree[Array]) -> Array:
    """The largest absolute value of an entry of any array."""
    flat, _ = jfu.ravel_pytree(tree)
    return jnp.max(jnp.abs(flat))
