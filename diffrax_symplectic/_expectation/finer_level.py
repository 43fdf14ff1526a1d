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


# The paths of a trial on the same noise: a larger number is tried only if, with the one
# before, statistical noise hides changes as large as the error.
_PATHS_OF_TRIALS = 512, 2048, 8192
# A trial takes at most this share of the samples of the estimate: the first one, and any
# that follows. Where the estimate takes 3 steps (1 and 2, on two levels), a path of the
# trial takes 7 on the same noise (1, 2 and 4), or 6 with halved steps on both levels.
_SHARE_OF_FIRST_TRIAL = 1 / 8
_SHARE_OF_LATER_TRIALS = 1 / 32
# The standard error of fewer paths than this is itself too uncertain. An estimate whose
# share is less than this has no trial, since one of 32 paths would be a large part of it.
_FEWEST_PATHS = 32
# The change of a single mean is sure if it is this many standard errors from zero, which
# happens by chance once in 370 times. (`_Changes.visible` asks for more of many means.)
_STD_ERRORS_TO_BE_SURE = 3
# A trial in which more than this share of the paths fails has no mean to compare.
_LARGEST_SHARE_FAILED = 0.1


def trial_with_finer_level(
    estimate: Expectation,
    problem: Problem,
    plan: SamplingPlan,
    key: PRNGKeyArray,
    devices: Devices,
) -> tuple[str | None, str]:
    """How a finer level changes an estimate of two levels by more than its error, as a
    sentence (`None` if it does not); and which changes the trial could not see, in words
    (empty if these are less than the error).

    Two levels agree on a wrong mean where both miss what happens in shorter times, such as
    a rotation, a close encounter or a decay, and by chance where phases are lost.

    There are two kinds of trials. One takes independent paths, with the same noise on all
    levels if the solver allows it, so that their differences vary little. Even so, the
    standard error of a difference may be a hundred times the error of an estimate by value
    functions or sorted paths. So these are sampled again with halved steps, by the
    programs that are compiled already: a change of ten errors is then visible. (Sorted
    paths whose steps may miss a rotation get the first kind all the same, since a change of
    less than ten errors would remain possible.)"""
    if any(map(has_unknown_law, brownian_paths(problem.terms))):
        return None, ""
    key = trial_key(key)
    is_fitted = isinstance(estimate.sampling, ValueFunctions)
    angle = unresolved_angle(problem)
    if plan.with_halved_steps is not None and (is_fitted or angle is None):
        changes = _changes_by_same_sampling(estimate, plan, key, devices)
    else:
        changes = _changes_on_same_noise(estimate, problem, key, devices)
    if changes is None:
        return None, ""
    h = problem.levels.h
    advice = "Pass a smaller `dt0`, or `levels=3`, which checks the order."
    if changes.are_sure:
        worst = int(np.argmax(changes.excess))
        message = (
            f"Steps are too long: on {changes.num_paths} paths of a trial, a third level, "
            f"with steps of {float(h[-1]) / 2:.3g}, changes a mean"
            f"{label_of(estimate, worst)} by {changes.sizes[worst]:.2g} ± "
            f"{changes.std_errors[worst]:.1g}, which is more than its error, "
            f"{changes.errors[worst]:.1g}. {advice}"
        )
        return message, ""
    # Next to value functions the standard error of fewer samples is always the larger one,
    # which says little of resolved steps.
    if is_fitted or not changes.are_hidden:
        return None, ""
    caveat = _caveat(estimate, changes)
    if angle is None:
        return None, caveat
    message = (
        f"Steps of `dt0={float(h[0]):g}` are long, omega h = {angle:.3g} for the largest "
        "frequency of the drift where paths start, and two levels may agree on a wrong "
        f"mean by chance: {caveat}, which is more than the error. {advice}"
    )
    return message, ""


class _Changes(NamedTuple):
    """The changes of all means by a finer level.

    - `sizes`, `std_errors`: their absolute values and standard errors.
    - `errors`: the errors of the means, as the estimate states them.
    - `num_paths`: the number of paths of the trial.
    """

    sizes: Float[np.ndarray, " n"]
    std_errors: Float[np.ndarray, " n"]
    errors: Float[np.ndarray, " n"]
    num_paths: int

    @property
    def visible(self) -> Float[np.ndarray, " n"]:
        """The smallest changes that are surely not by chance."""
        # The largest of n normal numbers grows like the square root of 2 log(n).
        num_std_errors = np.sqrt(
            _STD_ERRORS_TO_BE_SURE**2 + 2 * np.log(self.sizes.size)
        )
        return num_std_errors * self.std_errors

    @property
    def excess(self) -> Float[np.ndarray, " n"]:
        """By how much the changes surely exceed the errors; negative if they do not."""
        # A change that is NaN must not be the largest, for `np.any` and `np.argmax`.
        return np.nan_to_num(self.sizes - self.visible - self.errors, nan=-np.inf)

    @property
    def are_sure(self) -> bool:
        """Whether a change is surely more than an error."""
        return bool(np.any(self.excess > 0))

    @property
    def are_hidden(self) -> bool:
        """Whether the noise would hide a change as large as an error."""
        return bool(np.any(self.visible > self.errors))


