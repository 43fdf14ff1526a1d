"""Fitted value functions as control variates.

$u_n(y)$ stands for $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. What $u_{n+1}$ does in a step,
less its expectation over the random variables of that step, has mean zero whatever $u$ is.
For the exact $u$ these sum up to all that is random in $\\phi(y_N)$.
"""

import math

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._arguments import whole_number
from ._estimate import Expectation, run
from ._fits import (
    AbstractFitted,
    fit_derivatives,
    fit_values,
    Functions,
    Grid,
    Hermite,
    num_polynomials,
    Quadratic,
)
from ._noise import noise_of
from ._steps import (
    AbstractLevelSampler,
    AbstractSampling,
    along,
    Ensemble,
    Level,
    Plan,
    Prepared,
    Problem,
    simulate,
)


# By default there are no more polynomials than this in a fit.
_MOST_POLYNOMIALS = 130
# By default there is a grid in up to so many dimensions, as fine as memory allows,
# and so many steps from its points to all outcomes, for each step of a path.
_GRID, _GRID_SIZES, _MOST_STEPS = 2, (64, 32), 50_000
# Bytes that a fit may take.
_MOST_MEMORY = 4 * 2**30
# Second derivatives by the noise are averaged over so many states.
_SECOND = 32


class ValueFunctions(AbstractSampling):
    r"""Independent paths, less most of what is random in them.

    The random variables of a weak method take finitely many values in a step. So the mean
    over a step is a finite sum, and for any function $u_n$ of the state
    $\sum_n u_{n+1}(y_{n+1}) - \mathbb E[u_{n+1}(y_{n+1}) \mid y_n]$ has mean zero exactly.
    Subtracted from $\phi$, it leaves nothing random if $u_n(y) = \mathbb E[\phi(y_N) \mid
    y_n = y]$. These functions are found approximately, backwards in time, where a short
    pilot has been. How close they are decides the standard error, and nothing else: the
    estimate has no bias but that of the solver.

    In one or two dimensions the functions are interpolated on a grid, in up to 14 they are
    polynomials, and in more they are quadratic, by the mean of their derivatives. For more
    than 100 outcomes of a step (five noises or more) the variables with mean zero come from
    first and second derivatives by the noise.

    In a few dimensions standard errors are $10^{-4}$ to $10^{-8}$ of those of as many
    independent paths. In more than two dimensions it gains little in chaos, after times in
    which the noise has spread the paths all over, and for functions with kinks.

    **Arguments:**

    - `degree`: the total degree of polynomials. By default what is best of those above for
        each number of $\phi$, or nothing at all (which is plain), as fresh paths say; of
        polynomials up to degree 8, and 130 of them.
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

    def prepare(self, problem, key, devices):
        basis, kind, names = _basis(problem, self.degree)
        fitted = _fits(problem, key, basis)
        sampler = lambda best: ValueFunctionsSampler(problem, *_chosen(fitted, best))
        plan, same = Plan(self.num_paths, self.batch_size), problem.num_outputs
        if len(names) == 1:
            return Prepared(sampler(np.zeros(same, int)), plan)
        # The paths that choose are not those that are averaged.
        own, few = (
            jr.fold_in(key, len(problem.levels.h)),
            Plan(self.batch_size, self.batch_size),
        )
        trial = lambda k: run(sampler(np.full(same, k)), own, few, devices)
        spreads = [_spread(trial(k), same[0]) for k in range(len(names))]
        best = np.argmin(np.stack(spreads), axis=0)
        chosen = ", ".join(names[k] for k in np.unique(best))
        reason = f"{kind}: {chosen} was the best of {', '.join(names)}"
        return Prepared(sampler(best), plan, reason)


def _basis(
    p: Problem, degree: int | None
) -> tuple[AbstractFitted | Quadratic, str, list[str]]:
    """The functions, and what the candidates are called. Raises a `ValueError` if there is
    not enough memory, or for random variables without finitely many outcomes."""
    noise = noise_of(p, p.level(0))
    d, levels = sum(x.size for x in jtu.tree_leaves(p.y0)), len(p.levels.h)
    outputs, item = levels * p.max_steps * math.prod(p.num_outputs), p.dtype.itemsize
    many = num_polynomials(d, 2) > _MOST_POLYNOMIALS
    if degree is None:
        for size in _GRID_SIZES if d <= _GRID else ():
            steps = size**d * noise.num_outcomes
            if 2 * item * size**d * outputs <= _MOST_MEMORY and steps <= _MOST_STEPS:
                return Grid(d, size), "grid points along an axis", ["0", str(size)]
        few = [k for k in range(9) if num_polynomials(d, k) <= _MOST_POLYNOMIALS]
        degrees = (0, 1, 2) if many else (*(k for k in few[:-1] if k % 2 == 0), few[-1])
    else:
        degrees = (whole_number("degree", degree, 0),)
    if many and max(degrees) <= 2:
        return Quadratic(degrees), "degree", [*map(str, degrees)]
    basis = Hermite(d, degrees)
    need = item * basis.shape[1] * (basis.shape[0] + len(degrees) * outputs)
    if need > _MOST_MEMORY:
        raise ValueError(
            f"`degree={degree}` has {basis.shape[1]:,} polynomials in {d} dimensions, the "
            f"fit of which needs {need / 2**30:,.0f} GiB. Pass a smaller `degree`."
        )
    return basis, "degree", [*map(str, degrees)]


def value_function(problem: Problem, key: PRNGKeyArray) -> Functions | None:
    """A quadratic one, or none for random variables without finitely many outcomes."""
    try:
        basis = _basis(problem, 2)[0]
    except ValueError:
        return None
    fitted = _fits(problem, key, basis)
    return _chosen(fitted, np.zeros(problem.num_outputs, int))[0]


def _fits(problem: Problem, key: PRNGKeyArray, basis: AbstractFitted | Quadratic):
    """For each level."""
    levels = range(len(problem.levels.h))
    keys = [jr.fold_in(key, k) for k in levels]
    each = [_fit(problem, problem.level(k), keys[k], basis) for k in levels]
    return jtu.tree_map(lambda *xs: jnp.stack(xs), *each)


@eqx.filter_jit
def _fit(
    problem: Problem, level: Level, key: PRNGKeyArray, basis: AbstractFitted | Quadratic
) -> tuple[Functions, Array | None]:
    """Functions with an axis for the candidates, and what the noise keeps of them."""
    noise = noise_of(problem, level)
    flat, unravel = jfu.ravel_pytree(problem.y0)
    if isinstance(basis, Quadratic):
        u, states = fit_derivatives(noise, key, basis)
    else:
        u, states = fit_values(noise, key, basis)
    # Those before each step.
    few = jnp.concatenate([states[:1] * 0 + flat, states[:-1]])[:, :_SECOND]

    def second(i):
        return noise.second(i, jax.vmap(unravel)(few[i]), lambda y: u(i, y))

    return u, jax.lax.map(second, jnp.arange(problem.max_steps))


def _chosen(fitted: PyTree[Array], best: np.ndarray) -> PyTree[Array]:
    """The candidates `best`, of shape `(S, m)`. Coefficients end with the axes `C`, `S` and
    `m`, with an axis of size 1 for a grid, before which there is nothing at all."""
    functions, second = fitted

    def take(x):
        if isinstance(functions.basis, Grid):
            return x[..., 0, :, :] * best.astype(x.dtype)
        index = best.reshape(*[1] * (x.ndim - 2), *best.shape)
        return jnp.take_along_axis(x, index, -3).squeeze(-3)

    c, second = jtu.tree_map(take, (functions.coefficients, second))
    return Functions(functions.frames, c, functions.basis), second


def _spread(e: Expectation, times: int) -> np.ndarray:
    """The variance of a sample of the first combination; larger where few of them make up
    for most of it, so that it is not well known. Infinite if there are none."""

    def bound(squares, largest):
        n = max(e.num_samples, 1)
        with np.errstate(all="ignore"):
            bound = squares[0] / n + 2 * np.sqrt(squares[0] / n) * largest[0] / np.sqrt(
                n
            )
        known = np.isfinite(bound) & (e.num_samples > 1)
        return np.where(known, bound, np.inf).reshape(times, -1)

    each = jtu.tree_map(bound, e.sums_of_squares, e.largest)
    return np.concatenate(jtu.tree_leaves(each), axis=1)


class ValueFunctionsSampler(AbstractLevelSampler):
    """A sample is a path, with its value less what `functions`, along an axis of levels,
    say of its noise; `second` is what the noise keeps of them."""

    problem: Problem
    functions: Functions
    second: Array | None

    def on_level(self, keys, level):
        p, n = self.problem, len(keys)
        noise = noise_of(p, level)
        fitted = self.functions, self.second
        u, second = jtu.tree_map(lambda x: x[level.index], fitted)

        def step(i, ensemble, control):
            at, here = lambda y: u(i, y), jtu.tree_map(lambda x: x[i], second)
            one = lambda y, state, key: noise.advance(i, y, state, at, here, key)
            out = jax.vmap(one)(ensemble.y, ensemble.solver_state, keys)
            y, state, change, success = out
            # A path that failed has no value, and its control must be finite all the same.
            control = control + jnp.where(along(success, change), change, 0)
            return ensemble.moved(p, y, state, success), control

        state = noise.fresh(0, p.y0)
        same = jtu.tree_map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), state)
        ensemble, control = Ensemble.start(p, n, same), (n, *p.num_outputs)
        control = jnp.zeros(control, jax.eval_shape(lambda: u(0, p.y0)).dtype)
        keep = lambda x, failed: x
        saved, ensemble, control = simulate(p, level, ensemble, step, control, keep)
        return _controlled(saved, control), ~ensemble.failed, ensemble.failed


def _controlled(saved: PyTree[Array], control: Float[Array, "n S m"]) -> PyTree[Array]:
    """The values less their control variates."""
    leaves, treedef = jtu.tree_flatten(saved)
    ends = np.cumsum([x[0, 0].size for x in leaves])
    parts = jnp.split(jnp.moveaxis(control, 1, 0), ends[:-1], axis=2)
    less = lambda x, c: x - c.reshape(x.shape).astype(x.dtype)
    return treedef.unflatten([less(x, c) for x, c in zip(leaves, parts)])
