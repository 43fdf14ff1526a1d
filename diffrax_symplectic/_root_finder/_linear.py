"""Linear systems with the Jacobian of the stage equations."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from equinox.internal import ω
from jaxtyping import Array, PyTree

from ._small_lu import SmallLU


# Up to so many unknowns a dense matrix takes less memory than the vectors of GMRES.
MAX_DENSE = 16

_Linear = Callable[[PyTree[Array]], PyTree[Array]]


def solve(
    apply: _Linear,
    rhs: PyTree[Array],
    linear_solver: lx.AbstractLinearSolver[Any] | None,
) -> PyTree[Array]:
    """The `x` with `apply(x) = rhs`, or something that is not finite, or inexact, if there
    is none: nothing is raised. By `linear_solver`, or if that is `None` by elimination for
    a few unknowns and by GMRES, which needs no matrix, for more."""
    if linear_solver is None:
        few = sum(x.size for x in jtu.tree_leaves(rhs)) <= MAX_DENSE
        linear_solver = SmallLU() if few else _gmres
    # An absolute tolerance refers to a right-hand side of size one.
    size = optx.max_norm(rhs)
    size = jnp.where(size > 0, size, 1)
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: rhs))
    state: Any = linear_solver.init(operator, {})
    x, *_ = linear_solver.compute(state, (rhs**ω / size).ω, {})
    return (x**ω * size).ω


# A correction needs no more accuracy than the next one can make up for: each reduces the
# error by about 1e-3. The basis of GMRES is what the emergency costs in memory.
_gmres = lx.GMRES(rtol=1e-3, atol=1e-3, restart=10, stagnation_iters=4)
