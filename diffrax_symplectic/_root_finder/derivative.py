"""Derivatives of a solution, by implicit differentiation."""

import functools as ft
from collections.abc import Callable

import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._batch import where_pending
from .linear import LinearSolver, MAX_WRITTEN_OUT, reduction_to_rounding, solve
from .sweeps import solve_by_sweeps, unknowns_themselves
from .tolerance import Tolerance


# Derivatives are solved to rounding error, as steps are by default.
_TOLERANCE = Tolerance(rtol=None, atol=0.0, norm=optx.max_norm)
# The default of `picard_steps` of `PicardNewton`: sweeps for a derivative converge at the
# rate of those for the step.
_MOST_SWEEPS = 200


def differentiate(
    solver: LinearSolver, linear: Callable[[PyTree], PyTree], rhs: PyTree[Array]
) -> PyTree[Array]:
    r"""The tangent $x = L x + b$ of the solution of $k = \Phi(k)$, where $L$ is the
    derivative of $\Phi$ along $k$ and $b$ the derivative along everything else; and by
    transposition its adjoint. `linear` is the function $L$, and `rhs` is $b$.

    A `solver`, such as the linear solver of `optx.Newton`, solves for any number of
    unknowns. If it is `None`, up to four unknowns are solved for by elimination, and more
    by sweeps like those that solved the step: they converge if those did. Stragglers are
    gathered from the batch, and their systems are solved one by one, by elimination or
    GMRES.
    """
    # The unknowns are one vector: JAX cannot transpose a solve if only some arrays of the
    # right-hand side depend on the differentiated inputs.
    flat_rhs, unravel = jfu.ravel_pytree(rhs)

    def operator(x: Float[Array, " n"]) -> Float[Array, " n"]:
        image, _ = jfu.ravel_pytree(linear(unravel(x)))
        return x - image

    # The same function solves the transposed system, which has the same eigenvalues, so
    # that sweeps converge as fast.
    solve_either = ft.partial(_solve, solver)
    solution = lax.custom_linear_solve(operator, flat_rhs, solve_either, solve_either)
    return unravel(solution)


def _solve(
    solver: LinearSolver,
    operator: Callable[[Array], Array],
    rhs: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The solution of `operator(x) = rhs`, where `operator` is one minus the linearized map
    of the stage equations of a solved step, or its transpose."""
    if rhs.size <= MAX_WRITTEN_OUT or solver is not None:
        return solve(operator, rhs, solver).value

    def image(x: Float[Array, " n"]) -> Float[Array, " n"]:
        return x + (rhs - operator(x))

    by_sweeps, is_solved = solve_by_sweeps(
        _TOLERANCE,
        _MOST_SWEEPS,
        image,
        unknowns_themselves,
        guess=jnp.zeros_like(rhs),
        pending=jnp.array(True),
    )
    # No Newton correction makes up for the error of GMRES here, so it must be small.
    reduction = reduction_to_rounding(rhs.dtype)

    def solve_straggler(_: Float[Array, " n"]) -> Float[Array, " n"]:
        return solve(operator, rhs, solver=None, reduction=reduction).value

    return where_pending(solve_straggler, ~is_solved, by_sweeps)
