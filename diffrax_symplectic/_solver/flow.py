"""What moves the state between the kicks and the bath of a splitting: free flight, another
solver, or a flow that is known."""

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
from .._terms import rate, slow_apart
from .base import AbstractSymplecticSolver
from .step import result_of


# `flow(time, y, args)`.
FlowFunction: TypeAlias = Callable[[RealScalarLike, Y, Args], Y]
# Free flight, a solver for systems without noise, or a function.
Flow: TypeAlias = AbstractSymplecticSolver | FlowFunction | None


def is_solver(flow: Any) -> bool:
    # `isinstance` would look through wrappers, such as `diffrax.HalfSolver`.
    return issubclass(type(flow), AbstractSymplecticSolver)


def check_flow(flow: Any, steps: int, owner: str) -> None:
    """Raises a `ValueError` for what is no flow, or steps of a flow that takes none."""
    if flow is None or is_solver(flow):
        if flow is None and steps > 1:
            raise ValueError(
                f"`steps={steps}` of `{owner}` are those of a solver: pass one as `flow`, "
                "such as `StormerVerlet()`."
            )
        return
    if isinstance(flow, diffrax.AbstractSolver):
        raise ValueError(
            f"`flow` of `{owner}` must be a solver of this package, such as "
            "`ImplicitMidpoint()`, a `linear_flow`, or a function `(time, y, args)`; got "
            f"`{type(flow).__name__}`."
        )
    check_takes("flow", flow, "time", "y", "args")
    if steps > 1:
        raise ValueError(
            f"`steps={steps}` of `{owner}` are those of a solver; the flow {flow!r} takes "
            "one of any length."
        )


def kicks_and_rest(flow: Flow, drift: Terms) -> tuple[Terms, Terms]:
    """The terms whose forces are the kicks, and those that the flow follows."""
    if flow is None:
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
    """Raises a `ValueError` if a flow returns another state than it gets."""
    time = jnp.asarray(t0, jnp.result_type(t0, jnp.float32))
    y1 = eqx.filter_eval_shape(flow, time, y0, args)
    if _shapes_and_types(y1) != _shapes_and_types(y0):
        raise ValueError(
            "`flow(time, y, args)` must return a pair like the state, "
            f"{eqx.tree_pformat(y0)}; got {eqx.tree_pformat(y1)}."
        )


def _shapes_and_types(y: Y) -> PyTree:
    leaves, structure = jtu.tree_flatten(y)
    return structure, [(jnp.shape(x), jnp.result_type(x)) for x in leaves]


def returns_nan(
    flow: FlowFunction, time: RealScalarLike, y0: Y, args: Args
) -> Bool[Array, ""]:
    """Whether a flow returns NaN at the start of a solve, for half of its first step.
    Raises an error that names the flow; in a batch the path fails alone."""
    # The check has no derivative.
    y1 = jtu.tree_map(lax.stop_gradient, flow(time, y0, args))
    is_nan = jnp.stack([jnp.any(jnp.isnan(x)) for x in jtu.tree_leaves(y1)])
    # A path that has failed already is not the fault of the flow.
    return refused_where(all_finite(y0) & jnp.any(is_nan), _NAN)


_NAN = (
    "`flow(time, y, args)` returned NaN at `y0`, for half of the first step. (A mode with "
    "`omega = 0` has no `sin(omega * time) / omega`: write `time * jnp.sinc(omega * time / "
    "jnp.pi)`.)"
)


def begin_flow(
    flow: Flow, drift: Terms, t0: RealScalarLike, t1: Any, y0: Y, args: Args
) -> PyTree[Array]:
    """The state of the solver that is the flow, or whether a function returns NaN."""
    if flow is None:
        return None
    if not is_solver(flow):
        half = direction(drift) * (t1 - t0) / 2
        return returns_nan(flow, half, y0, args)  # pyright: ignore
    return flow.init(diffrax.MultiTerm(*drift), t0, t1, y0, args)  # pyright: ignore


def moved_by(
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
    """The state after the flow from `t0` to `t1`, half a step of length `time`; the state
    of the flow, and its result."""
    if flow is None:
        p, q = y
        _, velocities = rate(drift, t0, y, args)
        return (p, moved(q, time, velocities)), None, diffrax.RESULTS.successful
    if not is_solver(flow):
        # Steps are positive even in a solve backward in time, where the flow runs back.
        y1 = flow(direction(drift) * time, y, args)  # pyright: ignore
        R: Any = diffrax.RESULTS
        # `state` says whether the flow was broken at the start.
        result = R.where(state, R.nonfinite, result_of(None, y1))
        return y1, state, result
    terms = diffrax.MultiTerm(*drift)
    h = (t1 - t0) / steps

    def step(carry: tuple[Any, ...], k: Any) -> tuple[tuple[Any, ...], None]:
        y, state, _ = carry
        begin = t0 + k * h
        # What the bath did is a jump for a solver that remembers the end of its last step.
        y, _, _, state, result = flow.step(  # pyright: ignore
            terms, begin, begin + h, y, args, state, True
        )
        return (y, state, result), None

    carry = y, state, diffrax.RESULTS.successful
    if steps == 1:
        carry, _ = step(carry, 0)
    else:
        # A failure stays in the state of the solver, or in a state that is not finite.
        carry, _ = lax.scan(step, carry, jnp.arange(steps))
    return carry


def moved(x: PyTree, time: RealScalarLike, rate: PyTree) -> PyTree:
    """`x` after `time` at a constant rate."""

    def leaf_moved(x: Array, v: Array) -> Array:
        # In the precision of the state, which times need not have.
        return x + jnp.asarray(time, jnp.result_type(x)) * v

    return jtu.tree_map(leaf_moved, x, rate)


def handed_on(
    forces: PyTree[Array], made_jump: Any, anew: Callable[[], PyTree[Array]]
) -> PyTree[Array]:
    """The forces from the end of the last step, or after a jump, which moved the state,
    those that are computed `anew`."""
    if made_jump is False:
        return forces
    return lax.cond(made_jump, anew, lambda: forces)
