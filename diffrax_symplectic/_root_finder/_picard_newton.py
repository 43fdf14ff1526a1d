from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from equinox.internal import ω
from jaxtyping import Array, Bool, PyTree, Scalar

from ._small_lu import SmallLU


class _State(eqx.Module):
    y: PyTree[Array]
    # The last two corrections in units of the tolerance (1 is converged), and the last
    # one relative to the whole iterate.
    size: Scalar
    size_prev: Scalar
    overall: Scalar

    @property
    def shrink(self) -> Scalar:
        """By how much the last correction was smaller; 1 as long as that is unknown."""
        known = jnp.isfinite(self.size_prev)
        return jnp.where(known, _ratio(self.size, self.size_prev), 1.0)


class PicardNewton(optx.AbstractRootFinder):
    r"""For stage equations $k = \Phi(k)$, given as $k - \Phi(k) = 0$: solves them to
    rounding error, cheaply when the step is small and robustly when it is not.

    A step is as symplectic as its stage equations are solved. So the default tolerance
    is a few units in the last place of whatever dtype the state has, and the
    quadratic convergence of Newton's method is used to tell when the *next* correction
    would be below it: after $\delta_{k-1}$ and $\delta_k$ it is about
    $\delta_k (\delta_k / \delta_{k-1})^2$.

    Systems of up to `direct` unknowns are solved by Newton's method, the first few
    iterations of which are written out ahead of Optimistix' loop. The loop then normally
    has nothing left to do; over a batch of paths, iterating for as long as any of them
    needs costs more than one iteration too many. Larger systems are first tried by
    fixed-point (Picard) iteration, which needs no Jacobian and converges fast for steps
    that resolve the dynamics. It is given up for Newton's method if it converges
    slowly. Corrections of Newton's method that would make the
    residual larger are shortened.

    **Arguments:**

    - `rtol`: bound on the next correction, relative to the largest entry of each leaf of
        the iterate. `None` stands for two units in the last place.
    - `atol`: absolute bound on the next correction.
    - `norm`: norm within a leaf.
    - `linear_solver`: solves for the corrections of Newton's method; see Lineax.
    - `direct`: the most unknowns for which Newton's method is used from the start.
    - `unrolled`: the number of its iterations that are written out.
    - `picard_steps`: the most fixed-point iterations.
    """

    rtol: float | None = None
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm
    linear_solver: lx.AbstractLinearSolver = SmallLU()
    direct: int = eqx.field(default=4, static=True)
    unrolled: int = eqx.field(default=3, static=True)
    picard_steps: int = eqx.field(default=30, static=True)

    def init(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        f_struct: PyTree[jax.ShapeDtypeStruct],
        aux_struct: PyTree[jax.ShapeDtypeStruct],
        tags: frozenset[object],
    ) -> _State:
        del f_struct, aux_struct
        dtype = jnp.result_type(*jtu.tree_leaves(y))
        inf = jnp.array(jnp.inf, jnp.finfo(dtype).dtype)
        state = _State(y=y, size=inf, size_prev=inf, overall=inf)
        if sum(x.size for x in jtu.tree_leaves(y)) > self.direct:
            return self._picard(fn, args, options, state)
        for _ in range(self.unrolled):
            state = _newton(self, fn, args, options, state, tags)
        return state

    def _picard(self, fn, args, options, init: _State) -> _State:
        # Two iterations at a time: positions and momenta move each other, so that single
        # corrections shrink in turns.
        def advance(carry):
            state, step = carry
            first, _ = fn(state.y, args)
            state = eqx.tree_at(lambda s: s.y, state, (state.y**ω - first**ω).ω)
            second, _ = fn(state.y, args)
            return _correct(self, options, state, second), step + 2

        def proceed(carry):
            state, step = carry
            contracting = (step <= 2) | (state.shrink < 0.5)
            return ~_picard_done(state) & contracting & (step < self.picard_steps)

        state, _ = lax.while_loop(proceed, advance, advance((init, 0)))
        done = _picard_done(state)
        # Newton's method starts afresh: iterates that did not converge may be anywhere.
        return jtu.tree_map(
            lambda a, b: jnp.where(done, a, b),
            eqx.tree_at(lambda s: s.size, state, jnp.zeros_like(state.size)),
            init,
        )

    def step(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[PyTree[Array], _State, Any]:
        del y
        full = _newton(self, fn, args, options, state, tags)
        size_of = lambda y: optx.two_norm(fn(y, args)[0])
        before = size_of(state.y)

        def shorten(carry):
            _, factor = carry
            factor = factor / 2
            return (state.y**ω + factor * (full.y**ω - state.y**ω)).ω, factor

        def too_long(carry):
            y, factor = carry
            # Rounding errors alone may make a residual larger, by a little.
            matters = full.overall > 1e-3
            return matters & ~(size_of(y) < before) & (factor > 1e-3)

        one = jnp.ones_like(full.size)
        best, _ = lax.while_loop(too_long, shorten, (full.y, one))
        _, aux = fn(best, args)
        return best, eqx.tree_at(lambda s: s.y, full, best), aux

    def terminate(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, y, args, options, tags
        quadratic = state.size * state.shrink**2 <= 1
        result = optx.RESULTS.where(
            jnp.isnan(state.size), optx.RESULTS.nonfinite, optx.RESULTS.successful
        )
        return (state.size <= 1) | quadratic | _stagnated(state), result

    def postprocess(
        self,
        fn: Callable,
        y: PyTree[Array],
        aux: Any,
        args: PyTree[Any],
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[PyTree[Array], Any, dict[str, Any]]:
        del fn, y, args, options, tags, result
        return state.y, aux, {}


# One function that is traced and lowered once, and called several times.
@eqx.filter_jit
def _newton(self: PicardNewton, fn, args, options, state: _State, tags) -> _State:
    residual, jacobian, _ = jax.linearize(lambda y: fn(y, args), state.y, has_aux=True)
    operator = lx.FunctionLinearOperator(
        jacobian, jax.eval_shape(lambda: state.y), tags=tags
    )
    linear_state = self.linear_solver.init(operator, {})
    diff, _, _ = self.linear_solver.compute(linear_state, residual, {})
    return _correct(self, options, state, diff)


def _correct(self: PicardNewton, options, state: _State, diff) -> _State:
    """Subtracts the correction and measures it."""
    y = (state.y**ω - diff**ω).ω
    # What the unknown is added to: increments are only needed to the accuracy of the
    # state that they change.
    scale_of = options.get("scale", lambda y: y)
    sizes = jnp.stack([self.norm(d) for d in jtu.tree_leaves(diff)])
    scales = jnp.stack([self.norm(s) for s in jtu.tree_leaves(scale_of(y))])
    rtol = 2 * jnp.finfo(sizes.dtype).eps if self.rtol is None else self.rtol
    return _State(
        y=y,
        size=jnp.max(_ratio(sizes, rtol * scales + self.atol)),
        size_prev=state.size,
        overall=_ratio(jnp.max(sizes), jnp.max(scales)),
    )


def _picard_done(state: _State) -> Bool[Array, ""]:
    return (state.size <= 1) | _stagnated(state)


def _stagnated(state: _State) -> Bool[Array, ""]:
    """Rounding errors can keep the corrections to a leaf that is small next to the others
    above `rtol` for ever. They are recognised by no longer shrinking."""
    eps = jnp.finfo(state.size.dtype).eps
    return (state.shrink > 0.5) & (state.overall <= 100 * eps)


def _ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: no correction at all is no error at all."""
    return jnp.where(a == 0, 0, a / b)
