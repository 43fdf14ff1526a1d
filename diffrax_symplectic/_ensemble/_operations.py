"""The table of the operations of StableHLO that can be replayed. One that acts on each entry
by itself is a line in `_elementwise`, any other a function here.

A rule takes an operation and its operands to its results. StableHLO's specification
(https://openxla.org/stablehlo/spec) says what each of them does.
"""

import itertools
import math
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ._backend import array_types, drjit
from ._elementwise import elementwise
from ._tensor import constant, each, flat, known, Tensor, unflat


class Operation(NamedTuple):
    """An operation of a program, and what carries out its regions: the number of one and
    its arguments make its results."""

    op: Any
    run: Callable[..., list[Tensor]]
    # In which lanes an error is raised: the program of JAX takes these paths, and raises it.
    errors: list[Any]

    @property
    def name(self) -> str:
        return self.op.name.split(".")[-1]

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.op.results[0].type.shape)

    @property
    def kind(self) -> Any:
        return self.kind_of(self.op.results[0])

    def kind_of(self, value: Any) -> Any:
        """The type of Dr.Jit's arrays for a value of the program."""
        name = str(getattr(value.type, "element_type", value.type))
        if name not in array_types():
            raise NotReplayed(self.op, f"numbers of type `{name}`")
        return array_types()[name]

    def ints(self, name: str) -> list[int]:
        return [int(i) for i in self.op.attributes[name]]

    def int(self, name: str) -> int:
        return self.op.attributes[name].value

    def word(self, name: str) -> str:
        """Of an enumeration, written `#stablehlo<comparison_direction LT>`."""
        return re.findall(r"\w+", str(self.op.attributes[name]))[-1]

    def shapes(self) -> list[tuple[int, ...]]:
        return [tuple(x.type.shape) for x in self.op.results]

    def recorded(self, fn: Callable, *args: Any, **kwargs: Any) -> list[Tensor]:
        """The results, if Dr.Jit records a loop or a conditional by `fn`."""
        number = len(self.errors)
        out = fn(*args, mode="symbolic", **kwargs)
        if len(self.errors) > number:
            raise NotReplayed(
                self.op, "an error that is raised within a loop or branch"
            )
        return out

    def part(self, name: str, key: str) -> list[int]:
        """Of an attribute, written `#stablehlo.gather<offset_dims = [0], ...>`."""
        text = str(self.op.attributes[name])
        found = re.search(rf"\b{key} = (\[[^\]]*\]|\d+)", text)
        return [int(i) for i in re.findall(r"\d+", found[1])] if found else []


class NotReplayed(Exception):
    """An operation that cannot be replayed, and what of it."""

    def __init__(self, op: Any, what: str | None = None):
        super().__init__(what or f"`{op.name}`")
        self.location = str(op.location)


Rule: TypeAlias = Callable[..., list[Tensor]]
_RULES: dict[str, Rule] = {}


def _rule(fn: Rule) -> Rule:
    _RULES[fn.__name__.strip("_")] = fn
    return fn


def rule_of(name: str) -> Rule | None:
    """The rule for the operation of this name, without that of its dialect."""
    if fn := elementwise().get(name):
        return lambda o, *xs: [each(fn, *xs)]
    return _RULES.get(name)


# Entries are moved about


@_rule
def _constant(o):
    return [
        constant(o.kind, np.broadcast_to(np.asarray(o.op.attributes["value"]), o.shape))
    ]


@_rule
def _iota(o):
    places = np.indices(o.shape)[o.int("iota_dimension")]
    return [constant(o.kind, places)]


@_rule
def _broadcast_in_dim(o, x):
    sizes = [1] * len(o.shape)
    for d, n in zip(o.ints("broadcast_dimensions"), x.shape):
        sizes[d] = n
    return [x.take(np.broadcast_to(x.places.reshape(sizes), o.shape))]


@_rule
def _reshape(o, x):
    return [Tensor(x.entries, o.shape)]


@_rule
def _transpose(o, x):
    return [x.take(x.places.transpose(o.ints("permutation")))]


@_rule
def _slice(o, x):
    ends = map(slice, *map(o.ints, ("start_indices", "limit_indices", "strides")))
    return [x.take(x.places[tuple(ends)])]


@_rule
def _reverse(o, x):
    return [x.take(np.flip(x.places, o.ints("dimensions")))]


@_rule
def _concatenate(o, *xs):
    begins = np.cumsum([0, *[len(x.entries) for x in xs]])
    places = [x.places + begin for x, begin in zip(xs, begins)]
    whole = Tensor([*flat(xs)], ())
    return [whole.take(np.concatenate(places, o.int("dimension")))]


