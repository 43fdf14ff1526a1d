"""The loop that computes estimates, batch after batch, on any devices."""

import collections
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Key, PRNGKeyArray, PyTree

from .._arguments import check_untraced
from .._custom_types import Devices
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
from .sampling import Averaged, MOST_SAMPLES, Samples, SamplingPlan


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
    sampling: Any = None,
    start: Expectation | None = None,
    first: int = 0,
    tol: float | None = None,
    progress: Progress | None = None,
    ts: np.ndarray | None = None,
    kept: Kept | None = None,
) -> Expectation:
    """The estimate from the samples of a plan, which continues `start`, or without it
    begins with sample number `first`. With a tolerance `tol` it may end before all samples
    of the plan. The result does not depend on the number of devices. `ts` and `sampling`
    become fields of the result. `kept`, if there is one, gets the estimate after each
    batch, for the case of an interrupt."""
    # The numbers of the first sample of all, of the first that is not in `start`, and one
    # past the last.
    begin = first if start is None else start.moments[0].begin
    next_sample = first if start is None else start.moments[-1].end
    end = begin + plan.num_samples
    if end > MOST_SAMPLES:
        raise ValueError(
            f"Samples have numbers below 2^63; got {plan.num_samples} from number {begin} "
            "on. Pass a smaller number of paths (or replicates), or a smaller `first`."
        )
    batches = _Batches(plan, key, devices)
    no_moments = _moments_of_no_samples(plan, next_sample)
    estimate = Expectation(
        moments=(no_moments,),
        key_data=batches.key_data,
        layout=plan.outputs.layout,
        dtype=plan.outputs.dtype,
        paths_per_sample=plan.paths_per_sample,
        rounding_floor=plan.rounding_floor,
        sampling=sampling,
        reason=plan.reason,
        tol_reached=None if tol is None else False,
        digests=plan.digests,
        ts=ts,
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
        return _needs_no_more_samples(estimate, plan, tol)

    running_batches: collections.deque[_RunningBatch] = collections.deque()
    # One past the last sample of the batches that were started.
    end_of_started = next_sample
    # Batches are started one ahead: while a batch is being computed, the one before it is
    # added to the estimate.
    while True:
        starts_batch = end_of_started < end and not needs_no_more_samples()
        if starts_batch:
            running_batches.append(batches.start(end_of_started, end))
            end_of_started += batches.size * len(devices)
        has_previous = len(running_batches) > (1 if starts_batch else 0)
        if has_previous:
            for device_moments in batches.moments_of_devices(running_batches.popleft()):
                # The moments of each device are a batch of their own: where to stop
                # does not depend on how many devices there are.
                if _end_of(estimate) == end or needs_no_more_samples():
                    break
                estimate = _with_batch(estimate, device_moments, batches.size, end)
                kept.estimate = estimate
            if progress is not None:
                share = (_end_of(estimate) - begin) / plan.num_samples
                progress.step(max(share, share_of_needed(estimate, tol)))
        elif not starts_batch:
            break
    if tol is not None:
        has_enough = estimate.num_samples >= plan.least_samples
        tol_reached = has_enough and is_reached(estimate, tol)
        estimate = dataclasses.replace(estimate, tol_reached=tol_reached)
    kept.estimate = estimate
    return estimate


def _end_of(estimate: Expectation) -> int:
    """One past the last sample of the estimate."""
    return estimate.moments[-1].end


def _with_batch(
    estimate: Expectation,
    device_moments: BatchMoments,
    batch_size: int,
    end: int,
) -> Expectation:
    """The estimate with the next batch, of one device. Only the samples before number `end`
    count."""
    begin = _end_of(estimate)
    batch_end = min(begin + batch_size, end)
    new_moments = _in_float64(device_moments, begin, batch_end)
    moments = combined_in_halves((*estimate.moments, new_moments))
    return dataclasses.replace(estimate, moments=moments)


class _RunningBatch(NamedTuple):
    """A batch that has been started.

    - `first`: the number of its first sample.
    - `end`: samples with this number and larger ones do not count.
    - `has_newton`: whether Newton's method solves steps that sweeps do not.
    - `moments`: the moments on all devices, once they are computed.
    """

    first: int
    end: int
    has_newton: bool
    moments: BatchMoments


class _Batches:
    """The batches of a plan, in each of which every device takes `size` samples.

    Steps are first solved by sweeps alone: Newton's method would take a third of the time
    to compile an implicit step, and few paths need it. Once a path fails, its batch is
    computed again with Newton's method, which also takes part in all later batches."""

    def __init__(self, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices):
        self.size = min(plan.batch_size, plan.num_samples)
        self.key_data = np.asarray(jr.key_data(key))
        self._key_impl = jr.key_impl(key)
        self._sampler_with_newton = _for_all_processes(plan.sampler)
        self._sampler = self._sampler_with_newton
        # `simulate_paths` solves the steps before the sampler is called.
        if plan.simulate_paths is None and _has_newton(plan.sampler):
            self._sampler = _for_all_processes(_by_sweeps_alone(plan.sampler))
        self._simulate_paths = plan.simulate_paths
        self._devices = devices
        self._batch_moments: Any = (
            quick_batch_moments if plan.is_quick else batch_moments
        )
        self._mesh = Mesh(np.array(devices), ("samples",))

    def _sampler_at(self, first: int) -> Callable[..., Samples]:
        """The sampler for the batch from sample number `first` on."""
        if self._simulate_paths is None:
            return self._sampler
        paths = self._simulate_paths(first, self.size)
        # Not `jtu.Partial(self._sampler, paths)`: the function of a `Partial` is static, so
        # with arrays in it, as in the sampler, JAX would compile for each batch.
        return jtu.Partial(_samples_of_paths, self._sampler, paths)

    def start(self, first: int, end: int) -> "_RunningBatch":
        """Starts a batch on all devices, from sample number `first` on. Samples from number
        `end` on do not count."""
        moments = self._batch_moments(*self._arguments_of_batch(first, end))
        has_newton = self._sampler is self._sampler_with_newton
        return _RunningBatch(first, end, has_newton, moments)

    def _arguments_of_batch(self, first: int, end: int) -> tuple[Any, ...]:
        """The arguments of `batch_moments` for `start(first, end)`."""
        num_devices = len(self._devices)
        low_high = np.array([first & 0xFFFFFFFF, first >> 32], np.uint32)
        num_wanted = max(0, min(self.size * num_devices, end - first))
        num_wanted = np.array(num_wanted, np.int32)
        if num_devices == 1:
            on_device = jax.device_put((low_high, num_wanted), self._devices[0])
            low_high, num_wanted = on_device
        return (
            self._sampler_at(first),
            self.key_data,
            self._key_impl,
            low_high,
            num_wanted,
            self._mesh,
            self.size,
        )

    def moments_of_devices(self, running_batch: "_RunningBatch") -> list[BatchMoments]:
        """The moments on each device, copied to the host as soon as they are computed."""
        # The moments are traced if a function closes over traced values.
        check_untraced("`expectation` or `monte_carlo`", running_batch.moments)
        moments = jax.device_get(running_batch.moments)
        if not running_batch.has_newton and np.any(moments.any_failed):
            self._sampler = self._sampler_with_newton
            again = self.start(running_batch.first, running_batch.end)
            moments = jax.device_get(again.moments)
        num_devices = len(self._devices)
        return [jtu.tree_map(lambda x, k=k: x[k], moments) for k in range(num_devices)]


def _is_problem(x: Any) -> bool:
    return isinstance(x, Problem)


def _has_newton(sampler: Callable[..., Samples]) -> bool:
    """Whether Newton's method may solve steps of the paths that a sampler simulates."""
    parts = jtu.tree_leaves(sampler, is_leaf=_is_problem)
    return any(_is_problem(x) and has_newton(x.solver) for x in parts)


def _by_sweeps_alone(sampler: Callable[..., Samples]) -> Callable[..., Samples]:
    """The sampler without Newton's method. Solvers within a user's own function, which
    reports its failures by itself, stay as they are."""

    def by_sweeps_alone(x: Any) -> Any:
        if not _is_problem(x):
            return x
        return dataclasses.replace(x, solver=without_newton(x.solver))

    return jtu.tree_map(by_sweeps_alone, sampler, is_leaf=_is_problem)


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


def _moments_of_no_samples(plan: SamplingPlan, first: int) -> Moments:
    """The moments of no samples, which the batch from sample number `first` on
    continues."""
    outputs = plan.outputs
    zeros = np.zeros((outputs.num_combinations, outputs.layout.size))
    averaged = Averaged(**dict.fromkeys(plan.fields, zeros))
    return Moments(
        begin=first,
        end=first,
        num_good=0,
        num_failed=0,
        failed_on=(0,) * outputs.levels,
        mean=averaged,
        norm=averaged,
        largest=averaged,
        size=averaged,
    )


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


def _needs_no_more_samples(
    estimate: Expectation, plan: SamplingPlan, tol: float | None
) -> bool:
    """Whether there are enough samples for the tolerance, or more would not help: because
    the error of the steps, or of failed paths, is too large beside that of sampling."""
    least = plan.least_beside_steps if tol is None else plan.least_samples
    if least is None or estimate.num_samples < least:
        return False
    if tol is None:
        return is_bounded_by_steps(estimate)
    return is_reached(estimate, tol) or is_stuck(estimate, tol)
