"""A step of a Runge--Kutta method, by the plan of its tableau.

The plan orders the stages in blocks. A block has unknown stages, whose values k solve the
stage equations k = Phi(k), and explicit stages, which are evaluated from values that are
known already. A root finder solves the stage equations; derivatives of a step follow from
the equations by the implicit function theorem, not from the iterations.

Stages that evaluate the same vector fields may form a group: they are evaluated together,
with their values stacked along a new first axis.
"""

import functools as ft
from collections.abc import Callable, Iterable
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
from .._compat import dce_jaxpr, Jaxpr, programs_in, ω
from .._custom_types import RealScalarLike, Y
from .._root_finder import all_finite, differentiate, Halves
from .._tableau import Block, Group, Stage, StepPlan
from .._terms import tree_sum


# The value of a stage, or the stacked values of a group: the change of the part of the
# state that the stage writes, which is the whole state or one half of a pair `(p, q)`.
_Value: TypeAlias = PyTree[Array]
# The values of the stages known so far, by stage number.
KnownValues: TypeAlias = dict[int, _Value]
# The values of the unknown stages, by group. Comments and root finders call them k.
Unknown: TypeAlias = dict[Group, _Value]
# The change of the state by one channel over the whole step, as a function of time and
# state. A channel is the drift, or one random variable with the vector field that it
# drives.
Change: TypeAlias = Callable[[RealScalarLike, Y], Y]
# Whether the stage equations of all steps so far were solved: success, or the first
# failure. `None` for a solver without stage equations.
Outcome: TypeAlias = optx.RESULTS | None


class Step(NamedTuple):
    """One step.

    - `t0`, `h`: its start and size.
    - `changes`: for each channel, the function for the change of the state.
    """

    t0: RealScalarLike
    h: RealScalarLike
    changes: dict[str, Change]


