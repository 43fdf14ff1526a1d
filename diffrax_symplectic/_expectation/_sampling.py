"""The ways to take samples, as users name them."""

import abc
import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PRNGKeyArray, PyTree

from .._arguments import check_takes, whole_number
from .._custom_types import Y
from ._array_rqmc import ArrayRQMCSampler, coordinates, points_for
from ._batches import first_spread, Plan
from ._fits import MOST_POLYNOMIALS, num_pilots
from ._noise import noise_of
from ._polynomials import num_polynomials
from ._steps import AbstractSampler, IndependentPathsSampler, Problem
from ._value_functions import is_quadratic, value_functions


# Fewer replicates say too little about their spread to stop because of it.
_BEFORE_STOPPING = 8
# Bytes that a fit may take.
_MOST_MEMORY = 4 * 2**30


class Prepared(NamedTuple):
    """A sampler, how many samples it is to take, and what the result says about it."""

    sampler: AbstractSampler
    plan: Plan
    reason: str = ""


class AbstractSampling(eqx.Module):
    """How the samples of an expectation are taken."""

    @abc.abstractmethod
    def prepare(
        self, problem: Problem, weights: np.ndarray, key: PRNGKeyArray, devices: tuple
    ) -> Prepared:
        """Raises a `ValueError` for what it cannot do."""


class IndependentPaths(AbstractSampling):
    """Independent paths. Their error falls as one over the root of their number, whatever
    the system.

    With several levels a path takes the same Brownian motion on each of them if the path in
    `terms` says so: a [`diffrax_symplectic.FixedStepBrownianPath`][] with `cell=`. Then the
    `bias` is known much better than the mean.

    **Arguments:**

    - `num_paths`: how many paths; with `tol` at most.
    - `batch_size`: how many paths each device takes at once. By default 32,768 on CPUs
        (for a state of a few numbers, enough for all cores and little for their caches)
        and 262,144 elsewhere. Take less for large states.
    """

    num_paths: int = eqx.field(converter=lambda x: whole_number("num_paths", x))
    batch_size: int | None = None

    def prepare(self, problem, weights, key, devices):
        plan = Plan(self.num_paths, batch_size_of(self.batch_size, devices))
        return Prepared(IndependentPathsSampler(problem, weights), plan)


class ArrayRQMC(AbstractSampling):
    r"""Paths that balance each other, by randomized quasi-Monte Carlo.

    All paths of a replicate take a step together. Before it they are sorted, so that
    neighbours in the state space are neighbours along Hilbert's curve. Path number $j$ in
    this order takes the $j$-th of a scrambled set of Sobol' points, the coordinates of
    which become the random variables of the step, one each. So neighbours take values that
    balance each other, and what the paths have in common cancels. Each path by itself has
    its law exactly, and the estimate has no bias but that of the solver.

    The error falls faster than one over the root of the number of paths, in few dimensions
    much faster: for up to four numbers in the state (or in `sort_by`) and $\phi$ smooth,
    one replicate is worth hundreds to thousands of times as many independent paths. For
    large systems that the noise moves far it is worth tens of times as many, in chaos
    after long times no less than as many, and what is spent on sorting is lost.

    **Arguments:**

    - `num_paths`: of each replicate; a power of two.
    - `replicates`: independent randomizations; with `tol` at most, and 8 at least. Each
        device takes one at a time: memory does not grow with their number.
    - `sort_by`: takes the state to a PyTree of those real numbers that paths are sorted
        by, as few of them as distinguish the states that matter; by default the state
        itself.

    **Source:** [L'Ecuyer, Lécot and Tuffin
    (2008)](https://doi.org/10.1287/opre.1080.0556).
    """

    num_paths: int = eqx.field(
        default=2**14, converter=lambda x: _power_of_two("num_paths", x)
    )
    replicates: int = eqx.field(
        default=16, converter=lambda x: whole_number("replicates", x, 2)
    )
    sort_by: Callable[[Y], PyTree[ArrayLike]] | None = None

    def prepare(self, problem, weights, key, devices):
        layout, points = points_for(problem.terms, self.num_paths)
        sort_by = _state if self.sort_by is None else self.sort_by
        _check_sorted(sort_by, problem.y0, self.num_paths)
        sampler = ArrayRQMCSampler(
            problem, weights, sort_by, jnp.asarray(points), layout
        )
        plan = Plan(self.replicates, 1, self.num_paths, _BEFORE_STOPPING)
        return Prepared(sampler, plan)


