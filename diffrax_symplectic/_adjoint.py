"""Gradients by stepping back along the solution, for reversible solvers."""

import functools as ft
from collections.abc import Callable
from typing import Any, cast, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ._arguments import whole_number
from ._compat import (
    reversed_in_time,
    run_steps,
    saves_states,
    solve_state,
    StepTimes,
    while_loop,
    with_only_ys_differentiable,
    with_y,
    without_derivatives,
    ω,
)
from ._custom_types import IntScalarLike, Y
from ._solver import is_solver, LANGEVIN
from ._terms import check_unconstrained


class ReversingAdjoint(diffrax.AbstractAdjoint):
    r"""Reverse-mode gradients in memory that does not grow with the number of steps, for
    `diffrax.diffeqsolve(..., adjoint=...)`.

    Some solvers are reversible: the step from $t_{n+1}$ to $t_n$ with negated increments
    leads from $y_{n+1}$ back to $y_n$, so the states need not be stored. The backward pass
    steps from the end of the solution to its start, and multiplies by the transposed
    Jacobian of each step. In exact arithmetic these are the gradients of
    `diffrax.RecursiveCheckpointAdjoint`.

    Rounding errors grow on the way back. Therefore the forward pass saves up to
    `checkpoints` states, evenly spaced over the steps, from which the backward pass
    restarts. If it arrives at one of them with an error above $\varepsilon^{2/3}$ of the
    largest entry of the state, with the machine epsilon $\varepsilon$ (4e-11 in float64),
    an error is raised, or with `throw=False` the gradient is NaN. Near rest the error is
    compared with the size of later states, reduced by a tenth for each step.

    **Solvers:** tableaus that are reversible, as determined from their coefficients, such
    as [`diffrax_symplectic.ImplicitMidpoint`][], [`diffrax_symplectic.StormerVerlet`][],
    [`diffrax_symplectic.StrangGauss`][], [`diffrax_symplectic.LevyAreaMidpoint`][], and
    possibly your own; [`diffrax_symplectic.NinomiyaVictoir`][]; symmetric splittings for
    heat baths, such as [`diffrax_symplectic.BAOAB`][], with a flow that is reversible; and
    [`diffrax_symplectic.LinearFlow`][] around a reversible solver. With friction, rounding
    errors grow on the way back, about by $e^{\gamma t}$, and with
    [`diffrax_symplectic.BAOAB`][] by $|(1 + x) / (1 - x)|$ in each step, $x = \gamma h /
    2$: use more checkpoints. At $x = 1$ a step has no inverse.

    **Steps:** `diffrax.ConstantStepSize` or `diffrax.StepTo`. **Saving:** `SaveAt(t1=True)`
    or `SaveAt(ts=...)`. Events, forward mode and derivatives with respect to times are not
    supported.

    **Parameters:** gradients are with respect to `args`, the initial state, the terms and
    the solver. JAX raises an error for traced values that a Hamiltonian closes over: pass
    them through `args`.

    **Raises:** a `ValueError`, while tracing, for anything else.
    """

    checkpoints: int = eqx.field(
        default=64, converter=ft.partial(whole_number, "checkpoints")
    )

    def loop(
        self,
        *,
        args,
        terms,
        solver,
        stepsize_controller,
        event,
        saveat,
        init_state,
        passed_solver_state,
        passed_controller_state,
        **kwargs,
    ) -> Any:
        if passed_solver_state or passed_controller_state:
            raise ValueError(
                "`ReversingAdjoint` takes no `solver_state` and no `controller_state`."
            )
        check_unconstrained(terms, "ReversingAdjoint")
        _check_supported(solver, stepsize_controller, event, saveat)
        # No derivatives pass through the solver state, which each step of the backward pass
        # computes anew.
        kwargs |= dict(
            stepsize_controller=stepsize_controller,
            saveat=saveat,
            init_state=without_derivatives(init_state, _without_gradient),
        )
        differentiated = (init_state.y, args, terms, solver)
        final_state, aux_stats = _solve(differentiated, adjoint=self, **kwargs)
        return with_only_ys_differentiable(final_state), aux_stats


def _without_gradient(x: Any) -> Any:
    return lax.stop_gradient(x) if eqx.is_array(x) else x


