"""A trial with one more level, where two levels cannot check themselves."""

import dataclasses
import functools as ft
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from .._custom_types import Devices
from .._simulation import (
    Combination,
    finer_change_weights,
    has_discrete_increments,
    is_multiple,
    Problem,
    with_next_level,
)
from .._solver import path_of_array_cell
from .._terms import (
    brownian_paths,
    has_unknown_law,
    motion_numbers,
    random_paths,
    with_paths,
)
from .choose import trial_key
from .estimate import combined_results, Expectation, label_of
from .fitted import ValueFunctions
from .independent import IndependentPaths
from .long_steps import unresolved_angle
from .run import run
from .sampling import SamplingPlan


# The numbers of paths of a trial on the same noise: more are taken only while their noise
# hides changes as large as the error.
_NUMBERS_OF_PATHS = 512, 2048, 8192
# The largest shares of the samples of an estimate that a trial takes: at first, and if more
# are needed. A path of a trial has 7 steps for 3 on the same noise, or 2 for 1, so it takes
# a small part of the time.
_FIRST_SHARE = 1 / 8
_LARGEST_SHARE = 1 / 32
# Fewer paths than this do not know their own spread, and more would take longer than the
# estimate.
_FEWEST_PATHS = 32
# A change is sure if it is this many standard errors from zero: by chance that happens once
# in 370 times for a single mean, and hardly more often for the largest of many.
_SURE_OF_ONE = 3
# A trial of which more paths fail than this part has no mean to compare.
_MOST_FAILED = 0.1


class Trial(NamedTuple):
    """What a trial with a finer level tells.

    - `message`: how it changes a mean by more than its error; `None` if it does not.
    - `caveat`: which changes the trial could not see, in words; empty if these are less
        than the error.
    """

    message: str | None = None
    caveat: str = ""


def trial_with_finer_level(
    estimate: Expectation,
    problem: Problem,
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: Devices,
) -> Trial:
    """Whether a finer level changes an estimate of two levels by more than its error.

    Two levels are wrong and agree where both miss what happens in shorter times, such as a
    rotation, a close encounter or a decay, and by chance where phases are lost.

    A trial of independent paths has the same noise on all levels where the solver allows
    it, so that their differences vary little. That hides changes of a hundred errors of
    value functions and of sorted paths. These are taken again with half the steps, by the
    programs that are compiled already, which hides changes of ten errors. (Where steps may
    miss a rotation, that would not clear sorted paths of the suspicion.)"""
    if any(map(has_unknown_law, brownian_paths(problem.terms))):
        return Trial()
    key = trial_key(key)
    is_fitted = isinstance(estimate.sampling, ValueFunctions)
    angle = unresolved_angle(problem.with_any_steps())
    has_same_sampling = plan.with_half_steps is not None and (
        is_fitted or angle is None
    )
    if has_same_sampling:
        changes = _changes_by_same_sampling(estimate, plan, key, devices)
    else:
        changes = _changes_on_same_noise(estimate, problem, key, devices)
    if changes is None:
        return Trial()
    if changes.are_sure:
        h = float(problem.levels.h[-1]) / 2
        return Trial(message=_message(estimate, changes, h))
    # The noise of fewer samples is always larger, which says little of resolved steps.
    if is_fitted or has_same_sampling or not changes.are_hidden:
        return Trial()
    if angle is None:
        return Trial(caveat=_caveat(estimate, changes))
    return Trial(message=_message_on_chance(estimate, problem, changes, angle))


class _Changes(NamedTuple):
    """The changes of all means by a finer level.

    - `sizes`, `noise`: their sizes and standard errors.
    - `errors`: the errors of the means.
    - `num_paths`: the number of paths of the trial.
    """

    sizes: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]
    errors: Float[np.ndarray, " n"]
    num_paths: int

    @property
    def visible(self) -> Float[np.ndarray, " n"]:
        """The smallest changes that are surely no noise."""
        sure = np.sqrt(_SURE_OF_ONE**2 + 2 * np.log(self.sizes.size))
        return sure * self.noise

    @property
    def excess(self) -> Float[np.ndarray, " n"]:
        """By how much the changes surely exceed the errors."""
        # What is not finite is larger than nothing.
        return np.nan_to_num(self.sizes - self.visible - self.errors, nan=-np.inf)

    @property
    def are_sure(self) -> bool:
        """Whether a change is surely more than an error."""
        return bool(np.any(self.excess > 0))

    @property
    def are_hidden(self) -> bool:
        """Whether the noise would hide a change as large as an error."""
        return bool(np.any(self.visible > self.errors))


def _message(estimate: Expectation, changes: _Changes, h: float) -> str:
    worst = int(np.argmax(changes.excess))
    return (
        f"Steps are too long: on {changes.num_paths} paths of a trial, a third level, with "
        f"steps of {h:.3g}, changes a mean{label_of(estimate, worst)} by "
        f"{changes.sizes[worst]:.2g} ± {changes.noise[worst]:.1g}, which is more than its "
        f"error, {changes.errors[worst]:.1g}. Pass a smaller `dt0`, or `levels=3`, which "
        "checks the order."
    )


