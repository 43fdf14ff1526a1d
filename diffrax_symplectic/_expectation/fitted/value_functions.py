"""Independent paths with control variates from fitted value functions.

The value function $u_n(y)$ approximates $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. In each
step, $u_{n+1}$ minus its expectation over the step's random variables has mean zero for any
$u$. For the exact $u$ the sum of these differences is $\\phi(y_N)$ minus its mean.
"""

import dataclasses
import functools as ft
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..._arguments import check_memory, check_untraced, whole_number
from ..._lapack import lapack_in_turn
from ..._programs import compiled
from ..._simulation import Combination, Problem
from ..._solver import without_newton
from ..estimate import combined_results, Expectation
from ..run import run
from ..sampling import (
    AbstractSampling,
    Outputs,
    ROUNDING,
    SamplingPlan,
    saved_by_name,
)
from .bases import AbstractBasis
from .basis_choice import chosen_basis, warn_of_long_fit
from .controlled_paths import controlled_paths
from .fits import Choice, fit, FittedFunctions
from .mixture import Mixture
from .noise import Noise


# Folded into the key of a call to draw trials. (Numbers of levels, which are folded into it
# to draw fits, are smaller.)
_TRIAL_KEY = 0xFFFFFFFE
# From the code that calls `expectation` to `prepare`, counted as for `warnings.warn`.
_FRAMES_TO_USER = 6


@saved_by_name
class ValueFunctions(AbstractSampling):
    r"""Independent paths with a control variate that removes most of their variance.

    The random variables of a weak method take finitely many values in a step, so the mean
    over a step is a finite sum. For any functions $u_n$ of the state, the control variate
    $\sum_n u_{n+1}(y_{n+1}) - \mathbb E[u_{n+1}(y_{n+1}) \mid y_n]$ therefore has mean zero
    exactly. Subtracting it from $\phi$ removes all of the variance if $u_n(y) = \mathbb
    E[\phi(y_N) \mid y_n = y]$. These value functions are fitted backwards in time, at the
    states of a short pilot run. The quality of the fit affects only the standard error: the
    only bias of the estimate is the solver's.

    In one or two dimensions the fit is a polynomial of degree 4 or less plus a correction
    on a grid. In up to 14 dimensions it is a polynomial, and in more it is quadratic, from
    averaged derivatives. If a step has more than 100 outcomes (five noises or more), the
    control variate is built from first and second derivatives along the noise.

    Half of the paths draw wider noise, or for one or two noises such as pushes to one side,
    and are weighted by their likelihood ratios. So rare paths, where a fit may be poor, are
    a part of the estimate and of its standard error. (Where paths fail, or no fit is used,
    all paths draw the noise as it is.)

    In a few dimensions, standard errors are $10^{-4}$ to $10^{-8}$ times those of as many
    independent paths, if $\phi$ is smooth and times are [not too
    long](expectation.md#where-valuefunctions-gains).

    **Arguments:**

    - `degree`: the total degree of the polynomials; degree 0 disables the control variate.
        By default the best of the fits above is chosen for each component of $\phi$, or
        none, by trials with fresh paths; polynomials have degree 8 at most and 130 terms at
        most. Fits that would take long are made coarser.
    - `num_paths`: the number of paths to average; with `tol` an upper limit.
    - `batch_size`: the number of paths that each device solves at once.

    **Source:** the regression-based control variates of [Belomestny and others
    (2015)](https://doi.org/10.48550/arXiv.1510.03141), for weak schemes of [Belomestny,
    Häfner and Urusov (2016)](https://doi.org/10.48550/arXiv.1612.05255); the defensive
    mixture of [Hesterberg (1995)](https://doi.org/10.1080/00401706.1995.10484303).
    """

    degree: int | None = None
    num_paths: int = eqx.field(
        default=4096, converter=lambda x: whole_number("num_paths", x, 2)
    )
    batch_size: int = eqx.field(
        default=512, converter=lambda x: whole_number("batch_size", x)
    )

    def prepare(self, problem, key, devices):
        check_memory("batch_size", self.batch_size, problem.bytes_of_state, devices[0])
        chosen = chosen_basis(problem, self.degree)
        warn_of_long_fit(chosen, stacklevel=_FRAMES_TO_USER)
        basis = chosen.basis
        outputs = Outputs.of(problem)
        functions = _fits(problem, key, basis, range(len(problem.levels.h)))
        mixture = Mixture.of(problem)

        def plan_for(
            choice: Choice, mixture: Mixture, num_samples: int
        ) -> SamplingPlan:
            # A `Partial` is a PyTree: a program is compiled once for all arrays in it.
            sampler = jtu.Partial(controlled_paths, problem, functions, choice, mixture)
            return SamplingPlan(
                sampler,
                outputs,
                num_samples=num_samples,
                batch_size=self.batch_size,
                # These few paths take less time than compiling their program.
                is_quick=True,
            )

        # One trial for each candidate, on the same paths, which are not part of the
        # estimate.
        key_of_trials = jr.fold_in(key, _TRIAL_KEY)
        trials_of_candidates = []
        for candidate in range(len(basis.candidates)):
            same_for_all = Choice.of_all(candidate, problem.output_shape)
            plan = plan_for(same_for_all, mixture, self.batch_size)
            trials_of_candidates.append(run(plan, key_of_trials, devices))
        comparison = _comparison(trials_of_candidates, problem.output_shape)
        choice = comparison.choice
        if self.degree == 0:
            choice = choice._replace(used=np.zeros_like(choice.used))
        if self.degree and not np.any(choice.used):
            warnings.warn(
                f"`degree={self.degree}` is no better than no control variate, so none is "
                "used. Pass another `degree`, or another `sampling`.",
                stacklevel=_FRAMES_TO_USER,
            )
        # If paths fail, those of the other laws, which go further out, fail far more often,
        # and show nothing of the rare paths for which they are there.
        some_fail = any(trial.num_failed > 0 for trial in trials_of_candidates)
        if some_fail or not np.any(choice.used):
            mixture = mixture.own_law_alone()
        plan = plan_for(choice, mixture, self.num_paths)
        return plan._replace(
            reason=_reason(basis, choice),
            remainder=comparison.remainder(problem.dtype),
            with_halved_steps=(
                ft.partial(_with_halved_steps, plan, key) if chosen.is_quick else None
            ),
        )


