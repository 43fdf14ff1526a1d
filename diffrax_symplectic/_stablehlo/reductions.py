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


# The most numbers to sort: the operations of the sort grow with the square of this number.
_MOST_SORTED = 16


@rule
def _dot_general(operation: Operation, a: Tensor, b: Tensor) -> list[Tensor]:
    # Of shapes (batch, rows, summed) and (batch, columns, summed). An entry of the result
    # is the inner product of a row of `a` and a column of `b`.
    positions_in_a = _positions_as_matrices(operation, a, side="lhs")
    positions_in_b = _positions_as_matrices(operation, b, side="rhs")
    batch_size, num_rows, _ = positions_in_a.shape
    _, num_columns, _ = positions_in_b.shape
    # Products and sums have the type of the result, to which other numbers are converted.
    dtype = operation.dtype
    a_entries = [x if type(x) is dtype else dtype(x) for x in a.entries]
    b_entries = [x if type(x) is dtype else dtype(x) for x in b.entries]
    results = []
    for batch, i, j in np.ndindex(batch_size, num_rows, num_columns):
        row = [a_entries[position] for position in positions_in_a[batch, i]]
        column = [b_entries[position] for position in positions_in_b[batch, j]]
        results.append(_inner_product(row, column, dtype))
    return [Tensor(results, operation.shape)]


def _inner_product(row: list[Any], column: list[Any], dtype: type) -> Any:
    """The sum of the products of the numbers of a row and a column of type `dtype`."""
    total = dtype(0)
    # Dr.Jit replaces each product with a constant zero by zero. But zero times infinity or
    # NaN is NaN, so these products are added here: first the products with zeros in the
    # row, then the products with zeros in the column. (Products of complex numbers with
    # zeros are left out, as in `complex.py`.)
    if dr.is_float_v(dtype) and not dr.is_complex_v(dtype):
        total = total + _zero_or_nan(factors=row, others=column)
        total = total + _zero_or_nan(factors=column, others=row)
    for x, y in zip(row, column):
        total = dr.fma(x, y, total)
    return total


def _zero_or_nan(factors: Sequence[Any], others: Sequence[Any]) -> Any:
    """The sum of products of `others` with constant zeros among `factors`: zero, or NaN if
    one of the `others` that is not a constant is infinite or NaN."""
    unknown = [x for x in others if not is_literal(x)]
    if not unknown or not any(map(is_zero, factors)):
        return 0
    # The difference of a sum and itself is zero, or NaN if one of its terms is infinite or
    # NaN. The sum is over all unknown numbers, even those whose factor is not zero: so it
    # is the same for all rows of a sparse matrix, and Dr.Jit computes it once.
    total = ft.reduce(operator.add, unknown)
    return total - total


def _positions_as_matrices(operation: Operation, x: Tensor, side: str) -> np.ndarray:
    """The positions of the entries of an operand `x` of `dot_general`, which is the `lhs`
    or the `rhs`, as an array of shape (batch, kept, summed). Each of its axes stands for a
    group of axes of `x`."""
    name = "dot_dimension_numbers"
    batch = operation.part(name, f"{side}_batching_dimensions")
    summed = operation.part(name, f"{side}_contracting_dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in (*batch, *summed)]
    groups = (batch, kept, summed)
    sizes = [math.prod(x.shape[axis] for axis in axes) for axes in groups]
    return x.positions.transpose(*batch, *kept, *summed).reshape(sizes)


@rule
def _reduce(operation: Operation, *operands: Tensor) -> list[Tensor]:
    x = operands[0]
    axes = operation.integers("dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in axes]
    positions = x.positions.transpose(*kept, *axes)
    groups = positions.reshape(math.prod(operation.shape), -1)
    return _reduced(operation, operands, groups)


def _reduced(
    operation: Operation, operands: Sequence[Tensor], groups: Iterable[Iterable[Any]]
) -> list[Tensor]:
    """The results of a reduction by the operation's region, such as an addition.

    The first half of the `operands` are arrays of the same shape, and the second half the
    initial values for each of them. The region combines one entry of each array, since the
    result of one array may depend on the others: `argmax` reduces an array together with
    its indices.

    For each entry of a result, in row-major order, `groups` has the positions of the
    entries that are reduced to it.
    """
    num_arrays = len(operands) // 2
    arrays = operands[:num_arrays]
    totals = []
    for positions in groups:
        total = operands[num_arrays:]
        for position in positions:
            entries = [scalar(x.entries[position]) for x in arrays]
            total = operation.run(ONLY_REGION, [*total, *entries])
        totals.append([x.item() for x in total])
    return [Tensor(entries, operation.shape) for entries in zip(*totals)]


@rule
def _reduce_window(operation: Operation, *operands: Tensor) -> list[Tensor]:
    """Cumulative sums, and other reductions of windows."""
    if any(size > 1 for size in operation.integers("base_dilations")):
        raise operation.refusal("with a base dilation")
    x = operands[0]
    sizes = operation.integers("window_dimensions")
    # Strides from window to window, and distances between entries of a window, are 1 along
    # each axis if there is no such attribute.
    strides = np.array(operation.integers("window_strides") or 1)
    distances = np.array(operation.integers("window_dilations") or 1)
    # For each axis, the padding before and after.
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
        # Entries in the padding are left out, as XLA does. In the specification they are
        # the initial value, which makes no difference if this value is neutral.
        inside = [i for i in indices if np.all((i >= 0) & (i < x.shape))]
        groups.append([x.positions[tuple(index)] for index in inside])
    return _reduced(operation, operands, groups)


@rule
def _sort(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """A stable bubble sort along one axis. Several arrays of the same shape are sorted
    together: some of them may be the keys of the others."""
    axis = operation.integer("dimension")
    length = xs[0].shape[axis]
    if length > _MOST_SORTED:
        raise operation.refusal(f"of more than {_MOST_SORTED} numbers")
    arrays = [[*x.entries] for x in xs]
    for positions in np.moveaxis(xs[0].positions, axis, -1).reshape(-1, length):
        # Each round moves the largest of the entries before `end` to the last of them.
        for end in range(length, 1, -1):
            for left, right in itertools.pairwise(positions[:end]):
                # The region takes two entries of each array, and returns whether the first
                # of the two must stand before the second. It gets the right one as the
                # first: for equal entries it returns false, so that they are not exchanged.
                pairs = [scalar(array[i]) for array in arrays for i in (right, left)]
                (right_comes_first,) = operation.run(ONLY_REGION, pairs)
                is_wrong_order = right_comes_first.item()
                for array in arrays:
                    new_left = dr.select(is_wrong_order, array[right], array[left])
                    array[right] = dr.select(is_wrong_order, array[left], array[right])
                    array[left] = new_left
    return [Tensor(entries, x.shape) for entries, x in zip(arrays, xs)]
