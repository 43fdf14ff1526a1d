"""Operations that combine entries of an array: products of matrices, sums, sorting."""

import functools as ft
import itertools
import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from .._compat import is_literal
from .backend import dr
from .complex import is_complex
from .elementwise import is_zero
from .operation import NotReplayed, ONLY_REGION, Operation, rule
from .tensor import known_values, scalar, Tensor


# The most numbers to sort: exchanges grow with the square of the number.
_MOST_SORTED = 16


def _is_real_float(a: Any) -> bool:
    return dr.is_float_v(a) and not is_complex(a)


def _multiplied_and_added(a: Any, b: Any, c: Any) -> Any:
    """`a b + c`, in one operation if it can be."""
    return dr.fma(a, b, c) if _is_real_float(c) else a * b + c


@rule
def _dot_general(operation: Operation, a: Tensor, b: Tensor) -> list[Tensor]:
    # The places of the factors, of shapes (batch, rows, summed) and (batch, columns,
    # summed): row times column for each entry of the result.
    places_in_a = _as_matrices(operation, a, "lhs")
    places_in_b = _as_matrices(operation, b, "rhs")
    batch_size, num_rows, _ = places_in_a.shape
    _, num_columns, _ = places_in_b.shape
    # Products and sums have the type of the result, to which other numbers are converted.
    dtype = operation.dtype
    a_entries = [x if type(x) is dtype else dtype(x) for x in a.entries]
    b_entries = [x if type(x) is dtype else dtype(x) for x in b.entries]
    results = []
    for batch, i, j in np.ndindex(batch_size, num_rows, num_columns):
        row = [a_entries[place] for place in places_in_a[batch, i]]
        column = [b_entries[place] for place in places_in_b[batch, j]]
        total = dtype(0)
        if _is_real_float(total):
            total = total + _sum_left_out(row, column) + _sum_left_out(column, row)
        for x, y in zip(row, column):
            total = _multiplied_and_added(x, y, total)
        results.append(total)
    return [Tensor(results, operation.shape)]


def _sum_left_out(factors: Sequence[Any], others: Sequence[Any]) -> Any:
    """The sum of the products that Dr.Jit leaves out, because one of `factors` is a zero
    that is known while the kernel is recorded: zero, or NaN if a number among `others` is
    infinite or NaN."""
    unknown = [x for x in others if not is_literal(x)]
    if not unknown or not any(map(is_zero, factors)):
        return 0
    # A difference of equal numbers is zero, or NaN if they are infinite or NaN. The sum is
    # over all unknown factors, not those beside zeros alone: so it is the same for all rows
    # of a sparse matrix, and Dr.Jit computes it once.
    total = ft.reduce(operator.add, unknown)
    return total - total


