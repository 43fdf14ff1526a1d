"""`Problem`: the checked arguments of `expectation` or `ensemble`, and single steps.

Names of axes of arrays, here and in the modules that simulate a problem: `n` paths, `d`
entries of the state, `S` saved times (those at which to average), `m` numbers in `phi`.
"""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray, PyTree

from .._arguments import (
    brief,
    check_args,
    check_made_for_noise,
    check_solver,
    check_state,
    check_terms,
    check_untraced,
    whole_number,
)
from .._brownian import has_bounded_increments
from .._custom_types import Args, IntScalarLike, RealScalarLike, Y
from .._programs import digest, once_for_each_signature, traced
from .._root_finder import all_finite
from .._solver import AbstractSymplecticSolver, check_resolution, own_path, Want
from .._terms import (
    brownian_paths,
    check_assertions,
    check_drifts_differ,
    check_start,
    check_stratonovich,
    constraint_of,
    motion_numbers,
    NEED_VALUES,
    step_variables,
    StepVariables,
    which_are_shapes,
    which_need_truncation,
    with_paths_for_shapes,
    with_programs,
    with_truncation,
)
from .arguments import (
    check_cells,
    check_fit,
    check_noise,
    check_truncation,
    drawn_args,
    drawn_state,
    given_state,
    step_numbers,
    traced_phi,
)
from .layout import Layout
from .levels import halved, Level, level_weights, levels_of, MOST_LEVELS


# The number that is folded into the key of a sample to draw its `y0` and `args`. To draw
# its Brownian paths, the 32-bit words of the user's keys are folded into the same key. This
# arbitrary number is unlikely to be one of these words.
_START_KEY = 0x517A87
# The `unit` of a `TruncatedBrownianPath` that is made here, as a multiple of the interval
# from `t0` to `t1`. A single step over the whole interval then loses 0.04% of its variance,
# of which users need not be warned.
_UNIT_OF_TRUNCATION = 32


