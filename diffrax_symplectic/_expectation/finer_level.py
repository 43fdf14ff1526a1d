"""A trial with one more level, for estimates of two levels.

Two levels agree on a wrong mean where both miss what happens in shorter times than a step,
such as a rotation, a close encounter or a decay. Where phases are lost, they may agree by
chance. The trial shows whether a third level, with steps half as long as the finest ones,
would change the mean by more than its error.
"""

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
from .._solver import common_path
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


# The numbers of independent paths that are tried. A larger number is tried only if, with
# the one before, statistical noise hides changes as large as the error.
_PATHS_OF_TRIALS = 512, 2048, 8192
# The first trial takes at most this share of the samples of the estimate. (Where a path of
# the estimate takes 3 steps, 1 and 2 on two levels, a path of the trial takes 7 on three
# levels, or 6 with halved steps on two levels.)
_SHARE_OF_FIRST_TRIAL = 1 / 8
# Each later trial takes at most this share.
_SHARE_OF_LATER_TRIALS = 1 / 32
# The standard error of fewer paths than this is itself too uncertain. If this number is
# more than the share of the first trial, there is no trial.
_FEWEST_PATHS = 32
# The change of a single mean is sure if it is this many standard errors from zero, which
# happens by chance once in 370 times. (`_Changes.visible` asks for more of many means.)
_STD_ERRORS_TO_BE_SURE = 3
# A trial in which more than this share of the paths fails has no mean to compare.
_LARGEST_SHARE_FAILED = 0.1


class Verdict(NamedTuple):
    """What a trial says of an estimate.

    - `warning`: what is wrong with the steps, in sentences; `None` if the trial shows
        nothing wrong.
    - `caveat`: which changes the trial could not see, in words; empty if it could see a
        change as large as the error.
    """

    warning: str | None = None
    caveat: str = ""


def trial_with_finer_level(
    estimate: Expectation,
    problem: Problem,
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: Devices,
) -> Verdict:
    """Tries whether a finer level changes an estimate of two levels by more than its error.
    There are two kinds of trials:

    - On independent paths, if possible with the same noise on all levels, so that the
        difference between levels varies little. Even so, its standard error may be a
        hundred times the error of an estimate by value functions or sorted paths.
    - For value functions and sorted paths: by the same sampling with halved steps, whose
        programs are compiled already. A change of ten errors is then visible. A smaller
        change remains possible, so sorted paths whose steps may miss a rotation get a trial
        of the first kind."""
    # The law of a path of the user's own class is unknown, and may be another one on a
    # finer level.
    if any(map(has_unknown_law, brownian_paths(problem.terms))):
        return Verdict()
    key = trial_key(key)
    is_fitted = isinstance(estimate.sampling, ValueFunctions)
    # The angle by which a step turns the state, if it is so large that steps may miss a
    # rotation.
    angle = unresolved_angle(problem)
    if plan.with_halved_steps is not None and (is_fitted or angle is None):
        changes = _changes_by_same_sampling(estimate, plan, key, devices)
    else:
        changes = _changes_on_same_noise(estimate, problem, key, devices)
    if changes is None:
        return Verdict()
    return _verdict(estimate, problem, changes, angle)


class _Changes(NamedTuple):
    """By how much a finer level changes each number of the mean, as a trial shows.

    - `sizes`, `std_errors`: the absolute values of the changes, and their standard errors.
    - `errors`: the errors of the mean, as the estimate states them.
    - `num_paths`: the number of paths of the trial.
    """

    sizes: Float[np.ndarray, " n"]
    std_errors: Float[np.ndarray, " n"]
    errors: Float[np.ndarray, " n"]
    num_paths: int

    @property
    def visible(self) -> Float[np.ndarray, " n"]:
        """The smallest changes that chance alone would surely not make."""
        # The largest of n normal numbers grows like the square root of 2 log(n).
        log_n = np.log(self.sizes.size)
        return np.sqrt(_STD_ERRORS_TO_BE_SURE**2 + 2 * log_n) * self.std_errors

    @property
    def excess(self) -> Float[np.ndarray, " n"]:
        """By how much the changes surely exceed the errors. Negative where they may not
        exceed them."""
        # A change that is NaN must not be the largest, for `np.any` and `np.argmax`.
        return np.nan_to_num(self.sizes - self.visible - self.errors, nan=-np.inf)

    @property
    def are_sure(self) -> bool:
        """Whether any change surely exceeds its error."""
        return bool(np.any(self.excess > 0))

    @property
    def are_hidden(self) -> bool:
        """Whether the noise of the trial would hide a change as large as an error."""
        return bool(np.any(self.visible > self.errors))


