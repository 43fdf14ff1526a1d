"""Kernels that move paths through their steps.

Kernels are recorded and compiled once for a system. The step size, the time, parameters and
numbers of steps are inputs.

Paths *differ* if each has its own initial state and arrays in `args`.
"""

import dataclasses
import functools as ft
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._custom_types import RealScalarLike
from .._stablehlo import array_in_memory, array_types, dr, entries_of, scalar, Tensor
from .path_functions import PathFunctions
from .program import as_numbers, pack, Program, tensors_of, unpack


# The most numbers in the state of a system: kernels of larger systems take long to compile.
_MOST_NUMBERS_IN_STATE = 256
# Kernels of more operations take longer to compile than programs of JAX. Two examples: the
# stage equations of 64 rods (20,000 operations, which Dr.Jit compiles in 4.3 s and JAX in
# 5.2 s), and a loop of linear systems (53,000 operations, 16 s and 4.9 s).
_MOST_OPERATIONS = 25_000
# Dr.Jit warns if it records a function more often than this.
_MOST_RECORDINGS = 100


@dataclasses.dataclass
class Lanes:
    """The paths of a batch, as Dr.Jit arrays with one lane for each path. Each field but
    the last is a list of one array for each entry.

    - `keys`: the random keys, as integers.
    - `own_args`: the arrays in `args` if each path has its own, and otherwise nothing.
    - `y`: the states of the equation.
    - `solver_state`: the arrays in the solver state that differ between paths.
    - `stopped`: the mask of the paths of which a step was not solved.
    """

    keys: list[Any]
    own_args: list[Any]
    y: list[Any]
    solver_state: list[Any]
    stopped: Any


