"""Kernels that move paths through their steps. Each is recorded and compiled once for a
system, and reads step sizes, times, parameters and numbers of steps."""

import functools as ft
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._compat import frozen_function, variable_number
from .._custom_types import RealScalarLike
from .._stablehlo import (
    array_in_memory,
    array_types,
    ArrayType,
    dr,
    elements_of_both,
    elements_where,
    entries_of,
    scalar,
    tensors_from,
)
from .path_functions import PathFunctions
from .program import as_numbers, entry_kinds, pack, Program, shapes_of, unpack


# Kernels of systems with more numbers in their state take long to compile.
_MOST_NUMBERS_IN_STATE = 256
# Kernels of more operations compile for longer than programs of JAX. The stage equations of
# 64 rods, 20,000 operations, compile for 4.3 s, by JAX for 5.2 s; a loop of linear systems,
# 53,000 operations, for 16 s, by JAX for 4.9 s.
_MOST_OPERATIONS = 25_000
# Dr.Jit warns of a function that is recorded more often than this.
_MOST_RECORDINGS = 100


class Lanes(NamedTuple):
    """The paths of a batch. Each Dr.Jit array has one lane for each path.

    - `keys`: the words of the random keys.
    - `own_args`: the entries of the arrays in `args` that each path has of its own.
    - `y`: the entries of the states.
    - `solver_state`: the entries of the solver states that steps change.
    - `stopped`: whether a step of the path was not solved.
    """

    keys: list[Any]
    own_args: list[Any]
    y: list[Any]
    solver_state: list[Any]
    stopped: Any


class Shared(NamedTuple):
    """What all paths of a batch read.

    - `packed`: the arrays of the system, the step size, and the parts of the solver state
        that steps do not change.
    - `constants`: the large constants of the program of a step.
    """

    packed: dict[str, Any]
    constants: list[Any]


