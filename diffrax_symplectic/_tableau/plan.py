"""The plan of a step: which stages of a tableau to solve for, which to evaluate, and in
which order. It is made from coefficients alone, before tracing.

A stage is one evaluation of a vector field. Its channels are the names of the controls that
multiply the vector field: `"h"` for the step size, or random variables.
"""

import dataclasses
import functools as ft
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool

from .tableau import FlatTableau, Stage


# Numbers that differ by less are taken to be equal: coefficients are exact up to a few
# roundings of numbers of order one.
_TOLERANCE = 1e-14
# The search for the smallest set of unknown stages of a block ends at a size for which
# there are more than this many sets. Blocks of up to twelve stages are always searched
# exhaustively. No tableau of this package has a block of more than six stages. The bound
# only keeps an unusual tableau from taking minutes.
_MOST_CHOICES = 1000


# Stages of one kind that can be evaluated together, by their numbers.
Group: TypeAlias = tuple[int, ...]
# Entry `i, j` says whether stage `i` depends on the value of stage `j`.
_Dependencies: TypeAlias = Bool[np.ndarray, "s s"]


class Block(NamedTuple):
    """Stages that depend on each other: a strongly connected component of the dependency
    graph.

    - `unknown`: the stages to solve for; none if the block is explicit.
    - `explicit`: the other stages, ordered so that each depends only on the unknown stages
        and on earlier explicit stages.

    Both consist of groups of stages that can be evaluated together.
    """

    unknown: tuple[Group, ...]
    explicit: tuple[Group, ...]


# Plans are compared by identity, which is fast. It is enough, since `make_plan` returns the
# same plan for equal tableaus, as long as its cache holds the plan.
@dataclasses.dataclass(frozen=True, eq=False)
class StepPlan:
    """The distinct stages that a tableau uses, in blocks to be solved in order."""

    tableau: FlatTableau
    blocks: tuple[Block, ...]


def make_plan(tableau: FlatTableau) -> StepPlan:
    """The plan of a step: unused stages are dropped, equal ones merged, and the rest is
    ordered. Equal tableaus share one plan, the same object in every trace."""
    # A plan is static data of a traced step, so a new plan would make JAX trace the step
    # again. Arrays cannot be keys of a cache, so the coefficients are passed as bytes.
    return _make_plan(
        tableau.stages,
        np.asarray(tableau.matrix, np.float64).tobytes(),
        np.asarray(tableau.weights, np.float64).tobytes(),
    )


# A solver with free parameters has a tableau for each of their values. A search over
# parameters would make an unbounded cache too large.
@ft.lru_cache(maxsize=1024)
def _make_plan(stages: tuple[Stage, ...], matrix: bytes, weights: bytes) -> StepPlan:
    """`make_plan` for a tableau with these stages and coefficients, given as bytes."""
    num_stages = len(stages)
    tableau = FlatTableau(
        stages=stages,
        matrix=np.frombuffer(matrix, np.float64).reshape(num_stages, num_stages),
        weights=np.frombuffer(weights, np.float64),
    )
    # Below, stage `i` depends on stage `j` if entry `i, j` of the matrix is not zero. So
    # coefficients without effect, of values that a stage does not read, are set to zero.
    matrix_of_reads = np.where(tableau.reads_from, tableau.matrix, 0.0)
    tableau = dataclasses.replace(tableau, matrix=_with_exact_zeros(matrix_of_reads))
    # Each of the three reductions may make others possible: weights may cancel when stages
    # are merged, and columns may become equal when unused stages are dropped. So all three
    # are repeated until no stage is lost.
    while True:
        num_before = len(tableau.stages)
        tableau = _with_equal_stages_merged(tableau)
        tableau = _with_live_stages(tableau)
        # Channels are merged last: a stage that has got further channels is no longer equal
        # to stages with its former channels.
        tableau = _with_channels_merged(tableau)
        if len(tableau.stages) == num_before:
            return StepPlan(tableau, _blocks(tableau))


def _with_exact_zeros(x: np.ndarray | np.floating) -> np.ndarray:
    """Sets numbers to zero that are zero up to rounding."""
    return np.where(np.abs(x) < _TOLERANCE, 0.0, x)


def _equal(x: np.ndarray | float, y: np.ndarray | float) -> bool:
    """Whether coefficients are equal up to rounding."""
    return np.allclose(x, y, rtol=0, atol=_TOLERANCE)


def _with_live_stages(tableau: FlatTableau) -> FlatTableau:
    """The tableau with only the live stages: those on which the end of the step depends,
    directly or through other stages."""
    depends = tableau.matrix != 0
    is_live = tableau.weights != 0
    # Each round adds the stages that live ones depend on. No chain of dependencies is
    # longer than the number of stages.
    for _ in tableau.stages:
        is_live = is_live | (is_live @ depends)
    return tableau.take(np.flatnonzero(is_live).tolist())


def _with_equal_stages_merged(tableau: FlatTableau) -> FlatTableau:
    """The tableau with a single stage in place of stages of equal value, which are those
    with the same channels, evaluated at the same time and state. The value of the single
    stage is used with the sums of their coefficients."""

    def are_equal(i: int, j: int) -> bool:
        same_channels = tableau.stages[i].channels == tableau.stages[j].channels
        return same_channels and _same_evaluation(tableau, i, j)

    # Pairs are merged one at a time, since the merged stage may be equal to a third one.
    while pair := _first_pair(tableau, are_equal):
        i, j = pair
        matrix = tableau.matrix.copy()
        weights = tableau.weights.copy()
        # In floating point a sum that should vanish may not: 0.1 + 0.2 - 0.3 is not 0.
        matrix[:, i] = _with_exact_zeros(matrix[:, i] + matrix[:, j])
        weights[i] = _with_exact_zeros(weights[i] + weights[j])
        with_sums = dataclasses.replace(tableau, matrix=matrix, weights=weights)
        tableau = _without(with_sums, j)
    return tableau


