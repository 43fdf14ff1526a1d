"""The loop that computes estimates, batch after batch, on any devices."""

import collections
import dataclasses
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .._arguments import check_untraced, whole_number
from .._brownian import check_key, typed_key
from .._compat import quickly_compiled
from .._lapack import lapack_in_turn
from .estimate import (
    best_results,
    check_same,
    Expectation,
    ExpectationInterrupted,
)
from .moments import joined, Moments, total
from .sampling import KindsWithControl, Samples, SamplingPlan


# With an `r` of `std_error` above this, means of exp(5 x) with normal x were off by forty
# standard errors, and means of exp(3 x) by five.
_HEAVY = 0.35
NO_METER = diffrax.NoProgressMeter()


def checked_call(
    user: str, key, tol, start, first, devices: Sequence[Any] | None, *others: Any
) -> tuple[PRNGKeyArray, int, tuple]:
    """The key as a typed key, the number of the first sample, and the devices. Raises a
    `ValueError` for invalid arguments, and if any array is traced."""
    # Inside `jit` a new array is traced, too. Functions that close over traced values of
    # other transformations are found once something that depends on these is needed.
    new = jnp.zeros(())
    check_untraced(f"`{user}`", (key, others, new))
    check_key(key, user)
    if start is not None and first != 0:
        raise ValueError(
            "Pass either `start`, which continues after its last sample, or `first`."
        )
    first = whole_number("first", first, 0)
    is_number = isinstance(tol, int | float | np.number)
    if tol is not None and not (is_number and 0 < tol < np.inf):
        raise ValueError(f"`tol` must be a positive number, or `None`; got {tol!r}.")
    if start is not None and not isinstance(start, Expectation):
        raise ValueError(
            f"`start` must be what `{user}` returned, or `None`; got {start!r}."
        )
    devices = jax.devices() if devices is None else devices
    is_device = lambda x: isinstance(x, jax.Device)
    if not isinstance(devices, Sequence) or not all(map(is_device, devices)):
        raise ValueError(
            "`devices` must be a list of devices, such as `jax.devices()[:1]`, or `None`; "
            f"got {devices!r}."
        )
    return typed_key(key), first, tuple(devices)


def refuse_others(user: str, others: dict[str, Any]) -> None:
    """Raises a `TypeError` for arguments that only a solve takes."""
    if others:
        raise TypeError(
            f"`{user}` takes no {', '.join(f'`{name}`' for name in others)}. To use events "
            "or other arguments of `diffrax.diffeqsolve`, write the solve as a function of "
            "a random key and average it with `monte_carlo`."
        )


class Meter:
    """A progress meter, as a context manager."""

    def __init__(self, meter: diffrax.AbstractProgressMeter):
        self._meter, self._state = meter, meter.init()

    def step(self, progress: float) -> None:
        self._state = self._meter.step(self._state, np.asarray(progress))

    def __enter__(self) -> "Meter":
        return self

    def __exit__(self, *error) -> None:
        self._meter.close(self._state)


def run(
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: tuple,
    sampling: Any = None,
    start: Expectation | None = None,
    first: int = 0,
    tol: float | None = None,
    meter: Meter | None = None,
) -> Expectation:
    """The estimate from the samples of a plan, which continues `start`, or begins with
    sample number `first`. Without a meter it is a trial, without warnings. The result does
    not depend on the number of devices."""
    at = first
    if start is not None:
        first, at = start.moments[0].begin, start.moments[-1].end
    most, batches = first + plan.num_samples, _Batches(plan, key, devices)
    none = batches.nothing(at, most)
    about = plan.roundings, sampling, plan.reason, None, plan.far
    estimate = Expectation((none,), batches.key_data, plan.paths, *about)
    if start is not None:
        check_same(start, estimate, "`start`")
        if at > most:
            raise ValueError(
                "The number of paths (or replicates) includes `start`, which has "
                f"{at - first} already; got {plan.num_samples}. Pass a larger number."
            )
        estimate = dataclasses.replace(estimate, moments=start.moments)
    reached = lambda: _reached(estimate, plan.least, tol)
    running, done = collections.deque(), at
    try:
        while True:
            more = at < most and not reached()
            if more:
                running.append(batches.started(at, most, batches.sampler_at(at)))
                at += batches.size * len(devices)
            # While one batch is being computed, the previous one is added up.
            if len(running) > more:
                for part in batches.parts(running.popleft()):
                    # Where to stop does not depend on how many devices there are.
                    if done < most and not reached():
                        end = min(done + batches.size, most)
                        new = _moments(part, done, end, none.dtypes)
                        both = joined((*estimate.moments, new))
                        estimate = dataclasses.replace(estimate, moments=both)
                        done = end
                if meter is not None:
                    share = (done - first) / plan.num_samples
                    meter.step(max(share, _share_of_tolerance(estimate, tol)))
            elif not more:
                break
    except KeyboardInterrupt:
        raise ExpectationInterrupted(_finished(estimate, plan.least, tol)) from None
    estimate = _finished(estimate, plan.least, tol)
    if meter is not None:
        for message in _warnings(estimate, tol, plan.bounded):
            warnings.warn(message, stacklevel=3)
    return estimate