class Problem(eqx.Module):
    """The arguments of `expectation`, by the same names, and what follows from them.

    If the user passes a function of a random key as `y0` or `args`, the field with this
    name holds an example that the function has drawn, and `y0_of` or `args_of` holds the
    function.

    Outside of compiled programs times, levels and weights are NumPy arrays, since there
    each operation of JAX is a program of its own, which takes some 20 ms to compile.
    """

    phi: Callable[[RealScalarLike, Y, Args], PyTree]
    terms: PyTree[diffrax.AbstractTerm]
    solver: diffrax.AbstractSolver
    t0: Float[Array | np.ndarray, ""]
    y0: Y
    args: Args
    # The functions that draw `y0` and `args` for each path; `None` if all paths share them.
    y0_of: Callable | None
    args_of: Callable | None
    # All levels, along a leading axis.
    levels: Level
    # The `level_weights`, as an array, so that other weights compile nothing anew.
    weights: Float[Array | np.ndarray, "combinations levels"]
    # Whether to average at `t1` only, without an axis of times.
    at_end: bool = eqx.field(static=True)
    # For each path of the terms, the number of its Brownian motion. It is stored, since a
    # compiled program, in which keys are traced, cannot tell which paths are equal.
    motion_numbers: tuple[int, ...] = eqx.field(static=True)

    @staticmethod
    def of(
        phi: Callable,
        terms: PyTree,
        solver: Any,
        t0: Any,
        t1: Any,
        dt0: Any,
        y0: Y | Callable,
        args: Args | Callable,
        ts: Sequence[Any] | np.ndarray | Array | None,
        levels: int,
        want: Want = "weak",
        caller: str = "expectation",
        key: PRNGKeyArray | None = None,
    ) -> "Problem":
        """The problem of these arguments of the function `caller`. Raises a `ValueError`
        for bad arguments. Examples of `y0` and `args` are drawn from `key`, which may be
        any key of the user's random number generator.

        The order is:

        1. Types of arguments are checked.
        2. In `terms`, a path of the solver for the purpose `want` takes the place of each
           shape. `y0` and `args` become examples if they are functions.
        3. Programs take the place of the user's functions (see `_as_programs`).
        4. The terms are checked, with the values of `t0`, `y0` and `args`.
        5. Paths in `terms` that the solver made are truncated, if its steps need that.
        6. The steps on all levels are checked.
        """
        # 1. Types.
        num_levels = whole_number("levels", levels, least=1, most=MOST_LEVELS)
        check_terms(terms)
        check_solver("solver", solver)
        check_made_for_noise(solver)
        # 2. Paths and examples. `made_by_solver` has a flag for each path in `terms`.
        made_by_solver = which_are_shapes(terms)
        # The paths get keys for an example. In each sample other keys take their place.
        terms = with_paths_for_shapes(terms, ft.partial(own_path, solver, want))
        numbers_of_steps = step_numbers(t0, t1, dt0, ts)
        key = jr.key(0) if key is None else key
        y0, y0_of, args, args_of = _with_examples(y0, args, key, caller)
        check_drifts_differ(terms)
        # Times have the dtype of the state.
        dtype = jnp.result_type(*jtu.tree_leaves(y0))
        t0_array = np.asarray(t0, dtype)
        # 3. Programs.
        phi, terms, solver, y0_of, args = _as_programs(
            phi, terms, solver, y0_of, t0_array, y0, args, key
        )
        # What functions close over is now a part of their programs.
        check_untraced(f"`{caller}`", (phi, terms, solver, y0_of, args_of))
        # 4. Terms. Assertions and constraints are checked here, where the values of `y0`
        # are known. In the program of a solve they are traced.
        check_fit(terms, t0_array, y0, args)
        check_assertions(terms, t0_array, y0, args)
        if constraint_of(terms) is not None:
            check_start(terms, t0_array, y0, args)
        check_noise(terms)
        # 5. Truncation. With a very large increment of noise that depends on the state, the
        # equations of an implicit step may have no solution.
        if isinstance(solver, diffrax.AbstractImplicitSolver) and any(made_by_solver):
            needed = which_need_truncation(terms, t0_array, y0, args)
            # Paths of the user are kept as they are.
            which = [made and need for made, need in zip(made_by_solver, needed)]
            # One unit serves all levels. It is an array, so that another one compiles
            # nothing anew.
            unit = _UNIT_OF_TRUNCATION * (float(t1) - float(t0))
            terms = with_truncation(terms, which, np.asarray(unit, dtype))
        # 6. Steps.
        check_truncation(terms, float(dt0))
        smallest_step = float(dt0) / 2 ** (num_levels - 1)
        if isinstance(solver, AbstractSymplecticSolver):
            check_resolution(smallest_step, float(t0), float(t1), dtype)
        check_stratonovich(terms, solver, t0_array, y0, args, all_terms=True)
        check_cells(terms, float(t0), smallest_step)
        # `levels_of` is called before `level_weights`, since it refuses numbers of levels
        # for which weights cannot be computed.
        all_levels = levels_of(float(dt0), numbers_of_steps, num_levels, dtype)
        weights = level_weights(_order_of(solver, terms), num_levels)
        return Problem(
            phi=phi,
            terms=terms,
            solver=solver,
            t0=t0_array,
            y0=y0,
            args=args,
            y0_of=y0_of,
            args_of=args_of,
            levels=all_levels,
            weights=np.asarray(weights, jnp.result_type(float)),
            at_end=ts is None,
            motion_numbers=motion_numbers(brownian_paths(terms)),
        )

    def with_halved_steps(self) -> "Problem":
        """The same problem with halved steps on all levels."""
        return dataclasses.replace(self, levels=halved(self.levels))

    def level(self, index: IntScalarLike) -> Level:
        """The level with this number, which may be traced."""
        return jtu.tree_map(lambda x: x[index], self.levels)

    @property
    def num_components(self) -> int:
        """The number of real numbers in the state."""
        return sum(leaf.size for leaf in jtu.tree_leaves(self.y0))

    @property
    def finest_steps(self) -> int:
        """The number of steps on the finest level."""
        return int(self.levels.num_steps[-1])

    @property
    def digests(self) -> dict[str, str]:
        """A hash of each argument, by its name, as in `Expectation`."""
        level = self.level(0)

        def times(num_steps: Any) -> np.ndarray:
            # Equal times have equal hashes: single precision hides rounding errors, which
            # differ if the same time is reached by steps of another size.
            return np.asarray(self.t0 + num_steps * level.h, np.float32)

        arguments = dict(
            phi=self.phi,
            terms=self.terms,
            solver=self.solver,
            t0=self.t0,
            t1=times(level.num_steps),
            dt0=level.h,
            y0=self.y0 if self.y0_of is None else self.y0_of,
            args=self.args if self.args_of is None else self.args_of,
            ts=times(level.saved_steps),
        )
        return {name: digest(value) for name, value in arguments.items()}

    @property
    def order(self) -> int | float:
        """The weak order by which means are extrapolated."""
        return _order_of(self.solver, self.terms)

    @property
    def paths_differ(self) -> bool:
        """Whether not all paths have the same `y0` and `args`."""
        return self.y0_of is not None or self.args_of is not None

    def draw_start(self, key: PRNGKeyArray) -> tuple[Y, PyTree[Array]]:
        """The initial state of the path with this key, and the arrays in its `args`; `None`
        in place of these arrays if all paths have the same `args`."""
        y0_key, args_key = jr.split(jr.fold_in(key, _START_KEY))
        own_args = None
        if self.args_of is not None:
            own_args = eqx.filter(self.args_of(args_key), eqx.is_array)
        y0 = self.y0
        if self.y0_of is not None:
            y0 = self.y0_of(y0_key, self.with_args(own_args).args)
        return y0, own_args

    def with_args(self, own_args: PyTree[Array]) -> "Problem":
        """The problem of a single path. `own_args` are the arrays in the `args` of this
        path, or `None`, as from `draw_start`."""
        if own_args is None:
            return self
        shared_args = eqx.filter(self.args, eqx.is_array, inverse=True)
        return dataclasses.replace(self, args=eqx.combine(own_args, shared_args))

    def init(
        self, terms: PyTree, i: Any, h: Float[Array | np.ndarray, ""], y: Y
    ) -> PyTree[Array]:
        """The arrays of the solver's state before step `i`. (The rest of the solver's state
        is the same in all steps.)"""
        t = self.t0 + i * h
        state = self.solver.init(terms, t, t + h, y, self.args)
        return eqx.filter(state, eqx.is_array)

    def step(
        self,
        terms: PyTree,
        i: Any,
        h: Float[Array | np.ndarray, ""],
        y: Y,
        solver_state: PyTree[Array],
    ) -> tuple[Y, PyTree[Array], Bool[Array, ""]]:
        """Takes one step of one path. Returns its state and the arrays of the solver's
        state after the step, and whether the step succeeded."""
        # Both times follow from the number of the step, so that `next_t` is exactly the `t`
        # of the next step.
        t = self.t0 + i * h
        next_t = self.t0 + (i + 1) * h
        # Only the arrays of the solver's state are carried from step to step. The rest is
        # the same in all steps: it is taken from an initial state of the solver, which
        # `eqx.filter_eval_shape` makes without computing its arrays.
        initial_state = eqx.filter_eval_shape(
            self.solver.init, terms, t, next_t, y, self.args
        )
        is_struct = lambda x: isinstance(x, jax.ShapeDtypeStruct)
        constant_part = eqx.filter(initial_state, is_struct, inverse=True)
        whole_state = eqx.combine(solver_state, constant_part)
        y, _, _, whole_state, result = self.solver.step(
            terms, t, next_t, y, self.args, whole_state, made_jump=False
        )
        success = diffrax.is_okay(result) & all_finite(y)
        return y, eqx.filter(whole_state, eqx.is_array), success

    def variables(self, h: RealScalarLike) -> StepVariables:
        """The random variables of a step of this size."""
        return step_variables(self.terms, h, self.motion_numbers)

    def values(self, t: Any, y: Y) -> Float[Array, " m"]:
        """All numbers of `phi` as one vector."""
        return real_vector(self.phi(t, y, self.args))

    @property
    def layout(self) -> Layout:
        """The layout of vectors of all numbers of `phi` at all saved times. PyTrees have an
        axis of times unless the mean is at `t1` only."""
        num_times, _ = self.output_shape
        return Layout.of(self._struct_of_phi, None if self.at_end else num_times)

    @property
    def _struct_of_phi(self) -> PyTree[jax.ShapeDtypeStruct]:
        return _struct_of_phi(self.phi, self.t0, self.y0, self.args)

    @property
    def is_implicit(self) -> bool:
        """Whether the solver is known to solve equations in a step."""
        solver = self.solver
        if isinstance(solver, AbstractSymplecticSolver):
            # For a step with one noise, the numbers of unknowns in each of its systems of
            # equations.
            return len(solver.stage_vectors(1)) > 0
        return isinstance(solver, diffrax.AbstractImplicitSolver)

    @property
    def dtype_of_values(self) -> Any:
        """The dtype of `values`."""
        leaves = jtu.tree_leaves(self._struct_of_phi)
        return jnp.result_type(float, *[leaf.dtype for leaf in leaves])

    @property
    def dtype(self) -> Any:
        """The dtype of the state, which is also that of times."""
        return jnp.result_type(*jtu.tree_leaves(self.y0))

    @property
    def bytes_of_state(self) -> int:
        """The memory that a state takes."""
        return sum(leaf.nbytes for leaf in jtu.tree_leaves(self.y0))

    @property
    def output_shape(self) -> tuple[int, int]:
        """The number `S` of saved times, and the number `m` of numbers in `phi`."""
        return self.levels.saved_steps.shape[1], Layout.of(self._struct_of_phi).size


