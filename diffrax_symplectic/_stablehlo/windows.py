"""Operations that read or write a window of an array, at an index that may differ between
paths.

A *window* is a part of an array, a slice along each axis. Its *start* along an axis is the
index at which the slice begins.

The *position* of an entry is its index in the flat list `x.entries` of all entries of an
array `x`. `x.positions` has the shape of `x` and holds the position of each entry.

An array in memory is read at the addresses that each path computes from the starts. Entries
in registers have no address. There all windows that are possible are taken, with a mask of
the lanes whose starts are those of the window, and for each lane one of them is selected.
"""

import functools as ft
import itertools
import math
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from .backend import array_types, dr
from .elementwise import elementwise
from .operation import ONLY_REGION, Operation, rule
from .tensor import (
    constant,
    entries_of,
    known_value,
    map_entries,
    scalar,
    Table,
    Tensor,
)


# The most windows among which one is selected. Each costs a selection of every entry of the
# window.
_MOST_WINDOWS = 64


def _masks_of_starts(start: Tensor, last: int, is_clipped: bool) -> dict[int, Any]:
    """For each index from 0 to `last` at which a window may start along an axis, the mask
    of the lanes whose `start` it is.

    With `is_clipped`, a start out of range counts as the nearest of these indices. Without
    `is_clipped`, it has no mask.
    """
    every_lane = array_types()["i1"](True)
    if last == 0 and is_clipped:
        return {0: every_lane}
    # A start that is known while the kernel is recorded is the same in all lanes.
    value = known_value(start)
    if value is not None:
        nearest = min(max(value, 0), last)
        return {nearest: every_lane} if is_clipped or value == nearest else {}
    index = _widened(start.item())
    masks = {begin: index == begin for begin in range(last + 1)}
    if is_clipped:
        masks |= {0: index <= 0, last: index >= last}
    return masks


def _possible_windows(
    operation: Operation,
    x: Tensor,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
    is_clipped: bool,
) -> Iterator[tuple[tuple[slice, ...], Any]]:
    """For each window of `x` that some lane may have, yields its slices and the mask of the
    lanes that have it.

    - `starts` and `sizes` have an element for each axis of `x`.
    - With `is_clipped`, a window that would reach beyond an end of `x` is moved inside.
        Without `is_clipped`, no mask has the lanes with such a window.
    """
    # For each axis, the masks by the index at which a window starts.
    masks_of_axes = [
        _masks_of_starts(start, length - size, is_clipped)
        for start, length, size in zip(starts, x.shape, sizes)
    ]
    num_windows = math.prod(map(len, masks_of_axes))
    if num_windows > _MOST_WINDOWS:
        raise operation.refusal(
            f"with an index per path, among {num_windows} places (at most "
            f"{_MOST_WINDOWS} for an array that is drawn for each path, computed, or "
            "returned by a branch or loop; an array in `args` or from outside of the "
            "function may have any size)"
        )
    for begins in itertools.product(*masks_of_axes):
        slices = [slice(begin, begin + size) for begin, size in zip(begins, sizes)]
        masks = [of_axis[begin] for of_axis, begin in zip(masks_of_axes, begins)]
        # A lane has the window if it has the window's start along each axis. (An array
        # without axes has one window, in every lane.)
        yield tuple(slices), ft.reduce(operator.and_, masks, array_types()["i1"](True))


def _selected(choices: Iterable[tuple[Any, Tensor]]) -> Tensor:
    """In each lane the tensor whose mask is true. `choices` are one or more pairs of a mask
    and a tensor. In each lane exactly one mask is true."""
    # The first mask is not needed: where it is false, one of the others is true.
    (_, selected), *others = choices
    for mask, choice in others:
        selected = map_entries(ft.partial(dr.select, mask), choice, selected)
    return selected


def _window_at(
    operation: Operation, x: Tensor, starts: Sequence[Tensor], sizes: Sequence[int]
) -> Tensor:
    """The window of `x` that begins at `starts`, moved into `x` if it would reach beyond
    an end. `starts` and `sizes` have an element for each axis of `x`."""
    # A `Table` means entries in memory, which have an address. It is needed only if the
    # starts differ between paths.
    is_same_for_all_paths = all(known_value(start) is not None for start in starts)
    if isinstance(x.entries, Table) and not is_same_for_all_paths:
        return _window_of_table(operation, x, x.entries, starts, sizes)
    windows = _possible_windows(operation, x, starts, sizes, is_clipped=True)
    return _selected((mask, x.take(x.positions[slices])) for slices, mask in windows)


