"""An expectation to compute: the checked arguments, and single steps."""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .._arguments import (
    brief,
    check_real,
    check_solver,
    check_state,
    check_takes,
    parameters,
    whole_number,
)
from .._brownian import has_bounded_increments, is_random
from .._compat import is_traced
from .._custom_types import Args, IntScalarLike, RealScalarLike, Y
from .._root_finder import all_finite
from .._signature import once_for_each_signature
from .._solver import AbstractSymplecticSolver, check_resolution, own_path, Want
from .._terms import (
    brownian_paths,
    check_fit,
    check_start,
    check_stratonovich,
    constraint_of,
    evaluated,
    has_lifted,
    specified,
)
from .kinks import may_have_kinks
from .moments import level_weights
from .polynomials import tensordot
from .sampling import real


# Folded into the key of a sample to draw its `y0` and `args`. The keys of its paths are
# folded from the words of the user's keys: a number that is unlikely to be one of them.
_START = 0x517A87


class Level(eqx.Module):
    """One step size: its index, counted from the coarsest, the number of steps, and the
    steps after which to average."""

    index: Int[Array | np.ndarray, ""]
    h: Float[Array | np.ndarray, ""]
    num_steps: Int[Array | np.ndarray, ""]
    saved_steps: Int[Array | np.ndarray, " saves"]


class Problem(eqx.Module):
    """The arguments of `expectation`, by the same names, and the levels, along a leading
    axis. Where `y0` or `args` is a function of a random key, `y0` and `args` are an example
    of its values. Outside of programs times, levels and weights are NumPy arrays: there
    each operation of JAX is a program of its own, which takes some 20 ms to compile."""

    phi: Callable[[RealScalarLike, Y, Args], PyTree]
    terms: PyTree[diffrax.AbstractTerm]
    solver: diffrax.AbstractSolver
    t0: Float[Array | np.ndarray, ""]
    y0: Y
    args: Args
    # The functions of a random key that draw `y0` and `args` for each path.
    y0_of: Callable | None
    args_of: Callable | None
    levels: Level
    # An array, so that other weights do not compile anew.
    weights: Float[Array | np.ndarray, "combinations levels"]
    # Whether to average at `t1` only, without an axis of times.
    at_end: bool = eqx.field(static=True)
    # The number of steps on the finest level. (Shapes must be known when compiling.)
    max_steps: int = eqx.field(static=True)

    @staticmethod
    def of(
        phi,
        terms,
        solver,
        t0,
        t1,
        dt0,
        y0,
        args,
        ts,
        levels,
        want: Want = "weak",
        user: str = "expectation",
    ) -> "Problem":
        """Raises a `ValueError` for bad arguments of `user`, the function called. `want` is
        the purpose of the paths that take the place of shapes."""
        levels = whole_number("levels", levels)
        check_solver("solver", solver)
        if isinstance(solver, diffrax.HalfSolver):
            raise ValueError(
                "`solver` must take fixed steps; got a `diffrax.HalfSolver`."
            )
        # In each sample other keys take the place of these.
        terms = specified(terms, ft.partial(own_path, solver, want))
        saved_steps, num_steps = _steps(t0, t1, dt0, ts)
        # Any draw has the right structure.
        args_of = args if callable(args) else None
        args = args if args_of is None else _drawn_args(args_of, jr.key(0))
        y0_of = y0 if callable(y0) else None
        y0 = _state(y0) if y0_of is None else _drawn_state(y0_of, jr.key(1), args)
        check_state(y0, user)
        if y0_of is None and not _is_finite(y0):
            raise ValueError(f"`y0` must hold finite numbers; got {brief(y0)}.")
        start = np.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
        _check_shapes(phi, terms, start, y0, args)
        if constraint_of(terms) is not None:
            check_start(terms, start, y0, args)
        _check_noise(terms)
        smallest = float(dt0) / 2 ** (levels - 1)
        if isinstance(solver, AbstractSymplecticSolver):
            check_resolution(smallest, float(t0), float(t1), start.dtype)
        check_stratonovich(terms, solver, start, y0, args, all_terms=True)
        _check_cells(terms, t0, smallest)
        if num_steps * 2.0 ** (levels - 1) >= 2**31:
            raise ValueError(
                f"`levels={levels}` halves `dt0` {levels - 1} times, which is more than "
                "2^31 steps. Pass fewer levels: two to four are enough to extrapolate."
            )
        finer = 2 ** np.arange(levels, dtype=np.int32)
        grid = Level(
            np.arange(levels, dtype=np.int32),
            np.asarray(float(dt0) / finer, start.dtype),
            finer * num_steps,
            finer[:, None] * saved_steps,
        )
        order = getattr(solver, "weak_order", lambda terms: 1)(terms) or 1
        weights = np.asarray(level_weights(order, levels), jnp.result_type(float))
        at = grid, weights, ts is None, int(finer[-1] * num_steps)
        return Problem(phi, terms, solver, start, y0, args, y0_of, args_of, *at)

    def level(self, index: IntScalarLike) -> Level:
        if is_traced(index):
            return jtu.tree_map(lambda x: jnp.asarray(x)[index], self.levels)
        return jtu.tree_map(lambda x: x[index], self.levels)

    @property
    def has_kinks(self) -> bool:
        """Whether `phi` may not be smooth."""
        phi = lambda y: self.phi(self.t0, y, self.args)
        return may_have_kinks(phi, self.y0)

    @property
    def paths_differ(self) -> bool:
        """Whether not all paths have the same `y0` and `args`."""
        return self.y0_of is not None or self.args_of is not None

    def drawn(self, key: PRNGKeyArray) -> tuple[Y, PyTree[Array]]:
        """The initial state of the sample with this key, and its own `args` as arrays for
        `with_args`: nothing unless they are drawn."""
        for_y0, for_args = jr.split(jr.fold_in(key, _START))
        own = None
        if self.args_of is not None:
            own = eqx.filter(_drawn_args(self.args_of, for_args), eqx.is_array)
        if self.y0_of is None:
            return self.y0, own
        return _drawn_state(self.y0_of, for_y0, self.with_args(own).args), own

    def with_args(self, own: PyTree[Array]) -> "Problem":
        """The problem of a path that was drawn."""
        if self.args_of is None and own is None:
            return self
        rest = eqx.filter(self.args, eqx.is_array, inverse=True)
        return dataclasses.replace(self, args=eqx.combine(own, rest))

    def init(self, terms, i, h: Float[Array | np.ndarray, ""], y: Y) -> PyTree[Array]:
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
        self, kinds: Sequence[Float[Array | np.ndarray, "combinations S n m"]]
    ) -> PyTree[Array]:
        """The `values` of `Samples` from these kinds."""
        x = jnp.stack(kinds)
        return self.unravel(x[:, :, 0] if self.at_end else jnp.swapaxes(x, 2, 3))

    def shapes_of_samples(self, kinds: int) -> PyTree[jax.ShapeDtypeStruct]:
        """The shapes of the `values` of one sample, with this number of kinds."""
        (times, m), dtype = self.num_outputs, self.dtype_of_values
        zeros = np.zeros((len(self.weights), times, 1, m), dtype)
        averaged = jax.eval_shape(lambda: self.averaged([zeros] * kinds))
        one = lambda s: jax.ShapeDtypeStruct((*s.shape[:2], *s.shape[3:]), s.dtype)
        return jtu.tree_map(one, averaged)

    @property
    def bounded(self) -> bool:
        """Whether the increments of all paths are known to be bounded."""
        return all(has_bounded_increments(path) for path in brownian_paths(self.terms))

    @property
    def dtype_of_values(self) -> Any:
        return jax.eval_shape(lambda: self.values(self.t0, self.y0)).dtype

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*jtu.tree_leaves(self.y0))

    @property
    def num_outputs(self) -> tuple[int, int]:
        """The number of times at which to average, and of components of `phi`."""
        m = jax.eval_shape(lambda: self.values(self.t0, self.y0)).size
        return self.levels.saved_steps.shape[1], m


