"""One step: its stage equations solved, and differentiated as what they define."""

import functools as ft
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool

from .._compat import unsolved_step_result, ω
from .._custom_types import Y
from .._plan import Plan
from .._root_finder import (
    all_finite,
    batched_together,
    differentiate,
    PicardNewton,
)
from ._stages import closed, Stages, Step, Unknown


# Whether stage equations were not solved; `None` where there are none.
Unsolved: TypeAlias = Bool[ArrayLike, ""] | None


def take_step(
    plan: Plan,
    step: Step,
    y0: Y,
    solver: diffrax.AbstractSolver,
    unsolved: Unsolved = None,
) -> tuple[Y, Unsolved]:
    """The end of the step, and whether its stage equations were not solved. The root finder
    of `solver` solves them, unless those of an earlier step were already `unsolved`."""
    if plan.num_unknown == 0:
        return Stages(plan, step, y0).end([[]] * len(plan.blocks)), unsolved
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        raise ValueError(
            f"The tableau of `{type(solver).__name__}` has implicit stages. Let the class "
            "also subclass `diffrax_symplectic.AbstractImplicitStages`."
        )
    unsolved = jnp.array(False) if unsolved is None else jnp.asarray(unsolved)
    finder, most = solver.root_finder, solver.root_find_max_steps
    return _traced_once(plan, step, y0, unsolved, finder, most)


# Diffrax traces a step three times, or more.
@eqx.filter_jit
def _traced_once(plan: Plan, step: Step, y0: Y, lost, finder: Any, max_steps: int):
    stages = Stages(plan, closed(step, y0), y0)
    y1, _, unsolved = _implicit_step(stages, lost, finder=finder, max_steps=max_steps)
    return y1, unsolved


_UNSOLVED = (
    "The stage equations of a step were not solved. Take smaller steps; for Gaussian paths "
    "bound the increments with `TruncatedBrownianPath`; or, if the step is solvable but "
    "hard, raise `root_find_max_steps` of the solver (not `max_steps` of `diffeqsolve`)."
)


def result_of(unsolved: Unsolved, y1: Y) -> diffrax.RESULTS:
    """Whether the end of a step was reached."""
    R = diffrax.RESULTS
    finite = R.where(all_finite(y1), R.successful, R.nonfinite)  # pyright: ignore
    if unsolved is None:
        return finite
    return R.where(unsolved, unsolved_step_result(_UNSOLVED), finite)


@eqx.filter_custom_jvp
def _implicit_step(
    stages: Stages, lost: Bool[Array, ""], *, finder: Any, max_steps: int
) -> tuple[Y, Unknown, Bool[Array, ""]]:
    """The end of the step, the values of its unknown stages, and whether these do not
    solve the stage equations. No time is spent on a path that is `lost`."""
    if isinstance(finder, optx.BestSoFarRootFinder):
        raise ValueError(
            "`BestSoFarRootFinder` returns an iterate from before the last correction. It "
            "does not solve the stage equations. Pass the root finder within it."
        )
    step = stages.step
    t0, h, y0, lost = batched_together(
        (step.t0, step.h, stages.y0, lost), eqx.filter(step.driven, eqx.is_array)
    )
    stages = Stages(stages.plan, step._replace(t0=t0, h=h), y0)
    return _solved(stages, lost, finder, max_steps)


@eqx.filter_jit
def _solved(stages: Stages, lost: Bool[Array, ""], finder: Any, max_steps: int):
    guess = [stages.zero_of(block) for block in stages.plan.blocks]
    if not isinstance(finder, PicardNewton):
        # That one begins with this.
        guess = stages.image(guess)
    numbers = range(len(stages.plan.blocks))
    sol = optx.root_find(
        lambda k, stages: (k**ω - stages.image(k) ** ω).ω,
        finder,
        guess,
        args=stages,
        options=dict(
            scale=stages.scale,
            blocks=[ft.partial(stages.image_of, i) for i in numbers],
            lost=lost,
        ),
        max_steps=max_steps,
        throw=False,
    )
    unsolved = lost | (sol.result != optx.RESULTS.successful)
    return stages.end(sol.value), sol.value, unsolved


@_implicit_step.def_jvp
def _implicit_step_jvp(primals, tangents, *, finder, max_steps):
    (stages, lost), (t_stages, _) = primals, tangents
    y1, unknown, unsolved = _implicit_step(
        stages, lost, finder=finder, max_steps=max_steps
    )
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
    t_unknown = differentiate(getattr(finder, "linear_solver", None), linear, rhs)
    end = lambda x, k: eqx.combine(x, still).end(k)
    _, t_y1 = jax.jvp(end, (moving, root), (t_stages, t_unknown))
    t_y1, t_unknown = jtu.tree_map(lambda t: jnp.where(failed, 0, t), (t_y1, t_unknown))
    return (y1, unknown, unsolved), (t_y1, t_unknown, None)
