"""Samples of `expectation` from a fused kernel."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree

from .._custom_types import Args, Devices
from .._simulation import by_drjit, Level, Problem, state_itself
from .independent import IndependentPaths, samples_of_paths
from .sampling import Samples, SamplingPlan


# The default number of paths in a batch. It is large, since each call of the kernel takes a
# while before its first path.
_FUSED_BATCH = 2**19


def fused_plan(
    problem: Problem, key: PRNGKeyArray, sampling: Any, devices: Devices
) -> SamplingPlan:
    r"""A plan by which a kernel simulates independent paths, and JAX evaluates $\phi$.
    Raises a `ValueError` unless `sampling` is an `IndependentPaths`, and for several
    devices."""
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
    plan = sampling.prepare(problem, key, devices)
    if sampling.batch_size is None:
        plan = plan._replace(batch_size=_FUSED_BATCH)
    return plan._replace(
        sampler=jtu.Partial(_samples_of_fused_paths, problem),
        simulate_paths=FusedPaths(problem, key),
    )


class FusedPaths:
    """Simulates the paths of a plan by a fused kernel, and counts them.

    - `num_paths`: the number of paths so far, on all levels together.
    - `num_failed`: how many of these paths failed.
    - `num_stragglers`: how many of these paths the kernel handed back to JAX.
    """

    def __init__(self, problem: Problem, key: PRNGKeyArray):
        # A kernel returns states, and is the same for every $\phi$.
        self._problem = dataclasses.replace(problem, phi=state_itself, at_end=False)
        self._key = key
        self.num_paths = 0
        self.num_failed = 0
        self.num_stragglers = 0

    def __call__(self, first: int, num_samples: int) -> tuple[PyTree, np.ndarray]:
        """Simulates as many paths as there are samples, from sample number `first` on, on
        each level. Returns their states at the saved times, with axes for levels, paths and
        times; and which paths failed, with axes for levels and paths."""
        sample_numbers = np.arange(first, first + num_samples, dtype=np.uint64)
        batches = [
            by_drjit(self._problem, self._key, sample_numbers, level)
            for level in range(len(self._problem.levels.h))
        ]
        self.num_paths += num_samples * len(batches)
        self.num_failed += sum(int(np.sum(batch.failed)) for batch in batches)
        self.num_stragglers += sum(batch.num_stragglers for batch in batches)
        states_and_failed = [(batch.y, batch.failed) for batch in batches]
        return jtu.tree_map(lambda *levels: np.stack(levels), *states_and_failed)


def _samples_of_fused_paths(
    problem: Problem,
    paths: tuple[PyTree[Array], Bool[Array, "levels n"]],
    keys: Key[Array, " n"],
) -> Samples:
    """The samples of `paths` that `FusedPaths` returned. The `args` of each path are drawn
    from its key once more.

    Axes are named as in `_simulation/problem.py`: `S` times, and `m` numbers of `phi` at
    each time."""
    states, failed = paths
    _, args_of_paths = jax.vmap(problem.draw_start)(keys)

    def values_of_path(times: Any, y: PyTree, own_args: Args) -> Float[Array, "S m"]:
        """The values of `phi` on a path with the states `y` at all times."""
        return jax.vmap(problem.with_args(own_args).values)(times, y)

    def values_on_level(level: Level, y: PyTree[Array]) -> Float[Array, "n S m"]:
        times = problem.t0 + level.saved_steps * level.h
        return jax.vmap(values_of_path, (None, 0, 0))(times, y, args_of_paths)

    # (levels, n, S, m)
    phi = jax.vmap(values_on_level)(problem.levels, states)
    failed = failed | ~jnp.all(jnp.isfinite(phi), axis=(2, 3))
    values = phi.reshape(*phi.shape[:2], -1)
    return samples_of_paths(problem.weights, values, failed)
