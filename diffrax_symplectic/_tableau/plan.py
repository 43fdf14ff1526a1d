"""The plan of a step: which stages of a tableau to solve for or evaluate, and in which
order. It is made before tracing."""

import dataclasses
import functools as ft
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from .tableau import FlatTableau, Stage


# Coefficients are exact up to a few roundings of numbers of order one.
_TOLERANCE = 1e-14
# The smallest set of unknown stages of a block is found by trying all sets, up to a size
# with more than this many choices.
_MOST_CHOICES = 1000


# Stages of one kind that can be evaluated together.
Group: TypeAlias = tuple[int, ...]


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


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """The distinct stages that a tableau uses, in blocks to be solved in order."""

    tableau: FlatTableau
    blocks: tuple[Block, ...]

    @property
    def num_unknown(self) -> int:
        """The number of stage vectors to solve for in one step."""
        return sum(len(group) for block in self.blocks for group in block.unknown)


def make_plan(tableau: FlatTableau) -> Plan:
    """Drops unused stages, merges equal ones, and orders the rest. Equal tableaus share one
    plan, the same object in every trace."""
    as_bytes = lambda x: np.asarray(x, np.float64).tobytes()
    return _make_plan(
        tableau.stages, as_bytes(tableau.matrix), as_bytes(tableau.weights)
    )


@ft.lru_cache(maxsize=1024)
def _make_plan(stages: tuple[Stage, ...], matrix: bytes, weights: bytes) -> Plan:
    read = lambda data: np.frombuffer(data, np.float64)
    s = len(stages)
    tableau = FlatTableau(stages, read(matrix).reshape(s, s), read(weights))
    previous = None
    # Ignore coefficients of values that a stage does not read.
    masked = np.where(tableau.reads, tableau.matrix, 0.0)
    tableau = dataclasses.replace(tableau, matrix=_snap(masked))
    while previous is None or len(tableau.stages) < len(previous.stages):
        previous = tableau
        tableau = _merge(tableau, same_channels=True)
        tableau = _live(tableau)
        tableau = _merge(tableau, same_channels=False)
    return Plan(tableau, _blocks(tableau))


def _snap(x: np.ndarray | np.floating) -> np.ndarray:
    return np.where(np.abs(x) < _TOLERANCE, 0.0, x)


def _live(tableau: FlatTableau) -> FlatTableau:
    """Keeps the stages that the end of the step depends on."""
    live = tableau.weights != 0
    for _ in tableau.stages:
        live = live | (live @ (tableau.matrix != 0))
    return tableau.take(np.flatnonzero(live).tolist())


def _merge(tableau: FlatTableau, same_channels: bool) -> FlatTableau:
    """Merges pairs of stages that are evaluated at the same point.

    With the same channels they have the same value, and their coefficients are added. With
    different channels they can be merged if they always enter together.
    """
    stages, matrix, weights = tableau.stages, tableau.matrix, tableau.weights
    for i, j in itertools.combinations(range(len(stages)), 2):
        a, b = stages[i], stages[j]
        same_point = (
            (a.reads, a.writes) == (b.reads, b.writes)
            and np.isclose(a.c, b.c, rtol=0, atol=_TOLERANCE)
            and np.allclose(matrix[i], matrix[j], rtol=0, atol=_TOLERANCE)
        )
        if not same_point or (a.channels == b.channels) != same_channels:
            continue
        if same_channels:
            matrix, weights = matrix.copy(), weights.copy()
            matrix[:, i] = _snap(matrix[:, i] + matrix[:, j])
            weights[i] = _snap(weights[i] + weights[j])
            merged = a
        else:
            same_use = np.allclose(
                np.append(matrix[:, i], weights[i]),
                np.append(matrix[:, j], weights[j]),
                rtol=0,
                atol=_TOLERANCE,
            )
            if not same_use:
                continue
            merged = a._replace(channels=a.channels + b.channels)
        stages = stages[:i] + (merged,) + stages[i + 1 :]
        keep = [k for k in range(len(stages)) if k != j]
        # Merge one pair at a time: the merged stage may equal another.
        return _merge(FlatTableau(stages, matrix, weights).take(keep), same_channels)
    return tableau


def _blocks(tableau: FlatTableau) -> tuple[Block, ...]:
    """Strongly connected components of the dependencies, dependencies first."""
    n = len(tableau.stages)
    depends = tableau.matrix != 0
    reach = depends
    for k in range(n):
        reach = reach | (reach[:, k, None] & reach[k])
    closed = reach | np.eye(n, dtype=bool)
    mutual = closed & closed.T
    components = {tuple(np.flatnonzero(row).tolist()) for row in mutual}
    # A block depends on fewer stages than any block that depends on it.
    ordered = sorted(components, key=lambda block: (closed[block[0]].sum(), block))
    blocks = []
    for component in ordered:
        unknown, rounds = _cut(component, depends)
        explicit = [group for ready in rounds for group in _groups(ready, tableau)]
        groups = _groups(unknown, tableau)
        if len(groups) > 1:
            # Stages of other kinds would unstack the values again: without stacking, an
            # iteration of five stages takes a third less time.
            groups = tuple((i,) for group in groups for i in group)
        blocks.append(Block(groups, tuple(explicit)))
    return tuple(blocks)


def _groups(stages: Sequence[int], tableau: FlatTableau) -> tuple[Group, ...]:
    """Groups stages that evaluate the same vector field."""
    groups: dict[tuple, list[int]] = {}
    for i in stages:
        groups.setdefault(tableau.stages[i].kind, []).append(i)
    return tuple(map(tuple, groups.values()))


def _cut(
    block: tuple[int, ...], depends: np.ndarray
) -> tuple[tuple[int, ...], list[list[int]]]:
    """Stages whose removal breaks all dependency cycles, and the rounds in which the other
    stages can then be evaluated. As few as possible, unless there are many choices."""
    for size in range(len(block) + 1):
        if math.comb(len(block), size) > _MOST_CHOICES:
            break
        for unknown in itertools.combinations(block, size):
            rounds = _rounds([i for i in block if i not in unknown], depends)
            if rounds is not None:
                return unknown, rounds
    # Make stages explicit unless that closes a cycle, fewest neighbours first.
    links = depends | depends.T
    explicit, rounds = [], []
    for i in sorted(block, key=lambda i: links[i, list(block)].sum()):
        new = _rounds(sorted([*explicit, i]), depends)
        if new is not None:
            explicit, rounds = [*explicit, i], new
    return tuple(i for i in block if i not in explicit), rounds


def _rounds(stages: list[int], depends: np.ndarray) -> list[list[int]] | None:
    rounds = []
    rest = list(stages)
    while rest:
        ready = [i for i in rest if not depends[i, rest].any()]
        if not ready:
            return None
        rounds.append(ready)
        rest = [i for i in rest if i not in ready]
    return rounds
