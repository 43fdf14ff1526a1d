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
    axes = [
        _starts_along(start, length - size, clip)
        for start, length, size in zip(starts, x.shape, sizes)
    ]
    number = math.prod(map(len, axes))
    if number > _MOST_PLACES:
        what = (
            f"`{o.op.name}` with an index per path, among {number} places (the most are "
            f"{_MOST_PLACES}, but for an array in `args` or from outside of the function "
            "that is not drawn for each path, computed, or returned by a branch or loop)"
        )
        raise NotReplayed(o.op, what)
    for choice in itertools.product(*axes):
        slices = [slice(begin, begin + size) for (begin, _), size in zip(choice, sizes)]
        here = ft.reduce(_both, [mask for _, mask in choice], True)
        yield _Window(tuple(slices), here)


def _starts_along(start: Tensor, most: int, clip: bool) -> list[tuple[int, Any]]:
    """The possible starts of a window along an axis, from 0 to `most`, with their masks."""
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


def _both(one: Any, other: Any) -> Any:
    """Where both masks are true. `True` stands for all lanes, without an operation."""
    if one is True:
        return other
    return one if other is True else one & other


def _in_lanes(here: Any, new: Tensor, old: Tensor | None) -> Tensor:
    """The new entries in the lanes of a mask, and the old ones elsewhere."""
    # Without old ones this is the first of several places, one of which is each lane's.
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
        out = _in_lanes(here, x.take(x.places[slices]), out)
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
    # Where in memory each entry of `x` is: `x` may be a part of the table, or a transpose.
    places = table.places.reshape(x.shape)
    corner = int(places.flat[0])
    # The distance in memory between neighbours along each axis.
    strides = [
        int(places.take(1, axis).flat[0]) - corner if size > 1 else 0
        for axis, size in enumerate(x.shape)
    ]
    # An address is computed from these. Entries that were moved otherwise have none.
    regular = np.broadcast_to(corner + _offsets(strides, x.shape), x.shape)
    if not np.array_equal(regular, places):
        what = f"`{o.op.name}` with an index per path, from an array in another order"
        raise NotReplayed(o.op, what)
    signed = array_types()["i32"]
    begin = signed(corner)
    for start, stride, length, size in zip(starts, strides, x.shape, sizes):
        index = start.item()
        kind = type(index)
        # Moved into `x` in the index's own type: made signed, a large one is negative.
        inside = elementwise()["clamp"](kind(0), index, kind(length - size))
        begin = begin + signed(inside) * stride
    offsets = np.broadcast_to(_offsets(strides, sizes), sizes)
    unsigned = array_types()["ui32"]
    entries = [table.gathered(unsigned(begin + int(k))) for k in offsets.flat]
    return Tensor(entries, tuple(sizes))


def _offsets(strides: Sequence[int], shape: Sequence[int]) -> np.ndarray | int:
    """How far in memory each entry is from the first, up to broadcasting: the number zero
    for an array without axes, which has one entry."""
    # An axis of indices for each axis of the array, so that their sum is the whole array.
    indices = np.indices(shape, sparse=True)
    return sum(stride * index for stride, index in zip(strides, indices))


def _wide(index: Tensor) -> Tensor:
    """An index of a type that counts all places of an array: eight bits may be too few."""

    def wide(entry: Any) -> Any:
        few = drjit().itemsize_v(entry) < 4
        return array_types()["i32"](entry) if few else entry

    return each(wide, index)


@rule
def _dynamic_slice(o, x, *starts):
    return [_window(o, x, [*map(_wide, starts)], o.shape)]


@rule
def _dynamic_update_slice(o, x, update, *starts):
    # The entries of the update stand behind those of `x`.
    both = Tensor([*flat([x, update])], ())
    out = None
    # The first place is for all lanes; the others replace it in theirs.
    for slices, here in _windows(o, x, [*map(_wide, starts)], update.shape):
        places = x.places.copy()
        places[slices] = len(x.entries) + update.places
        out = _in_lanes(here, both.take(places), out)
    assert out is not None
    return [out]


