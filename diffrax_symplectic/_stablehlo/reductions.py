"""Operations that combine entries of an array: products of matrices, sums, sorting."""

import functools as ft
import itertools
import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from .._compat import is_literal
from .backend import drjit
from .complex import is_complex
from .elementwise import is_zero
from .operation import NotReplayed, Operation, rule
from .tensor import known, Tensor


# The most numbers to sort: exchanges grow with the square of the number.
_MOST_SORTED = 16


def _multiplied_and_added(a: Any, b: Any, c: Any) -> Any:
    """`a b + c`, in one operation if it can be."""
    real = drjit().is_float_v(c) and not is_complex(c)
    return drjit().fma(a, b, c) if real else a * b + c


@rule
def _dot_general(o, a, b):
    left = _matrices(o, a, "lhs")
    right = _matrices(o, b, "rhs")
    _, rows, _ = left.shape
    batch, columns, _ = right.shape
    # Products and sums have the type of the result, to which other numbers are converted.
    a_entries = [x if type(x) is o.kind else o.kind(x) for x in a.entries]
    b_entries = [x if type(x) is o.kind else o.kind(x) for x in b.entries]
    out = []
    for k, row, column in np.ndindex(batch, rows, columns):
        ours = [a_entries[i] for i in left[k, row]]
        theirs = [b_entries[j] for j in right[k, column]]
        total = o.kind(0)
        if drjit().is_float_v(total) and not is_complex(total):
            total = total + _left_out(ours, theirs) + _left_out(theirs, ours)
        for x, y in zip(ours, theirs):
            total = _multiplied_and_added(x, y, total)
        out.append(total)
    return [Tensor(out, o.shape)]


def _left_out(factors: Sequence[Any], others: Sequence[Any]) -> Any:
    """The sum of the products that Dr.Jit leaves out, those with a zero that is known while
    the kernel is recorded: zero, or NaN if the other factor may be infinite."""
    unknown = [x for x in others if not is_literal(x)]
    if not unknown or not any(map(is_zero, factors)):
        return 0
    # The sum is over all unknown factors, not those beside zeros alone: so it is the same
    # for all rows of a sparse matrix, which stay cheap.
    total = ft.reduce(operator.add, unknown)
    return total - total


def _matrices(o: Operation, x: Tensor, side: str) -> np.ndarray:
    """The places of a factor of `dot_general`: with an axis for the products, one for what
    stays, and one to sum over."""
    name = "dot_dimension_numbers"
    batch = o.part(name, f"{side}_batching_dimensions")
    summed = o.part(name, f"{side}_contracting_dimensions")
    kept = [axis for axis in range(len(x.shape)) if axis not in (*batch, *summed)]
    groups = (batch, kept, summed)
    sizes = [math.prod(x.shape[axis] for axis in axes) for axes in groups]
    return x.places.transpose(*batch, *kept, *summed).reshape(sizes)


@rule
def _reduce(o, *xs):
    # Several arrays may be reduced together, such as values and places for `argmax`.
    # First come the arrays, then where each reduction starts.
    num_arrays = len(xs) // 2
    arrays = xs[:num_arrays]
    starts = xs[num_arrays:]
    shape = arrays[0].shape
    axes = o.ints("dimensions")
    kept = [axis for axis in range(len(shape)) if axis not in axes]
    sizes = [shape[axis] for axis in kept]
    rows = arrays[0].places.transpose(*kept, *axes).reshape(math.prod(sizes), -1)
    neutral = _changes_nothing(o, starts)
    columns = []
    for row in rows:
        parts = [_entries_at(arrays, place) for place in row]
        # Most reductions start from a neutral element, such as zero in a sum.
        total = parts.pop(0) if parts and neutral else [*starts]
        for part in parts:
            total = o.run(0, [*total, *part])
        columns.append(total)
    return _join_columns(columns, tuple(sizes), num_arrays)


def _entries_at(arrays: Sequence[Tensor], place: Any) -> list[Tensor]:
    """The entries of all these arrays at a place, each as an array without axes."""
    return [Tensor([x.entries[place]], ()) for x in arrays]


def _join_columns(
    columns: list[list[Tensor]], shape: tuple[int, ...], num_arrays: int
) -> list[Tensor]:
    """Arrays of this shape from `columns`, each of which has an entry of each array."""
    arrays = []
    for k in range(num_arrays):
        entries = [column[k].item() for column in columns]
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


def _changes_nothing(o: Operation, starts: Sequence[Tensor]) -> bool:
    """Whether a reduction starts from the neutral element of its operation."""
    if len(starts) > 1:
        return False
    value = known(starts[0])
    repeated = o.reduces_by
    if value is None or repeated is None:
        return False
    if repeated == "and":
        # The neutral element has all bits set, which the integer 1 has not.
        return bool(~value == 0)
    return bool(value == _NEUTRAL.get(repeated))


@rule
def _reduce_window(o, *xs):
    """Cumulative sums, and other reductions of windows."""
    num_arrays = len(xs) // 2
    arrays = xs[:num_arrays]
    initial = xs[num_arrays:]
    if any(size > 1 for size in o.optional("base_dilations")):
        raise NotReplayed(o.op, f"`{o.op.name}` of entries that are apart")
    shape = arrays[0].shape
    ones = [1] * len(shape)
    sizes = o.ints("window_dimensions")
    strides = o.optional("window_strides") or ones
    gaps = o.optional("window_dilations") or ones
    # Pairs of the padding before and after. What lies outside is left out, as XLA does. The
    # specification has the initial value there, which is the same if it is neutral.
    padding = o.rows("padding") if o.has("padding") else np.zeros((len(shape), 2), int)
    before = padding.reshape(len(shape), 2)[:, 0]
    columns = []
    for window in np.ndindex(*o.shape):
        total = [*initial]
        for offset in np.ndindex(*sizes):
            at = np.array(window) * strides + np.array(offset) * gaps - before
            if np.all((at >= 0) & (at < shape)):
                place = arrays[0].places[tuple(at)]
                total = o.run(0, [*total, *_entries_at(arrays, place)])
        columns.append(total)
    return _join_columns(columns, o.shape, num_arrays)


@rule
def _sort(o, *xs):
    """Exchanges of neighbours until all are in order, which keep the order of equals."""
    axis = o.number("dimension")
    length = xs[0].shape[axis]
    if length > _MOST_SORTED:
        raise NotReplayed(o.op, f"`{o.op.name}` of more than {_MOST_SORTED} numbers")
    select = drjit().select
    # Arrays that are sorted together: the first ones may be keys of the others.
    outs = [[*x.entries] for x in xs]
    for row in np.moveaxis(xs[0].places, axis, -1).reshape(-1, length):
        # After each round the largest of those left is at their end.
        for end in range(length, 1, -1):
            for left, right in itertools.pairwise(row[:end]):
                # The region says whether the first of two must stand before the second, and
                # takes both of each array in turn. The right one is asked about first: they
                # are exchanged only if the right one must stand first, so equals stay.
                pairs = [Tensor([x[i]], ()) for x in outs for i in (right, left)]
                (answer,) = o.run(0, pairs)
                is_wrong = answer.item()
                for x in outs:
                    first = select(is_wrong, x[right], x[left])
                    x[right] = select(is_wrong, x[left], x[right])
                    x[left] = first
    return [Tensor(out, x.shape) for out, x in zip(outs, xs)]
