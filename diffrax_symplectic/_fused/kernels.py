"""Kernels that move paths through their steps. Each is recorded and compiled once for a
system, and reads step sizes, times, parameters and numbers of steps."""

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
from .._stablehlo import array_in_memory, array_types, dr, entries_of, scalar
from .path_functions import PathFunctions
from .program import as_numbers, pack, Program, tensors_of, unpack


# Kernels of systems with more numbers in their state take long to compile.
_MOST_NUMBERS_IN_STATE = 256
# Kernels of more operations compile for longer than programs of JAX. The stage equations of
# 64 rods, 20,000 operations, compile for 4.3 s, by JAX for 5.2 s; a loop of linear systems,
# 53,000 operations, for 16 s, by JAX for 4.9 s.
_MOST_OPERATIONS = 25_000
# Dr.Jit warns of a function that is recorded more often than this.
_MOST_RECORDINGS = 100


@dataclasses.dataclass
class Lanes:
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
        y = eqx.filter_eval_shape(functions.system, arrays).y0
        y_leaves = jtu.tree_leaves(y)
        num_numbers = sum(x.size for x in y_leaves)
        if num_numbers > _MOST_NUMBERS_IN_STATE:
            raise ValueError(
                f'`engine="drjit"` takes states of up to {_MOST_NUMBERS_IN_STATE} '
                f'numbers; got {num_numbers}. Pass `engine="jax"`.'
            )
        self._path_keys = Program(
            functions.path_keys, arrays=arrays, key=key, high=word, low=word
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

        # For each array of the solver state, whether each path has its own. If all paths
        # start alike, they share the arrays that a step returns unchanged, which then need
        # no registers.
        def is_moving(number: int, returned: int) -> bool:
            return functions.paths_differ or returned != number

        self._is_moving = jtu.tree_map(
            is_moving,
            self._step.numbers["solver_state"],
            self._step.returned.solver_state,
        )
        # What is packed to make the keys of paths, and for the steps of all paths: arrays
        # of the system, step size, and the solver state that steps do not change.
        types = self._step.types
        self._types_of_moving, fixed = eqx.partition(
            types["solver_state"], self._is_moving
        )
        self._types_of_shared = dict(arrays=types["arrays"], h=types["h"], fixed=fixed)
        types_of_key = self._path_keys.types["key"]
        self._types_for_keys = dict(arrays=types["arrays"], key=types_of_key)
        self._compiled_solver_state = jax.jit(self._solver_state_at_start)
        # They are recorded once for each combination of types and layouts of arguments.
        frozen = ft.partial(dr.freeze, warn_after=_MOST_RECORDINGS)
        self._make_keys = frozen(self._record_keys)
        self._take_steps = frozen(self._record_steps)

    def _solver_state_at_start(
        self, arrays: list[Array], key, y: PyTree[Array], own_args: list[Array]
    ) -> PyTree[Array]:
        """The solver state before the first step: the state of all paths; or if paths
        differ, the states of all along a leading axis, which `y` and `own_args` have,
        too."""

        def start_of_numbered_path(
            low: Array, y: PyTree[Array], own_args: list[Array]
        ) -> PyTree[Array]:
            keys = self._functions.path_keys(arrays, key, jnp.zeros_like(low), low)
            return self._functions.start(arrays, keys, own_args, y)

        # No solver draws random numbers in `init`, so the number of a path does not matter.
        # With `out_axes=None`, JAX raises an error if the result depends on it.
        start = jax.vmap(start_of_numbered_path, (0, None, None), out_axes=None)
        start_of_path = ft.partial(start, jnp.zeros(1, "uint32"))
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
        their first step, and what they share in steps of size `h`. If paths differ, `y0`
        and `own_args` have a leading axis of paths."""
        kinds = array_types()
        # The number of the first path is opaque: otherwise it would be a constant of the
        # kernel, so that every batch compiled a kernel of its own, in 20 to 40 ms.
        offset = dr.opaque(kinds["ui64"], first_path)
        path_numbers = dr.arange(kinds["ui64"], num_paths) + offset
        high = kinds["ui32"](path_numbers >> 32)
        low = kinds["ui32"](path_numbers)
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
            stopped=dr.opaque(kinds["i1"], False, num_paths),
        )
        shared = dict(arrays=arrays, h=np.asarray(h), fixed=fixed)
        return lanes, pack(self._types_of_shared, shared)

    def advance(
        self, lanes: Lanes, shared: dict[str, Any], first_step: int, end_step: int
    ) -> Lanes:
        """The paths after the steps `first_step` to `end_step - 1`."""
        # Numbers of steps are opaque, so that other numbers need no other kernel.
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
        """A Dr.Jit array for each entry of these arrays, with a lane for each path. If
        paths differ, the arrays have a leading axis of paths."""
        lanes = []
        leaves = zip(jtu.tree_leaves(types), jtu.tree_leaves(arrays), strict=True)
        for array_type, x in leaves:
            if self._functions.paths_differ:
                # (entries, paths)
                rows = as_numbers(x).reshape(num_paths, -1).T
                lanes += [array_in_memory(array_type.kind, row) for row in rows]
            else:
                in_all_lanes = ft.partial(dr.opaque, array_types()[array_type.kind])
                lanes += [in_all_lanes(n.item(), num_paths) for n in as_numbers(x).flat]
        return lanes

    def _record_keys(self, packed: dict[str, Any], high: Any, low: Any) -> list[Any]:
        """The words of the random keys of the paths with the numbers `high * 2^32 + low`,
        as Dr.Jit records their computation."""
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
        """The state, the solver state and which paths stopped after the steps `first_step`
        to `end_step - 1`, as Dr.Jit records the loop over steps. Dr.Jit asks for all that
        is in memory as arguments, and so for the large `constants` of a step."""
        # Dr.Jit numbers its variables one after another, one for each operation. So the
        # difference between this number and the last one below counts the operations.
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
            # The order decides how LLVM schedules operations: with the success first, a
            # step of `StormerVerlet` in single precision takes 1.13 times as long, and of
            # Heun's method 0.85.
            for failed in (*error_masks, ~stepped.success.item()):
                stopped = stopped | failed

            # A path that stopped stays where it was: sweeps over NaN would go on to the
            # limit in every later step.
            def kept(old: Any, new: Any) -> Any:
                return dr.select(stopped, old, new)

            new_y = jtu.tree_leaves(stepped.y)
            new_moving = eqx.filter(stepped.solver_state, self._is_moving)
            new_state = entries_of(jtu.tree_leaves(new_moving))
            kept_y = [*map(kept, y, entries_of(new_y))]
            return i + 1, stopped, kept_y, [*map(kept, solver_state, new_state)]

        state_at_start = (first_step, lanes.stopped, lanes.y, lanes.solver_state)
        _, stopped, y, solver_state = dr.while_loop(
            state_at_start, has_more_steps, after_step, mode="symbolic"
        )
        last_variable = max(x.index for x in [stopped, *y, *solver_state])
        num_operations = last_variable - first_variable
        if num_operations > _MOST_OPERATIONS:
            # Before the kernel is compiled.
            warnings.warn(
                f"A step of this system is a kernel of about {num_operations:,} "
                "operations, which compiles for longer than JAX does, for seconds to "
                "minutes: loops of known length, sorting and linear algebra are written "
                'out. Pass `engine="jax"`, unless the paths are very many.',
                stacklevel=2,
            )
        return y, solver_state, stopped