ReversingAdjoint.__init__.__doc__ = """**Arguments:**

- `checkpoints`: the number of states to save. Use more if rounding errors grow fast. They
    cost memory, and do not save time.

**Raises:** a `ValueError` if `checkpoints` is not a positive integer.
"""


def _check_supported(
    solver: Any, controller: Any, event: diffrax.Event | None, saveat: diffrax.SaveAt
) -> None:
    """Raises a `ValueError` for a solve that the backward pass cannot undo."""
    if not _undoes_its_steps(solver):
        fault = (
            "needs a reversible solver, such as `ImplicitMidpoint`, `StormerVerlet` or "
            f"`StrangGauss`; got `{type(solver).__name__}`"
        )
    elif not isinstance(controller, diffrax.ConstantStepSize | diffrax.StepTo):
        fault = (
            "needs steps that are known in advance: `stepsize_controller=diffrax."
            "ConstantStepSize()` or `diffrax.StepTo(ts)`; got "
            f"`{type(controller).__name__}`"
        )
    elif event is not None:
        fault = "does not support events"
    elif not _saves_states_alone(saveat):
        fault = (
            "only saves states, by `SaveAt(t1=True)` or `SaveAt(ts=...)`. Instead of "
            "`SaveAt(fn=...)` apply the function to `sol.ys`"
        )
    else:
        return
    raise ValueError(
        f"`ReversingAdjoint` {fault}. Alternatively pass "
        "`adjoint=diffrax.RecursiveCheckpointAdjoint()`."
    )


def _saves_states_alone(saveat: diffrax.SaveAt) -> bool:
    """Whether a solve saves states at the end or at given times, and nothing else."""
    sub_saveat = saveat.subs
    # With several `SubSaveAt`, `subs` is a PyTree of them.
    if saveat.dense or not isinstance(sub_saveat, diffrax.SubSaveAt):
        return False
    saves_both = sub_saveat.t1 and sub_saveat.ts is not None
    saves_more = sub_saveat.steps or sub_saveat.t0 or saves_both
    return not saves_more and saves_states(sub_saveat)


def _undoes_its_steps(solver: Any) -> bool:
    """Whether a step with negated increments leads from the end of a step back to its
    start. This is known only for solvers of this package."""
    return is_solver(solver) and solver.undoes_its_steps


# Equinox calls the rules for the forward and the backward pass below with the same
# arguments: `inputs` are differentiated, keyword arguments are not.
@eqx.filter_custom_vjp
def _solve(inputs, *, adjoint, throw, **kwargs):
    del throw
    return _run(adjoint, inputs, ft.partial(while_loop, kind="lax"), kwargs)


def _run(adjoint: ReversingAdjoint, inputs: Any, outer_while_loop: Callable, kwargs):
    """The final state of Diffrax's loop, and statistics. `inputs` are what is
    differentiated: the initial state, `args`, terms and solver. `kwargs` are the other
    arguments of `loop`."""
    y, args, terms, solver = inputs
    init_state = with_y(kwargs["init_state"], y)
    kwargs = kwargs | {"init_state": init_state}
    return run_steps(
        adjoint, outer_while_loop, args=args, terms=terms, solver=solver, **kwargs
    )


class _Residuals(NamedTuple):
    """What the forward pass leaves for the backward pass.

    - `checkpoints`: states at evenly spaced steps, along the first axis.
    - `y1`: the state at the end.
    - `num_steps`: the number of steps made.
    - `num_saved`: the number of times of `SaveAt(ts=...)`.
    """

    checkpoints: PyTree[Array]
    y1: Y
    num_steps: IntScalarLike
    num_saved: IntScalarLike


@_solve.def_fwd
def _solve_fwd(perturbed, inputs, *, adjoint, throw, **kwargs):
    del perturbed, throw
    times = StepTimes(kwargs["stepsize_controller"], kwargs["init_state"])
    steps_between = _steps_between(times, adjoint.checkpoints)
    # Set by `recording_while_loop`, since Diffrax returns only its own state.
    checkpoints = None

    def recording_while_loop(cond_fun, body_fun, init_val, **options):
        nonlocal checkpoints
        final, checkpoints = _while_loop_with_checkpoints(
            adjoint.checkpoints,
            steps_between,
            cond_fun,
            body_fun,
            init_val,
            **options,
        )
        return final

    out = _run(adjoint, inputs, recording_while_loop, kwargs)
    final_state, _ = out
    final = solve_state(final_state)
    return out, _Residuals(
        checkpoints=checkpoints,
        y1=final.y,
        num_steps=final.num_steps,
        num_saved=final.num_saved,
    )


