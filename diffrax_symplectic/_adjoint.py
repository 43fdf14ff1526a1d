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
    lax_while_loop,
    reversed_in_time,
    run_steps,
    saves_states,
    solve_state,
    StepTimes,
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
        # Derivatives are with respect to `inputs` alone. In particular none pass through
        # the solver state, which each step of the backward pass computes anew.
        inputs = (init_state.y, args, terms, solver)
        kwargs |= dict(
            stepsize_controller=stepsize_controller,
            saveat=saveat,
            init_state=without_derivatives(init_state),
        )
        final_state, aux_stats = _solve(inputs, adjoint=self, **kwargs)
        return with_only_ys_differentiable(final_state), aux_stats


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


# Equinox calls `_solve` and its rules for the forward and the backward pass with the same
# arguments. It differentiates with respect to the first one, `inputs = (y0, args, terms,
# solver)`, but not with respect to the keyword arguments. They are those that Diffrax
# passes to `ReversingAdjoint.loop`, and the adjoint.
@eqx.filter_custom_vjp
def _solve(inputs, *, adjoint, throw, **kwargs):
    """Solves the equation. Returns the final state of Diffrax's loop over steps, and
    statistics."""
    del throw
    return _loop_over_steps(adjoint, inputs, kwargs, lax_while_loop)


def _loop_over_steps(
    adjoint: ReversingAdjoint, inputs: Any, kwargs: Any, outer_while_loop: Callable
) -> Any:
    """What `_solve` returns, for its `inputs` and keyword arguments. `outer_while_loop` is
    called for the loop over steps."""
    y0, args, terms, solver = inputs
    # `y0` is not in `init_state`, since derivatives are with respect to `inputs` alone.
    kwargs = kwargs | {"init_state": with_y(kwargs["init_state"], y0)}
    return run_steps(
        adjoint, outer_while_loop, args=args, terms=terms, solver=solver, **kwargs
    )


class _Residuals(NamedTuple):
    """What the forward pass leaves for the backward pass.

    - `checkpoints`: states at evenly spaced steps, along the first axis.
    - `y1`: the state at the end.
    - `num_steps`: the number of steps made.
    - `num_saved`: the number of times of `SaveAt(ts=...)` that the solve has reached.
    """

    checkpoints: PyTree[Array]
    y1: Y
    num_steps: IntScalarLike
    num_saved: IntScalarLike


@_solve.def_fwd
def _solve_fwd(perturbed, inputs, *, adjoint, throw, **kwargs):
    """Solves the equation, and saves checkpoints on the way. Returns what `_solve` returns,
    and the residuals."""
    del perturbed, throw
    times = StepTimes(kwargs["stepsize_controller"], kwargs["init_state"])
    steps_between = _steps_between(times, adjoint.checkpoints)
    # Diffrax calls `recording_while_loop`, and returns only the state of its own loop. So
    # the checkpoints reach this function through a variable.
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

    out = _loop_over_steps(adjoint, inputs, kwargs, recording_while_loop)
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
    """Runs Diffrax's loop over steps, and saves the state before each step whose number is
    a multiple of `steps_between`.

    Returns the final state of the loop, and the saved states: arrays with one row for each
    checkpoint, `num_checkpoints` in all. Rows that are not needed are zero."""

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

        def save(x: Array, rows_of_x: Array) -> Array:
            return rows_of_x.at[row].set(x, mode="drop")

        return body_fun(state), jtu.tree_map(save, before_step.y, rows)

    # `buffers` tells which arrays of Diffrax's state the loop writes in place.
    def buffers_of_state(carry):
        state, _ = carry
        return buffers(state)

    rows = jtu.tree_map(empty_rows, solve_state(init_val).y)
    return lax_while_loop(
        is_going,
        record_and_step,
        (init_val, rows),
        buffers=buffers_of_state,
        **options,
    )


# At a checkpoint the error of a state is compared with the size of the state: its largest
# entry, or, if that is larger, this fraction of the size of the next state. So a state near
# rest has the size of states some steps later, since weak increments may take dozens of
# steps to move it.
_SIZE_KEPT_PER_STEP = 0.9


