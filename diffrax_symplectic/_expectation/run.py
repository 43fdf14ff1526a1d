"""The loop that computes estimates, batch after batch, on any devices."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Key, PRNGKeyArray, PyTree

from .._arguments import check_untraced
from .._custom_types import Devices
from .._parts import parts_of, with_parts
from .._simulation import Problem
from .._solver import has_newton, without_newton
from .batch import batch_moments, BatchMoments, quick_batch_moments
from .estimate import (
    check_same,
    combined_in_halves,
    Expectation,
    ExpectationInterrupted,
    is_bounded_by_steps,
    is_reached,
    is_stuck,
    Moments,
    share_of_needed,
)
from .progress import Progress
from .sampling import MOST_SAMPLES, Samples, SamplingPlan


class Kept:
    """Keeps the estimate so far. As a context manager it raises an `ExpectationInterrupted`
    that holds it, in place of a `KeyboardInterrupt` anywhere within.

    - `estimate`: the estimate after the last batch; `None` before the first.
    """

    estimate: Expectation | None = None

    def __enter__(self) -> "Kept":
        return self

    def __exit__(self, kind: Any, error: Any, traceback: Any) -> None:
        if isinstance(error, KeyboardInterrupt) and self.estimate is not None:
            raise ExpectationInterrupted(self.estimate) from None


def run(
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: Devices,
    start: Expectation | None = None,
    first: int = 0,
    tol: float | None = None,
    progress: Progress | None = None,
    kept: Kept | None = None,
    **fields: Any,
) -> Expectation:
    """The estimate from the samples of a plan, which continues `start`, or without it
    begins with sample number `first`. With a tolerance `tol` it may end before all samples
    of the plan. The result does not depend on the number of devices. `kept`, if there is
    one, gets the estimate after each batch, for the case of an interrupt. `fields` are
    further fields of the result."""
    # The numbers of the first sample of all, of the first that is not in the estimate yet,
    # and one past the last.
    begin = first if start is None else start.moments[0].begin
    next_sample = first if start is None else start.moments[-1].end
    end = begin + plan.num_samples
    if end > MOST_SAMPLES:
        raise ValueError(
            f"Samples have numbers below 2^63; got {plan.num_samples} from number {begin} "
            "on. Pass a smaller number of paths (or replicates), or a smaller `first`."
        )
    estimate = Expectation(
        moments=(),
        key_data=np.asarray(jr.key_data(key)),
        paths_per_sample=plan.paths_per_sample,
        reason=plan.reason if start is None else start.reason,
        tol_reached=None if tol is None else False,
        **plan.outputs._asdict(),
        **fields,
    )
    kept = Kept() if kept is None else kept
    if start is not None:
        check_same(start, estimate, "`start`")
        if next_sample > end:
            raise ValueError(
                "The number of paths (or replicates) includes `start`, which has "
                f"{next_sample - begin} already; got {plan.num_samples}. Pass a larger "
                "number."
            )
        estimate = dataclasses.replace(estimate, moments=start.moments)
        kept.estimate = estimate

    def needs_no_more_samples() -> bool:
        """Whether there are enough samples for the tolerance, or more would not help:
        because the error of the steps, or of failed paths, is too large beside that of
        sampling."""
        least = plan.least_beside_steps if tol is None else plan.least_samples
        if least is None or estimate.num_samples < least:
            return False
        if tol is None:
            return is_bounded_by_steps(estimate)
        return is_reached(estimate, tol) or is_stuck(estimate, tol)

    batches = _Batches(plan, key, devices)
    firsts = iter(range(next_sample, end, batches.size * len(devices)))

    def started_batch() -> Callable[[], list[BatchMoments]] | None:
        """The next batch, if there is one and it is needed."""
        first_of_batch = None if needs_no_more_samples() else next(firsts, None)
        return None if first_of_batch is None else batches.start(first_of_batch, end)

    batch = started_batch()
    while batch is not None:
        # Batches are started one ahead: while a batch is being computed, the one before it
        # is added to the estimate.
        batch_ahead = started_batch()
        for device_moments in batch():
            # The moments of each device are a batch of their own: where to stop does not
            # depend on how many devices there are.
            if next_sample == end or needs_no_more_samples():
                break
            batch_begin = next_sample
            next_sample = min(batch_begin + batches.size, end)
            moments = _in_float64(device_moments, batch_begin, next_sample)
            moments_of_all = combined_in_halves((*estimate.moments, moments))
            estimate = dataclasses.replace(estimate, moments=moments_of_all)
            kept.estimate = estimate
        if progress is not None:
            share = (next_sample - begin) / plan.num_samples
            progress.step(max(share, share_of_needed(estimate, tol)))
        batch = batch_ahead
    if tol is not None:
        has_enough = estimate.num_samples >= plan.least_samples
        tol_reached = has_enough and is_reached(estimate, tol)
        estimate = dataclasses.replace(estimate, tol_reached=tol_reached)
    kept.estimate = estimate
    return estimate


class _Batches:
    """The batches of a plan, in each of which every device takes `size` samples.

    Steps are first solved by sweeps alone: Newton's method would take a third of the time
    to compile an implicit step, and few paths need it. Once a path fails, its batch is
    computed again with Newton's method, which also takes part in all later batches."""

    def __init__(self, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices):
        self.size = min(plan.batch_size, plan.num_samples)
        self._key_data = np.asarray(jr.key_data(key))
        self._key_impl = jr.key_impl(key)
        samplers = [plan.sampler]
        # `simulate_paths` solves the steps before the sampler is called.
        if plan.simulate_paths is None and _has_newton(plan.sampler):
            samplers = [_by_sweeps_alone(plan.sampler), plan.sampler]
        # The last one is for paths that fail with the first one.
        self._samplers = [*map(_for_all_processes, samplers)]
        self._simulate_paths = plan.simulate_paths
        self._devices = devices
        self._batch_moments: Any = (
            quick_batch_moments if plan.is_quick else batch_moments
        )
        self._mesh = Mesh(np.array(devices), ("samples",))

    def start(self, first: int, end: int) -> Callable[[], list[BatchMoments]]:
        """Starts a batch on all devices, from sample number `first` on. Samples from number
        `end` on do not count. Returns a function that waits for the moments on each
        device."""
        num_devices = len(self._devices)
        low_high = np.array([first & 0xFFFFFFFF, first >> 32], np.uint32)
        num_wanted = np.array(min(self.size * num_devices, end - first), np.int32)
        if num_devices == 1:
            on_device = jax.device_put((low_high, num_wanted), self._devices[0])
            low_high, num_wanted = on_device
        sampler = self._samplers[0]
        may_be_repeated = len(self._samplers) > 1
        if self._simulate_paths is not None:
            # Not `jtu.Partial(sampler, paths)`: the function of a `Partial` is static, so
            # with arrays in it, as in the sampler, JAX would compile for each batch.
            paths = self._simulate_paths(first, self.size)
            sampler = jtu.Partial(_samples_of_paths, sampler, paths)
        moments = self._batch_moments(
            sampler,
            self._key_data,
            self._key_impl,
            low_high,
            num_wanted,
            self._mesh,
            self.size,
        )

        def moments_of_devices() -> list[BatchMoments]:
            # The moments are traced if a function closes over traced values.
            check_untraced("`expectation` or `monte_carlo`", moments)
            on_host = jax.device_get(moments)
            if may_be_repeated and np.any(on_host.any_failed):
                self._samplers = self._samplers[-1:]
                return self.start(first, end)()
            return [
                jtu.tree_map(lambda x, k=k: x[k], on_host) for k in range(num_devices)
            ]

        return moments_of_devices


