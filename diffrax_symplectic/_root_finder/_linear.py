"""Linear systems with the Jacobian of the stage equations."""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from . import _krylov
from ._tolerance import ratio


_Vector: TypeAlias = Float[Array, " n"]
_Matrix: TypeAlias = Float[Array, "n n"]
_Map: TypeAlias = Callable[[_Vector], _Vector]
_Solver: TypeAlias = lx.AbstractLinearSolver[Any] | None

# Up to so many unknowns a matrix costs no more than products with it do.
MAX_DENSE = 32
# Up to so many unknowns elimination is written out; its length grows with the cube.
_MAX_WRITTEN_OUT = 4
# The most terms of the series for a derivative, and the size of a term at which it is given
# up. Before they shrink terms may well grow, since positions and momenta differ in scale.
_MOST_TERMS, _DIVERGED = 60, 1e3
# The most cycles of GMRES.
_MOST_CYCLES = 40
# Rounding errors may keep terms above the tolerance by this factor.
_ENOUGH = 50


def matrix_of(apply: _Map, n: int, dtype) -> _Matrix:
    """The matrix of a linear map."""
    return jax.vmap(apply, out_axes=1)(jnp.eye(n, dtype=dtype))


def inverse(matrix: _Matrix) -> _Matrix:
    """The inverse of a matrix near the identity, by Gauss-Jordan elimination without
    exchanging rows. What this spoils is seen when the equations are not solved.

    LAPACK takes a call for each matrix of a batch, and here XLA fuses all of it.
    """
    n = len(matrix)

    def eliminate(k, matrix):
        here = jnp.arange(n) == k
        row = jnp.where(here, 1, matrix[k]) / matrix[k, k]
        column = jnp.where(here, 0, matrix[:, k])
        others = jnp.where(here, 0, matrix) - column[:, None] * row
        return jnp.where(here[:, None], row, others)

    if n <= _MAX_WRITTEN_OUT:
        return ft.reduce(lambda matrix, k: eliminate(k, matrix), range(n), matrix)
    return lax.fori_loop(0, n, eliminate, matrix)


def _eliminate(matrix: _Matrix, rhs: _Vector) -> _Vector:
    """The solution of a linear system, by elimination with partial pivoting."""
    n = len(rhs)
    if n > _MAX_WRITTEN_OUT:
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
    apply: _Map, rhs: _Vector, solver: _Solver
) -> tuple[_Vector, Bool[Array, ""]]:
    """The `x` with `apply(x) = rhs`, and whether it was found, by a solver of Lineax, or if
    that is `None` by elimination. If there is none, `x` is inexact or not finite:
    nothing is raised."""
    # An absolute tolerance refers to a right-hand side of size one.
    size = optx.max_norm(rhs)
    size = jnp.where(size > 0, size, 1)
    if solver is None:
        matrix = matrix_of(apply, rhs.size, rhs.dtype)
        return _eliminate(matrix, rhs / size) * size, jnp.array(True)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    x, result, _ = solver.compute(solver.init(operator, {}), rhs / size, {})
    return x * size, result == lx.RESULTS.successful


def differentiate(
    solver: _Solver, linear: Callable[[PyTree], PyTree], rhs: PyTree[Array]
) -> PyTree[Array]:
    r"""The tangent $x = L x + b$ of the solution of $k = \Phi(k)$, for the derivatives $L$
    of $\Phi$ along $k$ and $b$ along everything else; and by transposition its adjoint.

    Up to four unknowns by elimination, by `solver` if there is one, and otherwise by the
    iteration $x \leftarrow L x + b$. It converges where the one for the solution did, and
    where it does not, GMRES solves the system.
    """
    # As one vector: JAX cannot transpose a solve in whose right-hand side some arrays
    # depend on what is differentiated and others do not.
    flat, unravel = jfu.ravel_pytree(rhs)

    def by(operator: _Map, b: _Vector) -> _Vector:
        if b.size <= _MAX_WRITTEN_OUT or solver is not None:
            return solve(operator, b, solver)[0]
        return _by_series(operator, b)

    operator = lambda x: x - jfu.ravel_pytree(linear(unravel(x)))[0]
    return unravel(lax.custom_linear_solve(operator, flat, by, by))


def _by_series(operator: _Map, b: _Vector) -> _Vector:
    # A derivative is as accurate as the solution: two units in the last place.
    tolerance = 2 * jnp.finfo(b.dtype).eps

    def improve(correct: _Map):
        def body(carry):
            x, _, step = carry
            residual = b - operator(x)
            x = x + correct(residual)
            return x, ratio(optx.max_norm(residual), optx.max_norm(x)), step + 1

        return body

    def proceed(most: int):
        def proceed(carry):
            _, size, step = carry
            return (size > tolerance) & (size < _DIVERGED) & (step < most)

        return proceed

    start = b, jnp.ones_like(tolerance, b.dtype), 0
    x, size, _ = lax.while_loop(proceed(_MOST_TERMS), improve(lambda r: r), start)
    # Where that ended without success, by GMRES from nothing, improved a few times.
    solved = size <= _ENOUGH * tolerance
    x = jnp.where(solved, x, 0)
    size = jnp.where(solved, 0, 1).astype(b.dtype)
    by_krylov = improve(lambda r: _krylov.gmres(operator, r))
    x, *_ = lax.while_loop(proceed(_MOST_CYCLES), by_krylov, (x, size, 0))
    return x
