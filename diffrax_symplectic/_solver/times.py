"""Checks that floating-point times resolve a step, and that Brownian paths cover it."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._compat import direction
from .._custom_types import RealScalarLike
from .._terms import brownian_paths


# The least length of a step, in units in the last place (ulps) of the times of the solve.
# At the end of a solve Diffrax merges a shorter remainder into the step before.
_LEAST_ULPS = 100
_OUTSIDE = (
    "A step begins before `path.t0` or ends after `path.t1` of a Brownian path, which has "
    "no noise there. Solve between these times, or pass a longer path."
)


def check_resolution(h: float, t0: float, t1: float, dtype: Any) -> None:
    """Raises a `ValueError` for steps of size `h` between `t0` and `t1` that are too short
    for times of this dtype: `result_with_times_checked` would report each as failed."""
    rounding = float(jnp.finfo(dtype).eps) * max(abs(t0), abs(t1))
    if h < _LEAST_ULPS * rounding:
        raise ValueError(
            f"Steps of {h:g} are shorter than {_LEAST_ULPS} times the rounding of the "
            f"time in {dtype} at t0={t0} and t1={t1}. Call `jax.config.update("
            '"jax_enable_x64", True)` first, take longer steps, or start at `t0=0`.'
        )


def result_with_times_checked(
    terms: PyTree[diffrax.AbstractTerm],
    t0: RealScalarLike,
    t1: RealScalarLike,
    result: diffrax.RESULTS,
) -> diffrax.RESULTS:
    """The `result` of the step from `t0` to `t1`, or `RESULTS.dt_min_reached` if the step
    is too short for the rounding of times. If a Brownian path does not cover the step, that
    is an error when run."""
    R: Any = diffrax.RESULTS
    t0 = jnp.asarray(t0)
    t1 = jnp.asarray(t1)
    h = t1 - t0
    # The times of a single step may be integers, which count as single precision here.
    eps = float(jnp.finfo(jnp.result_type(t0, jnp.float32)).eps)
    is_too_short = h < _LEAST_ULPS * eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    result = R.where(is_too_short, R.dt_min_reached, result)
    for path in brownian_paths(terms):
        # Most paths have no ends, and need no check when run. Ends that are traced arrays
        # cannot be compared here.
        are_known = isinstance(path.t0, float) and isinstance(path.t1, float)
        if are_known and path.t0 == -np.inf and path.t1 == np.inf:
            continue
        # In a solve backward in time Diffrax changes the sign of all times.
        forward = direction(terms) > 0
        begin = jnp.where(forward, t0, -t1)
        end = jnp.where(forward, t1, -t0)
        # Times are rounded, so that a step may begin just before the path or end just after
        # it. A hundredth of the step is at least one rounding: see `_LEAST_ULPS`.
        slack = 0.01 * h
        is_outside = (begin < path.t0 - slack) | (end > path.t1 + slack)
        result = eqx.error_if(result, is_outside, _OUTSIDE)
    return result