def _window_of_table(
    operation: Operation,
    x: Tensor,
    table: Table,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
) -> Tensor:
    """What `_window_at` returns if the entries of `x` are those of a `table`: each path
    reads its own window from memory."""
    strides = _strides(operation, table, x.shape)
    # The address of the window's first entry is the sum of the address of the first entry
    # of `x` and, for each axis, the window's start times the stride.
    int32 = array_types()["i32"]
    first_address = int32(int(table.addresses[0]))
    for start, stride, length, size in zip(starts, strides, x.shape, sizes):
        index = _widened(start.item())
        dtype = type(index)
        # The index is clipped before it is converted to a signed type, in which a large one
        # would be negative.
        in_range = elementwise()["clamp"](dtype(0), index, dtype(length - size))
        first_address = first_address + int32(in_range) * stride
    uint32 = array_types()["ui32"]
    entries = [
        table.gathered(uint32(first_address + int(offset)))
        for offset in _offsets(strides, sizes).flat
    ]
    return Tensor(entries, tuple(sizes))


def _strides(operation: Operation, table: Table, shape: tuple[int, ...]) -> list[int]:
    """The distances in memory between neighbours along each axis of an array of this shape,
    whose entries are in the `table`. The array may be a slice or a transpose of a whole
    array in memory. If its entries were moved in another way, it has no strides, and the
    operation cannot be replayed."""
    addresses = table.addresses.reshape(shape)
    first = int(addresses.flat[0])
    # Along each axis, the distance from the first entry to the next one. Along an axis of
    # length one there is none, and any stride would do.
    strides = [
        int(addresses.take(1, axis).flat[0]) - first if size > 1 else 0
        for axis, size in enumerate(shape)
    ]
    # These are the strides only if all entries are where the strides say.
    if not np.array_equal(first + _offsets(strides, shape), addresses):
        raise operation.refusal(
            "with an index per path, from an array whose entries were moved other than by "
            "slices and transposes"
        )
    return strides


