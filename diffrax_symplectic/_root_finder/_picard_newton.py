import functools as ft
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


# Up to this many unknowns a few iterations too many cost less than to look after each.
_SMALL = 32


class _State(eqx.Module):
    y: PyTree[Array]
    # The last correction in units of the tolerance (1 is converged), how much smaller it
    # was than those before (1 as long as that is unknown), and its size relative to the
    # whole iterate.
    size: Scalar
    shrink: Scalar
    overall: Scalar

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether the next correction would be below the tolerance."""
        # Rounding errors can keep the corrections to a leaf that is small next to the
        # others above `rtol` for ever: then they no longer shrink.
        eps = jnp.finfo(self.size.dtype).eps
        stagnated = ~(self.shrink < 0.25) & (self.overall <= 100 * eps)
        # A fraction of the tolerance: what remains has the same sign in every step.
        return (self.size * jnp.minimum(self.shrink, 1) <= 1 / 8) | stagnated


class PicardNewton(optx.AbstractRootFinder):
    r"""For stage equations $k = \Phi(k)$, given as $k - \Phi(k) = 0$: solves them to
    rounding error, cheaply when the step is small and robustly when it is not.

    A step is as symplectic as its stage equations are solved. So the default tolerance
    is a few units in the last place of whatever dtype the state has. Iteration ends when
    the *next* correction would be below it: after $\delta_{n-1}$ and $\delta_n$ that is
    about $\delta_n\, (\delta_n / \delta_{n-1})$ for a method of linear convergence.

    What a step normally needs is written out, ahead of Optimistix' loop: over a batch of
    paths a loop costs more than the arithmetic, since XLA fuses none of what is in it
    with what is around it, and since it goes on for as long as any of the paths needs.

    - Up to `direct` unknowns: `warmup` fixed-point (Picard) iterations, one of Newton's
        method, and `chords` with the same Jacobian.
    - Above: fixed-point iterations, which need no Jacobian and converge fast for steps
        that resolve the dynamics. Up to 32 unknowns, `sweeps` of them follow each other
        without a look at the error; a loop goes on for as long as corrections shrink.

    The loop that then normally has nothing left to do is Newton's method. It goes on from
    where these iterations ended if they converged, and otherwise begins at the first
    guess. Corrections that would make the residual larger are shortened.

    The iterate is kept in the state, ahead of the one that Optimistix holds: a root finder
    that wraps another and looks at its iterates, such as `optimistix.BestSoFarRootFinder`,
    cannot wrap this one.

    **Arguments:**

    - `rtol`: bound on the next correction, relative to the largest entry of each leaf of
        the iterate. `None` stands for two units in the last place.
    - `atol`: absolute bound on the next correction.
    - `norm`: norm within a leaf.
    - `linear_solver`: solves for the corrections of Newton's method; see Lineax.
    - `direct`: the most unknowns for which Newton's method is used from the start.
    - `warmup`, `chords`, `sweeps`: see above.
    - `picard_steps`: the most fixed-point iterations.

    **Raises:** a `ValueError` for negative numbers, or fewer than 2 `sweeps`.
    """

    rtol: float | None = None
    atol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm
    linear_solver: lx.AbstractLinearSolver = SmallLU()
    direct: int = eqx.field(default=4, static=True)
    warmup: int = eqx.field(default=2, static=True)
    chords: int = eqx.field(default=1, static=True)
    sweeps: int = eqx.field(default=10, static=True)
    picard_steps: int = eqx.field(default=40, static=True)

    def __check_init__(self):
        least = dict(direct=0, warmup=0, chords=0, sweeps=2, picard_steps=0)
        for name, n in least.items():
            if getattr(self, name) < n:
                raise ValueError(
                    f"`{name}` of `PicardNewton` must be at least {n}; got "
                    f"{getattr(self, name)}."
                )

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
        dtype = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).dtype
        inf, one = jnp.array(jnp.inf, dtype), jnp.array(1, dtype)
        start = _State(y=y, size=inf, shrink=one, overall=inf)
        if sum(x.size for x in jtu.tree_leaves(y)) <= self.direct:
            return self._write_out_newton(fn, args, options, start, tags)
        return self._picard(fn, args, options, start)

    def _write_out_newton(self, fn, args, options, state: _State, tags) -> _State:
        for _ in range(self.warmup):
            y = (state.y**ω - fn(state.y, args)[0] ** ω).ω
            state = eqx.tree_at(lambda s: s.y, state, y)
        residual, solve = _linearized(self, fn, args, state.y, tags)
        state = _correct(self, options, state, solve(residual))
        for _ in range(self.chords):
            state = _correct(self, options, state, solve(fn(state.y, args)[0]))
        # If this led out of where `fn` has values, the loop starts afresh.
        size = jnp.where(jnp.isnan(state.size), jnp.inf, state.size)
        return eqx.tree_at(lambda s: s.size, state, size)

    def _picard(self, fn, args, options, start: _State) -> _State:
        # In pairs: positions and momenta move each other, so that corrections may shrink
        # in turns.
        def twice(y):
            for _ in range(2):
                y = (y**ω - fn(y, args)[0] ** ω).ω
            return y

        def advance(carry):
            state, step = carry
            diff = (state.y**ω - twice(state.y) ** ω).ω
            return _correct(self, options, state, diff), step + 2

        def proceed(carry):
            state, step = carry
            contracting = (step <= 2) | (state.shrink < 0.25)
            return ~state.converged & contracting & (step < self.picard_steps)

        state, step = start, jnp.array(0)
        if sum(x.size for x in jtu.tree_leaves(start.y)) <= _SMALL:
            # No need to look before the last of these.
            pairs = self.sweeps // 2
            shift = lambda _, ys: (*ys[1:], twice(ys[-1]))
            ys = lax.fori_loop(0, pairs, shift, (start.y,) * 3)
            # In the loops below this norm costs more: XLA computes what it is fused with
            # anew for each entry.
            norm = _folded_norm if self.norm is optx.max_norm else self.norm
            last, prev = ((ys[i] ** ω - ys[i - 1] ** ω).ω for i in (2, 1))
            size_prev, _ = _sizes(self, norm, options, ys[2], prev)
            size, overall = _sizes(self, norm, options, ys[2], last)
            state = _State(ys[2], size, _ratio(size, size_prev), overall)
            step = jnp.array(2 * pairs)
        state, _ = lax.while_loop(proceed, advance, (state, step))
        keep = state.converged | (state.shrink < 0.25)
        return jtu.tree_map(lambda a, b: jnp.where(keep, a, b), state, start)

    def step(
        self,
        fn: Callable,
        y: PyTree[Array],
        args: PyTree[Any],
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[PyTree[Array], _State, Any]:
        # Before the first step `y` is the first guess. What was written out may have led
        # anywhere if it was not converging.
        keep = state.shrink < 0.5
        fresh = eqx.tree_at(lambda s: s.size, state, jnp.full_like(state.size, jnp.inf))
        fresh = eqx.tree_at(lambda s: s.y, fresh, y)
        state = jtu.tree_map(lambda a, b: jnp.where(keep, a, b), state, fresh)
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
        result = optx.RESULTS.where(
            jnp.isnan(state.size), optx.RESULTS.nonfinite, optx.RESULTS.successful
        )
        return state.converged, result

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


def _linearized(
    self: PicardNewton, fn, args, y: PyTree[Array], tags
) -> tuple[PyTree[Array], Callable]:
    """The residual at `y`, and what solves the linearized equations there."""
    residual, jacobian, _ = jax.linearize(lambda y: fn(y, args), y, has_aux=True)
    if sum(x.size for x in jtu.tree_leaves(y)) > self.direct:
        # The Jacobian of a linear system does not depend on `y`. XLA would move it, and
        # its factorization, out of the loop and compute them in every step, also if the
        # loop runs zero times. `0 * y` is not simplified: `y` might not be finite.
        jacobian = ft.partial(_apply_tied, jacobian, y)
    operator = lx.FunctionLinearOperator(jacobian, jax.eval_shape(lambda: y), tags=tags)
    linear_state = self.linear_solver.init(operator, {})
    return residual, lambda x: self.linear_solver.compute(linear_state, x, {})[0]


def _apply_tied(linear: Callable, y: PyTree[Array], x: PyTree[Array]) -> PyTree[Array]:
    return linear((x**ω + 0 * y**ω).ω)


def _newton(self: PicardNewton, fn, args, options, state: _State, tags) -> _State:
    residual, solve = _linearized(self, fn, args, state.y, tags)
    return _correct(self, options, state, solve(residual))


def _correct(self: PicardNewton, options, state: _State, diff) -> _State:
    """Subtracts the correction and measures it."""
    y = (state.y**ω - diff**ω).ω
    size, overall = _sizes(self, self.norm, options, y, diff)
    shrink = jnp.where(jnp.isfinite(state.size), _ratio(size, state.size), 1)
    return _State(y, size, shrink, overall)


def _sizes(self: PicardNewton, norm, options, y, diff) -> tuple[Scalar, Scalar]:
    """A correction in units of the tolerance, and relative to the whole iterate."""
    # What the unknown is added to: increments are only needed to the accuracy of the
    # state that they change.
    scale_of = options.get("scale", lambda y: y)
    sizes = [norm(d) for d in jtu.tree_leaves(diff)]
    scales = [norm(s) for s in jtu.tree_leaves(scale_of(y))]
    rtol = 2 * jnp.finfo(sizes[0].dtype).eps if self.rtol is None else self.rtol
    largest = ft.partial(ft.reduce, jnp.maximum)
    size = largest([_ratio(a, rtol * b + self.atol) for a, b in zip(sizes, scales)])
    return size, _ratio(largest(sizes), largest(scales))


def _folded_norm(x: Array) -> Scalar:
    """The maximum norm of a short array, folded in half until one number is left. XLA
    fuses no reduction with what its result goes into, and on CPUs reduces short axes
    slowly."""
    x = jnp.abs(x).reshape(-1)
    while (n := x.size) > 1:
        half = (n + 1) // 2
        x = jnp.maximum(x[:half], x[n - half :])
    return x[0]


def _ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: no correction at all is no error at all."""
    return jnp.where(a == 0, 0, a / b)
