from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from .._compat import ω
from .._custom_types import IntScalarLike
from . import _continuation
from ._start import improve, Measured, start, Sweep
from ._tolerance import Tolerance


class PicardNewton(optx.AbstractRootFinder):
    r"""For stage equations $k = \Phi(k)$, given as $k - \Phi(k) = 0$: solves them to
    rounding error, cheaply when the step is small and robustly when it is not.

    A step is as symplectic as its stage equations are solved. So the default tolerance
    is two units in the last place of whatever dtype the state has. Iteration ends when
    the *next* correction would be below it: after $\delta_{n-1}$ and $\delta_n$ that is
    about $\delta_n\, (\delta_n / \delta_{n-1})$ for a method of linear convergence.

    First come iterations without a safety net, for each system of a step on its own:

    - Up to `direct` unknowns: `warmup` fixed-point (Picard) iterations, one of Newton's
        method, and `chords` with the same Jacobian. Newton's method begins at the guess
        where the last of several fixed-point iterations changes the values by more than
        half of what all of them did.
    - Above: `sweeps` fixed-point iterations, which need no Jacobian, without a look at the
        error; and rounds of `more_sweeps`, up to `picard_steps` in all, for as long as
        corrections shrink.

    Where these do not converge, Newton's method solves all stages of the step as one
    system. It tries the whole step first. If its corrections do not shrink, it solves for a
    part of the step, with increments reduced alike, and goes on from there part by part
    (continuation). If the branch of solutions that begins at the start of the step ends
    before the whole step, Newton's method looks for any other solution. Its linear systems
    are solved by elimination up to four unknowns, and above by GMRES, which needs no
    matrix. A small correction is no success where its linear system was not solved, or
    where the residual is larger than the state.

    **Arguments:**

    - `rtol`: bound on the next correction, relative to the largest entry of each leaf of
        the state that it changes. `None` stands for two units in the last place.
    - `atol`: absolute bound on the next correction.
    - `norm`: norm within a leaf.
    - `linear_solver`: a Lineax solver for all linear systems, those of derivatives
        included. `None` is elimination for few unknowns, and otherwise no matrix.
    - `direct`: the most unknowns for which Newton's method is used from the start.
    - `warmup`, `chords`, `sweeps`, `more_sweeps`, `picard_steps`: see above.

    In `optimistix.root_find`, `options={"scale": f}` says how large the state is that the
    unknowns `k` change: `f(k)` has their structure, and stands in place of `k` in `rtol`.

    **Raises:** a `ValueError` for negative numbers, fewer than 2 `sweeps`, or
        no `more_sweeps`.
    """

    rtol: float | None = None
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm
    linear_solver: lx.AbstractLinearSolver | None = None
    direct: int = eqx.field(default=4, static=True)
    warmup: int = eqx.field(default=4, static=True)
    chords: int = eqx.field(default=1, static=True)
    sweeps: int = eqx.field(default=9, static=True)
    picard_steps: int = eqx.field(default=40, static=True)
    more_sweeps: int = eqx.field(default=4, static=True)

    def __check_init__(self):
        least = dict(
            direct=0, warmup=0, chords=0, sweeps=2, more_sweeps=1, picard_steps=0
        )
        for name, n in least.items():
            if getattr(self, name) < n:
                raise ValueError(
                    f"`{name}` of `PicardNewton` must be at least {n}; got "
                    f"{getattr(self, name)}."
                )

    @property
    def tolerance(self) -> Tolerance:
        return Tolerance(self.rtol, self.atol, self.norm)

    def init(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        f_struct: PyTree[jax.ShapeDtypeStruct],
        aux_struct: PyTree[jax.ShapeDtypeStruct],
        tags: frozenset[object],
    ) -> "_Search":
        del f_struct, aux_struct, tags
        displaced = _Displaced(fn, args, options, y)

        def improve_all(systems: list[PyTree[Array]], sweeps: IntScalarLike) -> Sweep:
            found = improve(
                self, displaced.image, systems[0], displaced.measured, sweeps
            )
            return found._replace(y=[found.y])

        zero = jtu.tree_map(jnp.zeros_like, y)
        first = start(self, improve_all, [zero], displaced.measured)
        origin, near = (jfu.ravel_pytree(y)[0] for y in (y, first.y))
        near = jnp.where(first.converged | first.near, near, 0)
        return _Search(origin, _continuation.begin(near, first.converged))

    def step(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        state: "_Search",
        tags: frozenset[object],
    ) -> tuple[PyTree[Array], "_Search", Any]:
        del tags
        origin = jfu.ravel_pytree(y)[1](state.origin)
        displaced = _Displaced(fn, args, options, origin)
        equations = _continuation.as_vector(displaced.residual, displaced.measured, y)
        progress = _continuation.advance(self, equations, state.progress)
        y = displaced.moved(equations.restore(progress.y))
        return y, _Search(state.origin, progress), fn(y, args)[1]

    def terminate(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        state: "_Search",
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, y, args, options, tags
        result = optx.RESULTS.where(
            state.progress.hopeless, optx.RESULTS.nonfinite, optx.RESULTS.successful
        )
        return state.progress.solved, result

    def postprocess(
        self,
        fn: Callable,
        y: PyTree[Array],
        aux: Any,
        args: PyTree[Any],
        options: dict[str, Any],
        state: "_Search",
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[PyTree[Array], Any, dict[str, Any]]:
        del options, tags, result
        found = jfu.ravel_pytree(y)[1](state.origin + state.progress.y)
        # If the cheap iterations solved the equations, no step has computed it.
        aux = fn(found, args)[1] if jtu.tree_leaves(aux) else aux
        return found, aux, {}


class _Search(eqx.Module):
    """Where a search by itself stands: how far it has come from `origin`."""

    origin: Float[Array, " n"]
    progress: _continuation.State


class _Displaced(NamedTuple):
    """The equations `fn(y, args) = 0` for `k = y - origin`."""

    fn: Callable
    args: PyTree[Any]
    options: dict[str, Any]
    origin: PyTree[Array]

    def moved(self, k: PyTree[Array]) -> PyTree[Array]:
        return (self.origin**ω + k**ω).ω

    def residual(self, k: PyTree[Array]) -> PyTree[Array]:
        return self.fn(self.moved(k), self.args)[0]

    def image(self, k: PyTree[Array]) -> PyTree[Array]:
        return (k**ω - self.residual(k) ** ω).ω

    @property
    def measured(self) -> Measured:
        # The scale is that of what the unknown is added to: increments are only needed to
        # the accuracy of the state that they change.
        scale = self.options.get("scale", lambda y: y)
        return Measured(lambda change: change, lambda k: scale(self.moved(k)))
