import functools as ft
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jax import lax
from jaxtyping import Array, PyTree, Scalar

from .._batch import where_pending
from .._compat import ω
from ._continuation import advance, begin, Packed, Progress
from ._sweeps import Found, sweep
from ._tolerance import Limits


# Iterations of Newton's method in a step of the search: to gather paths from a large batch,
# and to put them back, takes longer than several of these.
ITERATIONS = 8

# The progress of the search; and zeros in place of auxiliary output, which `postprocess`
# evaluates once, at the solution.
_State: TypeAlias = tuple[Packed, Any]


class PicardNewton(optx.AbstractRootFinder[PyTree[Array], PyTree[Array], Any, _State]):
    r"""For stage equations $k = \Phi(k)$, given as $k - \Phi(k) = 0$: solves them to
    rounding error, cheaply when the step is small and robustly when it is not.

    A step is as symplectic as its stage equations are solved. So the default tolerance
    is two units in the last place of whatever dtype the state has. Iteration ends when
    the *next* correction would be below it: after $\delta_{n-1}$ and $\delta_n$ that is
    about $\delta_n\, (\delta_n / \delta_{n-1})$ for a method of linear convergence.

    First come sweeps for all paths of a batch together, until each is solved or does not
    converge: fixed-point (Picard) iterations, which need no Jacobian. In a sweep $q$ reads
    what $p$ has become. This is for a list of pairs `(p, q)`; of other unknowns two copies
    read each other. Where that converges slowly, values stay behind by a fraction of their
    change (successive over-relaxation: Young, Transactions of the American Mathematical
    Society 76, 1954).

    The paths that are left are gathered from the batch. For these, a step of the search is
    up to eight iterations of Newton's method. Its linear systems are solved by elimination
    up to 32 unknowns, and above by GMRES, which needs no matrix. If its corrections do not
    shrink, it solves for a part of the time step, with increments reduced alike, and goes
    on from there part by part (continuation). If the branch of solutions that begins at the
    start of the step ends before the whole step, Newton's method looks for any other
    solution. A small correction is no success where its linear system was not solved, or
    where the residual is larger than the state.

    **Arguments:**

    - `rtol`: bound on the next correction, relative to the largest entry of each leaf of
        the state that it changes. `None` stands for two units in the last place.
    - `atol`: absolute bound on the next correction.
    - `norm`: norm within a leaf.
    - `linear_solver`: a Lineax solver for all linear systems, those of derivatives
        included. `None` is elimination for few unknowns, and otherwise no matrix.
    - `picard_steps`: the most sweeps before Newton's method. Where their rate tells that so
        many would not do, they end at once.

    In `optimistix.root_find`, `options={"scale": f}` says how large the state is that the
    unknowns `k` change: `f(k)` has their structure, and stands in place of `k` in `rtol`.
    Nothing waits for the solution where `options={"lost": flag}` is true, and there it is
    of no use. Of Newton's method there are `options={"iterations": n}` in a step, or eight.

    **Raises:** a `ValueError` for negative numbers.
    """

    rtol: float | None = None
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm
    linear_solver: lx.AbstractLinearSolver | None = None
    picard_steps: int = eqx.field(default=200, static=True)

    def __check_init__(self):
        for name in ("rtol", "atol", "picard_steps"):
            if isinstance(n := getattr(self, name), int | float) and n < 0:
                raise ValueError(f"`{name}` of `PicardNewton` must be >= 0; got {n}.")

    def _limits(self, options: dict[str, Any]) -> Limits:
        # Increments are only needed to the accuracy of the state that they change.
        scale = options.get("scale", lambda k: k)
        return Limits(self.rtol, self.atol, self.norm, scale, self.picard_steps)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        del f_struct, tags
        lost = options.get("lost", jnp.array(False))
        limits, zeros = self._limits(options), jtu.tree_map(jnp.zeros_like, y)
        begun = Found(zeros, solved=lost, near=~lost)
        # A step sweeps the blocks of its plan one after another.
        if "sweep" in options:
            found = options["sweep"](limits, begun)
        else:
            moved = lambda k: (y**ω + k**ω).ω
            image = lambda k: (k**ω - fn(moved(k), args)[0] ** ω).ω
            scale = lambda k: limits.scale(moved(k))
            found = sweep(limits._replace(scale=scale), image, begun)
            found = found._replace(y=moved(found.y))
        k, guess = jfu.ravel_pytree(found.y)[0], jfu.ravel_pytree(y)[0]
        k = jnp.where(found.near, k, guess)
        of_array = lambda x: isinstance(x, jax.ShapeDtypeStruct)
        zero = lambda x: jnp.zeros(x.shape, x.dtype) if of_array(x) else x
        return begin(k, found.solved, guess), jtu.tree_map(zero, aux_struct)

    def step(self, fn, y, args, options, state, tags):
        del tags
        # `y` stays the guess. The state has the iterate, which `postprocess` returns.
        (packed, aux), (guess, restore) = state, jfu.ravel_pytree(y)
        residual = lambda k: jfu.ravel_pytree(fn(restore(k), args)[0])[0]
        ended = lambda packed: Progress.unpacked(packed).ended
        solver, limits = self.linear_solver, self._limits(options)
        once = ft.partial(advance, limits, solver, residual, restore, guess)
        another = lambda _, packed: jnp.where(ended(packed), packed, once(packed))
        times = options.get("iterations", ITERATIONS)
        newton = lambda packed: lax.fori_loop(0, times, another, packed)
        return y, (where_pending(newton, ~ended(packed), packed), aux), aux

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        progress, R = Progress.unpacked(state[0]), optx.RESULTS
        return progress.solved, R.where(progress.hopeless, R.nonfinite, R.successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del options, tags, result
        found = jfu.ravel_pytree(y)[1](Progress.unpacked(state[0]).k)
        aux = fn(found, args)[1] if jtu.tree_leaves(aux) else aux
        return found, aux, {}
