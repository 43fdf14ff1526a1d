"""Paths whose random words are given, in the place of those of `terms`."""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, UInt32

from .._brownian import AbstractStepwisePath, stepwise, THREE_POINT
from .._terms import brownian_paths


class _GivenWords(AbstractStepwisePath):
    """The path, but each of its steps is made of the same, given words."""

    path: AbstractStepwisePath
    words: UInt32[Array, " num_words"]

    @property
    def t0(self):
        return self.path.t0

    @property
    def t1(self):
        return self.path.t1

    @property
    def levy_area(self):
        return self.path.levy_area

    @property
    def laws(self):
        return self.path.laws

    def num_words(self, use_levy: bool = False) -> int:
        return self.path.num_words(use_levy)

    def increment(self, words, t0, t1, use_levy=False):
        return self.path.increment(words, t0, t1, use_levy)

    def draw(self, t0, t1, use_levy):
        words = self.words[: self.num_words(use_levy)]
        return self.increment(words, t0, t1, use_levy)


class Layout(NamedTuple):
    """Which of the words of a step each path in `terms` takes, how many there are, and
    whether there is but one three-point variable."""

    slices: tuple[tuple[int, int], ...]
    num_words: int
    sixths: bool


def layout(terms: PyTree[diffrax.AbstractTerm]) -> Layout:
    """Equal paths are one Brownian motion, and take the same words. Raises a `ValueError`
    for a path whose increments cannot be made of given words."""
    paths = [stepwise(path) for path in brownian_paths(terms)]
    slices, end = [], 0
    for i, path in enumerate(paths):
        same = [j for j in range(i) if eqx.tree_equal(paths[j], path)]
        start = slices[same[0]][0] if same else end
        slices.append((start, start + path.num_words(use_levy=True)))
        end = max(end, slices[-1][1])
    sixths = end == 1 and paths[0].laws == {"W": THREE_POINT}
    return Layout(tuple(slices), end, sixths)


def with_words(
    terms: PyTree[diffrax.AbstractTerm],
    layout: Layout,
    words: UInt32[Array, " num_words"],
) -> PyTree[diffrax.AbstractTerm]:
    """The terms, with paths whose increments are made of these words."""
    slices = iter(layout.slices)
    is_path = lambda x: isinstance(x, diffrax.AbstractBrownianPath)

    def replaced(x):
        if not is_path(x):
            return x
        start, end = next(slices)
        return _GivenWords(x, words[start:end])  # pyright: ignore[reportCallIssue]

    return jtu.tree_map(replaced, terms, is_leaf=is_path)
