"""Flows within a splitting: solvers of this package, or functions that return the state
after a time."""

from collections.abc import Callable
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from .._arguments import check_takes
from .._batch import refused_where
from .._custom_types import Args, RealScalarLike, Y
from .._root_finder import all_finite
from .base import AbstractSymplecticSolver


# A function `flow(time, y, args)`, which returns the state after `time` from the state `y`.
FlowFunction: TypeAlias = Callable[[RealScalarLike, Y, Args], Y]
# A solver for systems without noise, or a function.
Flow: TypeAlias = AbstractSymplecticSolver | FlowFunction


def is_solver(flow: Any) -> bool:
    """Whether a flow is a solver of this package."""
    # `isinstance` would look through wrappers, such as `diffrax.HalfSolver`.
    return issubclass(type(flow), AbstractSymplecticSolver)


def check_flow(flow: Any, steps: int, solver_name: str) -> None:
    """Raises a `ValueError` unless `flow` is a solver of this package, or a function
    `(time, y, args)` with `steps=1`. `solver_name` is for messages."""
    if is_solver(flow):
        return
    if isinstance(flow, diffrax.AbstractSolver):
        raise ValueError(
            f"`flow` of `{solver_name}` must be a solver of this package, such as "
            "`ImplicitMidpoint()`, a `linear_flow`, or a function `(time, y, args)`; got "
            f"`{type(flow).__name__}`."
        )
    check_takes("flow", flow, "time", "y", "args")
    if steps > 1:
        raise ValueError(
            f"`steps={steps}` of `{solver_name}` are those of a solver; the flow {flow!r} "
            "takes one of any length."
        )


def check_returns_pair(
    flow: FlowFunction, t0: RealScalarLike, y0: Y, args: Args
) -> None:
    """Raises a `ValueError` if a flow returns a state of another structure, shape or dtype
    than it gets."""
    # `t0` stands for a duration: only shapes and dtypes are computed.
    time = jnp.asarray(t0, jnp.result_type(t0, jnp.float32))
    y1 = eqx.filter_eval_shape(flow, time, y0, args)
    if _structure_of(y1) != _structure_of(y0):
        raise ValueError(
            "`flow(time, y, args)` must return a pair like the state, "
            f"{eqx.tree_pformat(y0)}; got {eqx.tree_pformat(y1)}."
        )


def _structure_of(y: PyTree) -> PyTree:
    """The structure of a state, and the shapes and dtypes of its leaves."""
    leaves, treedef = jtu.tree_flatten(y)
    return treedef, [(jnp.shape(x), jnp.result_type(x)) for x in leaves]


def returns_nan(
    flow: FlowFunction, time: RealScalarLike, y0: Y, args: Args
) -> Bool[Array, ""]:
    """Whether a flow returns NaN after `time`, half of the first step, from the start `y0`
    of a solve. NaN is an error, except under `vmap`: there the caller makes the path of
    this `y0` fail, and the others of its batch continue."""
    # The check has no derivative.
    y1 = jtu.tree_map(lax.stop_gradient, flow(time, y0, args))
    leaf_has_nan = jnp.stack([jnp.any(jnp.isnan(x)) for x in jtu.tree_leaves(y1)])
    # If `y0` is not finite, the path has failed before, and NaN is not the flow's fault.
    return refused_where(all_finite(y0) & jnp.any(leaf_has_nan), _NAN)


_NAN = (
    "`flow(time, y, args)` returned NaN at `y0`, for half of the first step. (A mode with "
    "`omega = 0` has no `sin(omega * time) / omega`: write `time * jnp.sinc(omega * time / "
    "jnp.pi)`.)"
)
