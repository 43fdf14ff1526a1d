"""Operations that read or write a window of an array, at an index that may differ between
paths.

Entries in registers have no address. A window whose place each path computes is selected
by comparing the index with every place that it may have. Arrays in memory are read where
the index says.

Here a *start* is the index at which a window begins along one axis, and *places* are
positions in the list of the entries of an array. The *addresses* of an array in memory are
the positions of its entries there.
"""

import functools as ft
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .backend import array_types, dr
from .elementwise import elementwise
from .operation import NotReplayed, ONLY_REGION, Operation, rule
from .tensor import (
    constant,
    entries_of,
    known_values,
    map_entries,
    scalar,
    Table,
    Tensor,
)


# The most windows among which one is selected by its index. Each costs a selection of every
# entry.
_MOST_WINDOWS = 64


class _PossibleStart(NamedTuple):
    """An index at which a window may begin along an axis.

    - `begin`: the index.
    - `mask`: the lanes whose window begins there, or `True` for all.
    """

    begin: int
    mask: Any


class _PossibleWindow(NamedTuple):
    """A part of an array where a window may be.

    - `slices`: the part, as a slice of each axis.
    - `mask`: the lanes whose window is there, or `True` for all.
    """

    slices: tuple[slice, ...]
    mask: Any


# From the start of a window along an axis and the last index at which it fits to all
# indices at which it may begin.
_StartsAlongAxis: TypeAlias = Callable[[Tensor, int], list[_PossibleStart]]


def _clipped_starts(start: Tensor, last: int) -> list[_PossibleStart]:
    """The indices from 0 to `last` at which a window may begin along an axis. An index out
    of range counts as the nearest of these."""
    value = known_values(start)
    if value is not None:
        return [_PossibleStart(int(np.clip(value, 0, last)), True)]
    if last == 0:
        return [_PossibleStart(0, True)]
    index = start.item()
    between = [_PossibleStart(begin, index == begin) for begin in range(1, last)]
    first = _PossibleStart(0, index <= 0)
    return [first, *between, _PossibleStart(last, index >= last)]


def _starts_in_range(start: Tensor, last: int) -> list[_PossibleStart]:
    """As `_clipped_starts`, but a window whose index is out of range begins nowhere."""
    value = known_values(start)
    if value is not None:
        return [_PossibleStart(int(value), True)] if 0 <= value <= last else []
    index = start.item()
    return [_PossibleStart(begin, index == begin) for begin in range(last + 1)]


def _possible_windows(
    operation: Operation,
    x: Tensor,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
    starts_along_axis: _StartsAlongAxis = _clipped_starts,
) -> Iterator[_PossibleWindow]:
    """The parts of `x` where a window may be that begins at `starts`, and has these sizes.
    Both have an element for each axis of `x`."""
    starts_of_axes = [
        starts_along_axis(start, length - size)
        for start, length, size in zip(starts, x.shape, sizes)
    ]
    num_windows = math.prod(map(len, starts_of_axes))
    if num_windows > _MOST_WINDOWS:
        what = (
            f"`{operation.full_name}` with an index per path, among {num_windows} places "
            f"(the most are {_MOST_WINDOWS}, but for an array in `args` or from outside of "
            "the function that is not drawn for each path, computed, or returned by a "
            "branch or loop)"
        )
        raise NotReplayed(operation.mlir_op, what)
    for corner in itertools.product(*starts_of_axes):
        slices = []
        mask = True
        for start, size in zip(corner, sizes):
            slices.append(slice(start.begin, start.begin + size))
            mask = _both_masks(mask, start.mask)
        yield _PossibleWindow(tuple(slices), mask)


def _both_masks(one: Any, other: Any) -> Any:
    """Where both masks are true. `True` stands for all lanes, without an operation."""
    if one is True:
        return other
    return one if other is True else one & other


def _selected(mask: Any, new: Tensor, old: Tensor | None) -> Tensor:
    """The new entries in the lanes of a mask, and the old ones elsewhere; without old
    entries, the new ones in all lanes."""
    # Callers go through all possible windows, of which each lane has one, and pass no old
    # entries with the first. In other lanes a later window replaces it.
    if old is None or mask is True:
        return new
    return map_entries(ft.partial(dr.select, mask), new, old)


