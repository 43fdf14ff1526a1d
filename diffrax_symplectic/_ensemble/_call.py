"""The states of many paths at given times."""

import warnings
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray, PyTree

from .._arguments import whole_number
from .._custom_types import Args, Y
from .._expectation._monte_carlo import path_keys, with_keys
from .._expectation._run import checked_call
from .._expectation._steps import Problem
from ._engines import Batch, ENGINES, state_itself
from ._layout import sample_key


# Numbers of states in a batch: enough for all cores, and memory of a few tens of megabytes.
_NUMBERS = {"jax": 2**17, "drjit": 2**20}
# On accelerators, for which more paths are needed.
_MORE = 16
# Where a larger share of the paths is left to JAX, that takes most of the time.
_MANY = 0.05


class Ensemble(eqx.Module):
    """The paths of [`diffrax_symplectic.ensemble`][].

    - `ts`: the times.
    - `ys`: the states at these, arrays of NumPy with axes in front for the paths, and with
        `ts` for the times. NaN, at all times, for a path that failed.
    - `failed`: which paths failed.
    - `num_stragglers`: how many paths `engine="drjit"` left to JAX.
    """

    ts: Float[np.ndarray, " times"]
    ys: PyTree[np.ndarray]
    failed: Bool[np.ndarray, " num_paths"]
    num_stragglers: int
    engine: str
    _terms: Any
    _key: Any

    @property
    def num_failed(self) -> int:
        return int(np.sum(self.failed))

    def terms(self, number: int) -> PyTree[diffrax.AbstractTerm]:
        """The terms of path number `number`, with its own random keys: with these
        `diffrax.diffeqsolve` follows it, to save it at more times, say."""
        high, low = (np.uint32(x) for x in divmod(int(number), 2**32))
        key = sample_key(self._key, high, low)
        return with_keys(self._terms, path_keys(self._terms, key))


def ensemble(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: float,
    t1: float,
    dt0: float,
    y0: Y,
    args: Args = None,
    *,
    key: PRNGKeyArray,
    num_paths: int,
    ts: Sequence[float] | np.ndarray | None = None,
    engine: str | None = None,
    batch_size: int | None = None,
) -> Ensemble:
    r"""The states of many paths: for histograms, spectra, clouds in phase space.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.2 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
        y0 = (jnp.array(0.0), jnp.array(1.0))
        paths = ds.ensemble(
            terms, ds.StormerVerlet(), 0, 10, 0.1, y0, key=jr.key(1), num_paths=10_000
        )
        p, q = paths.ys
        print(q.shape, q.std(), paths.num_failed)
        ```

    Path number $i$ has random keys of its own, made from `key` and $i$, whatever
    `num_paths`, `batch_size` and `engine` are. `ensemble(...).terms(i)` has them, for
    `diffrax.diffeqsolve`. Each path begins at `y0`. They are taken in batches, so that
    memory grows with their number only by what is returned.

    **Engines.** `engine="jax"`, the default, takes all paths through each step together.
    `engine="drjit"` makes one kernel of all steps, by
    [Dr.Jit](https://drjit.readthedocs.io): in this each path is alone in the registers of
    a processor, which is several times as fast. States are the same up to rounding.
    Implicit steps that a few sweeps do not solve are rare; such paths are taken anew by
    JAX, and counted. See [Large ensembles][large-ensembles].

    **Arguments:**

    - `terms`, `solver`, `t0`, `t1`, `dt0`, `y0`, `args`, `key`, `ts`: as for
        [`diffrax_symplectic.expectation`][].
    - `num_paths`: how many.
    - `engine`: `"jax"`, `"drjit"`, or `None` for the first.
    - `batch_size`: how many paths are taken at once. By default as many as have 131,072
        numbers of state, or with Dr.Jit a million; on accelerators 16 times as many.

    **Returns:** an [`diffrax_symplectic.Ensemble`][].

    **Raises:** as [`diffrax_symplectic.expectation`][]; a `ValueError` for another
    `engine`, and with `engine="drjit"` for a system with an operation that Dr.Jit has not,
    or of more than 256 numbers; an `ImportError` where Dr.Jit or a library of LLVM is
    missing. Warns if paths failed, and if many are left to JAX.
    """
    given = terms, t0, t1, dt0, y0, args
    key, _, _ = checked_call("ensemble", key, None, None, 0, None, given)
    num_paths = whole_number("num_paths", num_paths)
    engine = "jax" if engine is None else engine
    if engine not in ENGINES:
        raise ValueError(f'`engine` must be "jax", "drjit" or `None`; got {engine!r}.')
    times = [t1] if ts is None else ts
    problem = Problem.of(state_itself, terms, solver, t0, t1, dt0, y0, args, times, 1)
    if batch_size is None:
        batch_size = _default_size(engine, problem)
    size = whole_number("batch_size", batch_size)
    batches = []
    for begin in range(0, num_paths, size):
        # JAX compiles for a size. What is too much is dropped.
        n = min(size, num_paths if engine == "jax" else num_paths - begin)
        batches.append(
            ENGINES[engine](problem, key, np.arange(begin, begin + n, dtype=np.uint64))
        )
    joined = _joined(batches, num_paths, at_end=ts is None)
    saved = np.asarray(problem.levels.saved_steps[0])
    at = float(problem.t0) + saved * float(problem.levels.h[0])
    _warn_of(joined, engine)
    return Ensemble(at, *joined, engine, terms, key)


def _default_size(engine: str, problem: Problem) -> int:
    numbers = sum(x.size for x in jtu.tree_leaves(problem.y0))
    more = 1 if jax.default_backend() == "cpu" else _MORE
    return max(256, more * _NUMBERS[engine] // numbers)


def _joined(batches: list[Batch], num_paths: int, at_end: bool) -> Batch:
    failed = np.concatenate([b.failed for b in batches])[:num_paths]

    def join(*xs: np.ndarray) -> np.ndarray:
        x = np.concatenate(xs)[:num_paths]
        x[failed] = np.nan
        return x[:, 0] if at_end else x

    y = jtu.tree_map(join, *[b.y for b in batches])
    return Batch(y, failed, sum(b.stragglers for b in batches))


def _warn_of(joined: Batch, engine: str) -> None:
    count, lost = len(joined.failed), int(np.sum(joined.failed))
    if lost > 0:
        warnings.warn(
            f"{lost:,} of {count:,} paths failed. Their states are NaN: leave them out by "
            "`~failed`. Take smaller steps or bounded increments, such as those of a "
            "`WeakBrownianPath`; and look for NaNs in `y0`, `args` and the Hamiltonians.",
            stacklevel=3,
        )
    if joined.stragglers - lost > _MANY * count:
        warnings.warn(
            f"{joined.stragglers:,} of {count:,} paths had steps that the fused kernel did "
            'not solve, and were taken anew by JAX. Take smaller steps, or `engine="jax"`.',
            stacklevel=3,
        )
