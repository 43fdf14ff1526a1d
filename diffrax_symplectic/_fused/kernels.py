"""Kernels that move paths through their steps. Each is recorded and compiled once for a
layout, and reads step sizes, times, parameters and numbers of steps."""

import functools as ft
import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._stablehlo import (
    array_types,
    drjit,
    flat,
    MOST_IN_REGISTERS,
    Replay,
    scalar,
    Table,
    Tensor,
    unflat,
)
from .layout import Layout


# Kernels of larger systems take long to compile.
_MOST_NUMBERS = 256
# Dr.Jit warns if a function is recorded more often.
_RECORDINGS = 100


class Program:
    """A function lowered for one path, with the layout of its arguments."""

    def __init__(self, fn: Callable, *args: PyTree):
        # Lowered for CPUs on every device: for others JAX emits calls of libraries.
        with jax.default_device(jax.devices("cpu")[0]):
            lowered = jax.jit(fn, keep_unused=True).lower(*args)
        self.replay = Replay(lowered.compiler_ir("stablehlo"))
        types = iter(self.replay.arguments)
        self.types = [[next(types) for _ in jtu.tree_leaves(x)] for x in args]

    def constants(self) -> list[Any]:
        """The large constants, in memory."""
        pairs = self.replay.constants.items()
        of = lambda x: str(x.type.element_type)
        return [in_memory(of(x), values.ravel()) for x, values in pairs]

    def entries(self, argument: int) -> list[str]:
        """The types of all entries of an argument."""
        return [t for shape, t in self.types[argument] for _ in range(math.prod(shape))]

    def tensors(self, argument: int, entries: Iterable[Any]) -> list[Tensor]:
        return unflat(entries, [shape for shape, _ in self.types[argument]])


# The shape of an array and the type of its entries.
Struct: TypeAlias = tuple[tuple[int, ...], str]


def _packed(
    structs: list[Struct], arrays: Iterable[Array | np.ndarray]
) -> dict[str, Any]:
    """All entries, in one array for each type."""
    of_type: dict[str, list[np.ndarray]] = {t: [] for _, t in structs}
    for (_, t), x in zip(structs, arrays, strict=True):
        of_type[t].append(_numbers(x).ravel())
    return {t: in_memory(t, np.concatenate(xs)) for t, xs in of_type.items()}


def in_memory(of: str, values: np.ndarray) -> Any:
    """An array of Dr.Jit with these values."""
    kind = array_types()[of]
    if np.iscomplexobj(values):
        part = of.removeprefix("complex<").removesuffix(">")
        return kind(in_memory(part, np.real(values)), in_memory(part, np.imag(values)))
    # As a list, which is copied: memory of NumPy could be freed while Dr.Jit records.
    return kind(values.tolist())


def _unpacked(structs: list[Struct], packed: dict[str, Any]) -> Iterator[Tensor]:
    """The inverse of `_packed`, within a kernel."""
    begin = dict.fromkeys(packed, 0)
    for shape, t in structs:
        size = math.prod(shape)
        table = Table(packed[t], begin[t] + np.arange(size))
        begin[t] += size
        yield Tensor(table if size > MOST_IN_REGISTERS else [*table], shape)


def _numbers(x: Array | np.ndarray) -> np.ndarray:
    typed = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jr.key_data(x) if typed else x)


class Paths(NamedTuple):
    """The paths of a batch. Each Dr.Jit array has one lane for each path.

    - `keys`: the words of the random keys, and the entries of the paths' own `args`.
    - `y`: the entries of the states.
    - `memory`: the entries of the solver states.
    - `stopped`: whether a step of the path was not solved.
    """

    keys: list[Any]
    y: list[Any]
    memory: list[Any]
    stopped: Any