# From here on, `a_x` is the derivative of the loss with respect to `x`. The loss depends on
# the solution through the saved states.
class _Walk(NamedTuple):
    """How far the backward pass has come.

    - `i`: the number of steps of the solve that are still to be undone.
    - `y`: the state after these `i` steps.
    - `a_y`: the derivative of the loss with respect to `y`, through the saved states that
        come later than the first `num_saved`.
    - `a_parameters`: the derivatives of the loss with respect to those parameters (`args`,
        terms and solver) that are differentiated, through the steps undone so far.
    - `num_saved`: the number of saved states whose derivatives are not in `a_y` yet, those
        up to the time of `y`.
    - `size`: the size of `y`, as defined at `_SIZE_KEPT_PER_STEP`.
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
    """Returns the derivatives of the loss with respect to the `inputs` of `_solve`.

    - `residuals`: what the forward pass left.
    - `grad_out`: the derivatives with respect to what `_solve` returned.
    - `perturbed`: as `inputs`, with `True` in place of what is differentiated, and `False`
        in place of all else.

    The pass starts from the end of the solution. It undoes a step from `t0` to `t1` so:

    1. A step with negated increments leads back from the state at `t1` to that at `t0`.
    2. If there is a checkpoint at `t0`, the state is compared with it and replaced by it.
    3. Derivatives with respect to the states that were saved in the step are added.
    4. The transposed Jacobian of the step takes derivatives with respect to the state at
        `t1` to those with respect to the state at `t0` and the parameters.
    """
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
            return _y_after_step(eqx.combine(diff, nondiff), t0, t1, y0, solver_state)

        # In reversed time the step goes from `-t1` to `-t0`.
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
    a_y0 = saved.added_at_start(start.a_y, start.num_saved)
    return _checked_gradients(start.agrees, throw, (a_y0, *start.a_parameters))


def _y_after_step(parameters: PyTree, t0: Any, t1: Any, y0: Y, solver_state: Any) -> Y:
    """The state after a step with these `args`, terms and solver. `solver_state` is any
    state of the solver, for its structure."""
    args, terms, solver = parameters
    # The solver state belongs to another step, so the step is made as after a jump.
    made_jump = True
    y1, *_ = solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
    return y1


def _with_zeros(a_ys: PyTree[Array | None], y1: Y, ts: Array | None) -> PyTree[Array]:
    """`a_ys`, the derivatives with respect to the saved states, with zeros in place of
    `None`. Equinox passes `None` where the loss does not depend on a leaf. `y1` is one of
    the states, and `ts` are their times, or `None` if only the state at the end is
    saved."""
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
        """The `a_y` of the backward pass at the end of the solution. It is zero for states
        saved at `ts`: the first step back adds those that were saved at its end."""
        if self.ts is None:
            return jtu.tree_map(lambda rows: rows[-1], self.a_ys)
        return jtu.tree_map(lambda rows: jnp.zeros_like(rows[0]), self.a_ys)

    def added_in_step(self, t0: Any, t1: Any, a_y1: Y, num_saved: Array) -> _StepEnds:
        """Adds the derivatives with respect to the states that were saved in a step: after
        `t0` and up to `t1`. They are the last ones of the first `num_saved`. `a_y1` is the
        derivative with respect to the state at `t1`, through states that were saved later.

        Diffrax interpolates linearly in a step, `y = (1 - share) * y0 + share * y1` at the
        time `t0 + share * (t1 - t0)`. So a saved state with the derivative `a` adds
        `share * a` to `a_y1`, and `(1 - share) * a` to `a_y0`."""
        a_y0 = jtu.tree_map(jnp.zeros_like, a_y1)
        ends = _StepEnds(a_y1=a_y1, a_y0=a_y0, num_saved=num_saved)
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
        """Adds to `a_y0` the derivatives with respect to the first `num_saved` saved
        states, which are the initial state, saved before any step."""
        if self.ts is None:
            return a_y0
        is_at_start = jnp.arange(len(self.ts)) < num_saved

        def with_saved(a: Array, rows: Array) -> Array:
            return a + jnp.tensordot(is_at_start, rows, 1)

        return jtu.tree_map(with_saved, a_y0, self.a_ys)


def _meet_checkpoint(
    y_found: Y,
    checkpoints: PyTree[Array],
    i: IntScalarLike,
    steps_between: IntScalarLike,
    agreed_so_far: Bool[Array, ""],
    size: Array,
) -> tuple[Y, Bool[Array, ""]]:
    """Compares `y_found`, the state after `i` steps as the backward pass found it, with the
    checkpoint there. There is one after every `steps_between` steps.

    Returns a state and whether the pass agrees with all checkpoints from the end to here:

    - At a checkpoint: its state, and whether the pass `agreed_so_far` and the error of
        `y_found` is small in comparison with the `size` of the state.
    - Elsewhere: `y_found` and `agreed_so_far`."""
    # Elsewhere this reads the checkpoint before, and does not use it.
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