def _window_at(
    operation: Operation, x: Tensor, starts: Sequence[Tensor], sizes: Sequence[int]
) -> Tensor:
    """The window of `x` that begins at `starts`, moved into `x` if it is not within. Both
    `starts` and `sizes` have an element for each axis."""
    is_known = all(known_values(start) is not None for start in starts)
    if isinstance(x.entries, Table) and not is_known:
        return _window_of_table(operation, x, x.entries, starts, sizes)
    window = None
    for slices, mask in _possible_windows(operation, x, starts, sizes):
        window = _selected(mask, x.take(x.places[slices]), window)
    # There is at least one possible window, since starts are clipped.
    assert window is not None
    return window


def _window_of_table(
    operation: Operation,
    x: Tensor,
    table: Table,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
) -> Tensor:
    """As `_window_at`, where the entries of `x` are those of the `table` in memory. Each
    path reads its own window."""
    # `x` may be a part of what is in memory, or its transpose.
    addresses = table.addresses.reshape(x.shape)
    strides = _strides(operation, addresses)
    int32 = array_types()["i32"]
    # The address of the window's first entry: that of the first entry of `x`, and a stride
    # for each index.
    first_address = int32(int(addresses.flat[0]))
    for start, stride, length, size in zip(starts, strides, x.shape, sizes):
        index = start.item()
        dtype = type(index)
        # The index is moved into `x` in its own type: made signed, a large one would be
        # negative.
        in_range = elementwise()["clamp"](dtype(0), index, dtype(length - size))
        first_address = first_address + int32(in_range) * stride
    uint32 = array_types()["ui32"]
    entries = [
        table.gathered(uint32(first_address + int(offset)))
        for offset in _offsets(strides, sizes).flat
    ]
    return Tensor(entries, tuple(sizes))


def _strides(operation: Operation, addresses: np.ndarray) -> list[int]:
    """For each axis of an array in memory, the distance between neighbours along it,
    from the addresses of the entries. Raises a `NotReplayed` if distances differ along an
    axis."""
    first = int(addresses.flat[0])
    strides = [
        int(addresses.take(1, axis).flat[0]) - first if size > 1 else 0
        for axis, size in enumerate(addresses.shape)
    ]
    # Entries that were moved in another way than by slices and transposes have no strides.
    if not np.array_equal(first + _offsets(strides, addresses.shape), addresses):
        what = (
            f"`{operation.full_name}` with an index per path, from an array whose entries "
            "were moved other than by slices and transposes"
        )
        raise NotReplayed(operation.mlir_op, what)
    return strides


