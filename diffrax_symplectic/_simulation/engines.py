"""Simulates the paths of a batch with either engine. Both take a problem, the random key
that all samples share, and consecutive sample numbers."""

import dataclasses
import functools as ft
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from .._arguments import check_untraced
from .._fused import (
    functions_and_arrays,
    Kernels,
    Lanes,
    PathFunctions,
    sample_key,
    Shared,
    without_rescue,
)
from .._lapack import lapack_in_turn
from .._stablehlo import NotReplayed, source_lines
from .levels import Level
from .loop import values_of_paths
from .problem import Problem


# Beyond this share, stragglers take most of the time.
_MANY = 0.05


def warn_of_stragglers(stragglers: int, lost: int, count: int, stacklevel: int) -> None:
    """Warns if JAX simulated many of `count` paths again, of which `lost` failed."""
    if stragglers - lost > _MANY * count:
        warnings.warn(
            f"{stragglers:,} of {count:,} paths had steps that the fused kernel did not "
            "solve, or the sine or cosine of an angle beyond 2^31 (in single precision "
            "2^13), and were simulated again by JAX. Take smaller steps or angles, or "
            '`engine="jax"`.',
            stacklevel=stacklevel + 1,
        )


# The high or the low 32 bits of the numbers of samples.
_Words: TypeAlias = Array | np.ndarray


class Batch(NamedTuple):
    """Paths along the first axis of each array, saved times along the second.

    - `y`: the states.
    - `failed`: which paths failed. Their states are meaningless.
    - `num_stragglers`: how many paths the fused kernel handed back to JAX.
    """

    y: PyTree[np.ndarray]
    failed: Bool[np.ndarray, " n"]
    num_stragglers: int = 0


def state_itself(t, y, args):
    """The function to average if the states themselves are wanted."""
    del t, args
    return y


