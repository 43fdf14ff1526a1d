"""What a way to take samples has to say."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PRNGKeyArray, PyTree


# Deviations of so many roundings of the mean are roundings of the paths.
ROUNDING = 1e3


class Samples(eqx.Module):
    """What is averaged, with axes in front for kinds, for combinations of the levels, and
    for samples; which samples are good; and how many paths each has lost.

    The first kind is the estimate. Of many paths a second one is how heavy their tails are,
    `r` of `Expectation.std_error`. Of paths less a control variate there are the plain
    path, the control, and what the path says of tails.
    """

    values: PyTree[Array]
    good: Bool[Array, " n"]
    lost: Int[Array, " n"] | Bool[Array, " n"]


class Plan(NamedTuple):
    """How samples are taken.

    - `sampler`: a PyTree that makes one sample for each of several random keys.
    - `num_samples`: how many at most, those of an estimate to go on from included.
    - `batch_size`: how many each device takes at once.
    - `paths`: how many paths a sample has, on each level.
    - `least`: fewer samples than this do not tell their spread well enough to stop.
    - `reason`: what the result says of how they were chosen.
    - `far`, `roundings`: as in an estimate.
    - `paths_of`: takes the number of the first sample, and how many there are, to what the
        sampler takes before the keys, if that is made by no program of JAX.
    """

    sampler: Callable[..., Samples]
    num_samples: int
    batch_size: int
    paths: int = 1
    least: int = 2
    reason: str = ""
    far: PyTree[np.ndarray] | None = None
    roundings: int = 1
    paths_of: Callable[[int, int], Any] | None = None


class AbstractSampling(eqx.Module):
    """How the samples of an expectation are taken, as users name it."""

    @abc.abstractmethod
    def prepare(self, problem: Any, key: PRNGKeyArray, devices: tuple) -> Plan:
        """Raises a `ValueError` for what it cannot do."""


def real(dtype) -> Any:
    """The type in which numbers of this one are averaged."""
    return jnp.result_type(dtype, float)
