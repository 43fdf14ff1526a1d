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
from jaxtyping import Bool, PRNGKeyArray

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


# Folded into the key of a call to draw the trial. (For the pilot run of a level the number
# of the level is folded into it. Numbers of levels are smaller.)
_TRIAL_KEY = 0xFFFFFFFE
# The most numbers that a fit computes without a warning that it will take long.
_MOST_WITHOUT_WARNING = 2**31
# The `stacklevel` of warnings in `prepare` that point to the code that calls `expectation`.
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
        By default the fit is as above, with polynomials of degree 8 at most and 130 terms
        at most, and coarser where it would take long. For each component of $\phi$, a trial
        with fresh paths decides whether the control variate is used.
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

        levels = range(len(problem.levels.h))
        functions = _fits(problem, key, chosen.basis, room_for_steps(problem), levels)

        def sampler_for(
            is_used: Bool[np.ndarray, "S m"], mixture: Mixture
        ) -> jtu.Partial:
            # A `Partial` is a PyTree: a program is compiled once for all arrays in it.
            return jtu.Partial(controlled_paths, problem, functions, is_used, mixture)

        # A trial of the control variate for all means, by one batch of paths that are not a
        # part of the estimate.
        all_laws = Mixture.of(problem)
        always_used = np.ones(problem.output_shape, bool)
        trial_plan = SamplingPlan(
            sampler_for(always_used, all_laws),
            Outputs.of(problem),
            num_samples=self.batch_size,
            batch_size=self.batch_size,
            # So few paths take less time than compiling their program.
            is_quick=True,
        )
        trial = run(trial_plan, jr.fold_in(key, _TRIAL_KEY), devices)
        is_used, remainder = _comparison(trial, problem)
        if self.degree == 0:
            # The user asked for no control variate.
            is_used = np.zeros(problem.output_shape, bool)
        elif self.degree is not None and not np.any(is_used):
            warnings.warn(
                f"`degree={self.degree}` is no better than no control variate, so none is "
                "used. Pass another `degree`, or another `sampling`.",
                stacklevel=_FRAMES_TO_USER,
            )
        # Half of the paths draw by wider laws, to show the rare paths for which the fit may
        # be poor. If paths of the trial fail, paths by wider laws fail far more often, and
        # do not show rare paths.
        needs_own_law = trial.num_failed > 0 or not np.any(is_used)
        laws = all_laws.own_law_alone() if needs_own_law else all_laws

        plan = trial_plan._replace(
            sampler=sampler_for(is_used, laws),
            num_samples=self.num_paths,
            reason=_choice_in_words(chosen.basis, is_used),
            remainder=remainder,
        )
        if not chosen.has_quick_fit:
            return plan
        return plan._replace(
            with_halved_steps=ft.partial(_with_halved_steps, plan, key)
        )


def _choice_in_words(basis: AbstractBasis, is_used: Bool[np.ndarray, "S m"]) -> str:
    """Says for the result which degree, or number of grid points, the control variates
    have: `degree: 0, 4, chosen among 0, 4` if some means use degree 4, and others no
    control variate, for which zero stands."""
    used = np.unique(np.where(is_used, basis.resolution, 0))
    options = np.unique([0, basis.resolution])
    return (
        f"{basis.resolution_name}: {', '.join(map(str, used))}, chosen among "
        f"{', '.join(map(str, options))}"
    )


def _with_halved_steps(plan: SamplingPlan, key: PRNGKeyArray) -> SamplingPlan:
    """A plan of `ValueFunctions` with halved steps on all levels. Only the last level is
    fitted: each other level now has the steps of the next level of `plan`, and takes the
    functions of that level."""
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
    trial: Expectation, problem: Problem
) -> tuple[Bool[np.ndarray, "S m"], float]:
    """Compares the standard errors of a trial with and without the control variate.
    Returns for which times and components the control variate reduces the standard error,
    and the largest fraction of a standard error that remains."""
    result = combined_results(trial, Combination.BEST)
    # Where the fit has failed, the error is NaN.
    errors = np.nan_to_num(result.std_error, nan=np.inf)
    plain_errors = result.plain_std_error
    # A negation, so that the fit is used where the error without it is NaN.
    is_used = ~(errors >= plain_errors)
    # Where nothing is random, as for a constant `phi`, both errors are rounding errors,
    # whose fraction means nothing.
    rounding = ROUNDING * np.finfo(problem.dtype).eps * np.abs(result.mean)
    is_random = plain_errors > rounding
    fractions = np.minimum(errors, plain_errors)[is_random] / plain_errors[is_random]
    return is_used.reshape(problem.output_shape), float(np.max(fractions, initial=0.0))


def _fits(
    problem: Problem,
    key: PRNGKeyArray,
    basis: AbstractBasis,
    most_steps: int,
    levels: Sequence[int],
) -> FittedFunctions:
    """The functions fitted on the levels with these numbers, in arrays with room for
    `most_steps` steps."""

    def fits_by(solver: diffrax.AbstractSolver) -> tuple[FittedFunctions, int]:
        """The functions fitted by this solver, and how many paths of the pilots failed."""
        solved = dataclasses.replace(problem, solver=solver)
        # The number of a level is an array: an integer would be static, and each level
        # would compile its own program.
        fits = [fit(solved, np.array(k), key, basis, most_steps) for k in levels]
        functions_of_levels, failures_of_levels = zip(*fits)
        # The numbers are traced if a function of the user closes over traced values.
        check_untraced("`expectation`", failures_of_levels)
        return _joined(functions_of_levels), sum(map(int, failures_of_levels))

    # Newton's method would take a quarter of the time to compile a fit, and is needed only
    # at the few states at which fixed-point sweeps fail. So a fit leaves out these states.
    # But if paths of the pilot fail, steps are too long for sweeps alone, and the fit is
    # made again with Newton's method.
    functions, num_failed = fits_by(without_newton(problem.solver))
    if num_failed > 0 and has_newton(problem.solver):
        functions, _ = fits_by(problem.solver)
    return functions


def _joined(functions_of_levels: Sequence[FittedFunctions]) -> FittedFunctions:
    """Joins the functions of several levels along their leading axis, for the levels."""
    if len(functions_of_levels) == 1:
        return functions_of_levels[0]
    return jtu.tree_map(lambda *xs: jnp.concatenate(xs), *functions_of_levels)
