"""Samples of `expectation` from a fused kernel."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Key, PRNGKeyArray, PyTree

from .._custom_types import Devices
from .._root_finder import all_finite
from .._simulation import by_drjit, Level, Problem, state_itself
from .independent import IndependentPaths
from .sampling import Averaged, Samples, SamplingPlan


# The default number of paths in a batch: many, since each call of the kernel takes a while
# before its first path.
_FUSED_BATCH = 2**19


def fused_plan(
    problem: Problem, key: PRNGKeyArray, sampling: Any, devices: Devices
) -> SamplingPlan:
    r"""A plan in which a kernel simulates independent paths, and JAX evaluates $\phi$.
    Raises a `ValueError` for another `sampling`, or several devices."""
    if not isinstance(sampling, IndependentPaths):
        raise ValueError(
            '`engine="drjit"` takes independent paths: pass '
            f"`sampling=IndependentPaths(num_paths)`; got sampling={sampling!r}."
        )
    if len(devices) > 1:
        raise ValueError(
            f'`engine="drjit"` uses all cores, or one GPU; got {len(devices)} devices. '
            "Pass `devices=jax.devices()[:1]`."
        )
    levels = len(problem.levels.h)
    plan = sampling.plan(jtu.Partial(_samples, problem), levels, devices)
    if sampling.batch_size is None:
        plan = plan._replace(batch_size=_FUSED_BATCH)
    return plan._replace(paths_of=FusedPaths(problem, key))


class FusedPaths:
    """The paths of a plan, by their numbers.

    - `count`: the number of paths so far, on all levels.
    - `lost`: how many of these failed.
    - `stragglers`: how many were handed back to JAX.
    """

    def __init__(self, problem: Problem, key: PRNGKeyArray):
        # A kernel returns states, and is the same for every $\phi$.
        self._problem = dataclasses.replace(problem, phi=state_itself, at_end=False)
        self._key = key
        self._last: _NumberedPaths | None = None
        self.count = 0
        self.lost = 0
        self.stragglers = 0

    def __call__(self, first: int, number: int) -> "_Paths":
        """The paths of this number of samples, from sample `first` on."""
        # `expectation` asks for the first batch twice: to know the shapes of samples, and
        # for the samples.
        if self._last is None or self._last.which != (first, number):
            self._last = _NumberedPaths((first, number), self._batch(first, number))
        return self._last.paths

    def _batch(self, first: int, number: int) -> "_Paths":
        samples = np.arange(first, first + number, dtype=np.uint64)
        batches = [
            by_drjit(self._problem, self._key, samples, level)
            for level in range(len(self._problem.levels.h))
        ]
        self.count += number * len(batches)
        self.lost += sum(int(np.sum(batch.failed)) for batch in batches)
        self.stragglers += sum(batch.num_stragglers for batch in batches)
        return _Paths(
            y=jtu.tree_map(_stack_levels, *[batch.y for batch in batches]),
            failed=_stack_levels(*[batch.failed for batch in batches]),
        )


def _stack_levels(*levels: np.ndarray) -> np.ndarray:
    return np.stack(levels)


class _Paths(NamedTuple):
    """Paths, along the second axis of each array. The first axis is the level.

    - `y`: the states at the saved times, along the third axis.
    - `failed`: which paths failed.
    """

    y: PyTree[Array | np.ndarray]
    failed: Bool[Array | np.ndarray, "levels n"]


class _NumberedPaths(NamedTuple):
    """Paths, and `which` they are: the number of the first sample, and of samples."""

    which: tuple[int, int]
    paths: _Paths


def _samples(p: Problem, paths: _Paths, keys: Key[Array, " n"]) -> Samples:
    """The samples with these random keys, whose paths are known."""
    _, own_args = jax.vmap(p.draw_start)(keys)

    def values_of_path(times: Any, y: PyTree[Array], own: PyTree[Array]) -> Array:
        return jax.vmap(p.with_args(own).values)(times, y)

    def values_on_level(level: Level, y: PyTree[Array]) -> Array:
        times = p.t0 + level.saved_steps * level.h
        return jax.vmap(values_of_path, (None, 0, 0))(times, y, own_args)

    phi = jax.vmap(values_on_level)(p.levels, paths.y)
    finite = jax.vmap(jax.vmap(all_finite))(phi)
    lost = jnp.asarray(paths.failed) | ~finite
    values = p.shaped(p.combinations(jnp.swapaxes(phi, 1, 2)))
    return Samples(Averaged(values), ~jnp.any(lost, axis=0), lost)
