"""The program that computes one batch on each device."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._compat import is_closure_mismatch
from .._fused import sample_key
from .._lapack import lapack_in_turn
from .._programs import compiled
from .sampling import Averaged, Samples


# Powers of two that scale numbers have exponents at least this much below the largest of
# the dtype, so that sums of 2^24 scaled numbers stay in range.
_SPARE_EXPONENTS = 24
# The name of the axis of devices.
_DEVICE_AXIS = "samples"


class BatchMoments(NamedTuple):
    """Statistics of the samples of a batch. Arrays in an `Averaged` have axes for devices,
    combinations of levels, and numbers of `phi`.

    - `num_good`: the number of good samples.
    - `num_failed`: the number of failed paths. A path that fails on several levels counts
        once.
    - `failed_on`: the number of paths that failed on each level.
    - `any_failed`: whether any path failed, with those that are not counted.
    - `mean`: the mean of the good samples.
    - `mean_correction`: the correction of the rounding of `mean`, to be added in float64.
    - `norm`: the root of the sum of squared deviations from the corrected mean.
    - `largest`: the largest absolute deviation from `mean`.
    - `size`: the largest absolute value.
    """

    num_good: Int[Array, "*devices"]
    num_failed: Int[Array, "*devices"]
    failed_on: Int[Array, "*devices levels"]
    any_failed: Bool[Array, "*devices"]
    mean: Averaged
    mean_correction: Averaged
    norm: Averaged
    largest: Averaged
    size: Averaged


def _moments_on_devices(
    sampler: Callable[..., Samples],
    key_data: UInt32[Array, "..."],
    key_impl: Any,
    low_high: UInt32[Array, "2"],
    num_wanted: Int[Array, ""],
    mesh: Mesh,
    samples_per_device: int,
) -> BatchMoments:
    """The moments of a batch on all devices, along a leading axis. Each device takes
    `samples_per_device` samples, each with a key that is made of the number of the sample.

    - `sampler`: maps keys to samples.
    - `key_data`, `key_impl`: the data and the implementation of the user's key.
    - `low_high`: the low and the high 32 bits of the number of the batch's first sample.
        (JAX may have no 64-bit integers.)
    - `num_wanted`: only so many samples count, the first of all devices together. (All
        batches have the same size, since another size would compile anew. The last one may
        have more samples than are wanted.)"""

    def moments_on_device(sampler, low_high, num_wanted, device):
        # The indices of this device's samples within the batch.
        index = device * samples_per_device + jnp.arange(samples_per_device)
        # The sum of the number of the first sample and the index, by halves of 32 bits.
        low = low_high[0] + index.astype(jnp.uint32)
        # The lower half has wrapped around if it is less than one of its terms.
        has_carry = low < low_high[0]
        high = low_high[1] + has_carry.astype(jnp.uint32)
        key = jr.wrap_key_data(jnp.asarray(key_data), impl=key_impl)
        keys = jax.vmap(ft.partial(sample_key, key))(high, low)
        return _moments_of(lapack_in_turn(sampler)(keys), index < num_wanted)

    if mesh.size == 1:
        moments = moments_on_device(sampler, low_high, num_wanted, device=0)
        return jtu.tree_map(lambda x: x[None], moments)

    # Several devices run the same program, each on its own samples. `shard_map` takes
    # arrays alone, so the rest of the sampler is captured.
    dynamic, static = eqx.partition(sampler, eqx.is_array)

    # Devices do not communicate until the end, so the moments on each do not depend on the
    # number of devices.
    def gathered_moments(dynamic, low_high, num_wanted):
        sampler = eqx.combine(dynamic, static)
        device = jax.lax.axis_index(_DEVICE_AXIS)
        moments = moments_on_device(sampler, low_high, num_wanted, device)
        return jtu.tree_map(lambda x: jax.lax.all_gather(x, _DEVICE_AXIS), moments)

    # Every device gets all arguments, and returns the moments of all devices.
    whole = PartitionSpec()
    on_all_devices = jax.shard_map(
        gathered_moments, mesh=mesh, in_specs=whole, out_specs=whole, check_vma=False
    )
    try:
        return on_all_devices(dynamic, low_high, num_wanted)
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


batch_moments = compiled(_moments_on_devices)
# The same for samples that take less time than compiling their program.
quick_batch_moments = compiled(_moments_on_devices, quickly=True)


def _moments_of(samples: Samples, is_wanted: Bool[Array, " n"]) -> BatchMoments:
    """The moments of the samples of one device, as far as they are wanted."""
    good = samples.good & is_wanted
    # (levels, samples)
    failures = jnp.where(is_wanted, samples.num_failed, 0)
    # A path that fails on several levels counts once.
    num_failed = jnp.sum(jnp.max(failures, axis=0))
    any_failed = num_failed > 0
    if samples.also_failed is not None:
        any_failed |= jnp.any(samples.also_failed & is_wanted)
    fields = samples.averaged.fields
    # The fields of `samples.averaged` are one array, since fewer operations compile sooner.
    # Each statistic of this array is taken apart again into these fields.
    statistics = _statistics(jnp.stack([*fields.values()]), good)
    averaged = [Averaged(**dict(zip(fields, x))) for x in statistics]
    failed_on = jnp.sum(failures, axis=1)
    return BatchMoments(jnp.sum(good), num_failed, failed_on, any_failed, *averaged)


def _statistics(
    x: Float[Array, "fields combinations n numbers"], good: Bool[Array, " n"]
) -> tuple[Float[Array, "fields combinations numbers"], ...]:
    """The `mean`, `mean_correction`, `norm`, `largest` and `size` of `BatchMoments`, over
    those of `n` samples that are good.

    There are two passes over the samples: one for the mean, and one for the deviations from
    it, as a difference of squares would cancel. The correction `c` is the mean of the
    deviations `d`, which without rounding would be zero. About the corrected mean the sum
    of squares is `sum(d**2) - n c**2`. Sums are taken of numbers that are scaled to a size
    of about one."""
    is_used = good[:, None]
    # Without samples, sums are zero, and so are means with this divisor.
    divisor = jnp.maximum(jnp.sum(good), 1)
    x = jnp.where(is_used, x, 0)
    size = jnp.max(jnp.abs(x), axis=2)
    to_unit, to_size = _scales(size)
    mean = to_size * (jnp.sum(x * to_unit[:, :, None], axis=2) / divisor)

    deviations = jnp.where(is_used, x - mean[:, :, None], 0)
    largest = jnp.max(jnp.abs(deviations), axis=2)
    deviations_to_unit, to_deviations = _scales(largest)
    scaled = deviations * deviations_to_unit[:, :, None]
    scaled_correction = jnp.sum(scaled, axis=2) / divisor
    scaled_squares = jnp.sum(scaled**2, axis=2) - divisor * scaled_correction**2
    mean_correction = to_deviations * scaled_correction
    norm = to_deviations * jnp.sqrt(jnp.maximum(scaled_squares, 0))
    return mean, mean_correction, norm, largest, size


def _scales(size: Array) -> tuple[Array, Array]:
    """A power of two by which numbers of this size become about one, so that sums of them
    and of their squares stay in range; and the inverse of this power, to scale back. (XLA
    would divide by the power as a product with its inverse, which may underflow.)"""
    largest_exponent = jnp.finfo(size.dtype).maxexp - _SPARE_EXPONENTS
    _, exponent = jnp.frexp(size)
    exponent = jnp.clip(exponent, -largest_exponent, largest_exponent)
    one = jnp.ones_like(size)
    return jnp.ldexp(one, -exponent), jnp.ldexp(one, exponent)
