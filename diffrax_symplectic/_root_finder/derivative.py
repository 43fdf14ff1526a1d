"""Derivatives of a solution, by implicit differentiation."""

from collections.abc import Callable

import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._batch import where_pending
from .linear import MAX_WRITTEN_OUT, solve, Solver
from .sweeps import sweep
from .tolerance import Tolerance


# Derivatives are solved to rounding error, as steps are by default.
_TOLERANCE = Tolerance(None, 0.0, optx.max_norm)
_MOST_SWEEPS = 200


def differentiate(
    solver: Solver, linear: Callable[[PyTree], PyTree], rhs: PyTree[Array]
) -> PyTree[Array]:
    r"""The tangent $x = L x + b$ of the solution of $k = \Phi(k)$, where $L$ is the
    derivative of $\Phi$ along $k$ and $b$ the derivative along everything else; and by
    transposition its adjoint.

    Up to four unknowns are solved for by elimination, and more by `solver` if there is one.
    Otherwise the sweeps that solved the step are used: they converge if those did.
    Stragglers are gathered from the batch, and their systems are solved one by one.
    """
    # As one vector: JAX cannot transpose a solve if only some arrays of the right-hand side
    # depend on the differentiated inputs.
    flat, unravel = jfu.ravel_pytree(rhs)

    def by(operator: Callable[[Array], Array], b: Float[Array, " n"]) -> Array:
        if b.size <= MAX_WRITTEN_OUT or solver is not None:
            return solve(operator, b, solver)[0]
        image = lambda x: x + (b - operator(x))
        zero, yes = jnp.zeros_like(b), jnp.array(True)
        found, solved = sweep(_TOLERANCE, _MOST_SWEEPS, image, lambda x: x, zero, yes)
        reduction = float(jnp.finfo(b.dtype).eps) ** 0.9
        exactly = lambda _: solve(operator, b, None, reduction)[0]
        return where_pending(exactly, ~solved, found)

    operator = lambda x: x - jfu.ravel_pytree(linear(unravel(x)))[0]
    return unravel(lax.custom_linear_solve(operator, flat, by, by))
