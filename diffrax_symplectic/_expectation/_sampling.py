"""What a way to take samples has to say."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree


class Tails(eqx.Module):
    """What the mean absolute deviation from `promised` is made of that lies `beyond` some
    deviation, if a sample weighs as much as its `ratio` says. The arrays have an axis for
    levels and one of length 1 in front, one for combinations of the levels, and one for
    samples."""

    promised: PyTree[Array]
    beyond: PyTree[Array]
    ratio: Float[Array, " n"]


class Samples(eqx.Module):
    """What is averaged, with axes in front for levels and samples: values on each level,
    and which combinations of the levels to take; which of them are good; and how many
    paths each has lost. With a control variate, this, and what to look for in tails."""

    values: PyTree[Array]
    weights: Float[Array | np.ndarray, "combinations levels"]
    good: Bool[Array, "levels n"]
    lost: Int[Array, "levels n"] | None = None
    control: PyTree[Array] | None = None
    tails: Tails | None = None
    # Or how much of the spread the largest of many paths makes up for.
    heaviest: PyTree[Array] | None = None


class Plan(NamedTuple):
    """How samples are taken.

    - `sampler`: a PyTree that makes one sample for each of several random keys.
    - `num_samples`: how many at most, those of an estimate to go on from included.
    - `batch_size`: how many each device takes at once.
    - `paths`: how many paths a sample has, on each level.
    - `least`: fewer samples than this do not tell their spread well enough to stop.
    - `reason`: what the result says of how they were chosen.
    - `far`, `roundings`: as in an estimate.
    """

    sampler: Callable[[PRNGKeyArray], Samples]
    num_samples: int
    batch_size: int
    paths: int = 1
    least: int = 2
    reason: str = ""
    far: PyTree[np.ndarray] | None = None
    roundings: int = 1


class AbstractSampling(eqx.Module):
    """How the samples of an expectation are taken, as users name it."""

    @abc.abstractmethod
    def prepare(self, problem: Any, key: PRNGKeyArray, devices: tuple) -> Plan:
        """Raises a `ValueError` for what it cannot do."""
