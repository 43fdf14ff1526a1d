"""The loop over fixed steps that all samplings share."""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._arguments import check_solver, check_takes, whole_number
from .._brownian import is_random
from .._custom_types import Args, RealScalarLike, Y
from .._root_finder import all_finite
from .._solver import AbstractSymplecticSolver, check_resolution
from .._suggest import own_path, specified
from .._terms import (
    additive_fault,
    brownian_paths,
    check_fit,
    evaluated,
    has_lifted,
    separable_fault,
    split_terms,
)
from ._polynomials import tensordot
from ._sampling import real


class Level(eqx.Module):
    """One step size: its index, counted from the coarsest, the number of steps, and the
    steps after which to average."""

    index: Int[Array, ""]
    h: Float[Array, ""]
    num_steps: Int[Array, ""]
    saved_steps: Int[Array, " saves"]


class Problem(eqx.Module):
    """The arguments of `expectation`, by the same names, and the levels, along a leading
    axis."""

    phi: Callable[[RealScalarLike, Y, Args], PyTree]
    terms: PyTree[diffrax.AbstractTerm]
    solver: diffrax.AbstractSolver
    t0: Float[Array, ""]
    y0: Y
    args: Args
    levels: Level
    # An array, so that other weights do not compile anew.
    weights: Float[Array, "combinations levels"]
    # Whether to average at `t1` only, without an axis of times.
    at_end: bool = eqx.field(static=True)
    # The number of steps on the finest level. (Shapes must be known when compiling.)
    max_steps: int = eqx.field(static=True)

    @staticmethod
    def of(phi, terms, solver, t0, t1, dt0, y0, args, ts, levels) -> "Problem":
        """Raises a `ValueError` for bad arguments of `expectation`."""
        levels = whole_number("levels", levels)
        check_solver("solver", solver)
        if isinstance(solver, diffrax.HalfSolver):
            raise ValueError(
                "`solver` must take fixed steps; got a `diffrax.HalfSolver`."
            )
        # Each sample gets new keys, different for different ones.
        terms = specified(terms, ft.partial(own_path, solver, "weak"))
        saved_steps, num_steps = _steps(t0, t1, dt0, ts)
        if callable(y0):
            raise ValueError(
                "`y0` must be a state; got a function. For a random initial state, use "
                "`monte_carlo` with a function of the key that draws the state and solves."
            )
        y0 = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), y0)
        if not all_finite(y0):
            raise ValueError(f"`y0` must hold finite numbers; got {y0}.")
        start = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
        check_fit(terms, start, y0, args)
        _check_noise(terms)
        smallest = float(dt0) / 2 ** (levels - 1)
        if isinstance(solver, AbstractSymplecticSolver):
            check_resolution(smallest, float(t0), float(t1), start.dtype)
        _check_sense(terms, solver, start, y0, args)
        _check_cells(terms, t0, smallest)
        check_takes("phi", phi, "t", "y", "args")
        check_real("phi", jtu.tree_leaves(_shape_of(phi, terms, start, y0, args)))
        if num_steps * 2.0 ** (levels - 1) >= 2**31:
            raise ValueError(
                f"`levels={levels}` halves `dt0` {levels - 1} times, which is more than "
                "2^31 steps. Pass fewer levels: two to four are enough to extrapolate."
            )
        finer = 2 ** np.arange(levels, dtype=np.int32)
        grid = Level(
            jnp.arange(levels, dtype=jnp.int32),
            jnp.asarray(float(dt0) / finer, start.dtype),
            jnp.asarray(finer * num_steps),
            jnp.asarray(finer[:, None] * saved_steps),
        )
        order = getattr(solver, "weak_order", lambda terms: 1)(terms) or 1
        weights = jnp.asarray(level_weights(order, levels), float)
        at = grid, weights, ts is None, int(finer[-1] * num_steps)
        return Problem(phi, terms, solver, start, y0, args, *at)

    def level(self, index: int) -> Level:
        return jtu.tree_map(lambda x: x[index], self.levels)

    def init(self, terms, i, h: Float[Array, ""], y: Y) -> PyTree[Array]:
        """The arrays of the solver's state before step `i`. The rest of the state does not
        change."""
        t = self.t0 + i * h
        state = self.solver.init(terms, t, t + h, y, self.args)
        return eqx.filter(state, eqx.is_array)

    def step(self, terms, i, h, y: Y, state) -> tuple[Y, PyTree, Bool[Array, ""]]:
        """One step of one path, and whether it succeeded."""
        t, next_t = self.t0 + i * h, self.t0 + (i + 1) * h
        fresh = eqx.filter_eval_shape(self.solver.init, terms, t, next_t, y, self.args)
        is_struct = lambda x: isinstance(x, jax.ShapeDtypeStruct)
        state = eqx.combine(state, eqx.filter(fresh, is_struct, inverse=True))
        y, _, _, state, result = self.solver.step(
            terms, t, next_t, y, self.args, state, made_jump=False
        )
        state = eqx.filter(state, eqx.is_array)
        return y, state, diffrax.is_okay(result) & all_finite(y)

    def values(self, t, y: Y) -> Float[Array, " m"]:
        return numbers(self.phi(t, y, self.args))

    def unravel(self, x: Float[Array, "*axes m"]) -> PyTree[Array]:
        """Flat values of `phi` in its own structure."""
        shape = jax.eval_shape(lambda: self.phi(self.t0, self.y0, self.args))
        leaves, treedef = jtu.tree_flatten(shape)
        parts = jnp.split(x, np.cumsum([s.size for s in leaves])[:-1], axis=-1)
        pairs = zip(parts, leaves)
        return treedef.unflatten([y.reshape(*x.shape[:-1], *s.shape) for y, s in pairs])

    def combined(
        self, x: Float[Array, "levels ..."]
    ) -> Float[Array, "combinations ..."]:
        return tensordot(self.weights.astype(x.dtype), x, 1)

    def averaged(
        self, kinds: list[Float[Array, "combinations S n m"]]
    ) -> PyTree[Array]:
        """The `values` of `Samples` from these kinds."""
        x = jnp.stack(kinds)
        return self.unravel(x[:, :, 0] if self.at_end else jnp.swapaxes(x, 2, 3))

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*jtu.tree_leaves(self.y0))

    @property
    def num_outputs(self) -> tuple[int, int]:
        """The number of times at which to average, and of components of `phi`."""
        m = jax.eval_shape(lambda: self.values(self.t0, self.y0)).size
        return self.levels.saved_steps.shape[1], m