@_rule
def _pad(o, x, value):
    low, inner = o.ints("edge_padding_low"), o.ints("interior_padding")
    at = [a + np.arange(n) * (i + 1) for a, i, n in zip(low, inner, x.shape)]
    inside = [(0 <= k) & (k < n) for k, n in zip(at, o.shape)]
    places = np.full(o.shape, len(x.entries))
    places[np.ix_(*[k[b] for k, b in zip(at, inside)])] = x.places[np.ix_(*inside)]
    return [Tensor([*x.entries, value.item()], ()).take(places)]


# An index that differs from path to path chooses by as many comparisons as there are places.
_MOST_PLACES = 64


def _windows(
    o: Operation, x: Tensor, starts: Sequence[Tensor], sizes: Sequence[int]
) -> Iterator[tuple[tuple[slice, ...], Any]]:
    """Where a window of these sizes can be in `x`, and in which lanes it is there."""
    axes = []
    for start, n, size in zip(starts, x.shape, sizes):
        most, value = n - size, known(start)
        if most == 0 or value is not None:
            axes.append([(0 if most == 0 else int(np.clip(value, 0, most)), True)])
            continue
        s = start.item()
        first, last = [(0, s <= 0)], [(most, s >= most)]
        axes.append([*first, *[(k, s == k) for k in range(1, most)], *last])
    if (number := math.prod(map(len, axes))) > _MOST_PLACES:
        what = f"`{o.op.name}` with an index of each path among {number} places"
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
    out = None
    for window, here in _windows(o, x, starts, sizes):
        out = _in_lanes(here, x.take(x.places[window]), out)
    assert out is not None
    return out


@_rule
def _dynamic_slice(o, x, *starts):
    return [_window(o, x, starts, o.shape)]


@_rule
def _dynamic_update_slice(o, x, update, *starts):
    out = None
    for window, here in _windows(o, x, starts, update.shape):
        places = x.places.copy()
        places[window] = len(x.entries) + update.places
        out = _in_lanes(here, Tensor([*flat([x, update])], ()).take(places), out)
    return [out]


def _starts(o: Operation, name: str, x: Tensor, indices: Tensor, axes: list[int]):
    """For each of `indices` where a window in `x` begins."""
    if o.part(name, "operand_batching_dims") or o.part(name, "input_batching_dims"):
        raise NotReplayed(o.op, f"`{o.op.name}` with an axis of a batch")
    # Written only if it is not zero.
    vector = sum(o.part(name, "index_vector_dim"))
    places = indices.places.reshape(
        *indices.shape, *[1] * (vector == len(indices.shape))
    )
    places = np.moveaxis(places, vector, -1)
    zero = constant(type(indices.entries[0]), np.zeros(()))

    def start(row: np.ndarray) -> list[Tensor]:
        own = {axis: Tensor([indices.entries[i]], ()) for axis, i in zip(axes, row)}
        return [own.get(d, zero) for d in range(len(x.shape))]

    batch = places.shape[:-1]
    return batch, [start(row) for row in places.reshape(math.prod(batch), -1)]


@_rule
def _gather(o, x, indices):
    name, sizes = "dimension_numbers", o.ints("slice_sizes")
    batch, starts = _starts(o, name, x, indices, o.part(name, "start_index_map"))
    windows = Tensor(
        [*flat([_window(o, x, s, sizes) for s in starts])], (*batch, *sizes)
    )
    collapsed = tuple(len(batch) + d for d in o.part(name, "collapsed_slice_dims"))
    places = windows.places.squeeze(collapsed)
    moved = range(len(batch), places.ndim)
    return [windows.take(np.moveaxis(places, moved, o.part(name, "offset_dims")))]


@_rule
def _scatter(o, x, indices, updates):
    name = "scatter_dimension_numbers"
    inserted = o.part(name, "inserted_window_dims")
    window = o.part(name, "update_window_dims")
    sizes, left = [], iter(window)
    for d in range(len(x.shape)):
        sizes.append(1 if d in inserted else updates.shape[next(left)])
    axes = o.part(name, "scatter_dims_to_operand_dims")
    batch, starts = _starts(o, name, x, indices, axes)
    source = np.moveaxis(updates.places, window, range(len(batch), updates.places.ndim))
    out = [*x.entries]
    for start, row in zip(starts, source.reshape(math.prod(batch), -1)):
        values = [known(s) for s in start]
        if any(v is None for v in values):
            raise NotReplayed(o.op, f"`{o.op.name}` with an index of each path")
        begin = [int(v) for v in values if v is not None]
        fits = [0 <= b <= n - size for b, n, size in zip(begin, x.shape, sizes)]
        if not all(fits):
            continue  # It is dropped.
        at = tuple(slice(b, b + size) for b, size in zip(begin, sizes))
        for i, k in zip(x.places[at].flat, row):
            one = [Tensor([e], ()) for e in (out[i], updates.entries[k])]
            out[i] = o.run(0, one)[0].item()
    return [Tensor(out, x.shape)]