def _caveat(estimate: Expectation, changes: _Changes) -> str:
    worst = int(np.argmax(changes.visible / changes.errors))
    return (
        f"a trial with halved steps, on {changes.num_paths:,} paths, could only see a "
        f"change of the mean{label_of(estimate, worst)} above {changes.visible[worst]:.1e}"
    )


def _changes_on_same_noise(
    estimate: Expectation, problem: Problem, key: PRNGKeyArray, devices: Devices
) -> _Changes | None:
    """The changes on independent paths, more and more of them until the changes are sure,
    or known well enough to be less than the errors. `None` if the estimate has too few
    paths for a trial, or too many paths of the trial fail."""
    first, *others = _PATHS_OF_TRIALS
    # All trials take as many paths at once as the first one, so that they share a program;
    # or fewer if the user chose a smaller batch, as to save memory.
    batch_size = first
    sampling = estimate.sampling
    if isinstance(sampling, IndependentPaths) and sampling.batch_size is not None:
        batch_size = min(first, int(sampling.batch_size))
    # A fit takes far longer than the largest trial.
    if not isinstance(sampling, ValueFunctions):
        first = min(first, int(_SHARE_OF_FIRST_TRIAL * estimate.num_paths))
        most = _SHARE_OF_LATER_TRIALS * estimate.num_paths
        others = [num_paths for num_paths in others if num_paths <= most]
    if first < _FEWEST_PATHS:
        return None
    finer_problem = _with_finer_level(problem, key)
    trial = None
    changes = None
    for num_paths in (first, *others):
        plan = IndependentPaths(num_paths, batch_size).prepare(
            finer_problem, key, devices
        )
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


def _changes_by_same_sampling(
    estimate: Expectation, plan: SamplingPlan, key: PRNGKeyArray, devices: Devices
) -> _Changes | None:
    """The changes on samples of the same kind with halved steps; `None` if too many
    fail."""
    assert plan.with_halved_steps is not None
    # At least two samples, for a standard error; and a whole batch, since a part of one
    # takes as long.
    num_samples = max(
        2, plan.batch_size, int(_SHARE_OF_FIRST_TRIAL * estimate.num_samples)
    )
    trial_plan = plan.with_halved_steps()._replace(
        num_samples=num_samples, is_quick=plan.is_quick
    )
    trial = run(trial_plan, key, devices)
    if trial.num_failed > _LARGEST_SHARE_FAILED * num_samples * plan.paths_per_sample:
        return None
    of_estimate = estimate.vectors
    of_trial = trial.vectors
    # The standard error of so few samples may come out far too small. It is taken to be at
    # least what the spread of the estimate's samples gives for this number of them.
    least = of_estimate.std_error * np.sqrt(estimate.num_samples / num_samples)
    trial_std_error = np.maximum(least, of_trial.std_error)
    return _Changes(
        sizes=np.abs(of_trial.mean - of_estimate.mean),
        std_errors=np.hypot(of_estimate.std_error, trial_std_error),
        errors=of_estimate.error,
        num_paths=trial.num_paths,
    )


def _with_finer_level(problem: Problem, key: PRNGKeyArray) -> Problem:
    """The problem with one more level. Its single combination of levels is the change of
    the mean if the coarsest level is left out for the new one."""
    levels = with_next_level(problem.levels)
    finest = levels.h[-1]
    terms = problem.terms
    # Paths that draw an increment for each cell, one finest step long, have the same noise
    # on all levels. Cells begin at multiples of their length, where steps must begin, too,
    # and their increments are Gaussian, which the solver must take. Otherwise the levels
    # have independent noise.
    begins_at_cell = is_multiple(float(problem.t0), float(finest))
    if begins_at_cell and not has_discrete_increments(problem.solver):
        # An array, so that another cell compiles nothing anew.
        path = ft.partial(common_path, problem.solver, np.asarray(finest))
        numbers = motion_numbers(random_paths(terms))
        terms = with_paths(path, numbers, terms, key)
    weights = finer_change_weights(problem.order, len(problem.levels.h))
    return dataclasses.replace(
        problem,
        terms=terms,
        levels=levels,
        weights=weights[None].astype(problem.weights.dtype),
    )