def _with_examples(
    y0: Y | Callable, args: Args | Callable, key: PRNGKeyArray, caller: str
) -> tuple[Y, Callable | None, Args, Callable | None]:
    """The fields `y0`, `y0_of`, `args` and `args_of` of a `Problem`, with examples drawn
    from `key` where the user passes functions. Here `y0_of` is still the user's function
    itself: `_as_programs` traces it. Any key will do, since all draws have the same
    structure."""
    args_of = args if callable(args) else None
    if args_of is not None:
        args = drawn_args(args_of, key)
        args_of = traced(ft.partial(drawn_args, args_of), key, identity=args_of)
    else:
        check_args(args)
    y0_of = y0 if callable(y0) else None
    y0 = given_state(y0) if y0_of is None else drawn_state(y0_of, key, args)
    check_state(caller, y0)
    is_finite = all(np.all(np.isfinite(leaf)) for leaf in jtu.tree_leaves(y0))
    if y0_of is None and not is_finite:
        raise ValueError(f"`y0` must hold finite numbers; got {brief(y0)}.")
    return y0, y0_of, args, args_of


def _as_programs(
    phi: Callable,
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    y0_of: Callable | None,
    t0: np.ndarray,
    y0: Y,
    args: Args,
    key: PRNGKeyArray,
) -> tuple:
    """Returns `phi`, `terms`, `solver`, `y0_of` and `args`, with a program in place of each
    function of the user: the function as traced by JAX (see `_programs`).

    In `args`, an array takes the place of each Python float, so that other numbers compile
    nothing anew. But if a function of the user needs the numbers themselves, for example in
    an `if`, `args` stay as they are.
    """

    def programs_for(args: Args) -> tuple:
        draw_y0 = None
        if y0_of is not None:
            draw_y0 = traced(ft.partial(drawn_state, y0_of), key, args, identity=y0_of)
        return (
            traced_phi(phi, terms, t0, y0, args),
            with_programs(terms, t0, y0, args),
            with_programs(solver, t0, y0, args),
            draw_y0,
            args,
        )

    def float_as_array(x: Any) -> Any:
        # Integers are kept, since they may be exponents or sizes.
        return jnp.asarray(x) if type(x) is float else x

    # A function that needs numbers themselves raises one of `NEED_VALUES`, of which
    # `call_user_function` makes a `ValueError`. A `ValueError` with another cause is raised
    # again in the second attempt.
    try:
        return programs_for(jtu.tree_map(float_as_array, args))
    except (ValueError, *NEED_VALUES):
        # The second attempt is not made in here, since Python would print its error
        # together with this one.
        pass
    return programs_for(args)


