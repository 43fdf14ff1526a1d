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


# The most windows among which one is selected by its index. Each costs a selection of every
# entry.
_MOST_WINDOWS = 64


def _possible_starts(start: Tensor, last: int, is_clipped: bool) -> dict[int, Any]:
    """The indices from 0 to `last` at which a window may begin along an axis, and for each
    the mask of the lanes whose window begins there. If it `is_clipped`, an index out of
    range counts as the nearest of these; otherwise its window begins nowhere."""
    every_lane = array_types()["i1"](True)
    value = known_value(start)
    if is_clipped and (value is not None or last == 0):
        return {min(max(value or 0, 0), last): every_lane}
    if value is not None:
        return {value: every_lane} if 0 <= value <= last else {}
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
    is_clipped: bool = True,
) -> Iterator[tuple[tuple[slice, ...], Any]]:
    """The parts of `x`, as a slice of each axis, where a window may be that begins at
    `starts` and has these sizes, and for each the mask of the lanes whose window is there.
    Both have an element for each axis of `x`."""
    starts_of_axes = [
        _possible_starts(start, length - size, is_clipped)
        for start, length, size in zip(starts, x.shape, sizes)
    ]
    num_windows = math.prod(map(len, starts_of_axes))
    if num_windows > _MOST_WINDOWS:
        raise operation.refusal(
            f"with an index per path, among {num_windows} places (the most are "
            f"{_MOST_WINDOWS}, but for an array in `args` or from outside of the function "
            "that is not drawn for each path, computed, or returned by a branch or loop)"
        )
    for begins in itertools.product(*starts_of_axes):
        slices = [slice(begin, begin + size) for begin, size in zip(begins, sizes)]
        masks = [starts[begin] for starts, begin in zip(starts_of_axes, begins)]
        yield tuple(slices), ft.reduce(operator.and_, masks, array_types()["i1"](True))


def _selected(choices: Iterable[tuple[Any, Tensor]]) -> Tensor:
    """In each lane the choice whose mask is true, of one or more."""
    # Each lane has one choice: where the mask of the first is false, another replaces it.
    (_, selected), *others = choices
    for mask, choice in others:
        selected = map_entries(ft.partial(dr.select, mask), choice, selected)
    return selected


def _window_at(
    operation: Operation, x: Tensor, starts: Sequence[Tensor], sizes: Sequence[int]
) -> Tensor:
    """The window of `x` that begins at `starts`, moved into `x` if it is not within. Both
    `starts` and `sizes` have an element for each axis."""
    # Memory is read at an address that each path computes. Entries in registers have none:
    # the window is selected among all places where it may be.
    is_same_for_all_paths = all(known_value(start) is not None for start in starts)
    if isinstance(x.entries, Table) and not is_same_for_all_paths:
        return _window_of_table(operation, x, x.entries, starts, sizes)
    windows = _possible_windows(operation, x, starts, sizes)
    return _selected((mask, x.take(x.places[slices])) for slices, mask in windows)


def _window_of_table(
    operation: Operation,
    x: Tensor,
    table: Table,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
) -> Tensor:
    """As `_window_at`, where the entries of `x` are those of the `table` in memory. Each
    path reads its own window."""
    # `x` may be a part of what is in memory, or its transpose: for each of its axes, the
    # distance in memory between neighbours along it.
    addresses = table.addresses.reshape(x.shape)
    first = int(addresses.flat[0])
    strides = [
        int(addresses.take(1, axis).flat[0]) - first if size > 1 else 0
        for axis, size in enumerate(x.shape)
    ]
    # Entries that were moved in another way than by slices and transposes have no strides.
    if not np.array_equal(first + _offsets(strides, x.shape), addresses):
        raise operation.refusal(
            "with an index per path, from an array whose entries were moved other than by "
            "slices and transposes"
        )
    # The address of the window's first entry: that of the first entry of `x`, and a stride
    # for each index.
    int32 = array_types()["i32"]
    first_address = int32(first)
    for start, stride, length, size in zip(starts, strides, x.shape, sizes):
        index = _widened(start.item())
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