def _with_halved_steps(plan: SamplingPlan, key: PRNGKeyArray) -> SamplingPlan:
    """A plan of `ValueFunctions` with halved steps on all levels. Only the last level is
    fitted: each other level now has the steps of the one after it, and takes its fit."""
    problem, functions, *others = plan.sampler.args  # pyright: ignore (a `Partial`)
    finer_problem = problem.with_halved_steps()
    last_level = len(problem.levels.h) - 1
    last_functions = _fits(finer_problem, key, functions.basis, [last_level])
    known_functions = jtu.tree_map(lambda x: x[1:], functions)
    finer_functions = _joined([known_functions, last_functions])
    sampler = jtu.Partial(controlled_paths, finer_problem, finer_functions, *others)
    return plan._replace(sampler=sampler)


class _Comparison(NamedTuple):
    """The candidates, compared by their trials, with axes for times and components.

    - `choice`: the best candidates, and where they are better than none.
    - `least_errors`: the standard errors with them.
    - `plain_errors`: the standard errors without a control variate.
    - `mean`: the mean.
    """

    choice: Choice
    least_errors: Float[np.ndarray, "S m"]
    plain_errors: Float[np.ndarray, "S m"]
    mean: Float[np.ndarray, "S m"]

    def remainder(self, dtype: Any) -> float:
        """The largest fraction of a standard error that remains with control."""
        # Where nothing is random, as for a constant `phi`, both errors are rounding errors.
        rounding = ROUNDING * jnp.finfo(dtype).eps * np.abs(self.mean)
        is_random = self.plain_errors > rounding
        errors = np.minimum(self.least_errors, self.plain_errors)
        fractions = errors / np.where(is_random, self.plain_errors, 1)
        return float(np.max(np.where(is_random, fractions, 0), initial=0.0))


