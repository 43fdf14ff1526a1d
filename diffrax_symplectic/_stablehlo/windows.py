"""Operations that read or write a window of an array, at an index that may differ between
paths.

Entries in registers have no address. A window whose place each path computes is selected
by comparing the index with every place that it may have. Arrays in memory are read where
the index says.
"""

import functools as ft
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .backend import array_types, drjit
from .elementwise import elementwise
from .operation import NotReplayed, Operation, rule
from .tensor import constant, each, flat, known, Table, Tensor


# The most places to compare an index with. Each costs a selection of every entry.
_MOST_PLACES = 64


class _Window(NamedTuple):
    """A place that a window of an array may have.

    - `slices`: the place, as a slice of each axis.
    - `here`: the mask of the lanes whose window is there, or `True` for all.
    """

    slices: tuple[slice, ...]
    here: Any


def _windows(
    o: Operation,
    x: Tensor,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
    clip: bool = True,
) -> Iterator[_Window]:
    """The possible places of a window of these sizes in `x`. Windows that are not within
    `x` are moved into it, or else left out."""
    # For each axis, the possible starts with their masks.
    axes = [
        _starts_along(start, length - size, clip)
        for start, length, size in zip(starts, x.shape, sizes)
    ]
    num_places = math.prod(map(len, axes))
    if num_places > _MOST_PLACES:
        what = (
            f"`{o.op.name}` with an index per path, among {num_places} places (the most "
            f"are {_MOST_PLACES}, but for an array in `args` or from outside of the "
            "function that is not drawn for each path, computed, or returned by a "
            "branch or loop)"
        )
        raise NotReplayed(o.op, what)
    for starts_and_masks in itertools.product(*axes):
        slices = []
        here = True
        for (begin, mask), size in zip(starts_and_masks, sizes):
            slices.append(slice(begin, begin + size))
            here = _both_masks(here, mask)
        yield _Window(tuple(slices), here)


def _starts_along(start: Tensor, most: int, clip: bool) -> list[tuple[int, Any]]:
    """The possible starts of a window along an axis, from 0 to `most`, each with the mask
    of the lanes that start there, or `True` for all. With `clip`, an index out of range
    counts as the nearest start; without, it has none."""
    value = known(start)
    if value is not None and clip:
        return [(int(np.clip(value, 0, most)), True)]
    if value is not None:
        return [(int(value), True)] if 0 <= value <= most else []
    if clip and most == 0:
        return [(0, True)]
    index = start.item()
    if not clip:
        return [(place, index == place) for place in range(most + 1)]
    between = [(place, index == place) for place in range(1, most)]
    return [(0, index <= 0), *between, (most, index >= most)]


def _both_masks(one: Any, other: Any) -> Any:
    """Where both masks are true. `True` stands for all lanes, without an operation."""
    if one is True:
        return other
    return one if other is True else one & other


def _selected(here: Any, new: Tensor, old: Tensor | None) -> Tensor:
    """The new entries in the lanes of a mask, and the old ones elsewhere."""
    # Without old entries this is the first of several places. Each lane has one of these,
    # so that the others replace it where it is wrong.
    if old is None or here is True:
        return new
    return each(ft.partial(drjit().select, here), new, old)


def _window(
    o: Operation, x: Tensor, starts: Sequence[Tensor], sizes: Sequence[int]
) -> Tensor:
    """The window of `x` that starts there, moved into `x` if need be."""
    if isinstance(x.entries, Table) and any(known(start) is None for start in starts):
        return _from_table(o, x, x.entries, starts, sizes)
    out = None
    for slices, here in _windows(o, x, starts, sizes):
        out = _selected(here, x.take(x.places[slices]), out)
    assert out is not None
    return out


def _from_table(
    o: Operation,
    x: Tensor,
    table: Table,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
) -> Tensor:
    """A window of an array in memory, at each path's own place."""
    # The place of each entry of `x` in memory: `x` may be a part of the table, or its
    # transpose.
    places = table.places.reshape(x.shape)
    corner = int(places.flat[0])
    # The distance in memory between neighbours along each axis.
    strides = [
        int(places.take(1, axis).flat[0]) - corner if size > 1 else 0
        for axis, size in enumerate(x.shape)
    ]
    # Addresses are computed from the strides, which is wrong for entries that were moved in
    # another way.
    regular = np.broadcast_to(corner + _offsets(strides, x.shape), x.shape)
    if not np.array_equal(regular, places):
        what = f"`{o.op.name}` with an index per path, from an array in another order"
        raise NotReplayed(o.op, what)
    signed = array_types()["i32"]
    begin = signed(corner)
    for start, stride, length, size in zip(starts, strides, x.shape, sizes):
        index = start.item()
        dtype = type(index)
        # The index is moved into `x` in its own type: made signed, a large one would be
        # negative.
        in_range = elementwise()["clamp"](dtype(0), index, dtype(length - size))
        begin = begin + signed(in_range) * stride
    offsets = np.broadcast_to(_offsets(strides, sizes), sizes)
    unsigned = array_types()["ui32"]
    entries = [table.gathered(unsigned(begin + int(offset))) for offset in offsets.flat]
    return Tensor(entries, tuple(sizes))


def _offsets(strides: Sequence[int], shape: Sequence[int]) -> np.ndarray | int:
    """How far in memory each entry is from the first, up to broadcasting: the number zero
    for an array without axes, which has one entry."""
    # `sparse` indices of an axis have length one along all others: their sum is broadcast.
    indices = np.indices(shape, sparse=True)
    return sum(stride * index for stride, index in zip(strides, indices))


