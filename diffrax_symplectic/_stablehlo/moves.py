"""Operations that make, move or convert entries, one by one: the program knows where each
goes."""

import functools as ft
import operator
from typing import Any

import numpy as np

from .backend import array_types, drjit
from .complex import equal, is_complex
from .integers import to_integer
from .operation import NotReplayed, rule
from .tensor import constant, each, flat, Tensor


@rule
def _constant(o):
    return [constant(o.kind, o.value)]


@rule
def _iota(o):
    along = np.indices(o.shape)[o.number("iota_dimension")]
    return [constant(o.kind, along)]


@rule
def _broadcast_in_dim(o, x):
    # The axes of `x` in the order of those of the result, and new ones of length one.
    sizes = [1] * len(o.shape)
    for axis, size in zip(o.ints("broadcast_dimensions"), x.shape):
        sizes[axis] = size
    return [x.take(np.broadcast_to(x.places.reshape(sizes), o.shape))]


@rule
def _reshape(o, x):
    return [Tensor(x.entries, o.shape)]


@rule
def _transpose(o, x):
    return [x.take(x.places.transpose(o.ints("permutation")))]


@rule
def _slice(o, x):
    begins = o.ints("start_indices")
    ends = o.ints("limit_indices")
    kept = tuple(map(slice, begins, ends, o.ints("strides")))
    return [x.take(x.places[kept])]


@rule
def _reverse(o, x):
    return [x.take(np.flip(x.places, o.ints("dimensions")))]


@rule
def _concatenate(o, *xs):
    whole = Tensor([*flat(xs)], ())
    # Where the entries of each array begin in the list of all.
    begins = np.cumsum([0, *[len(x.entries) for x in xs]])
    places = [x.places + begin for x, begin in zip(xs, begins)]
    return [whole.take(np.concatenate(places, o.number("dimension")))]


@rule
def _pad(o, x, value):
    low = o.ints("edge_padding_low")
    between = o.ints("interior_padding")
    # Along each axis, where the entries of `x` go. A negative padding drops some of them.
    targets = [
        begin + np.arange(size) * (gap + 1)
        for begin, gap, size in zip(low, between, x.shape)
    ]
    is_inside = [(0 <= at) & (at < size) for at, size in zip(targets, o.shape)]
    kept = [at[inside] for at, inside in zip(targets, is_inside)]
    # One list of the entries of `x` and the value, which comes last.
    all_entries = Tensor([*x.entries, value.item()], ())
    place_of_value = len(x.entries)
    places = np.full(o.shape, place_of_value)
    places[np.ix_(*kept)] = x.places[np.ix_(*is_inside)]
    return [all_entries.take(places)]


@rule
def _convert(o, x):
    return [each(ft.partial(_converted, o.kind), x)]


def _converted(kind: type, entry: Any) -> Any:
    dr = drjit()
    if type(entry) is kind:
        return entry
    if dr.is_mask_v(kind):
        return ~(entry == 0)
    if dr.is_float_v(entry) and dr.is_integral_v(kind):
        return to_integer(kind, entry)
    return kind(entry)


@rule
def _bitcast_convert(o, x):
    if o.shape != x.shape:
        raise NotReplayed(o.op, f"`{o.op.name}` between numbers of different sizes")

    def reinterpreted(entry: Any) -> Any:
        return drjit().reinterpret_array(o.kind, entry)

    return [each(reinterpreted, x)]


@rule
def _complex(o, real, imag):
    return [each(o.kind, real, imag)]


@rule
def _compare(o, a, b):
    direction = o.word("comparison_direction").lower()
    if o.has("compare_type") and o.word("compare_type") == "TOTALORDER":
        a = each(_in_total_order, a)
        b = each(_in_total_order, b)
    # All entries are of one type.
    if is_complex(a.entries[0]):
        # Complex numbers have no order: the direction is `eq` or `ne`.
        same = each(equal, a, b)
        return [same if direction == "eq" else each(operator.invert, same)]
    if direction == "ne":
        # NaN differs from everything. In Dr.Jit NaN != NaN is false, unless it is folded.
        return [each(operator.invert, each(operator.eq, a, b))]
    return [each(getattr(operator, direction), a, b)]


def _in_total_order(a: Any) -> Any:
    """An integer that orders floating-point numbers, with NaN above infinity."""
    bits = 8 * drjit().itemsize_v(a)
    number = drjit().reinterpret_array(array_types()[f"i{bits}"], a)
    # All bits but the sign are turned in negative numbers, which the shift tells.
    return number ^ ((number >> (bits - 1)) & (2 ** (bits - 1) - 1))