def _verdict(
    estimate: Expectation, problem: Problem, changes: _Changes, angle: float | None
) -> Verdict:
    """What the changes say of an estimate:

    - If a change surely exceeds its error, there is a warning.
    - If the noise of the trial would hide such a change, there is a caveat; or instead a
        warning, if the steps may also miss a rotation.
    - Otherwise nothing.

    `angle` is the angle by which a step turns the state, or `None` if it is too small to be
    missed."""
    advice = "Pass a smaller `dt0`, or `levels=3`, which checks the order."
    if changes.are_sure:
        worst = int(np.argmax(changes.excess))
        finer_step = float(problem.levels.h[-1]) / 2
        return Verdict(
            warning=f"Steps are too long: on {changes.num_paths} paths of a trial, a third "
            f"level, with steps of {finer_step:.3g}, changes a mean"
            f"{label_of(estimate, worst)} by {changes.sizes[worst]:.2g} ± "
            f"{changes.std_errors[worst]:.1g}, which is more than its error, "
            f"{changes.errors[worst]:.1g}. {advice}"
        )
    # Beside the errors of value functions, the noise of a trial is always large, so that a
    # caveat would say nothing of the steps.
    is_fitted = isinstance(estimate.sampling, ValueFunctions)
    if is_fitted or not changes.are_hidden:
        return Verdict()
    caveat = _caveat(estimate, changes)
    if angle is None:
        return Verdict(caveat=caveat)
    return Verdict(
        warning=f"Steps of `dt0={float(problem.levels.h[0]):g}` are long, omega h = "
        f"{angle:.3g} for the largest frequency of the drift where paths start, and two "
        f"levels may agree on a wrong mean by chance: {caveat}, which is more than the "
        f"error. {advice}"
    )


def _caveat(estimate: Expectation, changes: _Changes) -> str:
    """Which changes the trial could not see, in words."""
    worst = int(np.argmax(changes.visible / changes.errors))
    return (
        f"a trial with halved steps, on {changes.num_paths:,} paths, could only see a "
        f"change of the mean{label_of(estimate, worst)} above {changes.visible[worst]:.1e}"
    )


def _changes_on_same_noise(
    estimate: Expectation, problem: Problem, key: PRNGKeyArray, devices: Devices
) -> _Changes | None:
    """The changes by a third level, on independent paths, if possible with the same noise
    on all levels. There are trials of more and more paths, until a change is sure, or the
    statistical noise of the trial does not hide changes as large as the errors. `None` if
    the estimate has too few paths for a trial, or if too many paths of a trial fail."""
    # All trials take batches of the same size, so that they share a program. The user may
    # have chosen a smaller size, for example to save memory.
    batch_size = _PATHS_OF_TRIALS[0]
    sampling = estimate.sampling
    if isinstance(sampling, IndependentPaths) and sampling.batch_size is not None:
        batch_size = min(batch_size, int(sampling.batch_size))
    finer_problem = _with_finer_level(problem, key)
    trial = None
    changes = None
    for num_paths in _numbers_of_paths(estimate):
        sampling_of_trial = IndependentPaths(num_paths, batch_size)
        plan = sampling_of_trial.prepare(finer_problem, key, devices)
        # Each trial continues the one before.
        trial = run(plan._replace(is_quick=True), key, devices, start=trial)
        if trial.num_failed > _LARGEST_SHARE_FAILED * num_paths:
            return None
        # The single combination of levels of `finer_problem` is the change.
        change = combined_results(trial, Combination.BEST)
        changes = _Changes(
            sizes=np.abs(change.mean),
            std_errors=change.std_error,
            errors=estimate.vectors.error,
            num_paths=num_paths,
        )
        if changes.are_sure or not changes.are_hidden:
            break
    return changes


