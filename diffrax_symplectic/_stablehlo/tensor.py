"""Arrays of one path as lists of Dr.Jit arrays, each with one entry for all paths."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from .._compat import is_literal
from .backend import array_types, dr


# Larger arrays that all paths share stay in memory: each entry in registers is a variable
# of the kernel, which takes time to record and to compile.
MOST_IN_REGISTERS = 64


@dataclasses.dataclass(frozen=True)
class ArrayType:
    """The shape of an array, and StableHLO's name of the type of its entries (`f64`)."""

    shape: tuple[int, ...]
    kind: str

    @property
    def size(self) -> int:
        return math.prod(self.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class Table(Sequence):
    """The entries of an array that all paths share: positions in an array of Dr.Jit in
    memory. An entry is read where a rule asks for it; each path may ask for its own.

    - `memory`: the array of Dr.Jit, in its own order.
    - `addresses`: where in `memory` the entries are.
    - `values`: the values in `memory` if these are constants of the program, so that
        operations with them can be folded.
    """

    memory: Any
    addresses: np.ndarray
    values: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.addresses)

    def __getitem__(self, i: Any) -> Any:
        address = int(self.addresses[i])
        if self.values is not None:
            # A constant of the kernel, which costs no read of memory.
            return type(self.memory)(self.values[address].item())
        return self.gathered(array_types()["ui32"](address))

    def gathered(self, addresses: Any) -> Any:
        """What is at these addresses in `memory`, one for each path."""
        return dr.gather(type(self.memory), self.memory, addresses)


@dataclasses.dataclass(frozen=True)
class Tensor:
    """An array whose entries, in row-major order, are Dr.Jit arrays with one lane for each
    path."""

    entries: Sequence[Any]
    shape: tuple[int, ...]

    @property
    def places(self) -> np.ndarray:
        """The positions of the entries. Rules that move entries act on these: NumPy does
        to the array of positions what the operation does to the array."""
        return np.arange(len(self.entries)).reshape(self.shape)

    def take(self, places: np.ndarray) -> "Tensor":
        """The entries at these positions."""
        # Of a table, positions are moved, and nothing is read.
        if isinstance(self.entries, Table):
            addresses = self.entries.addresses[places.ravel()]
            table = dataclasses.replace(self.entries, addresses=addresses)
            return Tensor(table, places.shape)
        return Tensor([self.entries[place] for place in places.flat], places.shape)

    def item(self) -> Any:
        """The entry of an array with a single one."""
        (entry,) = self.entries
        return entry


def scalar(entry: Any) -> Tensor:
    """An array without axes."""
    return Tensor([entry], ())


def constant(dtype: type, values: np.ndarray) -> Tensor:
    """An array of values that are part of the program. `dtype` is a type of Dr.Jit."""
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
    # A list is copied. Memory of NumPy could be freed while Dr.Jit records.
    return dtype(values.tolist())


def known_value(x: Tensor) -> Any | None:
    """The value of an index or a condition, which is an array with a single entry, if that
    is a constant, or was folded from constants by Dr.Jit; `None` if it is not known while
    the kernel is recorded.

    With a known index, loops are unrolled and entries selected while recording.
    """
    entry = x.item()
    return entry[0] if is_literal(entry) else None


def map_entries(fn: Callable, *xs: Tensor) -> Tensor:
    """Applies a function entry by entry. The arrays have one shape, but for scalars, which
    are repeated as needed."""
    # The result has the shape of the largest array: beside a scalar, an array with a single
    # entry counts as larger, since it has axes.
    largest = max(xs, key=lambda x: (len(x.entries), len(x.shape)))
    size = len(largest.entries)
    # The entries of each array, repeated if it is a scalar.
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
    """Tensors of these shapes from the first of these entries, one after another: the
    inverse of `entries_of`."""
    remaining = iter(entries)
    tensors = []
    for shape in shapes:
        entries_of_tensor = itertools.islice(remaining, math.prod(shape))
        tensors.append(Tensor([*entries_of_tensor], shape))
    return tensors


def copied_entries(xs: Sequence[Tensor]) -> tuple[Any, ...]:
    """The entries of these tensors as objects of their own, as a branch or the body of a
    loop must return them: Dr.Jit writes the result of a conditional into the objects that
    a branch returned, so a value from outside would change for all who hold it."""
    return tuple(type(entry)(entry) for entry in entries_of(xs))


def as_own_literal(entry: Any) -> Any:
    """An entry that a conditional or loop returned, for use after it. If both branches
    return the same constant, Dr.Jit returns the constant of the second branch, which is
    defined within it only: LLVM aborts the process if an outer branch returns that."""
    if dr.is_complex_v(entry):
        # One part of a complex number may be a constant, and the other not.
        return type(entry)(as_own_literal(entry.real), as_own_literal(entry.imag))
    return type(entry)(entry[0]) if is_literal(entry) else entry
