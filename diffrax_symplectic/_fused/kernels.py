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

from .._compat import frozen, variable_number
from .._custom_types import RealScalarLike
from .._stablehlo import (
    array_types,
    ArrayType,
    chosen,
    drjit,
    flat,
    in_memory,
    merged,
    scalar,
    unflat,
)
from .path_functions import PathFunctions
from .program import as_numbers, entry_kinds, pack, Program, shapes, unpack


# Kernels of larger systems take long to compile.
_MOST_NUMBERS = 256
# Kernels of more operations compile for longer than JAX: the stage equations of 64 rods, of
# 20,000, for 4.3 s where JAX takes 5.2 s, and a loop of linear systems, of 53,000, for 16 s
# where JAX takes 4.9 s.
_MOST_OPERATIONS = 25_000
# Dr.Jit warns if a function is recorded more often.
_MOST_RECORDINGS = 100


class Lanes(NamedTuple):
    """The paths of a batch. Each Dr.Jit array has one lane for each path.

    - `own`: the words of the random keys, and the entries of the paths' own `args`.
    - `y`: the entries of the states.
    - `solver_state`: the entries of the solver states that steps change.
    - `stopped`: whether a step of the path was not solved.
    """

    own: list[Any]
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
        word = jax.ShapeDtypeStruct((), "uint32")
        arrays = functions.arrays
        key = functions.key
        keys = jax.eval_shape(functions.path_keys, arrays, key, word, word)
        own = [*keys, *functions.own_args]
        y = jax.eval_shape(functions.y0, arrays)
        _check_size(sum(x.size for x in y))
        self._keys = Program(
            functions.path_keys,
            dict(arrays=arrays, key=key, high=word, low=word),
        )
        self._step = Program(
            functions.step,
            dict(
                arrays=arrays,
                own=own,
                h=jax.ShapeDtypeStruct((), jnp.result_type(*y)),
                number=jax.ShapeDtypeStruct((), "int32"),
                y=y,
                solver_state=jax.eval_shape(functions.start, arrays, own, y),
            ),
        )
        self._moves = self._which_arrays_move()
        self._constants = self._step.replay.constants()
        self._start = jax.jit(self._solver_state_at_start)
        self._make_keys = frozen(self._record_keys, _MOST_RECORDINGS)
        self._take_steps = frozen(self._record_steps, _MOST_RECORDINGS)

    def _which_arrays_move(self) -> list[bool]:
        """Which arrays of the solver state are the paths' own. Those that a step returns
        unchanged are shared, if all paths start alike: then they need no registers."""
        types = self._step.types["solver_state"]
        # It is the last argument of a step.
        first = len(self._step.replay.arguments) - len(types)
        # The results of a step: the state, the solver state, and whether it succeeded.
        begin = len(self._step.types["y"])
        returned = self._step.replay.handed_on[begin : begin + len(types)]
        return [
            self._functions.paths_differ or source != first + k
            for k, source in enumerate(returned)
        ]

    def _solver_state_at_start(
        self, arrays, key, y: list[Array], args: list[Array]
    ) -> list:
        """The solver state at the start of all paths, or of each if they differ."""

        def of_one(y: list[Array], args: list[Array]) -> list[Array]:
            def with_key(low: Array) -> list[Array]:
                high = jnp.zeros_like(low)
                keys = self._functions.path_keys(arrays, key, high, low)
                return self._functions.start(arrays, [*keys, *args], y)

            # No solver draws random numbers in `init`. JAX raises an error if the result
            # depends on the axis of numbers.
            return jax.vmap(with_key, out_axes=None)(jnp.zeros(1, "uint32"))

        if self._functions.paths_differ:
            return jax.vmap(of_one)(y, args)
        return of_one(y, args)

    def begin(
        self,
        arrays: list[Array],
        key: PRNGKeyArray,
        h: RealScalarLike,
        first: int,
        number: int,
        y0: PyTree[Array],
        args: PyTree[Array],
    ) -> tuple[Lanes, Shared]:
        """The paths of the samples `first` to `first + number - 1`, and what they share in
        steps of size `h`. If paths differ, `y0` and their own `args` have a leading axis of
        paths."""
        dr = drjit()
        kinds = array_types()
        # Opaque: a number would be a constant of the kernel, so that every batch compiled a
        # kernel of its own, in 20 to 40 ms.
        samples = dr.arange(kinds["ui64"], number) + dr.opaque(kinds["ui64"], first)
        high = kinds["ui32"](samples >> 32)
        low = kinds["ui32"](samples)
        dr.eval(high, low)
        keys = self._make_keys(pack(self._types_for_keys, [*arrays, key]), high, low)
        y = jtu.tree_leaves(y0)
        own_args = jtu.tree_leaves(args)
        solver_state = self._start(arrays, key, y, own_args)
        shared = [*arrays, np.asarray(h), *chosen(solver_state, self._stays)]
        lanes = Lanes(
            own=[*keys, *self._for_all(self._types_of_own_args, own_args, number)],
            y=self._for_all(self._step.types["y"], y, number),
            solver_state=self._for_all(
                self._types_of_moving, chosen(solver_state, self._moves), number
            ),
            stopped=dr.opaque(kinds["i1"], False, number),
        )
        return lanes, Shared(pack(self._types_of_shared, shared), self._constants)

    def advance(self, lanes: Lanes, shared: Shared, begin: int, end: int) -> Lanes:
        """The paths after the steps `begin` to `end - 1`."""
        # Opaque, so that other numbers need no other kernel.
        opaque = ft.partial(drjit().opaque, array_types()["i32"])
        y, solver_state, stopped = self._take_steps(
            *shared, opaque(begin), opaque(end), *lanes
        )
        return Lanes(lanes.own, y, solver_state, stopped)

    def _for_all(
        self, types: list[ArrayType], arrays: list[Array], number: int
    ) -> list[Any]:
        """The entries of these arrays, for each of the paths."""
        kinds = entry_kinds(types)
        if self._functions.paths_differ:
            # A row of numbers for each entry.
            rows = [row for x in arrays for row in as_numbers(x).reshape(number, -1).T]
            return [in_memory(kind, row) for kind, row in zip(kinds, rows, strict=True)]
        entries = [entry for x in arrays for entry in as_numbers(x).flat]
        return [
            drjit().opaque(array_types()[kind], entry.item(), number)
            for kind, entry in zip(kinds, entries, strict=True)
        ]

    @property
    def _types_for_keys(self) -> list[ArrayType]:
        return [*self._keys.types["arrays"], *self._keys.types["key"]]

    @property
    def _types_of_own_args(self) -> list[ArrayType]:
        own = self._step.types["own"]
        return own[len(own) - len(self._functions.own_args) :]

    @property
    def _types_of_shared(self) -> list[ArrayType]:
        types = self._step.types
        still = chosen(types["solver_state"], self._stays)
        return [*types["arrays"], *types["h"], *still]

    @property
    def _types_of_moving(self) -> list[ArrayType]:
        return chosen(self._step.types["solver_state"], self._moves)

    @property
    def _stays(self) -> list[bool]:
        return [not moves for moves in self._moves]

    def _record_keys(self, packed: dict[str, Any], high: Any, low: Any) -> list[Any]:
        """The words of the paths' own random keys, as Dr.Jit records their computation."""
        args = unpack(self._types_for_keys, packed)
        keys, _ = self._keys.replay(*args, scalar(high), scalar(low))
        return [*flat(keys)]

    def _record_steps(
        self,
        packed_of_shared: dict[str, Any],
        constants: list[Any],
        begin: Any,
        end: Any,
        own: list[Any],
        y: list[Any],
        solver_state: list[Any],
        stopped: Any,
    ) -> tuple[list[Any], list[Any], Any]:
        """The loop over steps, as Dr.Jit records it: the state, the solver state and which
        paths stopped, from those before."""
        select = drjit().select
        first = variable_number(begin + 1)
        step = self._step
        number_of_arrays = len(step.types["arrays"])
        shared = unpack(self._types_of_shared, packed_of_shared)
        arrays = shared[:number_of_arrays]
        h, *still = shared[number_of_arrays:]
        of_path = unflat(own, shapes(step.types["own"]))
        shapes_of_y = shapes(step.types["y"])
        shapes_of_moving = shapes(self._types_of_moving)

        def goes_on(i: Any, *_: Any) -> Any:
            return i < end

        def one_step(i: Any, stopped: Any, *numbers: Any) -> tuple[Any, ...]:
            left = iter(numbers)
            states = unflat(left, shapes_of_y)
            moving = unflat(left, shapes_of_moving)
            whole_state = merged(self._moves, moving, still)
            results, errors = step.replay(
                *arrays,
                *of_path,
                h,
                scalar(i),
                *states,
                *whole_state,
                constants=constants,
            )
            *results, success = results
            # LLVM schedules by the order: with the success first, a step of `StormerVerlet`
            # in single precision takes 1.13 times as long, and of Heun's method 0.85.
            for lost in (*errors, ~success.item()):
                stopped = stopped | lost
            moved = chosen(results[len(states) :], self._moves)
            new = [*flat(results[: len(states)]), *flat(moved)]
            # A path that stopped stays where it was: its numbers could be NaN, with which
            # sweeps end last.
            kept = [select(stopped, old, entry) for old, entry in zip(numbers, new)]
            return i + 1, stopped, *kept

        state = (begin, stopped, *y, *solver_state)
        _, stopped, *numbers = drjit().while_loop(
            state, goes_on, one_step, mode="symbolic"
        )
        last = max(map(variable_number, [stopped, *numbers]))
        _warn_of_operations(last - first)
        return numbers[: len(y)], numbers[len(y) :], stopped


def _warn_of_operations(number: int) -> None:
    """Warns, before it is compiled, of a kernel that compiles for longer than JAX."""
    if number > _MOST_OPERATIONS:
        warnings.warn(
            f"A step of this system is a kernel of about {number:,} operations, which "
            "compiles for longer than JAX does, for seconds to minutes: loops of known "
            'length, sorting and linear algebra are written out. Pass `engine="jax"`, '
            "unless the paths are very many.",
            stacklevel=2,
        )


def _check_size(number: int) -> None:
    if number > _MOST_NUMBERS:
        raise ValueError(
            f'`engine="drjit"` takes states of up to {_MOST_NUMBERS} numbers; got '
            f'{number}. Pass `engine="jax"`.'
        )
