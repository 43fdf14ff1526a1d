"""The plan of a step: which stages of a tableau to solve for or evaluate, and in which
order. It is made before tracing."""

import dataclasses
import functools as ft
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool

from .tableau import FlatTableau, Stage


# Coefficients are exact up to a few roundings of numbers of order one.
_TOLERANCE = 1e-14
# The smallest set of unknown stages of a block is found by trying all sets, up to a size
# with more than this many choices. Twelve stages are always searched exhaustively. No
# tableau of this package has a block with more than six, so the bound serves only to keep
# an unusual tableau from taking minutes.
_MOST_CHOICES = 1000


# Stages of one kind that can be evaluated together, by their numbers.
Group: TypeAlias = tuple[int, ...]
# Entry `i, j` says whether stage `i` depends on the value of stage `j`.
_Dependencies: TypeAlias = Bool[np.ndarray, "s s"]


class Block(NamedTuple):
    """Stages that depend on each other: a strongly connected component of the dependency
    graph.

    - `unknown`: the stages to solve for; none if the block is explicit.
    - `explicit`: the other stages, ordered so that each follows from the unknown stages and
        earlier ones.

    Both are in groups of stages that can be evaluated together.
    """

    unknown: tuple[Group, ...]
    explicit: tuple[Group, ...]


# Compared by identity, which is fast and enough: `make_plan` makes equal plans only once,
# unless more than its cache holds were made in between.
@dataclasses.dataclass(frozen=True, eq=False)
class StepPlan:
    """The distinct stages that a tableau uses, in blocks to be solved in order."""

    tableau: FlatTableau
    blocks: tuple[Block, ...]


def make_plan(tableau: FlatTableau) -> StepPlan:
    """The plan of a step: unused stages are dropped, equal ones merged, and the rest is
    ordered. Equal tableaus share one plan, the same object in every trace."""
    # A plan is static data of a traced step, so that a new object would be a new trace.
    # Arrays cannot be keys of a cache: the coefficients are passed as bytes.
    return _make_plan(
        tableau.stages,
        np.asarray(tableau.matrix, np.float64).tobytes(),
        np.asarray(tableau.weights, np.float64).tobytes(),
    )


# Solvers with free parameters have a tableau for each value of these, so that a search over
# parameters would fill an unbounded cache.
@ft.lru_cache(maxsize=1024)
def _make_plan(stages: tuple[Stage, ...], matrix: bytes, weights: bytes) -> StepPlan:
    """`make_plan` for the stages and the coefficients, as bytes, of a tableau."""
    num_stages = len(stages)
    tableau = FlatTableau(
        stages=stages,
        matrix=np.frombuffer(matrix, np.float64).reshape(num_stages, num_stages),
        weights=np.frombuffer(weights, np.float64),
    )
    # A coefficient counts as a dependency, also one of a value that a stage does not read.
    matrix_of_reads = np.where(tableau.reads_from, tableau.matrix, 0.0)
    tableau = dataclasses.replace(tableau, matrix=_snapped(matrix_of_reads))
    # Each of the three reductions can make more work for the others: stages may become
    # equal once others were dropped, and weights may cancel once stages were merged. So
    # they are repeated until no stage is lost.
    num_before = None
    while num_before is None or len(tableau.stages) < num_before:
        num_before = len(tableau.stages)
        tableau = _with_equal_stages_merged(tableau)
        tableau = _with_live_stages(tableau)
        # This comes last, since a stage whose weight cancels would keep others from being
        # merged.
        tableau = _with_channels_merged(tableau)
    return StepPlan(tableau, _blocks(tableau))


def _snapped(x: np.ndarray | np.floating) -> np.ndarray:
    """`x`, with numbers that are zero up to rounding set to zero: any other coefficient
    counts as a dependency."""
    return np.where(np.abs(x) < _TOLERANCE, 0.0, x)


def _equal(x: np.ndarray | float, y: np.ndarray | float) -> bool:
    """Whether coefficients are equal up to rounding."""
    return np.allclose(x, y, rtol=0, atol=_TOLERANCE)


def _with_live_stages(tableau: FlatTableau) -> FlatTableau:
    """The tableau with only the stages that the end of the step depends on."""
    depends = tableau.matrix != 0
    is_live = tableau.weights != 0
    # Each round adds the stages that live ones depend on. No chain of dependencies is
    # longer than the number of stages.
    for _ in tableau.stages:
        is_live = is_live | (is_live @ depends)
    return tableau.take(np.flatnonzero(is_live).tolist())


