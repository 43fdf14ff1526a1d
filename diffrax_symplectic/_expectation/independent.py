"""Independent paths: crude Monte Carlo."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from .._arguments import check_memory, whole_number
from .._custom_types import Devices
from .._simulation import as_vectors, combinations, Problem, values_of_paths
from .sampling import (
    AbstractSampling,
    Averaged,
    Outputs,
    Samples,
    SamplingPlan,
    saved_by_name,
)


# The default sizes of a batch. On CPUs this size keeps all cores busy and fits their
# caches. Elsewhere it takes more paths at once to keep a device busy.
_BATCH_ON_CPU = 2**15
_BATCH_ELSEWHERE = 2**18


@saved_by_name
class IndependentPaths(AbstractSampling):
    """Independent paths (crude Monte Carlo). For any system the error is proportional to
    one over the square root of their number.

    With several levels, each path uses the same Brownian motion on all of them if `terms`
    have a [`diffrax_symplectic.FixedStepBrownianPath`][] with `cell=`. Then the `bias` is
    estimated much more accurately than the mean.

    **Arguments:**

    - `num_paths`: the number of paths, at least two; with `tol` an upper limit.
    - `batch_size`: the number of paths that each device solves at once. By default 32,768
        on CPUs (for a state of a few components this keeps all cores busy and fits their
        caches) and 262,144 elsewhere. Choose less for large states, or to share few paths
        among several devices: the size of a batch does not depend on their number.
    """

    num_paths: int = eqx.field(converter=lambda x: whole_number("num_paths", x, 2))
    batch_size: int | np.integer | None = None

    def prepare(self, problem, key, devices):
        return self.plan(
            jtu.Partial(_samples_of_independent_paths, problem),
            Outputs.of(problem),
            devices,
            problem.bytes_of_state,
        )

    def plan(
        self,
        sampler: Callable[..., Samples],
        outputs: Outputs,
        devices: Devices,
        bytes_of_path: int,
    ) -> SamplingPlan:
        """The plan for any `sampler`, a function that makes a sample for each key.
        `bytes_of_path` is the least memory that a path takes."""
        if self.batch_size is None:
            size = _BATCH_ON_CPU if devices[0].platform == "cpu" else _BATCH_ELSEWHERE
        else:
            size = whole_number("batch_size", self.batch_size)
            check_memory("batch_size", size, bytes_of_path, devices[0])
        return SamplingPlan(
            sampler, outputs, num_samples=self.num_paths, batch_size=size
        )


def _samples_of_independent_paths(problem: Problem, keys: Key[Array, " n"]) -> Samples:
    """A sample is a path, with the same random key on all levels."""
    # (levels, S, n, m) and (levels, n)
    values, failed = values_of_paths(problem, keys)
    return samples_of_paths(problem.weights, as_vectors(values), failed)


def samples_of_paths(
    weights: Float[Array | np.ndarray, "combinations levels"],
    values: Float[Array, "levels n numbers"],
    failed: Bool[Array, "levels n"],
) -> Samples:
    """The samples of independent paths, from the values of the paths on all levels, and
    which of the paths failed. Each sample is combined from the levels with these weights.
    """
    # Of shape (combinations, n, numbers). What is `Averaged` is averaged over the samples.
    averaged = Averaged(combinations(weights, values))
    return Samples(averaged, good=~jnp.any(failed, axis=0), num_failed=failed)