@once_for_each_signature
def _struct_of_phi(
    phi: Callable[..., PyTree[ArrayLike]],
    t0: Float[Array | np.ndarray, ""],
    y0: Y,
    args: Args,
) -> PyTree[jax.ShapeDtypeStruct]:
    """The values of `phi`, with a shape and dtype in place of each array."""
    return jax.eval_shape(lambda: phi(t0, y0, args))


def _order_of(solver: diffrax.AbstractSolver, terms: PyTree) -> int | float:
    """The weak order of a solver for these terms. It is taken to be 1 for solvers of other
    packages, which have no `weak_order`, and for solvers of the user that return `None`."""
    return getattr(solver, "weak_order", lambda terms: 1)(terms) or 1


def advice_on_failures(problem: Problem | None) -> str:
    """Tells users, in sentences for a message, what to do about failed paths. `problem` is
    `None` for `monte_carlo`, which averages any function of the user."""
    on_equations = ""
    or_bounded = " or bounded increments, as from a `WeakBrownianPath`,"
    if problem is not None:
        if problem.is_implicit:
            on_equations = (
                "The equations of an implicit step may have no solution, for example where "
                "particles meet: pass a smaller `dt0`, or an explicit solver. If they are "
                "only hard, pass `root_finder=PicardNewton(newton_steps=1000)` to the "
                "solver. "
            )
        # There is nothing to gain if all increments are bounded already.
        if all(map(has_bounded_increments, brownian_paths(problem.terms))):
            or_bounded = ""
    return (
        f"{on_equations}"
        f"Take smaller steps{or_bounded} and look for NaNs in `y0`, `args` and the "
        "Hamiltonians, and for a `temperature` or `friction` that is negative or, as a "
        "matrix, not symmetric positive semidefinite."
    )


def ravel(y: Y) -> Float[Array, " d"]:
    """The leaves of a state as one vector."""
    return jfu.ravel_pytree(y)[0]


def real_vector(tree: PyTree) -> Float[Array, " m"]:
    """The leaves of a PyTree as one vector of floating-point numbers."""
    x = ravel(tree)
    return x.astype(jnp.result_type(x, float))