# Entries are converted


@_rule
def _convert(o, x):
    if o.kind is array_types()["i1"]:
        return [each(lambda a: a if type(a) is o.kind else ~(a == 0), x)]
    return [each(o.kind, x)]


@_rule
def _bitcast_convert(o, x):
    return [each(lambda a: drjit().reinterpret_array(o.kind, a), x)]


@_rule
def _compare(o, a, b):
    name = o.word("comparison_direction").lower()
    if name == "ne":
        # What is not a number differs from all. In Dr.Jit it does not.
        return [each(lambda a, b: ~(a == b), a, b)]
    return [each(getattr(operator, name), a, b)]


# Entries are combined


@_rule
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
        terms = [a.entries[m] * b.entries[n] for m, n in zip(left[k, i], right[k, j])]
        out.append(sum(terms[1:], terms[0]) if terms else o.kind(0))
    return [Tensor(out, o.shape)]


@_rule
def _reduce(o, *xs):
    axes, n = o.ints("dimensions"), len(xs) // 2
    rest = [d for d in range(len(xs[0].shape)) if d not in axes]
    kept = [xs[0].shape[d] for d in rest]
    rows = xs[0].places.transpose(*rest, *axes).reshape(int(np.prod(kept)), -1)
    outs = [[] for _ in range(n)]
    for row in rows:
        parts = [[Tensor([x.entries[i]], ()) for x in xs[:n]] for i in row]
        # Most reductions begin with what changes nothing, such as zero in a sum.
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


# What is run


@_rule
def _optimization_barrier(o, *xs):
    return [*xs]


@_rule
def _sharding_constraint(o, x):
    return [x]


@_rule
def _custom_call(o, *xs):
    raise NotReplayed(o.op, f"a call of `{o.op.attributes['call_target_name'].value}`")


def _raises(region: Any) -> bool:
    """Whether it calls back to Python, as `equinox.error_if` does to raise its error."""
    calls = [op for op in region.blocks[0].operations if "custom_call" in op.name]
    return any("callback" in op.attributes["call_target_name"].value for op in calls)


@_rule
def _case(o, index):
    value, number = known(index), len(o.op.regions)
    if value is not None:
        return o.run(int(value) if 0 <= value < number else number - 1, [])
    branches = [i for i in range(number) if not _raises(o.op.regions[i])]
    o.errors.extend(index.item() == i for i in range(number) if i not in branches)

    def taken(left: list[int]) -> tuple:
        """The first of the branches, or another one."""
        first, *others = left
        if not others:
            return flat(o.run(first, []))
        here = index.item() == first
        run, rest = lambda: flat(o.run(first, [])), lambda: taken(others)
        return o.recorded(drjit().if_stmt, (), here, run, rest)

    return unflat(taken(branches), o.shapes())


@_rule
def _if(o, condition):
    value = known(condition)
    if value is not None:
        return o.run(0 if value else 1, [])
    yes, no = (lambda i=i: flat(o.run(i, [])) for i in (0, 1))
    out = o.recorded(drjit().if_stmt, (), condition.item(), yes, no)
    return unflat(out, o.shapes())


# The first so many times around, a loop is written out, as long as it is known to go on.
_WRITTEN_OUT = 8


@_rule
def _while(o, *xs):
    body = o.op.regions[1].blocks[0]
    returned = [*[*body.operations][-1].operands]
    # What stays the same is no part of the loop's state, and constants stay known.
    moves = [a != b for a, b in zip(returned, body.arguments)]
    moving = lambda xs: [x for x, m in zip(xs, moves) if m]
    xs, number = [*xs], 0
    while (go := known(o.run(0, xs)[0])) is not None and number < _WRITTEN_OUT:
        if not go:
            return xs
        xs, number = o.run(1, xs), number + 1
    start, fixed = moving(xs), xs
    shapes = [x.shape for x in start]

    def whole(entries) -> list[Tensor]:
        left = iter(unflat(entries, shapes))
        return [next(left) if m else x for x, m in zip(fixed, moves)]

    on = lambda *y: o.run(0, whole(y))[0].item()
    once = lambda *y: flat(moving(o.run(1, whole(y))))
    out = o.recorded(drjit().while_loop, flat(start), on, once, compress=False)
    return whole(out)
