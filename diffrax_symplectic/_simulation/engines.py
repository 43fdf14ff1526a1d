"""The engines: functions that simulate the paths of a batch.

An engine takes a problem, the random key that all samples share, and the numbers of the
samples, one for each path. `by_jax` runs the loop over steps of `loop`. `by_drjit` fuses
the steps of many paths into a kernel of Dr.Jit. Stragglers are the paths that a kernel does
not finish: JAX simulates them again.
"""

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
# Dr.Jit aborts the process if two threads call one frozen function at the same time, so
# threads take turns. This costs no time, since a kernel uses all cores.
_IN_TURN = threading.RLock()


def warn_of_stragglers(
    num_stragglers: int, num_failed: int, num_paths: int, stacklevel: int
) -> None:
    """Warns if the fused kernel did not finish many paths that JAX then did finish."""
    # Failed paths are stragglers that JAX could not solve either. They do not count, since
    # the warning advises `engine="jax"`, by which they would fail, too.
    num_rescued = num_stragglers - num_failed
    if num_rescued > _LARGEST_SHARE_OF_STRAGGLERS * num_paths:
        warnings.warn(
            f"{num_stragglers:,} of {num_paths:,} paths had steps that the fused kernel "
            "did not solve, or numbers that are too large for it: the sine or cosine of an "
            "angle beyond 2^31, or a remainder of a quotient beyond 2^53 (in single "
            "precision 2^13 and 2^24). They were simulated again by JAX. Take smaller "
            'steps or numbers, or `engine="jax"`.',
            stacklevel=stacklevel + 1,
        )


class Batch(NamedTuple):
    """The paths of a batch.

    - `y`: the states, with paths along the first axis of each array, and saved times along
        the second. The states of failed paths are meaningless.
    - `failed`: which paths failed.
    - `num_stragglers`: how many paths the fused kernel handed back to JAX.
    """

    y: PyTree[np.ndarray]
    failed: Bool[np.ndarray, " n"]
    num_stragglers: int = 0


