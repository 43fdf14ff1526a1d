from collections.abc import Iterator
from typing import Any, TypeAlias

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jaxtyping import Array, PyTree

from .._compat import (
    pack_structures,
    PackedStructures,
    ravel_vector,
    transpose_packed_structures,
    unravel_solution,
)


# Up to this size elimination is written out; its length grows with the cube.
_MAX_UNROLLED = 4

_State: TypeAlias = tuple[Array, PackedStructures]


class SmallLU(lx.AbstractLinearSolver[_State]):
    """Direct elimination (with partial pivoting), written out for small systems.

    A batched call to LAPACK costs far more than the arithmetic of a 2 x 2 system and
    cannot be fused with what surrounds it. Here a system of up to four unknowns is a
    handful of elementwise operations. Larger ones go to `jax.numpy.linalg.solve`.

    This solver can only handle square nonsingular operators.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        del options
        if operator.in_size() != operator.out_size():
            raise ValueError(
                "`SmallLU` may only be used for linear solves with square matrices."
            )
        return _matrix(operator), pack_structures(operator)

    def compute(
        self, state: _State, vector: PyTree[Array], options: dict[str, Any]
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        del options
        matrix, structures = state
        rhs = ravel_vector(vector, structures)
        if len(matrix) <= _MAX_UNROLLED:
            solution = _solve_unrolled(matrix, rhs)
        else:
            solution = jnp.linalg.solve(matrix, rhs)
        return unravel_solution(solution, structures), lx.RESULTS.successful, {}

    def transpose(self, state: _State, options: dict[str, Any]):
        matrix, structures = state
        return (matrix.T, transpose_packed_structures(structures)), options

    def conj(self, state: _State, options: dict[str, Any]):
        matrix, structures = state
        return (matrix.conj(), structures), options

    def assume_full_rank(self) -> bool:
        return True


def _matrix(operator: lx.AbstractLinearOperator) -> Array:
    """The matrix of an operator, column by column."""
    structure = operator.in_structure()
    column = lambda unit: jfu.ravel_pytree(operator.mv(unit))[0]
    if operator.in_size() <= _MAX_UNROLLED:
        return jnp.stack([column(unit) for unit in _units(structure)], axis=1)
    return operator.as_matrix()


def _units(structure: PyTree[jax.ShapeDtypeStruct]) -> Iterator[PyTree[Array]]:
    """Unit vectors as constants of the program, which XLA can simplify."""
    leaves, treedef = jtu.tree_flatten(structure)
    for i, leaf in enumerate(leaves):
        for index in np.ndindex(leaf.shape):
            unit = [jnp.zeros(s.shape, s.dtype) for s in leaves]
            one = np.zeros(leaf.shape, leaf.dtype)
            one[index] = 1
            # Made by operations, to have the type of what is traced (under `shard_map`).
            unit[i] = unit[i] + one
            yield treedef.unflatten(unit)


def _solve_unrolled(matrix: Array, rhs: Array) -> Array:
    n = len(rhs)
    if n == 2:
        # Cramer's rule: no worse here than elimination, and no comparisons.
        (a, b), (c, d) = matrix
        x, y = rhs
        det = a * d - b * c
        return jnp.stack([(d * x - b * y) / det, (a * y - c * x) / det])
    # Rows as lists of scalars: XLA sees straight-line arithmetic and fuses all of it.
    rows = [[matrix[i, j] for j in range(n)] + [rhs[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            # Bring the largest pivot up by comparing neighbours, column by column.
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