class _Batches:
    """The batches of a plan: each device takes `size` samples at once."""

    def __init__(self, plan: SamplingPlan, key: PRNGKeyArray, devices: tuple):
        self.size = min(plan.batch_size, plan.num_samples)
        self.key_data, self._impl = np.asarray(jr.key_data(key)), jr.key_impl(key)
        self._sampler, self._paths_of, self._devices = (
            plan.sampler,
            plan.paths_of,
            devices,
        )
        self._shapes = plan.shapes
        self._sums: Any = _quick_batch if plan.quick else _batch
        if jax.process_count() > 1:
            # All processes hold the same arrays. Captured by a function they become
            # constants; as arguments they would have to be placed on all devices.
            self._sampler = lambda keys: plan.sampler(keys)
        self._mesh = Mesh(np.array(devices), ("samples",))

    def sampler_at(self, at: int) -> Callable:
        if self._paths_of is None:
            return self._sampler
        # Of a `Partial` of a `Partial` JAX would take the inner one for a function, arrays
        # and all, and compile anew for each.
        return jtu.Partial(_of_paths, self._sampler, self._paths_of(at, self.size))

    def started(self, at: int, most: int, sampler: Callable) -> tuple:
        """Starts one batch on each device, from sample `at` on and up to `most`."""
        count = len(self._devices)
        lo_hi = np.array([at & 0xFFFFFFFF, at >> 32], np.uint32)
        left = np.array(max(0, min(self.size * count, most - at)), np.int32)
        if count == 1:
            lo_hi, left = jax.device_put((lo_hi, left), self._devices[0])
        return self._sums(
            sampler, self.key_data, self._impl, lo_hi, left, self._mesh, self.size
        )

    def parts(self, running: tuple) -> list[tuple]:
        """The results of each device."""
        # They are traced if a function closes over traced values.
        check_untraced("`expectation` or `monte_carlo`", running)
        arrays = jax.device_get(running)
        at = lambda k: jtu.tree_map(lambda x: x[k], arrays)
        return [at(k) for k in range(len(self._devices))]

    def nothing(self, at: int, most: int) -> Moments:
        """The moments of no samples."""
        shapes = self._shapes
        if shapes is None:
            # JAX caches this trace and uses it for the first batch.
            sampler = self.sampler_at(at)
            batches = eqx.filter_eval_shape(self.started, at, most, sampler)[2]
            without_devices = lambda s: jax.ShapeDtypeStruct(s.shape[1:], s.dtype)
            shapes = jtu.tree_map(without_devices, batches)
        zeros = jtu.tree_map(lambda s: np.zeros(s.shape), shapes)
        dtypes = jtu.tree_map(lambda s: str(s.dtype), shapes)
        return Moments(at, at, 0, 0, zeros, zeros, zeros, zeros, dtypes)


def _of_paths(sampler: Callable, paths: PyTree, keys: PRNGKeyArray) -> Samples:
    return sampler(paths, keys)


def _reached(estimate: Expectation, least: int, tol: float | None) -> bool:
    if tol is None or estimate.num_samples < least:
        return False
    return all(bool(np.all(x <= tol)) for x in jtu.tree_leaves(estimate.std_error))


def _finished(estimate: Expectation, least: int, tol: float | None) -> Expectation:
    said = None if tol is None else _reached(estimate, least, tol)
    return dataclasses.replace(estimate, tol_reached=said)


