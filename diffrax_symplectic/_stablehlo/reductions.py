"""Operations that combine entries of an array: products of matrices, sums, sorting.

The *position* of an entry is its index in the flat list `x.entries` of all entries of an
array `x`. `x.positions` has the shape of `x` and holds the position of each entry.
"""

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
    """A batch of products of matrices: each entry of the result is the inner product of a
    row of `a` and a column of `b`."""
    # Of shapes (batch, rows, summed) and (batch, columns, summed).
    positions_in_a = _positions_by_axis_group(operation, a, side="lhs")
    positions_in_b = _positions_by_axis_group(operation, b, side="rhs")
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
    # Dr.Jit replaces a product with a constant zero by zero, even if the other factor is
    # infinite or NaN, and the product should be NaN. The next lines add 0, or NaN if one of
    # these products should be NaN. (Complex numbers are left as Dr.Jit has them, as in
    # `complex.py`.)
    if dr.is_float_v(dtype) and not dr.is_complex_v(dtype):
        total = total + _zero_or_nan(factors=row, others=column)
        total = total + _zero_or_nan(factors=column, others=row)
    for x, y in zip(row, column):
        total = dr.fma(x, y, total)
    return total


def _zero_or_nan(factors: Sequence[Any], others: Sequence[Any]) -> Any:
    """What to add to a sum of products so that it becomes NaN where it should. If one of
    the `factors` is a constant zero, this is NaN in the lanes where any of the `others` is
    infinite or NaN. Otherwise it is 0. Constants among the `others` are taken to be finite.
    """
    unknown = [x for x in others if not is_literal(x)]
    if not unknown or not any(map(is_zero, factors)):
        return 0
    # The difference of a sum and itself is zero, or NaN if one of its terms is infinite or
    # NaN. The sum is over all unknown numbers, even those whose factor is not zero: so it
    # is the same for all rows of a sparse matrix, and Dr.Jit computes it once.
    total = ft.reduce(operator.add, unknown)
    return total - total


def _positions_by_axis_group(operation: Operation, x: Tensor, side: str) -> np.ndarray:
    """The positions of the entries of an operand `x` of `dot_general`, as an array of shape
    (batch, kept, summed). In it each group of axes of `x` is merged into one axis: the axes
    of the batch, those that the result keeps, and those that are summed over. `side` is
    `lhs` or `rhs`, as in the names of MLIR."""
    axes_of = ft.partial(operation.integers_of_field, "dot_dimension_numbers")
    batch = axes_of(f"{side}_batching_dimensions")
    summed = axes_of(f"{side}_contracting_dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in (*batch, *summed)]
    groups = (batch, kept, summed)
    sizes = [math.prod(x.shape[axis] for axis in axes) for axes in groups]
    return x.positions.transpose(*batch, *kept, *summed).reshape(sizes)


@rule
def _reduce(operation: Operation, *operands: Tensor) -> list[Tensor]:
    """Sums, and other reductions along whole axes."""
    x = operands[0]
    axes = operation.integers("dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in axes]
    positions = x.positions.transpose(*kept, *axes)
    # A row for each entry of the result.
    groups = positions.reshape(math.prod(operation.shape), -1)
    return _reduced(operation, operands, groups)


def _reduced(
    operation: Operation, operands: Sequence[Tensor], groups: Iterable[Iterable[Any]]
) -> list[Tensor]:
    """The results of a reduction of one or more arrays of the same shape together. (So
    `argmax` reduces an array together with its indices.)

    - `operands` are the arrays, followed by an initial value for each array.
    - `groups` has, for each entry of a result in row-major order, the positions of the
        entries that are reduced to it.

    The operation's region, such as an addition, maps the totals so far and an entry of each
    array to the next totals.
    """
    num_arrays = len(operands) // 2
    arrays = operands[:num_arrays]
    initial_values = operands[num_arrays:]
    totals_of_groups = []
    for positions in groups:
        totals = initial_values
        for position in positions:
            entries = [scalar(x.entries[position]) for x in arrays]
            totals = operation.run(ONLY_REGION, [*totals, *entries])
        totals_of_groups.append([x.item() for x in totals])
    # Transposed, these are the entries of each result.
    return [Tensor(entries, operation.shape) for entries in zip(*totals_of_groups)]


@rule
def _reduce_window(operation: Operation, *operands: Tensor) -> list[Tensor]:
    """Cumulative sums, and other reductions of windows: parts of an array, all of the same
    size."""
    if any(size > 1 for size in operation.integers("base_dilations")):
        raise operation.refusal("with a base dilation")
    x = operands[0]
    sizes = operation.integers("window_dimensions")
    # Strides from window to window, and distances between entries of a window, are 1 along
    # each axis if there is no such attribute.
    strides = np.array(operation.integers("window_strides") or 1)
    distances = np.array(operation.integers("window_dilations") or 1)
    # Two numbers for each axis, the padding before and after. Without the attribute, both
    # are zero along all axes.
    padding = operation.integers("padding") or [0, 0]
    padding_before = np.array(padding[::2])
    groups = []
    for window in np.ndindex(*operation.shape):
        first_index = np.array(window) * strides - padding_before
        positions = []
        for offset in np.ndindex(*sizes):
            index = first_index + np.array(offset) * distances
            # Entries in the padding are left out, as XLA does. In the specification they
            # are the initial value, which makes no difference if this value is neutral.
            if np.all((index >= 0) & (index < x.shape)):
                positions.append(x.positions[tuple(index)])
        groups.append(positions)
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
        # Each round moves the largest of the first `end` entries to the end of them.
        for end in range(length, 1, -1):
            for left, right in itertools.pairwise(positions[:end]):
                # The region takes two entries of each array, and returns whether the first
                # of the two must stand before the second. Here the right entry is passed
                # first: for equal entries the region returns false, so that they are not
                # exchanged.
                pairs = [scalar(array[i]) for array in arrays for i in (right, left)]
                (right_comes_first,) = operation.run(ONLY_REGION, pairs)
                is_wrong_order = right_comes_first.item()
                for array in arrays:
                    new_left = dr.select(is_wrong_order, array[right], array[left])
                    array[right] = dr.select(is_wrong_order, array[left], array[right])
                    array[left] = new_left
    return [Tensor(entries, x.shape) for entries, x in zip(arrays, xs)]
