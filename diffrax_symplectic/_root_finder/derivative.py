"""Derivatives of a solution, by implicit differentiation."""

import functools as ft
from collections.abc import Callable

import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._batch import where_pending
from .linear import LinearSolver, MAX_WRITTEN_OUT, solve
from .sweeps import solve_by_sweeps
from .tolerance import Tolerance


# Derivatives are solved to rounding error, as steps are by default.
_TOLERANCE = Tolerance(rtol=None, atol=0.0, norm=optx.max_norm)
# As many as `PicardNewton` takes by default, for systems with the same rate of convergence.
_MOST_SWEEPS = 200


def differentiate(
    solver: LinearSolver, linear: Callable[[PyTree], PyTree], rhs: PyTree[Array]
) -> PyTree[Array]:
    r"""The tangent $x = L x + b$ of the solution of $k = \Phi(k)$, where $L$ is the
    derivative of $\Phi$ along $k$ and $b$ the derivative along everything else; and by
    transposition its adjoint.

    If there is a `solver`, such as that of `optx.Newton`, it solves for any number of
    unknowns. Without, up to four unknowns are solved for by elimination, and more by the
    sweeps that solved the step: they converge if those did. Stragglers are gathered from
    the batch, and their systems are solved one by one, by elimination or GMRES.
    """
    # As one vector: JAX cannot transpose a solve if only some arrays of the right-hand side
    # depend on the differentiated inputs.
    flat, unravel = jfu.ravel_pytree(rhs)

    def operator(x: Float[Array, " n"]) -> Float[Array, " n"]:
        image, _ = jfu.ravel_pytree(linear(unravel(x)))
        return x - image

    # The same function solves the transposed system, which has the same eigenvalues, so
    # that sweeps converge as fast.
    either = ft.partial(_solve, solver)
    return unravel(lax.custom_linear_solve(operator, flat, either, either))


def _solve(
    solver: LinearSolver,
    operator: Callable[[Array], Array],
    rhs: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The solution of `operator(x) = rhs`, of a system that a step could solve."""
    if rhs.size <= MAX_WRITTEN_OUT or solver is not None:
        return solve(operator, rhs, solver).value

    def image(x: Float[Array, " n"]) -> Float[Array, " n"]:
        return x + (rhs - operator(x))

    def itself(x: Float[Array, " n"]) -> Float[Array, " n"]:
        return x

    found, is_solved = solve_by_sweeps(
        _TOLERANCE,
        _MOST_SWEEPS,
        image,
        itself,
        guess=jnp.zeros_like(rhs),
        pending=jnp.array(True),
    )
    # No Newton correction makes up for the error of GMRES here, so it must be small, but it
    # cannot be as small as the rounding errors of one product.
    reduction = float(jnp.finfo(rhs.dtype).eps) ** 0.9

    def exactly(_: Float[Array, " n"]) -> Float[Array, " n"]:
        return solve(operator, rhs, None, reduction).value

    return where_pending(exactly, ~is_solved, found)
