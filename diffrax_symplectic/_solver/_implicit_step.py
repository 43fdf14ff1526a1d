"""One step: its stage equations solved, and differentiated as what they define."""

import functools as ft
import operator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool

from .._compat import unsolved_step_result, ω
from .._custom_types import BoolScalarLike, IntScalarLike, Y
from .._plan import Plan
from .._root_finder import (
    all_finite,
    differentiate,
    finish,
    improve,
    Measured,
    PicardNewton,
    start,
    Sweep,
)
from ._lanes import where_pending
from ._stages import closed, Stages, Step, Unknown


def take_step(
    plan: Plan, step: Step, y0: Y, solver: diffrax.AbstractSolver
) -> tuple[Y, diffrax.RESULTS]:
    """The end of the step, and whether it was reached. Implicit stages are solved by the
    root finder of `solver`."""
    if plan.num_unknown == 0:
        y1, unsolved = Stages(plan, step, y0).end([[]] * len(plan.blocks), True), False
    elif not isinstance(solver, diffrax.AbstractImplicitSolver):
        raise ValueError(
            f"The tableau of `{type(solver).__name__}` has implicit stages. Let the class "
            "also subclass `diffrax_symplectic.AbstractImplicitStages`."
        )
    else:
        finder, most = solver.root_finder, solver.root_find_max_steps
        y1, unsolved = _traced_once(plan, step, y0, finder, most)
    return y1, _result(unsolved, y1)


# Diffrax traces a step three times, or more.
@eqx.filter_jit
def _traced_once(plan: Plan, step: Step, y0: Y, finder: Any, max_steps: int):
    stages = Stages(plan, closed(step, y0), y0)
    y1, _, unsolved = _implicit_step(stages, finder=finder, max_steps=max_steps)
    return y1, unsolved


def first_failure(first: diffrax.RESULTS, then: diffrax.RESULTS) -> diffrax.RESULTS:
    return diffrax.RESULTS.where(first == diffrax.RESULTS.successful, then, first)


_UNSOLVED = (
    "The stage equations of a step were not solved. Take smaller steps; for Gaussian paths "
    "bound the increments with `TruncatedBrownianPath`; or, if the step is solvable but "
    "hard, raise `root_find_max_steps` of the solver (not `max_steps` of `diffeqsolve`)."
)


def _result(unsolved: BoolScalarLike, y1: Y) -> diffrax.RESULTS:
    R = diffrax.RESULTS
    stuck = unsolved_step_result(_UNSOLVED)
    finite = R.where(all_finite(y1), R.successful, R.nonfinite)  # pyright: ignore
    return R.where(unsolved, stuck, finite)


@eqx.filter_custom_jvp
def _implicit_step(
    stages: Stages, *, finder: Any, max_steps: int
) -> tuple[Y, Unknown, Bool[Array, ""]]:
    """The end of the step, the values of its unknown stages, and whether these do not
    solve the stage equations."""
    if not isinstance(finder, PicardNewton):
        unknown, unsolved = _by_root_find(stages, finder, max_steps)
        return stages.end(unknown), unknown, unsolved
    y1, unknown, unsolved = _by_blocks(stages, finder)
    rescue = lambda stages, value: _as_one_system(stages, value, finder, max_steps)
    if any(block.explicit for block in stages.plan.blocks):
        # The end of the step takes further evaluations, only for the paths concerned.
        return where_pending(rescue, unsolved, stages, (y1, unknown, unsolved))
    alone = lambda stages, value: rescue(stages, (None, *value))[1:]
    unknown, unsolved = where_pending(alone, unsolved, stages, (unknown, unsolved))
    return stages.end(unknown), unknown, unsolved


