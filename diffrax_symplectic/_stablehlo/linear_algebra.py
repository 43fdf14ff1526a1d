"""Small dense linear algebra: what JAX calls LAPACK for on CPUs.

Matrices are lists of rows, with an entry for all paths each. Everything is written out:
between loops of Dr.Jit values go through memory, which costs more than operations.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

from .backend import array_types, drjit
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
    for k in range(min(len(rows), len(rows[0]))):
        largest = dr.abs(rows[k][k])
        pivot = index(k)
        for i in range(k + 1, len(rows)):
            size = dr.abs(rows[i][k])
            larger = size > largest
            largest = dr.select(larger, size, largest)
            pivot = dr.select(larger, index(i), pivot)
        top = rows[k]
        for i in range(k + 1, len(rows)):
            here = pivot == i
            row = rows[i]
            rows[i] = [dr.select(here, old, x) for old, x in zip(rows[k], row)]
            top = [dr.select(here, x, y) for x, y in zip(row, top)]
        rows[k] = top
        # Below a pivot of zero are zeros.
        inverse = dr.select(top[k] == 0, 0, 1 / top[k])
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] * inverse
            rest = [
                dr.fma(-factor, y, x) for x, y in zip(rows[i][k + 1 :], top[k + 1 :])
            ]
            rows[i] = [*rows[i][:k], factor, *rest]
        pivots.append(pivot + 1)
    return rows, pivots


def _cholesky(a: Matrix) -> tuple[Matrix, Any]:
    """The lower factor of `A = L L^T`, and where `A` is not positive definite. Reads the
    lower triangle, and leaves the upper one."""
    dr = drjit()
    rows = [[*row] for row in a]
    failed = array_types()["i1"](False)
    for j, row in enumerate(rows):
        square = row[j]
        for k in range(j):
            square = dr.fma(-row[k], row[k], square)
        # Also if it is NaN.
        failed = failed | ~(square > 0)
        row[j] = dr.sqrt(square)
        inverse = 1 / row[j]
        for below in rows[j + 1 :]:
            entry = below[j]
            for k in range(j):
                entry = dr.fma(-below[k], row[k], entry)
            below[j] = entry * inverse
    return rows, failed


def _solve_triangular(a: Matrix, b: Matrix, lower: bool, unit: bool) -> Matrix:
    """The solution of `A X = B`."""
    dr = drjit()
    n = len(a)
    solved: dict[int, list[Any]] = {}
    for i in range(n) if lower else reversed(range(n)):
        row = b[i]
        for j, known in solved.items():
            row = [dr.fma(-a[i][j], y, x) for x, y in zip(row, known)]
        if not unit:
            inverse = 1 / a[i][i]
            row = [x * inverse for x in row]
        solved[i] = row
    return [solved[i] for i in range(n)]


def _transposed(a: Matrix) -> Matrix:
    return [[*column] for column in zip(*a)]


def _matrices(o: Operation, x: Tensor) -> list[Matrix]:
    """The matrices of a batch."""
    rows, columns = x.shape[-2:]
    # `inv` has as many right-hand sides as unknowns.
    if max(rows, columns) > _MOST_UNKNOWNS:
        what = f"`{_target(o)}` with more than {_MOST_UNKNOWNS} unknowns"
        raise NotReplayed(o.op, what)
    places = x.places.reshape(-1, rows, columns)
    return [[[x.entries[i] for i in row] for row in matrix] for matrix in places]


def _tensor(matrices: list[Matrix], shape: tuple[int, ...]) -> Tensor:
    return Tensor([x for a in matrices for row in a for x in row], shape)


def _target(o: Operation) -> str:
    return o.op.attributes["call_target_name"].value


def _letter(o: Operation, name: str) -> str:
    """An argument of LAPACK, such as `U` for an upper triangle."""
    return chr(o.op.attributes["mhlo.backend_config"][name].value)


def _getrf(o: Operation, x: Tensor) -> list[Tensor]:
    done = [_lu(a) for a in _matrices(o, x)]
    _, pivots, info = o.shapes()
    # JAX asks `info` for arguments that LAPACK does not take, not for pivots of zero.
    fine = array_types()["i32"](0)
    return [
        _tensor([factors for factors, _ in done], x.shape),
        Tensor([p for _, own in done for p in own], pivots),
        Tensor([fine] * len(done), info),
    ]


def _potrf(o: Operation, x: Tensor) -> list[Tensor]:
    upper = _letter(o, "uplo") == "U"
    turned = _transposed if upper else lambda a: a
    done = [_cholesky(turned(a)) for a in _matrices(o, x)]
    factors = [turned(factor) for factor, _ in done]
    # JAX asks whether `info` is zero.
    info = [drjit().select(lost, array_types()["i32"](1), 0) for _, lost in done]
    return [_tensor(factors, x.shape), Tensor(info, o.shapes()[1])]


def _trsm(o: Operation, a: Tensor, b: Tensor) -> list[Tensor]:
    lower = _letter(o, "uplo") == "L"
    unit = _letter(o, "diag") == "U"
    right = _letter(o, "side") == "R"
    # X A = B is A^T X^T = B^T.
    turns = (_letter(o, "trans_x") != "N") != right
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
    name = _target(o)
    for letter in ("s", "d"):
        for call, fn in _CALLS.items():
            if name == f"lapack_{letter}{call}_ffi":
                return fn(o, *xs)
    raise NotReplayed(o.op, f"a call of `{name}`")
