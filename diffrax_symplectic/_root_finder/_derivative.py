"""The derivative of a solution, as the linear equation that defines it."""

from collections.abc import Callable

import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._batch import where_pending
from ._linear import MAX_WRITTEN_OUT, solve, Solver
from ._sweeps import sweep
from ._tolerance import Tolerance


# A derivative is solved to rounding error, as the step is by default.
_TOLERANCE = Tolerance(None, 0.0, optx.max_norm)
_MOST_SWEEPS = 200


def differentiate(
    solver: Solver, linear: Callable[[PyTree], PyTree], rhs: PyTree[Array]
) -> PyTree[Array]:
    r"""The tangent $x = L x + b$ of the solution of $k = \Phi(k)$, for the derivatives $L$
    of $\Phi$ along $k$ and $b$ along everything else; and by transposition its adjoint.

    Up to four unknowns by elimination, by `solver` if there is one, and otherwise by the
    iterations that solved the step: they converge where those did. Where they do not, the
    stragglers are gathered from the batch, and their systems solved one by one.
    """
    # As one vector: JAX cannot transpose a solve in whose right-hand side some arrays
    # depend on what is differentiated and others do not.
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
