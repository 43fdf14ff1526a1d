"""The loop that computes estimates, batch after batch, on any devices."""

import collections
import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Key, PRNGKeyArray, PyTree

from .._arguments import check_untraced
from .._custom_types import Devices
from .batch import batch_moments, BatchMoments, quick_batch_moments
from .estimate import (
    check_same,
    Expectation,
    ExpectationInterrupted,
    is_reached,
    is_stuck,
    joined,
    Moments,
    share_of,
)
from .sampling import Samples, SamplingPlan


NO_METER = diffrax.NoProgressMeter()


class Meter:
    """A progress meter of Diffrax, as a context manager."""

    def __init__(self, meter: diffrax.AbstractProgressMeter):
        self._meter = meter
        self._state = meter.init()

    def step(self, progress: float) -> None:
        """Shows the progress, from 0 to 1."""
        self._state = self._meter.step(self._state, np.asarray(progress))

    def __enter__(self) -> "Meter":
        return self

    def __exit__(self, *error: Any) -> None:
        self._meter.close(self._state)


def run(
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: Devices,
    sampling: Any = None,
    start: Expectation | None = None,
    first: int = 0,
    tol: float | None = None,
    meter: Meter | None = None,
) -> Expectation:
    """The estimate from the samples of a plan, which continues `start`, or begins with
    sample number `first`. The result does not depend on the number of devices."""
    # One past the last sample that is part of the estimate.
    done = first
    if start is not None:
        first = start.moments[0].begin
        done = start.moments[-1].end
    end = first + plan.num_samples
    batches = _Batches(plan, key, devices)
    none = batches.nothing(done, end)
    estimate = Expectation(
        moments=(none,),
        key_data=batches.key_data,
        paths_per_sample=plan.paths,
        rounding_floor=plan.rounding_floor,
        sampling=sampling,
        reason=plan.reason,
        tails=plan.tails,
    )
    if start is not None:
        check_same(start, estimate, "`start`")
        if done > end:
            raise ValueError(
                "The number of paths (or replicates) includes `start`, which has "
                f"{done - first} already; got {plan.num_samples}. Pass a larger number."
            )
        estimate = dataclasses.replace(estimate, moments=start.moments)

    running: collections.deque[BatchMoments] = collections.deque()
    # One past the last sample of the batches that were started.
    begun = done
    try:
        while True:
            is_more = begun < end and not _stops(estimate, plan.least, tol)
            if is_more:
                running.append(batches.start(begun, end, batches.sampler_at(begun)))
                begun += batches.size * len(devices)
            # While one batch is being computed, the previous one is added up.
            has_previous = len(running) > (1 if is_more else 0)
            if has_previous:
                for of_device in batches.of_devices(running.popleft()):
                    # Where to stop does not depend on how many devices there are.
                    if done < end and not _stops(estimate, plan.least, tol):
                        after = min(done + batches.size, end)
                        new = _in_float64(of_device, done, after, none.dtypes)
                        moments = joined((*estimate.moments, new))
                        estimate = dataclasses.replace(estimate, moments=moments)
                        done = after
                if meter is not None:
                    share = (done - first) / plan.num_samples
                    meter.step(max(share, share_of(estimate, tol)))
            elif not is_more:
                break
    except KeyboardInterrupt:
        raise ExpectationInterrupted(
            _with_tol_reached(estimate, plan.least, tol)
        ) from None
    return _with_tol_reached(estimate, plan.least, tol)