class Ensemble(eqx.Module):
    """Paths, along the first axis of each array."""

    y: Y
    solver_state: PyTree[Array]
    # A failed path stays failed, and continues from `y0`: otherwise stage equations without
    # a solution would hold up the other paths in every later step.
    failed: Bool[Array, " n"]
    # The control variate, if any.
    control: Any

    @staticmethod
    def start(p: Problem, n: int, state: PyTree[Array], control=None) -> "Ensemble":
        y = jtu.tree_map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), p.y0)
        return Ensemble(y, state, jnp.zeros(n, bool), control)

    def moved(self, p: Problem, y, state, success, control=None) -> "Ensemble":
        """The paths after a step to `y`, with failed paths reset."""
        failed = self.failed | ~success
        keep = lambda new, old: jnp.where(along(failed, new), old, new)
        state = jtu.tree_map(keep, state, self.solver_state)
        return Ensemble(jtu.tree_map(keep, y, p.y0), state, failed, control)


def simulate(
    p: Problem,
    begin: Callable[[Level], tuple[Callable, Ensemble]],
    measure: Callable[[Array, Bool[Array, " n"]], Array] = lambda phi, failed: phi,
) -> tuple[Float[Array, "levels S ..."], Bool[Array, "levels n"], Any]:
    """Solves all levels. For each level `begin` returns `step(i, paths)` and the initial
    paths. Returns `measure(phi, failed)` after each saved step, which paths have failed at
    the end, and their control variates."""

    def on_level(level):
        step, paths = begin(level)
        n, (saves, m) = len(paths.failed), p.num_outputs

        def recorded(i, paths: Ensemble, saved):
            def record():
                phi = jax.vmap(lambda y: p.values(p.t0 + i * level.h, y))(paths.y)
                failed = paths.failed | ~jax.vmap(all_finite)(phi)
                here = along(level.saved_steps == i, saved)
                return failed, jnp.where(here, measure(phi, failed), saved)

            # One predicate for all paths, so that `phi` is evaluated only after saved
            # steps.
            here = jnp.any(level.saved_steps == i)
            failed, saved = lax.cond(here, record, lambda: (paths.failed, saved))
            return eqx.tree_at(lambda e: e.failed, paths, failed), saved

        def body(i, carry):
            paths, saved = carry
            return recorded(i + 1, step(i, paths), saved)

        dtype = jax.eval_shape(lambda: p.values(p.t0, p.y0)).dtype
        phi = jax.ShapeDtypeStruct((n, m), dtype)
        shape = jax.eval_shape(measure, phi, paths.failed).shape
        carry = recorded(0, paths, jnp.zeros((saves, *shape), dtype))
        paths, saved = lax.fori_loop(0, level.num_steps, body, carry)
        return saved, paths.failed, paths.control

    if len(p.levels.h) == 1:
        return jtu.tree_map(lambda x: x[None], on_level(p.level(0)))
    # All levels share one compiled program.
    return lax.map(on_level, p.levels)


