"""A step by the plan of a tableau: its stages, and the solution of the stage equations with
implicit differentiation."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from .._batch import batched_like, materialize
from .._compat import ω
from .._custom_types import RealScalarLike, Y
from .._root_finder import all_finite, differentiate, Halves
from .._tableau import Block, FlatTableau, Group, Stage, StepPlan
from .._terms import tree_sum


# The value of a stage: the change of the part of the state that it writes. Of several
# stages evaluated together, their values are stacked along a first axis.
_Value: TypeAlias = PyTree[Array]
# The values of the stages known so far, by stage number.
Values: TypeAlias = dict[int, _Value]
# The values of the unknown stages: for each block, for each of its groups.
Unknown: TypeAlias = list[list[_Value]]
# The vector field of one channel times its control, as a function of time and state.
Driven: TypeAlias = Callable[[RealScalarLike, Y], Y]


class Step(NamedTuple):
    """One step.

    - `t0`, `h`: its start and size.
    - `driven`: for each channel the vector field times its control.
    """

    t0: RealScalarLike
    h: RealScalarLike
    driven: dict[str, Driven]


class Stages(eqx.Module):
    """The stages of one step, in the blocks of its plan. Unknown values count as zero."""

    plan: StepPlan = eqx.field(static=True)
    step: Step
    y0: Y

    def zero_of(self, block: Block) -> list[_Value]:
        """Zero for each unknown stage of a block."""

        def zero(group: Group) -> _Value:
            first = self.plan.tableau.stages[group[0]]
            # One stage alone is not stacked.
            stacked = (len(group),) if len(group) > 1 else ()

            def zeros(x: Array) -> Array:
                return jnp.zeros((*stacked, *jnp.shape(x)), jnp.result_type(x))

            return jtu.tree_map(zeros, _part(self.y0, first.writes))

        return [zero(group) for group in block.unknown]

    def solve_blocks(
        self, solve: Callable, guess: Unknown, pending: Bool[Array, ""]
    ) -> tuple[Unknown, Bool[Array, ""]]:
        """The unknown values of all blocks, one block after another, each with the values
        of earlier blocks; and whether all blocks are solved. `solve` is called as
        `solve(image, scale, guess, pending)` and returns these for one block."""
        values: Values = {}
        unknown = []
        all_solved = jnp.array(True)
        for block, k in zip(self.plan.blocks, guess):
            if block.unknown:
                k, block_solved = self._solve_block(block, values, solve, k, pending)
                all_solved = all_solved & block_solved
            unknown.append(k)
            values = self._with_block(block, values, k, keep=True)
        return unknown, all_solved

    def _solve_block(
        self,
        block: Block,
        known: Values,
        solve: Callable,
        guess: list[_Value],
        pending: Bool[Array, ""],
    ) -> tuple[list[_Value], Bool[Array, ""]]:
        """The unknown values of one block, and whether they solve its equations."""
        # For values that are pairs (p, q), sweeps update all momenta, then all positions.
        pairs = all(type(value) is tuple and len(value) == 2 for value in guess)

        def pack(k: list[_Value]) -> Any:
            return Halves(*zip(*k)) if pairs else k

        def unpack(k: Any) -> list[_Value]:
            return [*zip(*k)] if pairs else k

        def image(k: Any) -> Any:
            return pack(self._image(block, known, unpack(k)))

        def scale(k: Any) -> Any:
            return pack(self._scale(block, unpack(k)))

        k, is_solved = solve(image, scale, pack(guess), pending)
        return unpack(k), is_solved

    def image(self, unknown: Unknown) -> Unknown:
        r"""$\Phi$ for the whole step."""
        values: Values = {}
        image = []
        for block, k in zip(self.plan.blocks, unknown):
            image.append(self._image(block, values, k))
            values = self._with_block(block, values, k)
        return image

    def _image(self, block: Block, known: Values, k: list[_Value]) -> list[_Value]:
        r"""$\Phi$ for the unknown values `k` of one block."""
        values = self._with_block(block, known, k)
        return [self._evaluate_group(group, values) for group in block.unknown]

    def _with_block(
        self, block: Block, values: Values, unknown: list[_Value], keep: bool = False
    ) -> Values:
        """`values` with the stages of a block added. With `keep`, explicit stages that
        enter several positions are computed only once."""
        # A new dictionary each time: the root finder traces an iteration more than once,
        # from the same known values.
        for group, value in zip(block.unknown, unknown):
            values = values | _unstack(group, value)
        for group in block.explicit:
            evaluate = ft.partial(self._evaluate_group, group, values)
            # Within an iteration, storing a value costs as much as computing it again.
            shared = keep and _uses(self.plan.tableau, group) > 1
            new = materialize(evaluate) if shared else evaluate()
            values = values | _unstack(group, new)
        return values

    def end(self, unknown: Unknown) -> Y:
        """The end of the step."""
        tableau = self.plan.tableau
        values: Values = {}
        for block, k in zip(self.plan.blocks, unknown):
            values = self._with_block(block, values, k, keep=True)
        return _position(self.y0, tableau.stages, tableau.weights[None], values)

    def scale(self, unknown: Unknown) -> Unknown:
        """The size of the state that unknown values change, which sets their tolerance."""
        return [self._scale(block, k) for block, k in zip(self.plan.blocks, unknown)]

    def _scale(self, block: Block, unknown: list[_Value]) -> list[_Value]:
        def size(y: Array, k: Array) -> Array:
            # Never below the value itself, so that a step from rest has a scale.
            return jnp.abs(y) + jnp.abs(k)

        def scale(group: Group, value: _Value) -> _Value:
            changed = _part(self.y0, self.plan.tableau.stages[group[0]].writes)
            return jtu.tree_map(size, changed, value)

        return [scale(group, k) for group, k in zip(block.unknown, unknown)]

    def _evaluate_group(self, group: Group, values: Values) -> _Value:
        """The values of stages of one kind, stacked unless there is only one."""
        tableau = self.plan.tableau
        rows = tableau.matrix[list(group)]
        position = _position(self.y0, tableau.stages, rows, values)
        return _evaluate(self.step, [tableau.stages[i] for i in group], position)


def with_explicit_arrays(step: Step, y0: Y) -> Step:
    """The same step, with the arrays that its functions capture made explicit. Each
    function is traced once, here."""
    # Converted functions accept only the types that they were traced for.
    dtype = jnp.result_type(step.t0, step.h, float)
    t0 = jnp.asarray(step.t0, dtype)
    h = jnp.asarray(step.h, dtype)
    driven = {
        name: eqx.filter_closure_convert(fn, t0, y0) for name, fn in step.driven.items()
    }
    return Step(t0, h, driven)


def _uses(tableau: FlatTableau, group: Group) -> int:
    """The number of positions that the values of `group` enter, including the end of the
    step."""
    columns = np.vstack([tableau.matrix, tableau.weights])[:, list(group)]
    return int(np.count_nonzero(columns.any(axis=1)))


def _unstack(group: Group, value: _Value) -> Values:
    """The values of a group, one by one."""
    if len(group) == 1:
        return {group[0]: value}
    return {
        i: jtu.tree_map(lambda stacked: stacked[place], value)
        for place, i in enumerate(group)
    }


def _evaluate(step: Step, stages: list[Stage], y: Y) -> _Value:
    """The values of stages of one kind at their positions `y`."""
    first = stages[0]

    def value(c: RealScalarLike, y: Y) -> _Value:
        t = step.t0 + c * step.h
        total = tree_sum([step.driven[name](t, y) for name in first.channels])
        return _part(total, first.writes)

    if len(stages) == 1:
        return value(first.c, y)
    # `vmap` keeps the compiled code as small as for one evaluation.
    times = [stage.c for stage in stages]
    if len(set(times)) == 1:
        # What depends on time alone is then computed once.
        return jax.vmap(value, in_axes=(None, 0))(times[0], y)
    return jax.vmap(value)(jnp.asarray(times, jnp.result_type(step.h, float)), y)


def _part(y: PyTree, part: str) -> PyTree:
    """The state `y`, or its half `"p"` or `"q"`."""
    return y if part == "y" else y["pq".index(part)]


def _position(
    y0: Y, stages: tuple[Stage, ...], rows: np.ndarray, values: Values
) -> PyTree[Array]:
    """`y0 + sum_i rows[:, i] values[i]`, stacked unless there is only one row. `values` may
    hold stages that these rows do not use, with weights of zero; stages that are not in it
    count as zero."""

    def moved(part: str) -> PyTree[Array]:
        """The state, or half of it, moved by the stages that write it."""
        base = _part(y0, part)
        # Zeros are left out here, since XLA may not drop products with zero, which are not
        # zero for infinite values.
        products = [
            _product(rows[:, i], value)
            for i, value in values.items()
            if rows[:, i].any() and stages[i].writes == part
        ]
        if products:
            # Add the small terms first, for fewer roundings at the size of the state.
            return (base**ω + tree_sum(products) ** ω).ω
        return base if len(rows) == 1 else jtu.tree_map(for_each_row, base)

    def for_each_row(x: Array) -> Array:
        return jnp.broadcast_to(x, (len(rows), *jnp.shape(x)))

    # A tableau writes whole states, or halves of states, but not both.
    return moved("y") if stages[0].writes == "y" else (moved("p"), moved("q"))


def _product(weights: np.ndarray, value: _Value) -> PyTree[Array]:
    """A value times each of these weights, stacked unless there is only one."""
    if len(weights) == 1:
        weight = float(weights[0])
        # A product with one would stay in the program.
        return value if weight == 1 else (weight * value**ω).ω

    def products(x: Array) -> Any:
        as_column = (-1, *[1] * x.ndim)
        return weights.astype(x.dtype).reshape(as_column) * x

    return jtu.tree_map(products, value)


# The outcome of the stage equations, or of an earlier failed step; `None` if there are
# none.
Outcome: TypeAlias = optx.RESULTS | None


def take_step(
    plan: StepPlan,
    step: Step,
    y0: Y,
    solver: diffrax.AbstractSolver,
    before: Outcome = None,
) -> tuple[Y, Outcome]:
    """The end of the step, and whether its stage equations were solved, by the root finder
    of `solver`. A path that failed `before` is skipped."""
    if plan.num_unknown == 0:
        nothing = [[]] * len(plan.blocks)
        return Stages(plan, step, y0).end(nothing), before
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        raise ValueError(
            f"The tableau of `{type(solver).__name__}` has implicit stages. Let the class "
            "also inherit from `diffrax_symplectic.AbstractImplicitStages`."
        )
    before = no_failure() if before is None else before
    return _traced_once(
        plan, step, y0, before, solver.root_finder, solver.root_find_max_steps
    )


def no_failure() -> optx.RESULTS:
    """The result before the first step, as arrays, since it is carried by a loop."""
    return jtu.tree_map(jnp.asarray, optx.RESULTS.successful)


def _failed(result: optx.RESULTS) -> Bool[Array, ""]:
    return result != optx.RESULTS.successful


def result_of(outcome: Outcome, y1: Y) -> diffrax.RESULTS:
    """The result of a step."""
    R = diffrax.RESULTS
    # Finite stages may still have an end that overflows.
    finite = R.where(all_finite(y1), R.successful, R.nonfinite)  # pyright: ignore
    if outcome is None:
        return finite
    return R.where(_failed(outcome), R.promote(outcome), finite)


# Diffrax traces a step three times or more.
@eqx.filter_jit
def _traced_once(
    plan: StepPlan, step: Step, y0: Y, before, finder: Any, max_steps: int
):
    stages = Stages(plan, with_explicit_arrays(step, y0), y0)
    y1, _, outcome = _implicit_step(stages, before, finder=finder, max_steps=max_steps)
    return y1, outcome


@eqx.filter_custom_jvp
def _implicit_step(
    stages: Stages, before: optx.RESULTS, *, finder: Any, max_steps: int
) -> tuple[Y, Unknown, optx.RESULTS]:
    """The end of the step, the values of its unknown stages, and whether they solve the
    stage equations. No time is spent on paths that failed `before`."""
    if isinstance(finder, optx.BestSoFarRootFinder):
        raise ValueError(
            "`BestSoFarRootFinder` returns an iterate from before the last correction, "
            "which does not solve the stage equations. Pass the root finder that it wraps."
        )
    lost = _failed(before)
    guess = [stages.zero_of(block) for block in stages.plan.blocks]
    guess, lost = batched_like((guess, lost), (stages, before))
    # Optimistix stops at once if the guess is not finite.
    guess = jtu.tree_map(lambda k: jnp.where(lost, jnp.nan, k), guess)
    sol = optx.root_find(
        lambda k, stages: (k**ω - stages.image(k) ** ω).ω,
        finder,
        guess,
        args=stages,
        # Root finders of other packages ignore options that they do not know.
        options=dict(scale=stages.scale, solve_blocks=Stages.solve_blocks),
        max_steps=max_steps,
        throw=False,
    )
    result = optx.RESULTS.where(lost, before, sol.result)
    return stages.end(sol.value), sol.value, result


@_implicit_step.def_jvp
def _implicit_step_jvp(primals, tangents, *, finder, max_steps):
    stages, before = primals
    t_stages, _ = tangents
    y1, unknown, result = _implicit_step(
        stages, before, finder=finder, max_steps=max_steps
    )
    # Without a solution there is no derivative. It is set to zero, so that a failed path
    # does not spoil gradients that are summed over a batch.
    failed = _failed(result) | ~all_finite(y1)
    root = jtu.tree_map(lambda k: jnp.where(failed, 0, k), unknown)

    # What is not differentiated has `None` for a tangent, which `jax.jvp` does not take.
    fixed = jtu.tree_map(_is_none, t_stages, is_leaf=_is_none)
    fixed_part, moving = eqx.partition(stages, fixed, is_leaf=_is_none)

    def image(moving: Stages) -> Unknown:
        return eqx.combine(moving, fixed_part).image(root)

    def end(moving: Stages, unknown: Unknown) -> Y:
        return eqx.combine(moving, fixed_part).end(unknown)

    # With k = Phi(k, x): dk = (dPhi / dk) dk + (dPhi / dx) dx.
    _, rhs = jax.jvp(image, (moving,), (t_stages,))
    _, linear = jax.linearize(stages.image, root)
    # The linear solver of a root finder, as in `PicardNewton` and `optx.Newton`, serves for
    # derivatives, too. Others (`optx.FixedPointIteration`, `optx.Dogleg`) have none.
    t_unknown = differentiate(getattr(finder, "linear_solver", None), linear, rhs)
    _, t_y1 = jax.jvp(end, (moving, root), (t_stages, t_unknown))
    t_y1, t_unknown = jtu.tree_map(lambda t: jnp.where(failed, 0, t), (t_y1, t_unknown))
    no_tangent = jtu.tree_map(lambda _: None, result)
    return (y1, unknown, result), (t_y1, t_unknown, no_tangent)


def _is_none(x: Any) -> bool:
    return x is None
