"""Operations that make, move or convert entries, one by one: the program knows where each
goes."""

import functools as ft
import operator
from typing import Any

import numpy as np

from .backend import array_types, dr
from .complex import equal
from .integers import to_integer
from .mlir import constant_values
from .operation import Operation, rule
from .tensor import constant, entries_of, map_entries, Table, Tensor


@rule
def _constant(operation: Operation) -> list[Tensor]:
    return [constant(operation.dtype, constant_values(operation.mlir_op))]


@rule
def _iota(operation: Operation) -> list[Tensor]:
    indices = np.indices(operation.shape)[operation.integer("iota_dimension")]
    return [constant(operation.dtype, indices)]


@rule
def _broadcast_in_dim(operation: Operation, x: Tensor) -> list[Tensor]:
    # The shape of `x` with an axis for each of the result: new axes have length one.
    sizes = np.ones(len(operation.shape), int)
    sizes[operation.integers("broadcast_dimensions")] = x.shape
    return [x.take(np.broadcast_to(x.places.reshape(sizes), operation.shape))]


@rule
def _reshape(operation: Operation, x: Tensor) -> list[Tensor]:
    return [Tensor(x.entries, operation.shape)]


@rule
def _transpose(operation: Operation, x: Tensor) -> list[Tensor]:
    return [x.take(x.places.transpose(operation.integers("permutation")))]


@rule
def _slice(operation: Operation, x: Tensor) -> list[Tensor]:
    begins = operation.integers("start_indices")
    ends = operation.integers("limit_indices")
    kept = tuple(map(slice, begins, ends, operation.integers("strides")))
    return [x.take(x.places[kept])]


@rule
def _reverse(operation: Operation, x: Tensor) -> list[Tensor]:
    return [x.take(np.flip(x.places, tuple(operation.integers("dimensions"))))]


@rule
def _concatenate(operation: Operation, *xs: Tensor) -> list[Tensor]:
    whole = Tensor([*entries_of(xs)], ())
    # Where the entries of each array begin in the list of all.
    begins = np.cumsum([0, *[len(x.entries) for x in xs]])
    places = [x.places + begin for x, begin in zip(xs, begins)]
    return [whole.take(np.concatenate(places, operation.integer("dimension")))]


@rule
def _pad(operation: Operation, x: Tensor, value: Tensor) -> list[Tensor]:
    before = np.array(operation.integers("edge_padding_low"), int)
    distances = 1 + np.array(operation.integers("interior_padding"), int)
    # One list of the entries of `x` and the value, which comes last.
    all_entries = Tensor([*x.entries, value.item()], ())
    places = np.full(operation.shape, len(x.entries))
    for index, place in np.ndenumerate(x.places):
        target = before + np.array(index, int) * distances
        # A negative padding moves some entries out of the result.
        if np.all((target >= 0) & (target < operation.shape)):
            places[tuple(target)] = place
    return [all_entries.take(places)]


@rule
def _select(
    operation: Operation, mask: Tensor, if_true: Tensor, if_false: Tensor
) -> list[Tensor]:
    # `vmap` of a conditional selects between two equal tables: one stays in memory.
    one = if_true.entries
    other = if_false.entries
    if isinstance(one, Table) and isinstance(other, Table):
        has_same_addresses = np.array_equal(one.addresses, other.addresses)
        if one.memory is other.memory and has_same_addresses:
            return [if_true]
    return [map_entries(dr.select, mask, if_true, if_false)]


@rule
def _convert(operation: Operation, x: Tensor) -> list[Tensor]:
    return [map_entries(ft.partial(_converted, operation.dtype), x)]


def _converted(dtype: type, entry: Any) -> Any:
    """An entry as a number of this type of Dr.Jit."""
    if type(entry) is dtype:
        return entry
    if dr.is_mask_v(dtype):
        return ~(entry == 0)
    if dr.is_float_v(entry) and dr.is_integral_v(dtype):
        return to_integer(dtype, entry)
    return dtype(entry)


@rule
def _bitcast_convert(operation: Operation, x: Tensor) -> list[Tensor]:
    if operation.shape != x.shape:
        raise operation.refusal("between numbers of different sizes")
    return [map_entries(ft.partial(dr.reinterpret_array, operation.dtype), x)]


@rule
def _complex(operation: Operation, real: Tensor, imag: Tensor) -> list[Tensor]:
    return [map_entries(operation.dtype, real, imag)]


@rule
def _compare(operation: Operation, a: Tensor, b: Tensor) -> list[Tensor]:
    # The directions are called as Python's functions are, such as `LT`.
    direction = operation.word("comparison_direction").lower()
    if operation.has("compare_type") and operation.word("compare_type") == "TOTALORDER":
        a = map_entries(_in_total_order, a)
        b = map_entries(_in_total_order, b)
    if direction not in ("eq", "ne"):
        return [map_entries(getattr(operator, direction), a, b)]
    # Complex numbers have no order, and are equal if both parts are.
    is_equal = map_entries(
        equal if dr.is_complex_v(a.entries[0]) else operator.eq, a, b
    )
    # NaN differs from everything. In Dr.Jit NaN != NaN is false, unless it is folded.
    return [is_equal if direction == "eq" else map_entries(operator.invert, is_equal)]


def _in_total_order(a: Any) -> Any:
    """An integer that orders floating-point numbers, with NaN above infinity.

    The bits of positive numbers, read as an integer, are in their order, and those of
    negative numbers in the reverse order.
    """
    num_bits = 8 * dr.itemsize_v(a)
    bits = dr.reinterpret_array(array_types()[f"i{num_bits}"], a)
    # The shift copies the bit of the sign to all bits: of a negative number all are set, of
    # others none. So the last line flips all bits of negative numbers but the sign, which
    # reverses their order.
    filled_with_sign = bits >> (num_bits - 1)
    all_but_sign = 2 ** (num_bits - 1) - 1
    return bits ^ (filled_with_sign & all_but_sign)