@_implicit_step.def_jvp
def _implicit_step_jvp(primals, tangents, *, finder, max_steps):
    (stages,), (t_stages,) = primals, tangents
    y1, unknown, unsolved = _implicit_step(stages, finder=finder, max_steps=max_steps)
    # Where there is no solution there is no derivative either. It is zero for such a
    # path, and no number that is not finite spoils what other paths have in common with it.
    failed = unsolved | ~all_finite(y1)
    root = jtu.tree_map(lambda k: jnp.where(failed, 0, k), unknown)

    is_none = lambda x: x is None
    fixed = jtu.tree_map(is_none, t_stages, is_leaf=is_none)
    still, moving = eqx.partition(stages, fixed, is_leaf=is_none)
    along = lambda fn: jax.jvp(
        lambda x: fn(eqx.combine(x, still), root), (moving,), (t_stages,)
    )[1]
    rhs = along(Stages.image)
    _, linear = jax.linearize(stages.image, root)
    t_unknown = differentiate(finder, linear, rhs)
    end = lambda x, k: eqx.combine(x, still).end(k)
    _, t_y1 = jax.jvp(end, (moving, root), (t_stages, t_unknown))
    t_y1, t_unknown = jtu.tree_map(lambda t: jnp.where(failed, 0, t), (t_y1, t_unknown))
    return (y1, unknown, unsolved), (t_y1, t_unknown, None)


def _by_blocks(stages: Stages, finder: PicardNewton):
    """The cheap iterations, block after block."""
    blocks = stages.plan.blocks
    guess = [stages.zero_of(block) for block in blocks]
    sweep = ft.partial(_sweep, stages, finder)
    found = start(finder, sweep, guess, Measured(stages.extent, stages.scale))
    keep = found.converged | found.near
    unknown = jtu.tree_map(lambda k: jnp.where(keep, k, 0), found.y)
    return stages.end(unknown, True), unknown, ~found.converged


def _sweep(
    stages: Stages, finder: PicardNewton, unknown: Unknown, sweeps: IntScalarLike
) -> Sweep:
    """One round of the cheap iterations in each block."""
    values, found = {}, []
    for i, (block, k) in enumerate(zip(stages.plan.blocks, unknown)):
        if len(block.unknown) > 0:

            def image(k, block=block, values=values):
                return stages.unknown_of(
                    block, stages.explicit_of(block, stages.given(block, values, k))
                )

            alone = lambda fn, i=i: lambda k: fn([[]] * i + [k])
            measured = Measured(alone(stages.extent), alone(stages.scale))
            found.append(improve(finder, image, k, measured, sweeps))
            k = found[-1].y
        else:
            found.append(Sweep([], [], [], True, True))
        values = stages.explicit_of(block, stages.given(block, values, k), keep=True)
    y, before, after, converged, near = zip(*found)
    all_of = ft.partial(ft.reduce, operator.and_)
    return Sweep(list(y), list(before), list(after), all_of(converged), all_of(near))


def _as_one_system(stages: Stages, value, finder: PicardNewton, max_steps: int):
    """Newton's method for all unknown stages together, from where the cheap iterations
    ended."""
    _, unknown, unsolved = value
    residual = lambda k: (k**ω - stages.image(k) ** ω).ω
    measured = Measured(stages.extent, stages.scale)
    unknown, solved = finish(finder, residual, measured, unknown, ~unsolved, max_steps)
    return stages.end(unknown), unknown, ~solved


def _by_root_find(stages: Stages, finder: Any, max_steps: int):
    """The whole step as one system, by any root finder."""
    if isinstance(finder, optx.BestSoFarRootFinder):
        raise ValueError(
            "`BestSoFarRootFinder` returns an iterate from before the last correction. It "
            "does not solve the stage equations. Pass the root finder within it."
        )
    guess = stages.image([stages.zero_of(block) for block in stages.plan.blocks])
    sol = optx.root_find(
        lambda k, stages: (k**ω - stages.image(k) ** ω).ω,
        finder,
        guess,
        args=stages,
        max_steps=max_steps,
        throw=False,
    )
    return sol.value, sol.result != optx.RESULTS.successful
