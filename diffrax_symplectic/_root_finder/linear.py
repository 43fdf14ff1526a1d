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

# Up to this many unknowns, a matrix costs no more than matrix-vector products.
_MAX_DENSE = 32
# Up to this many unknowns, elimination is unrolled; the code grows with their cube.
MAX_WRITTEN_OUT = 4
# Restarted GMRES: the number of directions, and the reduction of the residual. The next
# Newton correction makes up for the error of this one.
_DIRECTIONS = 20
REDUCTION = 1e-3


def correction(
    fn: _Map, x: _Vector, solver: Solver
) -> tuple[_Vector, _Vector, Bool[Array, ""]]:
    """The value of `fn` at `x`, the Newton correction to subtract from `x`, and whether it
    was found."""
    if solver is not None or x.size > _MAX_DENSE:
        value, derivative = jax.linearize(fn, x)
        return value, *solve(derivative, value, solver)
    # With `jvp` the compiled program contains `fn` only once.
    both = lambda v: jax.jvp(fn, (x,), (v,))
    value, matrix = jax.vmap(both, out_axes=(None, 1))(_units(x))
    return value, eliminate(matrix, value), jnp.array(True)


def solve(
    apply: _Map, rhs: _Vector, solver: Solver, reduction: float = REDUCTION
) -> tuple[_Vector, Bool[Array, ""]]:
    """Solves `apply(x) = rhs` for `x`, and returns whether that succeeded. `solver` is a
    Lineax solver; `None` is elimination, or for many unknowns GMRES with this `reduction`
    of the residual. On failure `x` is inexact or not finite, and nothing is raised."""
    if solver is None and rhs.size <= _MAX_DENSE:
        matrix = jax.vmap(apply, out_axes=1)(_units(rhs))
        return eliminate(matrix, rhs), jnp.array(True)
    if solver is None:
        solver = lx.GMRES(reduction, reduction, restart=_DIRECTIONS)
    # Absolute tolerances assume a right-hand side of size one.
    size = _size(rhs)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    x, result, _ = solver.compute(solver.init(operator, {}), rhs / size, {})
    return x * size, result == lx.RESULTS.successful


def _units(x: _Vector) -> Any:
    # A NumPy constant, which XLA folds, unlike `jnp.eye`.
    return np.eye(x.size, dtype=x.dtype)


def _size(rhs: _Vector) -> Scalar:
    size = optx.max_norm(rhs)
    return jnp.where(size > 0, size, 1)


def eliminate(matrix: Float[Array, "n n"], rhs: _Vector) -> _Vector:
    """Solves a linear system by elimination with partial pivoting, in XLA operations:
    LAPACK needs a call for each matrix of a batch, and 0.1 s to load."""
    n = len(rhs)
    if n > MAX_WRITTEN_OUT:
        rows = jnp.concatenate([matrix, rhs[:, None]], axis=1)
        return lax.fori_loop(0, n, _clear_column, rows)[:, n]
    # The division makes XLA store the right-hand side. Otherwise it would be recomputed in
    # each unrolled entry, which takes 0.1 s more to compile for four unknowns.
    size = _size(rhs)
    rows = [[*row, x] for row, x in zip(matrix, rhs / size)]
    for k in range(n):
        for i in range(k + 1, n):
            # Pairwise swaps bring up the row with the largest pivot.
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
