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
from .newton import Newton
from .sweeps import sweep
from .tolerance import all_finite, Tolerance


_SUCCESSFUL = optx.RESULTS.successful


class _State(NamedTuple):
    """Whether the equations are solved, the reason if they cannot be, and the structure of
    the auxiliary output."""

    solved: Bool[Array, ""]
    result: optx.RESULTS
    aux: Any


def _number_of_steps(name: str, default: int) -> Any:
    converter = ft.partial(whole_number, name, least=0)
    return eqx.field(default=default, converter=converter, static=True)


class PicardNewton(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, _State]):
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
    branch of solutions from the start of the step ends before the full step, Newton's
    method searches for any other solution. A small correction does not count as convergence
    if its linear system was not solved, or if the residual is larger than the state.

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
    `k` in `rtol`. `sweep(args, solve, k, pending)` solves the equations block by block,
    each with the values of earlier blocks, by `solve(image, scale, k, pending)`; both
    return the unknowns and whether they are solved.

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
            if isinstance(n := getattr(self, name), int | float) and not n >= 0:
                raise ValueError(f"`{name}` of `PicardNewton` must be >= 0; got {n}.")

    @property
    def _tolerance(self) -> Tolerance:
        return Tolerance(self.rtol, self.atol, self.norm)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        del fn, args, options, f_struct, tags
        return _State(*batched_like((jnp.array(False), _SUCCESSFUL), y), aux_struct)

    def step(self, fn, y, args, options, state, tags):
        del tags
        scale = options.get("scale", lambda k: k)
        pending = all_finite(y)
        solve = ft.partial(sweep, self._tolerance, self.picard_steps)
        if "sweep" in options:
            found, solved = options["sweep"](args, solve, y, pending)
        else:
            image = lambda y: (y**ω - fn(y, args)[0] ** ω).ω
            found, solved = solve(image, scale, y, pending)
        # As one vector: a loop needs separate kernels to select, gather and scatter each
        # array of its state.
        k, restore = jfu.ravel_pytree(found)
        residual = lambda k: jfu.ravel_pytree(fn(restore(k), args)[0])[0]
        start, _ = jfu.ravel_pytree(y)
        newton = Newton(
            residual, start, restore, scale, self._tolerance, self.linear_solver
        )
        rescue = lambda value: newton.solve(value[0], self.newton_steps)
        k, result = where_pending(rescue, pending & ~solved, (k, _SUCCESSFUL))
        y_new, solved = restore(k), result == _SUCCESSFUL
        # Evaluate the equations once more only if there is auxiliary output.
        aux = fn(y_new, args)[1] if jtu.tree_leaves(state.aux) else state.aux
        return y_new, _State(solved, result, state.aux), aux

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.solved, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}