class ValueFunctions(AbstractSampling):
    r"""Independent paths, less most of what is random in them.

    The random variables of a weak method take finitely many values in a step. So the mean
    over a step is a finite sum, and for any function $u_n$ of the state
    $\sum_n u_{n+1}(y_{n+1}) - \mathbb E[u_{n+1}(y_{n+1}) \mid y_n]$ has mean zero exactly.
    Subtracted from $\phi$, it leaves nothing random if $u_n(y) = \mathbb E[\phi(y_N) \mid
    y_n = y]$. Polynomials are fitted to these functions, backwards in time from the states
    of a short pilot. How well they fit decides the standard error, and nothing else: the
    estimate has no bias but that of the solver.

    In a few dimensions and for times in which the noise has not spread the paths all over,
    standard errors are $10^{-4}$ to $10^{-7}$ of those of as many independent paths. It
    gains little in chaos, after long times, and for functions with kinks.

    For more than 100 outcomes of a step (five noises or more) the variables with mean zero
    come from first and second derivatives by the noise. In more than 14 dimensions the
    functions are quadratic, by the mean of their derivatives.

    **Arguments:**

    - `degree`: the total degree of the polynomials. By default the best of 0 (which is
        plain), 2, 4, ..., chosen by fresh paths for each number of $\phi$: up to 8, and
        130 polynomials.
    - `num_paths`: how many paths are averaged; with `tol` at most.
    - `batch_size`: how many of them each device takes at once.

    **Source:** the regression-based control variates of [Belomestny and others
    (2015)](https://doi.org/10.48550/arXiv.1510.03141), for weak schemes of [Belomestny,
    Häfner and Urusov (2016)](https://doi.org/10.48550/arXiv.1612.05255).
    """

    degree: int | None = None
    num_paths: int = eqx.field(
        default=4096, converter=lambda x: whole_number("num_paths", x)
    )
    batch_size: int = eqx.field(
        default=512, converter=lambda x: whole_number("batch_size", x)
    )

    def prepare(self, problem, weights, key, devices):
        noise_of(problem, problem.level(0))
        degrees = self._degrees(problem)
        size = self.batch_size
        spread = lambda sampler, key: first_spread(sampler, key, devices, size)
        sampler, best = value_functions(problem, weights, key, degrees, spread)
        reason = ""
        if len(degrees) > 1:
            chosen = ", ".join(map(str, np.unique(best)))
            among = ", ".join(map(str, degrees))
            reason = f"degree {chosen} was the best of {among}"
        return Prepared(sampler, Plan(self.num_paths, size), reason)

    def _degrees(self, problem: Problem) -> tuple[int, ...]:
        d = jfu.ravel_pytree(problem.y0)[0].size
        if self.degree is None:
            if is_quadratic(d, (2,)):
                return 0, 1, 2
            few = [k for k in range(9) if num_polynomials(d, k) <= MOST_POLYNOMIALS]
            return (*(k for k in few[:-1] if k % 2 == 0), few[-1])
        degree = whole_number("degree", self.degree, 0)
        count = num_polynomials(d, degree)
        columns = (
            sum(s.size for s in problem.outputs()) * problem.levels.saved_steps.shape[1]
        )
        size = jnp.finfo(jnp.result_type(*jtu.tree_leaves(problem.y0))).bits // 8
        need = size * count * (num_pilots(d, degree) + problem.max_steps * columns)
        if need > _MOST_MEMORY and not is_quadratic(d, (degree,)):
            raise ValueError(
                f"`degree={degree}` has {count:,} polynomials in {d} dimensions, the fit "
                f"of which needs {need / 2**30:,.0f} GiB. Pass a smaller `degree`."
            )
        return (degree,)


def batch_size_of(batch_size: int | np.integer | None, devices: tuple) -> int:
    if batch_size is None:
        return 32768 if devices[0].platform == "cpu" else 262144
    return whole_number("batch_size", batch_size)


def _state(y: Y) -> Y:
    return y


def _power_of_two(name: str, value) -> int:
    whole = whole_number(name, value, 2)
    if whole & (whole - 1):
        raise ValueError(
            f"`{name}` must be a power of two, of which Sobol' points are balanced; got "
            f"{whole}. Pass {2 ** (whole.bit_length() - 1)} or {2 ** whole.bit_length()}."
        )
    return whole


def check_real(name: str, leaves: list) -> None:
    kinds = jnp.floating, jnp.integer, jnp.bool_
    is_real = lambda s: any(jnp.issubdtype(jnp.result_type(s), k) for k in kinds)
    if len(leaves) == 0 or not all(map(is_real, leaves)):
        raise ValueError(
            f"`{name}` must return real arrays; got dtypes "
            f"{[str(jnp.result_type(s)) for s in leaves]}. Return real and imaginary parts."
        )


def _check_sorted(sort_by, y0, num_paths: int) -> None:
    check_takes("sort_by", sort_by, "y")
    batch = jtu.tree_map(lambda x: x[None], y0)
    by = eqx.filter_eval_shape(lambda y: jtu.tree_leaves(jax.vmap(sort_by)(y)), batch)
    check_real("sort_by", by)
    dimension = jax.eval_shape(lambda y: coordinates(sort_by, y), batch).shape[1]
    # How many of the paths, sorted, there are along each coordinate.
    each = num_paths ** (1 / dimension)
    if each < 3:
        warnings.warn(
            f"{num_paths:,} paths are sorted by {dimension} coordinates, so that there are "
            f"{each:.1f} along each of them: neighbours are far apart, and `ArrayRQMC` "
            "gains little over `IndependentPaths`. Pass `sort_by` with the few coordinates "
            f"that matter most, {int(math.log(num_paths, 3))} at most.",
            stacklevel=4,
        )
