"""Linear systems with the Jacobian of the stage equations."""

import functools as ft
from collections.abc import Callable
from typing import Any, cast, TypeAlias

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float


_Vector: TypeAlias = Float[Array, " n"]
_Matrix: TypeAlias = Float[Array, "n n"]
_Map: TypeAlias = Callable[[_Vector], _Vector]
Solver: TypeAlias = lx.AbstractLinearSolver[Any] | None

# Up to so many unknowns a matrix costs no more than products with it do.
_MAX_DENSE = 32
# Up to so many unknowns elimination is written out; its length grows with the cube.
MAX_WRITTEN_OUT = 4
# Up to so many columns a product is written out: for two that saves up to a fifth of a
# step, and for three nothing.
_MAX_SUMMED = 2
# Restarted GMRES: so many directions, and how far the residual is reduced. A correction of
# Newton's method needs no more accuracy than the next one makes up for.
_DIRECTIONS = 20
REDUCTION = 1e-3


def matrix_of(apply: _Map, n: int, dtype) -> _Matrix:
    """The matrix of a linear map."""
    # XLA folds what is made of constants, and of `jnp.eye` it would not.
    return jax.vmap(apply, out_axes=1)(cast(Array, np.eye(n, dtype=dtype)))


def inverse(matrix: _Matrix) -> _Matrix:
    """The inverse of a matrix near the identity, by Gauss-Jordan elimination without
    exchanging rows. What this spoils is seen when the equations are not solved.

    LAPACK takes a call for each matrix of a batch, and here XLA fuses all of it.
    """
    n = len(matrix)

    def eliminate(k, matrix):
        here = np.arange(n) == k
        row = jnp.where(here, 1, matrix[k]) / matrix[k, k]
        column = jnp.where(here, 0, matrix[:, k])
        others = jnp.where(here, 0, matrix) - column[:, None] * row
        return jnp.where(here[:, None], row, others)

    if n <= MAX_WRITTEN_OUT:
        return ft.reduce(lambda matrix, k: eliminate(k, matrix), range(n), matrix)
    return lax.fori_loop(0, n, eliminate, matrix)


def product(matrix: _Matrix, x: _Vector) -> _Vector:
    """`matrix @ x`. Of few columns XLA fuses their sum with what `x` is made of, as it does
    no product of matrices."""
    if len(x) > _MAX_SUMMED:
        return matrix @ x
    return ft.reduce(jnp.add, [column * entry for column, entry in zip(matrix.T, x)])


def _eliminate(matrix: _Matrix, rhs: _Vector) -> _Vector:
    """The solution of a linear system, by elimination with partial pivoting."""
    n = len(rhs)
    if n > MAX_WRITTEN_OUT:
        # On CPUs JAX makes a permutation of LAPACK's pivots by a loop with ten kernels for
        # each row, which takes several times as long as this does.
        Q, R = jnp.linalg.qr(matrix)
        return jax.scipy.linalg.solve_triangular(R, Q.T @ rhs)
    # Rows as lists of scalars: XLA sees straight-line arithmetic and fuses all of it.
    rows = [[*matrix[i], rhs[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            # The largest pivot comes up by comparisons of two rows.
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            upper = [jnp.where(swap, b, a) for a, b in zip(rows[k], rows[i])]
            lower = [jnp.where(swap, a, b) for a, b in zip(rows[k], rows[i])]
            rows[k], rows[i] = upper, lower
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [b - factor * a for a, b in zip(rows[k], rows[i])]
    solution = [rhs[0]] * n
    for i in reversed(range(n)):
        known = sum((rows[i][j] * solution[j] for j in range(i + 1, n)), 0.0)
        solution[i] = (rows[i][n] - known) / rows[i][i]
    return jnp.stack(solution)


def solve(
    apply: _Map, rhs: _Vector, solver: Solver, reduction: float = REDUCTION
) -> tuple[_Vector, Bool[Array, ""]]:
    """The `x` with `apply(x) = rhs`, and whether it was found, by a solver of Lineax. If
    that is `None`, by elimination, or for many unknowns by GMRES with this `reduction` of
    the residual. If there is none, `x` is inexact or not finite: nothing is raised."""
    # An absolute tolerance refers to a right-hand side of size one.
    size = optx.max_norm(rhs)
    size = jnp.where(size > 0, size, 1)
    if solver is None and rhs.size > _MAX_DENSE:
        solver = lx.GMRES(reduction, reduction, restart=_DIRECTIONS)
    if solver is None:
        matrix = matrix_of(apply, rhs.size, rhs.dtype)
        return _eliminate(matrix, rhs / size) * size, jnp.array(True)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    x, result, _ = solver.compute(solver.init(operator, {}), rhs / size, {})
    return x * size, result == lx.RESULTS.successful