class Kernels:
    """The kernels of a system: one makes the random keys of paths, and one takes steps.
    Raises a `ValueError` if the state of the system is too large."""

    def __init__(self, functions: PathFunctions):
        self._functions = functions
        # 1. Lower the functions to programs, for shapes and dtypes of their arguments. The
        # number of a path has 64 bits, in two integers.
        uint32 = jax.ShapeDtypeStruct((), "uint32")
        arrays = functions.arrays
        key = functions.key
        keys = jax.eval_shape(functions.path_keys, arrays, key, uint32, uint32)
        y = eqx.filter_eval_shape(functions.system, arrays).y0
        y_leaves = jtu.tree_leaves(y)
        num_numbers = sum(x.size for x in y_leaves)
        if num_numbers > _MOST_NUMBERS_IN_STATE:
            raise ValueError(
                f'`engine="drjit"` takes states of up to {_MOST_NUMBERS_IN_STATE} '
                f'numbers; got {num_numbers}. Pass `engine="jax"`.'
            )
        self._path_keys = Program(
            functions.path_keys, arrays=arrays, key=key, high=uint32, low=uint32
        )
        self._step = Program(
            functions.step,
            arrays=arrays,
            keys=keys,
            own_args=functions.own_args,
            h=jax.ShapeDtypeStruct((), jnp.result_type(*y_leaves)),
            i=jax.ShapeDtypeStruct((), "int32"),
            y=y,
            solver_state=jax.eval_shape(
                functions.start, arrays, keys, functions.own_args, y
            ),
        )

        # 2. Separate the solver state. An array in it is *fixed* if paths start alike and a
        # step returns the same array that it got: then all paths share the array, and it
        # needs no registers. Otherwise it is *moving*, and each path has its own.
        def is_moving(argument_number: int, returned_number: int) -> bool:
            return functions.paths_differ or returned_number != argument_number

        numbers = self._step.numbers["solver_state"]
        returned_numbers = self._step.returned.solver_state
        self._is_moving = jtu.tree_map(is_moving, numbers, returned_numbers)
        types = self._step.types
        self._types_of_moving, fixed = eqx.partition(
            types["solver_state"], self._is_moving
        )
        # 3. List the arrays that all paths share, which are packed into a few arrays of
        # Dr.Jit: those that the steps read, and those that the keys are made from.
        self._types_of_shared = dict(arrays=types["arrays"], h=types["h"], fixed=fixed)
        types_of_key = self._path_keys.types["key"]
        self._types_for_keys = dict(arrays=types["arrays"], key=types_of_key)
        # 4. Make functions that are compiled when they are first called: one by JAX, and
        # two kernels. Dr.Jit calls the methods `_record...` only to record their
        # operations: once for each combination of types and layouts of arguments.
        self._compiled_solver_state = jax.jit(self._solver_state_at_start)
        frozen = ft.partial(dr.freeze, warn_after=_MOST_RECORDINGS)
        self._make_keys = frozen(self._record_keys)
        self._take_steps = frozen(self._record_steps)

    def _solver_state_at_start(
        self, arrays: list[Array], key, y: PyTree[Array], own_args: list[Array]
    ) -> PyTree[Array]:
        """The solver state before the first step. It is the same for all paths, unless
        paths differ: then `y`, `own_args` and the solver state have a leading axis of
        paths."""

        def start_of_path(y: PyTree[Array], own_args: list[Array]) -> PyTree[Array]:
            def start_of_path_number(low: Array) -> PyTree[Array]:
                keys = self._functions.path_keys(arrays, key, jnp.zeros_like(low), low)
                return self._functions.start(arrays, keys, own_args, y)

            # The start is computed for path number 0 alone: it does not depend on the
            # number, since no solver draws random numbers in `init`. If one did, JAX would
            # raise an error, for `out_axes=None` allows no result that depends on `low`.
            start = jax.vmap(start_of_path_number, out_axes=None)
            return start(jnp.zeros(1, "uint32"))

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
    ) -> tuple[Lanes, dict[str, Any]]:
        """The paths with the numbers `first_path` to `first_path + num_paths - 1` before
        their first step, and the packed inputs that all paths share in steps of size `h`.
        If paths differ, `y0` and `own_args` have a leading axis of paths."""
        dtypes = array_types()
        # The number of the first path is opaque, which means an input of the kernel. As a
        # constant it would make every batch compile another kernel, in 20 to 40 ms.
        offset = dr.opaque(dtypes["ui64"], first_path)
        path_numbers = dr.arange(dtypes["ui64"], num_paths) + offset
        high = dtypes["ui32"](path_numbers >> 32)
        low = dtypes["ui32"](path_numbers)
        packed_for_keys = pack(self._types_for_keys, dict(arrays=arrays, key=key))
        solver_state = self._compiled_solver_state(
            arrays, key, y0, jtu.tree_leaves(own_args)
        )
        moving, fixed = eqx.partition(solver_state, self._is_moving)
        types = self._step.types
        lanes = Lanes(
            keys=self._make_keys(packed_for_keys, high, low),
            own_args=self._in_lanes(types["own_args"], own_args, num_paths),
            y=self._in_lanes(types["y"], y0, num_paths),
            solver_state=self._in_lanes(self._types_of_moving, moving, num_paths),
            stopped=dr.opaque(dtypes["i1"], False, num_paths),
        )
        shared = dict(arrays=arrays, h=np.asarray(h), fixed=fixed)
        return lanes, pack(self._types_of_shared, shared)

    def advance(
        self, lanes: Lanes, shared: dict[str, Any], first_step: int, end_step: int
    ) -> Lanes:
        """The paths after the steps `first_step` to `end_step - 1`."""
        # The numbers are inputs of the kernel, so that it serves for all steps.
        opaque = ft.partial(dr.opaque, array_types()["i32"])
        y, solver_state, stopped = self._take_steps(
            shared, self._step.constants, opaque(first_step), opaque(end_step), lanes
        )
        return dataclasses.replace(
            lanes, y=y, solver_state=solver_state, stopped=stopped
        )

    def _in_lanes(
        self, types: PyTree, arrays: PyTree[Array], num_paths: int
    ) -> list[Any]:
        """A Dr.Jit array for each entry of these arrays of a path, with a lane for each
        path. If paths differ, the arrays have a leading axis of paths. Otherwise all lanes
        get the same values."""
        lanes = []
        leaves = zip(jtu.tree_leaves(types), jtu.tree_leaves(arrays), strict=True)
        for array_type, x in leaves:
            if self._functions.paths_differ:
                # Of shape (entries, paths).
                rows = as_numbers(x).reshape(num_paths, -1).T
                lanes += [array_in_memory(array_type.kind, row) for row in rows]
            else:
                in_all_lanes = ft.partial(dr.opaque, array_types()[array_type.kind])
                lanes += [in_all_lanes(n.item(), num_paths) for n in as_numbers(x).flat]
        return lanes

    def _record_keys(self, packed: dict[str, Any], high: Any, low: Any) -> list[Any]:
        """Records the computation of the random keys, as integers, of the paths with the
        numbers `high * 2^32 + low`."""
        arrays_and_key = unpack(self._types_for_keys, packed)
        keys, _ = self._path_keys(**arrays_and_key, high=scalar(high), low=scalar(low))
        return [*entries_of(keys)]

    def _record_steps(
        self,
        packed: dict[str, Any],
        constants: list[Any],
        first_step: Any,
        end_step: Any,
        lanes: Lanes,
    ) -> tuple[list[Any], list[Any], Any]:
        """Records the loop over the steps `first_step` to `end_step - 1`. Returns `y`,
        `solver_state` and `stopped` of the `Lanes` after these steps.

        - `packed`: the arrays that all paths share.
        - `constants`: the large constants of a step, such as tables. They are arguments,
            since Dr.Jit asks for all that a recorded function reads in memory.
        """
        # Dr.Jit numbers its variables one after another, one for each operation. So the
        # number of operations is about `last_variable - first_variable`. (The difference is
        # too large if many other variables are alive, since Dr.Jit fills the gaps between
        # their numbers.)
        first_variable = (first_step + 1).index
        types = self._step.types
        shared = unpack(self._types_of_shared, packed)
        same_in_all_steps = dict(
            arrays=shared["arrays"],
            h=shared["h"],
            keys=tensors_of(types["keys"], lanes.keys),
            own_args=tensors_of(types["own_args"], lanes.own_args),
        )

        def has_more_steps(i: Any, *_state: Any) -> Any:
            return i < end_step

        def after_step(
            i: Any, stopped: Any, y: list[Any], solver_state: list[Any]
        ) -> tuple[Any, Any, list[Any], list[Any]]:
            moving = tensors_of(self._types_of_moving, solver_state)
            stepped, error_masks = self._step(
                **same_in_all_steps,
                i=scalar(i),
                y=tensors_of(types["y"], y),
                solver_state=eqx.combine(moving, shared["fixed"]),
                constants=constants,
            )
            # The order of these masks decides how LLVM schedules operations. With the
            # success first, a step in single precision takes 1.13 times as long for
            # `StormerVerlet`, and 0.85 times for Heun's method.
            for failed in (*error_masks, ~stepped.success.item()):
                stopped = stopped | failed

            # A path that has stopped keeps its last state. A state of NaN would take the
            # largest number of sweeps in every later step.
            def kept_if_stopped(old: list[Any], new: PyTree[Tensor]) -> list[Any]:
                new_entries = entries_of(jtu.tree_leaves(new))
                return [dr.select(stopped, a, b) for a, b in zip(old, new_entries)]

            new_y = kept_if_stopped(y, stepped.y)
            new_moving = eqx.filter(stepped.solver_state, self._is_moving)
            return i + 1, stopped, new_y, kept_if_stopped(solver_state, new_moving)

        state_at_start = (first_step, lanes.stopped, lanes.y, lanes.solver_state)
        _, stopped, y, solver_state = dr.while_loop(
            state_at_start, has_more_steps, after_step, mode="symbolic"
        )
        last_variable = max(x.index for x in [stopped, *y, *solver_state])
        # The kernel is compiled after this method has returned.
        _warn_if_slow_to_compile(num_operations=last_variable - first_variable)
        return y, solver_state, stopped


def _warn_if_slow_to_compile(num_operations: int) -> None:
    if num_operations > _MOST_OPERATIONS:
        warnings.warn(
            f"A step of this system is a kernel of about {num_operations:,} operations, "
            "which compiles for longer than JAX does, for seconds to minutes: loops of "
            "known length, sorting and linear algebra are written out. Pass "
            '`engine="jax"`, unless the paths are very many.',
            stacklevel=3,
        )