def _as_matrices(operation: Operation, x: Tensor, side: str) -> np.ndarray:
    """The places of a factor of `dot_general`, which is the `lhs` or the `rhs`, in the
    shape (batch, kept axes, summed axes): each group of axes is one axis here."""
    name = "dot_dimension_numbers"
    batch = operation.part(name, f"{side}_batching_dimensions")
    summed = operation.part(name, f"{side}_contracting_dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in (*batch, *summed)]
    groups = (batch, kept, summed)
    sizes = [math.prod(x.shape[axis] for axis in axes) for axes in groups]
    return x.places.transpose(*batch, *kept, *summed).reshape(sizes)


@rule
def _reduce(operation: Operation, *xs: Tensor) -> list[Tensor]:
    arrays, initial = _arrays_and_initial(xs)
    shape = arrays[0].shape
    axes = operation.integers("dimensions")
    kept = [axis for axis in range(len(shape)) if axis not in axes]
    shape_of_results = tuple(shape[axis] for axis in kept)
    # (entries of a result, entries that are reduced to one)
    num_results = math.prod(shape_of_results)
    places = arrays[0].places.transpose(*kept, *axes).reshape(num_results, -1)
    starts_neutral = _starts_neutral(operation, initial)
    totals = []
    for places_of_total in places:
        parts = [_entries_at(arrays, place) for place in places_of_total]
        # A neutral element, such as zero in a sum, is left out: the first part takes its
        # place.
        total = parts.pop(0) if parts and starts_neutral else [*initial]
        for part in parts:
            total = operation.run(ONLY_REGION, [*total, *part])
        totals.append(total)
    return _arrays_of(totals, shape_of_results, len(arrays))


def _arrays_and_initial(
    operands: Sequence[Tensor],
) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """The two halves of the operands of a reduction: arrays of one shape, and the value
    from which each starts. Several arrays are reduced together where the result of one
    depends on the others, such as values and places for `argmax`."""
    num_arrays = len(operands) // 2
    return operands[:num_arrays], operands[num_arrays:]


def _entries_at(arrays: Sequence[Tensor], place: Any) -> list[Tensor]:
    """The entries of all these arrays at a place, each as an array without axes."""
    return [scalar(x.entries[place]) for x in arrays]


def _arrays_of(
    totals: list[list[Tensor]], shape: tuple[int, ...], num_arrays: int
) -> list[Tensor]:
    """Arrays of this shape. `totals` are their entries in row-major order, each a list with
    the entry of each array, as an array without axes."""
    arrays = []
    for k in range(num_arrays):
        entries = [total[k].item() for total in totals]
        arrays.append(Tensor(entries, shape))
    return arrays


# Neutral elements, by the operation that is repeated.
_NEUTRAL = {
    "add": 0,
    "multiply": 1,
    "maximum": -np.inf,
    "minimum": np.inf,
    "or": False,
}


def _starts_neutral(operation: Operation, initial: Sequence[Tensor]) -> bool:
    """Whether a reduction starts from the neutral element of its operation."""
    if len(initial) > 1:
        return False
    value = known_values(initial[0])
    repeated = operation.reduces_by
    if value is None or repeated is None:
        return False
    if repeated == "and":
        # The neutral element has all bits set, which the integer 1 has not.
        return bool(~value == 0)
    return bool(value == _NEUTRAL.get(repeated))


@rule
def _reduce_window(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """Cumulative sums, and other reductions of windows."""
    arrays, initial = _arrays_and_initial(xs)
    if any(size > 1 for size in operation.optional_integers("base_dilations")):
        raise NotReplayed(
            operation.mlir_op, f"`{operation.full_name}` of entries that are apart"
        )
    shape = arrays[0].shape
    ones = [1] * len(shape)
    sizes = operation.integers("window_dimensions")
    strides = np.array(operation.optional_integers("window_strides") or ones)
    distances = np.array(operation.optional_integers("window_dilations") or ones)
    padding_before = _padding_before(operation, len(shape))
    totals = []
    for window in np.ndindex(*operation.shape):
        corner = np.array(window) * strides - padding_before
        total = [*initial]
        for offset in np.ndindex(*sizes):
            index = corner + np.array(offset) * distances
            # What lies in the padding is left out, as XLA does. The specification has the
            # initial value there, which is the same if it is neutral.
            if np.all((index >= 0) & (index < shape)):
                place = arrays[0].places[tuple(index)]
                entries = _entries_at(arrays, place)
                total = operation.run(ONLY_REGION, [*total, *entries])
        totals.append(total)
    return _arrays_of(totals, operation.shape, len(arrays))


def _padding_before(operation: Operation, num_axes: int) -> np.ndarray:
    """How far a `reduce_window` pads its arrays at the beginning of each axis."""
    if not operation.has("padding"):
        return np.zeros(num_axes, int)
    # Pairs of the padding before and after. Without axes, there are none.
    before, _ = operation.matrix("padding").reshape(num_axes, 2).T
    return before


@rule
def _sort(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """Exchanges of neighbours until all are in order, which keep the order of equals."""
    axis = operation.integer("dimension")
    length = xs[0].shape[axis]
    if length > _MOST_SORTED:
        raise NotReplayed(
            operation.mlir_op,
            f"`{operation.full_name}` of more than {_MOST_SORTED} numbers",
        )
    # Arrays that are sorted together: the first ones may be keys of the others.
    arrays = [[*x.entries] for x in xs]
    for places in np.moveaxis(xs[0].places, axis, -1).reshape(-1, length):
        # After each round the largest of those left is at their end.
        for end in range(length, 1, -1):
            for left, right in itertools.pairwise(places[:end]):
                _put_in_order(operation, arrays, left, right)
    return [Tensor(entries, x.shape) for entries, x in zip(arrays, xs)]


def _put_in_order(
    operation: Operation, arrays: list[list[Any]], left: int, right: int
) -> None:
    """Exchanges the entries at two places, in all arrays, where the order is wrong."""
    # The region takes two entries of each array in turn, and says whether the first of two
    # must stand before the second. It gets the right one as the first: for equals it says
    # no, so that they stay.
    pairs = [scalar(entries[place]) for entries in arrays for place in (right, left)]
    (right_comes_first,) = operation.run(ONLY_REGION, pairs)
    is_wrong_order = right_comes_first.item()
    for entries in arrays:
        new_left = dr.select(is_wrong_order, entries[right], entries[left])
        entries[right] = dr.select(is_wrong_order, entries[left], entries[right])
        entries[left] = new_left
