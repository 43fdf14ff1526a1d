"""The states of many paths at given times."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, get_args

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray, PyTree

from ._arguments import brief, check_memory, ShortTraceback, whole_number
from ._compat import is_traced
from ._custom_types import Args, IntScalarLike, RealScalarLike, Y
from ._fused import sample_key
from ._simulation import (
    advice_on_failures,
    Batch,
    check_gaussian,
    checked_key,
    ENGINES,
    Problem,
    state_itself,
    warn_of_stragglers,
    warn_of_truncation,
)
from ._solver import Want
from ._terms import path_keys, which_are_shapes, with_keys


# The number of entries of all states in a batch, for each engine on CPUs. So many keep
# every core busy, and take tens of megabytes.
_ENTRIES_OF_BATCH = {"jax": 2**17, "drjit": 2**20}
# On accelerators a batch has this many times as many entries.
_FACTOR_ON_ACCELERATORS = 16
# The fewest paths in a batch. For large states, smaller batches would be too many.
_FEWEST_PATHS = 256


class Ensemble(eqx.Module):
    """The paths of [`diffrax_symplectic.ensemble`][].

    - `ts`: the saved times.
    - `ys`: the states at these times, as NumPy arrays. The first axis is the path; if `ts`
        was passed, the second is the time. All states of a failed path are NaN.
    - `failed`: which paths failed.
    - `num_stragglers`: how many paths `engine="drjit"` handed back to JAX.
    - `engine`: the engine that simulated the paths.
    """

    ts: Float[np.ndarray, " times"]
    ys: PyTree[np.ndarray]
    failed: Bool[np.ndarray, " num_paths"]
    num_stragglers: int
    engine: str
    _problem: Problem
    _key: Any

    @property
    def num_failed(self) -> int:
        return int(np.sum(self.failed))

    def terms(self, number: IntScalarLike) -> PyTree[diffrax.AbstractTerm]:
        """The terms of path number `number`, with its random keys. Passed to
        `diffrax.diffeqsolve` they give the same path, for example to save it at more
        times. `number` may be traced, to solve several paths by `jax.vmap`."""
        terms = self._problem.terms
        return with_keys(terms, path_keys(terms, self._key_of(number)))

    def start(self, number: IntScalarLike) -> tuple[Y, Args]:
        """The initial state and the `args` of path number `number`, which may be traced."""
        y0, own_args = self._problem.draw_start(self._key_of(number))
        return y0, self._problem.with_args(own_args).args

    def _key_of(self, number: IntScalarLike) -> PRNGKeyArray:
        """The random key of path number `number`. Raises a `ValueError` unless the number
        is an integer, and not negative. (The sign of traced numbers is not known.)"""
        is_scalar = eqx.is_array_like(number) and jnp.shape(number) == ()
        if not is_scalar or not jnp.issubdtype(jnp.result_type(number), jnp.integer):
            raise ValueError(
                f"`number` must be one integer, 0 or larger; got {brief(number)}. For "
                "several paths, batch over their numbers: `jax.vmap(paths.start)(numbers)`."
            )
        if not is_traced(number):
            number = whole_number("number", int(number), least=0)
        return sample_key(self._key, *_high_and_low(number))


def _high_and_low(number: IntScalarLike) -> tuple[ArrayLike, ArrayLike]:
    """The high and the low 32 bits of an integer that is not negative: a traced one, or an
    `int` of Python, which may have more bits than integers of JAX."""
    if not is_traced(number):
        high, low = divmod(number, 2**32)
        return np.uint32(high), np.uint32(low)
    traced_number = jnp.asarray(number)
    # The shift gives zero, as it should, if the integer type has 32 bits or fewer.
    return (traced_number >> 32).astype(jnp.uint32), traced_number.astype(jnp.uint32)


def ensemble(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    dt0: RealScalarLike,
    y0: Y | Callable[..., Y],
    args: Args | Callable[[PRNGKeyArray], Args] = None,
    *,
    key: PRNGKeyArray,
    num_paths: int,
    ts: Sequence[RealScalarLike] | np.ndarray | Array | None = None,
    want: Want = "strong",
    engine: str | None = None,
    batch_size: int | None = None,
) -> Ensemble:
    r"""Solves for many independent paths and returns their states, for histograms, spectra,
    and clouds in phase space.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.2 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ())  # the shape of one noise
        y0 = (jnp.array(0.0), jnp.array(1.0))
        paths = ds.ensemble(
            terms, ds.StormerVerlet(), 0, 10, 0.1, y0, key=jr.key(1), num_paths=10_000
        )
        p, q = paths.ys
        print(q.shape, q.std(), paths.num_failed)
        ```

    Path $i$ depends on `key` and $i$ only. With `terms(i)` and `start(i)` of the result,
    `diffrax.diffeqsolve` gives the same path. `y0` may be a function that draws a start for
    each path. With more paths, only the returned arrays take more memory. For events along
    a path use [`diffrax_symplectic.monte_carlo`][].

    **Noise.** If `terms` hold a shape, the solver makes a path with Gaussian increments.
    For implicit solvers, the increments of noise that depends on the state are bounded by a
    [`diffrax_symplectic.TruncatedBrownianPath`][], which takes at most 0.04% of their
    variance. (You are warned if a truncated path of your own takes more than 0.1%.) The
    discrete increments of `want="weak"` take less time, and give the right means of smooth
    functions only. Solvers with discrete increments only, such as
    [`diffrax_symplectic.AdditiveGauss`][], need `want="weak"`.

    **Engines.** `engine="drjit"` fuses all steps into one kernel, several times as fast;
    see [Large ensembles][large-ensembles]. `"jax"` is the default.

    **Arguments:**

    - `terms`, `solver`, `t0`, `t1`, `dt0`, `y0`, `args`, `key`, `ts`: as for
        [`diffrax_symplectic.expectation`][].
    - `num_paths`: the number of paths.
    - `want`: `"strong"` for Gaussian increments, or `"weak"` for discrete ones, where
        `terms` have the shape of a path; a path itself is kept.
    - `engine`: `"jax"`, `"drjit"`, or `None`, which means `"jax"`.
    - `batch_size`: the number of paths to simulate at once. By default, the states of a
        batch have 131,072 entries, with Dr.Jit a million; on accelerators 16 times as many.

    **Returns:** an [`diffrax_symplectic.Ensemble`][].

    **Raises:** what [`diffrax_symplectic.expectation`][] raises, and a `ValueError` if
    `engine` or `want` is unknown, or if a solver with discrete increments only would have
    to make a path and `want` is not `"weak"`. With `engine="drjit"`: a `ValueError` if the
    system uses an operation that cannot be replayed, its state has more than 256 entries,
    or a `PicardNewton` has another tolerance than rounding error, and an `ImportError` if
    Dr.Jit or LLVM is missing. Warns if paths failed, if Dr.Jit handed many paths back to
    JAX, and if a truncated path of your own takes more than 0.1% of the variance of
    increments.
    """
    key = checked_key("ensemble", key, (terms, t0, t1, dt0, y0, args))
    num_paths = whole_number("num_paths", num_paths)
    engine = "jax" if engine is None else engine
    if engine not in ENGINES:
        raise ValueError(f'`engine` must be "jax", "drjit" or `None`; got {engine!r}.')
    if want not in get_args(Want):
        raise ValueError(f"`want` must be one of {get_args(Want)}; got {want!r}.")
    with ShortTraceback():
        problem = Problem.of(
            state_itself, terms, solver, t0, t1, dt0, y0, args, ts,
            levels=1, want=want, caller="ensemble", key=key,
        )  # fmt: skip
    if want == "strong" and any(which_are_shapes(terms)):
        check_gaussian(solver)
    warn_of_truncation(problem.terms, float(dt0), stacklevel=2)
    num_times = problem.levels.saved_steps.size
    check_memory("num_paths", num_paths, num_times * problem.bytes_of_state)
    if batch_size is None:
        batch_size = _default_batch_size(problem, engine)
    batch_size = min(whole_number("batch_size", batch_size), num_paths)
    all_paths = _in_batches(problem, key, num_paths, batch_size, engine)
    num_failed = int(np.sum(all_paths.failed))
    if num_failed > 0:
        warnings.warn(
            f"{num_failed:,} of {num_paths:,} paths failed. Their states are NaN: select "
            f"the others with `~failed`. {advice_on_failures(problem)}",
            stacklevel=2,
        )
    warn_of_stragglers(all_paths.num_stragglers, num_failed, num_paths, stacklevel=2)
    # The times at which steps end. (The times in `ts` may differ from these by rounding.)
    level = problem.level(0)
    saved_times = float(problem.t0) + np.asarray(level.saved_steps) * float(level.h)
    return Ensemble(
        ts=saved_times,
        ys=all_paths.y,
        failed=all_paths.failed,
        num_stragglers=all_paths.num_stragglers,
        engine=engine,
        _problem=problem,
        _key=key,
    )


def _default_batch_size(problem: Problem, engine: str) -> int:
    """The number of paths that an engine simulates at once by default."""
    num_entries = _ENTRIES_OF_BATCH[engine]
    if jax.default_backend() != "cpu":
        num_entries *= _FACTOR_ON_ACCELERATORS
    return max(_FEWEST_PATHS, num_entries // problem.num_components)


def _in_batches(
    problem: Problem, key: PRNGKeyArray, num_paths: int, batch_size: int, engine: str
) -> Batch:
    """The paths with the numbers from 0 to `num_paths - 1`, simulated in batches, as one
    `Batch`. The states of failed paths are NaN. If states are wanted at `t1` only, they
    have no axis of times."""
    batches = []
    for first in range(0, num_paths, batch_size):
        # JAX would compile anew for a last batch of another size. So it simulates a whole
        # batch, and paths with numbers from `num_paths` on are dropped below.
        size = batch_size if engine == "jax" else min(batch_size, num_paths - first)
        sample_numbers = np.arange(first, first + size, dtype=np.uint64)
        batches.append(ENGINES[engine](problem, key, sample_numbers))
    failed = np.concatenate([batch.failed for batch in batches])[:num_paths]

    def concatenate(*leaves: np.ndarray) -> np.ndarray:
        # (paths, times, ...)
        states = np.concatenate(leaves)[:num_paths]
        states[failed] = np.nan
        return states[:, 0] if problem.at_end else states

    y = jtu.tree_map(concatenate, *[batch.y for batch in batches])
    return Batch(y, failed, sum(batch.num_stragglers for batch in batches))