def _steps_between(times: StepTimes, num_checkpoints: int) -> IntScalarLike:
    """The number of steps from one checkpoint to the next."""
    # The quotient is rounded up, so that the checkpoints suffice for all steps.
    return jnp.maximum(1, -(-jnp.asarray(times.num_steps()) // num_checkpoints))


def _while_loop_with_checkpoints(
    num_checkpoints: int,
    steps_between: IntScalarLike,
    cond_fun: Callable,
    body_fun: Callable,
    init_val: Any,
    *,
    buffers: Callable,
    **options,
) -> tuple[Any, PyTree[Array]]:
    """Runs Diffrax's loop over steps. Returns the final state of the loop, and the states
    at every `steps_between` steps, along a first axis of length `num_checkpoints`."""

    def empty_rows(x: Array) -> Array:
        return jnp.zeros((num_checkpoints, *jnp.shape(x)), x.dtype)

    def is_going(carry):
        state, _ = carry
        return cond_fun(state)

    def record_and_step(carry):
        state, rows = carry
        before_step = solve_state(state)
        row, rest = jnp.divmod(before_step.num_steps, steps_between)
        # For states between checkpoints the row is out of range, so that `save` drops them.
        row = jnp.where(rest == 0, row, num_checkpoints)

        def save(x: Array, saved: Array) -> Array:
            return saved.at[row].set(x, mode="drop")

        return body_fun(state), jtu.tree_map(save, before_step.y, rows)

    # `buffers` tells which arrays of Diffrax's state the loop writes in place.
    def buffers_of_state(carry):
        state, _ = carry
        return buffers(state)

    rows = jtu.tree_map(empty_rows, solve_state(init_val).y)
    return while_loop(
        is_going,
        record_and_step,
        (init_val, rows),
        buffers=buffers_of_state,
        kind="lax",
        **options,
    )


# From here on, `a_x` is the derivative of the loss with respect to `x`.
class _Walk(NamedTuple):
    """The state of the backward pass.

    - `i`: the number of steps from the start.
    - `y`: the state after these steps.
    - `a_y`: with respect to `y`, without the effect on the first `num_saved` saved states.
    - `a_parameters`: with respect to the parameters, through the steps after `y`.
    - `num_saved`: the number of saved states up to the time of `y`.
    - `size`: the largest entry of `y`, or if it is larger, `_SIZE_KEPT_PER_STEP` times the
        size of the next state.
    - `agrees`: whether the pass agreed with all checkpoints so far.
    """

    i: Array
    y: Y
    a_y: Y
    a_parameters: PyTree[Array]
    num_saved: Array
    size: Array
    agrees: Bool[Array, ""]


@_solve.def_bwd
def _solve_bwd(
    residuals: _Residuals, grad_out, perturbed, inputs, *, adjoint, throw, **kwargs
):
    times = StepTimes(kwargs["stepsize_controller"], kwargs["init_state"])
    steps_between = _steps_between(times, adjoint.checkpoints)
    solver_state = times.solver_state()
    a_final_state, _ = grad_out
    ts = kwargs["saveat"].subs.ts
    a_ys = _with_zeros(solve_state(a_final_state).ys, residuals.y1, ts)
    saved = _SavedStates(ts, a_ys)
    # The parameters are `args`, terms and solver.
    _, *parameters = inputs
    _, *is_perturbed = perturbed
    diff, nondiff = eqx.partition(parameters, is_perturbed)
    args, terms, solver = parameters
    parameters_back = (args, reversed_in_time(terms), solver)

    def is_going(walk: _Walk) -> Bool[Array, ""]:
        return walk.i > 0

    def step_back(walk: _Walk) -> _Walk:
        i = walk.i - 1
        t0 = times.time(i)
        t1 = times.time(i + 1)

        def step(y0: Y, diff: PyTree[Array]) -> Y:
            parameters = eqx.combine(diff, nondiff)
            return _y_after_step(parameters, t0, t1, y0, solver_state)

        y_found = _y_after_step(parameters_back, -t1, -t0, walk.y, solver_state)
        size = jnp.maximum(optx.max_norm(y_found), _SIZE_KEPT_PER_STEP * walk.size)
        y0, agrees = _meet_checkpoint(
            y_found, residuals.checkpoints, i, steps_between, walk.agrees, size
        )
        # The step is made forward again, from the state that was found, so that its
        # transposed Jacobian is exact.
        _, vjp = jax.vjp(step, y0, diff)
        ends = saved.added_in_step(t0, t1, walk.a_y, walk.num_saved)
        a_y0_through_step, a_parameters_of_step = vjp(ends.a_y1)
        return _Walk(
            i=i,
            y=y0,
            a_y=(ends.a_y0**ω + a_y0_through_step**ω).ω,
            a_parameters=(walk.a_parameters**ω + a_parameters_of_step**ω).ω,
            num_saved=ends.num_saved,
            size=size,
            agrees=agrees,
        )

    end = _Walk(
        i=jnp.asarray(residuals.num_steps),
        y=residuals.y1,
        a_y=saved.at_end(),
        a_parameters=jtu.tree_map(jnp.zeros_like, diff),
        num_saved=jnp.asarray(residuals.num_saved),
        size=optx.max_norm(residuals.y1),
        agrees=jnp.array(True),
    )
    start = lax.while_loop(is_going, step_back, end)
    a_y = saved.added_at_start(start.a_y, start.num_saved)
    return _checked_gradients(start.agrees, throw, (a_y, *start.a_parameters))


def _y_after_step(parameters: PyTree, t0: Any, t1: Any, y0: Y, solver_state: Any) -> Y:
    """The state after one step of the solve."""
    args, terms, solver = parameters
    # The solver state belongs to another step, so the step is made as after a jump.
    y1, *_ = solver.step(terms, t0, t1, y0, args, solver_state, made_jump=True)
    return y1


def _with_zeros(a_ys: PyTree[Array | None], y1: Y, ts: Array | None) -> PyTree[Array]:
    """`a_ys`, the derivatives with respect to the saved states, with zeros in place of
    `None`, which JAX passes where the loss does not depend on a leaf. `y1` is one of the
    states, and `ts` are the times."""
    num_times = 1 if ts is None else len(ts)

    def or_zeros(y1_leaf: Array, a_leaf: Array | None) -> Array:
        if a_leaf is None:
            return jnp.zeros((num_times, *jnp.shape(y1_leaf)), y1_leaf.dtype)
        return a_leaf

    return jtu.tree_map(or_zeros, y1, a_ys, is_leaf=lambda x: x is None)


class _StepEnds(NamedTuple):
    """Derivatives of the loss with respect to the states at both ends of a step.

    - `a_y1`: with respect to the state at the end of the step.
    - `a_y0`: with respect to the state at the start, but not through the state at the end.
    - `num_saved`: the number of saved states that are not in the derivatives yet.
    """

    a_y1: Y
    a_y0: Y
    num_saved: Array


class _SavedStates(NamedTuple):
    """Derivatives of the loss with respect to the saved states.

    - `ts`: the times of the states. `None` if only the state at the end is saved.
    - `a_ys`: the derivatives, along the first axis.
    """

    ts: Array | None
    a_ys: PyTree[Array]

    def at_end(self) -> Y:
        """The derivatives with respect to the state at the end, before the first step
        back."""
        if self.ts is None:
            return jtu.tree_map(lambda rows: rows[-1], self.a_ys)
        # The first step back adds the states that were saved at its end.
        return jtu.tree_map(lambda rows: jnp.zeros_like(rows[0]), self.a_ys)

    def added_in_step(self, t0: Any, t1: Any, a_y1: Y, num_saved: Array) -> _StepEnds:
        """Adds to `a_y1` the derivatives with respect to the states that were saved after
        `t0` and up to `t1`, the last ones of the first `num_saved`.

        Diffrax interpolates these states linearly: the state at the time
        `t0 + share * (t1 - t0)` is `(1 - share) * y0 + share * y1`."""
        ends = _StepEnds(a_y1, jtu.tree_map(jnp.zeros_like, a_y1), num_saved)
        ts = self.ts
        if ts is None:
            return ends

        def with_share(a_y: Y, share: Array, index: Array) -> Y:
            return jtu.tree_map(lambda a, rows: a + share * rows[index], a_y, self.a_ys)

        def add_last(ends: _StepEnds) -> _StepEnds:
            last = ends.num_saved - 1
            share = (ts[last] - t0) / (t1 - t0)
            return _StepEnds(
                a_y1=with_share(ends.a_y1, share, last),
                a_y0=with_share(ends.a_y0, 1 - share, last),
                num_saved=last,
            )

        def has_more(ends: _StepEnds) -> Bool[Array, ""]:
            # If no saved state is left, this reads the last time, but does not use it.
            return (ends.num_saved > 0) & (ts[ends.num_saved - 1] > t0)

        return lax.while_loop(has_more, add_last, ends)

    def added_at_start(self, a_y0: Y, num_saved: Array) -> Y:
        """Adds to `a_y0` the derivatives with respect to the first `num_saved` states. They
        were saved at the start of the solve, before any step."""
        if self.ts is None:
            return a_y0
        is_at_start = jnp.arange(len(self.ts)) < num_saved

        def with_saved(a: Array, rows: Array) -> Array:
            return a + jnp.tensordot(is_at_start, rows, 1)

        return jtu.tree_map(with_saved, a_y0, self.a_ys)


# Errors of a state are compared with its size, which is at least this fraction of the size
# of the next state. So a state at rest has a size, too, although weak increments may take
# dozens of steps to move it.
_SIZE_KEPT_PER_STEP = 0.9


def _meet_checkpoint(
    y_found: Y,
    checkpoints: PyTree[Array],
    i: IntScalarLike,
    steps_between: IntScalarLike,
    agreed_so_far: Bool[Array, ""],
    size: Array,
) -> tuple[Y, Bool[Array, ""]]:
    """Compares `y_found`, the state after `i` steps as the backward pass found it, with the
    checkpoint there, if there is one.

    Returns the checkpoint, or without one `y_found`; and whether the pass `agreed_so_far`
    and agrees with this checkpoint, too, up to an error in proportion to `size`."""
    # Between checkpoints this reads the one before, and does not use it.
    row, rest = jnp.divmod(i, steps_between)
    checkpoint = jtu.tree_map(lambda rows: rows[row], checkpoints)
    error = optx.max_norm((y_found**ω - checkpoint**ω).ω)
    # A third of the digits may be lost to rounding errors on the way. The gradients, which
    # are computed from the states on the way, keep the others.
    eps = float(jnp.finfo(error.dtype).eps)
    agrees = error <= eps ** (2 / 3) * jnp.maximum(size, optx.max_norm(checkpoint))
    is_at_checkpoint = rest == 0

    def saved_or_found(saved: Array, found: Array) -> Array:
        return jnp.where(is_at_checkpoint, saved, found)

    y = jtu.tree_map(saved_or_found, checkpoint, y_found)
    return y, agreed_so_far & (agrees | ~is_at_checkpoint)


def _steps_without_inverse() -> str:
    """For messages: the steps of solvers for heat baths that have no inverse, such as
    "`BAOAB` with rate of friction times step equal to 2"."""
    return " or of ".join(
        f"`{type(solver).__name__}` with rate of friction times step equal to "
        f"{solver.friction_without_inverse:g}"
        for solver in (kind() for kind in LANGEVIN)
        if solver.undoes_its_steps
    )


def _checked_gradients(
    agrees: Bool[Array, ""], throw: bool, gradients: PyTree
) -> PyTree:
    """The gradients, if the backward pass agrees with all checkpoints. Otherwise an error
    is raised when run, or without `throw`, the gradients are NaN."""
    if throw:
        return eqx.error_if(
            gradients,
            ~agrees,
            "`ReversingAdjoint` could not reconstruct the solution: rounding errors grew "
            "too large between two checkpoints, or a step has no inverse, as one of "
            f"{_steps_without_inverse()}. Increase `checkpoints`, change the step, or pass "
            "`adjoint=diffrax.RecursiveCheckpointAdjoint()`.",
        )

    # NaN is better than a gradient that is silently wrong.
    def or_nan(x: Array) -> Array:
        return jnp.where(agrees, x, cast(Array, jnp.nan))

    return jtu.tree_map(or_nan, gradients)
