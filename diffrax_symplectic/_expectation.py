"""Expectations over very many paths, a batch at a time."""

import collections
import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, PRNGKeyArray, PyTree

from ._brownian import check_key


_Sample: TypeAlias = Callable[[PRNGKeyArray], Any]
# Scalars of NumPy are no arrays.
_Host = PyTree[np.ndarray | np.floating]


_no_meter = diffrax.NoProgressMeter()


class Expectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as [`diffrax_symplectic.expectation`][] returns.

    - `mean`: the mean over the paths that succeeded, in the structure of $\phi$, in
        float64; NaN if none did.
    - `sum_of_squares`: the sum of the squared deviations from `mean`.
    - `num_paths`: how many paths succeeded.
    - `num_failed`: how many paths failed. They have no part in the rest.
    - `key_data`: the random key that the paths came from.
    """

    mean: _Host
    sum_of_squares: _Host
    num_paths: int
    num_failed: int
    key_data: np.ndarray

    @property
    def variance(self) -> _Host:
        r"""The variance of $\phi$ over the paths."""
        n = self.num_paths - 1
        share = lambda m2: m2 / n if n > 0 else np.full_like(m2, np.nan)
        return jtu.tree_map(share, self.sum_of_squares)

    @property
    def std_error(self) -> _Host:
        """The standard error of `mean`."""
        n = max(self.num_paths, 1)
        return jtu.tree_map(lambda v: np.sqrt(v / n), self.variance)


class ExpectationInterrupted(KeyboardInterrupt):
    """Raised by [`diffrax_symplectic.expectation`][] in place of a `KeyboardInterrupt`.
    Its attribute `estimate` holds what was done until then, to go on from with
    `start=`."""

    def __init__(self, estimate: Expectation):
        super().__init__(
            f"Interrupted after {estimate.num_paths + estimate.num_failed} paths. Catch "
            "`ExpectationInterrupted` and pass its `estimate` as `start` to go on."
        )
        self.estimate = estimate


def expectation(
    fn: _Sample,
    key: PRNGKeyArray,
    num_paths: int,
    *,
    batch_size: int | None = None,
    devices: Sequence[Any] | None = None,
    start: Expectation | None = None,
    progress_meter: diffrax.AbstractProgressMeter = _no_meter,
) -> Expectation:
    r"""Estimates $\mathbb E[\phi]$ and its standard error over any number of paths.

    The paths are taken in batches, so that memory does not grow with their number. Path
    number $i$ gets the key
    `fold_in(fold_in(key, i >> 32), i & 0xFFFFFFFF)`, whatever the batch size and the
    devices are. Means and deviations are accumulated by the pairwise formula of Chan,
    Golub and LeVeque, between batches in float64.

    !!! example

        ```python
        import diffrax
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H = lambda t, p, q, args: (p**2 + q**2) / 2
        y0 = (jnp.array(0.0), jnp.array(1.0))

        def phi(key):
            terms = ds.hamiltonian_terms(H, H, ds.WeakBrownianPath((), key))
            sol = diffrax.diffeqsolve(
                terms, ds.SRKw1(), t0=0, t1=1, dt0=0.1, y0=y0, throw=False
            )
            p, q = sol.ys
            return q[-1] ** 2, sol.result

        estimate = ds.expectation(phi, jr.key(0), 10_000)
        print(estimate.mean, estimate.std_error, estimate.num_failed)
        ```

    `fn` is compiled anew for each new function. For many values of a parameter pass one
    function and the parameter as an array, `jax.tree_util.Partial(fn, parameter)`.
    Gradients are taken within: the mean of `jax.grad` of a path is the gradient of the
    expectation (on one device: `devices=jax.devices()[:1]`). This function itself is no
    part of a JAX program: it cannot be differentiated, `jit`ted or `vmap`ped.

    **Arguments:**

    - `fn`: takes a random key to $\phi$, a PyTree of real arrays, or to a pair of that
        and a `diffrax.RESULTS`: as above, with `throw=False`. A path fails if its result
        is neither successful nor an event, or anything in its $\phi$ is not finite.
        (Without `sol.result` a path that failed counts as a success: Diffrax returns where
        it stopped.)
    - `key`: a JAX random key.
    - `num_paths`: how many paths there shall be in all, those of `start` included.
    - `batch_size`: how many paths each device takes at once. By default 32,768 on CPUs
        (for a state of a few numbers, enough for all cores and little for their caches)
        and 262,144 elsewhere. Take less for large states.
    - `devices`: the devices that share each batch, by default all of `jax.devices()`:
        under `jax.distributed` those of every process, each of which has to make the same
        call and gets the same result.
    - `start`: an earlier estimate with the same `fn` (which is not checked) and `key`, to
        be continued.
    - `progress_meter`: one of Diffrax's.

    **Returns:** an [`diffrax_symplectic.Expectation`][].

    **Raises:** a `ValueError` for sizes that are not positive integers, if `key` is not a
    random key, if `start` came from another key, has other shapes or more paths, or if
    $\phi$ is not real or holds a `diffrax.RESULTS`;
    [`diffrax_symplectic.ExpectationInterrupted`][], with the estimate so far, on an
    interrupt from the keyboard.

    **Source:** [Chan, Golub and LeVeque
    (1983)](https://doi.org/10.1080/00031305.1983.10483115) for the formula by which means
    and variances of batches are combined.
    """
    devices = tuple(jax.devices() if devices is None else devices)
    on_cpu = devices[0].platform == "cpu"
    if batch_size is None:
        batch_size = 32768 if on_cpu else 262144
    num_paths = _positive("num_paths", num_paths)
    batch_size = _positive("batch_size", batch_size)
    check_key(key, "expectation")
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jr.wrap_key_data(key)
    key_data, impl = np.asarray(jr.key_data(key)), jr.key_impl(key)
    first = 0 if start is None else start.num_paths + start.num_failed
    # No more lanes than paths.
    batch_size = min(batch_size, max(1, -(-(num_paths - first) // len(devices))))
    mesh = Mesh(np.array(devices), ("paths",))
    step = batch_size * len(devices)

    def batch(begin: int):
        lo_hi = np.array([begin & 0xFFFFFFFF, begin >> 32], np.uint32)
        size = np.array(min(step, num_paths - begin), np.int32)
        if len(devices) == 1:
            lo_hi, size = jax.device_put((lo_hi, size), devices[0])
        return _batch(fn, key_data, lo_hi, size, impl, mesh, batch_size)

    # JAX keeps what it traced here for the first batch.
    shapes = eqx.filter_eval_shape(batch, min(first, num_paths - 1))
    estimate = _start(shapes[2], key_data, start, num_paths)
    running = collections.deque()
    meter = progress_meter.init()
    try:
        for begin in range(first, num_paths, step):
            # One computes while the one before is added up.
            running.append(batch(begin))
            if len(running) == 2:
                estimate = _merge(estimate, running.popleft())
                done = estimate.num_paths + estimate.num_failed
                meter = progress_meter.step(meter, np.asarray(done / num_paths))
        while running:
            estimate = _merge(estimate, running.popleft())
    except KeyboardInterrupt:
        raise ExpectationInterrupted(_finished(estimate)) from None
    finally:
        progress_meter.close(meter)
    return _finished(estimate)


def _positive(name: str, value) -> int:
    integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not integer or value < 1:
        raise ValueError(f"`{name}` must be a positive integer; got {value!r}.")
    return int(value)


def _finished(estimate: Expectation) -> Expectation:
    """Without any path there is no mean."""
    if estimate.num_paths > 0:
        return estimate
    nothing = jtu.tree_map(lambda x: np.full_like(x, np.nan), estimate.mean)
    return dataclasses.replace(estimate, mean=nothing)


def _start(
    mean: PyTree[jax.ShapeDtypeStruct],
    key_data: np.ndarray,
    start: Expectation | None,
    num_paths: int,
) -> Expectation:
    """The estimate without any path, or the one to go on from."""
    for leaf in jtu.tree_leaves(mean):
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            raise ValueError(
                "`fn` must return real arrays; got one of dtype "
                f"{leaf.dtype}. Return real and imaginary parts."
            )
    zeros = jtu.tree_map(lambda s: np.zeros(s.shape), mean)
    if start is None:
        return Expectation(zeros, zeros, 0, 0, key_data)
    if not np.array_equal(start.key_data, key_data):
        raise ValueError(
            "`start` is an estimate with another `key`. Pass the one that it came from, "
            "so that no path is taken twice."
        )
    if jtu.tree_structure(start.mean) != jtu.tree_structure(zeros) or any(
        np.shape(a) != b.shape
        for a, b in zip(jtu.tree_leaves(start.mean), jtu.tree_leaves(zeros))
    ):
        raise ValueError(
            "`start` is an estimate of something of another structure or other shapes. "
            "Pass one that came from the same `fn`."
        )
    if start.num_paths + start.num_failed > num_paths:
        raise ValueError(
            "`num_paths` counts all paths, those of `start` included, of which there are "
            f"{start.num_paths + start.num_failed} already; got {num_paths}."
        )
    return start if start.num_paths > 0 else dataclasses.replace(start, mean=zeros)


def _evaluate(fn: _Sample, key) -> tuple[PyTree[Array], Array]:
    """What `fn` returns, and whether the path succeeded."""
    out = fn(key)
    success = jnp.array(True)
    if isinstance(out, tuple) and len(out) == 2 and _is_result(out[1]):
        out, result = out
        success = diffrax.is_okay(result)
    if any(map(_is_result, jtu.tree_leaves(out, is_leaf=_is_result))):
        raise ValueError(
            "`fn` returns a `diffrax.RESULTS` within phi, where it would be averaged. "
            "Return a pair `(phi, sol.result)`, so that paths that failed are left out."
        )
    out = jtu.tree_map(jnp.asarray, out)
    for leaf in jtu.tree_leaves(out):
        success = success & jnp.all(jnp.isfinite(leaf))
    return out, success


def _is_result(x) -> bool:
    return isinstance(x, type(diffrax.RESULTS.successful))


@eqx.filter_jit
def _batch(fn, key_data, lo_hi, size, impl, mesh: Mesh, n: int):
    """Number, mean and sum of squared deviations of the successful paths, and the number
    of the others, over one batch on all devices."""

    def local(lo_hi, size, device: Any = 0, total=lambda x: x):
        index = device * n + jnp.arange(n)
        lo = lo_hi[0] + index.astype(jnp.uint32)
        hi = lo_hi[1] + (lo < lo_hi[0]).astype(jnp.uint32)
        key = jr.wrap_key_data(jnp.asarray(key_data), impl=impl)
        fold = lambda hi, lo: jr.fold_in(jr.fold_in(key, hi), lo)
        phi, success = jax.vmap(lambda k: _evaluate(fn, k))(jax.vmap(fold)(hi, lo))
        good = success & (index < size)
        count = total(jnp.sum(good))
        failed = total(jnp.sum(~success & (index < size)))

        def moments(x):
            x = x.astype(jnp.result_type(x, float))
            keep = good.reshape(-1, *[1] * (x.ndim - 1))
            add = lambda x: total(jnp.sum(jnp.where(keep, x, 0), axis=0))
            mean = add(x) / jnp.maximum(count, 1)
            # In two passes: no difference of large numbers.
            return mean, add((x - mean) ** 2)

        leaves, treedef = jtu.tree_flatten(phi)
        means, squares = zip(*map(moments, leaves))
        return count, failed, treedef.unflatten(means), treedef.unflatten(squares)

    def shard(lo_hi, size):
        total = ft.partial(jax.lax.psum, axis_name="paths")
        return local(lo_hi, size, jax.lax.axis_index("paths"), total)

    if mesh.size == 1:
        # Diffrax's and Optimistix' reverse mode does not work under `shard_map`.
        return local(lo_hi, size)
    specs = PartitionSpec(), PartitionSpec()
    return jax.shard_map(
        shard, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(), check_vma=False
    )(lo_hi, size)


def _merge(estimate: Expectation, batch) -> Expectation:
    """The estimate from the paths of both."""
    count, failed, mean, squares = jax.device_get(batch)
    a, b = estimate.num_paths, int(count)
    n = max(a + b, 1)
    delta = jtu.tree_map(lambda x, y: y.astype(float) - x, estimate.mean, mean)
    return Expectation(
        mean=jtu.tree_map(lambda x, d: x + d * (b / n), estimate.mean, delta),
        sum_of_squares=jtu.tree_map(
            lambda x, y, d: x + y.astype(float) + d**2 * (a * b / n),
            estimate.sum_of_squares,
            squares,
            delta,
        ),
        num_paths=a + b,
        num_failed=estimate.num_failed + int(failed),
        key_data=estimate.key_data,
    )
