"""The program that computes one batch on each device."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from .._compat import is_closure_mismatch, quickly_compiled
from .._lapack import lapack_in_turn
from .sampling import Averaged, Samples


# Powers of two up to this one below the largest that the dtype holds: sums of 2^24 numbers
# of this size stay in range.
_ROOM = 24


class BatchMoments(NamedTuple):
    """What is known of the samples of a batch. Arrays in an `Averaged` have leading axes
    for devices and combinations of levels.

    - `good`: the number of good samples.
    - `failed`: the number of failed paths. A path that fails on several levels counts once.
    - `failed_on`: the number of paths that failed on each level.
    - `mean`: the mean of the good samples.
    - `rest`: the rounding error of this mean, which is added to it in float64.
    - `norm`: the root of the sum of squared deviations from the exact mean.
    - `largest`: the largest deviation.
    - `size`: the largest absolute value.
    """

    good: Int[Array, "*devices"]
    failed: Int[Array, "*devices"]
    failed_on: Int[Array, "*devices levels"]
    mean: Averaged
    rest: Averaged
    norm: Averaged
    largest: Averaged
    size: Averaged


def _moments_on_devices(
    sampler: Callable[..., Samples],
    key_data: UInt32[Array, "..."],
    impl: Any,
    first: UInt32[Array, "2"],
    wanted: Int[Array, ""],
    mesh: Mesh,
    n: int,
) -> BatchMoments:
    """The moments on all devices, along a leading axis. Each takes `n` samples, the first
    one from sample number `first` on, in two halves of 32 bits. The first `wanted`
    count."""
    if mesh.size == 1:
        moments = _of_device(sampler, key_data, impl, first, wanted, n, 0)
        return jtu.tree_map(lambda x: x[None], moments)
    dynamic, static = eqx.partition(sampler, eqx.is_array)

    # The devices do not communicate until the end, so each one's result does not depend on
    # how many there are.
    def shard(dynamic, first, wanted):
        sampler = eqx.combine(dynamic, static)
        device = jax.lax.axis_index("samples")
        moments = _of_device(sampler, key_data, impl, first, wanted, n, device)
        return jtu.tree_map(lambda x: jax.lax.all_gather(x, "samples"), moments)

    none = PartitionSpec()
    sharded = jax.shard_map(
        shard, mesh=mesh, in_specs=none, out_specs=none, check_vma=False
    )
    try:
        return sharded(dynamic, first, wanted)
    except ValueError as error:
        # The loop of Diffrax's default adjoint rejects arrays that vary between devices.
        if is_closure_mismatch(error):
            error.add_note(
                "Reverse mode through `diffrax.RecursiveCheckpointAdjoint`, the default of "
                "`diffeqsolve`, does not work on several devices. Pass `adjoint=diffrax_"
                "symplectic.ReversingAdjoint()` or `adjoint=diffrax.DirectAdjoint()` to "
                "`diffeqsolve`, or `devices=jax.devices()[:1]` to `monte_carlo`."
            )
        raise


batch_moments = eqx.filter_jit(_moments_on_devices)
# For samples that take less time than compiling their program.
quick_batch_moments = quickly_compiled(_moments_on_devices)


def _of_device(
    sampler: Callable[..., Samples],
    key_data: UInt32[Array, "..."],
    impl: Any,
    first: UInt32[Array, "2"],
    wanted: Int[Array, ""],
    n: int,
    device: Any,
) -> BatchMoments:
    """The moments on one device, by its number."""
    index = device * n + jnp.arange(n)
    # The sum of `first` and `index` in two halves, since there may be no 64-bit integers.
    low = first[0] + index.astype(jnp.uint32)
    high = first[1] + (low < first[0]).astype(jnp.uint32)
    key = jr.wrap_key_data(jnp.asarray(key_data), impl=impl)

    def sample_key(high: Array, low: Array) -> PRNGKeyArray:
        return jr.fold_in(jr.fold_in(key, high), low)

    samples = lapack_in_turn(sampler)(jax.vmap(sample_key)(high, low))
    # The last batch is cut here: another size would be another program.
    is_wanted = index < wanted
    good = samples.good & is_wanted
    lost = jnp.where(is_wanted, samples.lost, 0)
    failed = jnp.sum(jnp.max(lost, axis=0))
    fields = samples.averaged.fields
    # All fields of one shape are summed at once, since fewer operations compile sooner.
    stacked = jtu.tree_map(lambda *of_fields: jnp.stack(of_fields), *fields.values())
    leaves, treedef = jtu.tree_flatten(stacked)
    each = [_moments_of_array(leaf, good) for leaf in leaves]

    def by_field(*of_leaves: Array) -> Averaged:
        tree = treedef.unflatten(of_leaves)
        parts = [jtu.tree_map(lambda x, k=k: x[k], tree) for k in range(len(fields))]
        return Averaged(**dict(zip(fields, parts)))

    moments = itertools.starmap(by_field, zip(*each))
    return BatchMoments(jnp.sum(good), failed, jnp.sum(lost, axis=1), *moments)


def _moments_of_array(
    x: Float[Array, "fields combinations n ..."], good: Bool[Array, " n"]
) -> tuple[Array, Array, Array, Array, Array]:
    """`mean`, `rest`, `norm`, `largest` and `size` of `BatchMoments` for one array."""
    mask = good.reshape(-1, *[1] * (x.ndim - 3))
    n = jnp.maximum(jnp.sum(good), 1)

    def largest_of(x: Array) -> Array:
        return jnp.max(jnp.abs(x), axis=2)

    x = jnp.where(mask, x, 0)
    size = largest_of(x)
    to_unit, from_unit = _powers(size)
    mean = from_unit * (jnp.sum(x * to_unit[:, :, None], axis=2) / n)
    # Two passes avoid cancellation. The second also finds the rounding error of the mean.
    deviations = jnp.where(mask, x - mean[:, :, None], 0)
    largest = largest_of(deviations)
    to_unit, from_unit = _powers(largest)
    z = deviations * to_unit[:, :, None]
    rest = jnp.sum(z, axis=2) / n
    squares = jnp.maximum(jnp.sum(z**2, axis=2) - n * rest**2, 0)
    return mean, from_unit * rest, from_unit * jnp.sqrt(squares), largest, size


def _powers(size: Array) -> tuple[Array, Array]:
    """A power of two that scales numbers of this size to about one, so that sums of them
    and of their squares stay in range; and its inverse. (XLA divides by multiplying with
    the inverse, which may underflow.)"""
    most = jnp.finfo(size.dtype).maxexp - _ROOM
    exponent = jnp.clip(jnp.frexp(size)[1], -most, most)
    one = jnp.ones_like(size)
    return jnp.ldexp(one, -exponent), jnp.ldexp(one, exponent)
