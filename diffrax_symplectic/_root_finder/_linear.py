"""Linear systems with the Jacobian of the stage equations."""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Scalar

from .._custom_types import IntScalarLike


_Vector: TypeAlias = Float[Array, " n"]
_Map: TypeAlias = Callable[[_Vector], _Vector]
Solver: TypeAlias = lx.AbstractLinearSolver[Any] | None

# Up to so many unknowns a matrix costs no more than products with it do.
_MAX_DENSE = 32
# Up to so many unknowns elimination is written out; its length grows with the cube.
MAX_WRITTEN_OUT = 4
# Restarted GMRES: so many directions, and how far the residual is reduced. A correction of
# Newton's method needs no more accuracy than the next one makes up for.
_DIRECTIONS = 20
REDUCTION = 1e-3


def correction(
    fn: Callable[[_Vector], tuple[_Vector, Any]], x: _Vector, solver: Solver
) -> tuple[_Vector, _Vector, Bool[Array, ""], Any]:
    """The value of `fn` at `x`, the correction that Newton's method subtracts from `x`,
    whether it was found, and the auxiliary output of `fn`."""
    if solver is not None or x.size > _MAX_DENSE:
        value, derivative, aux = jax.linearize(fn, x, has_aux=True)
        return value, *solve(derivative, value, solver), aux
    # So that a program has `fn` only once.
    both = lambda v: jax.jvp(fn, (x,), (v,), has_aux=True)
    value, matrix, aux = jax.vmap(both, out_axes=(None, 1, None))(_units(x))
    return value, _eliminate(matrix, value), jnp.array(True), aux


def solve(
    apply: _Map, rhs: _Vector, solver: Solver, reduction: float = REDUCTION
) -> tuple[_Vector, Bool[Array, ""]]:
    """The `x` with `apply(x) = rhs`, and whether it was found, by a solver of Lineax. If
    that is `None`, by elimination, or for many unknowns by GMRES with this `reduction` of
    the residual. If there is none, `x` is inexact or not finite: nothing is raised."""
    if solver is None and rhs.size <= _MAX_DENSE:
        matrix = jax.vmap(apply, out_axes=1)(_units(rhs))
        return _eliminate(matrix, rhs), jnp.array(True)
    if solver is None:
        solver = lx.GMRES(reduction, reduction, restart=_DIRECTIONS)
    # An absolute tolerance refers to a right-hand side of size one.
    size = _size(rhs)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    x, result, _ = solver.compute(solver.init(operator, {}), rhs / size, {})
    return x * size, result == lx.RESULTS.successful


def _units(x: _Vector) -> Any:
    # XLA folds what is made of constants, and of `jnp.eye` it would not.
    return np.eye(x.size, dtype=x.dtype)


def _size(rhs: _Vector) -> Scalar:
    size = optx.max_norm(rhs)
    return jnp.where(size > 0, size, 1)


def _eliminate(matrix: Float[Array, "n n"], rhs: _Vector) -> _Vector:
    """The solution of a linear system, by elimination with partial pivoting. By operations
    of XLA: LAPACK takes a call for each matrix of a batch, and 0.1 s to load."""
    n = len(rhs)
    if n > MAX_WRITTEN_OUT:
        rows = jnp.concatenate([matrix, rhs[:, None]], axis=1)
        return lax.fori_loop(0, n, _clear_column, rows)[:, n]
    # XLA keeps what has been divided in memory. Otherwise the right-hand side is made anew
    # in each entry of what is written out: with four unknowns 0.1 s more to compile.
    size = _size(rhs)
    rows = [[*row, x] for row, x in zip(matrix, rhs / size)]
    for k in range(n):
        for i in range(k + 1, n):
            # The largest pivot comes up by comparisons of two rows.
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            upper = [jnp.where(swap, b, a) for a, b in zip(rows[k], rows[i])]
            lower = [jnp.where(swap, a, b) for a, b in zip(rows[k], rows[i])]
            rows[k], rows[i] = upper, lower
        scale = 1 / rows[k][k]
        rows[k] = [scale * x for x in rows[k]]
        for i in {*range(n)} - {k}:
            rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k])]
    return size * jnp.stack([row[n] for row in rows])


def _clear_column(k: IntScalarLike, rows: Float[Array, "n m"]) -> Float[Array, "n m"]:
    place = jnp.arange(len(rows))
    i = jnp.argmax(jnp.where(place < k, -1, jnp.abs(rows[:, k])))
    pivot = rows[i] / rows[i, k]
    rows = rows.at[i].set(rows[k])
    return (rows - rows[:, k, None] * pivot).at[k].set(pivot)
