"""Small dense linear algebra: operations for which JAX calls LAPACK on CPUs.

A matrix is a list of rows, whose entries are Dr.Jit arrays with a lane for each path. All
loops are unrolled, since values that go from one loop of Dr.Jit to another go through
memory, which costs more than operations.
"""

import math
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from .backend import array_types, dr
from .mlir import call_target
from .operation import NotReplayed, Operation, rule
from .tensor import Tensor


# Larger matrices take long to compile.
_MOST_UNKNOWNS = 16

# A list of rows, whose entries are Dr.Jit arrays.
Matrix: TypeAlias = list[list[Any]]


def _lu(a: Matrix) -> tuple[Matrix, list[Any]]:
    """Gaussian elimination with partial pivoting. Returns what LAPACK's `getrf` does:

    - the factors of `P A = L U` in one matrix, without the ones on the diagonal of L;
    - the exchanges of rows that make up `P`: the `k`-th number is the number of the row,
        counted from one, that was exchanged with row `k`.
    """
    rows = [[*row] for row in a]
    num_columns = len(rows[0]) if rows else 0
    pivots = []
    for column in range(min(len(rows), num_columns)):
        rows_below = range(column + 1, len(rows))
        pivot = _row_of_pivot(rows, column)
        pivots.append(pivot + 1)
        # 1. Exchange the row on the diagonal and the row of the pivot. The number of this
        # row differs between lanes, and rows in registers cannot be read by a number. So
        # each row below is exchanged in the lanes where it is the row of the pivot.
        old_top = rows[column]
        top = old_top
        for below in rows_below:
            is_pivot = pivot == below
            row = rows[below]
            rows[below] = _where(is_pivot, old_top, row)
            top = _where(is_pivot, row, top)
        rows[column] = top
        # 2. From each row below, subtract the multiple of the row on the diagonal that
        # makes the entry in this column zero. The factor, an entry of L, is stored in place
        # of the zero. If the pivot is zero, the entries below are zero already.
        inverse = dr.select(top[column] == 0, 0, 1 / top[column])
        for below in rows_below:
            row = rows[below]
            factor = row[column] * inverse
            rest = _minus_multiple(row[column + 1 :], factor, top[column + 1 :])
            rows[below] = [*row[:column], factor, *rest]
    return rows, pivots


def _row_of_pivot(rows: Matrix, column: int) -> Any:
    """In each lane, the number of the row with the largest absolute value in this column,
    from the diagonal down."""
    int32 = array_types()["i32"]
    largest = dr.abs(rows[column][column])
    pivot = int32(column)
    for below in range(column + 1, len(rows)):
        size = dr.abs(rows[below][column])
        is_larger = size > largest
        largest = dr.select(is_larger, size, largest)
        pivot = dr.select(is_larger, int32(below), pivot)
    return pivot


def _where(mask: Any, row: list[Any], other: list[Any]) -> list[Any]:
    """`row` in the lanes where the mask is true, and `other` in the remaining lanes."""
    return [dr.select(mask, x, y) for x, y in zip(row, other)]


def _minus_multiple(row: list[Any], factor: Any, other: list[Any]) -> list[Any]:
    """`row - factor * other`."""
    return [dr.fma(-factor, y, x) for x, y in zip(row, other)]


def _cholesky(a: Matrix) -> tuple[Matrix, Any]:
    """The lower factor of `A = L L^T`, and the mask of the lanes in which `A` is not
    positive definite. Reads the lower triangle of `A` only, and returns its upper triangle
    above `L`.

    The factor is computed column by column, with sums over `k < j`:

        l_jj = sqrt(a_jj - sum l_jk^2)
        l_ij = (a_ij - sum l_ik l_jk) / l_jj
    """
    rows = [[*row] for row in a]
    failed = array_types()["i1"](False)
    for j, row in enumerate(rows):
        square = row[j]
        for k in range(j):
            square = dr.fma(-row[k], row[k], square)
        # With `~`, NaN is marked as well: its comparison is false.
        failed = failed | ~(square > 0)
        row[j] = dr.sqrt(square)
        # One division for the whole column.
        inverse = 1 / row[j]
        for below in rows[j + 1 :]:
            entry = below[j]
            for k in range(j):
                entry = dr.fma(-below[k], row[k], entry)
            below[j] = entry * inverse
    return rows, failed