def independent_steps(
    p: Problem, level: Level, n: int, terms_of: Callable, randomness: Callable
) -> tuple[Callable[[Any, Ensemble], Ensemble], Ensemble]:
    """The step of `n` independent paths, and these paths at the start. In step `i` each
    path has the terms `terms_of(r)`, with `r` its own row of `randomness(i)`."""

    def step(i, paths):
        one = lambda random, y, state: p.step(terms_of(random), i, level.h, y, state)
        return paths.moved(
            p, *jax.vmap(one)(randomness(i), paths.y, paths.solver_state)
        )

    start = lambda random: p.init(terms_of(random), 0, level.h, p.y0)
    return step, Ensemble.start(p, n, jax.vmap(start)(randomness(0)))


def _steps(t0, t1, dt0, ts: Sequence | None) -> tuple[np.ndarray, np.integer]:
    """The numbers of steps after which to average, and the number of all steps."""
    if dt0 is None:
        raise ValueError("`dt0` must be a number: steps are fixed; got None.")
    given = f"got dt0={dt0!r}, t0={t0!r}, t1={t1!r}"
    if not all(eqx.is_array_like(x) and np.ndim(x) == 0 for x in (t0, t1, dt0)):
        raise ValueError(f"`t0`, `t1` and `dt0` must be numbers; {given}.")
    t0, t1, dt0 = float(t0), float(t1), float(dt0)
    if not (0 < dt0 < np.inf and t0 < t1 < np.inf):
        raise ValueError(f"`dt0` must be positive, and `t1` after `t0`; {given}.")
    times = np.array([t1] if ts is None else ts, float).reshape(-1)
    counts = (np.append(times, t1) - t0) / dt0
    whole = np.round(counts)
    if not np.all(np.abs(counts - whole) <= 1e-6 * np.maximum(whole, 1)):
        raise ValueError(
            "`t1` and each of `ts` must be a whole number of steps after `t0`; got "
            f"t0={t0}, dt0={dt0}, t1={t1} and ts={ts}. Choose a `dt0` that divides the "
            "intervals between them."
        )
    if len(times) == 0 or np.any(whole < 0) or np.any(whole > whole[-1]):
        raise ValueError(
            f"`ts` must hold at least one time, all between `t0` and `t1`; got {ts}."
        )
    *saved, num_steps = whole.astype(np.int32)
    return np.array(saved), num_steps


def _check_noise(terms) -> None:
    """Raises a `ValueError` if nothing in the terms is random."""
    if len(brownian_paths(terms)) == 0:
        raise ValueError(
            "`terms` have no Brownian path, so nothing is random. Solve them once, with "
            "`diffrax.diffeqsolve`."
        )
    if not any(map(is_random, brownian_paths(terms))):
        raise ValueError(
            "No Brownian path in `terms` has a random key, so all samples would have the "
            "same noise. Solve once, with `diffrax.diffeqsolve`. If your path draws its "
            "own noise, give it a field that holds a JAX random key. To average over many "
            "records, pass `monte_carlo` a function that draws one of them."
        )