class Stages(eqx.Module):
    """The stages of one step from the state `y0`, in the blocks of its plan. No block
    depends on a later one: while it is solved, values of later blocks count as zero."""

    plan: StepPlan = eqx.field(static=True)
    step: Step
    y0: Y
    # Whether sweeps, the fixed-point iterations of a root finder, may update momenta and
    # positions one after the other. It matters only for values that are pairs `(p, q)`.
    in_halves: bool = eqx.field(static=True, default=True)

    def _start(self, group: Group) -> PyTree[Array]:
        """The part of `y0` that the stages of a group write."""
        return _part(self.y0, self.plan.tableau.stages[group[0]].writes)

    def zeros(self) -> Unknown:
        """The guess of the root finder: zeros in the shapes of all unknown values."""

        def zeros_for(group: Group) -> _Value:
            # The value of a group of one stage is not stacked.
            stacked_axis = (len(group),) if len(group) > 1 else ()

            def stacked_zeros(x: Array) -> Array:
                return jnp.zeros((*stacked_axis, *jnp.shape(x)), jnp.result_type(x))

            return jtu.tree_map(stacked_zeros, self._start(group))

        groups = [group for block in self.plan.blocks for group in block.unknown]
        return {group: zeros_for(group) for group in groups}

    def scale(self, unknown: Unknown) -> Unknown:
        """For each unknown value `k`, which moves the part `y` of the state, the size `|y|
        + |k|`. The root finder's tolerance for `k` is relative to this size."""

        def size(y: Array, value: Array) -> Array:
            # `|k|` is added because the state may be zero. The state broadcasts against the
            # stacked values of a group.
            return jnp.abs(y) + jnp.abs(value)

        return {
            group: jtu.tree_map(size, self._start(group), value)
            for group, value in unknown.items()
        }

    def solve_blocks(
        self, solve: Callable, guess: Unknown, pending: Bool[Array, ""]
    ) -> tuple[Unknown, Bool[Array, ""]]:
        """Solves the blocks one after another, each with the values of earlier blocks.
        Returns the unknown values of all blocks, and whether all blocks are solved. A path
        that is not `pending` is left alone.

        `solve(image, scale, guess, pending)` solves the equations `k = image(k)` of one
        block. It returns `k`, and whether it is a solution. `scale(k)` are the sizes to
        which its tolerance is relative, as in the method `scale`."""
        known: KnownValues = {}
        unknown: Unknown = {}
        all_solved = jnp.array(True)
        for block in self.plan.blocks:
            # An explicit block has no unknown stages.
            if block.unknown:
                solution, block_solved = self._solve_block(
                    block, known, solve, guess, pending
                )
                unknown = unknown | solution
                all_solved = all_solved & block_solved
            known = self._with_block(block, known, unknown, stores_shared=True)
        return unknown, all_solved

    def _solve_block(
        self,
        block: Block,
        known: KnownValues,
        solve: Callable,
        guess: Unknown,
        pending: Bool[Array, ""],
    ) -> tuple[Unknown, Bool[Array, ""]]:
        """The unknown values of one block, and whether they solve its equations, by `solve`
        as for `solve_blocks`. `known` are the values of the stages of earlier blocks."""
        block_guess = {group: guess[group] for group in block.unknown}

        def block_image(unknown: Unknown) -> Unknown:
            known_with_block = self._with_block(block, known, unknown)
            return self._values(block.unknown, known_with_block)

        if self.in_halves and all(map(_is_pair, block_guess.values())):
            solve = ft.partial(_solve_in_halves, solve)
        return solve(block_image, self.scale, block_guess, pending)

    def image(self, unknown: Unknown) -> Unknown:
        r"""The values $\Phi(k)$ that the stage equations of the whole step give to its
        unknown stages, if they have the values $k$. A solution is a fixed point."""
        return self._values(unknown, self._known(unknown))

    def end(self, unknown: Unknown) -> Y:
        """The state at the end of the step, from the values of its unknown stages."""
        tableau = self.plan.tableau
        known = self._known(unknown, stores_shared=True)
        return _states(self.y0, tableau.stages, tableau.weights[None], known)

    def _values(self, groups: Iterable[Group], known: KnownValues) -> Unknown:
        """The values of the stages in these groups, evaluated from the known values."""
        return {group: self._evaluate(group, known) for group in groups}

    def _known(self, unknown: Unknown, stores_shared: bool = False) -> KnownValues:
        """The values of all stages, from the values of the unknown ones."""
        known: KnownValues = {}
        for block in self.plan.blocks:
            known = self._with_block(block, known, unknown, stores_shared)
        return known

    def _with_block(
        self,
        block: Block,
        known: KnownValues,
        unknown: Unknown,
        stores_shared: bool = False,
    ) -> KnownValues:
        """`known` with the values of all stages of a block added. The values of its unknown
        stages are taken from `unknown`; its explicit stages are evaluated.

        With `stores_shared`, an explicit value that is used several times is stored, so
        that XLA does not compute it again for each use. (Within an iteration of the root
        finder, storing a value costs as much as computing it again.)"""
        # Each `|` makes a new dictionary, and the caller's is not changed: the root finder
        # traces an iteration more than once, from the same known values.
        for group in block.unknown:
            known = known | _unstack(group, unknown[group])
        # Row `i` has the coefficients of the state at which stage `i` is evaluated, and the
        # last row the coefficients of the end of the step. So column `j` shows where the
        # value of stage `j` is used.
        tableau = self.plan.tableau
        coefficients = np.vstack([tableau.matrix, tableau.weights])
        for group in block.explicit:
            evaluate = ft.partial(self._evaluate, group, known)
            num_uses = np.count_nonzero(coefficients[:, list(group)].any(axis=1))
            is_stored = stores_shared and num_uses > 1
            value = materialize(evaluate) if is_stored else evaluate()
            known = known | _unstack(group, value)
        return known

    def _evaluate(self, group: Group, known: KnownValues) -> _Value:
        """The values of the stages in a group, stacked unless there is only one. The state
        of each stage follows from its row of coefficients and the known values."""
        tableau = self.plan.tableau
        rows = tableau.matrix[list(group)]
        states = _states(self.y0, tableau.stages, rows, known)
        stages = [tableau.stages[i] for i in group]
        # The stages of a group have the same channels and write the same part of the state.
        first = stages[0]

        # `c` is the time of a stage as a fraction of the step.
        def value_at(c: RealScalarLike, y: Y) -> _Value:
            t = self.step.t0 + c * self.step.h
            changes = [self.step.changes[name](t, y) for name in first.channels]
            return _part(tree_sum(changes), first.writes)

        if len(stages) == 1:
            return value_at(first.c, states)
        # `vmap` keeps the compiled code as small as for one evaluation.
        fractions = [stage.c for stage in stages]
        if len(set(fractions)) == 1:
            # With one time for all, what depends on time alone is computed once.
            return jax.vmap(value_at, in_axes=(None, 0))(first.c, states)
        c_of_stages = jnp.asarray(fractions, jnp.result_type(self.step.h, float))
        return jax.vmap(value_at)(c_of_stages, states)


