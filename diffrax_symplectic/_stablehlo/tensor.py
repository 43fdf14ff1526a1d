"""Arrays of one path as lists of Dr.Jit arrays, each with one entry for all paths."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .backend import array_types, drjit


# Larger arrays that all paths share stay in memory.
MOST_IN_REGISTERS = 64


class Table(Sequence):
    """The entries of an array that all paths share: positions in an array of Dr.Jit in
    memory. An entry is read where a rule asks for it; each path may ask for its own.

    - `memory`: the array, in its own order.
    - `places`: where in `memory` the entries are.
    - `values`: the values in `memory` if these are constants of the program, so that
        operations with them can be folded.
    """

    def __init__(
        self, memory: Any, places: np.ndarray, values: np.ndarray | None = None
    ):
        self.memory = memory
        self.places = places
        self.values = values

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return self.at_places(np.arange(len(self))[i])
        place = int(self.places[i])
        if self.values is not None:
            return type(self.memory)(self.values[place].item())
        return self.gathered(array_types()["ui32"](place))

    def at_places(self, places: np.ndarray) -> "Table":
        return Table(self.memory, self.places[places], self.values)

    def gathered(self, places: Any) -> Any:
        """What is at these places of `memory`, one for each path."""
        return drjit().gather(type(self.memory), self.memory, places)


class Tensor(NamedTuple):
    """An array whose entries, in row-major order, are Dr.Jit arrays with one lane for each
    path."""

    entries: Sequence[Any]
    shape: tuple[int, ...]

    @property
    def places(self) -> np.ndarray:
        """The positions of the entries. Rules that move entries act on these."""
        return np.arange(len(self.entries)).reshape(self.shape)

    def take(self, places: np.ndarray) -> "Tensor":
        """The entries at these positions."""
        if isinstance(self.entries, Table):
            return Tensor(self.entries.at_places(places.ravel()), places.shape)
        return Tensor([self.entries[i] for i in places.flat], places.shape)

    def item(self) -> Any:
        (entry,) = self.entries
        return entry


def scalar(entry: Any) -> Tensor:
    return Tensor([entry], ())


def constant(kind: type, values: np.ndarray) -> Tensor:
    return Tensor([kind(x.item()) for x in values.flat], values.shape)


def known(x: Tensor) -> np.ndarray | None:
    """The values, if Dr.Jit knows them: constants, and what it folded from constants."""
    dr = drjit()
    literal = dr.VarState.Literal
    if not all(e.state == literal for e in x.entries):
        return None
    value = lambda e: complex(e.real[0], e.imag[0]) if dr.is_complex_v(e) else e[0]
    return np.array([value(e) for e in x.entries]).reshape(x.shape)


def each(fn: Callable, *xs: Tensor) -> Tensor:
    """Applies a function entry by entry. A scalar is repeated as needed."""
    size = max(xs, key=lambda x: (len(x.entries), len(x.shape)))
    spread = [
        x.entries
        if len(x.entries) == len(size.entries)
        else [*x.entries] * len(size.entries)
        for x in xs
    ]
    return Tensor([fn(*es) for es in zip(*spread)], size.shape)


def flat(xs: Sequence[Tensor]) -> tuple:
    return tuple(entry for x in xs for entry in x.entries)


def copied(xs: Sequence[Tensor]) -> tuple:
    """The entries of these tensors as objects of their own, as a branch or the body of a
    loop must return them: Dr.Jit writes the result of a conditional into the objects that
    a branch returned, so a value from outside would change for all who hold it."""
    return tuple(type(entry)(entry) for entry in flat(xs))


def made_here(entry: Any) -> Any:
    """An entry that a conditional or loop returned, for use after it. If both branches
    return the same constant, Dr.Jit returns the constant of the second branch, which is
    defined within it only: LLVM aborts the process if an outer branch returns that."""
    if entry.state != drjit().VarState.Literal:
        return entry
    return type(entry)(entry[0])


def unflat(entries: Iterable[Any], shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    left = iter(entries)
    return [Tensor([next(left) for _ in range(math.prod(s))], s) for s in shapes]