def _numbers_of_paths(estimate: Expectation) -> list[int]:
    """The numbers of paths of trials on independent paths, in increasing order. The list is
    empty if the estimate has too few paths for a trial."""
    # A fit takes far longer than the largest trial.
    if isinstance(estimate.sampling, ValueFunctions):
        return [*_PATHS_OF_TRIALS]
    first, *later = _PATHS_OF_TRIALS
    first = min(first, int(_SHARE_OF_FIRST_TRIAL * estimate.num_paths))
    if first < _FEWEST_PATHS:
        return []
    most_later = _SHARE_OF_LATER_TRIALS * estimate.num_paths
    return [first, *(num_paths for num_paths in later if num_paths <= most_later)]


def _with_finer_level(problem: Problem, key: PRNGKeyArray) -> Problem:
    """The problem with one more level, whose steps are half as long as the finest ones. Its
    single combination of levels is a difference of two extrapolated means: from all levels
    but the coarsest, minus from all but the new one."""
    levels = with_next_level(problem.levels)
    finest_step = levels.h[-1]
    terms = problem.terms
    # Paths with a `cell` have the same noise on all levels: they draw a Gaussian increment
    # from each multiple of the cell to the next, and add the increments up over a step.
    # This needs steps that begin at multiples of the cell, and a solver that takes Gaussian
    # increments. Otherwise the noise of the levels is independent.
    begins_at_cell = is_multiple(float(problem.t0), float(finest_step))
    if begins_at_cell and not has_discrete_increments(problem.solver):
        # The cell is an array, since another number would compile anew.
        path = ft.partial(common_path, problem.solver, np.asarray(finest_step))
        numbers = motion_numbers(random_paths(terms))
        terms = with_paths(path, numbers, terms, key)
    weights = finer_change_weights(problem.order, len(problem.levels.h))
    return dataclasses.replace(
        problem,
        terms=terms,
        levels=levels,
        weights=weights[None].astype(problem.weights.dtype),
    )


def _changes_by_same_sampling(
    estimate: Expectation, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices
) -> _Changes | None:
    """The changes by halved steps: the difference between the mean of the estimate, and the
    mean of a trial by the same sampling in which the steps of both levels are half as long.
    `None` if too many paths of the trial fail."""
    assert plan.with_halved_steps is not None
    # At least two samples, for a standard error; and at least a whole batch, since a part
    # of one takes as long.
    most_by_share = int(_SHARE_OF_FIRST_TRIAL * estimate.num_samples)
    num_samples = max(2, plan.batch_size, most_by_share)
    trial_plan = plan.with_halved_steps()._replace(
        num_samples=num_samples, is_quick=plan.is_quick
    )
    trial = run(trial_plan, key, devices)
    if trial.num_failed > _LARGEST_SHARE_FAILED * num_samples * plan.paths_per_sample:
        return None
    of_estimate = estimate.vectors
    of_trial = trial.vectors
    # The standard error of so few samples may come out far too small. So it is taken to be
    # at least that of as many samples of the estimate.
    least_error = of_estimate.std_error * np.sqrt(estimate.num_samples / num_samples)
    trial_std_error = np.maximum(least_error, of_trial.std_error)
    return _Changes(
        sizes=np.abs(of_trial.mean - of_estimate.mean),
        std_errors=np.hypot(of_estimate.std_error, trial_std_error),
        errors=of_estimate.error,
        num_paths=trial.num_paths,
    )