def _solve_in_halves(
    solve: Callable,
    image: Callable[[Unknown], Unknown],
    scale: Callable[[Unknown], Unknown],
    guess: Unknown,
    pending: Bool[Array, ""],
) -> tuple[Unknown, Bool[Array, ""]]:
    """`solve(image, scale, guess, pending)` for values that are pairs `(p, q)`, one for
    each group. `solve` gets them as one pair, `Halves`, of the momenta and the positions of
    all groups, so that its sweeps update all momenta, then all positions."""

    def halves_of(values: Unknown) -> Halves:
        momenta = {group: p for group, (p, _) in values.items()}
        positions = {group: q for group, (_, q) in values.items()}
        return Halves(momenta, positions)

    def pairs_of(halves: Halves) -> Unknown:
        return {group: (halves.p[group], halves.q[group]) for group in halves.p}

    def image_of_halves(halves: Halves) -> Halves:
        return halves_of(image(pairs_of(halves)))

    def scale_of_halves(halves: Halves) -> Halves:
        return halves_of(scale(pairs_of(halves)))

    halves, is_solved = solve(
        image_of_halves, scale_of_halves, halves_of(guess), pending
    )
    return pairs_of(halves), is_solved


def _is_pair(y: Y) -> bool:
    return type(y) is tuple and len(y) == 2


def _unstack(group: Group, value: _Value) -> KnownValues:
    """The values of the stages in a group, by stage number, from its stacked `value`."""
    if len(group) == 1:
        (number,) = group
        return {number: value}
    return {
        number: jtu.tree_map(lambda stacked: stacked[row], value)
        for row, number in enumerate(group)
    }


def _part(y: PyTree, name: str) -> PyTree:
    """The part of the state `y` with this name: all of it for `"y"`, its first half for
    `"p"`, its second half for `"q"`."""
    if name == "y":
        return y
    p, q = y
    return p if name == "p" else q


def _states(
    y0: Y, stages: tuple[Stage, ...], rows: np.ndarray, known: KnownValues
) -> PyTree[Array]:
    """For each row `a` of coefficients the state `y0 + sum_i a[i] known[i]`, where `i` are
    the numbers of the known stages. The states are stacked unless there is only one row.

    If the stages write halves of states, each half is moved by the stages that write it."""

    def moved(part: str) -> PyTree[Array]:
        """The states, if `part` is `"y"`, or their half `"p"` or `"q"`."""
        start = _part(y0, part)
        products = []
        for i, value in known.items():
            # Products with zero are left out here. XLA may not drop them: the product of
            # zero and infinity is NaN.
            if stages[i].writes == part and rows[:, i].any():
                products.append(_products(rows[:, i], value))
        if products:
            # Add the small terms first, for fewer roundings at the size of the state.
            return (start**ω + tree_sum(products) ** ω).ω
        # No stage moves this part, so all states have that of `y0`.
        return start if len(rows) == 1 else jtu.tree_map(for_each_row, start)

    def for_each_row(x: Array) -> Array:
        return jnp.broadcast_to(x, (len(rows), *jnp.shape(x)))

    # The stages of a tableau all write whole states, or all write halves of states.
    if stages[0].writes == "y":
        return moved("y")
    return moved("p"), moved("q")


def _products(weights: np.ndarray, value: _Value) -> PyTree[Array]:
    """The products of `value` with each of these weights, stacked unless there is only
    one."""
    if len(weights) == 1:
        weight = float(weights[0])
        # A product with one would stay in the program.
        return value if weight == 1 else (weight * value**ω).ω

    def stacked_products(x: Array) -> Any:
        # The weights along a new first axis, and an axis of length one for each of `x`.
        as_column = (-1, *[1] * x.ndim)
        return weights.astype(x.dtype).reshape(as_column) * x

    return jtu.tree_map(stacked_products, value)


