"""Small dense linear algebra: what JAX calls LAPACK for on CPUs.

Matrices are lists of rows, with an entry for all paths each. Everything is written out:
between loops of Dr.Jit values go through memory, which costs more than operations.
"""

import math
import re
from collections.abc import Callable
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
    """The factors of `P A = L U` in one matrix, as `getrf` gives them, and for each column
    the row that was exchanged with it, counted from one."""
    rows = [[*row] for row in a]
    num_columns = len(rows[0]) if rows else 0
    index = array_types()["i32"]
    pivots = []
    for column in range(min(len(rows), num_columns)):
        rows_below = range(column + 1, len(rows))
        # The number of the row with the largest entry of the column, from the diagonal
        # down. It differs between paths.
        largest = dr.abs(rows[column][column])
        pivot = index(column)
        for below in rows_below:
            size = dr.abs(rows[below][column])
            is_larger = size > largest
            largest = dr.select(is_larger, size, largest)
            pivot = dr.select(is_larger, index(below), pivot)
        pivots.append(pivot + 1)
        # Rows in registers cannot be read by this number. So each row below is exchanged
        # with the one on the diagonal in those lanes where it is the pivot.
        old_top = rows[column]
        top = old_top
        for below in rows_below:
            is_pivot = pivot == below
            row = rows[below]
            rows[below] = _where(is_pivot, old_top, row)
            top = _where(is_pivot, row, top)
        rows[column] = top
        # Multiples of that row make the entries below zero, and are stored in their place.
        # If the pivot is zero, so is all that is below it.
        inverse = dr.select(top[column] == 0, 0, 1 / top[column])
        for below in rows_below:
            row = rows[below]
            factor = row[column] * inverse
            rest = _minus_multiple(row[column + 1 :], factor, top[column + 1 :])
            rows[below] = [*row[:column], factor, *rest]
    return rows, pivots


def _where(mask: Any, row: list[Any], other: list[Any]) -> list[Any]:
    """One row where a mask is true, and another elsewhere."""
    return [dr.select(mask, x, y) for x, y in zip(row, other)]


def _minus_multiple(row: list[Any], factor: Any, other: list[Any]) -> list[Any]:
    """`row - factor * other`."""
    return [dr.fma(-factor, y, x) for x, y in zip(row, other)]


def _cholesky(a: Matrix) -> tuple[Matrix, Any]:
    """The lower factor of `A = L L^T`, and the mask of the lanes in which `A` is not
    positive definite. Reads the lower triangle, and leaves the upper one.

    Column by column, from the entries `a` of `A` and `l` of `L`, with sums over `k < j`:

        l_jj = sqrt(a_jj - sum l_jk^2)
        l_ij = (a_ij - sum l_ik l_jk) / l_jj
    """
    rows = [[*row] for row in a]
    failed = array_types()["i1"](False)
    for j, row in enumerate(rows):
        square = row[j]
        for k in range(j):
            square = dr.fma(-row[k], row[k], square)
        # The comparison is false for NaN, too.
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
    """The solution of `A X = B`. Reads one triangle of `A`, the lower or the upper one,
    and with `is_unit` takes its diagonal for ones."""
    n = len(a)
    rows_of_solution: dict[int, list[Any]] = {}
    # From the row with a single unknown on, each row has one more.
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


# The functions below are called as LAPACK's are, without the letter for the type of
# numbers. Their arguments are the matrices with which JAX calls these, and their results
# the entries of each array that these return.


def _getrf(operation: Operation, a: Matrix) -> list[list[Any]]:
    """The factors of `P A = L U`, the exchanges of rows, and `info`."""
    factors, pivots = _lu(a)
    # LAPACK reports arguments that it does not take by a negative `info`, and pivots of
    # zero by a positive one. JAX looks for the first only, which do not occur here.
    return [_entries(factors), pivots, [array_types()["i32"](0)]]


def _potrf(operation: Operation, a: Matrix) -> list[list[Any]]:
    """Cholesky's factor of a positive definite matrix, and `info`."""
    is_upper = operation.letter("uplo") == "U"
    # The upper factor U of `A = U^T U` is the transpose of the lower one.
    factor, failed = _cholesky(_transposed(a) if is_upper else a)
    # JAX only compares `info` with zero, so that any other number stands for failure.
    info = dr.select(failed, array_types()["i32"](1), 0)
    return [_entries(_transposed(factor) if is_upper else factor), [info]]


def _trsm(operation: Operation, a: Matrix, b: Matrix) -> list[list[Any]]:
    """The solution of a triangular system, with the matrix on either side."""
    is_lower = operation.letter("uplo") == "L"
    is_on_the_right = operation.letter("side") == "R"
    # `X A = B` is `A^T X^T = B^T`. So the matrix is transposed if it is on the right or
    # LAPACK is asked to transpose it, but not for both.
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
    """A call of LAPACK, for which operations on entries stand in. All axes but the last two
    are a batch of matrices."""
    target = call_target(operation.mlir_op)
    # By this call, older versions of JAX say on which devices an array is.
    if target == "Sharding":
        return list(xs)
    # The first letter of LAPACK's name says the precision, single or double.
    match = re.fullmatch("lapack_[sd](.*)_ffi", target)
    if match is None or match[1] not in _LAPACK:
        raise NotReplayed(operation.mlir_op, f"a call of `{target}`")
    batches = []
    for x in xs:
        # The larger side, since right-hand sides may be many, too: `inv` has as many as
        # unknowns.
        if max(x.shape[-2:]) > _MOST_UNKNOWNS:
            what = f"`{target}` with more than {_MOST_UNKNOWNS} unknowns"
            raise NotReplayed(operation.mlir_op, what)
        places = x.places.reshape(math.prod(x.shape[:-2]), *x.shape[-2:])
        batches.append([[x.take(row).entries for row in matrix] for matrix in places])
    # For each matrix of the batch, the entries of each array that LAPACK returns.
    results = [
        _LAPACK[match[1]](operation, *matrices)
        for matrices in zip(*batches, strict=True)
    ]
    # For each array, the entries of all matrices.
    arrays = zip(*results)
    return [
        Tensor(_entries(list(entries)), shape)
        for entries, shape in zip(arrays, operation.shapes)
    ]
