"""Operations that combine entries of an array: products of matrices, sums, sorting."""

import functools as ft
import itertools
import math
import operator
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .._compat import is_literal
from .backend import dr
from .elementwise import is_zero
from .operation import ONLY_REGION, Operation, rule
from .tensor import scalar, Tensor


# The most numbers to sort: exchanges grow with the square of the number.
_MOST_SORTED = 16


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
        if dr.is_float_v(dtype) and not dr.is_complex_v(dtype):
            total = total + _sum_left_out(row, column) + _sum_left_out(column, row)
        for x, y in zip(row, column):
            total = dr.fma(x, y, total)
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
def _reduce(operation: Operation, *operands: Tensor) -> list[Tensor]:
    x = operands[0]
    axes = operation.integers("dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in axes]
    places = x.places.transpose(*kept, *axes)
    return _reduced(operation, operands, places.reshape(math.prod(operation.shape), -1))


def _reduced(
    operation: Operation, operands: Sequence[Tensor], groups: Iterable[Iterable[Any]]
) -> list[Tensor]:
    """The results of a reduction. `groups` has the places of the entries that are reduced
    to one, for each entry of a result in row-major order.

    The first half of the operands are arrays of one shape, the others the values from which
    each starts. Several arrays are reduced together where the result of one depends on the
    others, such as values and places for `argmax`.
    """
    num_arrays = len(operands) // 2
    arrays = operands[:num_arrays]
    totals = []
    for places in groups:
        total = operands[num_arrays:]
        for place in places:
            entries = [scalar(x.entries[place]) for x in arrays]
            total = operation.run(ONLY_REGION, [*total, *entries])
        totals.append([x.item() for x in total])
    return [Tensor(entries, operation.shape) for entries in zip(*totals)]


@rule
def _reduce_window(operation: Operation, *operands: Tensor) -> list[Tensor]:
    """Cumulative sums, and other reductions of windows."""
    if any(size > 1 for size in operation.integers("base_dilations")):
        raise operation.refusal("of entries that are apart")
    x = operands[0]
    sizes = operation.integers("window_dimensions")
    strides = np.array(operation.integers("window_strides") or 1)
    distances = np.array(operation.integers("window_dilations") or 1)
    # Pairs of the padding before and after, for each axis.
    padding = (
        operation.matrix("padding") if operation.has("padding") else np.zeros(2, int)
    )
    padding_before = padding.reshape(-1, 2)[:, 0]
    groups = []
    for window in np.ndindex(*operation.shape):
        corner = np.array(window) * strides - padding_before
        indices = [
            corner + np.array(offset) * distances for offset in np.ndindex(*sizes)
        ]
        # What lies in the padding is left out, as XLA does. The specification has the
        # initial value there, which is the same if it is neutral.
        inside = [i for i in indices if np.all((i >= 0) & (i < x.shape))]
        groups.append([x.places[tuple(index)] for index in inside])
    return _reduced(operation, operands, groups)


@rule
def _sort(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """Exchanges of neighbours until all are in order, which keep the order of equals."""
    axis = operation.integer("dimension")
    length = xs[0].shape[axis]
    if length > _MOST_SORTED:
        raise operation.refusal(f"of more than {_MOST_SORTED} numbers")
    # Arrays that are sorted together: the first ones may be keys of the others.
    arrays = [[*x.entries] for x in xs]
    for places in np.moveaxis(xs[0].places, axis, -1).reshape(-1, length):
        # After each round the largest of those left is at their end.
        for end in range(length, 1, -1):
            for left, right in itertools.pairwise(places[:end]):
                # The region takes two entries of each array in turn, and says whether the
                # first of two must stand before the second. It gets the right one as the
                # first: for equals it says no, so that they stay.
                pairs = [scalar(x[place]) for x in arrays for place in (right, left)]
                (right_comes_first,) = operation.run(ONLY_REGION, pairs)
                is_wrong_order = right_comes_first.item()
                for x in arrays:
                    new_left = dr.select(is_wrong_order, x[right], x[left])
                    x[right] = dr.select(is_wrong_order, x[left], x[right])
                    x[left] = new_left
    return [Tensor(entries, x.shape) for entries, x in zip(arrays, xs)]