def by_jax(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> Batch:
    """The paths with these sample numbers on one level, simulated by JAX. (All levels of
    the problem are simulated, and the others are dropped.)"""
    states_and_failed = _paths_by_jax(problem, key, _high_and_low(sample_numbers))
    # The results are traced if a function of the user closes over traced values.
    check_untraced("`ensemble`", states_and_failed)
    y, failed = jax.device_get(states_and_failed)
    return Batch(jtu.tree_map(lambda x: x[level], y), failed[level])


def _high_and_low(sample_numbers: np.ndarray) -> UInt32[np.ndarray, "2 n"]:
    """The high and the low 32 bits of 64-bit numbers, as the two rows of an array, since
    JAX may have no 64-bit integers. The parameter `words` below is such an array."""
    high = sample_numbers >> np.uint64(32)
    low = sample_numbers & np.uint64(0xFFFFFFFF)
    return np.stack([high, low]).astype(np.uint32)


def _sample_keys(
    key: PRNGKeyArray, words: UInt32[Array | np.ndarray, "2 n"]
) -> Key[Array, " n"]:
    """The random keys of samples, whose numbers have the high and low bits `words`."""
    return jax.vmap(ft.partial(sample_key, key))(*words)


@compiled
def _draw_starts(
    problem: Problem, key: PRNGKeyArray, words: UInt32[Array | np.ndarray, "2 n"]
) -> tuple[PyTree, PyTree]:
    """The results of `Problem.draw_start` for the paths of a batch."""
    return jax.vmap(problem.draw_start)(_sample_keys(key, words))


@compiled
@lapack_in_turn
def _paths_by_jax(
    problem: Problem, key: PRNGKeyArray, words: UInt32[Array | np.ndarray, "2 n"]
) -> tuple[PyTree[Array], Bool[Array, "levels n"]]:
    """The saved states of the paths of a batch, whose first axes are those of levels, paths
    and times, and which paths failed."""
    # (levels, times, paths, entries of the state)
    states, failed = values_of_paths(problem, _sample_keys(key, words))
    # (levels, paths, times, entries of the state)
    states = jnp.swapaxes(states, 1, 2)
    return Layout.of(problem.y0).unravel(states), failed


def by_drjit(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> Batch:
    """The paths with these sample numbers on one level, simulated by a fused kernel. JAX
    simulates again the paths that the kernel could not finish.

    Raises an `ImportError` without Dr.Jit, and a `ValueError` if an operation of the
    problem cannot be replayed by Dr.Jit."""
    try:
        with _IN_TURN:
            fused = _fused_batch(problem, key, sample_numbers, level)
    except ImportError as error:
        raise ImportError(
            f'`engine="drjit"` needs Dr.Jit. {error}; or pass `engine="jax"`, which needs '
            "nothing else."
        ) from error
    # Dr.Jit raises a `RuntimeError` if an error is raised in what it records.
    except (NotReplayed, RuntimeError) as error:
        refusal = _refusal(error)
        if refusal is None:
            raise
        # The errors behind the refusal are about Dr.Jit's recordings, and pages long.
        raise refusal from None
    if fused.num_stragglers == 0:
        return fused
    return _with_stragglers(problem, key, sample_numbers, level, fused)


def _fused_batch(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int
) -> Batch:
    """The paths of a batch, simulated by the kernel alone: stragglers count as failed. The
    kernel is called for all steps up to one saved time, then for those up to the next."""
    kernels, lanes, shared = fused_start(problem, key, sample_numbers, level)
    saved_steps = np.asarray(problem.level(level).saved_steps)
    # From the number of steps to a saved time, to the states of shape (paths, entries).
    states_after: dict[int, np.ndarray] = {}
    num_steps_done = 0
    for num_steps in np.unique(saved_steps).tolist():
        # There is no step to take to a saved time that is `t0`.
        if num_steps > num_steps_done:
            lanes = kernels.advance(lanes, shared, num_steps_done, num_steps)
        num_steps_done = num_steps
        states_after[num_steps] = np.stack([*map(np.asarray, lanes.y)], axis=-1)
    # (paths, times, entries). Saved times may be in any order, and may be repeated.
    states = np.stack([states_after[step] for step in saved_steps.tolist()], axis=1)
    # The mask is copied, since no array of Dr.Jit may outlive this call: afterwards another
    # thread may use Dr.Jit.
    is_unfinished = np.array(lanes.stopped)
    return Batch(
        y=Layout.of(problem.y0).unravel(states),
        failed=is_unfinished,
        num_stragglers=int(np.sum(is_unfinished)),
    )


def fused_start(
    problem: Problem, key: PRNGKeyArray, sample_numbers: np.ndarray, level: int = 0
) -> tuple[Kernels, Lanes, dict[str, Any]]:
    """The paths with these sample numbers before their first step, and the kernels that
    take their steps by `kernels.advance(lanes, shared, first_step, end_step)`:

    - `kernels`, which are compiled unless they were compiled before;
    - `lanes`: what differs between the paths, as arrays with an entry for each path;
    - `shared`: what all paths share.
    """
    kernels, arrays = _kernels_and_arrays(problem, key)
    y0 = problem.y0
    own_args = None
    if problem.paths_differ:
        y0, own_args = _draw_starts(problem, key, _high_and_low(sample_numbers))
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


def _kernels_and_arrays(
    problem: Problem, key: PRNGKeyArray
) -> tuple[Kernels, list[Array]]:
    """The kernels of a problem, and the arrays in it, which are inputs of the kernels."""
    # Kernels solve the equations of implicit steps by plain sweeps. They get step sizes,
    # times and numbers of steps as inputs. So placeholders stand for them here, and
    # problems that differ only in these have the same kernels.
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
    return _kernels(functions), arrays


# The kernels that were compiled for these functions before, or new ones. Kernels hold all
# that the user's functions capture, so only a few of them are kept.
_kernels = ft.lru_cache(maxsize=8)(Kernels)


def _with_stragglers(
    problem: Problem,
    key: PRNGKeyArray,
    sample_numbers: np.ndarray,
    level: int,
    fused: Batch,
) -> Batch:
    """The batch `fused` with its stragglers, of which there are one or more, replaced by
    the same paths as simulated by JAX."""
    (stragglers,) = np.nonzero(fused.failed)
    num_stragglers = len(stragglers)
    # JAX compiles a program for each number of paths. So that there are few such numbers,
    # stragglers are repeated until there are a power of four, or as many as in the batch.
    power_of_four = 4 ** int(np.ceil(np.log(num_stragglers) / np.log(4)))
    num_to_solve = min(len(sample_numbers), power_of_four)
    repeated_stragglers = np.resize(stragglers, num_to_solve)
    # JAX simulates the paths from their start, so that they are the same as without a
    # kernel. To go on from where the kernel stopped, it would also need the solver's state.
    solved = by_jax(problem, key, sample_numbers[repeated_stragglers], level)

    def with_solved(fused_leaf: np.ndarray, solved_leaf: np.ndarray) -> np.ndarray:
        leaf = np.array(fused_leaf)
        leaf[stragglers] = solved_leaf[:num_stragglers]
        return leaf

    # All stragglers count as failed in `fused`.
    failed = with_solved(fused.failed, solved.failed)
    y = jtu.tree_map(with_solved, fused.y, solved.y)
    return Batch(y, failed, num_stragglers)


def _refusal(error: BaseException | None) -> ValueError | None:
    """The error to raise for the user if `error` comes from an operation that Dr.Jit cannot
    replay; `None` if it has another cause, and should be raised as it is."""
    # `error` may be an error of Dr.Jit that was raised from a `NotReplayed`.
    cause = error
    while cause is not None and not isinstance(cause, NotReplayed):
        cause = cause.__cause__ or cause.__context__
    if cause is None:
        return None
    # The user's function that needs the operation is the first one that is neither in this
    # package nor in an installed one. JAX may not have recorded it.
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
ENGINES: dict[str, Callable[..., Batch]] = {"jax": by_jax, "drjit": by_drjit}
