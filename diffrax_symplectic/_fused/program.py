"""Functions of one path, lowered for replays."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._arguments import inside_jax
from .._stablehlo import (
    array_types,
    ArrayType,
    in_memory,
    MOST_IN_REGISTERS,
    Replay,
    Table,
    Tensor,
)


class Program:
    """A function of arrays of one path, lowered to StableHLO.

    - `replay`: the function of tensors.
    - `types`: for each argument of the function, by its name, the types of its leaves.
    """

    def __init__(self, fn: Callable, arguments: dict[str, PyTree]):
        """`arguments` are names, in the order of `fn`, with structures of shapes."""
        # Lowered for CPUs on every device: for others JAX emits calls of libraries. With
        # unused arguments, so that arguments and types are in step.
        with jax.default_device(jax.devices("cpu")[0]):
            lowered = jax.jit(fn, keep_unused=True).lower(*arguments.values())
        # The module itself: to write it as text and to read that takes longer.
        self.replay = Replay(lowered.compiler_ir("stablehlo"))
        left = iter(self.replay.arguments)
        if len(self.replay.arguments) > len(jtu.tree_leaves(arguments)):
            # Traced values that a function closes over are arguments of the program, too.
            raise inside_jax('`engine="drjit"`')
        self.types: dict[str, list[ArrayType]] = {
            name: [next(left) for _ in jtu.tree_leaves(argument)]
            for name, argument in arguments.items()
        }
        for leaf, of in zip(jtu.tree_leaves(arguments), self.replay.arguments):
            _check_kind(leaf, of)


def _check_kind(leaf: Any, of: ArrayType) -> None:
    if of.kind not in array_types():
        raise ValueError(
            f'`engine="drjit"` has no numbers of type {leaf.dtype}, which an array in '
            "`args` or `terms` has. Convert it, with `.astype(float)` or `.astype(int)`, "
            'or pass `engine="jax"`.'
        )


def entry_kinds(types: Iterable[ArrayType]) -> list[str]:
    """The kind of each entry of arrays of these types."""
    return [of.kind for of in types for _ in range(of.size)]


def shapes(types: Iterable[ArrayType]) -> list[tuple[int, ...]]:
    return [of.shape for of in types]


def pack(
    types: Sequence[ArrayType], arrays: Iterable[Array | np.ndarray]
) -> dict[str, Any]:
    """The entries of all these arrays, which all paths share, in one array of Dr.Jit for
    each kind: a kernel takes few arguments."""
    of_kind: dict[str, list[np.ndarray]] = {of.kind: [] for of in types}
    for of, x in zip(types, arrays, strict=True):
        of_kind[of.kind].append(as_numbers(x).ravel())
    return {kind: in_memory(kind, np.concatenate(xs)) for kind, xs in of_kind.items()}


def unpack(types: Sequence[ArrayType], packed: dict[str, Any]) -> list[Tensor]:
    """The inverse of `pack`, within a kernel."""
    begin = dict.fromkeys(packed, 0)
    tensors = []
    for of in types:
        places = begin[of.kind] + np.arange(of.size)
        begin[of.kind] += of.size
        table = Table(packed[of.kind], places)
        # Small arrays are read once, before the loop over steps.
        entries = table if of.size > MOST_IN_REGISTERS else [*table]
        tensors.append(Tensor(entries, of.shape))
    return tensors


def as_numbers(x: Array | np.ndarray) -> np.ndarray:
    """The array, or the words of random keys."""
    # Dr.Jit knows no random keys. In a lowered program these are their words, too.
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jr.key_data(x) if is_key else x)