def _share_of_tolerance(estimate: Expectation, tol: float | None) -> float:
    """The estimated share of the samples needed that has been taken."""
    if tol is None or estimate.num_samples < 2:
        return 0.0
    errors = jtu.tree_leaves(estimate.std_error)
    largest = max(float(np.max(x, initial=tol)) for x in errors)
    return (tol / largest) ** 2 if np.isfinite(largest) else 0.0


def _moments(part, begin: int, end: int, dtypes) -> Moments:
    count, failed, *trees = part
    wide = lambda tree: jtu.tree_map(lambda x: x.astype(float), tree)
    mean, rest, norm, largest, size = map(wide, trees)
    mean = jtu.tree_map(np.add, mean, rest)
    numbers = begin, end, int(count), int(failed)
    return Moments(*numbers, mean, norm, largest, size, dtypes)


def _warnings(estimate: Expectation, tol: float | None, bounded: bool) -> Iterator[str]:
    if estimate.num_failed > 0:
        yield from _warnings_of_failures(estimate, bounded)
    if estimate.num_samples > 1:
        yield from _warnings_of_spread(estimate)
    if estimate.tol_reached is False:
        errors = jtu.tree_leaves(estimate.std_error)
        largest = max(float(np.max(x, initial=0.0)) for x in errors)
        yield (
            f"`tol={tol}` was not reached: the largest standard error is {largest:.1e} "
            f"after {estimate.num_paths:,} paths. Take more paths, continuing with "
            "`start=`, or another `sampling`."
        )


def _warnings_of_failures(estimate: Expectation, bounded: bool) -> Iterator[str]:
    changes = jtu.tree_leaves(estimate.failed_error)
    errors = jtu.tree_leaves(estimate.std_error)
    # Without samples both are NaN.
    if all(np.all(change <= error) for change, error in zip(changes, errors)):
        return
    if estimate.num_samples == 0:
        rest = "there is no mean"
    else:
        largest = max(float(np.max(x, initial=0.0)) for x in changes)
        rest = (
            "they are left out of the mean, and could change it by more than its standard "
            f"error, up to {largest:.1e}, which is part of `error`"
        )
    instead = "" if bounded else " or bounded increments, as from a `WeakBrownianPath`,"
    yield (
        f"{estimate.num_failed:,} paths failed: {rest}. Take smaller steps{instead} and "
        "look for NaNs in `y0`, `args` and the Hamiltonians."
    )


def _warnings_of_spread(estimate: Expectation) -> Iterator[str]:
    results = jtu.tree_leaves((estimate.mean, estimate.std_error))
    if not all(np.all(np.isfinite(x)) for x in results):
        yield (
            "The mean or its standard error is not finite: the averaged values overflow. "
            "Take smaller steps or a more stable solver, and check whether single paths "
            "stay bounded."
        )
    best = best_results(estimate)
    if any(np.any(x) for x in jtu.tree_leaves(best.dropped)):
        yield (
            "A control variate was dropped: its mean over these paths is more than five "
            "standard errors from zero, or not finite. The estimate is crude Monte Carlo. "
            "Pass a smaller `degree`, or another `sampling`."
        )
    if any(np.any(x > _HEAVY) for x in jtu.tree_leaves(best.heaviness)):
        yield (
            f"A few of the {estimate.num_paths:,} paths account for most of the variance: "
            "still rarer paths may contribute much to the mean, and the standard error may "
            "be too small. Take many more paths, or a function that grows more slowly."
        )
    whole = total(estimate.moments)
    kinds = zip(jtu.tree_leaves(whole.size), jtu.tree_leaves(whole.dtypes))
    # The values without control.
    plain = lambda x: x[int(len(x) == len(KindsWithControl)), 0]
    low = [dtype for x, dtype in kinds if np.max(plain(x)) < _least(dtype)]
    if low:
        yield (
            f"A component is zero, or underflows {low[0]}, on all paths. If it "
            'underflows, use other units, or call `jax.config.update("jax_enable'
            '_x64", True)` first. If it is the indicator of a rare event, the event did '
            "not occur, and the standard error is meaningless."
        )
    elif not any(np.any(x > 0) for x in jtu.tree_leaves(estimate.variance)):
        yield (
            f"All {estimate.num_samples:,} samples are equal, so the error is unknown. "
            "Check that phi depends on the noise, and a function for `monte_carlo` on its "
            "key."
        )


