"""Linear systems with the Jacobian of the stage equations."""

import functools as ft
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Scalar

from .._compat import linear_solution
from .._custom_types import IntScalarLike


_Vector: TypeAlias = Float[Array, " n"]
_Map: TypeAlias = Callable[[_Vector], _Vector]
LinearSolver: TypeAlias = lx.AbstractLinearSolver[Any] | None

# Up to this many unknowns, a matrix costs no more than matrix-vector products.
_MAX_DENSE = 32
# Up to this many unknowns, elimination is unrolled; the code grows with their cube.
MAX_WRITTEN_OUT = 4
# GMRES restarts after this number of directions. By default it reduces the residual by this
# factor only: the next Newton correction makes up for the error.
_DIRECTIONS = 20
REDUCTION = 1e-3


class LinearSolution(NamedTuple):
    """The solution of a linear system.

    - `value`: the unknowns. If they were not found they are inexact, or not finite.
    - `found`: whether the solver succeeded. Elimination always does, with values that are
        not finite if the matrix is singular.
    """

    value: _Vector
    found: Bool[Array, ""]


class NewtonCorrection(NamedTuple):
    """One correction of Newton's method.

    - `residual`: the value of the equations before it.
    - `change`: what to subtract from the iterate.
    - `found`: whether its linear system was solved.
    - `derivative`: the derivative of the equations before it, along a vector.
    """

    residual: _Vector
    change: _Vector
    found: Bool[Array, ""]
    derivative: _Map


def correction(fn: _Map, x: _Vector, solver: LinearSolver) -> NewtonCorrection:
    """The Newton correction for `fn(x) = 0` at `x`. Without a `solver`, small systems are
    solved by elimination."""
    if solver is not None or x.size > _MAX_DENSE:
        value, derivative = jax.linearize(fn, x)
        change, found = solve(derivative, value, solver)
        return NewtonCorrection(value, change, found, derivative)

    # The columns of the Jacobian are the derivatives along unit vectors. `jvp` gives value
    # and column by one evaluation, so that the compiled program contains `fn` once.
    def value_and_column(unit: _Vector) -> tuple[_Vector, _Vector]:
        return jax.jvp(fn, (x,), (unit,))

    value, matrix = jax.vmap(value_and_column, out_axes=(None, 1))(_unit_vectors(x))

    def product(vector: _Vector) -> _Vector:
        # The sum is unrolled, so that XLA fuses it: it reduces short axes slowly on CPUs.
        return ft.reduce(operator.add, vector[:, None] * matrix.T)

    return NewtonCorrection(
        residual=value,
        change=eliminate(matrix, value),
        found=jnp.array(True),
        derivative=product,
    )


def solve(
    apply: _Map, rhs: _Vector, solver: LinearSolver, reduction: float = REDUCTION
) -> LinearSolution:
    """Solves `apply(x) = rhs` for `x`. `solver` is a Lineax solver; `None` is elimination,
    or for many unknowns GMRES with this `reduction` of the residual. Nothing is raised on
    failure."""
    if solver is None and rhs.size <= _MAX_DENSE:
        matrix = jax.vmap(apply, out_axes=1)(_unit_vectors(rhs))
        # A singular matrix shows as entries that are not finite.
        return LinearSolution(eliminate(matrix, rhs), jnp.array(True))
    if solver is None:
        solver = lx.GMRES(reduction, reduction, restart=_DIRECTIONS)
    # Absolute tolerances assume a right-hand side of size one.
    size = _largest_or_one(rhs)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    # `lx.linear_solve`, without its derivatives.
    x, result = linear_solution(solver, operator, rhs / size)
    return LinearSolution(x * size, result == lx.RESULTS.successful)


def solve_matrix(matrix: Float[Array, "n n"], rhs: _Vector) -> _Vector:
    """Solves `matrix @ x = rhs`, differentiably. If the matrix is singular, `x` is not
    finite, or large."""
    # GMRES, too, solves to rounding error here.
    reduction = reduction_to_rounding(rhs.dtype)

    def multiply(x: _Vector) -> _Vector:
        return matrix @ x

    # JAX calls this with `multiply` or its transpose as `apply`.
    def solve_by(
        matrix_or_transpose: Float[Array, "n n"], apply: _Map, rhs: _Vector
    ) -> _Vector:
        if len(matrix_or_transpose) <= _MAX_DENSE:
            return eliminate(matrix_or_transpose, rhs)
        return solve(apply, rhs, solver=None, reduction=reduction).value

    # Derivatives come from the equation: they are solves with the matrix, or in reverse
    # mode with its transpose.
    return lax.custom_linear_solve(
        multiply, rhs, ft.partial(solve_by, matrix), ft.partial(solve_by, matrix.T)
    )


