"""Operations that move, convert or combine entries."""

import itertools
import math
import operator
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .backend import array_types, drjit
from .complex import equal, is_complex, values
from .elementwise import elementwise
from .operation import NotReplayed, Operation, rule
from .tensor import constant, each, flat, known, Table, Tensor


# Moves


@rule
def _constant(o):
    if is_complex(o.kind):
        return [constant(o.kind, values(o.op, o.shape))]
    numbers = np.asarray(o.op.attributes["value"])
    return [constant(o.kind, np.broadcast_to(numbers, o.shape))]


@rule
def _iota(o):
    places = np.indices(o.shape)[o.number("iota_dimension")]
    return [constant(o.kind, places)]


@rule
def _broadcast_in_dim(o, x):
    sizes = [1] * len(o.shape)
    for d, n in zip(o.ints("broadcast_dimensions"), x.shape):
        sizes[d] = n
    return [x.take(np.broadcast_to(x.places.reshape(sizes), o.shape))]


@rule
def _reshape(o, x):
    return [Tensor(x.entries, o.shape)]


@rule
def _transpose(o, x):
    return [x.take(x.places.transpose(o.ints("permutation")))]


@rule
def _slice(o, x):
    ends = map(slice, *map(o.ints, ("start_indices", "limit_indices", "strides")))
    return [x.take(x.places[tuple(ends)])]


@rule
def _reverse(o, x):
    return [x.take(np.flip(x.places, o.ints("dimensions")))]


@rule
def _concatenate(o, *xs):
    begins = np.cumsum([0, *[len(x.entries) for x in xs]])
    places = [x.places + begin for x, begin in zip(xs, begins)]
    whole = Tensor([*flat(xs)], ())
    return [whole.take(np.concatenate(places, o.number("dimension")))]


@rule
def _pad(o, x, value):
    low, inner = o.ints("edge_padding_low"), o.ints("interior_padding")
    at = [a + np.arange(n) * (i + 1) for a, i, n in zip(low, inner, x.shape)]
    inside = [(0 <= k) & (k < n) for k, n in zip(at, o.shape)]
    places = np.full(o.shape, len(x.entries))
    places[np.ix_(*[k[b] for k, b in zip(at, inside)])] = x.places[np.ix_(*inside)]
    return [Tensor([*x.entries, value.item()], ()).take(places)]


# An index that differs between paths selects by comparison with each position.
_MOST_PLACES = 64
# Exchanges grow with the square of the number.
_MOST_SORTED = 16


def _windows(
    o: Operation,
    x: Tensor,
    starts: Sequence[Tensor],
    sizes: Sequence[int],
    clip: bool = True,
) -> Iterator[tuple[tuple[slice, ...], Any]]:
    """The possible positions of a window of these sizes in `x`, with masks of the lanes.
    Windows that are not within `x` are moved into it, or else left out."""
    axes = []
    for start, n, size in zip(starts, x.shape, sizes):
        most, value = n - size, known(start)
        if value is not None and not clip and not 0 <= value <= most:
            return
        if value is not None:
            axes.append([(int(np.clip(value, 0, most)), True)])
            continue
        if most == 0 and clip:
            axes.append([(0, True)])
            continue
        s = start.item()
        if not clip:
            axes.append([(k, s == k) for k in range(most + 1)])
            continue
        first, last = [(0, s <= 0)], [(most, s >= most)]
        axes.append([*first, *[(k, s == k) for k in range(1, most)], *last])
    if (number := math.prod(map(len, axes))) > _MOST_PLACES:
        what = (
            f"`{o.op.name}` with an index per path, among {number} places (arrays that "
            "are computed before the solve may be larger)"
        )
        raise NotReplayed(o.op, what)
    for choice in itertools.product(*axes):
        here = True
        for _, also in choice:
            here = also if here is True else here if also is True else here & also
        yield tuple(slice(k, k + n) for (k, _), n in zip(choice, sizes)), here


def _in_lanes(here: Any, new: Tensor, old: Tensor | None) -> Tensor:
    if old is None or here is True:
        return new
    return each(lambda a, b: drjit().select(here, a, b), new, old)


def _window(o: Operation, x: Tensor, starts, sizes) -> Tensor:
    if isinstance(x.entries, Table) and any(known(s) is None for s in starts):
        return _from_table(o, x, x.entries, starts, sizes)
    out = None
    for window, here in _windows(o, x, starts, sizes):
        out = _in_lanes(here, x.take(x.places[window]), out)
    assert out is not None
    return out


