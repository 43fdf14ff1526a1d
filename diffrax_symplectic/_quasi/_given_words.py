"""Paths whose random words are given, in the place of those of `terms`."""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, UInt32

from .._brownian import (
    AbstractStepwisePath,
    GivenPath,
    Increment,
    stepwise,
    THREE_POINT,
)
from .._terms import brownian_paths, replace_paths


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

    def given(path: diffrax.AbstractBrownianPath) -> GivenPath:
        start, end = next(slices)
        make = jtu.Partial(_from_words, path, words[start:end])
        return GivenPath(make=make, levy_area=path.levy_area)

    return replace_paths(terms, given)


def _from_words(path: AbstractStepwisePath, words, t0, t1, use_levy: bool) -> Increment:
    """The increment of the path that is made of the first of these words."""
    return path.increment(words[: path.num_words(use_levy)], t0, t1, use_levy)
