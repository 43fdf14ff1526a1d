"""Which sampling to take, by a short pilot."""

import dataclasses
import time
from typing import NamedTuple

import diffrax
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PRNGKeyArray

from ._batches import run
from ._sampling import (
    AbstractSampling,
    ArrayRQMC,
    IndependentPaths,
    Prepared,
    ValueFunctions,
)
from ._steps import Problem


# Paths of a trial of independent paths, which is one batch; of a replicate, and how many.
_PATHS, _REPLICATE, _REPLICATES = 2**13, 2**12, 8
# What promises to take less time than this is taken without further trials.
_SECONDS = 0.5
# A gain for which no other sampling is tried.
_CLEAR = 1e5
# The most samples that a tolerance may ask for.
_MOST = 10**9


class _Trial(NamedTuple):
    """A sampling that was tried: the variance of a sample, the largest if there are several
    numbers, and the seconds that it takes."""

    sampling: AbstractSampling
    prepared: Prepared
    variance: float
    seconds: float

    @property
    def work(self) -> float:
        """Seconds to a standard error of 1."""
        return self.variance * self.seconds


def chosen(
    problem: Problem, weights: np.ndarray, key: PRNGKeyArray, tol: float | None, devices
) -> tuple[AbstractSampling, Prepared, str]:
    """The sampling with the least product of variance and time, of those that can be used,
    sized for `tol`; and why."""

    def tried(sampling, samples: int) -> _Trial | None:
        try:
            prepared = sampling.prepare(problem, weights, key, devices)
        except ValueError:
            return None
        plan = dataclasses.replace(prepared.plan, num_samples=samples)
        own = jr.fold_in(key, 0xFFFFFFFF)
        sample = lambda: run(
            prepared.sampler, own, plan, devices, None, None, _no_meter
        )
        sample()  # compiles
        begin = time.perf_counter()
        e = sample()
        seconds = (time.perf_counter() - begin) / samples
        variances = [np.max(x, initial=0.0) for x in jtu.tree_leaves(e.variance)]
        variance = max(map(float, variances))
        return _Trial(
            sampling, prepared, variance if np.isfinite(variance) else np.inf, seconds
        )

    plain = tried(IndependentPaths(_PATHS, _PATHS), _PATHS)
    functions = rqmc = None
    assert plain is not None
    if tol is None or plain.work / tol**2 > _SECONDS:
        functions = ValueFunctions()
        functions = tried(functions, functions.batch_size)
        if functions is None or functions.work * _CLEAR > plain.work:
            rqmc = tried(ArrayRQMC(_REPLICATE, _REPLICATES), _REPLICATES)
    done = [trial for trial in (plain, functions, rqmc) if trial is not None]
    best = min(done, key=lambda trial: trial.work)
    listed = [f"{type(t.sampling).__name__} {t.work:.1e}" for t in done]
    reason = f"variance times seconds: {', '.join(listed)}"
    return *_sized(best, tol), reason


_no_meter = diffrax.NoProgressMeter()


def _sized(best: _Trial, tol: float | None) -> tuple[AbstractSampling, Prepared]:
    """With as many samples as the tolerance needs, and some more."""
    sampling, plan = best.sampling, best.prepared.plan
    if tol is None:
        count = {IndependentPaths: 2**17, ArrayRQMC: 64, ValueFunctions: 4096}
        samples = count[type(sampling)]
    else:
        samples = int(np.clip(1.5 * best.variance / tol**2, plan.batch_size, _MOST))
        samples = max(samples, 2 * plan.least)
    name = "replicates" if isinstance(sampling, ArrayRQMC) else "num_paths"
    sampling = dataclasses.replace(sampling, **{name: samples})
    plan = dataclasses.replace(plan, num_samples=samples)
    return sampling, best.prepared._replace(plan=plan)
