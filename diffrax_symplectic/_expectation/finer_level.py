"""A trial with one more level, where two levels cannot check themselves."""

import dataclasses
import functools as ft
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float, PRNGKeyArray, PyTree

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
from .estimate import combined_results, Expectation
from .fitted import ValueFunctions
from .independent import IndependentPaths
from .run import run


# The numbers of paths of a trial: more are taken only while their noise hides changes as
# large as the error.
_NUMBERS_OF_PATHS = 512, 2048, 8192
# A trial takes at most this part of the paths of an estimate. A path of a trial has 7 steps
# for 3, so it takes a small part of the time.
_PART = 8
_PART_BEYOND_FIRST = 32
# Fewer paths than this do not know their own spread, and more would take longer than the
# estimate.
_FEWEST_PATHS = 32
# A change is sure if it is this many standard errors from zero: by chance that happens once
# in 370 times for a single mean, and hardly more often for the largest of many.
_SURE_OF_ONE = 3
# A trial of which more paths fail than this part has no mean to compare.
_MOST_FAILED = 0.1


def changes_with_finer_level(
    estimate: Expectation, problem: Problem, key: PRNGKeyArray, devices: Devices
) -> str | None:
    """How a finer level changes an estimate by more than its error, as a sentence; `None`
    if it does not.

    Two levels are wrong and agree where both miss what happens in shorter times, such as a
    close encounter or a decay, and by chance where phases are lost. The trial takes few
    paths, each with the same noise on all levels where the solver allows it, so that their
    differences vary little."""
    if any(map(has_unknown_law, brownian_paths(problem.terms))):
        return None
    key = trial_key(key)
    finer_problem = _with_finer_level(problem, key)
    trial = None
    for num_paths in _numbers_of_paths(estimate):
        sampling = IndependentPaths(num_paths, _batch_size(estimate))
        plan = sampling.prepare(finer_problem, key, devices)
        trial = run(plan._replace(is_quick=True), key, devices, start=trial)
        if trial.num_failed > _MOST_FAILED * num_paths:
            return None
        change = _largest_change(trial, estimate)
        if change.is_sure or not change.is_hidden:
            break
    else:
        return None
    if not change.is_sure:
        return None
    h = float(problem.levels.h[-1]) / 2
    return (
        f"Steps are too long: on {num_paths} paths of a trial, a third level, with steps "
        f"of {h:.3g}, changes a mean by {change.size:.2g} ± {change.noise:.1g}, which is "
        f"more than its error, {change.error:.1g}. Pass a smaller `dt0`, or `tol`, which "
        "takes smaller steps until they fit the order."
    )


class _Change(NamedTuple):
    """The change of the mean that exceeds its error most.

    - `size`, `noise`: its size and standard error.
    - `error`: the error of the mean.
    - `is_sure`: whether it is surely more than this error.
    - `is_hidden`: whether the noise would hide a change as large as the error.
    """

    size: float
    noise: float
    error: float
    is_sure: bool
    is_hidden: bool


def _largest_change(trial: Expectation, estimate: Expectation) -> _Change:
    """The change of an estimate by a trial."""
    change = combined_results(trial, Combination.BEST)
    sizes = np.abs(_numbers(change.mean))
    noise = _numbers(change.std_error)
    errors = _numbers(estimate.error)
    sure = np.sqrt(_SURE_OF_ONE**2 + 2 * np.log(sizes.size))
    # What is not finite is larger than nothing.
    excess = np.nan_to_num(sizes - sure * noise - errors, nan=-np.inf)
    worst = np.argmax(excess)
    return _Change(
        size=float(sizes[worst]),
        noise=float(noise[worst]),
        error=float(errors[worst]),
        is_sure=bool(excess[worst] > 0),
        is_hidden=bool(np.any(sure * noise > errors)),
    )


def _numbers_of_paths(estimate: Expectation) -> list[int]:
    """The numbers of paths of the trial of an estimate."""
    # The fits of value functions take far longer than their paths.
    if isinstance(estimate.sampling, ValueFunctions):
        return list(_NUMBERS_OF_PATHS)
    first, *others = _NUMBERS_OF_PATHS
    first = min(first, estimate.num_paths // _PART)
    if first < _FEWEST_PATHS:
        return []
    most = estimate.num_paths // _PART_BEYOND_FIRST
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
    has_same_noise = not has_discrete_increments(problem.solver)
    if has_same_noise and is_multiple(float(problem.t0), float(finest)):
        path = ft.partial(path_of_array_cell, problem.solver, np.asarray(finest))
        numbers = motion_numbers(random_paths(terms))
        terms = with_paths(path, numbers, terms, key)
    weights = finer_change_weights(problem.order, len(problem.levels.h))
    return dataclasses.replace(
        problem,
        terms=terms,
        levels=levels,
        weights=weights[None].astype(problem.weights.dtype),
        finest_steps=int(levels.num_steps[-1]),
    )


def _numbers(tree: PyTree[np.ndarray | np.floating]) -> Float[np.ndarray, " n"]:
    """All numbers of a PyTree of arrays as one vector."""
    return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(tree)])
