"""Operations that make, move or convert single entries. It is known while the kernel is
recorded where each entry goes.

The *position* of an entry is its index in the flat list `x.entries` of all entries of an
array `x`. `x.positions` has the shape of `x` and holds the position of each entry. To move
entries, NumPy moves these positions, and `x.take(positions)` is the array of the entries
there.
"""

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
    # `x` gets an axis for each axis of the result. The new axes have length one.
    sizes = np.ones(len(operation.shape), int)
    sizes[operation.integers("broadcast_dimensions")] = x.shape
    return [x.take(np.broadcast_to(x.positions.reshape(sizes), operation.shape))]


@rule
def _reshape(operation: Operation, x: Tensor) -> list[Tensor]:
    return [Tensor(x.entries, operation.shape)]


@rule
def _transpose(operation: Operation, x: Tensor) -> list[Tensor]:
    return [x.take(x.positions.transpose(operation.integers("permutation")))]


@rule
def _slice(operation: Operation, x: Tensor) -> list[Tensor]:
    begins = operation.integers("start_indices")
    ends = operation.integers("limit_indices")
    kept = tuple(map(slice, begins, ends, operation.integers("strides")))
    return [x.take(x.positions[kept])]


@rule
def _reverse(operation: Operation, x: Tensor) -> list[Tensor]:
    return [x.take(np.flip(x.positions, tuple(operation.integers("dimensions"))))]


@rule
def _concatenate(operation: Operation, *xs: Tensor) -> list[Tensor]:
    all_entries = Tensor(entries_of(xs), ())
    # The position in the list of all entries at which the entries of each array begin.
    begins = np.cumsum([0, *[len(x.entries) for x in xs]])
    positions = [x.positions + begin for x, begin in zip(xs, begins)]
    return [all_entries.take(np.concatenate(positions, operation.integer("dimension")))]


@rule
def _pad(operation: Operation, x: Tensor, value: Tensor) -> list[Tensor]:
    """Adds the padding `value` before, between and after the entries of `x`: the entry with
    the index `i` goes to `before + i * distance`, along each axis."""
    before = np.array(operation.integers("edge_padding_low"), int)
    distances = 1 + np.array(operation.integers("interior_padding"), int)
    # The value is the last of these entries. At first it is taken everywhere, then the
    # entries of `x` are put where they go.
    all_entries = Tensor([*x.entries, value.item()], ())
    positions = np.full(operation.shape, len(x.entries))
    for index, position in np.ndenumerate(x.positions):
        new_index = before + np.array(index, int) * distances
        # A negative padding moves some entries out of the result.
        if np.all((new_index >= 0) & (new_index < operation.shape)):
            positions[tuple(new_index)] = position
    return [all_entries.take(positions)]


@rule
def _select(
    operation: Operation, mask: Tensor, if_true: Tensor, if_false: Tensor
) -> list[Tensor]:
    # With `vmap` of a conditional, JAX also selects between an array and itself. If the
    # array is in memory (its entries are a `Table`), it stays there.
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
    """The entry, converted to this type of Dr.Jit arrays."""
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
    # In lower case, a direction such as `LT` is the name of a function in `operator`.
    direction = operation.word("comparison_direction").lower()
    if operation.has("compare_type") and operation.word("compare_type") == "TOTALORDER":
        a = map_entries(_in_total_order, a)
        b = map_entries(_in_total_order, b)
    if direction not in ("eq", "ne"):
        return [map_entries(getattr(operator, direction), a, b)]
    is_complex = dr.is_complex_v(a.entries[0])
    is_equal = map_entries(equal if is_complex else operator.eq, a, b)
    # "Not equal" is the inverse of "equal", since Dr.Jit's own `!=` is false for two NaNs
    # (unless both are constants).
    return [is_equal if direction == "eq" else map_entries(operator.invert, is_equal)]


def _in_total_order(a: Any) -> Any:
    """Maps floating-point numbers to integers that have the same order. This is the total
    order of StableHLO: -0 is below 0, and NaN with a positive sign is above infinity."""
    num_bits = 8 * dr.itemsize_v(a)
    # The bits of positive numbers, read as integers, have the order of the numbers, and the
    # bits of negative numbers the reverse order.
    bits = dr.reinterpret_array(array_types()[f"i{num_bits}"], a)
    # So for negative numbers all bits except the sign are flipped, which reverses their
    # order. The shift copies the sign to all bits: they are all set for a negative number,
    # and none is set otherwise.
    filled_with_sign = bits >> (num_bits - 1)
    all_but_sign = 2 ** (num_bits - 1) - 1
    return bits ^ (filled_with_sign & all_but_sign)