def _message_on_chance(
    estimate: Expectation, problem: Problem, changes: _Changes, angle: float
) -> str:
    caveat = _caveat(estimate, changes)
    return (
        f"Steps of `dt0={float(problem.levels.h[0]):g}` are long, omega h = {angle:.3g} "
        "for the largest frequency of the drift where paths start, and two levels may "
        f"agree on a wrong mean by chance: {caveat}, which is more than the error. Pass a "
        "smaller `dt0`, or `levels=3`, which checks the order."
    )


def _caveat(estimate: Expectation, changes: _Changes) -> str:
    worst = int(np.argmax(changes.visible / changes.errors))
    return (
        f"a trial with half the steps, on {changes.num_paths:,} paths, could only see a "
        f"change of the mean{label_of(estimate, worst)} above {changes.visible[worst]:.1e}"
    )


def _changes_on_same_noise(
    estimate: Expectation, problem: Problem, key: PRNGKeyArray, devices: Devices
) -> _Changes | None:
    """The changes on independent paths, as many as they take; `None` if too few are
    affordable, or too many fail."""
    finer_problem = _with_finer_level(problem, key)
    trial = None
    changes = None
    for num_paths in _trial_sizes(estimate):
        sampling = IndependentPaths(num_paths, _batch_size(estimate))
        plan = sampling.prepare(finer_problem, key, devices)
        trial = run(plan._replace(is_quick=True), key, devices, start=trial)
        if trial.num_failed > _MOST_FAILED * num_paths:
            return None
        change = combined_results(trial, Combination.BEST)
        changes = _Changes(
            sizes=np.abs(change.mean),
            noise=change.std_error,
            errors=estimate.vectors.error,
            num_paths=num_paths,
        )
        if changes.are_sure or not changes.are_hidden:
            break
    return changes


def _changes_by_same_sampling(
    estimate: Expectation, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices
) -> _Changes | None:
    """The changes on samples of the same kind with half the steps; `None` if too many
    fail."""
    assert plan.with_half_steps is not None
    # At least two samples, for a standard error; and a whole batch, since a part of one
    # takes as long.
    num_samples = max(2, plan.batch_size, int(_FIRST_SHARE * estimate.num_samples))
    trial_plan = plan.with_half_steps()._replace(
        num_samples=num_samples, is_quick=plan.is_quick
    )
    trial = run(trial_plan, key, devices)
    if trial.num_failed > _MOST_FAILED * num_samples * plan.paths_per_sample:
        return None
    own = estimate.vectors
    other = trial.vectors
    # So few samples may show a standard error that is far too small. It is taken to be at
    # least that of the estimate, scaled to their number.
    expected = own.std_error * np.sqrt(estimate.num_samples / num_samples)
    return _Changes(
        sizes=np.abs(other.mean - own.mean),
        noise=np.hypot(own.std_error, np.maximum(expected, other.std_error)),
        errors=own.error,
        num_paths=trial.num_paths,
    )


def _trial_sizes(estimate: Expectation) -> list[int]:
    """The numbers of paths to try in turn; none if even the first would be too small."""
    # A fit takes far longer than the largest trial.
    if isinstance(estimate.sampling, ValueFunctions):
        return list(_NUMBERS_OF_PATHS)
    first, *others = _NUMBERS_OF_PATHS
    first = min(first, int(_FIRST_SHARE * estimate.num_paths))
    if first < _FEWEST_PATHS:
        return []
    most = _LARGEST_SHARE * estimate.num_paths
    return [first] + [number for number in others if number <= most]


def _batch_size(estimate: Expectation) -> int:
    """The paths that a trial takes at once: those of its first number, or as few as the
    user chooses where paths take much memory."""
    largest = _NUMBERS_OF_PATHS[0]
    sampling = estimate.sampling
    if isinstance(sampling, IndependentPaths) and sampling.batch_size is not None:
        return min(largest, int(sampling.batch_size))
    return largest


def _with_finer_level(problem: Problem, key: PRNGKeyArray) -> Problem:
    """The problem with one more level, whose single combination of levels is the change
    of the estimate by it."""
    levels = with_next_level(problem.levels)
    finest = levels.h[-1]
    terms = problem.terms
    # All levels have the same noise by paths that are sampled over cells of the finest
    # step, if these begin at multiples of it, and the solver takes Gaussian increments.
    # Otherwise the levels have independent noise.
    begins_at_cell = is_multiple(float(problem.t0), float(finest))
    if begins_at_cell and not has_discrete_increments(problem.solver):
        # An array, so that another cell compiles nothing anew.
        path = ft.partial(path_of_array_cell, problem.solver, np.asarray(finest))
        numbers = motion_numbers(random_paths(terms))
        terms = with_paths(path, numbers, terms, key)
    weights = finer_change_weights(problem.order, len(problem.levels.h))
    return dataclasses.replace(
        problem,
        terms=terms,
        levels=levels,
        weights=weights[None].astype(problem.weights.dtype),
    )
