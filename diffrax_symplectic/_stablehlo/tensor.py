"""Arrays of one path, for all paths at once: each entry is a Dr.Jit array with one *lane*
for each path.

The *position* of an entry is its index in the flat list of all entries, which is in
row-major order.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from .._compat import is_literal
from .backend import array_types, dr


# An array that all paths share stays in memory if it has more entries than this. Each entry
# in registers is a variable of the kernel, which takes time to record and to compile.
MOST_IN_REGISTERS = 64


@dataclasses.dataclass(frozen=True)
class ArrayType:
    """The shape of an array, and `kind`, StableHLO's name of the type of its entries, such
    as `f64`."""

    shape: tuple[int, ...]
    kind: str

    @property
    def size(self) -> int:
        return math.prod(self.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class Table(Sequence):
    """The entries of an array that all paths share, which stay in memory. An entry is read
    only where a rule asks for it, and each path may read a different entry.

    - `memory`: the Dr.Jit array that holds the entries, perhaps among others.
    - `addresses`: for each entry, its index in `memory`.
    - `values`: the values in `memory` if they are constants of the program, so that Dr.Jit
        can fold operations with them.
    """

    memory: Any
    addresses: np.ndarray
    values: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.addresses)

    def __getitem__(self, i: Any) -> Any:
        address = int(self.addresses[i])
        if self.values is not None:
            # A constant becomes a part of the kernel, without a read of memory.
            return type(self.memory)(self.values[address].item())
        return self.gathered(array_types()["ui32"](address))

    def gathered(self, addresses: Any) -> Any:
        """The values in `memory` at these addresses, of which each path has one."""
        return dr.gather(type(self.memory), self.memory, addresses)


@dataclasses.dataclass(frozen=True)
class Tensor:
    """An array whose entries, in row-major order, are Dr.Jit arrays with one lane for each
    path."""

    entries: Sequence[Any]
    shape: tuple[int, ...]

    @property
    def positions(self) -> np.ndarray:
        """The positions `0, 1, 2, ...` of the entries, as an array of this shape. A rule
        that moves entries lets NumPy move the positions, and then takes the entries there:
        `x.take(x.positions.T)` is the transpose."""
        return np.arange(len(self.entries)).reshape(self.shape)

    def take(self, positions: np.ndarray) -> "Tensor":
        """The array of the entries at these positions."""
        # The entries of a table stay in memory: only their addresses are taken.
        if isinstance(self.entries, Table):
            addresses = self.entries.addresses[positions.ravel()]
            table = dataclasses.replace(self.entries, addresses=addresses)
            return Tensor(table, positions.shape)
        entries = [self.entries[position] for position in positions.flat]
        return Tensor(entries, positions.shape)

    def item(self) -> Any:
        """The only entry of an array that has one."""
        (entry,) = self.entries
        return entry


def scalar(entry: Any) -> Tensor:
    """An array without axes."""
    return Tensor([entry], ())


def constant(dtype: type, values: np.ndarray) -> Tensor:
    """An array of constants with these values. `dtype` is a type of Dr.Jit arrays."""
    return Tensor([dtype(value.item()) for value in values.flat], values.shape)


def array_in_memory(kind: str, values: np.ndarray) -> Any:
    """A Dr.Jit array with these values as its lanes. `kind` is StableHLO's name of their
    type, as in `ArrayType`."""
    dtype = array_types()[kind]
    if np.iscomplexobj(values):
        part = kind.removeprefix("complex<").removesuffix(">")
        real = array_in_memory(part, np.real(values))
        imag = array_in_memory(part, np.imag(values))
        return dtype(real, imag)
    # Dr.Jit copies a list, but may share the memory of a NumPy array, which could be freed
    # while the kernel is recorded.
    return dtype(values.tolist())


def known_value(x: Tensor) -> Any | None:
    """The value of an array with a single entry, such as an index or a condition, if the
    value is known while the kernel is recorded: it is a constant, or Dr.Jit folded it from
    constants. Otherwise `None`.

    Where a value is known, loops are unrolled and entries selected at this time.
    """
    entry = x.item()
    # A constant has the same value in all lanes, so that the first lane gives it.
    return entry[0] if is_literal(entry) else None


def map_entries(fn: Callable, *xs: Tensor) -> Tensor:
    """Applies a function entry by entry. The arrays have the same shape, except for
    scalars, which are repeated as needed."""
    # The result has the shape of the largest array. Among arrays with one entry, an array
    # of shape (1,) counts as larger than a scalar.
    largest = max(xs, key=lambda x: (len(x.entries), len(x.shape)))
    size = len(largest.entries)
    operands = [
        x.entries if len(x.entries) == size else [*x.entries] * size for x in xs
    ]
    results = [fn(*entries) for entries in zip(*operands)]
    return Tensor(results, largest.shape)


def entries_of(xs: Sequence[Tensor]) -> tuple[Any, ...]:
    """The entries of all these tensors."""
    return tuple(entry for x in xs for entry in x.entries)


def tensors_from(
    entries: Iterable[Any], shapes: Sequence[tuple[int, ...]]
) -> list[Tensor]:
    """Tensors of these shapes, each with the next of the `entries`: the inverse of
    `entries_of`."""
    remaining = iter(entries)
    tensors = []
    for shape in shapes:
        entries_of_tensor = itertools.islice(remaining, math.prod(shape))
        tensors.append(Tensor([*entries_of_tensor], shape))
    return tensors


def copied_entries(xs: Sequence[Tensor]) -> tuple[Any, ...]:
    """Copies of the entries of these tensors.

    A branch or the body of a loop must return copies, since Dr.Jit writes the results of a
    conditional into the objects that a branch returned. If a branch returned a variable
    from outside of the branch itself, this variable would change wherever it is used.
    """
    return tuple(type(entry)(entry) for entry in entries_of(xs))


def usable_outside(entry: Any) -> Any:
    """The same value as `entry`, which a conditional or loop of the kernel returned, for
    use after the conditional or loop: a constant is replaced by a new constant.

    If both branches return the same constant, Dr.Jit returns the constant of the second
    branch, which is defined within this branch only. LLVM aborts the process if an outer
    branch returns that constant.
    """
    if dr.is_complex_v(entry):
        # One part of a complex number may be a constant, and the other not.
        return type(entry)(usable_outside(entry.real), usable_outside(entry.imag))
    # A constant has the same value in all lanes, so that the first lane gives it. Dr.Jit
    # knows this value while it records: to read it runs no kernel.
    return type(entry)(entry[0]) if is_literal(entry) else entry