def _widened(index: Tensor) -> Tensor:
    """An index of at least four bytes: eight bits may be too few for the places of an
    array."""

    def widened_entry(entry: Any) -> Any:
        is_narrow = drjit().itemsize_v(entry) < 4
        return array_types()["i32"](entry) if is_narrow else entry

    return each(widened_entry, index)


@rule
def _dynamic_slice(o, x, *starts):
    return [_window(o, x, [*map(_widened, starts)], o.shape)]


@rule
def _dynamic_update_slice(o, x, update, *starts):
    # One list: the entries of `x`, then those of the update.
    both = Tensor([*flat([x, update])], ())
    out = None
    # The first place is taken for all lanes, and replaced by the others in their lanes.
    for slices, here in _windows(o, x, [*map(_widened, starts)], update.shape):
        places = x.places.copy()
        places[slices] = len(x.entries) + update.places
        out = _selected(here, both.take(places), out)
    assert out is not None
    return [out]


class _Starts(NamedTuple):
    """Where the windows of a `gather` or `scatter` begin.

    - `batch`: the shape of the array of windows.
    - `each`: for each window, in row-major order, its index along each axis.
    - `batched_axes`: the axes along which a window follows its own place in `batch`.
    """

    batch: tuple[int, ...]
    each: list[list[Tensor]]
    batched_axes: list[int]


def _starts(
    x: Tensor,
    indices: Tensor,
    vector_axis: int,
    axes: Sequence[int],
    batched_axes: dict[int, int],
) -> _Starts:
    """Where windows of `x` begin.

    `indices` holds a vector for each window, along the axis `vector_axis`: its index along
    each of `axes`. `batched_axes` maps axes of `x` to the axes of `indices` along
    which both go in step.
    """
    # If `indices` have no such axis, each vector is a single number.
    has_no_axis = vector_axis == len(indices.shape)
    shape = (*indices.shape, 1) if has_no_axis else indices.shape
    indices = _widened(indices)
    # (batch, the numbers of a vector)
    places = np.moveaxis(indices.places.reshape(shape), vector_axis, -1)
    batch = places.shape[:-1]

    def known_index(value: Any) -> Tensor:
        return constant(array_types()["i32"], np.asarray(value))

    def start(window: tuple[int, ...]) -> list[Tensor]:
        """The index along each axis at which the window of this place in `batch` begins."""
        index_along = [known_index(0)] * len(x.shape)
        for axis, place in zip(axes, places[window]):
            index_along[axis] = Tensor([indices.entries[place]], ())
        for axis, indices_axis in batched_axes.items():
            # The batch lacks the vector's axis, so axes behind it have moved up by one.
            is_behind = indices_axis > vector_axis
            batch_axis = indices_axis - 1 if is_behind else indices_axis
            index_along[axis] = known_index(window[batch_axis])
        return index_along

    starts = [start(window) for window in np.ndindex(*batch)]
    return _Starts(batch, starts, [*batched_axes])


@rule
def _gather(o, x, indices):
    name = "dimension_numbers"
    sizes = o.ints("slice_sizes")
    in_step = zip(
        o.part(name, "operand_batching_dims"),
        o.part(name, "start_indices_batching_dims"),
    )
    batch, starts, batched_axes = _starts(
        x,
        indices,
        # This number is printed only if it is not zero: an empty list has the sum zero.
        vector_axis=sum(o.part(name, "index_vector_dim")),
        axes=o.part(name, "start_index_map"),
        batched_axes=dict(in_step),
    )
    entries = flat([_window(o, x, start, sizes) for start in starts])
    windows = Tensor([*entries], (*batch, *sizes))
    # The result does not have these axes of a window, which have length one.
    dropped = [*o.part(name, "collapsed_slice_dims"), *batched_axes]
    places = windows.places.squeeze(tuple(len(batch) + axis for axis in dropped))
    # The other axes of a window go to where the result has them.
    window_axes = range(len(batch), places.ndim)
    return [windows.take(np.moveaxis(places, window_axes, o.part(name, "offset_dims")))]


@rule
def _scatter(o, x, indices, updates):
    name = "scatter_dimension_numbers"
    in_step = zip(
        o.part(name, "input_batching_dims"),
        o.part(name, "scatter_indices_batching_dims"),
    )
    batch, starts, batched_axes = _starts(
        x,
        indices,
        vector_axis=sum(o.part(name, "index_vector_dim")),
        axes=o.part(name, "scatter_dims_to_operand_dims"),
        batched_axes=dict(in_step),
    )
    window_axes = o.part(name, "update_window_dims")
    # Along the other axes of `x` a window has length one, and `updates` have no axis.
    axes_of_length_one = {*o.part(name, "inserted_window_dims"), *batched_axes}
    sizes_of_updates = iter([updates.shape[axis] for axis in window_axes])
    sizes = [
        1 if axis in axes_of_length_one else next(sizes_of_updates)
        for axis in range(len(x.shape))
    ]
    # (windows, the entries of a window)
    last_axes = range(len(batch), updates.places.ndim)
    places = np.moveaxis(updates.places, window_axes, last_axes)
    rows = places.reshape(math.prod(batch), -1)
    out = [*x.entries]
    # Windows are written one after another: they may overlap, and the region may add.
    for start, row in zip(starts, rows):
        for slices, here in _windows(o, x, start, sizes, clip=False):
            for target, source in zip(x.places[slices].flat, row):
                old = Tensor([out[target]], ())
                (new,) = o.run(0, [old, Tensor([updates.entries[source]], ())])
                out[target] = _selected(here, new, old).item()
    return [Tensor(out, x.shape)]