class Kernels:
    """The kernels of a system. Raises a `ValueError` if it is too large."""

    def __init__(self, functions: PathFunctions):
        self._functions = functions
        # Programs are lowered for shapes and dtypes of their arguments. The number of a
        # path is two words.
        word = jax.ShapeDtypeStruct((), "uint32")
        arrays = functions.arrays
        key = functions.key
        keys = jax.eval_shape(functions.path_keys, arrays, key, word, word)
        own_args = [*functions.own_args]
        y = jax.eval_shape(functions.y0, arrays)
        _check_size(sum(x.size for x in y))
        self._path_keys = Program(
            functions.path_keys,
            dict(arrays=arrays, key=key, high=word, low=word),
        )
        self._step = Program(
            functions.step,
            dict(
                arrays=arrays,
                keys=keys,
                own_args=own_args,
                h=jax.ShapeDtypeStruct((), jnp.result_type(*y)),
                i=jax.ShapeDtypeStruct((), "int32"),
                y=y,
                solver_state=jax.eval_shape(functions.start, arrays, keys, own_args, y),
            ),
        )
        self._is_moving = self._moving_arrays()
        self._constants = self._step.replay.constants()
        self._compiled_solver_state = jax.jit(self._solver_state_at_start)
        self._make_keys = frozen_function(self._record_keys, _MOST_RECORDINGS)
        self._take_steps = frozen_function(self._record_steps, _MOST_RECORDINGS)

    def _moving_arrays(self) -> list[bool]:
        """For each array of the solver state, whether each path has its own. If all paths
        start alike, they share the arrays that a step returns unchanged, which then need no
        registers."""
        num_arrays = len(self._step.types["solver_state"])
        # The solver state is the last argument of a step.
        first_argument = len(self._step.replay.arguments) - num_arrays
        # The results of a step are the state, the solver state, and whether it succeeded.
        first_result = len(self._step.types["y"])
        returned = self._step.replay.returned_arguments
        # For each array of the new solver state, the number of the argument that the step
        # returns as this array, or `None` if it computes the array.
        sources = returned[first_result : first_result + num_arrays]
        return [
            self._functions.paths_differ or source != first_argument + k
            for k, source in enumerate(sources)
        ]

    def _solver_state_at_start(
        self, arrays: list[Array], key, y: list[Array], own_args: list[Array]
    ) -> list:
        """The leaves of the solver state before the first step: the state of all paths; or
        if paths differ, the states of all along a leading axis, which `y` and `own_args`
        have, too."""

        def start_of_path(y: list[Array], own_args: list[Array]) -> list[Array]:
            def start_of_numbered_path(low: Array) -> list[Array]:
                high = jnp.zeros_like(low)
                keys = self._functions.path_keys(arrays, key, high, low)
                return self._functions.start(arrays, keys, own_args, y)

            # No solver draws random numbers in `init`, so the number of a path does not
            # matter. With `out_axes=None`, JAX raises an error if the result depends on it.
            path_numbers = jnp.zeros(1, "uint32")
            return jax.vmap(start_of_numbered_path, out_axes=None)(path_numbers)

        if self._functions.paths_differ:
            return jax.vmap(start_of_path)(y, own_args)
        return start_of_path(y, own_args)

    def lanes_and_shared(
        self,
        arrays: list[Array],
        key: PRNGKeyArray,
        h: RealScalarLike,
        first_path: int,
        num_paths: int,
        y0: PyTree[Array],
        own_args: PyTree[Array],
    ) -> tuple[Lanes, Shared]:
        """The paths with the numbers `first_path` to `first_path + num_paths - 1` before
        their first step, and what they share in steps of size `h`. If paths differ, `y0`
        and `own_args` have a leading axis of paths."""
        kinds = array_types()
        # The number of the first path is opaque: otherwise it would be a constant of the
        # kernel, so that every batch compiled a kernel of its own, in 20 to 40 ms.
        offset = dr.opaque(kinds["ui64"], first_path)
        path_numbers = dr.arange(kinds["ui64"], num_paths) + offset
        high = kinds["ui32"](path_numbers >> 32)
        low = kinds["ui32"](path_numbers)
        packed_for_keys = pack(self._types_for_keys, [*arrays, key])
        keys = self._make_keys(packed_for_keys, high, low)
        y_leaves = jtu.tree_leaves(y0)
        args_leaves = jtu.tree_leaves(own_args)
        solver_state = self._compiled_solver_state(arrays, key, y_leaves, args_leaves)
        moving = elements_where(solver_state, self._is_moving)
        fixed = elements_where(solver_state, self._is_fixed)
        types = self._step.types
        lanes = Lanes(
            keys=keys,
            own_args=self._in_lanes(types["own_args"], args_leaves, num_paths),
            y=self._in_lanes(types["y"], y_leaves, num_paths),
            solver_state=self._in_lanes(self._types_of_moving, moving, num_paths),
            stopped=dr.opaque(kinds["i1"], False, num_paths),
        )
        packed = pack(self._types_of_shared, [*arrays, np.asarray(h), *fixed])
        return lanes, Shared(packed, self._constants)

    def advance(
        self, lanes: Lanes, shared: Shared, first_step: int, end_step: int
    ) -> Lanes:
        """The paths after the steps `first_step` to `end_step - 1`."""
        # Numbers of steps are opaque, so that other numbers need no other kernel.
        opaque = ft.partial(dr.opaque, array_types()["i32"])
        y, solver_state, stopped = self._take_steps(
            *shared, opaque(first_step), opaque(end_step), *lanes
        )
        return lanes._replace(y=y, solver_state=solver_state, stopped=stopped)

    def _in_lanes(
        self, types: list[ArrayType], arrays: list[Array], num_paths: int
    ) -> list[Any]:
        """A Dr.Jit array for each entry of these arrays, with a lane for each path. If
        paths differ, the arrays have a leading axis of paths."""
        kinds = entry_kinds(types)
        if self._functions.paths_differ:
            # (entries, paths) for each array
            matrices = [as_numbers(x).reshape(num_paths, -1).T for x in arrays]
            rows = [row for matrix in matrices for row in matrix]
            return [
                array_in_memory(kind, row)
                for kind, row in zip(kinds, rows, strict=True)
            ]
        entries = [entry for x in arrays for entry in as_numbers(x).flat]
        return [
            dr.opaque(array_types()[kind], entry.item(), num_paths)
            for kind, entry in zip(kinds, entries, strict=True)
        ]

    @property
    def _types_for_keys(self) -> list[ArrayType]:
        return [*self._path_keys.types["arrays"], *self._path_keys.types["key"]]

    @property
    def _types_of_shared(self) -> list[ArrayType]:
        types = self._step.types
        fixed = elements_where(types["solver_state"], self._is_fixed)
        return [*types["arrays"], *types["h"], *fixed]

    @property
    def _types_of_moving(self) -> list[ArrayType]:
        return elements_where(self._step.types["solver_state"], self._is_moving)

    @property
    def _is_fixed(self) -> list[bool]:
        return [not is_moving for is_moving in self._is_moving]

    def _record_keys(self, packed: dict[str, Any], high: Any, low: Any) -> list[Any]:
        """The words of the random keys of the paths with the numbers `high * 2^32 + low`,
        as Dr.Jit records their computation."""
        arrays_and_key = unpack(self._types_for_keys, packed)
        keys, _ = self._path_keys.replay(*arrays_and_key, scalar(high), scalar(low))
        return [*entries_of(keys)]

    def _record_steps(
        self,
        packed: dict[str, Any],
        constants: list[Any],
        first_step: Any,
        end_step: Any,
        keys: list[Any],
        own_args: list[Any],
        y: list[Any],
        solver_state: list[Any],
        stopped: Any,
    ) -> tuple[list[Any], list[Any], Any]:
        """The state, the solver state and which paths stopped after the steps `first_step`
        to `end_step - 1`, as Dr.Jit records the loop over steps. The arguments are the
        fields of `Shared`, the numbers of the steps, and the fields of `Lanes`."""
        # Dr.Jit numbers its variables one after another, one for each operation. So the
        # difference between this number and the last one below counts the operations.
        first_variable = variable_number(first_step + 1)
        step = self._step
        # In the order in which `lanes_and_shared` packs them: the arrays of the system, the
        # step size, and the arrays of the solver state that steps do not change.
        num_arrays = len(step.types["arrays"])
        shared = unpack(self._types_of_shared, packed)
        arrays = shared[:num_arrays]
        h, *fixed = shared[num_arrays:]
        key_tensors = tensors_from(keys, shapes_of(step.types["keys"]))
        args_tensors = tensors_from(own_args, shapes_of(step.types["own_args"]))
        shapes_of_y = shapes_of(step.types["y"])
        shapes_of_moving = shapes_of(self._types_of_moving)

        def has_more_steps(i: Any, *_state: Any) -> Any:
            return i < end_step

        # The entries are those of `y`, followed by those of the moving solver state.
        def after_step(i: Any, stopped: Any, *entries: Any) -> tuple[Any, ...]:
            remaining_entries = iter(entries)
            y_tensors = tensors_from(remaining_entries, shapes_of_y)
            moving = tensors_from(remaining_entries, shapes_of_moving)
            whole_solver_state = elements_of_both(self._is_moving, moving, fixed)
            results, error_masks = step.replay(
                *arrays,
                *key_tensors,
                *args_tensors,
                h,
                scalar(i),
                *y_tensors,
                *whole_solver_state,
                constants=constants,
            )
            # The arrays of the state, those of the solver state, and whether the step
            # succeeded, as in `Stepped`.
            *states, success = results
            # The order decides how LLVM schedules operations: with the success first, a
            # step of `StormerVerlet` in single precision takes 1.13 times as long, and of
            # Heun's method 0.85.
            for failed in (*error_masks, ~success.item()):
                stopped = stopped | failed
            new_y = states[: len(y_tensors)]
            new_solver_state = states[len(y_tensors) :]
            new_moving = elements_where(new_solver_state, self._is_moving)
            new_entries = [*entries_of(new_y), *entries_of(new_moving)]
            # A path that stopped stays where it was: sweeps over NaN would go on to the
            # limit in every later step.
            kept = [
                dr.select(stopped, old, new) for old, new in zip(entries, new_entries)
            ]
            return i + 1, stopped, *kept

        state_at_start = (first_step, stopped, *y, *solver_state)
        _, has_stopped, *entries = dr.while_loop(
            state_at_start, has_more_steps, after_step, mode="symbolic"
        )
        last_variable = max(map(variable_number, [has_stopped, *entries]))
        _warn_of_operations(last_variable - first_variable)
        return entries[: len(y)], entries[len(y) :], has_stopped


def _warn_of_operations(num_operations: int) -> None:
    """Warns of a kernel that compiles for longer than a program of JAX, before it does."""
    if num_operations > _MOST_OPERATIONS:
        warnings.warn(
            f"A step of this system is a kernel of about {num_operations:,} operations, "
            "which compiles for longer than JAX does, for seconds to minutes: loops of "
            "known length, sorting and linear algebra are written out. Pass "
            '`engine="jax"`, unless the paths are very many.',
            stacklevel=2,
        )


def _check_size(num_numbers: int) -> None:
    """Raises a `ValueError` for states of more numbers than kernels take."""
    if num_numbers > _MOST_NUMBERS_IN_STATE:
        raise ValueError(
            f'`engine="drjit"` takes states of up to {_MOST_NUMBERS_IN_STATE} '
            f'numbers; got {num_numbers}. Pass `engine="jax"`.'
        )