def take_step(
    plan: StepPlan,
    step: Step,
    y0: Y,
    solver: diffrax.AbstractSolver,
    last_outcome: Outcome = None,
) -> tuple[Y, Outcome]:
    """The state at the end of the step from `y0`, and the outcome. If there are stage
    equations, the root finder of `solver` solves them; it skips paths whose `last_outcome`
    is a failure."""
    if not any(block.unknown for block in plan.blocks):
        return Stages(plan, step, y0).end({}), last_outcome
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        raise ValueError(
            f"The tableau of `{type(solver).__name__}` has implicit stages. Let the class "
            "also inherit from `diffrax_symplectic.AbstractImplicitStages`."
        )
    last_outcome = no_failure() if last_outcome is None else last_outcome
    return _jitted_implicit_step(
        plan, step, y0, last_outcome, solver.root_finder, solver.root_find_max_steps
    )


def no_failure() -> optx.RESULTS:
    """The outcome before the first step, with arrays as leaves, since a loop carries it."""
    return jtu.tree_map(jnp.asarray, optx.RESULTS.successful)


def _failed(result: optx.RESULTS) -> Bool[Array, ""]:
    return result != optx.RESULTS.successful


def result_of(outcome: Outcome, y1: Y) -> diffrax.RESULTS:
    """The result of a step that ends at `y1`, as Diffrax reports it."""
    R = diffrax.RESULTS
    # The end may overflow although all stages are finite.
    result = R.where(all_finite(y1), R.successful, R.nonfinite)  # pyright: ignore
    if outcome is None:
        return result
    return R.where(_failed(outcome), R.promote(outcome), result)


# Diffrax traces a step three times or more. `filter_jit` traces this function only once.
@eqx.filter_jit
def _jitted_implicit_step(
    plan: StepPlan,
    step: Step,
    y0: Y,
    last_outcome: optx.RESULTS,
    finder: Any,
    max_steps: int,
) -> tuple[Y, optx.RESULTS]:
    """`take_step` for a plan with unknown stages: makes the stages from functions that can
    be differentiated, and chooses how sweeps update them."""
    # `filter_closure_convert` makes the arrays that a function captures leaves of a PyTree,
    # so that `_implicit_step` sees derivatives with respect to them. A converted function
    # accepts only the types that it was converted for, so `t0` and `h` get theirs first.
    dtype = jnp.result_type(step.t0, step.h, float)
    t0 = jnp.asarray(step.t0, dtype)
    h = jnp.asarray(step.h, dtype)
    changes = {
        name: eqx.filter_closure_convert(change, t0, y0)
        for name, change in step.changes.items()
    }
    step = Step(t0, h, changes)
    in_halves = not _computes_halves_together(step, y0)
    stages = Stages(plan, step, y0, in_halves)
    y1, _, outcome = _implicit_step(
        stages, last_outcome, finder=finder, max_steps=max_steps
    )
    return y1, outcome


# The number of operations that compute the two halves of a change one by one, divided by
# the number that compute both together: 1 if the halves share no operation, 2 if they share
# all. Above this ratio they are computed together. Then sweeps keep two copies y and z of
# all unknowns, both momenta and positions, and update them in turn: y = Phi(z), z = Phi(y).
# Such sweeps cost about the same and are fewer:
#
# - For a qubit under measurement (ratio 1.76) a step takes 24 evaluations in place of 44
#   for one path, and 65 in place of 106 for the slowest of 1,024 paths.
# - For amplitudes on four sites (1.77) and two damped spins (1.58) a step takes 0.63 to
#   0.74 times as many sweeps, for h = 0.1 to 0.6.
_LEAST_RATIO_TOGETHER = 1.5


def _computes_halves_together(step: Step, y0: Y) -> bool:
    """Whether the changes of both halves of a pair share most of their operations, as for
    an amplitude whose real and imaginary parts are the halves. A sweep that updates one
    half after the other would compute the shared operations twice.

    The operations are counted in the program of the whole change, and in what is left of it
    if only the change of one half is needed."""
    if not _is_pair(y0):
        return False

    def whole_change(y: Y) -> Y:
        return tree_sum([change(step.t0, y) for change in step.changes.values()])

    program = jax.make_jaxpr(whole_change)(y0).jaxpr
    # The results of the program are the leaves of the first half, then those of the second.
    first, _ = y0
    num_first = len(jtu.tree_leaves(first))
    num_second = len(program.outvars) - num_first

    def operations_for(is_needed: list[bool]) -> int:
        """The number of operations for the results that are needed."""
        # Dead-code elimination drops each operation that no needed result depends on.
        remaining, _ = dce_jaxpr(program, is_needed)
        return _num_operations(remaining)

    for_first = operations_for([True] * num_first + [False] * num_second)
    for_second = operations_for([False] * num_first + [True] * num_second)
    together = operations_for([True] * len(program.outvars))
    return for_first + for_second > _LEAST_RATIO_TOGETHER * together


