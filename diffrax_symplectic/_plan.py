"""From a tableau to the work of one step, decided before anything is traced."""

import dataclasses
import functools as ft
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from ._tableau import FlatTableau, Stage


# Coefficients are exact up to a few roundings of order-one numbers.
_TOLERANCE = 1e-14
# The fewest unknown stages of a block are found by trying all sets, up to a size of which
# there are more than this.
_MOST_CHOICES = 1000


# Stages of one kind that can be evaluated together.
Group: TypeAlias = tuple[int, ...]


class Block(NamedTuple):
    """Stages that depend on each other: a strongly connected component of the graph of
    dependencies.

    - `unknown`: the stages that are solved for; none if the block is explicit.
    - `explicit`: the other stages, in an order in which each follows from the unknown ones
        and the earlier ones.

    Both in groups of stages that can be evaluated together.
    """

    unknown: tuple[Group, ...]
    explicit: tuple[Group, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """The stages of a tableau that are used, without repetitions, in blocks that are solved
    one after another."""

    tableau: FlatTableau
    blocks: tuple[Block, ...]

    @property
    def num_unknown(self) -> int:
        """Stage vectors that are solved for in one step."""
        return sum(len(group) for block in self.blocks for group in block.unknown)


def make_plan(tableau: FlatTableau) -> Plan:
    """Drops unused stages, evaluates equal ones once, and orders the rest. Equal tableaus
    have one plan, the same object in every trace."""
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
    # A stage does not depend on values that it does not read.
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

    With the same channels they have the same value: their coefficients add up. With
    different channels they can still be one stage if they always enter together.
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
        # One pair at a time: the merged stage may now equal another.
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
            # Stages of other kinds would take stacked values apart again: an iteration of
            # five stages takes a third less time without stacking.
            groups = tuple((i,) for group in groups for i in group)
        blocks.append(Block(groups, tuple(explicit)))
    return tuple(blocks)


def _groups(stages: Sequence[int], tableau: FlatTableau) -> tuple[Group, ...]:
    """Groups the stages that evaluate the same vector field."""
    groups: dict[tuple, list[int]] = {}
    for i in stages:
        groups.setdefault(tableau.stages[i].kind, []).append(i)
    return tuple(map(tuple, groups.values()))


def _cut(
    block: tuple[int, ...], depends: np.ndarray
) -> tuple[tuple[int, ...], list[list[int]]]:
    """Stages without which no cycle of dependencies is left, and the rounds in which the
    other stages can then be evaluated. As few as possible, unless there are many choices.
    """
    for size in range(len(block) + 1):
        if math.comb(len(block), size) > _MOST_CHOICES:
            break
        for unknown in itertools.combinations(block, size):
            rounds = _rounds([i for i in block if i not in unknown], depends)
            if rounds is not None:
                return unknown, rounds
    # Make stage after stage explicit unless that closes a cycle, fewest neighbours first.
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