def _least(dtype: str) -> float:
    """The smallest number whose rounding errors do not underflow."""
    return float(jnp.finfo(dtype).tiny / jnp.finfo(dtype).eps)


def _sums(sampler, key_data, impl, lo_hi, left, mesh: Mesh, n: int):
    """The batches of all devices: the numbers of good samples and of failed paths, and the
    sums from which `_moments` computes the moments of the good samples."""

    def local(sampler, lo_hi, left, device: Any = 0):
        index = device * n + jnp.arange(n)
        lo = lo_hi[0] + index.astype(jnp.uint32)
        hi = lo_hi[1] + (lo < lo_hi[0]).astype(jnp.uint32)
        key = jr.wrap_key_data(jnp.asarray(key_data), impl=impl)
        fold = lambda hi, lo: jr.fold_in(jr.fold_in(key, hi), lo)
        samples = lapack_in_turn(sampler)(jax.vmap(fold)(hi, lo))
        wanted = index < left
        good, failed = samples.good & wanted, jnp.where(wanted, samples.lost, 0)
        leaves, treedef = jtu.tree_flatten(samples.values)
        each = [_moments_of_batch(x, good) for x in leaves]
        return jnp.sum(good), jnp.sum(failed), *map(treedef.unflatten, zip(*each))

    if mesh.size == 1:
        return jtu.tree_map(lambda x: x[None], local(sampler, lo_hi, left))
    dynamic, static = eqx.partition(sampler, eqx.is_array)

    # The devices do not communicate until the end, so each one's result does not depend on
    # how many there are.
    def shard(dynamic, lo_hi, left):
        sampler = eqx.combine(dynamic, static)
        out = local(sampler, lo_hi, left, jax.lax.axis_index("samples"))
        return jtu.tree_map(lambda x: jax.lax.all_gather(x, "samples"), out)

    none = PartitionSpec()
    sharded = jax.shard_map(
        shard, mesh=mesh, in_specs=none, out_specs=none, check_vma=False
    )
    try:
        return sharded(dynamic, lo_hi, left)
    except ValueError as error:
        # The loop of Diffrax's default adjoint rejects arrays that vary between devices.
        if "Closure-converted function" in str(error):
            error.add_note(
                "Reverse mode through `diffrax.RecursiveCheckpointAdjoint`, the default of "
                "`diffeqsolve`, does not work on several devices. Pass `adjoint=diffrax_"
                "symplectic.ReversingAdjoint()` or `adjoint=diffrax.DirectAdjoint()` to "
                "`diffeqsolve`, or `devices=jax.devices()[:1]` to `monte_carlo`."
            )
        raise


_batch = eqx.filter_jit(_sums)
_quick_batch = quickly_compiled(_sums)


def _moments_of_batch(
    x: Float[Array, "kinds combinations n ..."], good: Bool[Array, " n"]
):
    """For the good samples: the mean, its rounding error, the root of the sum of squared
    deviations from the exact mean, the largest deviation, and the largest absolute value.
    """
    keep = good.reshape(-1, *[1] * (x.ndim - 3))
    x = jnp.where(keep, x, 0)
    total, n = lambda x: jnp.sum(x, axis=2), jnp.maximum(jnp.sum(good), 1)
    largest = lambda x: jnp.max(jnp.abs(x), axis=2)
    size = largest(x)
    to_unit, from_unit = _powers(size)
    mean = from_unit * (total(x * to_unit[:, :, None]) / n)
    # Two passes avoid cancellation. The second also finds the rounding error of the mean.
    off = jnp.where(keep, x - mean[:, :, None], 0)
    far = largest(off)
    to_unit, from_unit = _powers(far)
    z = off * to_unit[:, :, None]
    rest = total(z) / n
    squares = jnp.maximum(total(z**2) - n * rest**2, 0)
    return mean, from_unit * rest, from_unit * jnp.sqrt(squares), far, size


def _powers(size: Array) -> tuple[Array, Array]:
    """A power of two that scales numbers of this size to about one, so that sums of them
    and of their squares stay in range; and its inverse. (XLA divides by multiplying with
    the inverse, which may underflow.)"""
    most = jnp.finfo(size.dtype).maxexp - 24
    exponent = jnp.clip(jnp.frexp(size)[1], -most, most)
    one = jnp.ones_like(size)
    return jnp.ldexp(one, -exponent), jnp.ldexp(one, exponent)
