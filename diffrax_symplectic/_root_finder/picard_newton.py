"""The root finder for stage equations: sweeps for all paths, then Newton's method for the
paths that sweeps leave unsolved."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, PyTree, Scalar

from .._arguments import whole_number
from .._batch import batched_like, where_pending
from .._compat import ω
from .newton import solve_by_newton
from .sweeps import solve_by_sweeps, unknowns_themselves
from .tolerance import all_finite, Tolerance


_SUCCESSFUL = optx.RESULTS.successful
_UNSOLVED = optx.RESULTS.nonlinear_divergence


class _FinderState(NamedTuple):
    """The state of the root finder, between its only step and the end.

    - `is_solved`: whether the equations are solved, or had no finite guess.
    - `result`: success, or the reason why they are not.
    - `aux`: the structure of the auxiliary output.
    """

    is_solved: Bool[Array, ""]
    result: optx.RESULTS
    aux: Any


def _number_of_steps(name: str, default: int) -> Any:
    """A field for a number of iterations. It bounds loops, so it is known while tracing."""
    converter = ft.partial(whole_number, name, least=0)
    return eqx.field(default=default, converter=converter, static=True)


class PicardNewton(
    optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, _FinderState]
):
    r"""Solves stage equations $k = \Phi(k)$, given as $k - \Phi(k) = 0$, to rounding error:
    cheaply for small steps, and robustly for large ones.

    A step is only as symplectic as its stage equations are accurate, so the default
    tolerance is two units in the last place of the state's dtype. Iteration ends when the
    *next* correction would be below the tolerance; with linear convergence it is estimated
    from the last two, as $\delta_n\, (\delta_n / \delta_{n-1})$.

    First all paths of a batch are solved together by sweeps, until each has converged or is
    seen not to converge. A sweep is a fixed-point (Picard) iteration, without a Jacobian,
    in which $q$ is updated with the new $p$ (Gauss--Seidel). Unknowns other than pairs
    $(p, q)$ are iterated by Gauss--Seidel on the doubled system. Slow convergence is
    accelerated by under-relaxation (Young, Transactions of the American Mathematical
    Society 76, 1954).

    Then the stragglers are gathered from the batch and solved by Newton's method. Its
    linear systems are solved by elimination up to 32 unknowns, and by matrix-free GMRES
    above. If the corrections do not shrink, it solves a fraction of the time step, with the
    increments scaled alike, and continues from there part by part (continuation). If the
    branch of solutions from the start of the step ends before the full step, the step
    fails. A small correction does not count as convergence if its linear system was not
    solved, or if the residual is larger than the state.

    **Arguments:**

    - `rtol`: bound on the next correction, relative to the largest entry of the leaf of
        the state that it changes. `None` is two units in the last place.
    - `atol`: absolute bound on the next correction.
    - `norm`: the norm within a leaf.
    - `linear_solver`: a Lineax solver for all linear systems, including derivatives.
        `None` is elimination for few unknowns, and matrix-free iteration otherwise.
    - `picard_steps`: the most sweeps before Newton's method. They end early if their
        convergence rate shows that this many would not suffice.
    - `newton_steps`: the most iterations of Newton's method.

    In `optimistix.root_find`, `options` may hold two functions. `scale(k)`, in the
    structure of the unknowns `k`, is the size of the state that they change, and replaces
    `k` in `rtol`. `solve_blocks(args, solve, k, pending)` solves the equations block by
    block, each with the values of earlier blocks, by `solve(image, scale, k, pending)`;
    both return the unknowns and whether they are solved.

    In `optimistix.root_find`, all of this is one step: `max_steps` has no effect unless it
    is zero.

    **Raises:** a `ValueError` for negative numbers.
    """

    rtol: float | None = None
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm
    linear_solver: lx.AbstractLinearSolver | None = None
    picard_steps: int = _number_of_steps("picard_steps", 200)
    newton_steps: int = _number_of_steps("newton_steps", 100)

    def __check_init__(self):
        for name in ("rtol", "atol"):
            number = getattr(self, name)
            # A traced tolerance cannot be checked, but has a meaning. NaN fails, too.
            if isinstance(number, int | float) and not number >= 0:
                raise ValueError(
                    f"`{name}` of `PicardNewton` must be >= 0; got {number}."
                )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _FinderState:
        del fn, args, options, f_struct, tags
        is_solved, result = batched_like((jnp.array(False), _SUCCESSFUL), y)
        return _FinderState(is_solved, result, aux_struct)

    def step(self, fn, y, args, options, state, tags):
        del tags
        scale = options.get("scale", unknowns_themselves)
        # A guess that is not finite stands for a path that failed before. Such a path is
        # left alone, so that the others of its batch need not wait for it, and counts as
        # solved: its unknowns stay not finite, by which the caller sees the failure.
        can_solve = all_finite(y)
        tolerance = Tolerance(self.rtol, self.atol, self.norm)
        sweep = ft.partial(solve_by_sweeps, tolerance, self.picard_steps)

        def equations(k: PyTree[Array]) -> PyTree[Array]:
            """The value of `k - Phi(k)`."""
            value, _ = fn(k, args)
            return value

        if "solve_blocks" in options:
            solve_blocks = options["solve_blocks"]
            by_sweeps, solved_by_sweeps = solve_blocks(args, sweep, y, can_solve)
        else:

            def image(k: PyTree[Array]) -> PyTree[Array]:
                return (k**ω - equations(k) ** ω).ω

            by_sweeps, solved_by_sweeps = sweep(image, scale, y, can_solve)
        # Newton's method is for the paths that sweeps did not solve.
        pending = can_solve & ~solved_by_sweeps
        if self.newton_steps == 0:
            # Without Newton's method a program compiles in half the time.
            y_new = by_sweeps
            result = optx.RESULTS.where(pending, _UNSOLVED, _SUCCESSFUL)
        else:
            y_new, result = self._solve_stragglers(
                equations, scale, tolerance, pending, guess=y, by_sweeps=by_sweeps
            )
        is_solved = result == _SUCCESSFUL
        # The equations are evaluated once more only if there is auxiliary output.
        aux = state.aux
        if jtu.tree_leaves(state.aux):
            _, aux = fn(y_new, args)
        return y_new, _FinderState(is_solved, result, state.aux), aux

    def _solve_stragglers(
        self,
        equations: Callable[[PyTree[Array]], PyTree[Array]],
        scale: Callable[[PyTree[Array]], PyTree[Array]],
        tolerance: Tolerance,
        pending: Bool[Array, ""],
        guess: PyTree[Array],
        by_sweeps: PyTree[Array],
    ) -> tuple[PyTree[Array], optx.RESULTS]:
        """The unknowns and the result for all paths: by Newton's method, from where the
        sweeps ended, for the paths that are `pending`, and `by_sweeps` for the others."""
        # The unknowns are one vector: a loop needs separate kernels to select, gather and
        # scatter each array of its state.
        flat_by_sweeps, restore = jfu.ravel_pytree(by_sweeps)
        # Continuation starts from the guess of the step, not where the sweeps ended.
        start, _ = jfu.ravel_pytree(guess)
        solver = self.linear_solver
        max_iterations = self.newton_steps

        def residual(k: Array) -> Array:
            return jfu.ravel_pytree(equations(restore(k)))[0]

        def solve(value: tuple[Array, optx.RESULTS]) -> tuple[Array, optx.RESULTS]:
            k, _ = value
            return solve_by_newton(
                residual, k, start, restore, scale, tolerance, solver, max_iterations
            )

        k, result = where_pending(solve, pending, (flat_by_sweeps, _SUCCESSFUL))
        return restore(k), result

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.is_solved, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}
