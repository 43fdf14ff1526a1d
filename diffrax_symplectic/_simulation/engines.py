"""Simulates the paths of a batch with either engine. Both take a problem, the random key
that all samples share, and consecutive sample numbers."""

import dataclasses
import functools as ft
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Key, PRNGKeyArray, PyTree, UInt32

from .._arguments import check_untraced
from .._fused import (
    by_sweeps_alone,
    functions_and_arrays,
    Kernels,
    Lanes,
    sample_key,
)
from .._lapack import lapack_in_turn
from .._programs import compiled
from .._stablehlo import NotReplayed, source_lines
from .layout import Layout
from .levels import Level
from .loop import values_of_paths
from .problem import Problem


# Above this share of all paths, stragglers take most of the time.
_LARGEST_SHARE_OF_STRAGGLERS = 0.05
# Dr.Jit aborts the process if two threads call one frozen function at the same time. A
# kernel uses all cores, so that taking turns costs no time.
_IN_TURN = threading.RLock()


def warn_of_stragglers(
    num_stragglers: int, num_failed: int, num_paths: int, stacklevel: int
) -> None:
    """Warns if JAX simulated many paths again, besides those that failed."""
    # Failed paths are stragglers that JAX could not solve either. They do not count, since
    # the warning advises `engine="jax"`, which would not help them.
    num_rescued = num_stragglers - num_failed
    if num_rescued > _LARGEST_SHARE_OF_STRAGGLERS * num_paths:
        warnings.warn(
            f"{num_stragglers:,} of {num_paths:,} paths had steps that the fused kernel "
            "did not solve, or the sine or cosine of an angle beyond 2^31 (in single "
            "precision 2^13), and were simulated again by JAX. Take smaller steps or "
            'angles, or `engine="jax"`.',
            stacklevel=stacklevel + 1,
        )


class Batch(NamedTuple):
    """Paths along the first axis of each array, saved times along the second.

    - `y`: the states.
    - `failed`: which paths failed. The states of these are meaningless.
    - `num_stragglers`: how many paths the fused kernel handed back to JAX.
    """

    y: PyTree[np.ndarray]
    failed: Bool[np.ndarray, " n"]
    num_stragglers: int = 0


