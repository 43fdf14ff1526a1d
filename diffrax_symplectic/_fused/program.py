"""Functions of one path, lowered to StableHLO; and the arrays that kernels read, packed for
Dr.Jit."""

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
    """A function of arrays of one path, lowered to StableHLO. In place of each array a
    program takes a `Tensor`, which holds the array for many paths, each in a lane of its
    own. So it computes the function for all paths at once.

    - `types`: the types of all argument arrays. It is a dictionary by the names of the
        arguments, and each item has the structure of the argument.
    - `numbers`: with the same structure, the number of each of these arrays, counted from
        the first array of the first argument.
    - `returned`: with the structure of the results, the number of the argument array that
        the function returns unchanged as this result, or -1 if there is none.
    - `constants`: the large constants of the program, as arrays of Dr.Jit.
    """

    def __init__(self, fn: Callable, **arguments: PyTree):
        """`arguments` are PyTrees of shapes and dtypes."""
        # `fn` is lowered for CPUs on every device: for other devices JAX emits calls of
        # libraries. Unused arguments are kept, so that each argument array has a type.
        with jax.default_device(jax.devices("cpu")[0]):
            lowered = jax.jit(fn, keep_unused=True).lower(**arguments)
        # The module, not its text, which would take time to write and to parse.
        self._replay = Replay(lowered.compiler_ir("stablehlo"))
        types = self._replay.arguments
        leaves, treedef = jtu.tree_flatten(arguments)
        if len(types) > len(leaves):
            # The program has arguments that `fn` does not have: traced values that a user's
            # function closes over.
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
        """The results, and masks of the lanes that fail. `constants` are
        `self.constants`, as arguments of the kernel. Without them, large constants are
        written into the kernel."""
        tensors = jtu.tree_leaves(arguments)
        results, error_masks = self._replay(*tensors, constants=constants)
        return self._out_tree.unflatten(results), error_masks


def tensors_of(types: PyTree[ArrayType], entries: Iterable[Any]) -> PyTree[Tensor]:
    """Tensors of these types, each with the next of the `entries`."""
    leaves, treedef = jtu.tree_flatten(types)
    return treedef.unflatten(tensors_from(entries, [leaf.shape for leaf in leaves]))


def pack(
    types: PyTree[ArrayType], arrays: PyTree[Array | np.ndarray]
) -> dict[str, Any]:
    """Packs arrays that all paths share: for each kind of number, such as `f64`, one Dr.Jit
    array of the entries of all arrays of this kind, one after another. So a kernel has few
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
    """The arrays of these types that `pack` has packed, within a kernel."""
    # For each kind, the number of entries of the arrays that are unpacked already, which is
    # the address of the next entry.
    next_address = dict.fromkeys(packed, 0)

    def unpacked(array_type: ArrayType) -> Tensor:
        kind = array_type.kind
        addresses = next_address[kind] + np.arange(array_type.size)
        next_address[kind] += array_type.size
        table = Table(packed[kind], addresses)
        # A small array is read here, before the loop over steps. An entry of a large array
        # is read where a step needs it.
        entries = table if array_type.size > MOST_IN_REGISTERS else [*table]
        return Tensor(entries, array_type.shape)

    return jtu.tree_map(unpacked, types)


def as_numbers(x: Array | np.ndarray) -> np.ndarray:
    """The array as a NumPy array. An array of random keys becomes an array of the integers
    of the keys, which stand for the keys in lowered programs, too."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jr.key_data(x) if is_key else x)
