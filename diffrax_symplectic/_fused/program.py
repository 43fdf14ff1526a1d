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
    tensors_from,
)


class Program:
    """A function of arrays of one path, lowered to StableHLO: a function of tensors in
    place of these arrays.

    - `types`: for each argument of the function, by its name, the types of its arrays, in
        the structure of the argument.
    - `numbers`: in the same structure, the numbers of these arrays among all.
    - `returned`: in the structure of the results, for each array the number of the array
        that is returned unchanged in its place, or -1.
    - `constants`: the large constants of the program, as arrays of Dr.Jit.
    """

    def __init__(self, fn: Callable, **arguments: PyTree):
        """`arguments` are PyTrees of shapes and dtypes."""
        # On every device `fn` is lowered for CPUs: for others JAX emits calls of libraries.
        # Unused arguments are kept, so that arguments and types are in step.
        with jax.default_device(jax.devices("cpu")[0]):
            lowered = jax.jit(fn, keep_unused=True).lower(**arguments)
        # The module is passed itself: to write it as text and to parse the text takes
        # longer.
        self._replay = Replay(lowered.compiler_ir("stablehlo"))
        types = self._replay.arguments
        leaves, treedef = jtu.tree_flatten(arguments)
        if len(types) > len(leaves):
            # Traced values that a function closes over are arguments of the program, too.
            raise inside_jax('`engine="drjit"`')
        for leaf, array_type in zip(leaves, types):
            if array_type.kind not in array_types():
                raise ValueError(
                    f'`engine="drjit"` has no numbers of type {leaf.dtype}, which an array '
                    "in `args` or `terms` has. Convert it, with `.astype(float)` or "
                    '`.astype(int)`, or pass `engine="jax"`.'
                )
        self._out_tree = lowered.out_tree
        self.types: dict[str, PyTree[ArrayType]] = treedef.unflatten(types)
        self.numbers: dict[str, PyTree[int]] = treedef.unflatten(range(len(types)))
        returned = self._replay.returned_arguments
        self.returned: PyTree[int] = self._out_tree.unflatten(
            [-1 if number is None else number for number in returned]
        )
        self.constants = self._replay.constants()

    def __call__(
        self, *, constants: Sequence[Any] = (), **arguments: PyTree[Tensor]
    ) -> tuple[PyTree[Tensor], list[Any]]:
        """The results, and masks of the lanes that raise an error. Without `constants`,
        large ones are written into the kernel."""
        tensors = jtu.tree_leaves(arguments)
        results, error_masks = self._replay(*tensors, constants=constants)
        return self._out_tree.unflatten(results), error_masks


def tensors_of(types: PyTree[ArrayType], entries: Iterable[Any]) -> PyTree[Tensor]:
    """Tensors of these types from their entries, one array after another."""
    leaves, treedef = jtu.tree_flatten(types)
    return treedef.unflatten(tensors_from(entries, [leaf.shape for leaf in leaves]))


def pack(
    types: PyTree[ArrayType], arrays: PyTree[Array | np.ndarray]
) -> dict[str, Any]:
    """The entries of all these arrays, which all paths share, one array after another, in
    one array of Dr.Jit for each kind of number, such as `f64`: a kernel takes few
    arguments."""
    rows: dict[str, list[np.ndarray]] = {}
    leaves = zip(jtu.tree_leaves(types), jtu.tree_leaves(arrays), strict=True)
    for array_type, x in leaves:
        rows.setdefault(array_type.kind, []).append(as_numbers(x).ravel())
    return {
        kind: array_in_memory(kind, np.concatenate(rows_of_kind))
        for kind, rows_of_kind in rows.items()
    }


def unpack(types: PyTree[ArrayType], packed: dict[str, Any]) -> PyTree[Tensor]:
    """The inverse of `pack`, within a kernel."""
    # For each kind, the number of entries that belong to the arrays before.
    num_before = dict.fromkeys(packed, 0)

    def unpacked(array_type: ArrayType) -> Tensor:
        kind = array_type.kind
        addresses = num_before[kind] + np.arange(array_type.size)
        num_before[kind] += array_type.size
        table = Table(packed[kind], addresses)
        # Entries of small arrays are read here, before the loop over steps, and those of
        # large ones where a step asks for them.
        entries = table if array_type.size > MOST_IN_REGISTERS else [*table]
        return Tensor(entries, array_type.shape)

    return jtu.tree_map(unpacked, types)


def as_numbers(x: Array | np.ndarray) -> np.ndarray:
    """The array in NumPy; for random keys, an array of their words."""
    # Dr.Jit has no random keys. In a lowered program, too, random keys are their words.
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jr.key_data(x) if is_key else x)
