"""Any number of samples, one batch after another, on any devices."""

import collections
import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PRNGKeyArray, PyTree

from ._result import (
    Expectation,
    ExpectationInterrupted,
    finished,
    initial,
    merge,
    reached,
)
from ._steps import AbstractSampler


class Plan(eqx.Module):
    """How samples are taken.

    - `num_samples`: how many at most, those of an estimate to go on from included.
    - `batch_size`: how many each device takes at once.
    - `paths`: how many paths a sample has, on each level.
    - `least`: fewer samples than this do not tell their spread well enough to stop.
    """

    num_samples: int
    batch_size: int
    paths: int = 1
    least: int = 2


def run(
    sampler: AbstractSampler,
    key: PRNGKeyArray,
    plan: Plan,
    devices: tuple,
    start: Expectation | None,
    tol: float | None,
    progress_meter: diffrax.AbstractProgressMeter,
    **about: Any,
) -> Expectation:
    """The estimate from samples, of which number $i$ gets the key
    `fold_in(fold_in(key, i >> 32), i & 0xFFFFFFFF)`, whatever the batch size and the
    devices are. `about` is said of it in its fields of these names."""
    words = _words(key)
    most, size = plan.num_samples, plan.batch_size
    # Of independent paths each that failed was a sample.
    lost = lambda e: e.num_failed if plan.paths == 1 else 0
    used = lambda e: e.num_samples + lost(e)
    first = 0 if start is None else used(start)
    # A batch need not be larger than the number of samples.
    size = min(size, max(1, -(-(most - first) // len(devices))))
    sampler = _shared(sampler)

    batch = lambda begin: _one_batch(sampler, words, devices, begin, most, size)
    # JAX caches this trace and uses it for the first batch.
    shapes = eqx.filter_eval_shape(batch, first)
    values = jtu.tree_map(
        lambda s: jax.ShapeDtypeStruct(s.shape[1:], s.dtype), shapes[2]
    )
    estimate = initial(values, words[0], start, used, most)
    estimate = dataclasses.replace(estimate, **about)
    running = collections.deque()
    meter = progress_meter.init()
    try:
        while True:
            more = first < most and not reached(estimate, tol, plan.least)
            if more:
                running.append(batch(first))
                first += size * len(devices)
            # One batch is computed while the one before it is added up.
            if len(running) > more:
                done = jax.device_get(running.popleft())
                for one in range(len(devices)):
                    # The same samples decide, however many are made at once.
                    if not reached(estimate, tol, plan.least):
                        part = jtu.tree_map(lambda x: x[one], done)
                        estimate = merge(estimate, part, plan.paths)
                meter = progress_meter.step(meter, np.asarray(used(estimate) / most))
            elif not more:
                break
    except KeyboardInterrupt:
        estimate = finished(estimate, tol, plan.least)
        raise ExpectationInterrupted(estimate) from None
    finally:
        progress_meter.close(meter)
    return finished(estimate, tol, plan.least)


def first_spread(
    sampler: AbstractSampler, key: PRNGKeyArray, devices: tuple, size: int
) -> PyTree[np.ndarray]:
    """The variance over a batch of samples of the first combination; larger where few of
    them make up for most of it, so that it is not well known. Infinite if there are
    none."""
    sampler = _shared(sampler)
    out = jax.device_get(_one_batch(sampler, _words(key), devices, 0, size, size))
    (count, _, _, squares), largest = out[:4], out[4]

    def bound(squares, largest):
        squares, largest = squares[0, 0], largest[0, 0]
        n = max(int(count[0]), 1)
        with np.errstate(all="ignore"):
            bound = squares / n + 2 * np.sqrt(squares / n) * largest / np.sqrt(n)
        return np.where(np.isfinite(bound) & (count[0] > 1), bound, np.inf)

    return jtu.tree_map(bound, squares, largest)


def _words(key: PRNGKeyArray) -> tuple[np.ndarray, Any]:
    """The random key as NumPy's, and of which kind it is."""
    return np.asarray(jr.key_data(key)), jr.key_impl(key)


def _one_batch(
    sampler: AbstractSampler, words, devices: tuple, begin: int, most: int, size: int
) -> tuple:
    """Of samples number `begin` to `most`, as many as a batch has on each device."""
    lo_hi = np.array([begin & 0xFFFFFFFF, begin >> 32], np.uint32)
    left = np.array(max(0, min(size * len(devices), most - begin)), np.int32)
    if len(devices) == 1:
        lo_hi, left = jax.device_put((lo_hi, left), devices[0])
    mesh = Mesh(np.array(devices), ("samples",))
    batch: Any = _batch
    return batch(sampler, *words, lo_hi, left, mesh, size)


def _shared(sampler: AbstractSampler) -> AbstractSampler:
    """For several processes: each holds the same arrays. They become constants of its
    program, since arguments would have to be placed on the devices of all."""
    return _Constant(_Holder(sampler)) if jax.process_count() > 1 else sampler


class _Holder:
    """Compared by identity."""

    def __init__(self, value):
        self.value = value


class _Constant(AbstractSampler):
    holder: _Holder = eqx.field(static=True)

    def __call__(self, keys):
        return self.holder.value(keys)


@eqx.filter_jit
def _batch(sampler, key_data, impl, lo_hi, left, mesh: Mesh, n: int):
    """Of the batch of each device: the number of good samples and of paths that failed; of
    the good ones mean, sum of squared deviations from it, and the largest deviation."""

    def local(sampler, lo_hi, left, device: Any = 0):
        index = device * n + jnp.arange(n)
        lo = lo_hi[0] + index.astype(jnp.uint32)
        hi = lo_hi[1] + (lo < lo_hi[0]).astype(jnp.uint32)
        key = jr.wrap_key_data(jnp.asarray(key_data), impl=impl)
        fold = lambda hi, lo: jr.fold_in(jr.fold_in(key, hi), lo)
        samples = sampler(jax.vmap(fold)(hi, lo))
        wanted = index < left
        good = samples.good & wanted
        count, failed = jnp.sum(good), jnp.sum(jnp.where(wanted, samples.failed, 0))

        def moments(x):
            x = x.astype(jnp.result_type(x, float))
            keep = good.reshape(-1, *[1] * (x.ndim - 1))
            add = lambda x: jnp.sum(jnp.where(keep, x, 0), axis=0)
            mean = add(x) / jnp.maximum(count, 1)
            # In two passes, so that no two large numbers are subtracted.
            off = jnp.where(keep, x - mean, 0)
            return mean, jnp.sum(off**2, axis=0), jnp.max(jnp.abs(off), axis=0)

        leaves, treedef = jtu.tree_flatten(samples.values)
        each = map(treedef.unflatten, zip(*map(moments, leaves)))
        return count, failed, *each

    if mesh.size == 1:
        return jtu.tree_map(lambda x: x[None], local(sampler, lo_hi, left))
    dynamic, static = eqx.partition(sampler, eqx.is_array)

    # The programs of the devices know nothing of each other until they are done: so what
    # one of them computes does not depend on how many there are.
    def shard(dynamic, lo_hi, left):
        sampler = eqx.combine(dynamic, static)
        out = local(sampler, lo_hi, left, jax.lax.axis_index("samples"))
        return jtu.tree_map(lambda x: jax.lax.all_gather(x, "samples"), out)

    sharded = jax.shard_map(
        shard,
        mesh=mesh,
        in_specs=PartitionSpec(),
        out_specs=PartitionSpec(),
        check_vma=False,
    )
    try:
        return sharded(dynamic, lo_hi, left)
    except ValueError as error:
        # The loop of Diffrax's default adjoint takes arrays that vary from device to
        # device for others than those it was made for.
        if "Closure-converted function" not in str(error):
            raise
        raise ValueError(
            "Reverse mode through `diffrax.RecursiveCheckpointAdjoint`, the default of "
            "`diffeqsolve`, does not work on several devices. Pass `adjoint="
            "diffrax_symplectic.ReversingAdjoint()` or `adjoint=diffrax.DirectAdjoint()` "
            "to `diffeqsolve`, or `devices=jax.devices()[:1]` to `monte_carlo`."
        ) from error
