"""Independent paths with control variates from fitted value functions.

The value function $u_n(y)$ approximates $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. In each
step, $u_{n+1}$ minus its expectation over the step's random variables has mean zero for any
$u$. For the exact $u$ the sum of these differences is $\\phi(y_N)$ minus its mean.
"""

import dataclasses
import functools as ft
import warnings
from collections.abc import Sequence

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from ..._arguments import check_memory, check_untraced, whole_number
from ..._simulation import Combination, Problem
from ..._solver import has_newton, without_newton
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
from .basis_choice import chosen_basis
from .controlled_paths import controlled_paths
from .fits import fit, FittedFunctions, room_for_steps
from .mixture import Mixture


# Folded into the key of a call to draw trials. (Numbers of levels, which are folded into it
# to draw fits, are smaller.)
_TRIAL_KEY = 0xFFFFFFFE
# The most numbers that a fit computes without a warning that it will take long.
_MOST_WITHOUT_WARNING = 2**31
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
        if chosen.num_numbers > _MOST_WITHOUT_WARNING:
            warnings.warn(
                f"The fit of `ValueFunctions` takes as long as {chosen.num_states:,} "
                "independent paths. If fewer paths are accurate enough, pass "
                "`sampling=IndependentPaths(num_paths)`.",
                stacklevel=_FRAMES_TO_USER,
            )
        basis = chosen.basis
        outputs = Outputs.of(problem)
        levels = range(len(problem.levels.h))
        functions = _fits(problem, key, basis, room_for_steps(problem), levels)
        mixture = Mixture.of(problem)

        def plan_for(
            choice: Int[np.ndarray, "S m"], mixture: Mixture, num_samples: int
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
        trials = []
        for number in range(1, len(basis.candidates) + 1):
            same_for_all = np.full(problem.output_shape, number)
            plan = plan_for(same_for_all, mixture, self.batch_size)
            trials.append(run(plan, key_of_trials, devices))
        choice, remainder = _comparison(trials, problem)
        if self.degree == 0:
            choice = np.zeros_like(choice)
        if self.degree and not np.any(choice):
            warnings.warn(
                f"`degree={self.degree}` is no better than no control variate, so none is "
                "used. Pass another `degree`, or another `sampling`.",
                stacklevel=_FRAMES_TO_USER,
            )
        # If paths fail, those of the other laws, which go further out, fail far more often,
        # and show nothing of the rare paths for which they are there.
        if any(trial.num_failed > 0 for trial in trials) or not np.any(choice):
            mixture = mixture.own_law_alone()
        plan = plan_for(choice, mixture, self.num_paths)
        # Without a control variate, the candidate is zero.
        options = np.array([0, *basis.candidates])
        return plan._replace(
            reason=(
                f"{basis.candidate_name}: {_listed(options[choice])}, chosen among "
                f"{_listed(options)}"
            ),
            remainder=remainder,
            with_halved_steps=(
                ft.partial(_with_halved_steps, plan, key) if chosen.is_quick else None
            ),
        )


def _listed(options: np.ndarray) -> str:
    """The options, each of them once, such as `0, 2, 4`."""
    return ", ".join(map(str, np.unique(options)))


def _with_halved_steps(plan: SamplingPlan, key: PRNGKeyArray) -> SamplingPlan:
    """A plan of `ValueFunctions` with halved steps on all levels. Only the last level is
    fitted: each other level now has the steps of the one after it, and takes its fit."""
    problem, functions, *others = plan.sampler.args  # pyright: ignore (a `Partial`)
    finer_problem = problem.with_halved_steps()
    num_levels, most_steps, *_ = functions.coefficients.shape
    last_functions = _fits(
        finer_problem, key, functions.basis, most_steps, [num_levels - 1]
    )
    known_functions = jtu.tree_map(lambda x: x[1:], functions)
    finer_functions = _joined([known_functions, last_functions])
    sampler = jtu.Partial(controlled_paths, finer_problem, finer_functions, *others)
    return plan._replace(sampler=sampler)


def _comparison(
    trials: list[Expectation], problem: Problem
) -> tuple[Int[np.ndarray, "S m"], float]:
    """Compares the candidates, by a trial of each. The number of the best candidate for
    each time and component, counted from 1, or 0 where none is better than none; and the
    largest fraction of a standard error that remains with them."""
    results = [combined_results(trial, Combination.BEST) for trial in trials]
    # (C, S * m). A candidate whose error is NaN has failed.
    errors = np.nan_to_num([result.std_error for result in results], nan=np.inf)
    least_errors = np.min(errors, axis=0)
    # The trials have the same paths, so without control their results are the same.
    plain_errors = results[0].plain_std_error
    is_no_better = least_errors >= plain_errors
    choice = np.where(is_no_better, 0, 1 + np.argmin(errors, axis=0))
    # Where nothing is random, as for a constant `phi`, both errors are rounding errors.
    rounding = ROUNDING * np.finfo(problem.dtype).eps * np.abs(results[0].mean)
    is_random = plain_errors > rounding
    fractions = np.minimum(least_errors, plain_errors)[is_random]
    fractions = fractions / plain_errors[is_random]
    return choice.reshape(problem.output_shape), float(np.max(fractions, initial=0.0))


def _fits(
    problem: Problem,
    key: PRNGKeyArray,
    basis: AbstractBasis,
    most_steps: int,
    levels: Sequence[int],
) -> FittedFunctions:
    """The fits of levels with these numbers, in arrays for `most_steps` steps."""

    def fits_by(solver: diffrax.AbstractSolver) -> tuple[FittedFunctions, int]:
        """The fits by this solver, and how many of the pilot's paths failed."""
        solved = dataclasses.replace(problem, solver=solver)
        # An integer would be static: a program for each level.
        fits = [fit(solved, np.array(k), key, basis, most_steps) for k in levels]
        functions_of_levels, failures_of_levels = zip(*fits)
        # The numbers are traced if a function of the user closes over traced values.
        check_untraced("`expectation`", failures_of_levels)
        return _joined(functions_of_levels), sum(map(int, failures_of_levels))

    # Newton's method is a quarter of the time to compile a fit, and few of its states need
    # it. A state at which the sweeps fail is left out of the fit. But if paths of the pilot
    # fail, steps are too long for sweeps: the fit is made again, with Newton's method.
    functions, num_failed = fits_by(without_newton(problem.solver))
    if num_failed > 0 and has_newton(problem.solver):
        functions, _ = fits_by(problem.solver)
    return functions


def _joined(functions_of_levels: Sequence[FittedFunctions]) -> FittedFunctions:
    """The functions of several levels, each with a leading axis of levels, as one."""
    if len(functions_of_levels) == 1:
        return functions_of_levels[0]
    return jtu.tree_map(lambda *xs: jnp.concatenate(xs), *functions_of_levels)
