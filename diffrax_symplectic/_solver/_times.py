"""Whether a step can be taken at its time: whether numbers resolve it, and Brownian paths
cover it."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._brownian import covers_all_times
from .._compat import direction, result_named
from .._custom_types import RealScalarLike
from .._terms import brownian_paths


# Diffrax takes what is left of a solve in one step if it is shorter than a hundred units in
# the last place of its end.
ROUNDINGS = 100
_TOO_SHORT = (
    f"A step is shorter than {ROUNDINGS} times the rounding of the time, so that steps are "
    "not of one length, and the last ones become one. Begin at `t0=0`, take longer steps, "
    'or call `jax.config.update("jax_enable_x64", True)` first, and pass times in double '
    "precision."
)
_OUTSIDE = (
    "A step goes beyond `path.t0` or `path.t1` of a Brownian path, where its noise is not "
    "known. Solve within these times, or pass a longer path."
)


def result_at(
    terms: PyTree[diffrax.AbstractTerm],
    t0: RealScalarLike,
    t1: RealScalarLike,
    result: diffrax.RESULTS,
) -> diffrax.RESULTS:
    """`result` of the step from `t0` to `t1`, or why it could not be taken there."""
    where: Any = diffrax.RESULTS.where
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    h, eps = t1 - t0, float(jnp.finfo(jnp.result_type(t0, jnp.float32)).eps)
    short = h < ROUNDINGS * eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    result = where(short, result_named("step_too_short", _TOO_SHORT), result)
    for path in brownian_paths(terms):
        if covers_all_times(path):
            continue
        # In a solve backward in time Diffrax counts it from minus `t0` on.
        forward = direction(terms) > 0
        begin, end = jnp.where(forward, t0, -t1), jnp.where(forward, t1, -t0)
        # Times are rounded.
        slack = 0.01 * h
        outside = (begin < path.t0 - slack) | (end > path.t1 + slack)
        result = where(outside, result_named("outside_of_path", _OUTSIDE), result)
    return result
