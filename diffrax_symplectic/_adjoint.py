"""Gradients by stepping back along the solution, for reversible solvers."""

import dataclasses
import functools as ft
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
from ._compat import nondifferentiable_backward, reversed_in_time, while_loop, ω
from ._custom_types import IntScalarLike, RealScalarLike, Y
from ._solver import (
    AbstractSplitting,
    AbstractSymplecticRungeKutta,
    BAOAB,
    NinomiyaVictoir,
)
from ._tableau import is_own_inverse, make_plan


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

    **Solvers:** tableaus that are reversible, as determined from their coefficients:
    [`diffrax_symplectic.ImplicitMidpoint`][], [`diffrax_symplectic.StormerVerlet`][],
    [`diffrax_symplectic.StrangGauss`][], [`diffrax_symplectic.LevyAreaMidpoint`][], and
    possibly your own; [`diffrax_symplectic.NinomiyaVictoir`][] and
    [`diffrax_symplectic.BAOAB`][]; and [`diffrax_symplectic.Damped`][] or
    [`diffrax_symplectic.LinearFlow`][] around one of these. With friction, rounding errors
    grow by $e^{\gamma t}$ on the way back: use more checkpoints.

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
        _check_supported(solver, stepsize_controller, event, saveat)
        y = init_state.y
        # Each step of the backward pass recomputes the solver state (see `made_jump`).
        stop = lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x
        fixed = jtu.tree_map(stop, init_state.solver_state)
        kwargs |= dict(
            stepsize_controller=stepsize_controller,
            saveat=saveat,
            init_state=dataclasses.replace(init_state, y=object(), solver_state=fixed),
        )
        final_state, aux_stats = _solve(
            (y, args, terms, solver), adjoint=self, **kwargs
        )
        ys = final_state.save_state.ys
        final_state = nondifferentiable_backward(final_state, symbolic=False)
        return eqx.tree_at(lambda s: s.save_state.ys, final_state, ys), aux_stats


ReversingAdjoint.__init__.__doc__ = """**Arguments:**

- `checkpoints`: the number of states to save. Use more if rounding errors grow fast. They
    cost memory, and do not save time.

**Raises:** a `ValueError` if `checkpoints` is not a positive integer.
"""


def _check_supported(solver, controller, event, saveat) -> None:
    sub = saveat.subs
    one = isinstance(sub, diffrax.SubSaveAt) and not saveat.dense
    more = not one or sub.steps or sub.t0 or (sub.t1 and sub.ts is not None)
    known = diffrax.ConstantStepSize | diffrax.StepTo
    faults = {
        "needs a reversible solver, such as `ImplicitMidpoint`, "
        f"`StormerVerlet` or `StrangGauss`; got `{type(solver).__name__}`":
            not _undoes_its_steps(solver),
        "needs steps that are known in advance: `stepsize_controller=diffrax."
        "ConstantStepSize()` or `diffrax.StepTo(ts)`; got "
        f"`{type(controller).__name__}`": not isinstance(controller, known),
        "does not support events": event is not None,
        "only saves states, by `SaveAt(t1=True)` or `SaveAt(ts=...)`. Instead of "
        "`SaveAt(fn=...)` apply the function to `sol.ys`":
            more or sub.fn is not diffrax.SubSaveAt(t1=True).fn,
    }  # fmt: skip
    for fault, found in faults.items():
        if found:
            raise ValueError(
                f"`ReversingAdjoint` {fault}. Alternatively pass "
                "`adjoint=diffrax.RecursiveCheckpointAdjoint()`."
            )


def _undoes_its_steps(solver: Any) -> bool:
    # `isinstance` would look through wrappers, such as `diffrax.HalfSolver`.
    kind = type(solver)
    # With negated increments `NinomiyaVictoir` takes its flows in reverse order.
    if issubclass(kind, NinomiyaVictoir | BAOAB):
        return True
    if issubclass(kind, AbstractSplitting):
        return _undoes_its_steps(solver.solver)
    if not issubclass(kind, AbstractSymplecticRungeKutta):
        return False
    return is_own_inverse(make_plan(solver.tableau.flatten()).tableau)


@eqx.filter_custom_vjp
def _solve(inputs, *, adjoint, throw, **kwargs):
    del throw
    return _run(adjoint, inputs, ft.partial(while_loop, kind="lax"), kwargs)