def _comparison(
    trials_of_candidates: list[Expectation], output_shape: tuple[int, int]
) -> _Comparison:
    """Compares the candidates, by a trial of each."""
    results_of_candidates = [
        combined_results(trial, Combination.BEST) for trial in trials_of_candidates
    ]
    # (C, S, m)
    errors = np.stack(
        [result.std_error.reshape(output_shape) for result in results_of_candidates]
    )
    # A candidate whose error is NaN has failed.
    errors = np.nan_to_num(errors, nan=np.inf)
    least_errors = np.min(errors, axis=0)
    # The trials have the same paths, so without control their results are the same.
    first, *_ = results_of_candidates
    plain_errors = first.plain_std_error.reshape(output_shape)
    # Written as a negation, so that a fit is used if the error without it is NaN.
    is_no_better = least_errors >= plain_errors
    return _Comparison(
        choice=Choice(best=np.argmin(errors, axis=0), used=~is_no_better),
        least_errors=least_errors,
        plain_errors=plain_errors,
        mean=first.mean.reshape(output_shape),
    )


def _reason(basis: AbstractBasis, choice: Choice) -> str:
    """Which candidates were chosen, with zero for none, such as
    `degree: 2, 4, chosen among 0, 2, 4`."""
    # Zero stands for no control variate, so candidate `k` is option `k + 1`.
    options = np.array([0, *basis.candidates])
    chosen = np.unique(options[np.where(choice.used, choice.best + 1, 0)])
    return (
        f"{basis.candidate_name}: {', '.join(map(str, chosen))}, chosen among "
        f"{', '.join(map(str, np.unique(options)))}"
    )


def _fits(
    problem: Problem, key: PRNGKeyArray, basis: AbstractBasis, levels: Sequence[int]
) -> FittedFunctions:
    """The fits of levels with these numbers."""
    # Newton's method is a quarter of the time to compile a fit, and few of its states need
    # it. A state at which the sweeps fail is left out of the fit.
    sweeps_only = dataclasses.replace(problem, solver=without_newton(problem.solver))
    functions, num_failed = _fits_and_failures(sweeps_only, key, basis, levels)
    has_no_newton = eqx.tree_equal(sweeps_only.solver, problem.solver)
    if num_failed == 0 or has_no_newton:
        return functions
    # If paths of the pilot fail, steps are too long for sweeps: the fit is made again, with
    # Newton's method.
    functions, _ = _fits_and_failures(problem, key, basis, levels)
    return functions


def _fits_and_failures(
    problem: Problem, key: PRNGKeyArray, basis: AbstractBasis, levels: Sequence[int]
) -> tuple[FittedFunctions, int]:
    """The fits of levels, and how many of the pilot's paths failed."""
    functions_of_levels = []
    failures_of_levels = []
    for index in levels:
        # An integer would be static: a program for each level. Its shape keeps the axis of
        # levels, along which the fits are joined.
        functions, num_failed = _fit_of_level(problem, np.array([index]), key, basis)
        functions_of_levels.append(functions)
        failures_of_levels.append(num_failed)
    # The numbers are traced if a function of the user closes over traced values.
    check_untraced("`expectation`", failures_of_levels)
    return _joined(functions_of_levels), sum(map(int, failures_of_levels))


def _joined(functions_of_levels: Sequence[FittedFunctions]) -> FittedFunctions:
    """The functions of several levels, each with a leading axis of levels, as one."""
    if len(functions_of_levels) == 1:
        return functions_of_levels[0]
    return jtu.tree_map(lambda *xs: jnp.concatenate(xs), *functions_of_levels)


@ft.partial(compiled, quickly=True)
@lapack_in_turn
def _fit_of_level(
    problem: Problem, index: Int[Array, "1"], key: PRNGKeyArray, basis: AbstractBasis
) -> tuple[FittedFunctions, Int[Array, ""]]:
    """The fit of the level with this index, with a leading axis of levels, and how many of
    the pilot's paths failed."""
    level = problem.level(index[0])
    key_of_level = jr.fold_in(key, index[0])
    functions, num_failed = fit(Noise.of(problem, level), key_of_level, basis)
    return jtu.tree_map(lambda x: x[None], functions), num_failed
