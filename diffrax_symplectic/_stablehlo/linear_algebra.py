"""Small dense linear algebra: what JAX calls LAPACK for on CPUs.

Matrices are lists of rows, with an entry for all paths each. Everything is written out:
between loops of Dr.Jit values go through memory, which costs more than operations.
"""

import math
from collections.abc import Callable
from typing import Any, TypeAlias

from .backend import array_types, drjit
from .mlir import call_target
from .operation import NotReplayed, Operation, rule
from .tensor import Tensor


# Larger matrices take long to compile.
_MOST_UNKNOWNS = 16

Matrix: TypeAlias = list[list[Any]]


def _lu(a: Matrix) -> tuple[Matrix, list[Any]]:
    """The factors of `P A = L U` in one matrix, as `getrf` gives them, and for each column
    the row that was exchanged with it, counted from one."""
    dr = drjit()
    index = array_types()["i32"]
    rows = [[*row] for row in a]
    pivots = []
    for step in range(min(len(rows), len(rows[0]) if rows else 0)):
        # The row of the largest entry in what is left of the column, which differs between
        # paths.
        largest = dr.abs(rows[step][step])
        pivot = index(step)
        for below in range(step + 1, len(rows)):
            size = dr.abs(rows[below][step])
            larger = size > largest
            largest = dr.select(larger, size, largest)
            pivot = dr.select(larger, index(below), pivot)
        # Rows have no address within a kernel: any row below may be the one to exchange
        # with the first, and becomes the top one then.
        first = rows[step]
        top = first
        for below in range(step + 1, len(rows)):
            is_pivot = pivot == below
            row = rows[below]
            rows[below] = _where(is_pivot, first, row)
            top = _where(is_pivot, row, top)
        rows[step] = top
        # If the pivot is zero, so is all that is below it.
        inverse = dr.select(top[step] == 0, 0, 1 / top[step])
        for below in range(step + 1, len(rows)):
            row = rows[below]
            factor = row[step] * inverse
            rest = _minus_multiple(row[step + 1 :], factor, top[step + 1 :])
            rows[below] = [*row[:step], factor, *rest]
        pivots.append(pivot + 1)
    return rows, pivots


def _where(mask: Any, row: list[Any], other: list[Any]) -> list[Any]:
    """One row where a mask is true, and another elsewhere."""
    return [drjit().select(mask, entry, old) for entry, old in zip(row, other)]


def _minus_multiple(row: list[Any], factor: Any, other: list[Any]) -> list[Any]:
    """A row less a multiple of another."""
    return [drjit().fma(-factor, entry, old) for old, entry in zip(row, other)]


def _cholesky(a: Matrix) -> tuple[Matrix, Any]:
    """The lower factor of `A = L L^T`, and where `A` is not positive definite. Reads the
    lower triangle, and leaves the upper one."""
    dr = drjit()
    rows = [[*row] for row in a]
    failed = array_types()["i1"](False)
    for column, row in enumerate(rows):
        square = row[column]
        for k in range(column):
            square = dr.fma(-row[k], row[k], square)
        # The comparison is false for NaN, too.
        failed = failed | ~(square > 0)
        row[column] = dr.sqrt(square)
        # One division for the whole column.
        inverse = 1 / row[column]
        for below in rows[column + 1 :]:
            entry = below[column]
            for k in range(column):
                entry = dr.fma(-below[k], row[k], entry)
            below[column] = entry * inverse
    return rows, failed


def _solve_triangular(a: Matrix, b: Matrix, lower: bool, unit: bool) -> Matrix:
    """The solution of `A X = B`. Reads one triangle of `A`, and with `unit` takes its
    diagonal for ones."""
    n = len(a)
    solved: dict[int, list[Any]] = {}
    # From the row with a single unknown on, each row has one more.
    for i in range(n) if lower else reversed(range(n)):
        row = b[i]
        for j, known in solved.items():
            row = _minus_multiple(row, a[i][j], known)
        if not unit:
            inverse = 1 / a[i][i]
            row = [entry * inverse for entry in row]
        solved[i] = row
    return [solved[i] for i in range(n)]


def _transposed(a: Matrix) -> Matrix:
    return [[*column] for column in zip(*a)]


def _matrices(o: Operation, x: Tensor) -> list[Matrix]:
    """The matrices of a batch."""
    rows, columns = x.shape[-2:]
    # `inv` has as many right-hand sides as unknowns.
    if max(rows, columns) > _MOST_UNKNOWNS:
        what = f"`{call_target(o.op)}` with more than {_MOST_UNKNOWNS} unknowns"
        raise NotReplayed(o.op, what)
    places = x.places.reshape(math.prod(x.shape[:-2]), rows, columns)
    return [[[x.entries[i] for i in row] for row in matrix] for matrix in places]


def _tensor(matrices: list[Matrix], shape: tuple[int, ...]) -> Tensor:
    """The inverse of `_matrices`."""
    return Tensor([entry for a in matrices for row in a for entry in row], shape)


def _getrf(o: Operation, x: Tensor) -> list[Tensor]:
    factors = []
    pivots = []
    for matrix in _matrices(o, x):
        factors_of_matrix, pivots_of_matrix = _lu(matrix)
        factors.append(factors_of_matrix)
        pivots.extend(pivots_of_matrix)
    _, shape_of_pivots, shape_of_info = o.shapes()
    # JAX asks `info` for arguments that LAPACK does not take, not for pivots of zero.
    success = array_types()["i32"](0)
    return [
        _tensor(factors, x.shape),
        Tensor(pivots, shape_of_pivots),
        Tensor([success] * len(factors), shape_of_info),
    ]


def _potrf(o: Operation, x: Tensor) -> list[Tensor]:
    upper = o.letter("uplo") == "U"
    factors = []
    info = []
    for matrix in _matrices(o, x):
        # The upper factor U of `A = U^T U` is the transpose of the lower one.
        factor, failed = _cholesky(_transposed(matrix) if upper else matrix)
        factors.append(_transposed(factor) if upper else factor)
        # JAX asks whether `info` is zero.
        info.append(drjit().select(failed, array_types()["i32"](1), 0))
    _, shape_of_info = o.shapes()
    return [_tensor(factors, x.shape), Tensor(info, shape_of_info)]


def _trsm(o: Operation, a: Tensor, b: Tensor) -> list[Tensor]:
    lower = o.letter("uplo") == "L"
    unit = o.letter("diag") == "U"
    right = o.letter("side") == "R"
    # The matrix is on the right in `X A = B`, which is `A^T X^T = B^T`. So it is transposed
    # for either of `trans_x` and `right`, but not for both.
    turns = (o.letter("trans_x") != "N") != right
    out = []
    for matrix, rhs in zip(_matrices(o, a), _matrices(o, b), strict=True):
        rhs = _transposed(rhs) if right else rhs
        matrix = _transposed(matrix) if turns else matrix
        x = _solve_triangular(matrix, rhs, lower != turns, unit)
        out.append(_transposed(x) if right else x)
    return [_tensor(out, b.shape)]


# LAPACK's names without the letter for the type of numbers.
_CALLS: dict[str, Callable[..., list[Tensor]]] = {
    "getrf": _getrf,
    "potrf": _potrf,
    "trsm": _trsm,
}


@rule
def _custom_call(o, *xs):
    name = call_target(o.op)
    for letter in ("s", "d"):
        for call, fn in _CALLS.items():
            if name == f"lapack_{letter}{call}_ffi":
                return fn(o, *xs)
    raise NotReplayed(o.op, f"a call of `{name}`")
