"""A trial with one more level, where two levels cannot check themselves."""

import dataclasses
import functools as ft

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
from .._solver import common_path
from .._terms import (
    brownian_paths,
    has_unknown_law,
    motion_numbers,
    random_paths,
    with_paths,
)
from .choose import trial_key
from .estimate import combined_results, Expectation
from .independent import IndependentPaths
from .run import run


# A trial takes so many paths, or this part of those of the estimate if that is less, so
# that it takes a small part of its time: a path of a trial has 7 steps for 3.
_MOST_PATHS = 512
_PART = 8
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
    num_paths = min(_MOST_PATHS, estimate.num_paths // _PART)
    if num_paths < _FEWEST_PATHS:
        return None
    if any(map(has_unknown_law, brownian_paths(problem.terms))):
        return None
    key = trial_key(key)
    plan = IndependentPaths(num_paths).prepare(
        _with_finer_level(problem, key), key, devices
    )
    trial = run(plan._replace(is_quick=True), key, devices)
    if trial.num_failed > _MOST_FAILED * num_paths:
        return None
    change = combined_results(trial, Combination.BEST)
    changes = np.abs(_numbers(change.mean))
    noise = _numbers(change.std_error)
    errors = _numbers(estimate.error)
    sure = np.sqrt(_SURE_OF_ONE**2 + 2 * np.log(changes.size))
    # What is not finite is larger than nothing.
    excess = np.nan_to_num(changes - sure * noise - errors, nan=-1.0)
    worst = np.argmax(excess)
    if not excess[worst] > 0:
        return None
    h = float(problem.levels.h[-1]) / 2
    return (
        f"Steps are too long: on {num_paths} paths of a trial, a third level, with steps "
        f"of {h:.3g}, changes a mean by {changes[worst]:.2g} ± {noise[worst]:.1g}, which "
        f"is more than its error, {errors[worst]:.1g}. Pass a smaller `dt0`, or `tol`, "
        "which takes smaller steps until they fit the order."
    )


def _with_finer_level(problem: Problem, key: PRNGKeyArray) -> Problem:
    """The problem with one more level, whose single combination of levels is the change
    of the estimate by it."""
    levels = with_next_level(problem.levels)
    finest = float(levels.h[-1])
    terms = problem.terms
    has_same_noise = not has_discrete_increments(problem.solver)
    if has_same_noise and is_multiple(float(problem.t0), finest):
        path = ft.partial(common_path, problem.solver, finest)
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
