"""Flows within a splitting: another solver, or a flow that is known."""

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
from .._compat import direction
from .._custom_types import Args, RealScalarLike, Terms, Y
from .._root_finder import all_finite
from .._terms import slow_apart
from .base import AbstractSymplecticSolver
from .step import result_of


# `flow(time, y, args)`.
FlowFunction: TypeAlias = Callable[[RealScalarLike, Y, Args], Y]
# Free flight, a solver for systems without noise, or a function.
Flow: TypeAlias = AbstractSymplecticSolver | FlowFunction | None


def is_solver(flow: Any) -> bool:
    """Whether a flow is a solver of this package."""
    # `isinstance` would look through wrappers, such as `diffrax.HalfSolver`.
    return issubclass(type(flow), AbstractSymplecticSolver)


def check_flow(flow: Any, steps: int, solver_name: str) -> None:
    """Raises a `ValueError` unless `flow` is a flow, and for several `steps` of a flow that
    is no solver. `solver_name` is for messages."""
    if is_solver(flow):
        return
    if flow is None and steps > 1:
        raise ValueError(
            f"`steps={steps}` of `{solver_name}` are those of a solver: pass one as "
            "`flow`, such as `StormerVerlet()`."
        )
    if flow is None:
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


def check_keeps_constraint(flow: Flow) -> None:
    """Raises a `ValueError` for a flow that leaves the surface of a constraint."""
    if not getattr(flow, "keeps_constraints", False):
        raise ValueError(
            f"The flow {flow!r} does not keep the constraint of the terms. Use "
            "`BAOAB()` or `BAOAB(StormerVerlet())`."
        )


def kicks_and_rest(has_flow: bool, drift: Terms) -> tuple[Terms, Terms]:
    """The terms whose forces are the kicks of a splitting, and the terms that its flow
    follows, or free flight."""
    # Kicks take the forces of the whole drift, and free flight its velocities.
    if not has_flow:
        return drift, drift
    rest, slow = slow_apart(drift)
    return slow, rest


def check_follows(
    flow: Flow, drift: Terms, t0: RealScalarLike, y0: Y, args: Args
) -> None:
    """Raises a `ValueError` if a flow does not take this drift or state."""
    if is_solver(flow):
        flow.check(diffrax.MultiTerm(*drift), t0, y0, args)  # pyright: ignore
    elif flow is not None:
        check_returns_pair(flow, t0, y0, args)  # pyright: ignore


def check_returns_pair(
    flow: FlowFunction, t0: RealScalarLike, y0: Y, args: Args
) -> None:
    """Raises a `ValueError` if a flow returns a state of another structure, shape or dtype
    than it gets."""
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
    of a solve. This is also an error, but not in a batch: there the path has to fail by
    this flag, without the others."""
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


def begin_flow(
    flow: Flow,
    drift: Terms,
    t0: RealScalarLike,
    t1: RealScalarLike,
    time: RealScalarLike,
    y0: Y,
    args: Args,
) -> PyTree[Array]:
    """The state of a flow at the start of a solve. For a solver it is its own state, for a
    first step from `t0` to `t1`. For a function it is whether this returns NaN after
    `time`, the share of the first step for which it is called."""
    if not is_solver(flow):
        # Steps are positive even in a solve backward in time, where the flow runs back.
        return returns_nan(flow, direction(drift) * time, y0, args)  # pyright: ignore
    return flow.init(diffrax.MultiTerm(*drift), t0, t1, y0, args)  # pyright: ignore


def after_flow(
    flow: Flow,
    steps: int,
    drift: Terms,
    t0: RealScalarLike,
    t1: RealScalarLike,
    time: RealScalarLike,
    y: Y,
    args: Args,
    state: PyTree[Array],
) -> tuple[Y, PyTree[Array], diffrax.RESULTS]:
    """`y` after the flow from `t0` to `t1`, a share of the step of length `time`; the state
    of the flow after it; and its result."""
    if is_solver(flow):
        return _after_steps(flow, steps, drift, t0, t1, y, args, state)
    # Steps are positive even in a solve backward in time, where the flow runs back.
    y1 = flow(direction(drift) * time, y, args)  # pyright: ignore
    R: Any = diffrax.RESULTS
    # The state of a function is whether it returned NaN at the start.
    result = R.where(state, R.nonfinite, result_of(None, y1))
    return y1, state, result


def _after_steps(
    solver: Any,
    steps: int,
    drift: Terms,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y: Y,
    args: Args,
    state: PyTree[Array],
) -> tuple[Y, PyTree[Array], diffrax.RESULTS]:
    """`after_flow` for a solver, which goes from `t0` to `t1` in this many steps."""
    terms = diffrax.MultiTerm(*drift)
    h = (t1 - t0) / steps

    def step(carry: tuple[Any, ...], index: Any) -> tuple[tuple[Any, ...], None]:
        y, state, _ = carry
        step_start = t0 + index * h
        # What the bath did is a jump for a solver that remembers the end of its last step.
        made_jump = True
        y, _, _, state, result = solver.step(
            terms, step_start, step_start + h, y, args, state, made_jump
        )
        return (y, state, result), None

    carry = y, state, diffrax.RESULTS.successful
    if steps == 1:
        carry, _ = step(carry, 0)
    else:
        # The last result tells of all: after a failure the state of the solver, or a state
        # that is not finite, makes all further steps fail.
        carry, _ = lax.scan(step, carry, jnp.arange(steps))
    return carry


def moved(x: PyTree, time: RealScalarLike, rate: PyTree) -> PyTree:
    """`x` after `time` at a constant rate."""

    def moved_leaf(x: Array, rate: Array) -> Array:
        # The time is converted to the precision of the state, which it need not have.
        return x + jnp.asarray(time, jnp.result_type(x)) * rate

    return jtu.tree_map(moved_leaf, x, rate)


def forces_at_start(
    last_forces: PyTree[Array], made_jump: Any, compute: Callable[[], PyTree[Array]]
) -> PyTree[Array]:
    """The forces at the start of a step: those from the end of the last step, or after a
    jump, which moved the state, those that `compute()` returns."""
    if made_jump is False:
        return last_forces
    return lax.cond(made_jump, compute, lambda: last_forces)
