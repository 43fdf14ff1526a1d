"""The derivative of what stage equations define."""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, PyTree

from . import _linear
from ._tolerance import ratio


_Vector: TypeAlias = Float[Array, " n"]
_Linear: TypeAlias = Callable[[_Vector], _Vector]

# The most terms of the series, and the size of a term at which it is given up. Before they
# shrink terms may well grow, since positions and momenta differ in scale.
_MOST_TERMS, _DIVERGED = 60, 1e3
# The most cycles of GMRES.
_MOST_CYCLES = 40
# Rounding errors may keep terms above the tolerance by this factor.
_ENOUGH = 50


def differentiate(
    finder: Any, linear: Callable[[PyTree], PyTree], rhs: PyTree[Array]
) -> PyTree[Array]:
    r"""The tangent $x = L x + b$ of the solution of $k = \Phi(k)$, for the derivatives $L$
    of $\Phi$ along $k$ and $b$ along everything else; and by transposition its adjoint.

    Up to four unknowns by elimination, by a `linear_solver` of `finder` if it has one, and
    otherwise by the iteration $x \leftarrow L x + b$. It converges where the one for the
    solution did, and where it does not, GMRES solves the system.
    """
    linear_solver = getattr(finder, "linear_solver", None)
    # As one vector: JAX cannot transpose a solve in whose right-hand side some arrays
    # depend on what is differentiated and others do not.
    flat, unravel = jfu.ravel_pytree(rhs)

    def solve(operator: _Linear, b: _Vector) -> _Vector:
        if b.size <= _linear.MAX_DENSE or linear_solver is not None:
            return _linear.solve(operator, b, linear_solver)
        return _by_series(operator, b)

    operator = lambda x: x - jfu.ravel_pytree(linear(unravel(x)))[0]
    return unravel(lax.custom_linear_solve(operator, flat, solve, solve))


def _by_series(operator: _Linear, b: _Vector) -> _Vector:
    # A derivative is as accurate as the solution: two units in the last place.
    tolerance = 2 * jnp.finfo(b.dtype).eps

    def improve(correct: _Linear):
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
    by_krylov = improve(lambda r: _linear.solve(operator, r, None))
    x, *_ = lax.while_loop(proceed(_MOST_CYCLES), by_krylov, (x, size, 0))
    return x
