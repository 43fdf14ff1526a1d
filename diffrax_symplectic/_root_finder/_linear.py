"""Linear systems with the Jacobian of the stage equations."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from . import _krylov
from ._small_lu import SmallLU


# Up to so many unknowns elimination costs no more than products with the matrix do.
MAX_DENSE = 4


def solve(
    apply: Callable[[Array], Array],
    rhs: Float[Array, " n"],
    linear_solver: lx.AbstractLinearSolver[Any] | None,
) -> Float[Array, " n"]:
    """The `x` with `apply(x) = rhs`, or something that is not finite, or inexact, if there
    is none: nothing is raised. By `linear_solver`, or if that is `None` by elimination for
    a few unknowns and by GMRES, which needs no matrix, for more."""
    if linear_solver is None and rhs.size > MAX_DENSE:
        return _krylov.gmres(apply, rhs)
    return solve_by(linear_solver, apply, rhs)[0]


def solve_by(
    linear_solver: lx.AbstractLinearSolver[Any] | None,
    apply: Callable[[Array], Array],
    rhs: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The same by a solver of Lineax, or elimination, and whether it succeeded."""
    # An absolute tolerance refers to a right-hand side of size one.
    size = optx.max_norm(rhs)
    size = jnp.where(size > 0, size, 1)
    linear_solver = SmallLU() if linear_solver is None else linear_solver
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    state: Any = linear_solver.init(operator, {})
    x, result, _ = linear_solver.compute(state, rhs / size, {})
    return x * size, result == lx.RESULTS.successful