def _solve_triangular(a: Matrix, b: Matrix, is_lower: bool, is_unit: bool) -> Matrix:
    """The solution of `A X = B` by substitution, row by row: with sums over the rows `j`
    that are solved already, `x_i = (b_i - sum a_ij x_j) / a_ii`.

    Reads one triangle of `A`, the lower or the upper one. With `is_unit`, ones are taken in
    place of the diagonal.
    """
    n = len(a)
    rows_of_solution: dict[int, list[Any]] = {}
    # Solved first is the row with a single unknown. Each further row has one more.
    for i in range(n) if is_lower else reversed(range(n)):
        row = b[i]
        for j, solved_row in rows_of_solution.items():
            row = _minus_multiple(row, a[i][j], solved_row)
        if not is_unit:
            inverse = 1 / a[i][i]
            row = [entry * inverse for entry in row]
        rows_of_solution[i] = row
    return [rows_of_solution[i] for i in range(n)]


def _transposed(a: Matrix) -> Matrix:
    return [[*column] for column in zip(*a)]


def _entries(a: Matrix) -> list[Any]:
    return [entry for row in a for entry in row]


# The functions below stand for LAPACK's functions of the same names (without LAPACK's
# letter for the type of numbers). Their arguments are the matrices that JAX passes to
# LAPACK. They return a list for each array that LAPACK returns, with the entries of the
# array.


def _getrf(operation: Operation, a: Matrix) -> list[list[Any]]:
    """The factors of `P A = L U`, the exchanges of rows, and `info`."""
    factors, pivots = _lu(a)
    # LAPACK's `info` is negative for invalid arguments, which do not occur here, and
    # positive for pivots of zero, which JAX does not look for. So zero serves always.
    return [_entries(factors), pivots, [array_types()["i32"](0)]]


def _potrf(operation: Operation, a: Matrix) -> list[list[Any]]:
    """The Cholesky factor of a positive definite matrix, and `info`."""
    is_upper = operation.letter("uplo") == "U"
    # The upper factor U of `A = U^T U` is the transpose of the lower one.
    factor, failed = _cholesky(_transposed(a) if is_upper else a)
    # JAX only compares `info` with zero: any other number means failure.
    info = dr.select(failed, array_types()["i32"](1), 0)
    return [_entries(_transposed(factor) if is_upper else factor), [info]]


def _trsm(operation: Operation, a: Matrix, b: Matrix) -> list[list[Any]]:
    """The solution of a triangular system `A X = B` or `X A = B`, where JAX may ask for the
    transpose of `A` in its place."""
    is_lower = operation.letter("uplo") == "L"
    is_on_the_right = operation.letter("side") == "R"
    # `X A = B` is the same as `A^T X^T = B^T`. So `A` is transposed if it is on the right,
    # or if JAX asks for the transpose. If both hold, the two transposes cancel.
    is_transposed = (operation.letter("trans_x") != "N") != is_on_the_right
    x = _solve_triangular(
        _transposed(a) if is_transposed else a,
        _transposed(b) if is_on_the_right else b,
        # The transpose of a lower triangle is an upper one.
        is_lower=is_lower != is_transposed,
        is_unit=operation.letter("diag") == "U",
    )
    return [_entries(_transposed(x) if is_on_the_right else x)]


_LAPACK: dict[str, Callable[..., list[list[Any]]]] = {
    "getrf": _getrf,
    "potrf": _potrf,
    "trsm": _trsm,
}


@rule
def _custom_call(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """Does the work of a call of LAPACK, by operations on entries. Each array is a matrix
    or, with more than two axes, a batch of matrices in the last two."""
    target = call_target(operation.mlir_op)
    # By a call of `Sharding`, older versions of JAX say on which devices an array is.
    if target == "Sharding":
        return list(xs)
    # The letter before the function's name says the precision, single or double.
    match = re.fullmatch("lapack_[sd](.*)_ffi", target)
    if match is None or match[1] not in _LAPACK:
        raise NotReplayed(operation.mlir_op, f"a call of `{target}`")
    # All matrices have at most this many rows and columns, also those of right-hand sides:
    # `inv` has as many right-hand sides as unknowns.
    if any(max(x.shape[-2:]) > _MOST_UNKNOWNS for x in xs):
        what = f"`{target}` with more than {_MOST_UNKNOWNS} unknowns"
        raise NotReplayed(operation.mlir_op, what)
    function = _LAPACK[match[1]]
    batches = [_matrices(x) for x in xs]
    # For each element of the batch, the entries of each array that LAPACK returns.
    results = [function(operation, *element) for element in zip(*batches, strict=True)]
    # Transposed: for each array that LAPACK returns, its entries in each element.
    arrays = zip(*results)
    return [
        Tensor(_entries(list(entries)), shape)
        for entries, shape in zip(arrays, operation.shapes)
    ]


def _matrices(x: Tensor) -> list[list[Sequence[Any]]]:
    """The rows of each matrix of a batch. (`x.positions` has the shape of `x`, and holds
    the index of each entry in the list of all entries.)"""
    positions = x.positions.reshape(math.prod(x.shape[:-2]), *x.shape[-2:])
    return [[x.take(row).entries for row in matrix] for matrix in positions]
