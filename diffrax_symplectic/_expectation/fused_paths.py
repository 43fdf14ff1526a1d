"""Samples of `expectation` from a fused kernel."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from .._root_finder import all_finite
from ._problem import Problem
from .engines import by_drjit, state_itself
from .monte_carlo import IndependentPaths
from .sampling import Plan, Samples


# Default number of paths in a batch: large, to amortize the call of the kernel.
_BATCH = 2**19


def fused_plan(
    problem: Problem, key: PRNGKeyArray, sampling: Any, devices: tuple
) -> Plan:
    """A plan in which a kernel simulates independent paths, and JAX evaluates $\\phi$.
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
    plan = sampling.plan(jtu.Partial(_samples, problem), devices)
    if sampling.batch_size is None:
        plan = plan._replace(batch_size=_BATCH)
    return plan._replace(paths_of=FusedPaths(problem, key))


class FusedPaths:
    """The paths of a plan, from sample `first` on, and how many of all so far failed or
    were handed back to JAX."""

    def __init__(self, problem: Problem, key: PRNGKeyArray):
        self._problem = dataclasses.replace(problem, phi=state_itself, at_end=False)
        self._key = key
        self._last = None
        self.count = self.lost = self.stragglers = 0

    def __call__(self, first: int, n: int) -> tuple[PyTree[np.ndarray], np.ndarray]:
        # `expectation` asks for the first batch twice.
        if self._last is None or self._last[0] != (first, n):
            self._last = (first, n), self._batch(first, n)
        return self._last[1]

    def _batch(self, first: int, n: int) -> tuple[PyTree[np.ndarray], np.ndarray]:
        numbers = np.arange(first, first + n, dtype=np.uint64)
        levels = range(len(self._problem.levels.h))
        batches = [by_drjit(self._problem, self._key, numbers, k) for k in levels]
        self.count += n * len(batches)
        self.lost += sum(int(np.sum(b.failed)) for b in batches)
        self.stragglers += sum(b.stragglers for b in batches)
        stack = lambda *x: np.stack(x)
        return jtu.tree_map(stack, *[b.y for b in batches]), stack(
            *[b.failed for b in batches]
        )


def _samples(
    p: Problem,
    paths: tuple[PyTree[Array], Bool[Array, "levels n"]],
    keys: PRNGKeyArray,
) -> Samples:
    y, failed = paths
    _, args = jax.vmap(p.drawn)(keys)

    def values(level, y):
        times = p.t0 + level.saved_steps * level.h
        of_path = lambda y, args: jax.vmap(p.with_args(args).values)(times, y)
        return jax.vmap(of_path)(y, args)

    phi = jax.vmap(values)(p.levels, y)
    lost = jnp.any(failed | ~jax.vmap(jax.vmap(all_finite))(phi), axis=0)
    combined = p.combined(jnp.swapaxes(phi, 1, 2))
    return Samples(p.averaged([combined]), ~lost, lost)
