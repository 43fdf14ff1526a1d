"""The stage equations of one step, carried out by the plan of a tableau."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import optimistix as optx
from equinox.internal import ω
from jaxtyping import Array, Bool, PyTree

from .._custom_types import RealScalarLike, Y
from .._materialize import materialize
from .._plan import Block, Plan
from .._tableau import FlatTableau, Stage
from .._terms import tree_sum


# The value of one stage: the change of the part of the state that it writes.
_Value: TypeAlias = PyTree[Array]
# What drives stages of one channel: from time and state to vector field times control.
Driven: TypeAlias = Callable[[RealScalarLike, Y], Y]


class Step(NamedTuple):
    """One step from `t0` over `h`, driven by `driven`, a function for each channel."""

    t0: RealScalarLike
    h: RealScalarLike
    driven: dict[str, Driven]


def take_step(
    plan: Plan, step: Step, y0: Y, solver: diffrax.AbstractSolver
) -> tuple[Y, diffrax.RESULTS]:
    """The end of the step, and whether it was reached. Implicit stages are solved by the
    root finder of `solver`."""
    stages, matrix = plan.tableau.stages, plan.tableau.matrix
    values: dict[int, _Value] = {}
    result = diffrax.RESULTS.successful

    def values_of(group: tuple[int, ...], values: dict[int, _Value]) -> _Value:
        """The values of stages of one kind; stacked, unless it is only one."""
        position = _position(y0, stages, matrix[list(group)], values)
        return _evaluate(step, [stages[i] for i in group], position)

    for block in plan.blocks:
        if len(block.unknown) > 0:
            unknown, solved = _solve(block, values_of, values, stages, y0, solver)
            values |= unknown
            result = first_failure(result, solved)
        for group in block.explicit:
            evaluate = ft.partial(values_of, group, values)
            shared = _uses(plan.tableau, group) > 1
            values |= _unstack(group, materialize(evaluate) if shared else evaluate())

    y1 = _position(y0, stages, plan.tableau.weights[None], values)
    nonfinite: diffrax.RESULTS = diffrax.RESULTS.nonfinite  # pyright: ignore
    finite = diffrax.RESULTS.where(_all_finite(y1), result, nonfinite)
    return y1, first_failure(result, finite)


def _uses(tableau: FlatTableau, group: tuple[int, ...]) -> int:
    """How many positions the values of `group` enter, the end of the step included."""
    columns = np.vstack([tableau.matrix, tableau.weights])[:, list(group)]
    return int(np.count_nonzero(columns.any(axis=1)))


def first_failure(first: diffrax.RESULTS, then: diffrax.RESULTS) -> diffrax.RESULTS:
    return diffrax.RESULTS.where(first == diffrax.RESULTS.successful, then, first)


def _solve(
    block: Block, values_of, known, stages, y0, solver
) -> tuple[dict[int, _Value], diffrax.RESULTS]:
    groups = block.unknown

    def complete(unknown: list[_Value]) -> dict[int, _Value]:
        values = dict(known)
        for group, value in zip(groups, unknown):
            values |= _unstack(group, value)
        return values

    def residual(unknown: list[_Value], _) -> list[_Value]:
        values = complete(unknown)
        for group in block.explicit:
            values |= _unstack(group, values_of(group, values))
        image = [values_of(group, values) for group in groups]
        return (unknown**ω - image**ω).ω

    # A stage where it would be if this block did not move at all.
    guess = [values_of(group, known) for group in groups]
    written = [_part(y0, stages[group[0]].writes) for group in groups]
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        raise ValueError(
            f"The tableau of `{type(solver).__name__}` has implicit stages. Let the class "
            "also subclass `diffrax_symplectic.AbstractImplicitStages`."
        )
    finder = solver.root_finder
    linear_solver = getattr(finder, "linear_solver", lx.AutoLinearSolver(None))
    sol = optx.root_find(
        residual,
        finder,
        guess,
        options=dict(scale=jtu.Partial(_scale, written)),
        max_steps=solver.root_find_max_steps,
        adjoint=optx.ImplicitAdjoint(linear_solver=linear_solver),
        throw=False,
    )
    solved = {i: v for i, v in complete(sol.value).items() if i not in known}
    return solved, diffrax.RESULTS.promote(sol.result)


def _scale(written: list[_Value], unknown: list[_Value]) -> list:
    """How large the state is that the unknown stage values change."""
    return jtu.tree_map(lambda x, k: jnp.abs(x) + jnp.abs(k), written, unknown)


def _unstack(group: tuple[int, ...], value: _Value) -> dict[int, _Value]:
    if len(group) == 1:
        return {group[0]: value}
    return {i: jtu.tree_map(lambda v: v[j], value) for j, i in enumerate(group)}


def _evaluate(step: Step, stages: list[Stage], y: Y) -> _Value:
    """The values of stages of one kind at their positions `y`."""
    first = stages[0]

    def value(c, y):
        t = step.t0 + c * step.h
        total = tree_sum([step.driven[name](t, y) for name in first.channels])
        return _part(total, first.writes)

    if len(stages) == 1:
        return value(first.c, y)
    # Under `vmap`, for code and arrays of the size of one evaluation, not of many.
    c = [stage.c for stage in stages]
    if len(set(c)) == 1:
        return jax.vmap(value, in_axes=(None, 0))(c[0], y)
    return jax.vmap(value)(jnp.asarray(c, jnp.result_type(step.h, float)), y)


def _part(y: Y, part: str) -> PyTree[Array]:
    return y if part == "y" else y["pq".index(part)]


def _position(
    y0: Y, stages: tuple[Stage, ...], rows: np.ndarray, values: dict[int, _Value]
) -> PyTree[Array]:
    """`y0 + sum_i rows[:, i] values[i]`, over the values there are. Stacked, unless it is
    only one row."""

    def scaled(i: int) -> PyTree[Array]:
        column = rows[:, i]
        if len(column) == 1:
            weight = float(column[0])
            return values[i] if weight == 1 else (weight * values[i] ** ω).ω
        return jtu.tree_map(
            lambda v: column.astype(v.dtype).reshape(-1, *[1] * v.ndim) * v, values[i]
        )

    def add(part: str) -> PyTree[Array]:
        base = _part(y0, part)
        total = None
        for i in values:
            if rows[:, i].any() and stages[i].writes == part:
                total = scaled(i) if total is None else (total**ω + scaled(i) ** ω).ω
        if total is None:
            stack = lambda x: jnp.broadcast_to(x, (len(rows), *jnp.shape(x)))
            return base if len(rows) == 1 else jtu.tree_map(stack, base)
        # The small terms first: fewer roundings of the size of the state.
        return (base**ω + total**ω).ω

    return add("y") if stages[0].writes == "y" else (add("p"), add("q"))


def _all_finite(y: Y) -> Bool[Array, ""]:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(y)]))