def _offsets(strides: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """How far in memory each entry of an array of this shape is from the first."""
    return np.tensordot(np.array(strides, int), np.indices(shape), axes=1)


def _widened(index: Any) -> Any:
    """An index of at least four bytes: eight bits may be too few for the places of an
    array."""
    return array_types()["i32"](index) if dr.itemsize_v(index) < 4 else index


@rule
def _dynamic_slice(operation: Operation, x: Tensor, *starts: Tensor) -> list[Tensor]:
    return [_window_at(operation, x, starts, operation.shape)]


@rule
def _dynamic_update_slice(
    operation: Operation, x: Tensor, update: Tensor, *starts: Tensor
) -> list[Tensor]:
    # One list: the entries of `x`, followed by those of the update. Each possible result is
    # a selection of its places.
    both = Tensor([*entries_of([x, update])], ())
    results = []
    for slices, mask in _possible_windows(operation, x, starts, update.shape):
        places = x.places.copy()
        places[slices] = len(x.entries) + update.places
        results.append((mask, both.take(places)))
    return [_selected(results)]


def _windows(
    x: Tensor,
    indices: Tensor,
    index_vector_dim: list[int],
    axes: Sequence[int],
    batched_axes: dict[int, int],
) -> tuple[tuple[int, ...], list[list[Tensor]]]:
    """The windows of `x` that a `gather` reads or a `scatter` writes: the shape of the
    array of windows, and for each window, in row-major order, its start along each axis of
    `x`.

    `indices` holds a vector for each window, along the axis `index_vector_dim`: the starts
    of the window along each of `axes`. `batched_axes` maps axes of `x` to axes of
    `indices`: along these, a window starts at its own position in the array of windows.
    Along all other axes windows start at zero.
    """
    # This number is printed only if it is not zero: an empty list has the sum zero.
    vector_axis = sum(index_vector_dim)
    # If `indices` have no such axis, each vector is a single number.
    places = indices.places
    if vector_axis == places.ndim:
        places = places[..., None]
    # Where each index stands along each axis of `indices`, with the vectors' axis last, as
    # in `vectors`: (axes, *windows, the numbers of a vector).
    positions = np.moveaxis(np.indices(places.shape), 1 + vector_axis, -1)
    vectors = np.moveaxis(places, vector_axis, -1)
    shape = vectors.shape[:-1]

    def starts_of(window: tuple[int, ...]) -> list[Tensor]:
        known = np.zeros(len(x.shape), int)
        for axis, axis_of_indices in batched_axes.items():
            known[axis] = positions[axis_of_indices][window][0]
        starts = [constant(array_types()["i32"], np.asarray(start)) for start in known]
        for axis, place in zip(axes, vectors[window]):
            starts[axis] = scalar(indices.entries[place])
        return starts

    return shape, [starts_of(window) for window in np.ndindex(*shape)]


@rule
def _gather(operation: Operation, x: Tensor, indices: Tensor) -> list[Tensor]:
    part = ft.partial(operation.part, "dimension_numbers")
    batched_axes = part("operand_batching_dims")
    shape, starts_of_windows = _windows(
        x,
        indices,
        index_vector_dim=part("index_vector_dim"),
        axes=part("start_index_map"),
        batched_axes=dict(zip(batched_axes, part("start_indices_batching_dims"))),
    )
    sizes = operation.integers("slice_sizes")
    entries = entries_of(
        [_window_at(operation, x, starts, sizes) for starts in starts_of_windows]
    )
    windows = Tensor([*entries], (*shape, *sizes))
    # The result does not have these axes of a window, which have length one.
    dropped = [*part("collapsed_slice_dims"), *batched_axes]
    places = windows.places.squeeze(tuple(len(shape) + axis for axis in dropped))
    # The other axes of a window, which are the last ones here, go to where the result has
    # them.
    last_axes = range(len(shape), places.ndim)
    return [windows.take(np.moveaxis(places, last_axes, part("offset_dims")))]


@rule
def _scatter(
    operation: Operation, x: Tensor, indices: Tensor, updates: Tensor
) -> list[Tensor]:
    part = ft.partial(operation.part, "scatter_dimension_numbers")
    batched_axes = part("input_batching_dims")
    shape, starts_of_windows = _windows(
        x,
        indices,
        index_vector_dim=part("index_vector_dim"),
        axes=part("scatter_dims_to_operand_dims"),
        batched_axes=dict(zip(batched_axes, part("scatter_indices_batching_dims"))),
    )
    # The axes of a window become the last ones of `updates`.
    window_axes = part("update_window_dims")
    last_axes = range(len(shape), updates.places.ndim)
    places = np.moveaxis(updates.places, window_axes, last_axes)
    # Along these axes of `x` a window has length one, and `updates` have no axis.
    added_axes = sorted([*part("inserted_window_dims"), *batched_axes])
    rows = places.reshape(math.prod(shape), *places.shape[len(shape) :])
    entries = [*x.entries]
    # Windows are written one after another: they may overlap, and the region may add.
    # Windows that are not within `x` are not written at all.
    for starts, row in zip(starts_of_windows, rows):
        window = np.expand_dims(row, added_axes)
        possible_windows = _possible_windows(
            operation, x, starts, window.shape, is_clipped=False
        )
        for slices, mask in possible_windows:
            for target, source in zip(x.places[slices].flat, window.flat):
                old = scalar(entries[target])
                update = scalar(updates.entries[source])
                (new,) = operation.run(ONLY_REGION, [old, update])
                entries[target] = dr.select(mask, new.item(), old.item())
    return [Tensor(entries, x.shape)]
