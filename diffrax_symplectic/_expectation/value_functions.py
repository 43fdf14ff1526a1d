"""Independent paths with control variates from fitted value functions.

The value function $u_n(y)$ approximates $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. In each
step, $u_{n+1}$ minus its expectation over the step's random variables has mean zero for any
$u$. For the exact $u$ the sum of these differences is $\\phi(y_N)$ minus its mean.
"""

import dataclasses
import functools as ft
import itertools
import math
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from .._arguments import check_untraced, whole_number
from .._compat import quickly_compiled
from .._lapack import lapack_in_turn
from .._terms import number_of_noises
from .bases import AbstractBasis, Hermite, Quadratic
from .estimate import best_results
from .fits import fit, Functions, without_newton
from .grid import Grid
from .moments import total
from .noise import Noise
from .polynomials import num_polynomials
from .problem import Problem
from .run import run
from .sampling import (
    AbstractSampling,
    KindsWithControl,
    ROUNDING,
    Samples,
    SamplingPlan,
    saved_by_name,
)
from .simulation import along, Paths, simulate


# The most polynomials in a fit by default.
_MOST_POLYNOMIALS = 130
# By default a grid is used in up to this many dimensions, with the largest of these sizes
# that memory and time allow: the most evaluations (points times outcomes) for one step of a
# path, and for all steps.
_GRID, _GRID_SIZES, _MOST_ENDS, _MOST = 2, (64, 32), 50_000, 2**25
# Bytes that a fit may take, and the numbers it may compute before a warning that it will
# take long (about a minute).
_MOST_MEMORY, _OUT_OF_PROPORTION = 4 * 2**30, 2**31
# The number folded into the key of trials, and the number of batches with wider noise.
_TRIAL, _WIDE = 0xFFFFFFFE, 2
# The most noises of which paths are pushed to all sides.
_MOST_NOISES = 2


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

    In a few dimensions, standard errors are $10^{-4}$ to $10^{-8}$ times the standard error
    of as many independent paths. In more than two dimensions the gain is small for chaotic
    systems, for times after which the noise has spread the paths over the whole phase
    space, and for functions with kinks.

    **Arguments:**

    - `degree`: the total degree of the polynomials; degree 0 disables the control variate.
        By default the best of the fits above is chosen for each component of $\phi$, or
        none, by trials with fresh paths; polynomials have degree 8 at most and 130 terms at
        most. Fits that would take long are made coarser.
    - `num_paths`: the number of paths to average; with `tol` an upper limit.
    - `batch_size`: the number of paths that each device solves at once.

    **Source:** the regression-based control variates of [Belomestny and others
    (2015)](https://doi.org/10.48550/arXiv.1510.03141), for weak schemes of [Belomestny,
    Häfner and Urusov (2016)](https://doi.org/10.48550/arXiv.1612.05255).
    """

    degree: int | None = None
    num_paths: int = eqx.field(
        default=4096, converter=lambda x: whole_number("num_paths", x, 2)
    )
    batch_size: int = eqx.field(
        default=512, converter=lambda x: whole_number("batch_size", x)
    )

    def prepare(self, problem, key, devices):
        basis, (times, m) = _basis(problem, self.degree), problem.num_outputs
        functions, shape = _fits(problem, key, basis), (len(problem.weights), times, m)
        shapes = problem.shapes_of_samples(len(KindsWithControl))
        never = np.zeros(shape), np.full(shape, np.inf)
        narrow, *wider = _wider(problem)

        def plan(best, used, n: int, usual=never, law=narrow):
            usual = [x.astype(problem.dtype) for x in usual]
            sampler = jtu.Partial(
                _controlled_paths, problem, functions, best, used, usual, law
            )
            return SamplingPlan(sampler, n, self.batch_size, shapes=shapes, quick=True)

        # The trials' paths are not part of the estimate.
        trial = lambda *args: run(plan(*args), jr.fold_in(key, _TRIAL), devices)
        flat = lambda tree, *axes: np.concatenate(
            [np.reshape(x, (*axes, times, -1)) for x in jtu.tree_leaves(tree)], axis=-1
        )
        all_of, used = (lambda k: np.full((times, m), k)), np.ones((times, m), bool)
        count = len(basis.candidates)
        tried = [trial(all_of(k), used, self.batch_size) for k in range(count)]
        errors = np.stack([flat(e.std_error) for e in tried])
        errors = np.nan_to_num(errors, nan=np.inf)
        best = np.argmin(errors, axis=0)
        plain = flat(best_results(tried[0]).plain_std_error)
        used = ~(np.min(errors, axis=0) >= plain)
        if self.degree and not np.any(used):
            warnings.warn(
                f"`degree={self.degree}` is no better than no control variate, so none is "
                "used. Pass another `degree`, or another `sampling`.",
                stacklevel=4,
            )
        # Paths with wider noise estimate the deviations beyond the largest in the trial.
        at = lambda tree, kind: flat(jtu.tree_map(lambda x: x[kind], tree), shape[0])
        with_fit = np.stack([at(total(e.moments).largest, 0) for e in tried])
        with_fit = np.take_along_axis(with_fit, best[None, None], 0)[0]
        without = total(tried[0].moments)
        usual = at(without.mean, 1), np.where(used, with_fit, at(without.largest, 1))
        n = _WIDE * self.batch_size
        wide = [trial(best, used, n, usual, law).moments for law in wider]
        largest = lambda *means: ft.reduce(np.fmax, [x[3] for x in means])
        far = jtu.tree_map(largest, *[total(x).mean for x in wide])
        names = np.array([0, *basis.candidates])
        chosen = ", ".join(map(str, np.unique(names[np.where(used, best + 1, 0)])))
        among = ", ".join(map(str, np.unique(names)))
        reason = f"{basis.kind}: {chosen}, chosen among {among}"
        final = plan(best, used, self.num_paths, usual)
        rounding = ROUNDING * jnp.finfo(problem.dtype).eps * np.abs(flat(tried[0].mean))
        ratios = _ratios(np.min(errors, axis=0), plain, rounding)
        left = np.max(ratios, initial=0.0)
        return final._replace(reason=reason, far=far, left=float(left))


def _ratios(errors: np.ndarray, plain: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """Standard errors with control, as fractions of those without it, at most one; zero
    where those are `rounding` errors only, as of a constant."""
    random = plain > rounding
    ratios = np.minimum(errors, plain) / np.where(random, plain, 1)
    return np.where(random, ratios, 0)


def value_function(problem: Problem, key: PRNGKeyArray) -> Functions | None:
    """A quadratic value function for each level, or `None` if the random variables do not
    have finitely many outcomes."""
    try:
        basis = _basis(problem, 2)
    except ValueError:
        return None
    return _fits(problem, key, basis).chosen(np.zeros(problem.num_outputs, int))


def _fits(problem: Problem, key: PRNGKeyArray, basis: AbstractBasis) -> Functions:
    """The fits of all levels."""
    lean = dataclasses.replace(problem, solver=without_newton(problem.solver))
    functions, lost = _fits_by(lean, key, basis)
    if lost == 0 or eqx.tree_equal(lean.solver, problem.solver):
        return functions
    # Steps too long for sweeps: the fit is made again, with Newton's method.
    functions, _ = _fits_by(problem, key, basis)
    return functions


def _fits_by(
    problem: Problem, key: PRNGKeyArray, basis: AbstractBasis
) -> tuple[Functions, int]:
    """The fits of all levels, and how many of the pilot's paths failed."""
    count = len(problem.levels.h)
    each = [_fitted(problem, np.array([k]), key, basis) for k in range(count)]
    check_untraced("`expectation`", [number for _, number in each])
    lost = sum(int(number) for _, number in each)
    functions = [own for own, _ in each]
    if count == 1:
        return functions[0], lost
    return jtu.tree_map(lambda *xs: jnp.concatenate(xs), *functions), lost


@quickly_compiled
@lapack_in_turn
def _fitted(
    problem: Problem, index: Int[Array, "1"], key: PRNGKeyArray, basis: AbstractBasis
) -> tuple[Functions, Int[Array, ""]]:
    """The fit of the level with this index, with a leading axis of levels, and how many of
    the pilot's paths failed."""
    level = problem.level(index[0])
    own, lost = fit(Noise.of(problem, level), jr.fold_in(key, index[0]), basis)
    return jtu.tree_map(lambda x: x[None], own), lost


def _basis(p: Problem, degree: int | None) -> AbstractBasis:
    """Raises a `ValueError` if the fit needs too much memory, or for random variables
    without finitely many outcomes."""
    points = len(Noise.of(p, p.level(0)).nodes()[1])
    d, levels = sum(x.size for x in jtu.tree_leaves(p.y0)), len(p.levels.h)
    outputs, item = levels * p.max_steps * math.prod(p.num_outputs), p.dtype.itemsize
    many = num_polynomials(d, 2) > _MOST_POLYNOMIALS
    steps = int(np.sum(p.levels.num_steps))
    if degree is None:
        for size in _GRID_SIZES if d <= _GRID else ():
            grid = Grid(d, (size,))
            memory, ends = 2 * item * grid.size * outputs, size**d * points
            if memory <= _MOST_MEMORY and ends <= _MOST_ENDS and ends * steps <= _MOST:
                return grid
        few = [k for k in range(1, 9) if num_polynomials(d, k) <= _MOST_POLYNOMIALS]
        # Drop degrees whose fit would take too long.
        cheap = lambda k: Hermite(d, (k,)).sites * points * steps <= _MOST
        few = [k for k in few if k <= 2 or cheap(k)]
        degrees = (1, 2) if many else (*(k for k in few[:-1] if k % 2 == 0), few[-1])
    else:
        degrees = (whole_number("degree", degree, 0),)
    basis = Quadratic(d, degrees) if many and degrees[-1] <= 2 else Hermite(d, degrees)
    if isinstance(basis, Hermite):
        need = item * basis.size * (basis.pilots + len(degrees) * outputs)
        if need > _MOST_MEMORY:
            raise ValueError(
                f"`degree={degree}` has {basis.size:,} polynomials in {d} dimensions, and "
                f"its fit needs {need / 2**30:,.0f} GiB. Pass a smaller `degree`."
            )
    numbers = basis.sites * points * steps * d
    if numbers > _OUT_OF_PROPORTION:
        warnings.warn(
            f"The fit of `ValueFunctions` takes as long as {basis.sites * points:,} "
            "independent paths. If fewer paths are accurate enough, pass "
            "`sampling=IndependentPaths(num_paths)`.",
            stacklevel=5,
        )
    return basis


def _wider(p: Problem) -> list[tuple[np.ndarray, np.ndarray]]:
    """Laws of the noise, as factors of `Noise.share` and of `Noise.tilt`: its own, a wider
    one, and for one noise or two those in which each noise pushes to one side."""
    m, n = number_of_noises(p.terms), len(Noise.of(p, p.level(0)).laws)
    sides = [*itertools.product((-1, 1), repeat=m)] if m <= _MOST_NOISES else []
    pushed = [(0, [*side, *[0] * (n - m)]) for side in sides]
    laws = [(0, [0] * n), (1, [0] * n), *pushed]
    return [(np.array(a, p.dtype), np.array(b, p.dtype)) for a, b in laws]


def _controlled_paths(
    p: Problem, functions: Functions, best, used, usual, law, keys: PRNGKeyArray
) -> Samples:
    """A sample is a path minus the control variate of `functions` (with a leading axis of
    levels), by their `best` candidates, where they are `used`. With a wider
    `law` (see `_wider`) deviations beyond the `usual` ones are estimated: the mean without
    control, and the largest deviation."""
    functions = functions.chosen(best)
    n, (center, beyond) = len(keys), [x[:, :, None] for x in usual]
    share, side = law
    drawn = jax.vmap(p.drawn)(keys)

    def begin(level):
        noise, u = Noise.of(p, level), jtu.tree_map(lambda x: x[level.index], functions)

        def step(i, paths):
            at, second = lambda y: u(i, y), jtu.tree_map(lambda x: x[i], u.second)

            def one(y, state, args, key):
                x, log_ratio = noise.draw(
                    key, i, share * noise.share, side * noise.tilt
                )
                own = noise.with_args(args)
                return own.advance(i, y, state, at, second, x), log_ratio

            given = paths.y, paths.solver_state, paths.args, keys
            after, log_ratio = jax.vmap(one)(*given)
            y, state, success, value, change = after
            # A failed path has no value, but its control must be finite.
            change = jnp.where(along(success, change), change, 0)
            control, promised, ratios = paths.control
            promised = jnp.where(i == 0, value - change, promised)
            control = control + jnp.where(used, change, 0), promised, ratios + log_ratio
            return paths.moved(p, y, state, success, control)

        dtype = jax.eval_shape(lambda: u(0, p.y0)).dtype
        state = jax.vmap(lambda y, args: noise.with_args(args).fresh(0, y))(*drawn)
        zero = jnp.zeros((n, *p.num_outputs), dtype)
        return step, Paths.start(p, *drawn, state, (zero, zero, jnp.zeros(n, dtype)))

    saved, failed, (*known, log_ratio) = simulate(p, begin)
    control, promised = (jnp.swapaxes(x, 1, 2).astype(saved.dtype) for x in known)
    promised = jnp.where(along(p.levels.saved_steps[0] == 0, saved[0]), saved, promised)
    each = saved - control, saved, control, promised
    left, plain, control, promised = map(p.combined, each)
    off = jnp.abs(left - jnp.where(used[:, None], promised, center))
    # Deviations must exceed rounding.
    beyond = beyond + ROUNDING * jnp.finfo(off.dtype).eps * jnp.abs(plain)
    # Cap ratios at one: paths that are likelier without wider noise are seen without it.
    ratio = jnp.exp(-jnp.maximum(jnp.sum(log_ratio, axis=0), 0))[:, None]
    far, lost = jnp.where(off > beyond, ratio * off, 0), jnp.any(failed, axis=0)
    kinds = [left, plain, control, far]
    return Samples(p.averaged(kinds), ~lost, lost)