def _run(adjoint, inputs, outer_while_loop, kwargs):
    y, args, terms, solver = inputs
    init_state = eqx.tree_at(lambda s: s.y, kwargs["init_state"], y)
    return adjoint._loop(
        **kwargs | {"init_state": init_state},
        args=args,
        terms=terms,
        solver=solver,
        event=None,
        inner_while_loop=ft.partial(while_loop, kind="lax"),
        outer_while_loop=outer_while_loop,
    )


@_solve.def_fwd
def _solve_fwd(perturbed, inputs, *, adjoint, throw, **kwargs):
    del perturbed, throw
    every = _Steps.of(kwargs).between(adjoint.checkpoints)
    recorded = []

    def recording_while_loop(cond_fun, body_fun, init_val, *, buffers, **options):
        rows = jtu.tree_map(
            lambda x: jnp.zeros((adjoint.checkpoints, *jnp.shape(x)), x.dtype),
            init_val.y,
        )

        def body(carry):
            state, rows = carry
            row, rest = jnp.divmod(state.num_steps, every)
            # Indices beyond the last row are dropped.
            row = jnp.where(rest == 0, row, adjoint.checkpoints)
            save = lambda x, rows: rows.at[row].set(x, mode="drop")
            return body_fun(state), jtu.tree_map(save, state.y, rows)

        final, rows = while_loop(
            lambda carry: cond_fun(carry[0]),
            body,
            (init_val, rows),
            buffers=lambda carry: buffers(carry[0]),
            kind="lax",
            **options,
        )
        recorded.append(rows)
        return final

    out = _run(adjoint, inputs, recording_while_loop, kwargs)
    final_state, _ = out
    index = final_state.save_state.saveat_ts_index
    return out, (recorded[0], final_state.y, final_state.num_steps, index)