class _Batches:
    """The batches of a plan: each device takes `size` samples at once."""

    def __init__(self, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices):
        self.size = min(plan.batch_size, plan.num_samples)
        self.key_data = np.asarray(jr.key_data(key))
        self._impl = jr.key_impl(key)
        self._sampler = plan.sampler
        self._paths_of = plan.paths_of
        self._devices = devices
        self._shapes = plan.shapes
        self._levels = plan.levels
        self._batch_moments: Any = quick_batch_moments if plan.quick else batch_moments
        if jax.process_count() > 1:
            # All processes hold the same arrays. Captured by a function they become
            # constants; as arguments they would have to be placed on all devices.
            self._sampler = lambda keys: plan.sampler(keys)
        self._mesh = Mesh(np.array(devices), ("samples",))

    def sampler_at(self, at: int) -> Callable[..., Samples]:
        """What makes the samples of the batch from sample `at` on."""
        if self._paths_of is None:
            return self._sampler
        # Of a `Partial` of a `Partial` JAX would take the inner one for a function, arrays
        # and all, and compile anew for each.
        return jtu.Partial(_of_paths, self._sampler, self._paths_of(at, self.size))

    def start(self, at: int, end: int, sampler: Callable[..., Samples]) -> BatchMoments:
        """Starts one batch on each device, from sample `at` on and up to `end`."""
        count = len(self._devices)
        low_high = np.array([at & 0xFFFFFFFF, at >> 32], np.uint32)
        wanted = np.array(max(0, min(self.size * count, end - at)), np.int32)
        if count == 1:
            low_high, wanted = jax.device_put((low_high, wanted), self._devices[0])
        return self._batch_moments(
            sampler, self.key_data, self._impl, low_high, wanted, self._mesh, self.size
        )

    def of_devices(self, running: BatchMoments) -> list[BatchMoments]:
        """The moments on each device, on the host. Waits for them."""
        # They are traced if a function closes over traced values.
        check_untraced("`expectation` or `monte_carlo`", running)
        arrays = jax.device_get(running)
        count = len(self._devices)
        return [jtu.tree_map(lambda x, k=k: x[k], arrays) for k in range(count)]

    def nothing(self, at: int, end: int) -> Moments:
        """The moments of no samples."""
        shapes = self._shapes
        if shapes is None:
            # JAX caches this trace and uses it for the first batch.
            sampler = self.sampler_at(at)
            struct = eqx.filter_eval_shape(self.start, at, end, sampler)
            # Without the axis of devices.
            shapes = jtu.tree_map(
                lambda s: jax.ShapeDtypeStruct(s.shape[1:], s.dtype), struct.mean
            )
        zeros = jtu.tree_map(lambda s: np.zeros(s.shape), shapes)
        return Moments(
            begin=at,
            end=at,
            good=0,
            failed=0,
            failed_on=(0,) * self._levels,
            mean=zeros,
            norm=zeros,
            largest=zeros,
            size=zeros,
            dtypes=jtu.tree_map(lambda s: str(s.dtype), shapes.value),
        )


def _of_paths(sampler: Callable, paths: PyTree, keys: Key[Array, " n"]) -> Samples:
    """The samples from paths that were computed outside of JAX."""
    return sampler(paths, keys)


def _in_float64(
    of_device: BatchMoments, begin: int, end: int, dtypes: PyTree[str]
) -> Moments:
    """The moments of samples `begin` to `end - 1`, in float64."""
    # Single precision could not hold the sum of a mean and its rounding error.
    wide = jtu.tree_map(lambda x: x.astype(float), of_device)
    return Moments(
        begin=begin,
        end=end,
        good=int(of_device.good),
        failed=int(of_device.failed),
        failed_on=tuple(map(int, of_device.failed_on)),
        mean=jtu.tree_map(np.add, wide.mean, wide.rest),
        norm=wide.norm,
        largest=wide.largest,
        size=wide.size,
        dtypes=dtypes,
    )


def _stops(estimate: Expectation, least: int, tol: float | None) -> bool:
    """Whether there are enough samples for the tolerance, or more would not help."""
    if tol is None or estimate.num_samples < least:
        return False
    return is_reached(estimate, tol) or is_stuck(estimate, tol)


def _with_tol_reached(
    estimate: Expectation, least: int, tol: float | None
) -> Expectation:
    """The estimate, which now says whether it reached the tolerance."""
    reached = None
    if tol is not None:
        reached = estimate.num_samples >= least and is_reached(estimate, tol)
    return dataclasses.replace(estimate, tol_reached=reached)
