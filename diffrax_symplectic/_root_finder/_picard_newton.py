import abc
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, PyTree, Scalar

from .._batch import batched_like, where_pending
from .._compat import ω
from ._newton import Newton
from ._sweeps import sweep
from ._tolerance import all_finite, Tolerance


_Found: TypeAlias = tuple[Any, Bool[Array, ""]]


_SUCCESSFUL = optx.RESULTS.successful


class AbstractBlocks(eqx.Module):
    """Arguments `args` that know their equations block by block."""

    @abc.abstractmethod
    def sweep(self, solve: Callable[..., _Found], guess: Any, pending: Any) -> _Found:
        """Solves block after block, each from the values of those before it, by
        `solve(image, scale, guess, pending)`."""


class _State(NamedTuple):
    """Whether the equations are solved, if they cannot be, why, and the structure of
    auxiliary output."""

    solved: Bool[Array, ""]
    result: optx.RESULTS
    aux: Any


class PicardNewton(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, _State]):
    r"""For stage equations $k = \Phi(k)$, given as $k - \Phi(k) = 0$: solves them to
    rounding error, cheaply when the step is small and robustly when it is not.

    A step is as symplectic as its stage equations are solved. So the default tolerance
    is two units in the last place of whatever dtype the state has. Iteration ends when
    the *next* correction would be below it: after $\delta_{n-1}$ and $\delta_n$ that is
    about $\delta_n\, (\delta_n / \delta_{n-1})$ for a method of linear convergence.

    There is one step. First come sweeps for all paths of a batch together, until each
    is solved or does not converge: fixed-point (Picard) iterations, which need no Jacobian,
    in which $q$ reads the new $p$ (Gauss--Seidel). Unknowns that are no pairs $(p, q)$ are
    iterated as a doubled system. Where that converges slowly, it is under-relaxed (Young,
    Transactions of the American Mathematical Society 76, 1954).

    Then come the stragglers, gathered from the batch, by Newton's method. Its linear
    systems are solved by elimination up to 32 unknowns, and above by GMRES, which needs no
    matrix. If its corrections do not shrink, it solves for a part of the time step, with
    increments reduced alike, and goes on from there part by part (continuation). If the
    branch of solutions that begins at the start of the step ends before the whole step,
    Newton's method looks for any other solution. A small correction is no success where
    its linear system was not solved, or where the residual is larger than the state.

    **Arguments:**

    - `rtol`: bound on the next correction, relative to the largest entry of each leaf of
        the state that it changes. `None` stands for two units in the last place.
    - `atol`: absolute bound on the next correction.
    - `norm`: norm within a leaf.
    - `linear_solver`: a Lineax solver for all linear systems, those of derivatives
        included. `None` is elimination for few unknowns, and otherwise no matrix.
    - `picard_steps`: the most sweeps before Newton's method. Where their rate tells that so
        many would not do, they end at once.
    - `newton_steps`: the most iterations of Newton's method after them.

    In `optimistix.root_find`, `options={"scale": f}` says how large the state is that the
    unknowns `k` change: `f(k)` has their structure, and stands in place of `k` in `rtol`.

    **Raises:** a `ValueError` for negative numbers.
    """

    rtol: float | None = None
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm
    linear_solver: lx.AbstractLinearSolver | None = None
    picard_steps: int = eqx.field(default=200, static=True)
    newton_steps: int = eqx.field(default=100, static=True)

    def __check_init__(self):
        for name in ("rtol", "atol", "picard_steps", "newton_steps"):
            if isinstance(n := getattr(self, name), int | float) and n < 0:
                raise ValueError(f"`{name}` of `PicardNewton` must be >= 0; got {n}.")

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        del fn, args, options, f_struct, tags
        return _State(*batched_like((jnp.array(False), _SUCCESSFUL), y), aux_struct)

    def step(self, fn, y, args, options, state, tags):
        del tags
        scale = options.get("scale", lambda k: k)
        pending = all_finite(y)
        found, solved = self._sweep(fn, y, args, scale, pending)
        # As a vector: a loop selects, gathers and scatters each array of its state by
        # kernels of their own.
        k, restore = jfu.ravel_pytree(found)
        residual = lambda k, _: jfu.ravel_pytree(fn(restore(k), args)[0])[0]

        def rescue(value):
            newton = Newton(
                start=jfu.ravel_pytree(y)[0],
                restore=restore,
                rtol=self.rtol,
                atol=self.atol,
                norm=self.norm,
                linear_solver=self.linear_solver,
            )
            sol = optx.root_find(
                residual,
                newton,
                value[0],
                options=dict(scale=scale),
                max_steps=self.newton_steps,
                throw=False,
            )
            return sol.value, sol.result

        k, result = where_pending(rescue, pending & ~solved, (k, _SUCCESSFUL))
        y_new, solved = restore(k), result == _SUCCESSFUL
        # The equations once more only where there is auxiliary output.
        aux = fn(y_new, args)[1] if jtu.tree_leaves(state.aux) else state.aux
        return y_new, _State(solved, result, state.aux), aux

    def _sweep(self, fn, y, args, scale, pending) -> _Found:
        tolerance = Tolerance(self.rtol, self.atol, self.norm)
        solve = ft.partial(sweep, tolerance, self.picard_steps)
        if isinstance(args, AbstractBlocks):
            return args.sweep(solve, y, pending)
        return solve(lambda y: (y**ω - fn(y, args)[0] ** ω).ω, scale, y, pending)

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.solved, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}