class _Starts(NamedTuple):
    """Where the windows of a `gather` or `scatter` begin.

    - `batch`: the shape of the array of windows.
    - `each`: for each window, in row-major order, its index along each axis.
    - `together`: the axes along which a window follows its own place in `batch`.
    """

    batch: tuple[int, ...]
    each: list[list[Tensor]]
    together: list[int]


def _starts(
    x: Tensor,
    indices: Tensor,
    vector_axis: int,
    axes: Sequence[int],
    together: dict[int, int],
) -> _Starts:
    """Where windows of `x` begin.

    `indices` holds a vector for each window, along the axis `vector_axis`: its index along
    each of `axes`. `together` maps axes of `x` to axes of `indices` along which both go in
    step.
    """
    # If the axis is one more than there are, each vector is a single number.
    missing = vector_axis == len(indices.shape)
    shape = (*indices.shape, 1) if missing else indices.shape
    indices = _wide(indices)
    places = np.moveaxis(indices.places.reshape(shape), vector_axis, -1)
    batch = places.shape[:-1]

    def number(i: Any) -> Tensor:
        return constant(array_types()["i32"], np.asarray(i))

    def start(place: tuple[int, ...]) -> list[Tensor]:
        along = [number(0)] * len(x.shape)
        for axis, i in zip(axes, places[place]):
            along[axis] = Tensor([indices.entries[i]], ())
        for axis, of_indices in together.items():
            # Axes of `indices` behind the vector's are one less in the batch.
            along[axis] = number(place[of_indices - (of_indices > vector_axis)])
        return along

    return _Starts(batch, [start(place) for place in np.ndindex(*batch)], [*together])


@rule
def _gather(o, x, indices):
    name = "dimension_numbers"
    sizes = o.ints("slice_sizes")
    in_step = zip(
        o.part(name, "operand_batching_dims"),
        o.part(name, "start_indices_batching_dims"),
    )
    batch, starts, together = _starts(
        x,
        indices,
        # Printed only if it is not zero.
        vector_axis=sum(o.part(name, "index_vector_dim")),
        axes=o.part(name, "start_index_map"),
        together=dict(in_step),
    )
    found = flat([_window(o, x, start, sizes) for start in starts])
    windows = Tensor([*found], (*batch, *sizes))
    # Axes of length one that the result does not have.
    dropped = [*o.part(name, "collapsed_slice_dims"), *together]
    places = windows.places.squeeze(tuple(len(batch) + axis for axis in dropped))
    # The axes of a window go to where the result has them.
    inner = range(len(batch), places.ndim)
    return [windows.take(np.moveaxis(places, inner, o.part(name, "offset_dims")))]


@rule
def _scatter(o, x, indices, updates):
    name = "scatter_dimension_numbers"
    in_step = zip(
        o.part(name, "input_batching_dims"),
        o.part(name, "scatter_indices_batching_dims"),
    )
    batch, starts, together = _starts(
        x,
        indices,
        vector_axis=sum(o.part(name, "index_vector_dim")),
        axes=o.part(name, "scatter_dims_to_operand_dims"),
        together=dict(in_step),
    )
    window_axes = o.part(name, "update_window_dims")
    # Along the other axes of `x` a window has length one, and `updates` have no axis.
    single = {*o.part(name, "inserted_window_dims"), *together}
    left = iter(window_axes)
    sizes = [
        1 if axis in single else updates.shape[next(left)]
        for axis in range(len(x.shape))
    ]
    # The entries of each window, in a row.
    inner = range(len(batch), updates.places.ndim)
    source = np.moveaxis(updates.places, window_axes, inner)
    rows = source.reshape(math.prod(batch), -1)
    out = [*x.entries]
    # One after another: windows may overlap, and the region may add.
    for start, row in zip(starts, rows):
        for slices, here in _windows(o, x, start, sizes, clip=False):
            for target, of_updates in zip(x.places[slices].flat, row):
                old = Tensor([out[target]], ())
                (new,) = o.run(0, [old, Tensor([updates.entries[of_updates]], ())])
                out[target] = _in_lanes(here, new, old).item()
    return [Tensor(out, x.shape)]