class _Steps(NamedTuple):
    """The times of the steps of a solve, computed by its controller."""

    controller: diffrax.AbstractStepSizeController
    init_state: Any

    @staticmethod
    def of(kwargs: dict) -> "_Steps":
        return _Steps(kwargs["stepsize_controller"], kwargs["init_state"])

    def between(self, checkpoints: int) -> IntScalarLike:
        """The number of steps between two saved states."""
        if isinstance(self.controller, diffrax.StepTo):
            number = len(self.controller.ts) - 1
        else:
            _, number, *_ = self.init_state.controller_state
        return jnp.maximum(1, -(-jnp.asarray(number) // checkpoints))

    def time(self, i: IntScalarLike) -> RealScalarLike:
        """The time after `i` steps."""
        if isinstance(self.controller, diffrax.StepTo):
            return self.controller.ts[i]
        _, *fixed = self.init_state.controller_state
        first, second = self.init_state.tprev, self.init_state.tnext
        # The controller computes times from the number of steps alone.
        _, _, later, *_ = self.controller.adapt_step_size(
            first, second, None, None, None, None, 1, (i - 1, *fixed)
        )
        return jnp.where(i == 1, second, later)


class _Walk(NamedTuple):
    """The state of the backward pass."""

    # The number of steps from the start, and the state there.
    i: Array
    y: Y
    # The derivatives of the loss with respect to this state, and to the parameters so far.
    a_y: Y
    a_parameters: PyTree[Array]
    # The number of saved times before this one.
    saved: Array
    # The size of nearby states.
    size: Array
    arrived: Bool[Array, ""]


@_solve.def_bwd
def _solve_bwd(residuals, grad_out, perturbed, inputs, *, adjoint, throw, **kwargs):
    rows, y1, num_steps, saved = residuals
    sub = kwargs["saveat"].subs
    init_state, steps = kwargs["init_state"], _Steps.of(kwargs)
    every = steps.between(adjoint.checkpoints)
    _, *parameters = inputs
    _, *is_perturbed = perturbed
    diff, nondiff = eqx.partition(parameters, is_perturbed)
    # Outputs that the loss does not depend on have no derivative.
    number = 1 if sub.ts is None else len(sub.ts)
    g = jtu.tree_map(
        lambda x, g: jnp.zeros((number, *jnp.shape(x)), x.dtype) if g is None else g,
        y1,
        grad_out[0].save_state.ys,
        is_leaf=lambda x: x is None,
    )

    def step(y, diff, i, back: bool):
        args, terms, solver = eqx.combine(diff, nondiff)
        t0, t1 = steps.time(i), steps.time(i + 1)
        if back:
            t0, t1, terms = -t1, -t0, reversed_in_time(terms)
        # As after a jump, since the solver state belongs to another step.
        return solver.step(terms, t0, t1, y, args, init_state.solver_state, True)[0]

    def body(walk: _Walk) -> _Walk:
        i = walk.i - 1
        before = step(walk.y, diff, i, True)
        size = jnp.maximum(optx.max_norm(before), _PER_STEP * walk.size)
        y, arrived = _begin_anew(before, rows, i, every, walk.arrived, size)
        a_y, a_y0, saved = walk.a_y, (0 * walk.a_y**ω).ω, walk.saved
        if sub.ts is not None:
            t0, t1 = steps.time(i), steps.time(i + 1)
            a_y, a_y0, saved = _saved_between(t0, t1, sub.ts, g, a_y, a_y0, saved)
        _, vjp = jax.vjp(lambda y, diff: step(y, diff, i, False), y, diff)
        through, a_parameters = vjp(a_y)
        total = (walk.a_parameters**ω + a_parameters**ω).ω
        return _Walk(i, y, (a_y0**ω + through**ω).ω, total, saved, size, arrived)

    start = jtu.tree_map(lambda g: g[-1] if sub.ts is None else 0 * g[0], g)
    zeros = jtu.tree_map(jnp.zeros_like, diff)
    at, size, yes = jnp.asarray(num_steps), optx.max_norm(y1), jnp.array(True)
    walk = _Walk(at, y1, start, zeros, jnp.asarray(saved), size, yes)
    walk = lax.while_loop(lambda walk: walk.i > 0, body, walk)
    a_y = walk.a_y
    if sub.ts is not None:
        # States saved at the start itself.
        before = jnp.arange(len(sub.ts)) < walk.saved
        a_y = jtu.tree_map(lambda a, g: a + jnp.tensordot(before, g, 1), a_y, g)
    return _if_arrived(walk.arrived, throw, (a_y, *walk.a_parameters))


# The fraction of its size that a state passes to the one before it. Thus a start at rest,
# where weak increments may leave it for dozens of steps, gets the size of later states.
_PER_STEP = 0.9


def _begin_anew(
    y: Y, rows: PyTree[Array], i, every, arrived, size: Array
) -> tuple[Y, Bool[Array, ""]]:
    """The state after `i` steps, replaced by the checkpoint if there is one, and whether
    both agree, for states of this `size`."""
    row, rest = jnp.divmod(i, every)
    exact = jtu.tree_map(lambda rows: rows[row], rows)
    error = optx.max_norm((y**ω - exact**ω).ω)
    eps = float(jnp.finfo(error.dtype).eps)
    close = error <= eps ** (2 / 3) * jnp.maximum(size, optx.max_norm(exact))
    here = rest == 0
    y = jtu.tree_map(lambda walked, saved: jnp.where(here, saved, walked), y, exact)
    return y, arrived & (close | ~here)


def _saved_between(t0, t1, ts, g, a_y, a_y0, saved):
    """Adds the derivatives with respect to the states saved between `t0` and `t1`, which
    are interpolated linearly."""

    def add(carry):
        a_y, a_y0, saved = carry
        share = (ts[saved - 1] - t0) / (t1 - t0)
        of = lambda x, share: jtu.tree_map(lambda x, g: x + share * g[saved - 1], x, g)
        return of(a_y, share), of(a_y0, 1 - share), saved - 1

    # If no saved time is left, this reads the last one, but does not use it.
    more = lambda carry: (carry[2] > 0) & (ts[carry[2] - 1] > t0)
    return lax.while_loop(more, add, (a_y, a_y0, saved))


def _if_arrived(arrived: Bool[Array, ""], throw: bool, gradients: PyTree) -> PyTree:
    """The gradients; or if the backward pass failed, an error when run, or NaN."""
    if throw:
        return eqx.error_if(
            gradients,
            ~arrived,
            "`ReversingAdjoint` could not reconstruct the solution: rounding errors grew "
            "too large between two checkpoints. Increase `checkpoints`, or pass "
            "`adjoint=diffrax.RecursiveCheckpointAdjoint()`.",
        )
    nan = lambda x: jnp.where(arrived, x, cast(Array, jnp.nan))
    return jtu.tree_map(nan, gradients)