def reduction_to_rounding(dtype: Any) -> float:
    """The reduction of the residual by which GMRES solves to about rounding error. It
    cannot be as small as the rounding errors of one product with the matrix."""
    return float(jnp.finfo(dtype).eps) ** 0.9


def _unit_vectors(x: _Vector) -> Any:
    """The unit vectors, as rows."""
    # A NumPy constant, which XLA folds, unlike `jnp.eye`.
    return np.eye(x.size, dtype=x.dtype)


def _largest_or_one(rhs: _Vector) -> Scalar:
    """The largest absolute value of the entries, or 1 if all are zero, as a divisor."""
    size = optx.max_norm(rhs)
    return jnp.where(size > 0, size, 1)


def eliminate(matrix: Float[Array, "n n"], rhs: _Vector) -> _Vector:
    """Solves a linear system by elimination with partial pivoting, in XLA operations:
    LAPACK needs a call for each matrix of a batch, and 0.1 s to load."""
    num_unknowns = len(rhs)
    if num_unknowns == 1:
        return rhs / matrix[0]
    if num_unknowns > MAX_WRITTEN_OUT:
        augmented = jnp.concatenate([matrix, rhs[:, None]], axis=1)
        cleared = lax.fori_loop(0, num_unknowns, _clear_column, augmented)
        return cleared[:, num_unknowns]
    # The right-hand side is divided by its size, which makes XLA store it. Otherwise XLA
    # would recompute it in each unrolled entry, which takes 0.1 s more to compile for four
    # unknowns.
    size = _largest_or_one(rhs)
    # The rows of the augmented matrix, whose last column is the right-hand side.
    rows = [[*row, entry] for row, entry in zip(matrix, rhs / size)]
    for k in range(num_unknowns):
        _bring_up_pivot(rows, k)
        # One division and a product for each entry take less time than a division for each.
        inverse = 1 / rows[k][k]
        rows[k] = [inverse * entry for entry in rows[k]]
        # Rows above are cleared, too (Gauss-Jordan), in place of a substitution backward.
        for i in {*range(num_unknowns)} - {k}:
            factor = rows[i][k]
            rows[i] = [entry - factor * pivot for entry, pivot in zip(rows[i], rows[k])]
    return size * jnp.stack([row[num_unknowns] for row in rows])


def _bring_up_pivot(rows: list[list[Scalar]], k: int) -> None:
    """Exchanges rows, in place, so that of row `k` and those below, row `k` has the largest
    entry of column `k` by size."""
    # Pairwise swaps are selections, which a batch can do without gathering rows.
    for i in range(k + 1, len(rows)):
        is_larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
        # The entries of both rows, column by column.
        pairs = list(zip(rows[k], rows[i]))
        rows[k] = [jnp.where(is_larger, lower, upper) for upper, lower in pairs]
        rows[i] = [jnp.where(is_larger, upper, lower) for upper, lower in pairs]


def _clear_column(k: IntScalarLike, rows: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """One step of elimination: scales the row with the largest pivot, moves it to row `k`,
    and clears column `k` in all other rows."""
    row_numbers = jnp.arange(len(rows))
    # The rows above row `k` have had their turn. A negative size is never the largest.
    sizes = jnp.where(row_numbers < k, -1, jnp.abs(rows[:, k]))
    pivot_number = jnp.argmax(sizes)
    pivot_row = rows[pivot_number] / rows[pivot_number, k]
    # To exchange the two rows, row `k` is written to the place of the pivot's row here, and
    # the pivot's row to place `k` in the last line. Rows are replaced by selections, which
    # the fused engine replays. It does not replay a scatter to a row that differs between
    # paths.
    with_row_k = jnp.where((row_numbers == pivot_number)[:, None], rows[k], rows)
    cleared = with_row_k - with_row_k[:, k, None] * pivot_row
    return jnp.where((row_numbers == k)[:, None], pivot_row, cleared)