def _offsets(strides: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """The distance in memory of each entry of an array of this shape from the first."""
    return np.tensordot(np.array(strides, int), np.indices(shape), axes=1)


def _widened(index: Any) -> Any:
    """The index as an integer of at least four bytes: eight bits may be too few for the
    length of an axis."""
    return array_types()["i32"](index) if dr.itemsize_v(index) < 4 else index


@rule
def _dynamic_slice(operation: Operation, x: Tensor, *starts: Tensor) -> list[Tensor]:
    return [_window_at(operation, x, starts, operation.shape)]


@rule
def _dynamic_update_slice(
    operation: Operation, x: Tensor, update: Tensor, *starts: Tensor
) -> list[Tensor]:
    """Makes the result for each window that may be updated, and selects one in each
    lane."""
    # Each of these results takes its entries from one list, in which the entries of the
    # update follow those of `x`.
    both = Tensor(entries_of([x, update]), ())
    results = []
    windows = _possible_windows(operation, x, starts, update.shape, is_clipped=True)
    for slices, mask in windows:
        positions = x.positions.copy()
        positions[slices] = len(x.entries) + update.positions
        results.append((mask, both.take(positions)))
    return [_selected(results)]


def _starts_of_windows(
    x: Tensor,
    indices: Tensor,
    index_vector_dim: list[int],
    axes: Sequence[int],
    batched_axes: dict[int, int],
) -> tuple[tuple[int, ...], list[list[Tensor]]]:
    """Where the windows of `x` start that a `gather` reads or a `scatter` writes. Along its
    axis `index_vector_dim`, the array `indices` has the starts of a window. Its other axes
    are the axes of an array of windows.

    Returns the shape of the array of windows, and for each window, in row-major order, its
    start along each axis of `x`:

    - along each of `axes`, the start that `indices` has;
    - along an axis of `x` that `batched_axes` maps to an axis of `indices`, the window's
        own index along this axis in the array of windows;
    - along all other axes, zero.
    """
    # MLIR prints this number only if it is not zero. An empty list has the sum zero.
    vector_axis = sum(index_vector_dim)
    positions = indices.positions
    # If `indices` has no such axis, each window has a single start.
    if vector_axis == positions.ndim:
        positions = positions[..., None]
    axes_of_windows = [axis for axis in range(positions.ndim) if axis != vector_axis]
    # For each window, the positions in `indices` of its starts.
    positions_of_starts = np.moveaxis(positions, vector_axis, -1)
    shape = positions_of_starts.shape[:-1]

    def starts_of(window: tuple[int, ...]) -> list[Tensor]:
        """The starts of the window with this index in the array of windows."""
        # First the starts that are the same in all lanes, then those in `indices`.
        known = np.zeros(len(x.shape), int)
        for axis, axis_of_indices in batched_axes.items():
            known[axis] = window[axes_of_windows.index(axis_of_indices)]
        starts = [constant(array_types()["i32"], np.asarray(start)) for start in known]
        for axis, position in zip(axes, positions_of_starts[window]):
            starts[axis] = scalar(indices.entries[position])
        return starts

    return shape, [starts_of(window) for window in np.ndindex(*shape)]


@rule
def _gather(operation: Operation, x: Tensor, indices: Tensor) -> list[Tensor]:
    """Reads a window of `x` for each vector of starts in `indices`."""
    field = ft.partial(operation.integers_of_field, "dimension_numbers")
    batched_axes = field("operand_batching_dims")
    shape, starts_of_windows = _starts_of_windows(
        x,
        indices,
        index_vector_dim=field("index_vector_dim"),
        axes=field("start_index_map"),
        batched_axes=dict(zip(batched_axes, field("start_indices_batching_dims"))),
    )
    sizes = operation.integers("slice_sizes")
    windows = [_window_at(operation, x, starts, sizes) for starts in starts_of_windows]
    # The axes of the array of windows come first, then the axes of a window.
    array = Tensor(entries_of(windows), (*shape, *sizes))
    # These axes of a window have length one, and are no axes of the result.
    dropped = [*field("collapsed_slice_dims"), *batched_axes]
    positions = array.positions.squeeze(tuple(len(shape) + axis for axis in dropped))
    # In the result the remaining axes of a window are the axes `offset_dims`.
    axes_in_window = range(len(shape), positions.ndim)
    return [array.take(np.moveaxis(positions, axes_in_window, field("offset_dims")))]


@rule
def _scatter(
    operation: Operation, x: Tensor, indices: Tensor, updates: Tensor
) -> list[Tensor]:
    """Writes to a window of `x` for each vector of starts in `indices`. The operation's
    region maps an old entry and its update to the new entry, such as their sum."""
    field = ft.partial(operation.integers_of_field, "scatter_dimension_numbers")
    batched_axes = field("input_batching_dims")
    shape, starts_of_windows = _starts_of_windows(
        x,
        indices,
        index_vector_dim=field("index_vector_dim"),
        axes=field("scatter_dims_to_operand_dims"),
        batched_axes=dict(zip(batched_axes, field("scatter_indices_batching_dims"))),
    )
    # In `updates` the axes of a window are `update_window_dims`. Here they become the last
    # axes, and all axes before them become one. So `windows` has, for each window, the
    # positions in `updates` of its entries.
    window_axes = field("update_window_dims")
    last_axes = range(len(shape), updates.positions.ndim)
    positions = np.moveaxis(updates.positions, window_axes, last_axes)
    windows = positions.reshape(math.prod(shape), *positions.shape[len(shape) :])
    # Along these axes of `x` a window has length one. `updates` has no axes for them.
    added_axes = sorted([*field("inserted_window_dims"), *batched_axes])
    entries = [*x.entries]
    # Windows are written one after another, since they may overlap, and a new entry may
    # depend on the old one. Windows that are not within `x` are not written at all.
    for starts, window in zip(starts_of_windows, windows):
        sources = np.expand_dims(window, added_axes)
        possible_windows = _possible_windows(
            operation, x, starts, sources.shape, is_clipped=False
        )
        for slices, mask in possible_windows:
            for source, target in zip(sources.flat, x.positions[slices].flat):
                old = scalar(entries[target])
                update = scalar(updates.entries[source])
                (new,) = operation.run(ONLY_REGION, [old, update])
                entries[target] = dr.select(mask, new.item(), old.item())
    return [Tensor(entries, x.shape)]
