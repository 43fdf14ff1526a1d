"""Small dense linear algebra: what JAX calls LAPACK for on CPUs.

Matrices are lists of rows, with an entry for all paths each. Everything is written out:
between loops of Dr.Jit values go through memory, which costs more than operations.
"""

import math
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
    pivots = []
    for column in range(min(len(rows), num_columns)):
        pivot = _number_of_pivot_row(rows, column)
        _exchange_with_pivot_row(rows, column, pivot)
        _eliminate_below(rows, column)
        pivots.append(pivot + 1)
    return rows, pivots


def _number_of_pivot_row(rows: Matrix, column: int) -> Any:
    """The number of the row with the largest entry of a column, from the diagonal down. It
    differs between paths."""
    index = array_types()["i32"]
    largest = dr.abs(rows[column][column])
    pivot = index(column)
    for below in range(column + 1, len(rows)):
        size = dr.abs(rows[below][column])
        is_larger = size > largest
        largest = dr.select(is_larger, size, largest)
        pivot = dr.select(is_larger, index(below), pivot)
    return pivot


def _exchange_with_pivot_row(rows: Matrix, top: int, pivot: Any) -> None:
    """Exchanges the row number `top` with row `pivot`, which is the same or one below."""
    # The number of the pivot differs between paths, and rows in registers cannot be read by
    # a number. So each row below is exchanged in those lanes where it is the pivot.
    old_top = rows[top]
    new_top = old_top
    for below in range(top + 1, len(rows)):
        is_pivot = pivot == below
        row = rows[below]
        rows[below] = _where(is_pivot, old_top, row)
        new_top = _where(is_pivot, row, new_top)
    rows[top] = new_top


def _eliminate_below(rows: Matrix, column: int) -> None:
    """Subtracts multiples of the row on the diagonal from those below, so that their
    entries in this column become zero, and stores the factors in place of these zeros."""
    top = rows[column]
    # If the pivot is zero, so is all that is below it.
    inverse = dr.select(top[column] == 0, 0, 1 / top[column])
    for below in range(column + 1, len(rows)):
        row = rows[below]
        factor = row[column] * inverse
        rest = _minus_multiple(row[column + 1 :], factor, top[column + 1 :])
        rows[below] = [*row[:column], factor, *rest]


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


def _matrices(operation: Operation, x: Tensor) -> list[Matrix]:
    """The matrices of a batch, whose last two axes are theirs. Raises a `NotReplayed` if
    they are too large."""
    *batch, num_rows, num_columns = x.shape
    # `inv` has as many right-hand sides as unknowns.
    if max(num_rows, num_columns) > _MOST_UNKNOWNS:
        target = call_target(operation.mlir_op)
        what = f"`{target}` with more than {_MOST_UNKNOWNS} unknowns"
        raise NotReplayed(operation.mlir_op, what)
    places = x.places.reshape(math.prod(batch), num_rows, num_columns)
    return [
        [[x.entries[place] for place in row] for row in matrix] for matrix in places
    ]


def _tensor_of(matrices: list[Matrix], shape: tuple[int, ...]) -> Tensor:
    """The inverse of `_matrices`."""
    entries = [entry for matrix in matrices for row in matrix for entry in row]
    return Tensor(entries, shape)


# The functions below are called as LAPACK's are, without the letter for the type of
# numbers. Their arguments and results are those with which JAX calls these.


def _getrf(operation: Operation, x: Tensor) -> list[Tensor]:
    """The factors of `P A = L U`, the exchanges of rows, and `info`."""
    factors = []
    pivots = []
    for matrix in _matrices(operation, x):
        factors_of_matrix, pivots_of_matrix = _lu(matrix)
        factors.append(factors_of_matrix)
        pivots.extend(pivots_of_matrix)
    _, shape_of_pivots, shape_of_info = operation.shapes
    # LAPACK reports arguments that it does not take by a negative `info`, and pivots of
    # zero by a positive one. JAX looks for the first only, which do not occur here.
    success = array_types()["i32"](0)
    return [
        _tensor_of(factors, x.shape),
        Tensor(pivots, shape_of_pivots),
        Tensor([success] * len(factors), shape_of_info),
    ]


def _potrf(operation: Operation, x: Tensor) -> list[Tensor]:
    """Cholesky's factor of a positive definite matrix, and `info`."""
    is_upper = operation.letter("uplo") == "U"
    factors = []
    info = []
    for matrix in _matrices(operation, x):
        # The upper factor U of `A = U^T U` is the transpose of the lower one.
        factor, failed = _cholesky(_transposed(matrix) if is_upper else matrix)
        factors.append(_transposed(factor) if is_upper else factor)
        # JAX only compares `info` with zero, so that any other number stands for failure.
        info.append(dr.select(failed, array_types()["i32"](1), 0))
    _, shape_of_info = operation.shapes
    return [_tensor_of(factors, x.shape), Tensor(info, shape_of_info)]


def _trsm(operation: Operation, a: Tensor, b: Tensor) -> list[Tensor]:
    """The solution of a triangular system, with the matrix on either side."""
    is_lower = operation.letter("uplo") == "L"
    is_unit = operation.letter("diag") == "U"
    is_on_the_right = operation.letter("side") == "R"
    # `X A = B` is `A^T X^T = B^T`. So the matrix is transposed if it is on the right or
    # LAPACK is asked to transpose it, but not for both.
    is_transposed = (operation.letter("trans_x") != "N") != is_on_the_right
    solutions = []
    pairs = zip(_matrices(operation, a), _matrices(operation, b), strict=True)
    for matrix, rhs in pairs:
        x = _solve_triangular(
            _transposed(matrix) if is_transposed else matrix,
            _transposed(rhs) if is_on_the_right else rhs,
            # The transpose of a lower triangle is an upper one.
            is_lower=is_lower != is_transposed,
            is_unit=is_unit,
        )
        solutions.append(_transposed(x) if is_on_the_right else x)
    return [_tensor_of(solutions, b.shape)]


_LAPACK: dict[str, Callable[..., list[Tensor]]] = {
    "getrf": _getrf,
    "potrf": _potrf,
    "trsm": _trsm,
}


@rule
def _custom_call(operation: Operation, *xs: Tensor) -> list[Tensor]:
    target = call_target(operation.mlir_op)
    # By this call, older versions of JAX say on which devices an array is.
    if target == "Sharding":
        return list(xs)
    # The first letter of LAPACK's name says the precision, single or double.
    for letter in ("s", "d"):
        for name, fn in _LAPACK.items():
            if target == f"lapack_{letter}{name}_ffi":
                return fn(operation, *xs)
    raise NotReplayed(operation.mlir_op, f"a call of `{target}`")
