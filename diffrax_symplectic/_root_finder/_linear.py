"""Linear systems with the Jacobian of the stage equations."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from equinox.internal import ω
from jaxtyping import Array, PyTree

from . import _krylov
from ._small_lu import SmallLU


# Up to so many unknowns elimination costs no more than products with the matrix do.
MAX_DENSE = 4

_Linear = Callable[[PyTree[Array]], PyTree[Array]]


def solve(
    apply: _Linear,
    rhs: PyTree[Array],
    linear_solver: lx.AbstractLinearSolver[Any] | None,
) -> PyTree[Array]:
    """The `x` with `apply(x) = rhs`, or something that is not finite, or inexact, if there
    is none: nothing is raised. By `linear_solver`, or if that is `None` by elimination for
    a few unknowns and by GMRES, which needs no matrix, for more."""
    if linear_solver is None and sum(x.size for x in jtu.tree_leaves(rhs)) > MAX_DENSE:
        flat, unravel = jfu.ravel_pytree(rhs)
        return unravel(
            _krylov.gmres(lambda x: jfu.ravel_pytree(apply(unravel(x)))[0], flat)
        )
    linear_solver = SmallLU() if linear_solver is None else linear_solver
    # An absolute tolerance refers to a right-hand side of size one.
    size = optx.max_norm(rhs)
    size = jnp.where(size > 0, size, 1)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    state: Any = linear_solver.init(operator, {})
    x, *_ = linear_solver.compute(state, (rhs**ω / size).ω, {})
    return (x**ω * size).ω
