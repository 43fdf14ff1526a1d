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
        # Each step of the backward pass recomputes the solver state (see `made_jump`).
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
    """Raises a `ValueError` for solves that the backward pass does not know how to
    undo."""
    known_steps = diffrax.ConstantStepSize | diffrax.StepTo
    if not _undoes_its_steps(solver):
        fault = (
            "needs a reversible solver, such as `ImplicitMidpoint`, `StormerVerlet` or "
            f"`StrangGauss`; got `{type(solver).__name__}`"
        )
    elif not isinstance(controller, known_steps):
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
    """Whether states are saved at the end or at given times, and nothing else is."""
    sub_saveat = saveat.subs
    # Several of them would be a PyTree.
    if saveat.dense or not isinstance(sub_saveat, diffrax.SubSaveAt):
        return False
    saves_both = sub_saveat.t1 and sub_saveat.ts is not None
    saves_more = sub_saveat.steps or sub_saveat.t0 or saves_both
    return not saves_more and saves_states(sub_saveat)


def _undoes_its_steps(solver: Any) -> bool:
    """Whether a step with negated increments leads back to where a step began, which is
    known for solvers of this package only."""
    return is_solver(solver) and solver.undoes_its_steps


# Equinox passes to the rules below what is passed here, in the same way: `inputs` are
# differentiated, keyword arguments are not.
@eqx.filter_custom_vjp
def _solve(inputs, *, adjoint, throw, **kwargs):
    del throw
    return _run(adjoint, inputs, ft.partial(while_loop, kind="lax"), kwargs)


def _run(adjoint: ReversingAdjoint, inputs: Any, outer_while_loop: Callable, kwargs):
    """The final state of Diffrax's loop, and statistics. `inputs` are differentiated:
    state, `args`, terms and solver. `kwargs` are the other arguments of `loop`."""
    y, args, terms, solver = inputs
    init_state = with_y(kwargs["init_state"], y)
    kwargs = kwargs | {"init_state": init_state}
    return run_steps(
        adjoint, outer_while_loop, args=args, terms=terms, solver=solver, **kwargs
    )