def _num_operations(program: Jaxpr) -> int:
    """The number of operations in a program, with those of the programs that it calls."""
    inner = [part for eqn in program.eqns for part in programs_in(eqn)]
    return len(program.eqns) + sum(map(_num_operations, inner))


@eqx.filter_custom_jvp
def _implicit_step(
    stages: Stages, last_outcome: optx.RESULTS, *, finder: Any, max_steps: int
) -> tuple[Y, Unknown, optx.RESULTS]:
    """The state at the end of the step, the values of its unknown stages, and the outcome.
    A path that failed before keeps its `last_outcome`, and the root finder spends no time
    on it."""
    if isinstance(finder, optx.BestSoFarRootFinder):
        raise ValueError(
            "`BestSoFarRootFinder` returns an iterate from before the last correction, "
            "which does not solve the stage equations. Pass the root finder that it wraps."
        )
    failed_before = _failed(last_outcome)
    inputs = stages, last_outcome
    guess, failed_before = batched_like((stages.zeros(), failed_before), inputs)
    # With NaN as the guess, the root finder stops at once for a path that failed before.
    guess = jtu.tree_map(lambda k: jnp.where(failed_before, jnp.nan, k), guess)

    def residual(k: Unknown, stages: Stages) -> Unknown:
        return (k**ω - stages.image(k) ** ω).ω

    sol = optx.root_find(
        residual,
        finder,
        guess,
        args=stages,
        # Root finders of other packages ignore options that they do not know.
        options=dict(scale=stages.scale, solve_blocks=Stages.solve_blocks),
        max_steps=max_steps,
        throw=False,
    )
    result = optx.RESULTS.where(failed_before, last_outcome, sol.result)
    return stages.end(sol.value), sol.value, result


@_implicit_step.def_jvp
def _implicit_step_jvp(primals, tangents, *, finder, max_steps):
    """The tangents of the step by the implicit function theorem. The unknown values k
    satisfy k = Phi(k, x), where x are the variables in `stages`. So the tangents satisfy
    the linear equation dk = (dPhi / dk) dk + (dPhi / dx) dx."""
    stages, last_outcome = primals
    t_stages, _ = tangents
    y1, unknown, result = _implicit_step(
        stages, last_outcome, finder=finder, max_steps=max_steps
    )
    # Without a solution there is no derivative. It is taken at k = 0, and set to zero, so
    # that a failed path does not spoil gradients that are summed over a batch.
    failed = _failed(result) | ~all_finite(y1)
    root = jtu.tree_map(lambda k: jnp.where(failed, 0, k), unknown)
    constants, variables = _constants_and_variables(stages, t_stages)

    def image_of_root(variables: Stages) -> Unknown:
        return eqx.combine(variables, constants).image(root)

    def end_of_step(variables: Stages, unknown: Unknown) -> Y:
        return eqx.combine(variables, constants).end(unknown)

    # `rhs` is (dPhi / dx) dx, and `linear` the function that multiplies by dPhi / dk.
    _, rhs = jax.jvp(image_of_root, (variables,), (t_stages,))
    _, linear = jax.linearize(stages.image, root)
    # The linear solver of a root finder, as in `PicardNewton` and `optx.Newton`, serves for
    # derivatives, too. Others (`optx.FixedPointIteration`, `optx.Dogleg`) have none.
    linear_solver = getattr(finder, "linear_solver", None)
    t_unknown = differentiate(linear_solver, linear, rhs)
    _, t_y1 = jax.jvp(end_of_step, (variables, root), (t_stages, t_unknown))
    t_y1, t_unknown = jtu.tree_map(lambda t: jnp.where(failed, 0, t), (t_y1, t_unknown))
    t_result = jtu.tree_map(lambda _: None, result)
    return (y1, unknown, result), (t_y1, t_unknown, t_result)


def _constants_and_variables(stages: Stages, t_stages: Stages) -> tuple[Stages, Stages]:
    """The leaves of `stages` that are not differentiated, and the leaves that are. A leaf
    that is not differentiated has the tangent `None`, which `jax.jvp` does not take."""
    is_constant = jtu.tree_map(_is_none, t_stages, is_leaf=_is_none)
    return eqx.partition(stages, is_constant)


def _is_none(x: Any) -> bool:
    return x is None