def _from_table(o: Operation, x: Tensor, table: Table, starts, sizes) -> Tensor:
    """A window of an array in memory, at each path's own place."""
    places = table.places.reshape(x.shape)
    corner = places.flat[0]
    steps = [
        int(places.take(1, d).flat[0] - corner) if n > 1 else 0
        for d, n in enumerate(x.shape)
    ]
    regular = corner + sum(
        step * k for step, k in zip(steps, np.indices(x.shape, sparse=True))
    )
    if not np.array_equal(np.broadcast_to(regular, x.shape), places):
        what = f"`{o.op.name}` with an index per path, from an array in another order"
        raise NotReplayed(o.op, what)
    number = array_types()["i32"]
    begin = number(int(corner))
    for start, step, n, size in zip(starts, steps, x.shape, sizes):
        s = start.item()
        most = type(s)(n - size)
        begin = begin + number(elementwise()["clamp"](type(s)(0), s, most)) * step
    inside = sum(step * k for step, k in zip(steps, np.indices(sizes, sparse=True)))
    offsets = np.broadcast_to(inside, sizes)
    index = array_types()["ui32"]
    return Tensor(
        [table.gathered(index(begin + int(k))) for k in offsets.flat], tuple(sizes)
    )


@rule
def _dynamic_slice(o, x, *starts):
    return [_window(o, x, starts, o.shape)]


@rule
def _dynamic_update_slice(o, x, update, *starts):
    out, both = None, Tensor([*flat([x, update])], ())
    for window, here in _windows(o, x, starts, update.shape):
        places = x.places.copy()
        places[window] = len(x.entries) + update.places
        out = _in_lanes(here, both.take(places), out)
    assert out is not None
    return [out]


def _starts(
    o: Operation, name: str, x: Tensor, indices: Tensor, axes: list[int], batched: str
):
    """The start of the window in `x` for each of `indices`, and the axes of `x` along which
    it follows the place among the indices."""
    together = dict(
        zip(
            o.part(
                name, f"{'input' if batched == 'scatter' else 'operand'}_batching_dims"
            ),
            o.part(name, f"{batched}_indices_batching_dims"),
        )
    )
    # The attribute is printed only if it is not zero.
    vector = sum(o.part(name, "index_vector_dim"))
    places = indices.places.reshape(
        *indices.shape, *[1] * (vector == len(indices.shape))
    )
    places = np.moveaxis(places, vector, -1)
    batch = places.shape[:-1]
    number = lambda i: constant(type(indices.entries[0]), np.asarray(i))

    def start(place: tuple[int, ...]) -> list[Tensor]:
        own = {
            axis: Tensor([indices.entries[i]], ())
            for axis, i in zip(axes, places[place])
        }
        for axis, along in together.items():
            own[axis] = number(place[along - (along > vector)])
        return [own.get(d, number(0)) for d in range(len(x.shape))]

    return batch, [start(place) for place in np.ndindex(*batch)], [*together]


@rule
def _gather(o, x, indices):
    name, sizes = "dimension_numbers", o.ints("slice_sizes")
    axes = o.part(name, "start_index_map")
    batch, starts, together = _starts(o, name, x, indices, axes, "start")
    windows = Tensor(
        [*flat([_window(o, x, s, sizes) for s in starts])], (*batch, *sizes)
    )
    collapsed = [*o.part(name, "collapsed_slice_dims"), *together]
    places = windows.places.squeeze(tuple(len(batch) + d for d in collapsed))
    moved = range(len(batch), places.ndim)
    return [windows.take(np.moveaxis(places, moved, o.part(name, "offset_dims")))]


@rule
def _scatter(o, x, indices, updates):
    name = "scatter_dimension_numbers"
    axes = o.part(name, "scatter_dims_to_operand_dims")
    batch, starts, together = _starts(o, name, x, indices, axes, "scatter")
    inserted = [*o.part(name, "inserted_window_dims"), *together]
    window = o.part(name, "update_window_dims")
    sizes, left = [], iter(window)
    for d in range(len(x.shape)):
        sizes.append(1 if d in inserted else updates.shape[next(left)])
    source = np.moveaxis(updates.places, window, range(len(batch), updates.places.ndim))
    out = [*x.entries]
    for start, row in zip(starts, source.reshape(math.prod(batch), -1)):
        for window, here in _windows(o, x, start, sizes, clip=False):
            for i, k in zip(x.places[window].flat, row):
                old = Tensor([out[i]], ())
                new = o.run(0, [old, Tensor([updates.entries[k]], ())])[0]
                out[i] = _in_lanes(here, new, old).item()
    return [Tensor(out, x.shape)]


@rule
def _sort(o, *xs):
    """Exchanges of neighbours until all are in order, which keep the order of equals."""
    axis, n = o.number("dimension"), xs[0].shape[o.number("dimension")]
    if n > _MOST_SORTED:
        raise NotReplayed(o.op, f"`{o.op.name}` of more than {_MOST_SORTED} numbers")
    outs = [[*x.entries] for x in xs]
    for row in np.moveaxis(xs[0].places, axis, -1).reshape(-1, n):
        for end in range(n - 1, 0, -1):
            for left, right in itertools.pairwise(row[: end + 1]):
                pairs = [Tensor([x[i]], ()) for x in outs for i in (right, left)]
                wrong = o.run(0, pairs)[0].item()
                for x in outs:
                    low = drjit().select(wrong, x[right], x[left])
                    x[right] = drjit().select(wrong, x[left], x[right])
                    x[left] = low
    return [Tensor(out, x.shape) for out, x in zip(outs, xs)]


# Conversions