def _with_equal_stages_merged(tableau: FlatTableau) -> FlatTableau:
    """The tableau without stages that have the same value as another, because the same
    channels (the controls that drive them) drive both at the same time and state. Their
    coefficients are added."""

    def are_equal(i: int, j: int) -> bool:
        same_channels = tableau.stages[i].channels == tableau.stages[j].channels
        return same_channels and _same_evaluation(tableau, i, j)

    # Pairs are merged one at a time, since the merged stage may equal another.
    while pair := _first_pair(tableau, are_equal):
        i, j = pair
        matrix = tableau.matrix.copy()
        weights = tableau.weights.copy()
        # A sum that should vanish may not in floating point: 0.1 + 0.2 - 0.3 is not 0.
        matrix[:, i] = _snapped(matrix[:, i] + matrix[:, j])
        weights[i] = _snapped(weights[i] + weights[j])
        with_sums = dataclasses.replace(tableau, matrix=matrix, weights=weights)
        tableau = _without(with_sums, j)
    return tableau


def _with_channels_merged(tableau: FlatTableau) -> FlatTableau:
    """The tableau with one stage, with the channels of both, in place of two that are
    driven by different channels at the same time and state, and enter everything with the
    same coefficients: its value is the sum of both."""

    def can_be_summed(i: int, j: int) -> bool:
        return (
            tableau.stages[i].channels != tableau.stages[j].channels
            and _same_evaluation(tableau, i, j)
            and _equal(tableau.matrix[:, i], tableau.matrix[:, j])
            and _equal(tableau.weights[i], tableau.weights[j])
        )

    # Pairs are merged one at a time, since the merged stage may be merged with another.
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
    """The first pair of stages `i < j` with `may_be_merged(i, j)`, if there is one."""
    pairs = itertools.combinations(range(len(tableau.stages)), 2)
    return next((pair for pair in pairs if may_be_merged(*pair)), None)


def _same_evaluation(tableau: FlatTableau, i: int, j: int) -> bool:
    """Whether two stages evaluate their vector fields at the same time and state, for the
    same part of the state."""
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
    """The blocks of a step, the strongly connected components of the dependencies. Each
    comes after the blocks that it depends on."""
    num_stages = len(tableau.stages)
    depends = tableau.matrix != 0
    # Entry `i, j` says whether a chain of dependencies leads from stage `i` to stage `j`.
    # By Warshall's algorithm, all chains through the first stages up to `k` are known after
    # round `k`. Each stage reaches itself, so that an explicit stage is a component, too.
    reaches = depends | np.eye(num_stages, dtype=bool)
    for k in range(num_stages):
        reaches = reaches | (reaches[:, k, None] & reaches[k])
    is_mutual = reaches & reaches.T
    components = {tuple(np.flatnonzero(row).tolist()) for row in is_mutual}

    def rank(component: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
        # A block depends on fewer stages than any block that depends on it. Equal numbers
        # are ordered by the numbers of the stages.
        return int(reaches[component[0]].sum()), component

    ordered = sorted(components, key=rank)
    return tuple(_as_block(component, depends, tableau) for component in ordered)


def _as_block(
    component: tuple[int, ...], depends: _Dependencies, tableau: FlatTableau
) -> Block:
    """The block of the stages `component`, which depend on each other."""
    numbers, rounds = _smallest_cut(component, depends)
    unknown = _groups(numbers, tableau)
    if len(unknown) > 1:
        # Each group would unstack the values of the other groups again. Without stacking,
        # an iteration of five stages takes a third less time.
        unknown = tuple((i,) for group in unknown for i in group)
    explicit = [group for ready in rounds for group in _groups(ready, tableau)]
    return Block(unknown, tuple(explicit))


def _groups(stages: Sequence[int], tableau: FlatTableau) -> tuple[Group, ...]:
    """These stages in groups that evaluate the same vector field."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    for i in stages:
        kind = tableau.stages[i].kind
        groups.setdefault(kind, []).append(i)
    return tuple(tuple(group) for group in groups.values())


def _smallest_cut(
    block: tuple[int, ...], depends: _Dependencies
) -> tuple[tuple[int, ...], list[list[int]]]:
    """The fewest stages of a block whose removal breaks all cycles of dependencies, and the
    rounds in which the others can then be evaluated. If there are too many choices, all
    stages: these equations have the same solution, but more of them are solved."""
    for size in range(len(block)):
        if math.comb(len(block), size) > _MOST_CHOICES:
            break
        for unknown in itertools.combinations(block, size):
            rounds = _rounds([i for i in block if i not in unknown], depends)
            if rounds is not None:
                return unknown, rounds
    return block, []


def _rounds(stages: Sequence[int], depends: _Dependencies) -> list[list[int]] | None:
    """Stages in rounds, each of which depends on no stage of its own or a later round.
    `None` if they depend on each other in a cycle."""
    rounds = []
    remaining = list(stages)
    while remaining:
        ready = [i for i in remaining if not depends[i, remaining].any()]
        if not ready:
            return None
        rounds.append(ready)
        remaining = [i for i in remaining if i not in ready]
    return rounds