def _offsets(strides: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """How far in memory each entry of an array of this shape is from the first."""
    # `sparse` indices of an axis have length one along all others.
    indices = np.indices(shape, sparse=True)
    total = sum(stride * index for stride, index in zip(strides, indices))
    # Without axes the sum is the number zero.
    return np.broadcast_to(total, shape)


def _widened(index: Tensor) -> Tensor:
    """An index of at least four bytes: eight bits may be too few for the places of an
    array."""

    def widened_entry(entry: Any) -> Any:
        is_narrow = dr.itemsize_v(entry) < 4
        return array_types()["i32"](entry) if is_narrow else entry

    return map_entries(widened_entry, index)


@rule
def _dynamic_slice(operation: Operation, x: Tensor, *starts: Tensor) -> list[Tensor]:
    return [_window_at(operation, x, [*map(_widened, starts)], operation.shape)]


@rule
def _dynamic_update_slice(
    operation: Operation, x: Tensor, update: Tensor, *starts: Tensor
) -> list[Tensor]:
    # One list: the entries of `x`, followed by those of the update. Each possible result is
    # a selection of its places.
    both = Tensor([*entries_of([x, update])], ())
    wide_starts = [*map(_widened, starts)]
    result = None
    for slices, mask in _possible_windows(operation, x, wide_starts, update.shape):
        places = x.places.copy()
        places[slices] = len(x.entries) + update.places
        result = _selected(mask, both.take(places), result)
    assert result is not None
    return [result]


class _Windows(NamedTuple):
    """The windows of a `gather` or `scatter`.

    - `shape`: the shape of the array of windows.
    - `starts`: for each window, in row-major order, its start along each axis.
    """

    shape: tuple[int, ...]
    starts: list[list[Tensor]]


def _windows(
    x: Tensor,
    indices: Tensor,
    vector_axis: int,
    axes: Sequence[int],
    batched_axes: dict[int, int],
) -> _Windows:
    """The windows of `x` that a `gather` reads or a `scatter` writes.

    `indices` holds a vector for each window, along the axis `vector_axis`: the starts of
    the window along each of `axes`. `batched_axes` maps axes of `x` to axes of `indices`:
    along these, a window starts at its own position in the array of windows. Along all
    other axes windows start at zero.
    """
    # If `indices` have no such axis, each vector is a single number.
    has_no_axis = vector_axis == len(indices.shape)
    shape_of_indices = (*indices.shape, 1) if has_no_axis else indices.shape
    indices = _widened(indices)
    # (*windows, the numbers of a vector)
    places = np.moveaxis(indices.places.reshape(shape_of_indices), vector_axis, -1)
    shape = places.shape[:-1]

    def constant_start(value: int) -> Tensor:
        return constant(array_types()["i32"], np.asarray(value))

    def starts_of(window: tuple[int, ...]) -> list[Tensor]:
        """The start along each axis of the window at this position in the array of
        windows."""
        starts = [constant_start(0)] * len(x.shape)
        for axis, place in zip(axes, places[window]):
            starts[axis] = scalar(indices.entries[place])
        for axis, axis_of_indices in batched_axes.items():
            # The array of windows lacks the vectors' axis, so axes behind it move up by
            # one.
            is_behind = axis_of_indices > vector_axis
            axis_of_windows = axis_of_indices - 1 if is_behind else axis_of_indices
            starts[axis] = constant_start(window[axis_of_windows])
        return starts

    return _Windows(shape, [starts_of(window) for window in np.ndindex(*shape)])


@rule
def _gather(operation: Operation, x: Tensor, indices: Tensor) -> list[Tensor]:
    name = "dimension_numbers"
    batched_axes = operation.part(name, "operand_batching_dims")
    batched_axes_of_indices = operation.part(name, "start_indices_batching_dims")
    shape, starts_of_windows = _windows(
        x,
        indices,
        # This number is printed only if it is not zero: an empty list has the sum zero.
        vector_axis=sum(operation.part(name, "index_vector_dim")),
        axes=operation.part(name, "start_index_map"),
        batched_axes=dict(zip(batched_axes, batched_axes_of_indices)),
    )
    sizes = operation.integers("slice_sizes")
    entries = entries_of(
        [_window_at(operation, x, starts, sizes) for starts in starts_of_windows]
    )
    windows = Tensor([*entries], (*shape, *sizes))
    # The result does not have these axes of a window, which have length one.
    dropped = [*operation.part(name, "collapsed_slice_dims"), *batched_axes]
    places = windows.places.squeeze(tuple(len(shape) + axis for axis in dropped))
    # The other axes of a window, which are the last ones here, go to where the result has
    # them.
    last_axes = range(len(shape), places.ndim)
    window_axes = operation.part(name, "offset_dims")
    return [windows.take(np.moveaxis(places, last_axes, window_axes))]


@rule
def _scatter(
    operation: Operation, x: Tensor, indices: Tensor, updates: Tensor
) -> list[Tensor]:
    name = "scatter_dimension_numbers"
    batched_axes = operation.part(name, "input_batching_dims")
    batched_axes_of_indices = operation.part(name, "scatter_indices_batching_dims")
    shape, starts_of_windows = _windows(
        x,
        indices,
        # As in `_gather`, an empty list stands for zero.
        vector_axis=sum(operation.part(name, "index_vector_dim")),
        axes=operation.part(name, "scatter_dims_to_operand_dims"),
        batched_axes=dict(zip(batched_axes, batched_axes_of_indices)),
    )
    window_axes = operation.part(name, "update_window_dims")
    # Along the other axes of `x` a window has length one, and `updates` have no axis.
    axes_of_length_one = {*operation.part(name, "inserted_window_dims"), *batched_axes}
    sizes_of_updates = iter([updates.shape[axis] for axis in window_axes])
    sizes = [
        1 if axis in axes_of_length_one else next(sizes_of_updates)
        for axis in range(len(x.shape))
    ]
    # The axes of a window become the last ones: (windows, the entries of a window).
    last_axes = range(len(shape), updates.places.ndim)
    places = np.moveaxis(updates.places, window_axes, last_axes)
    rows = places.reshape(math.prod(shape), -1)
    entries = [*x.entries]
    # Windows are written one after another: they may overlap, and the region may add.
    # Windows that are not within `x` are not written at all.
    for starts, row in zip(starts_of_windows, rows):
        possible_windows = _possible_windows(
            operation, x, starts, sizes, _starts_in_range
        )
        for slices, mask in possible_windows:
            for target, source in zip(x.places[slices].flat, row):
                old = scalar(entries[target])
                update = scalar(updates.entries[source])
                (new,) = operation.run(ONLY_REGION, [old, update])
                entries[target] = _selected(mask, new, old).item()
    return [Tensor(entries, x.shape)]
