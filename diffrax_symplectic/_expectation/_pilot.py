"""Which sampling an expectation takes, if it was not told: a pilot tries some."""

import dataclasses
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PRNGKeyArray

from ._array_rqmc import ArrayRQMC
from ._estimate import Plan, run
from ._monte_carlo import IndependentPaths
from ._steps import AbstractSampling, Problem
from ._value_functions import paths_of_a_fit, ValueFunctions


# The keys made from this number belong to no sample.
NO_SAMPLE = 0xFFFFFFFF
# Paths of a batch of independent paths, of which a trial has two; of a replicate, and how
# many.
_PATHS, _REPLICATE, _REPLICATES = 2**12, 2**12, 8
# Of large systems a batch has fewer paths: as many as make so many numbers in all steps,
# some seconds at most.
_NUMBERS, _FEWEST_PATHS = 2**26, 2**8
# What promises to take less time than this is taken without further trials.
_SECONDS = 0.5
# Without a tolerance nobody has asked for more: about the seconds that the samples take. A
# trial may take half of what is left to gain.
_MOST_SECONDS = 10.0
# A gain for which no other sampling is tried.
_CLEAR = 1e5
# How many samples there are without a tolerance at most, and with one.
_SAMPLES = {IndependentPaths: 2**17, ArrayRQMC: 64, ValueFunctions: 4096}
_MOST = 10**9


class _Trial(NamedTuple):
    """A sampling, and of its samples the variance (of several numbers the largest) and the
    seconds that one takes."""

    sampling: AbstractSampling
    plan: Plan
    variance: float
    seconds: float

    @property
    def cost(self) -> float:
        """Seconds to a standard error of 1."""
        return self.variance * self.seconds


def choose(
    problem: Problem, key: PRNGKeyArray, tol: float | None, devices: tuple
) -> tuple[AbstractSampling, Plan]:
    """The sampling with the least product of variance and time, of those that can be used
    and whose trial does not take too long. It gets as many samples as the tolerance needs,
    and some more; without one as many as do not take too long."""
    numbers = sum(x.size for x in jtu.tree_leaves(problem.y0))
    steps = int(np.sum(problem.levels.num_steps))
    size = int(np.clip(_NUMBERS // (numbers * steps), _FEWEST_PATHS, _PATHS))
    functions, balanced = ValueFunctions(), ArrayRQMC(_REPLICATE, _REPLICATES)
    tried = lambda sampling, samples: _tried(sampling, samples, problem, key, devices)
    plain = tried(IndependentPaths(size, size), 2 * size)
    trials, without = [plain], []
    # With how many samples they are tried, and how many paths take as long, at least.
    for sampling, samples, paths in (
        (functions, 2 * functions.batch_size, lambda: paths_of_a_fit(problem)),
        (balanced, _REPLICATES, lambda: _REPLICATE * (_REPLICATES + 1)),
    ):
        try:
            why_not = _why_not(plain, min(trial.cost for trial in trials), tol, paths)
            if not why_not:
                trials.append(tried(sampling, samples))
        except ValueError as error:
            first_sentence = " ".join(str(error).split()).split(". ")[0]
            why_not = f"not possible: {first_sentence}"
        without += [f"{type(sampling).__name__} {why_not}"] if why_not else []
    best = min(trials, key=lambda trial: trial.cost)
    samples = _num_samples(best, tol)
    name = "replicates" if isinstance(best.sampling, ArrayRQMC) else "num_paths"
    sampling = dataclasses.replace(best.sampling, **{name: samples})
    listed = ", ".join(f"{type(x.sampling).__name__} {x.cost:.1e}" for x in trials)
    listed = f"chosen by the least variance times seconds: {listed}"
    reason = "; ".join([listed, *without])
    return sampling, best.plan._replace(num_samples=samples, reason=reason)


def _why_not(
    plain: _Trial, cost: float, tol: float | None, paths: Callable[[], int]
) -> str:
    """Why no other sampling is tried, whose trial takes at least as long as so many
    independent paths do. The best so far has this cost."""
    left = _MOST_SECONDS if tol is None else cost / tol**2
    if tol is not None and left <= _SECONDS:
        return f"not needed: `tol` takes less than {_SECONDS} s"
    if cost * _CLEAR < plain.cost:
        return "not tried: the gain is large already"
    least = plain.seconds * paths()
    return f"not tried: that takes {least:.2g} s or more" if least > left / 2 else ""


def _tried(
    sampling: AbstractSampling,
    samples: int,
    problem: Problem,
    key: PRNGKeyArray,
    devices: tuple,
) -> _Trial:
    """Raises a `ValueError` if the sampling cannot be used."""
    # What a sampling warns of is told by its error.
    with warnings.catch_warnings(action="ignore"):
        plan = sampling.prepare(problem, key, devices)
    own = jr.fold_in(key, NO_SAMPLE)
    more = lambda n, start: run(plan._replace(num_samples=n), own, devices, start=start)
    # The first batch, which may have to be compiled, is not timed.
    first = more(plan.batch_size, None)
    begin = time.perf_counter()
    tried = more(samples, first)
    seconds = _agreed(time.perf_counter() - begin) / (samples - plan.batch_size)
    variances = jtu.tree_leaves(tried.variance)
    variance = max(float(np.max(x, initial=0.0)) for x in variances)
    variance = variance if np.isfinite(variance) else np.inf
    return _Trial(sampling, plan, variance, seconds)


def _agreed(seconds: float) -> float:
    """Those of the first process: all have to choose the same."""
    if jax.process_count() == 1:
        return seconds
    from jax.experimental import multihost_utils

    return float(multihost_utils.broadcast_one_to_all(np.float32(seconds)))


def _num_samples(trial: _Trial, tol: float | None) -> int:
    plan = trial.plan
    if tol is not None:
        samples = int(np.clip(1.5 * trial.variance / tol**2, plan.batch_size, _MOST))
        return max(samples, 2 * plan.least)
    usual = _SAMPLES[type(trial.sampling)]
    samples = int(min(_MOST_SECONDS / trial.seconds, usual))
    # Whole batches: a part of one takes as long.
    if samples > plan.batch_size:
        samples -= samples % plan.batch_size
    return max(samples, plan.least)
