"""Estimates of expectations, and how they are made: any number of samples, one batch after
another, on any devices."""

import collections
import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .._brownian import check_key


# Where a larger share of the paths fails, a warning says so.
_MANY = 0.01
NO_METER = diffrax.NoProgressMeter()
# NumPy returns scalars, which are not arrays, from operations on arrays without axes.
_Host = PyTree[np.ndarray | np.floating]


class Samples(eqx.Module):
    """What is averaged, with axes in front for levels and samples: values on each level,
    and which combinations of the levels to take; which of them are good; and how many
    paths each has lost."""

    values: PyTree[Array]
    weights: Float[Array | np.ndarray, "combinations levels"]
    good: Bool[Array, "levels n"]
    lost: Int[Array, "levels n"] | None = None


class Plan(NamedTuple):
    """How samples are taken.

    - `sampler`: a PyTree that makes one sample for each of several random keys.
    - `num_samples`: how many at most, those of an estimate to go on from included.
    - `batch_size`: how many each device takes at once.
    - `paths`: how many paths a sample has, on each level.
    - `least`: fewer samples than this do not tell their spread well enough to stop.
    - `reason`: what the result says of how they were chosen.
    """

    sampler: Callable[[PRNGKeyArray], Samples]
    num_samples: int
    batch_size: int
    paths: int = 1
    least: int = 2
    reason: str = ""


class Expectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as [`diffrax_symplectic.expectation`][] and
    [`diffrax_symplectic.monte_carlo`][] return. To print it gives a few lines.

    - `num_paths`: how many paths the estimate is made of, on each level.
    - `num_failed`: how many paths failed, on all levels. They have no part in the rest.
    - `num_samples`: how many independent samples the mean is taken over: paths, or
        replicates of [`diffrax_symplectic.ArrayRQMC`][].
    - `sampling`: how the samples were made.
    - `reason`: why this one was chosen, if there was a choice; otherwise empty.
    - `tol_reached`: whether all standard errors are at most `tol`; `None` without `tol`.
    - `combinations`, `sums_of_squares`, `largest`: means over the samples, sums of squared
        deviations from them, and the largest deviation within a batch, along an axis in
        front: of the estimate, and with two levels or more of its `bias` and of what the
        last extrapolation changed.
    - `key_data`: the random key that the samples came from.
    """

    num_paths: int
    num_failed: int
    num_samples: int
    combinations: _Host
    sums_of_squares: _Host
    largest: _Host
    key_data: np.ndarray
    sampling: Any = None
    reason: str = ""
    tol_reached: bool | None = None

    @property
    def mean(self) -> _Host:
        r"""The best estimate, in the structure of $\phi$ and in float64: the mean over the
        samples, extrapolated to steps of size zero if there are two levels or more. With
        `ts` there is an axis in front, one place for each of them. NaN without samples."""
        return self._mean(0)

    @property
    def std_error(self) -> _Host:
        """The standard error of `mean`, from the spread of the samples."""
        return self._std_error(0)

    @property
    def variance(self) -> _Host:
        """The variance of a sample."""
        return jtu.tree_map(lambda s: self.num_samples * s**2, self.std_error)

    @property
    def bias(self) -> _Host | None:
        r"""With two levels or more the error of discretization of the finest one,
        $\mathbb E[\phi_h] - \mathbb E[\phi]$, as extrapolation knows it; otherwise `None`.
        `mean + bias` is the mean of that level. It is no part of `mean`."""
        return self._mean(1)

    @property
    def bias_std_error(self) -> _Host | None:
        """The standard error of `bias`."""
        return self._std_error(1)

    @property
    def error(self) -> _Host:
        """The error of `mean` all together: the root of the sum of the squares of
        `std_error` and, with two levels or more, of what the last extrapolation has
        changed. What discretization leaves after that is of a higher order in the step
        size, and smaller as a rule. With one level nothing is known of it, and this is
        `std_error`."""
        change = self._mean(2)
        if change is None:
            return self.std_error
        return jtu.tree_map(np.hypot, self.std_error, change)

    def interval(self, confidence: float = 0.95) -> tuple[_Host, _Host]:
        r"""The ends of an interval that covers the mean of infinitely many samples with
        this probability: Student's $t$ with one degree of freedom less than there are
        samples, times `std_error`, to either side of `mean`. (For 16 samples and 95% that
        is 2.13 standard errors, for very many 1.96.) What is left of the error of
        discretization is not part of it: see `error`."""
        # Half of the time to import this package, if it stood at the top.
        from scipy.special import stdtrit

        factor = stdtrit(max(self.num_samples - 1, 1), (1 + confidence) / 2)
        side = lambda sign: jtu.tree_map(
            lambda m, s: m + sign * factor * s, self.mean, self.std_error
        )
        return side(-1), side(1)

    def __str__(self) -> str:

        def shown(mean, error) -> str:
            """With two digits more than the least of the errors has."""
            least = np.clip(np.min(np.nan_to_num(error), initial=1), 1e-10, 1)
            digits = 2 - math.floor(math.log10(least))
            mode = "fixed" if digits < 12 else "maxprec"
            mean = np.asarray(mean)
            return np.array2string(mean, precision=digits, threshold=6, floatmode=mode)

        short: Any = {"float_kind": "{:.1e}".format}
        brief = lambda x: np.array2string(np.asarray(x), formatter=short, threshold=6)
        mean, error = jtu.tree_leaves(self.mean), jtu.tree_leaves(self.std_error)
        leaves = lambda x: [brief(y) for y in jtu.tree_leaves(x)[:6]]
        lines = [f"{shown(m, e)} ± {brief(e)}" for m, e in zip(mean[:6], error)]
        if self.bias is not None:
            whole = zip(lines, leaves(self.error))
            lines = [f"{x} (sampling), {e} (total)" for x, e in whole]
        lines += ["..."] * (len(mean) > 6)
        if self.bias is not None:
            pairs = zip(leaves(self.bias), leaves(self.bias_std_error))
            biases = ", ".join(f"{bias} ± {error}" for bias, error in pairs)
            lines.append(f"bias of the finest step, taken out: {biases}")
        elif self.sampling is not None:
            lines.append("not included: the error of discretization (see `levels`)")
        how = "" if self.sampling is None else f", {self.sampling}"
        lines.append(f"{self.num_paths:,} paths, {self.num_failed:,} failed{how}")
        lines += [self.reason] if self.reason else []
        lines += ["`tol` was not reached"] if self.tol_reached is False else []
        return "\n".join(lines)

    __repr__ = __str__

    def _mean(self, combination: int) -> Any:
        leaves = jtu.tree_leaves(self.combinations)
        if leaves and len(leaves[0]) <= combination:
            return None
        known = 1.0 if self.num_samples > 0 else np.nan
        return jtu.tree_map(lambda x: known * x[combination], self.combinations)

    def _std_error(self, combination: int) -> Any:
        n = self.num_samples
        share = 1 / (n * (n - 1)) if n > 1 else np.nan
        if self._mean(combination) is None:
            return None
        error = lambda squares: np.sqrt(share * squares[combination])
        return jtu.tree_map(error, self.sums_of_squares)


class ExpectationInterrupted(KeyboardInterrupt):
    """Raised by [`diffrax_symplectic.expectation`][] and
    [`diffrax_symplectic.monte_carlo`][] in place of a `KeyboardInterrupt`. Its attribute
    `estimate` holds what was done until then, to go on from with `start=`."""

    def __init__(self, estimate: Expectation):
        super().__init__(
            f"Interrupted after {estimate.num_paths + estimate.num_failed} paths. Catch "
            "`ExpectationInterrupted` and pass its `estimate` as `start` to go on."
        )
        self.estimate = estimate


def checked_call(
    user: str, key, tol, start, devices: Sequence[Any] | None, *others: Any
) -> tuple[PRNGKeyArray, tuple]:
    """The key and the devices that a user means. Raises a `ValueError` for what none of
    these arguments can be, and if an array of the call is traced."""
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves((key, others))):
        raise ValueError(
            f"`{user}` takes as many batches as numbers tell, so it is no part of a JAX "
            "program. Call it outside of `jit`, `vmap` and `grad`. The gradient of a mean "
            "is the mean of gradients: `monte_carlo` averages them."
        )
    check_key(key, user)
    is_number = isinstance(tol, int | float | np.number)
    if tol is not None and not (is_number and 0 < tol < np.inf):
        raise ValueError(f"`tol` must be a positive number, or `None`; got {tol!r}.")
    if start is not None and not isinstance(start, Expectation):
        raise ValueError(
            f"`start` must be what `{user}` returned, or `None`; got {start!r}."
        )
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    devices = jax.devices() if devices is None else devices
    is_device = lambda x: isinstance(x, jax.Device)
    if not isinstance(devices, Sequence) or not all(map(is_device, devices)):
        raise ValueError(
            "`devices` must be a list of devices, such as `jax.devices()[:1]`, or `None`; "
            f"got {devices!r}."
        )
    devices = tuple(devices)
    return key if typed else jr.wrap_key_data(key), devices


class Meter:
    """A progress meter that is shown from here on until it is left."""

    def __init__(self, meter: diffrax.AbstractProgressMeter):
        self._meter, self._state = meter, meter.init()

    def step(self, progress: float) -> None:
        self._state = self._meter.step(self._state, np.asarray(progress))

    def __enter__(self) -> "Meter":
        return self

    def __exit__(self, *error) -> None:
        self._meter.close(self._state)


def run(
    plan: Plan,
    key: PRNGKeyArray,
    devices: tuple,
    sampling: Any = None,
    start: Expectation | None = None,
    tol: float | None = None,
    meter: Meter | None = None,
) -> Expectation:
    """The estimate from the samples of a plan. Without a meter it is a trial, which warns
    of nothing. What a device computes, and in which order its sums are added up, does not
    depend on how many there are."""
    sampler, most = plan.sampler, plan.num_samples
    key_data, size = np.asarray(jr.key_data(key)), min(plan.batch_size, most)
    if jax.process_count() > 1:
        # Each process holds the same arrays. In a function they become constants of its
        # program, since arguments would have to be placed on the devices of all.
        sampler = lambda keys: plan.sampler(keys)
    mesh = Mesh(np.array(devices), ("samples",))

    def batch(begin: int) -> tuple:
        lo_hi = np.array([begin & 0xFFFFFFFF, begin >> 32], np.uint32)
        left = np.array(max(0, min(size * len(devices), most - begin)), np.int32)
        if len(devices) == 1:
            lo_hi, left = jax.device_put((lo_hi, left), devices[0])
        one: Any = _batch
        return one(sampler, key_data, jr.key_impl(key), lo_hi, left, mesh, size)

    # Of independent paths each that failed was a sample.
    used = lambda e: e.num_samples + (e.num_failed if plan.paths == 1 else 0)
    first = 0 if start is None else used(start)
    # JAX caches this trace and uses it for the first batch.
    shapes = eqx.filter_eval_shape(batch, first)[2]
    zeros = jtu.tree_map(lambda s: np.zeros(s.shape[1:]), shapes)
    if start is None:
        estimate = Expectation(0, 0, 0, zeros, zeros, zeros, key_data)
    else:
        estimate = _checked_start(start, zeros, key_data, first, most)
    about = dict(sampling=sampling, reason=plan.reason)
    estimate = dataclasses.replace(estimate, **about)

    def reached() -> bool:
        if tol is None or estimate.num_samples < plan.least:
            return False
        return all(bool(np.all(x <= tol)) for x in jtu.tree_leaves(estimate.std_error))

    def finished() -> Expectation:
        said = None if tol is None else reached()
        return dataclasses.replace(estimate, tol_reached=said)

    running = collections.deque()
    try:
        while True:
            more = first < most and not reached()
            if more:
                running.append(batch(first))
                first += size * len(devices)
            # One batch is computed while the one before it is added up.
            if len(running) > more:
                done = jax.device_get(running.popleft())
                for one in range(len(devices)):
                    # The same samples decide, however many are made at once.
                    if not reached():
                        part = jtu.tree_map(lambda x: x[one], done)
                        estimate = _merged(estimate, part, plan.paths)
                if meter is not None:
                    meter.step(used(estimate) / most)
            elif not more:
                break
    except KeyboardInterrupt:
        raise ExpectationInterrupted(finished()) from None
    estimate = finished()
    if meter is not None:
        _warn_of(estimate, tol)
    return estimate


def _warn_of(estimate: Expectation, tol: float | None) -> None:
    done, lost = estimate.num_paths, estimate.num_failed
    if lost > _MANY * (done + lost):
        rest = f"the mean is that of the other {done:,}, and biased"
        rest = rest if done else "there is no mean"
        warnings.warn(
            f"{lost:,} paths failed: {rest}. Take smaller steps or bounded "
            "increments, such as those of a `WeakBrownianPath`; and look for NaNs in `y0`, "
            "`args` and the Hamiltonians.",
            stacklevel=4,
        )
    results = jtu.tree_leaves((estimate.mean, estimate.std_error))
    if estimate.num_samples > 1 and not all(np.all(np.isfinite(x)) for x in results):
        warnings.warn(
            "The mean or its standard error is not finite: values that are averaged are "
            "so large that their squares overflow. Take smaller steps, or a solver that is "
            "stable with these; see whether single solutions stay bounded.",
            stacklevel=4,
        )
    if estimate.tol_reached is False:
        errors = jtu.tree_leaves(estimate.std_error)
        largest = max(float(np.max(x, initial=0.0)) for x in errors)
        warnings.warn(
            f"`tol={tol}` was not reached: the largest standard error is {largest:.1e} "
            f"after {estimate.num_paths:,} paths. Take more paths, going on with `start=`, "
            "or another `sampling`.",
            stacklevel=4,
        )


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
        # A path fails once, on however many levels.
        good = jnp.all(samples.good, axis=0)
        lost = ~good + (0 if samples.lost is None else jnp.sum(samples.lost, axis=0))
        failed, good = jnp.sum(jnp.where(wanted, lost, 0)), good & wanted
        count = jnp.sum(good)

        def moments(x):
            x = x.astype(real(x.dtype))
            if jnp.iscomplexobj(x):
                raise ValueError(
                    "What is averaged must be real arrays; got one of dtype "
                    f"{x.dtype}. Return real and imaginary parts."
                )
            x = jnp.tensordot(samples.weights.astype(x.dtype), x, 1)
            keep = good.reshape(-1, *[1] * (x.ndim - 2))
            total = lambda x: jnp.sum(jnp.where(keep, x, 0), axis=1)
            n = jnp.maximum(count, 1)
            mean = total(x) / n
            # In two passes, so that no two large numbers are subtracted. The second one
            # finds by how much the first was rounded, too.
            off = jnp.where(keep, x - mean[:, None], 0)
            rest = total(off) / n
            squares = jnp.maximum(total(off**2) - n * rest**2, 0)
            return mean, rest, squares, jnp.max(jnp.abs(off), axis=1)

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

    none = PartitionSpec()
    sharded = jax.shard_map(
        shard, mesh=mesh, in_specs=none, out_specs=none, check_vma=False
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


def _checked_start(start: Expectation, zeros, key_data, used: int, most: int):
    """The estimate to go on from, which has used up so many samples."""
    if not np.array_equal(start.key_data, key_data):
        raise ValueError(
            "`start` is an estimate with another `key`. Pass the one that it came from, "
            "so that no path is taken twice."
        )
    shapes = lambda tree: jtu.tree_map(np.shape, tree)
    if not eqx.tree_equal(shapes(start.combinations), shapes(zeros)):
        raise ValueError(
            "`start` is an estimate of something of another structure or other shapes. "
            "Pass one that came from the same function, times and levels."
        )
    if used > most:
        raise ValueError(
            "The number of paths (or of replicates) counts all, those of `start` included, "
            f"of which there are {used} already; got {most}."
        )
    return start


@np.errstate(over="ignore", invalid="ignore")
def _merged(estimate: Expectation, batch, paths: int) -> Expectation:
    """The estimate from its own samples, of so many paths each, and those of the batch, by
    the pairwise formula of Chan, Golub and LeVeque."""
    count, failed, mean, rest, squares, largest = batch
    a, b = estimate.num_samples, int(count)
    n, trees = max(a + b, 1), jtu.tree_map
    mean = trees(lambda x, y: x.astype(float) + y, mean, rest)
    delta = trees(lambda x, y: y - x, estimate.combinations, mean)
    both = lambda x, y, d: x + y.astype(float) + d**2 * (a * b / n)
    return dataclasses.replace(
        estimate,
        combinations=trees(lambda x, d: x + d * (b / n), estimate.combinations, delta),
        sums_of_squares=trees(both, estimate.sums_of_squares, squares, delta),
        largest=trees(np.maximum, estimate.largest, largest),
        num_samples=a + b,
        num_paths=estimate.num_paths + b * paths,
        num_failed=estimate.num_failed + int(failed),
    )


def real(dtype) -> Any:
    return jnp.result_type(dtype, float)
