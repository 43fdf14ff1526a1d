"""Expectations over very many paths, one batch after another."""

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

from ._arguments import whole_number
from ._brownian import check_key
from ._compat import ClosedJaxpr, jaxpr_as_fun, solves_without_throwing
from ._estimate import (
    Expectation,
    ExpectationInterrupted,
    finished,
    initial,
    merge,
    reached,
)


_Sample: TypeAlias = Callable[..., Any]


_no_meter = diffrax.NoProgressMeter()


def expectation(
    fn: _Sample,
    key: PRNGKeyArray,
    num_paths: int | np.integer,
    *,
    batch_size: int | np.integer | None = None,
    devices: Sequence[Any] | None = None,
    start: Expectation | None = None,
    tol: float | None = None,
    levels: int = 1,
    order: int | None = None,
    num_coupled: int | None = None,
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
    expectation. On several devices the solve needs the adjoint `diffrax.DirectAdjoint()` or
    `diffrax_symplectic.ReversingAdjoint()`. This function itself is no part of a JAX
    program: it cannot be differentiated, `jit`ted or `vmap`ped.

    **Two levels.** With `levels=2` and `order=p` the function is `fn(key, level)`, which
    solves with the step $h$ on level 0 and with $h/2$ on level 1. `mean` is that of level
    0. The difference of the levels is estimated from paths that are solved on both, with
    the same key. Let them follow one Brownian motion, with `cell=` of
    [`diffrax_symplectic.FixedStepBrownianPath`][]: then it varies little, and few paths are
    enough. From it come `bias`, the part of the error of discretization that is of order
    $h^p$, and `bias_std_error`.

    !!! example

        ```python
        def phi(key, level):
            path = ds.FixedStepBrownianPath((), key, cell=0.05)
            terms = ds.hamiltonian_terms(H, H, ds.TruncatedBrownianPath(path))
            sol = diffrax.diffeqsolve(
                terms, ds.ImplicitMidpoint(), t0=0, t1=1, dt0=0.1 / 2**level, y0=y0,
                throw=False,
            )
            return sol.ys[1][-1] ** 2, sol.result

        estimate = ds.expectation(phi, jr.key(0), 10_000, levels=2, order=1)
        print(estimate.mean - estimate.bias, estimate.bias_std_error)
        ```

    **Arguments:**

    - `fn`: takes a random key to $\phi$, a PyTree of real arrays, or to a pair of that
        and a `diffrax.RESULTS`: as above, with `throw=False`. A path fails if its result
        is neither successful nor an event, or anything in its $\phi$ is not finite.
        (`throw=False` without `sol.result` is refused: Diffrax returns where a path that
        failed stopped, which would count as a success.)
    - `key`: a JAX random key.
    - `num_paths`: the number of all paths, those of `start` included.
    - `batch_size`: how many paths each device takes at once. By default 32,768 on CPUs
        (for a state of a few numbers, enough for all cores and little for their caches)
        and 262,144 elsewhere. Take less for large states.
    - `devices`: the devices that share each batch, by default all of `jax.devices()`:
        under `jax.distributed` those of every process, each of which has to make the same
        call and gets the same result.
    - `start`: an earlier estimate to continue. It has to come from the same `key` and the
        same `fn`; that of `fn` is not checked.
    - `tol`: if given, no further batch begins once the standard error of every entry of
        $\phi$ is at most `tol`. `num_paths` is then the most that are taken.
    - `levels`: 2 to estimate the error of discretization, too.
    - `order`: with two levels, the weak order $p$ of the solver for the terms, as
        `solver.weak_order(terms)` says.
    - `num_coupled`: with two levels, how many further paths are solved on both; by default
        a sixteenth of `num_paths`.
    - `progress_meter`: one of Diffrax's, for the paths of the first level.

    **Returns:** an [`diffrax_symplectic.Expectation`][].

    **Raises:** a `ValueError` for sizes that are not positive integers, if `key` is not a
    random key, if `start` came from another key, has other shapes or more paths, if `tol`
    is not positive, for `levels` other than 1 or 2, or 2 without `order`, if $\phi$ is
    not real or holds a `diffrax.RESULTS`, or if `fn` solves with `throw=False` and does
    not return `sol.result`;
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
    num_paths = whole_number("num_paths", num_paths)
    batch_size = whole_number("batch_size", batch_size)
    check_key(key, "expectation")
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jr.wrap_key_data(key)
    if tol is not None and not 0 < tol < np.inf:
        raise ValueError(f"`tol` must be a positive number, or `None`; got {tol!r}.")
    run = ft.partial(_run, batch_size=batch_size, devices=devices)
    if levels == 1:
        return run(fn, key, num_paths, start, tol, progress_meter)
    if levels != 2 or order is None:
        raise ValueError(
            "`levels` must be 1, or 2 with `order=`, the weak order of the solver; got "
            f"levels={levels!r} and order={order!r}."
        )
    order = whole_number("order", order)
    if num_coupled is not None:
        num_coupled = whole_number("num_coupled", num_coupled)
    estimate = run(_Level(fn, 0), key, num_paths, start, tol, progress_meter)
    estimate = dataclasses.replace(estimate, order=order)
    before = estimate.difference
    if num_coupled is None:
        made = 0 if before is None else before.num_paths + before.num_failed
        num_coupled = max(num_paths // 16, 2, made)
    # The keys made from this one belong to no path of the first level.
    key = jr.fold_in(key, 0xFFFFFFFF)
    try:
        difference = run(_Difference(fn), key, num_coupled, before, None, _no_meter)
    except KeyboardInterrupt as interrupt:
        # While the program of the second level is traced, there is no estimate by it yet.
        difference = getattr(interrupt, "estimate", before)
        estimate = dataclasses.replace(estimate, difference=difference)
        raise ExpectationInterrupted(estimate) from None
    return dataclasses.replace(estimate, difference=difference)


class _Level(eqx.Module):
    """A path on one level. For the same `fn` two of these are equal, so that JAX compiles
    them once."""

    fn: _Sample
    level: int = eqx.field(static=True)

    def __call__(self, key):
        return self.fn(key, self.level)


class _Difference(eqx.Module):
    """The finer level minus the coarser one, from the same key."""

    fn: _Sample

    def __call__(self, key):
        coarse, a = _evaluate(_Level(self.fn, 0), key)
        fine, b = _evaluate(_Level(self.fn, 1), key)
        wide = lambda x: x.astype(jnp.result_type(x, float))
        difference = jtu.tree_map(lambda x, y: wide(x) - wide(y), fine, coarse)
        nonfinite: diffrax.RESULTS = diffrax.RESULTS.nonfinite  # pyright: ignore
        good = diffrax.RESULTS.successful
        return difference, diffrax.RESULTS.where(a & b, good, nonfinite)


def _run(
    fn: _Sample,
    key: PRNGKeyArray,
    num_paths: int,
    start: Expectation | None,
    tol: float | None,
    progress_meter: diffrax.AbstractProgressMeter,
    *,
    batch_size: int,
    devices: tuple,
) -> Expectation:
    """The estimate of one level, a batch at a time."""
    key_data, impl = np.asarray(jr.key_data(key)), jr.key_impl(key)
    first = 0 if start is None else start.num_paths + start.num_failed
    # A batch need not be larger than the number of paths.
    batch_size = min(batch_size, max(1, -(-(num_paths - first) // len(devices))))
    mesh = Mesh(np.array(devices), ("paths",))
    step = batch_size * len(devices)

    def batch(begin: int):
        lo_hi = np.array([begin & 0xFFFFFFFF, begin >> 32], np.uint32)
        size = np.array(min(step, num_paths - begin), np.int32)
        if len(devices) == 1:
            lo_hi, size = jax.device_put((lo_hi, size), devices[0])
        return _batch(fn, key_data, lo_hi, size, impl, mesh, batch_size)

    # JAX caches this trace and uses it for the first batch.
    shapes = eqx.filter_eval_shape(batch, first)
    estimate = initial(shapes[2], key_data, start, num_paths)
    running = collections.deque()
    meter = progress_meter.init()
    try:
        while True:
            more = first < num_paths and not reached(estimate, tol)
            if more:
                running.append(batch(first))
                first += step
            # One batch is computed while the one before it is added up.
            if len(running) > more:
                estimate = merge(estimate, running.popleft())
                done = estimate.num_paths + estimate.num_failed
                meter = progress_meter.step(meter, np.asarray(done / num_paths))
            elif not more:
                break
    except KeyboardInterrupt:
        raise ExpectationInterrupted(finished(estimate, tol)) from None
    finally:
        progress_meter.close(meter)
    return finished(estimate, tol)


def _evaluate(fn: _Sample, key) -> tuple[PyTree[Array], Array]:
    """What `fn` returns, and whether the path succeeded."""
    program, shape = jax.make_jaxpr(fn, return_shape=True)(key)
    check_failures_are_reported(program, shape)
    leaves = jaxpr_as_fun(program)(key)
    out = jtu.tree_unflatten(jtu.tree_structure(shape), leaves)
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
    if len(jtu.tree_leaves(out)) == 0:
        raise ValueError(f"`fn` must return arrays, which are averaged; got {out!r}.")
    for leaf in jtu.tree_leaves(out):
        success = success & jnp.all(jnp.isfinite(leaf))
    return out, success


def check_failures_are_reported(program: ClosedJaxpr, out: PyTree) -> None:
    """Raises a `ValueError` if a function solves with `throw=False`, as its program says,
    but what it returns holds no `diffrax.RESULTS`."""
    reported = any(map(_is_result, jtu.tree_leaves(out, is_leaf=_is_result)))
    if not reported and solves_without_throwing(program.jaxpr):
        raise ValueError(
            "`fn` solves with `throw=False` but does not return `sol.result`, so that "
            "paths that failed would be averaged as if they had not. Return the pair "
            "`(phi, sol.result)`: then they are left out and counted. Or pass `throw=True` "
            "to `diffeqsolve`, which raises an error if a path fails. If `fn` sees to "
            "failures itself, return `(phi, diffrax.RESULTS.successful)`."
        )


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
            # In two passes, so that no two large numbers are subtracted.
            return mean, add((x - mean) ** 2)

        leaves, treedef = jtu.tree_flatten(phi)
        means, squares = zip(*map(moments, leaves))
        return count, failed, treedef.unflatten(means), treedef.unflatten(squares)

    def shard(lo_hi, size):
        total = ft.partial(jax.lax.psum, axis_name="paths")
        return local(lo_hi, size, jax.lax.axis_index("paths"), total)

    if mesh.size == 1:
        return local(lo_hi, size)
    specs = PartitionSpec(), PartitionSpec()
    sharded = jax.shard_map(
        shard, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(), check_vma=False
    )
    try:
        return sharded(lo_hi, size)
    except ValueError as error:
        # The loop of Diffrax's default adjoint takes arrays that vary from device to
        # device for others than those it was made for.
        if "Closure-converted function" not in str(error):
            raise
        raise ValueError(
            "Reverse mode through `diffrax.RecursiveCheckpointAdjoint`, the default of "
            "`diffeqsolve`, does not work on several devices. Pass `adjoint="
            "diffrax_symplectic.ReversingAdjoint()` or `adjoint=diffrax.DirectAdjoint()` "
            "to `diffeqsolve`, or `devices=jax.devices()[:1]` to `expectation`."
        ) from error