def by_jax(
    p: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> Batch:
    """With the loop of `expectation`."""
    paths = _paths(p, key, *_halves(sample_numbers))
    # They are traced if a function closes over traced values.
    check_untraced("`ensemble`", paths)
    y, failed = jax.device_get(paths)
    return Batch(jtu.tree_map(lambda x: x[level], y), failed[level])


def _halves(sample_numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The high and the low 32 bits."""
    high = (sample_numbers >> np.uint64(32)).astype(np.uint32)
    return high, (sample_numbers & np.uint64(0xFFFFFFFF)).astype(np.uint32)


def _sample_keys(key: PRNGKeyArray, high: _Words, low: _Words) -> Array:
    """The keys of the samples with these numbers."""
    return jax.vmap(ft.partial(sample_key, key))(high, low)


@eqx.filter_jit
def _draw_starts(
    p: Problem, key: PRNGKeyArray, high: _Words, low: _Words
) -> tuple[PyTree, PyTree]:
    """`Problem.draw_start` for the paths of a batch."""
    return jax.vmap(p.draw_start)(_sample_keys(key, high, low))


@eqx.filter_jit
@lapack_in_turn
def _paths(
    p: Problem, key: PRNGKeyArray, high: _Words, low: _Words
) -> tuple[PyTree[Array], Bool[Array, "levels n"]]:
    """The saved states of the paths of a batch, along axes of levels, paths and times, and
    which paths failed."""
    states, failed = values_of_paths(p, _sample_keys(key, high, low))
    return p.unravel(jnp.swapaxes(states, 1, 2)), failed


def by_drjit(
    p: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> Batch:
    """With a fused kernel. JAX simulates again the paths that the kernel could not finish.

    Raises an `ImportError` without Dr.Jit, and a `ValueError` if the system cannot be
    replayed."""
    try:
        fused = _fused_batch(p, key, sample_numbers, level)
    except ImportError as error:
        raise ImportError(
            f'`engine="drjit"` needs Dr.Jit. {error}; or pass `engine="jax"`, which needs '
            "nothing else."
        ) from error
    except (NotReplayed, RuntimeError) as error:
        refused = _refusal(error)
        if refused is None:
            raise
        # The errors behind it are about recordings, and pages long.
        raise refused from None
    if fused.num_stragglers == 0:
        return fused
    return _with_stragglers(p, key, sample_numbers, level, fused)


def _fused_batch(
    p: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int
) -> Batch:
    """The paths from the kernel alone: those that it did not finish count as failed."""
    kernels, lanes, shared = fused_start(p, key, sample_numbers, level)
    saved_steps = np.asarray(p.level(level).saved_steps)
    # From the number of a step to the entries of all states after it. The kernel is called
    # for the steps between two times.
    after: dict[int, list[np.ndarray]] = {}
    done = 0
    for step in np.unique(saved_steps).tolist():
        if step > done:
            lanes = kernels.advance(lanes, shared, done, step)
        done = step
        after[step] = [np.asarray(entry) for entry in lanes.y]
    entries = [
        np.stack([after[step][k] for step in saved_steps.tolist()], axis=1)
        for k in range(len(lanes.y))
    ]
    stopped = np.asarray(lanes.stopped)
    return Batch(_states_of_entries(p.y0, entries), stopped, int(np.sum(stopped)))


class FusedStart(NamedTuple):
    """The paths of a batch before their first step, and the kernels that take their steps:
    `kernels.advance(lanes, shared, begin, end)`.
    """

    kernels: Kernels
    lanes: Lanes
    shared: Shared


def fused_start(
    p: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> FusedStart:
    """Compiles the kernels of a problem, unless they are known, and starts these paths."""
    own_args = None if p.args_of is None else eqx.filter(p.args, eqx.is_array)
    functions, arrays = functions_and_arrays(_bare(p), key, own_args, p.paths_differ)
    kernels = _kernels(functions)
    if p.paths_differ:
        y0, args = _draw_starts(p, key, *_halves(sample_numbers))
    else:
        y0 = p.y0
        args = None
    h = p.level(level).h
    first = int(sample_numbers[0])
    lanes, shared = kernels.begin(arrays, key, h, first, len(sample_numbers), y0, args)
    return FusedStart(kernels, lanes, shared)


def _bare(p: Problem) -> Problem:
    """The problem as a kernel is compiled for it: with plain sweeps for root finders, and
    without step sizes, times and numbers of steps, which are inputs of the kernel."""
    none = jnp.zeros(1, jnp.int32)
    level = Level(none, jnp.ones_like(p.levels.h[:1]), none, none[None])
    return dataclasses.replace(
        p,
        solver=without_rescue(p.solver),
        y0_of=None,
        args_of=None,
        levels=level,
        weights=jnp.ones((1, 1)),
        at_end=True,
        finest_steps=1,
    )


# A kernel keeps what the user's functions capture, so only a few are kept.
@ft.lru_cache(maxsize=8)
def _kernels(functions: PathFunctions) -> Kernels:
    return Kernels(functions)


def _with_stragglers(
    p: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int, fused: Batch
) -> Batch:
    """The paths of a batch, with those that the kernel did not finish simulated by JAX."""
    # What the kernel returned for these is where it stopped. From there JAX would need the
    # solver's state, too: it begins anew, which also gives the same path as without kernel.
    (which,) = np.nonzero(fused.failed)
    # Rounded up to a power of four, so that JAX compiles few programs.
    power = int(np.ceil(np.log(len(which)) / np.log(4)))
    size = min(len(sample_numbers), 4**power)
    rest = by_jax(p, key, sample_numbers[np.resize(which, size)], level)

    def with_those_of_jax(fused: np.ndarray, by_jax: np.ndarray) -> np.ndarray:
        y = np.array(fused)
        y[which] = by_jax[: len(which)]
        return y

    failed = np.zeros(len(sample_numbers), bool)
    failed[which] = rest.failed[: len(which)]
    return Batch(jtu.tree_map(with_those_of_jax, fused.y, rest.y), failed, len(which))


def _states_of_entries(y0: PyTree, entries: list[np.ndarray]) -> PyTree[np.ndarray]:
    """States in the structure of `y0`, with leading axes for paths and times, from their
    entries, each an array with these axes."""
    leaves, treedef = jtu.tree_flatten(y0)
    left = iter(entries)
    axes = entries[0].shape
    each = []
    for leaf in leaves:
        of_leaf = [next(left) for _ in range(leaf.size)]
        if of_leaf:
            stacked = np.stack(of_leaf, axis=-1)
        else:
            # An empty array has no entries to stack.
            stacked = np.zeros((*axes, 0), leaf.dtype)
        each.append(stacked.reshape(*axes, *leaf.shape))
    return treedef.unflatten(each)


def _refusal(error: BaseException | None) -> ValueError | None:
    """The error for the user if an operation cannot be replayed; `None` if the error is
    another one, to be raised as it is. Dr.Jit wraps errors of the functions with which it
    records a loop."""
    while error is not None and not isinstance(error, NotReplayed):
        error = error.__cause__ or error.__context__
    if error is None:
        return None
    return ValueError(
        f'`engine="drjit"` cannot replay {error}{_origin(error.location)}. Pass '
        '`engine="jax"`, or write the function without it.'
    )


def _origin(location: str) -> str:
    """The function of the user's code that an operation comes from, if JAX recorded it: the
    first one outside of installed packages."""
    package = str(Path(__file__).parents[1])
    for source in source_lines(location):
        if "site-packages" not in source.file and not source.file.startswith(package):
            where = f"({source.file}, line {source.line})"
            return f", which `{source.function}` needs {where}"
    return ""


# From the name of an engine to the function that simulates a batch.
ENGINES: dict[str, Callable[..., Batch]] = {
    "jax": by_jax,
    "drjit": by_drjit,
}