class _Residuals(NamedTuple):
    """What the forward pass leaves for the backward pass.

    - `checkpoints`: the saved states, evenly spaced over the steps, along the first axis.
    - `y1`: the state at the end.
    - `num_steps`: the number of steps made.
    - `num_saved`: the number of saved times.
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
    checkpoints_of_loop = []

    def recording_while_loop(cond_fun, body_fun, init_val, **options):
        final, checkpoints = _while_loop_with_checkpoints(
            adjoint.checkpoints,
            steps_between,
            cond_fun,
            body_fun,
            init_val,
            **options,
        )
        # Diffrax returns only its own state, so the checkpoints leave by this list.
        checkpoints_of_loop.append(checkpoints)
        return final

    out = _run(adjoint, inputs, recording_while_loop, kwargs)
    final_state, _ = out
    final = solve_state(final_state)
    [checkpoints] = checkpoints_of_loop
    return out, _Residuals(
        checkpoints=checkpoints,
        y1=final.y,
        num_steps=final.num_steps,
        num_saved=final.num_saved,
    )


def _steps_between(times: StepTimes, num_checkpoints: int) -> IntScalarLike:
    """The number of steps between two checkpoints."""
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
    """Diffrax's loop over steps, which also carries the checkpoints, a row for each: its
    final state, and the checkpoints."""

    def empty_rows(x: Array) -> Array:
        return jnp.zeros((num_checkpoints, *jnp.shape(x)), x.dtype)

    def is_going(carry):
        state, _ = carry
        return cond_fun(state)

    def record_and_step(carry):
        state, rows = carry
        before_step = solve_state(state)
        row, rest = jnp.divmod(before_step.num_steps, steps_between)
        # States between checkpoints go to the row after the last one, which `save` drops.
        row = jnp.where(rest == 0, row, num_checkpoints)

        def save(x: Array, saved: Array) -> Array:
            return saved.at[row].set(x, mode="drop")

        return body_fun(state), jtu.tree_map(save, before_step.y, rows)

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
    - `y`: the state there.
    - `a_y`, `a_parameters`: the derivatives of the loss with respect to this state, and to
        the parameters so far.
    - `num_saved`: the number of saved times before this one.
    - `size`: the largest entry of this state, or of a later one with a discount for each
        step between.
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
    checkpoints, y1, num_steps, num_saved = residuals
    ts = kwargs["saveat"].subs.ts
    times = StepTimes(kwargs["stepsize_controller"], kwargs["init_state"])
    steps_between = _steps_between(times, adjoint.checkpoints)
    _, *parameters = inputs
    _, *is_perturbed = perturbed
    diff, nondiff = eqx.partition(parameters, is_perturbed)
    step = ft.partial(_step_of_solve, times, nondiff)
    final_grad, _ = grad_out
    num_times = 1 if ts is None else len(ts)
    a_ys = _with_zeros(solve_state(final_grad).ys, y1, num_times)

    def is_going(walk: _Walk) -> Bool[Array, ""]:
        return walk.i > 0

    def step_back(walk: _Walk) -> _Walk:
        i = walk.i - 1
        y_found = step(walk.y, diff, i, back=True)
        size = jnp.maximum(optx.max_norm(y_found), _SIZE_KEPT_PER_STEP * walk.size)
        y, agrees = _meet_checkpoint(
            y_found, checkpoints, i, steps_between, walk.agrees, size
        )
        cotangents = _StepCotangents(
            a_y1=walk.a_y,
            a_y0=jtu.tree_map(jnp.zeros_like, walk.a_y),
            num_saved=walk.num_saved,
        )
        if ts is not None:
            t0 = times.time(i)
            t1 = times.time(i + 1)
            cotangents = _with_saved_cotangents(t0, t1, ts, a_ys, cotangents)
        # The step is made forward again, from the state that was found, so that its
        # transposed Jacobian is exact.
        forward = ft.partial(step, i=i, back=False)
        _, vjp = jax.vjp(forward, y, diff)
        a_y_through_step, a_parameters_of_step = vjp(cotangents.a_y1)
        return _Walk(
            i=i,
            y=y,
            a_parameters=(walk.a_parameters**ω + a_parameters_of_step**ω).ω,
            a_y=(cotangents.a_y0**ω + a_y_through_step**ω).ω,
            num_saved=cotangents.num_saved,
            size=size,
            agrees=agrees,
        )

    if ts is None:
        a_y1 = jtu.tree_map(lambda rows: rows[-1], a_ys)
    else:
        # States that were saved at the end, too, are added in the first step back, as all
        # that were saved after the start of that step.
        a_y1 = jtu.tree_map(lambda rows: jnp.zeros_like(rows[0]), a_ys)
    walk = _Walk(
        i=jnp.asarray(num_steps),
        y=y1,
        a_y=a_y1,
        a_parameters=jtu.tree_map(jnp.zeros_like, diff),
        num_saved=jnp.asarray(num_saved),
        size=optx.max_norm(y1),
        agrees=jnp.array(True),
    )
    walk = lax.while_loop(is_going, step_back, walk)
    a_y0 = walk.a_y
    if ts is not None:
        # Each step back passes the times after its start, so that those of states saved at
        # the start of the solve are left.
        is_at_start = jnp.arange(len(ts)) < walk.num_saved

        def with_saved_at_start(a: Array, rows: Array) -> Array:
            return a + jnp.tensordot(is_at_start, rows, 1)

        a_y0 = jtu.tree_map(with_saved_at_start, a_y0, a_ys)
    return _checked_gradients(walk.agrees, throw, (a_y0, *walk.a_parameters))


def _step_of_solve(
    times: StepTimes,
    nondiff: PyTree,
    y: Y,
    diff: PyTree[Array],
    i: IntScalarLike,
    back: bool,
) -> Y:
    """The state after one step from `y` between the times of steps `i` and `i + 1`, forward
    or back. `diff` and `nondiff` are the two parts of `args`, terms and solver: what is
    differentiated, and everything else."""
    args, terms, solver = eqx.combine(diff, nondiff)
    t0 = times.time(i)
    t1 = times.time(i + 1)
    if back:
        begin = -t1
        end = -t0
        terms = reversed_in_time(terms)
    else:
        begin = t0
        end = t1
    # The solver state belongs to another step, so the step is made as after a jump.
    made_jump = True
    solver_state = times.solver_state()
    y1, *_ = solver.step(terms, begin, end, y, args, solver_state, made_jump)
    return y1


def _with_zeros(grad_ys: PyTree[Array | None], y1: Y, num_times: int) -> PyTree[Array]:
    """The derivatives of the loss with respect to the states at all saved times, with zeros
    in place of `None`, which JAX gives where the loss does not depend on a leaf."""

    def or_zeros(y1_leaf: Array, grad: Array | None) -> Array:
        if grad is None:
            return jnp.zeros((num_times, *jnp.shape(y1_leaf)), y1_leaf.dtype)
        return grad

    return jtu.tree_map(or_zeros, y1, grad_ys, is_leaf=lambda x: x is None)


# The fraction of its size that a state passes to the one before it. Thus a start at rest,
# which weak increments may not leave for dozens of steps, gets the size of later states.
_SIZE_KEPT_PER_STEP = 0.9


def _meet_checkpoint(
    y_found: Y,
    checkpoints: PyTree[Array],
    i: IntScalarLike,
    steps_between: IntScalarLike,
    agreed_so_far: Bool[Array, ""],
    size: Array,
) -> tuple[Y, Bool[Array, ""]]:
    """The state after `i` steps: the checkpoint if there is one, and otherwise `y_found`;
    and whether the pass `agreed_so_far` and agrees with this checkpoint, for states of this
    `size`. `steps_between` is the number of steps from one checkpoint to the next."""
    # Between checkpoints this reads the checkpoint before, and does not use it.
    row, rest = jnp.divmod(i, steps_between)
    checkpoint = jtu.tree_map(lambda rows: rows[row], checkpoints)
    error = optx.max_norm((y_found**ω - checkpoint**ω).ω)
    # A third of the digits may be lost to rounding errors on the way. The gradients, which
    # are taken at states between checkpoints, then keep two thirds.
    eps = float(jnp.finfo(error.dtype).eps)
    agrees = error <= eps ** (2 / 3) * jnp.maximum(size, optx.max_norm(checkpoint))
    is_at_checkpoint = rest == 0

    def saved_if_there_is_one(found: Array, saved: Array) -> Array:
        return jnp.where(is_at_checkpoint, saved, found)

    y = jtu.tree_map(saved_if_there_is_one, y_found, checkpoint)
    return y, agreed_so_far & (agrees | ~is_at_checkpoint)


class _StepCotangents(NamedTuple):
    """Derivatives of the loss at a step, as saved times are passed on the way back.

    - `a_y1`: with respect to the state at the end of the step.
    - `a_y0`: with respect to the state at the start of the step, apart from its effect on
        the state at the end.
    - `num_saved`: the number of saved times that are not passed yet.
    """

    a_y1: Y
    a_y0: Y
    num_saved: Array


def _with_saved_cotangents(
    t0, t1, ts: Array, a_ys: PyTree[Array], cotangents: _StepCotangents
) -> _StepCotangents:
    """`cotangents` with the derivatives `a_ys` added with respect to the states that were
    saved at those times `ts` after `t0` and up to `t1`. Diffrax interpolates these states
    linearly: `(1 - share) * y0 + share * y1` at the time `t0 + share * (t1 - t0)`."""

    def with_share(a_y: Y, share: Array, index: Array) -> Y:
        return jtu.tree_map(lambda a, rows: a + share * rows[index], a_y, a_ys)

    def pass_one(cotangents: _StepCotangents) -> _StepCotangents:
        last = cotangents.num_saved - 1
        share = (ts[last] - t0) / (t1 - t0)
        a_y1 = with_share(cotangents.a_y1, share, last)
        a_y0 = with_share(cotangents.a_y0, 1 - share, last)
        return _StepCotangents(a_y1, a_y0, last)

    def has_more(cotangents: _StepCotangents) -> Bool[Array, ""]:
        # If no saved time is left, this reads the last one, but does not use it.
        num_saved = cotangents.num_saved
        return (num_saved > 0) & (ts[num_saved - 1] > t0)

    return lax.while_loop(has_more, pass_one, cotangents)


def _steps_without_inverse() -> str:
    """Steps of solvers for heat baths that shrink areas to zero, for messages: such as
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
    """The gradients, if the backward pass agrees with all checkpoints; otherwise an error
    when run, or without `throw` NaN."""
    if throw:
        return eqx.error_if(
            gradients,
            ~agrees,
            "`ReversingAdjoint` could not reconstruct the solution: rounding errors grew "
            "too large between two checkpoints, or a step has no inverse, as one of "
            f"{_steps_without_inverse()}. Increase `checkpoints`, change the step, or pass "
            "`adjoint=diffrax.RecursiveCheckpointAdjoint()`.",
        )

    # A gradient that is silently wrong would be worse.
    def or_nan(x: Array) -> Array:
        return jnp.where(agrees, x, cast(Array, jnp.nan))

    return jtu.tree_map(or_nan, gradients)