def _state(y0: Y) -> Y:
    return jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), y0)


def _is_finite(y0: Y) -> bool:
    return all(np.all(np.isfinite(x)) for x in jtu.tree_leaves(y0))


def _drawn_state(y0_of: Callable, key: PRNGKeyArray, args: Args) -> Y:
    # By its name, since a function of the key may have other parameters with defaults.
    if "args" in parameters(y0_of):
        check_takes("y0", y0_of, "key", "args")
        return _state(y0_of(key, args))
    check_takes("y0", y0_of, "key")
    return _state(y0_of(key))


def _drawn_args(args_of: Callable, key: PRNGKeyArray) -> Args:
    check_takes("args", args_of, "key")
    try:
        args = args_of(key)
    except TypeError as error:
        error.add_note(
            "`args` is called with a random key, to draw the `args` of each path. If your "
            "Hamiltonians take a function in `args`, pass it in a tuple or a dictionary."
        )
        raise
    is_numpy = lambda x: isinstance(x, np.ndarray | np.generic)
    return jtu.tree_map(lambda x: jnp.asarray(x) if is_numpy(x) else x, args)


def ravel(y: Y) -> Float[Array, " d"]:
    return jfu.ravel_pytree(y)[0]


def numbers(tree: PyTree) -> Float[Array, " m"]:
    """The leaves as one vector of real numbers."""
    x = ravel(tree)
    return x.astype(real(x.dtype))


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
            "Choose a `dt0` that divides the intervals between `t0`, `t1` and `ts`: `t1` "
            "and each of `ts` must be a whole number of steps after `t0`. Got "
            f"dt0={dt0}, t0={t0}, t1={t1} and ts={brief(times)}."
        )
    if len(times) == 0 or np.any(whole < 0) or np.any(whole > whole[-1]):
        raise ValueError(
            "`ts` must hold at least one time, all between `t0` and `t1`; got "
            f"{brief(times)}."
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


@once_for_each_signature
def _check_shapes(phi: Callable, terms, start, y0: Y, args: Args) -> None:
    """Raises an error unless terms and `phi` fit the state, and the latter is real."""
    check_fit(terms, start, y0, args)
    check_takes("phi", phi, "t", "y", "args")
    check_real("phi", jtu.tree_leaves(_shape_of(phi, terms, start, y0, args)))


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
