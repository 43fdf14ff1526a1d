"""What is known of an expectation after so many randomizations, on so many levels."""

from collections.abc import Sequence

import equinox as eqx
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float, PyTree
from scipy.stats import t as student


_Host = PyTree[np.ndarray | np.floating]


class QuasiExpectation(eqx.Module):
    r"""An estimate of $\mathbb E[\phi]$, as [`diffrax_symplectic.quasi_expectation`][]
    returns. `mean`, `std_error` and `bias` have the structure of $\phi$; with `ts` their
    arrays have an axis in front, one place for each of them.

    - `mean`: the mean over the replicates, extrapolated to steps of size zero if there are
        two levels or more. NaN if all paths of a replicate failed.
    - `std_error`: its standard error, from the spread of the replicates.
    - `bias`: with two levels or more, by how much the last extrapolation has changed the
        mean. The error of discretization that is left is of a higher order in the step
        size, and smaller as a rule. With one level `None`.
    - `num_replicates`: how many replicates were made.
    - `num_failed`: how many of the paths failed, in all replicates and levels. They have
        no part in the rest from the step on in which they failed.
    - `tol_reached`: whether all standard errors are at most `tol`; `None` without `tol`.
    - `replicates`: the estimates whose mean is taken, along an axis in front.
    """

    mean: _Host
    std_error: _Host
    bias: _Host | None
    num_replicates: int
    num_failed: int
    tol_reached: bool | None
    replicates: _Host

    def interval(self, confidence: float = 0.95) -> tuple[_Host, _Host]:
        r"""The ends of an interval that covers the mean of infinitely many replicates with
        this probability: Student's $t$ with one degree of freedom less than there are
        replicates, times `std_error`, to either side of `mean`. (For 16 replicates and 95%
        that is 2.13 standard errors, for 4 it is 3.18.) What is left of the error of
        discretization is not part of it: see `bias`."""
        factor = student.ppf((1 + confidence) / 2, self.num_replicates - 1)
        side = lambda sign: jtu.tree_map(
            lambda m, s: m + sign * factor * s, self.mean, self.std_error
        )
        return side(-1), side(1)


def extrapolation_weights(order: int, levels: int) -> Float[np.ndarray, " levels"]:
    r"""The weights of the levels, with steps $h, h/2, h/4, \ldots$, in the sum that has no
    terms in $h^p, \ldots, h^{p + L - 2}$, for $L$ levels of a method of weak order $p$.

    [Talay and Tubaro (1990)](https://doi.org/10.1080/07362999008809220) show that the error
    has an expansion in powers of $h$.
    """
    powers = np.array([0, *range(order, order + levels - 1)])
    system = 2.0 ** -np.outer(powers, np.arange(levels))
    return np.linalg.solve(system, np.eye(levels)[0])


def estimate(
    values: Sequence[Sequence[_Host]],
    num_failed: int,
    order: int,
    tol: float | None,
) -> QuasiExpectation:
    """From the means of each level of each replicate."""
    levels = len(values[0])
    weights = extrapolation_weights(order, levels)

    def combined(weights):
        weighted = lambda *xs: sum(
            w * np.asarray(x, float) for w, x in zip(weights, xs)
        )
        each = [jtu.tree_map(weighted, *levels) for levels in values]
        return jtu.tree_map(lambda *xs: np.stack(xs), *each)

    average = lambda tree: jtu.tree_map(lambda x: np.mean(x, axis=0), tree)
    replicates = combined(weights)
    error = lambda x: np.std(x, axis=0, ddof=1) / np.sqrt(len(x))
    std_error = jtu.tree_map(error, replicates)
    bias = None
    if levels > 1:
        # The finer levels alone, with one power of the step size less.
        before = [0.0, *extrapolation_weights(order, levels - 1)]
        bias = jtu.tree_map(np.abs, average(combined(weights - before)))
    reached = None
    if tol is not None:
        reached = all(bool(np.all(x <= tol)) for x in jtu.tree_leaves(std_error))
    return QuasiExpectation(
        mean=average(replicates),
        std_error=std_error,
        bias=bias,
        num_replicates=len(values),
        num_failed=num_failed,
        tol_reached=reached,
        replicates=replicates,
    )
