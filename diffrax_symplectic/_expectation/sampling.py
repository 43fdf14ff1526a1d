"""The interface between samplings and the loop over batches."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from .._custom_types import Devices
from .._simulation import Layout, Problem


# Deviations up to this many roundings of the mean count as rounding errors, since those of
# many operations add up: up to 2e-13 of the mean in double precision, 1e-4 in single.
ROUNDING = 1e3
# Samples have smaller numbers than this. Their keys are made of two words of 32 bits, of
# which the last values of the first word belong to trials.
MOST_SAMPLES = 2**63


class Averaged(NamedTuple):
    """What is averaged over samples: their values, and what else some samplings know of
    them. Each field is an array whose last axis is for all numbers of `phi`, or `None`
    if the sampling does not have it.

    - `value`: the value of a sample. The mean of the values is the estimate.
    - `heaviness`: for a replicate of many paths, the `r` of `Expectation.std_error` over
        these paths, which measures how heavy their tails are.
    - `largest`: for a replicate, the largest deviation of one of its paths from its mean.
    - `plain`: for a path with a control variate, its value without the control variate.
    - `control`: for a path with a control variate, the control variate, which is `plain`
        minus `value`.
    """

    # Arrays of JAX, or of NumPy on the host.
    value: Any
    heaviness: Any = None
    largest: Any = None
    plain: Any = None
    control: Any = None

    @property
    def fields(self) -> dict[str, Any]:
        """The fields that are not `None`."""
        return {name: x for name, x in self._asdict().items() if x is not None}

    @property
    def without_control(self) -> Any:
        """The values without a control variate."""
        return self.value if self.plain is None else self.plain


class Samples(eqx.Module):
    """Samples to average.

    - `averaged`: their values, with axes for combinations of levels, for samples and for
        all numbers of `phi`.
    - `good`: which samples count in the mean.
    - `num_failed`: how many paths failed in each sample, on each level.
    - `also_failed`: which samples have a path that failed, but is not counted; `None` if
        there are none.
    """

    averaged: Averaged
    good: Bool[Array, " n"]
    num_failed: Int[Array, "levels n"] | Bool[Array, "levels n"]
    also_failed: Bool[Array, " n"] | None = None


class Outputs(NamedTuple):
    """What the averaged numbers are, as fields of an `Expectation`.

    - `layout`: how the numbers make PyTrees like `phi`.
    - `levels`: the number of levels.
    - `dtype`: the dtype in which the numbers are computed.
    """

    layout: Layout
    levels: int
    dtype: str

    @staticmethod
    def of(problem: Problem) -> "Outputs":
        """The outputs that are the values of the `phi` of a problem."""
        levels = len(problem.levels.h)
        return Outputs(problem.layout, levels, str(problem.dtype_of_values))


class SamplingPlan(NamedTuple):
    """How samples are taken.

    - `sampler`: a callable PyTree that makes one sample for each of several random keys.
    - `outputs`: the numbers that are averaged.
    - `num_samples`: the most samples, including the samples of an estimate to continue.
    - `batch_size`: the number of samples that each device takes at once.
    - `paths_per_sample`: the number of paths in a sample, on each level.
    - `least_samples`: the fewest samples whose variance is estimated well enough to stop.
    - `least_beside_steps`: the fewest samples after which an estimate without a tolerance
        may end because its sampling error is a small part of the error of the steps; `None`
        if it always takes all samples.
    - `reason`: why this sampling was chosen, for the result.
    - `remainder`: the fraction of the standard error that a control variate leaves, by a
        trial; the largest over all numbers of `phi`.
    - `is_quick`: whether the samples take less time than compiling their program. The
        program is then compiled quickly, with slower code.
    - `simulate_paths`: for paths computed outside JAX, maps the number of the first sample
        and the number of samples to an argument that the sampler takes before the keys.
    - `with_halved_steps`: makes the plan with halved steps on all levels, whose samples
        have the same program; `None` if to make it would take long.
    """

    sampler: Callable[..., Samples]
    outputs: Outputs
    num_samples: int
    batch_size: int
    paths_per_sample: int = 1
    least_samples: int = 2
    least_beside_steps: int | None = None
    reason: str = ""
    remainder: float = 0.0
    is_quick: bool = False
    simulate_paths: Callable[[int, int], Any] | None = None
    with_halved_steps: Callable[[], "SamplingPlan"] | None = None


class AbstractSampling(eqx.Module):
    """How the samples of an expectation are taken. The public classes are subclasses."""

    @abc.abstractmethod
    def prepare(
        self, problem: Problem, key: PRNGKeyArray, devices: Devices
    ) -> SamplingPlan:
        """The plan for a problem. Trials for it draw from `key`. Raises a `ValueError` for
        a problem that this sampling cannot take."""


# The samplings whose estimates can be read from files, by the names of their classes.
SAVED_SAMPLINGS: dict[str, type[AbstractSampling]] = {}

_Sampling = TypeVar("_Sampling", bound=type[AbstractSampling])


def saved_by_name(sampling: _Sampling) -> _Sampling:
    """Decorates a sampling whose estimates can be read from files, where it is known by the
    name of its class."""
    SAVED_SAMPLINGS[sampling.__name__] = sampling
    return sampling