def _with_channels_merged(tableau: FlatTableau) -> FlatTableau:
    """The tableau with a single stage in place of two stages of which only the sum of their
    values matters: they have different channels, are evaluated at the same time and state,
    and enter all stages and the end of the step with the same coefficients. The single
    stage has the channels of both, and its value is the sum."""

    def can_be_summed(i: int, j: int) -> bool:
        return (
            tableau.stages[i].channels != tableau.stages[j].channels
            and _same_evaluation(tableau, i, j)
            and _equal(tableau.matrix[:, i], tableau.matrix[:, j])
            and _equal(tableau.weights[i], tableau.weights[j])
        )

    # Pairs are merged one at a time, since the merged stage may be merged with a third one.
    while pair := _first_pair(tableau, can_be_summed):
        i, j = pair
        stages = list(tableau.stages)
        channels = stages[i].channels + stages[j].channels
        stages[i] = stages[i]._replace(channels=channels)
        tableau = _without(dataclasses.replace(tableau, stages=tuple(stages)), j)
    return tableau


def _first_pair(
    tableau: FlatTableau, may_be_merged: Callable[[int, int], bool]
) -> tuple[int, int] | None:
    """The first pair of stages `i < j` that may be merged, or `None`."""
    pairs = itertools.combinations(range(len(tableau.stages)), 2)
    return next((pair for pair in pairs if may_be_merged(*pair)), None)


def _same_evaluation(tableau: FlatTableau, i: int, j: int) -> bool:
    """Whether two stages evaluate their vector fields at the same time and state, and write
    the same part of the state."""
    first = tableau.stages[i]
    second = tableau.stages[j]
    return (
        (first.reads, first.writes) == (second.reads, second.writes)
        and _equal(first.c, second.c)
        and _equal(tableau.matrix[i], tableau.matrix[j])
    )


def _without(tableau: FlatTableau, j: int) -> FlatTableau:
    return tableau.take([i for i in range(len(tableau.stages)) if i != j])


def _blocks(tableau: FlatTableau) -> tuple[Block, ...]:
    """The blocks of a step: the strongly connected components of the dependencies. Each
    block comes after the blocks on which it depends."""
    num_stages = len(tableau.stages)
    depends = tableau.matrix != 0
    # Entry `i, j` of `reaches` says whether a chain of dependencies leads from stage `i` to
    # stage `j`. This is Warshall's algorithm: after round `k`, all chains are known whose
    # stages between `i` and `j` are among the first, up to number `k`. Each stage reaches
    # itself, so that an explicit stage is a component, too.
    reaches = depends | np.eye(num_stages, dtype=bool)
    for k in range(num_stages):
        reaches = reaches | (reaches[:, k, None] & reaches[k])
    is_mutual = reaches & reaches.T
    # All stages of a component have the same row of `is_mutual`, which marks its stages.
    components = {tuple(np.flatnonzero(row).tolist()) for row in is_mutual}

    def num_reached(component: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
        # A block reaches more stages than any block on which it depends. Blocks that reach
        # equally many are ordered by the numbers of their own stages.
        return int(reaches[component[0]].sum()), component

    ordered = sorted(components, key=num_reached)
    return tuple(_as_block(component, depends, tableau) for component in ordered)


def _as_block(
    component: tuple[int, ...], depends: _Dependencies, tableau: FlatTableau
) -> Block:
    """The block of the stages in `component`, which depend on each other: as few unknown
    stages as possible, and explicit stages in an order in which they can be evaluated."""
    unknown_stages, rounds = _smallest_cut(component, depends)
    unknown = _groups(unknown_stages, tableau)
    if len(unknown) > 1:
        # The values of a group are stacked, and every other group that reads them would
        # unstack them again. So each unknown stage becomes a group of its own: an iteration
        # of five stages takes a third less time.
        unknown = tuple((i,) for group in unknown for i in group)
    explicit = [group for ready in rounds for group in _groups(ready, tableau)]
    return Block(unknown, tuple(explicit))


def _groups(stages: Sequence[int], tableau: FlatTableau) -> tuple[Group, ...]:
    """Divides these stages into groups that evaluate the same vector field."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    for i in stages:
        kind = tableau.stages[i].kind
        groups.setdefault(kind, []).append(i)
    return tuple(tuple(group) for group in groups.values())


def _smallest_cut(
    block: tuple[int, ...], depends: _Dependencies
) -> tuple[tuple[int, ...], list[list[int]]]:
    """The fewest stages of a block whose removal breaks all cycles of dependencies; and the
    rounds in which the other stages can then be evaluated, as from `_rounds`.

    All sets of stages are tried, the smallest first. If there are too many, all stages of
    the block are removed. This leads to the same solution, but more equations have to be
    solved than necessary.
    """
    for size in range(len(block)):
        if math.comb(len(block), size) > _MOST_CHOICES:
            break
        for unknown in itertools.combinations(block, size):
            rounds = _rounds([i for i in block if i not in unknown], depends)
            if rounds is not None:
                return unknown, rounds
    return block, []


def _rounds(stages: Sequence[int], depends: _Dependencies) -> list[list[int]] | None:
    """Divides these stages into rounds, so that no stage depends on a stage of its own or a
    later round. `None` if there is a cycle of dependencies."""
    rounds = []
    remaining = list(stages)
    while remaining:
        ready = [i for i in remaining if not depends[i, remaining].any()]
        if not ready:
            return None
        rounds.append(ready)
        remaining = [i for i in remaining if i not in ready]
    return rounds