def _check_sense(terms, solver, t0, y0: Y, args: Args) -> None:
    """Raises a `ValueError` for Ito solvers, unless both senses agree: for additive noise,
    and for noise that changes `p` and depends on `q`."""
    if not isinstance(solver, diffrax.AbstractItoSolver):
        return
    noise = tuple(split_terms(terms)[1])
    if additive_fault(noise, t0, y0, args) and separable_fault((), noise, t0, y0, args):
        raise ValueError(
            f"`{type(solver).__name__}` solves equations in the sense of Ito, but "
            "`expectation` takes all terms in the sense of Stratonovich, and here the two "
            "differ. Use a solver of this package, or a Stratonovich solver of Diffrax "
            "such as `diffrax.Heun`. If you mean the Ito equation, add its drift "
            "correction, or pass your own solve to `monte_carlo`."
        )


def _check_cells(terms, t0, h: float) -> None:
    """Raises a `ValueError` for steps that are not made up of whole cells of a path."""
    for path in brownian_paths(terms):
        cell = getattr(path, "cell", None)
        whole = lambda x: abs(x / cell - round(x / cell)) <= 1e-3
        if cell is not None and not (whole(float(t0)) and whole(h)):
            raise ValueError(
                f"Steps of a `{type(path).__name__}` with `cell` must begin and end at "
                f"multiples of `cell`; got cell={cell}, t0={t0} and the smallest step {h}. "
                "Pass a `cell` that divides `t0` and the steps of all `levels`."
            )


def _shape_of(phi: Callable, terms, t0, y0: Y, args: Args) -> PyTree:
    """The shape of `phi`'s result. Errors explain which state `phi` gets."""
    once = lambda t, y, args: evaluated("phi", phi, t, y, args=args)
    try:
        return eqx.filter_eval_shape(once, t0, y0, args)
    except (TypeError, AttributeError, IndexError) as error:
        if has_lifted(terms):
            error.add_note(
                "For spins and complex amplitudes `phi(t, y, args)` gets the pair "
                "`(p, q)`: call `from_spinors(y)` or `from_pair(y)` in it."
            )
        raise


def level_weights(order: int, levels: int) -> Float[np.ndarray, "combinations levels"]:
    r"""The combinations of the means with steps $h, h/2, h/4, \ldots$ that an
    [`diffrax_symplectic.Expectation`][] holds, for a method of weak order $p$. For $L$
    levels the first eliminates the error terms in $h^p, \ldots, h^{p + L - 2}$. With
    $L > 1$ there are two more: the finest level's mean minus the first, and the change by
    the last extrapolation.

    [Talay and Tubaro (1990)](https://doi.org/10.1080/07362999008809220) show that the error
    has an expansion in powers of $h$.
    """
    best = _extrapolated(order, levels)
    if levels == 1:
        return best[None]
    # The finer levels alone, which eliminate one power of the step size less.
    before = np.append(0.0, _extrapolated(order, levels - 1))
    return np.stack([best, np.eye(levels)[-1] - best, best - before])


def _extrapolated(order: int, levels: int) -> Float[np.ndarray, " levels"]:
    powers = np.array([0, *range(order, order + levels - 1)])
    system = 2.0 ** -np.outer(powers, np.arange(levels))
    return np.linalg.solve(system, np.eye(levels)[0])


def along(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask of the first axis, broadcastable against `x`."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))


def ravel(y: Y) -> Float[Array, " d"]:
    return jfu.ravel_pytree(y)[0]


def numbers(tree: PyTree) -> Float[Array, " m"]:
    """The leaves as one vector of real numbers."""
    x = ravel(tree)
    return x.astype(real(x.dtype))


def check_real(name: str, leaves: list) -> None:
    if len(leaves) == 0:
        raise ValueError(f"`{name}` must return real arrays; it returned none.")
    kinds = jnp.floating, jnp.integer, jnp.bool_
    dtypes = [getattr(s, "dtype", type(s)) for s in leaves]
    if not all(any(jnp.issubdtype(d, k) for k in kinds) for d in dtypes):
        raise ValueError(
            f"`{name}` must return real arrays; got dtypes {[str(d) for d in dtypes]}. "
            "For complex numbers return their real and imaginary parts."
        )