def by_jax(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> Batch:
    """The paths with these sample numbers on one level, simulated by JAX. The loop is that
    of `expectation`, which runs all levels of the problem: the others are dropped."""
    states_and_failed = _paths_by_jax(problem, key, _words(sample_numbers))
    # The results are traced if a function of the user closes over traced values.
    check_untraced("`ensemble`", states_and_failed)
    y, failed = jax.device_get(states_and_failed)
    return Batch(jtu.tree_map(lambda x: x[level], y), failed[level])


def _words(sample_numbers: np.ndarray) -> UInt32[np.ndarray, "2 n"]:
    """The high and the low 32 bits of 64-bit numbers."""
    high = sample_numbers >> np.uint64(32)
    low = sample_numbers & np.uint64(0xFFFFFFFF)
    return np.stack([high, low]).astype(np.uint32)


def _sample_keys(
    key: PRNGKeyArray, words: UInt32[Array | np.ndarray, "2 n"]
) -> Key[Array, " n"]:
    """The random keys of the samples with these numbers."""
    return jax.vmap(ft.partial(sample_key, key))(*words)


@compiled
def _draw_starts(
    problem: Problem, key: PRNGKeyArray, words: UInt32[Array | np.ndarray, "2 n"]
) -> tuple[PyTree, PyTree]:
    """`Problem.draw_start` for the paths of a batch."""
    return jax.vmap(problem.draw_start)(_sample_keys(key, words))


@compiled
@lapack_in_turn
def _paths_by_jax(
    problem: Problem, key: PRNGKeyArray, words: UInt32[Array | np.ndarray, "2 n"]
) -> tuple[PyTree[Array], Bool[Array, "levels n"]]:
    """The saved states of the paths of a batch, along axes of levels, paths and times, and
    which paths failed."""
    # (levels, times, paths, entries of the state)
    states, failed = values_of_paths(problem, _sample_keys(key, words))
    # (levels, paths, times, entries of the state)
    states = jnp.swapaxes(states, 1, 2)
    return Layout.of(problem.y0).unravel(states), failed


def by_drjit(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> Batch:
    """The paths with these sample numbers, on one level, simulated by a fused kernel. JAX
    simulates again the paths that the kernel could not finish.

    Raises an `ImportError` without Dr.Jit, and a `ValueError` if the system cannot be
    replayed."""
    try:
        with _IN_TURN:
            fused = _fused_batch(problem, key, sample_numbers, level)
    except ImportError as error:
        raise ImportError(
            f'`engine="drjit"` needs Dr.Jit. {error}; or pass `engine="jax"`, which needs '
            "nothing else."
        ) from error
    except (NotReplayed, RuntimeError) as error:
        refusal = _refusal(error)
        if refusal is None:
            raise
        # The errors behind the refusal are about recordings, and pages long.
        raise refusal from None
    if fused.num_stragglers == 0:
        return fused
    return _with_stragglers(problem, key, sample_numbers, level, fused)


def _fused_batch(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int
) -> Batch:
    """The paths of a batch from the kernel alone: those that it did not finish count as
    failed."""
    kernels, lanes, shared = fused_start(problem, key, sample_numbers, level)
    saved_steps = np.asarray(problem.level(level).saved_steps)
    # By the number of steps before a saved time: (paths, entries of the state). The kernel
    # is called once for all steps from one saved time to the next.
    states_after: dict[int, np.ndarray] = {}
    num_steps_done = 0
    for num_steps in np.unique(saved_steps).tolist():
        # There is no step to take if the saved time is `t0`.
        if num_steps > num_steps_done:
            lanes = kernels.advance(lanes, shared, num_steps_done, num_steps)
        num_steps_done = num_steps
        states_after[num_steps] = np.stack([*map(np.asarray, lanes.y)], axis=-1)
    # (paths, times, entries of the state). `ts` may repeat a time.
    states = np.stack([states_after[step] for step in saved_steps.tolist()], axis=1)
    # A copy, so that no array of Dr.Jit outlives this call, during which no other thread
    # uses Dr.Jit.
    is_unfinished = np.array(lanes.stopped)
    return Batch(
        y=Layout.of(problem.y0).unravel(states),
        failed=is_unfinished,
        num_stragglers=int(np.sum(is_unfinished)),
    )


def fused_start(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> tuple[Kernels, Lanes, dict[str, Any]]:
    """The kernels of the problem, which are compiled unless they are known; what differs
    between the paths with these sample numbers before their first step, and what they
    share. `kernels.advance(lanes, shared, first_step, end_step)` takes their steps."""
    # Kernels have plain sweeps for root finders. Step sizes, times and numbers of steps are
    # inputs of a kernel, which is compiled for placeholders.
    zero = jnp.zeros(1, jnp.int32)
    any_h = jnp.ones_like(problem.levels.h[:1])
    compiled_problem = dataclasses.replace(
        problem,
        solver=by_sweeps_alone(problem.solver),
        y0_of=None,
        args_of=None,
        levels=Level(index=zero, h=any_h, num_steps=zero, saved_steps=zero[None]),
        weights=jnp.ones((1, 1)),
        at_end=True,
    )
    example_args = None
    if problem.args_of is not None:
        example_args = eqx.filter(problem.args, eqx.is_array)
    functions, arrays = functions_and_arrays(
        compiled_problem, key, example_args, problem.paths_differ
    )
    kernels = _kernels(functions)
    y0 = problem.y0
    own_args = None
    if problem.paths_differ:
        y0, own_args = _draw_starts(problem, key, _words(sample_numbers))
    lanes, shared = kernels.lanes_and_shared(
        arrays,
        key,
        h=problem.level(level).h,
        first_path=int(sample_numbers[0]),
        num_paths=len(sample_numbers),
        y0=y0,
        own_args=own_args,
    )
    return kernels, lanes, shared


# A kernel keeps all that the user's functions capture, so only a few kernels are kept.
_kernels = ft.lru_cache(maxsize=8)(Kernels)


def _with_stragglers(
    problem: Problem,
    key: PRNGKeyArray,
    sample_numbers: np.ndarray,
    level: int,
    fused: Batch,
) -> Batch:
    """The `fused` paths of a batch, in which those that the kernel did not finish, one or
    more, are replaced by paths that JAX simulates."""
    # JAX begins anew. To go on from where the kernel stopped it would need the solver's
    # state, and it would not give the same paths as without a kernel.
    (stragglers,) = np.nonzero(fused.failed)
    num_stragglers = len(stragglers)
    # Their number is rounded up to a power of four, by repeating stragglers, so that JAX
    # compiles few programs.
    power_of_four = 4 ** int(np.ceil(np.log(num_stragglers) / np.log(4)))
    num_to_solve = min(len(sample_numbers), power_of_four)
    repeated_stragglers = np.resize(stragglers, num_to_solve)
    solved = by_jax(problem, key, sample_numbers[repeated_stragglers], level)

    def with_solved(fused_leaf: np.ndarray, solved_leaf: np.ndarray) -> np.ndarray:
        leaf = np.array(fused_leaf)
        leaf[stragglers] = solved_leaf[:num_stragglers]
        return leaf

    # So far all stragglers counted as failed.
    failed = with_solved(fused.failed, solved.failed)
    y = jtu.tree_map(with_solved, fused.y, solved.y)
    return Batch(y, failed, num_stragglers)


def _refusal(error: BaseException | None) -> ValueError | None:
    """The error for the user if an operation cannot be replayed; `None` if the error is
    another one, to be raised as it is."""
    # Dr.Jit raises errors of its own from those of the functions that it records.
    cause = error
    while cause is not None and not isinstance(cause, NotReplayed):
        cause = cause.__cause__ or cause.__context__
    if cause is None:
        return None
    # The user's function from which the operation comes is the first one outside of
    # installed packages. JAX may have recorded none.
    origin = ""
    package = str(Path(__file__).parents[1])
    for source in source_lines(cause.location):
        if "site-packages" not in source.file and not source.file.startswith(package):
            place = f"({source.file}, line {source.line})"
            origin = f", which `{source.function}` needs {place}"
            break
    return ValueError(
        f'`engine="drjit"` cannot replay {cause}{origin}. Pass `engine="jax"`, or write '
        "the function without it."
    )


# From the name of an engine to the function that simulates a batch.
ENGINES: dict[str, Callable[..., Batch]] = {
    "jax": by_jax,
    "drjit": by_drjit,
}