class Kernels:
    """The kernels of a layout. Raises a `ValueError` if the system is too large."""

    def __init__(self, layout: Layout):
        arrays, key = layout.arrays, layout.key
        word, number = (jax.ShapeDtypeStruct((), x) for x in ("uint32", "int32"))
        keys = jax.eval_shape(layout.path_keys, arrays, key, word, word)
        own = [*keys, *layout.own_args]
        y = jtu.tree_leaves(jax.eval_shape(lambda x: layout.problem(x).y0, arrays))
        memory = jax.eval_shape(layout.start, arrays, own, y)
        size = sum(math.prod(x.shape) for x in y)
        if size > _MOST_NUMBERS:
            raise ValueError(
                f'`engine="drjit"` takes states of up to {_MOST_NUMBERS} numbers; got '
                f'{size}. Pass `engine="jax"`.'
            )
        h = jax.ShapeDtypeStruct((), jnp.result_type(*y))

        def start_of_one(arrays, key, y, args):
            of = lambda lo: layout.path_keys(arrays, key, jnp.zeros_like(lo), lo)
            start = lambda keys: layout.start(arrays, [*keys, *args], y)
            # No solver draws random numbers in `init`: it does not depend on the keys.
            return jax.vmap(start, out_axes=None)(
                jax.vmap(of)(jnp.zeros(1, word.dtype))
            )

        @jax.jit
        def start(arrays, key, y, args):
            if layout.paths_differ:
                return jax.vmap(start_of_one, (None, None, 0, 0))(arrays, key, y, args)
            return start_of_one(arrays, key, y, args)

        self._start = start
        self._keys = Program(layout.path_keys, arrays, key, word, word)
        self._step = Program(layout.step, arrays, own, h, number, y, memory)
        self._paths_differ = layout.paths_differ
        # Entries of the solver state that a step returns unchanged are parameters, if all
        # paths start alike.
        begin = sum(map(len, self._step.types[:-1]))
        handed_on = self._step.replay.handed_on[len(y) : -1]
        self._moves = [
            layout.paths_differ or i != begin + k for k, i in enumerate(handed_on)
        ]
        self._constants = self._step.constants()
        freeze = ft.partial(drjit().freeze, warn_after=_RECORDINGS)
        self._make_keys = freeze(self._record_keys)
        self._take_steps = freeze(self._record_steps)

    def begin(
        self,
        arrays: list[Array],
        key: PRNGKeyArray,
        h: Array | np.ndarray,
        first: int,
        n: int,
        y0: PyTree[Array],
        args: PyTree[Array],
    ):
        """The paths of the samples `first` to `first + n - 1`, and the parameters of their
        steps of size `h`. If paths differ, `y0` and their own `args` have a leading axis of
        paths."""
        dr, kinds = drjit(), array_types()
        types = [*self._keys.types[0], *self._keys.types[1]]
        numbers = dr.arange(kinds["ui64"], n) + first
        hi, lo = kinds["ui32"](numbers >> 32), kinds["ui32"](numbers)
        dr.eval(hi, lo)
        keys = self._make_keys(_packed(types, [*arrays, key]), hi, lo)
        y, own = jtu.tree_leaves(y0), jtu.tree_leaves(args)
        memory = self._start(arrays, key, y, own)
        fixed = [x for x, moves in zip(memory, self._moves) if not moves]
        parameters = _packed(self._uniform, [*arrays, h, *fixed])

        def for_all(types: list[str], leaves) -> list[Any]:
            if self._paths_differ:
                rows = [x for a in leaves for x in _numbers(a).reshape(n, -1).T]
                return [in_memory(t, x) for t, x in zip(types, rows, strict=True)]
            values = [x for leaf in leaves for x in _numbers(leaf).flat]
            return [dr.opaque(kinds[t], x.item(), n) for t, x in zip(types, values)]

        moving = [x for x, moves in zip(memory, self._moves) if moves]
        keys += for_all(self._step.entries(1)[len(keys) :], own)
        y, memory = for_all(self._step.entries(4), y), for_all(self._moving, moving)
        paths = Paths(keys, y, memory, dr.opaque(kinds["i1"], False, n))
        return paths, (parameters, self._constants)

    def advance(self, paths: Paths, parameters, begin: int, end: int) -> Paths:
        """The paths after the steps `begin` to `end - 1`."""
        number = ft.partial(drjit().opaque, array_types()["i32"])
        y, memory, stopped = self._take_steps(
            parameters, number(begin), number(end), *paths
        )
        return Paths(paths.keys, y, memory, stopped)

    @property
    def _uniform(self) -> list[Struct]:
        return [*self._step.types[0], *self._step.types[2], *self._memory(False)]

    @property
    def _moving(self) -> list[str]:
        return [t for s, t in self._memory(True) for _ in range(math.prod(s))]

    def _memory(self, moves: bool) -> list[Struct]:
        return [x for x, m in zip(self._step.types[5], self._moves) if m == moves]

    def _record_keys(self, packed, hi, lo) -> list[Any]:
        program = self._keys
        args = _unpacked([*program.types[0], *program.types[1]], packed)
        out, _ = program.replay(*args, scalar(hi), scalar(lo))
        return [*flat(out)]

    def _record_steps(self, parameters, begin, end, keys, y, memory, stopped):
        dr, step = drjit(), self._step
        packed, constants = parameters
        tensors = _unpacked(self._uniform, packed)
        arrays = [*itertools.islice(tensors, len(step.types[0]))]
        h = [next(tensors)]
        fixed = [*tensors]
        shapes = [shape for shape, _ in self._memory(True)]
        uniform = [*arrays, *step.tensors(1, iter(keys)), *h]

        def once(i, stopped, *numbers):
            left = iter(numbers)
            y, moving = step.tensors(4, left), iter(unflat(left, shapes))
            still = iter(fixed)
            memory = [next(moving if m else still) for m in self._moves]
            args = [*uniform, scalar(i), *y, *memory]
            out, errors = step.replay(*args, memory=constants)
            *out, success = out
            for lost in (~success.item(), *errors):
                stopped = stopped | lost
            new = [*flat(out[: len(y)])]
            new += flat([x for x, m in zip(out[len(y) :], self._moves) if m])
            kept = [dr.select(stopped, a, b) for a, b in zip(numbers, new)]
            return i + 1, stopped, *kept

        _, stopped, *numbers = dr.while_loop(
            (begin, stopped, *y, *memory),
            lambda i, *_: i < end,
            once,
            mode="symbolic",
            compress=False,
        )
        return numbers[: len(y)], numbers[len(y) :], stopped
