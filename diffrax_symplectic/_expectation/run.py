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
    """Keeps the estimate so far. As a context manager it turns a `KeyboardInterrupt` within
    its block into an `ExpectationInterrupted` that holds this estimate.

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
    """The estimate from the samples of a plan, which are computed in batches. The result
    does not depend on the number of devices.

    - `start`: an estimate to continue. Without it, samples begin with number `first`.
    - `tol`: the tolerance, with which fewer samples may be taken than the plan has.
    - `kept`: gets the estimate after each batch, for the case of an interrupt.
    - `fields`: further fields of the result."""
    # Samples have the numbers `begin` to `end - 1`. Those before `next_sample` are in the
    # estimate.
    begin = first if start is None else start.moments[0].begin
    next_sample = first if start is None else start.moments[-1].end
    end = begin + plan.num_samples
    if end > MOST_SAMPLES:
        raise ValueError(
            f"Samples have numbers below 2^63; got {plan.num_samples} from number {begin} "
            "on. Pass a smaller number of paths (or replicates), or a smaller `first`."
        )
    kept = Kept() if kept is None else kept
    tol_reached = None if tol is None else False
    estimate = _first_estimate(plan, key, start, tol_reached=tol_reached, **fields)
    if start is not None:
        kept.estimate = estimate

    def needs_no_more_samples() -> bool:
        """Whether to stop. With a tolerance: once it is reached, or more samples would not
        help, because the error of the steps or of failed paths is too large. Without one:
        once the error of the steps is most of the error, if the plan allows that."""
        # With fewer samples the error is too uncertain to stop.
        least = plan.least_beside_steps if tol is None else plan.least_samples
        if least is None or estimate.num_samples < least:
            return False
        if tol is None:
            return is_bounded_by_steps(estimate)
        return is_reached(estimate, tol) or is_stuck(estimate, tol)

    batches = _Batches(plan, key, devices)
    # The number of the first sample of each batch.
    firsts = iter(range(next_sample, end, batches.size * len(devices)))

    def start_batch() -> Callable[[], list[BatchMoments]] | None:
        """Starts the next batch. Returns the function that waits for its moments on each
        device, or `None` if no batch is left or needed."""
        first_of_batch = None if needs_no_more_samples() else next(firsts, None)
        return None if first_of_batch is None else batches.start(first_of_batch, end)

    moments_of_batch = start_batch()
    while moments_of_batch is not None:
        # Batches are started one ahead: while a batch is being computed, the one before it
        # is added to the estimate.
        moments_ahead = start_batch()
        for device_moments in moments_of_batch():
            # If there are enough samples before the last device of a batch, those of the
            # other devices are dropped, so that the number of samples at the end does not
            # depend on the number of devices.
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
        moments_of_batch = moments_ahead
    if tol is not None:
        has_enough = estimate.num_samples >= plan.least_samples
        tol_reached = has_enough and is_reached(estimate, tol)
        estimate = dataclasses.replace(estimate, tol_reached=tol_reached)
    kept.estimate = estimate
    return estimate


def _first_estimate(
    plan: SamplingPlan, key: PRNGKeyArray, start: Expectation | None, **fields: Any
) -> Expectation:
    """The estimate before the first batch: it has the samples of `start`, or none. Raises a
    `ValueError` if `start` has another key, other arguments, or more samples than the plan.
    `fields` are further fields of the estimate."""
    estimate = Expectation(
        moments=() if start is None else start.moments,
        key_data=np.asarray(jr.key_data(key)),
        paths_per_sample=plan.paths_per_sample,
        reason=plan.reason if start is None else start.reason,
        **plan.outputs._asdict(),
        **fields,
    )
    if start is not None:
        check_same(start, estimate, "`start`")
        num_taken = start.moments[-1].end - start.moments[0].begin
        if num_taken > plan.num_samples:
            raise ValueError(
                "The number of paths (or replicates) includes `start`, which has "
                f"{num_taken} already; got {plan.num_samples}. Pass a larger number."
            )
    return estimate


class _Batches:
    """The batches of a plan, in each of which every device takes `size` samples.

    Implicit steps are first solved by sweeps alone, the fixed-point iterations of the root
    finder `PicardNewton`. Few paths need its Newton's method, which would be a third of the
    time to compile a step. Once a path fails, its batch is computed again with Newton's
    method, and all later batches are computed with it.
    """

    def __init__(self, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices):
        self.size = min(plan.batch_size, plan.num_samples)
        self._key_data = np.asarray(jr.key_data(key))
        self._key_impl = jr.key_impl(key)
        samplers = [plan.sampler]
        solvers = [problem.solver for problem in parts_of(Problem, plan.sampler)]
        # With `simulate_paths`, the steps are solved before the sampler is called.
        if plan.simulate_paths is None and any(map(has_newton, solvers)):
            samplers = [_by_sweeps_alone(plan.sampler), plan.sampler]
        # The first sampler takes all samples until a path fails, and then the last one.
        self._samplers = [*map(_for_all_processes, samplers)]
        self._simulate_paths = plan.simulate_paths
        self._devices = devices
        self._program: Any = quick_batch_moments if plan.is_quick else batch_moments
        self._mesh = Mesh(np.array(devices), ("samples",))

    def start(self, first: int, end: int) -> Callable[[], list[BatchMoments]]:
        """Starts a batch on all devices, from sample number `first` on. Samples from number
        `end` on do not count. Returns a function that waits for the moments on each
        device."""
        num_devices = len(self._devices)
        # The number in two halves of 32 bits, since JAX may have no 64-bit integers.
        low_high = np.array([first & 0xFFFFFFFF, first >> 32], np.uint32)
        num_wanted = np.array(min(self.size * num_devices, end - first), np.int32)
        if num_devices == 1:
            device = self._devices[0]
            low_high, num_wanted = jax.device_put((low_high, num_wanted), device)
        sampler = self._samplers[0]
        may_be_repeated = len(self._samplers) > 1
        if self._simulate_paths is not None:
            # Not `jtu.Partial(sampler, paths)`: JAX takes the function of a `Partial` as
            # static, so it would compile anew for the arrays in the sampler of each batch.
            paths = self._simulate_paths(first, self.size)
            sampler = jtu.Partial(_samples_of_paths, sampler, paths)
        moments = self._program(
            sampler,
            self._key_data,
            self._key_impl,
            low_high,
            num_wanted,
            self._mesh,
            self.size,
        )

        def moments_of_devices() -> list[BatchMoments]:
            # The moments are traced if a function of the user closes over traced values.
            check_untraced("`expectation` or `monte_carlo`", moments)
            on_host = jax.device_get(moments)
            if may_be_repeated and np.any(on_host.any_failed):
                # Repeat this batch, and take all later ones, with Newton's method.
                self._samplers = self._samplers[-1:]
                return self.start(first, end)()
            return [
                jtu.tree_map(lambda x, k=k: x[k], on_host) for k in range(num_devices)
            ]

        return moments_of_devices


def _by_sweeps_alone(sampler: Callable[..., Samples]) -> Callable[..., Samples]:
    """The sampler without Newton's method. Solvers that a function of the user calls, as
    for `monte_carlo`, stay as they are."""

    def by_sweeps_alone(problem: Problem) -> Problem:
        return dataclasses.replace(problem, solver=without_newton(problem.solver))

    return with_parts(Problem, by_sweeps_alone, sampler)


def _for_all_processes(sampler: Callable[..., Samples]) -> Callable[..., Samples]:
    """The sampler itself, or for several processes a function that captures it."""
    if jax.process_count() == 1:
        return sampler
    # The arrays in a sampler would be arguments of the program, and have to be placed on
    # the devices of all processes. Captured by a function, they are constants of the
    # program, the same in all processes.
    return lambda keys: sampler(keys)


def _samples_of_paths(
    sampler: Callable, paths: PyTree, keys: Key[Array, " n"]
) -> Samples:
    """The samples that a sampler makes of paths that were computed outside JAX."""
    return sampler(paths, keys)


def _in_float64(device_moments: BatchMoments, begin: int, end: int) -> Moments:
    """The moments of samples `begin` to `end - 1`, which one device computed, in float64.
    The mean is `mean + mean_correction`, a sum that single precision could not hold."""
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