@rule
def _convert(o, x):
    if o.kind is array_types()["i1"]:
        return [each(lambda a: a if type(a) is o.kind else ~(a == 0), x)]
    return [each(o.kind, x)]


@rule
def _bitcast_convert(o, x):
    return [each(lambda a: drjit().reinterpret_array(o.kind, a), x)]


@rule
def _compare(o, a, b):
    name = o.word("comparison_direction").lower()
    if "compare_type" in o.op.attributes and o.word("compare_type") == "TOTALORDER":
        a, b = each(_in_total_order, a), each(_in_total_order, b)
    if is_complex(a.entries[0]):
        same = each(equal, a, b)
        return [same if name == "eq" else each(operator.invert, same)]
    if name == "ne":
        # NaN differs from everything, but not in Dr.Jit.
        return [each(lambda a, b: ~(a == b), a, b)]
    return [each(getattr(operator, name), a, b)]


def _in_total_order(a: Any) -> Any:
    """An integer that orders floating-point numbers, with NaN above infinity."""
    kinds = {4: "i32", 8: "i64"}
    bits = 8 * drjit().itemsize_v(a)
    number = drjit().reinterpret_array(array_types()[kinds[bits // 8]], a)
    # Of negative numbers all bits but the sign are turned.
    return number ^ ((number >> (bits - 1)) & (2 ** (bits - 1) - 1))


# Combinations


def _multiplied_and_added(a: Any, b: Any, c: Any) -> Any:
    """`a b + c`, in one operation if it can be."""
    real = drjit().is_float_v(c) and not is_complex(c)
    return drjit().fma(a, b, c) if real else a * b + c


@rule
def _complex(o, real, imag):
    return [each(o.kind, real, imag)]


@rule
def _dot_general(o, a, b):
    part = lambda side, kind: o.part(
        "dot_dimension_numbers", f"{side}_{kind}_dimensions"
    )

    def matrices(x: Tensor, side: str) -> np.ndarray:
        batch, summed = part(side, "batching"), part(side, "contracting")
        free = [d for d in range(len(x.shape)) if d not in (*batch, *summed)]
        size = lambda axes: int(np.prod([x.shape[d] for d in axes]))
        places = x.places.transpose(*batch, *free, *summed)
        return places.reshape(size(batch), size(free), size(summed))

    left, right = matrices(a, "lhs"), matrices(b, "rhs")
    out = []
    for k, i, j in np.ndindex(len(left), left.shape[1], right.shape[1]):
        total = o.kind(0)
        for m, n in zip(left[k, i], right[k, j]):
            total = _multiplied_and_added(a.entries[m], b.entries[n], total)
        out.append(total)
    return [Tensor(out, o.shape)]


@rule
def _reduce(o, *xs):
    axes, n = o.ints("dimensions"), len(xs) // 2
    rest = [d for d in range(len(xs[0].shape)) if d not in axes]
    kept = [xs[0].shape[d] for d in rest]
    rows = xs[0].places.transpose(*rest, *axes).reshape(int(np.prod(kept)), -1)
    outs = [[] for _ in range(n)]
    for row in rows:
        parts = [[Tensor([x.entries[i]], ()) for x in xs[:n]] for i in row]
        # Most reductions start from a neutral element, such as zero in a sum.
        total = parts.pop(0) if parts and _changes_nothing(o, xs[n:]) else [*xs[n:]]
        for part in parts:
            total = o.run(0, [*total, *part])
        for out, t in zip(outs, total):
            out.append(t.item())
    return [Tensor(out, tuple(kept)) for out in outs]


def _changes_nothing(o, starts) -> bool:
    value = known(starts[0])
    name = [*o.op.regions[0].blocks[0].operations][0].operation.name.split(".")[-1]
    neutral = {
        "add": 0,
        "multiply": 1,
        "maximum": -np.inf,
        "minimum": np.inf,
        "or": False,
        "and": True,
    }
    return len(starts) == 1 and value is not None and neutral.get(name) == value


@rule
def _reduce_window(o, *xs):
    """Cumulative sums, and other reductions of windows."""
    n = len(xs) // 2
    if any(size > 1 for size in o.optional("base_dilations")):
        raise NotReplayed(o.op, f"`{o.op.name}` of entries that are apart")
    shape = xs[0].shape
    rank = len(shape)
    ones = [1] * rank
    sizes = o.ints("window_dimensions")
    strides = o.optional("window_strides") or ones
    apart = o.optional("window_dilations") or ones
    padding = o.op.attributes["padding"] if "padding" in o.op.attributes else [0] * rank
    low = np.asarray(padding).reshape(rank, -1)[:, 0]
    outs = [[] for _ in range(n)]
    for place in np.ndindex(*o.shape):
        total = [*xs[n:]]
        for offset in np.ndindex(*sizes):
            at = np.array(place) * strides + np.array(offset) * apart - low
            if np.all((at >= 0) & (at < shape)):
                i = xs[0].places[tuple(at)]
                part = [Tensor([x.entries[i]], ()) for x in xs[:n]]
                total = o.run(0, [*total, *part])
        for out, t in zip(outs, total):
            out.append(t.item())
    return [Tensor(out, o.shape) for out in outs]
