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
    array_in_memory,
    array_types,
    ArrayType,
    MOST_IN_REGISTERS,
    Replay,
    Table,
    Tensor,
)


class Program:
    """A function of arrays of one path, lowered to StableHLO.

    - `replay`: the function of tensors that replays it.
    - `types`: for each argument of the function, by its name, the types of its leaves.
    """

    def __init__(self, fn: Callable, arguments: dict[str, PyTree]):
        """`arguments` maps the names of the arguments of `fn`, in their order, to PyTrees
        of shapes and dtypes."""
        # On every device `fn` is lowered for CPUs: for others JAX emits calls of libraries.
        # Unused arguments are kept, so that arguments and types are in step.
        with jax.default_device(jax.devices("cpu")[0]):
            lowered = jax.jit(fn, keep_unused=True).lower(*arguments.values())
        # The module is passed itself: to write it as text and to parse the text takes
        # longer.
        self.replay = Replay(lowered.compiler_ir("stablehlo"))
        leaves = jtu.tree_leaves(arguments)
        if len(self.replay.arguments) > len(leaves):
            # Traced values that a function closes over are arguments of the program, too.
            raise inside_jax('`engine="drjit"`')
        for leaf, array_type in zip(leaves, self.replay.arguments):
            _check_kind(leaf, array_type)
        remaining_types = iter(self.replay.arguments)
        self.types: dict[str, list[ArrayType]] = {
            name: [next(remaining_types) for _ in jtu.tree_leaves(argument)]
            for name, argument in arguments.items()
        }


def _check_kind(leaf: Any, array_type: ArrayType) -> None:
    """Raises a `ValueError` for a leaf whose dtype Dr.Jit does not have."""
    if array_type.kind not in array_types():
        raise ValueError(
            f'`engine="drjit"` has no numbers of type {leaf.dtype}, which an array in '
            "`args` or `terms` has. Convert it, with `.astype(float)` or `.astype(int)`, "
            'or pass `engine="jax"`.'
        )


def entry_kinds(types: Iterable[ArrayType]) -> list[str]:
    """The kind of each entry of arrays of these types, one array after another."""
    return [array_type.kind for array_type in types for _ in range(array_type.size)]


def shapes_of(types: Iterable[ArrayType]) -> list[tuple[int, ...]]:
    return [array_type.shape for array_type in types]


def pack(
    types: Sequence[ArrayType], arrays: Iterable[Array | np.ndarray]
) -> dict[str, Any]:
    """The entries of all these arrays, which all paths share, one array after another, in
    one array of Dr.Jit for each kind of number, such as `f64`: a kernel takes few
    arguments."""
    rows: dict[str, list[np.ndarray]] = {array_type.kind: [] for array_type in types}
    for array_type, x in zip(types, arrays, strict=True):
        rows[array_type.kind].append(as_numbers(x).ravel())
    return {
        kind: array_in_memory(kind, np.concatenate(rows_of_kind))
        for kind, rows_of_kind in rows.items()
    }


def unpack(types: Sequence[ArrayType], packed: dict[str, Any]) -> list[Tensor]:
    """The inverse of `pack`, within a kernel."""
    # For each kind, the number of entries that belong to the arrays before.
    num_before = dict.fromkeys(packed, 0)
    tensors = []
    for array_type in types:
        kind = array_type.kind
        addresses = num_before[kind] + np.arange(array_type.size)
        num_before[kind] += array_type.size
        table = Table(packed[kind], addresses)
        # Entries of small arrays are read here, before the loop over steps, and those of
        # large ones where a step asks for them.
        entries = table if array_type.size > MOST_IN_REGISTERS else [*table]
        tensors.append(Tensor(entries, array_type.shape))
    return tensors


def as_numbers(x: Array | np.ndarray) -> np.ndarray:
    """The array in NumPy; for random keys, an array of their words."""
    # Dr.Jit has no random keys. In a lowered program, too, random keys are their words.
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jr.key_data(x) if is_key else x)