def _has_newton(sampler: Callable[..., Samples]) -> bool:
    """Whether Newton's method may solve steps of the paths that a sampler simulates."""
    return any(has_newton(problem.solver) for problem in parts_of(Problem, sampler))


def _by_sweeps_alone(sampler: Callable[..., Samples]) -> Callable[..., Samples]:
    """The sampler without Newton's method. Solvers within a user's own function, which
    reports its failures by itself, stay as they are."""

    def by_sweeps_alone(problem: Problem) -> Problem:
        return dataclasses.replace(problem, solver=without_newton(problem.solver))

    return with_parts(Problem, by_sweeps_alone, sampler)


def _for_all_processes(sampler: Callable[..., Samples]) -> Callable[..., Samples]:
    """The sampler itself, or for several processes a function that captures it."""
    if jax.process_count() == 1:
        return sampler
    # The arrays in a sampler are arguments of a program, which would have to be placed on
    # the devices of all processes. In a function they are constants of the program, which
    # all processes have alike.
    return lambda keys: sampler(keys)


def _samples_of_paths(
    sampler: Callable, paths: PyTree, keys: Key[Array, " n"]
) -> Samples:
    """The samples from paths that were computed outside JAX."""
    return sampler(paths, keys)


def _in_float64(device_moments: BatchMoments, begin: int, end: int) -> Moments:
    """The moments of samples `begin` to `end - 1`, in float64."""
    # Single precision could not hold the sum of a mean and its correction.
    wide = jtu.tree_map(lambda x: x.astype(float), device_moments)
    return Moments(
        begin=begin,
        end=end,
        num_good=int(device_moments.num_good),
        num_failed=int(device_moments.num_failed),
        failed_on=tuple(map(int, device_moments.failed_on)),
        mean=jtu.tree_map(np.add, wide.mean, wide.mean_correction),
        norm=wide.norm,
        largest=wide.largest,
        size=wide.size,
    )
