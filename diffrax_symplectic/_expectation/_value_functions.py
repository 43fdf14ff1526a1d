"""Paths less what fitted value functions say of their noise.

$u_n(y)$ stands for $\\mathbb E[\\phi(y_N) \\mid y_n = y]$. What $u_{n+1}$ does in a step,
less its expectation over the random variables of that step, has mean zero whatever $u$ is.
For the exact $u$ these sum up to all that is random in $\\phi(y_N)$.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .._arguments import whole_number
from .._brownian import Discrete, random_words
from .._custom_types import Y
from .._terms import outcomes, step_variables
from ._bases import AbstractBasis, Grid, Hermite, Quadratic
from ._fits import fit, Functions
from ._moments import total
from ._polynomials import num_polynomials
from ._run import run
from ._sampling import AbstractSampling, Plan, Samples
from ._steps import along, Ensemble, Level, Problem, samples


# Up to so many outcomes a step is taken for each of them.
_MOST_OUTCOMES = 100

# A function of the state.
Function: TypeAlias = Callable[[Y], Array]
# By default there are no more polynomials than this in a fit.
_MOST_POLYNOMIALS = 130
# By default there is a grid in up to so many dimensions, as fine as memory and time allow:
# so many steps from its points to all outcomes, for each step of a path and for all.
_GRID, _GRID_SIZES, _MOST_ENDS, _MOST = 2, (64, 32), 50_000, 2**25
# Bytes that a fit may take, and numbers of states in it before a warning says that it will
# take long: a minute or so.
_MOST_MEMORY, _OUT_OF_PROPORTION = 4 * 2**30, 2**31
# The number that makes the key of trials, and how many batches have wider noise: it makes
# a path about as likely as one in e^8.
_TRIAL, _WIDE, _NATS = 0xFFFFFFFE, 2, 8.0


class ValueFunctions(AbstractSampling):
    r"""Independent paths, less most of what is random in them.

    The random variables of a weak method take finitely many values in a step. So the mean
    over a step is a finite sum, and for any function $u_n$ of the state
    $\sum_n u_{n+1}(y_{n+1}) - \mathbb E[u_{n+1}(y_{n+1}) \mid y_n]$ has mean zero exactly.
    Subtracted from $\phi$, it leaves nothing random if $u_n(y) = \mathbb E[\phi(y_N) \mid
    y_n = y]$. These functions are found approximately, backwards in time, where a short
    pilot has been. How close they are decides the standard error, and nothing else: the
    estimate has no bias but that of the solver.

    In one or two dimensions the functions are polynomials and what these leave, on a grid;
    in up to 14 they are polynomials, and in more they are quadratic, by the mean of their
    derivatives. For more
    than 100 outcomes of a step (five noises or more) the variables with mean zero come from
    first and second derivatives by the noise.

    In a few dimensions standard errors are $10^{-4}$ to $10^{-8}$ of those of as many
    independent paths. In more than two dimensions it gains little in chaos, after times in
    which the noise has spread the paths all over, and for functions with kinks.

    **Arguments:**

    - `degree`: the total degree of polynomials. By default what is best of those above for
        each number of $\phi$, or nothing at all (which is plain), as fresh paths say; of
        polynomials up to degree 8, and 130 of them. Fits that would take long are coarser.
    - `num_paths`: how many paths are averaged; with `tol` at most.
    - `batch_size`: how many of them each device takes at once.

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
        functions, count = _fits(problem, key, basis), len(basis.candidates)
        shape = len(problem.weights), times, m
        narrow, never = np.zeros((), problem.dtype), np.full(shape, np.inf)

        def plan(best, n: int, wide=narrow, beyond=never):
            u, beyond = functions.chosen(best), beyond.astype(problem.dtype)
            sampler = jtu.Partial(_controlled_paths, problem, u, wide, beyond)
            return Plan(sampler, n, self.batch_size)

        # The paths that choose are not those that are averaged.
        trial = lambda plan: run(plan, jr.fold_in(key, _TRIAL), devices)
        tried = [
            trial(plan(np.full((times, m), k), self.batch_size)) for k in range(count)
        ]
        flat = lambda tree, *axes: np.concatenate(
            [np.reshape(x, (*axes, times, -1)) for x in jtu.tree_leaves(tree)], axis=-1
        )
        errors = np.stack([flat(e.std_error) for e in tried])
        best = np.argmin(np.nan_to_num(errors, nan=np.inf), axis=0)
        if self.degree and not np.any(best):
            warnings.warn(
                f"`degree={self.degree}` is no better than plain paths, which are taken. "
                "Pass another `degree`, or another `sampling`.",
                stacklevel=4,
            )
        # Paths with wider noise say what deviations there are beyond those of the trial.
        largest = [
            jtu.tree_map(lambda x: x[0], total(e.moments).largest) for e in tried
        ]
        largest = np.stack([flat(x, len(problem.weights)) for x in largest])
        beyond = np.take_along_axis(largest, best[None, None], 0)[0]
        wide = trial(plan(best, _WIDE * self.batch_size, narrow + 1, beyond))
        far = jtu.tree_map(lambda x: x[3], total(wide.moments).mean)
        listed = lambda which: ", ".join(str(basis.candidates[k]) for k in which)
        chosen, among = listed(np.unique(best)), listed(range(count))
        reason = f"{basis.kind}: {chosen} was the best of {among}"
        final = plan(best, self.num_paths, beyond=beyond)
        return final._replace(reason=reason, far=far)


def value_function(problem: Problem, key: PRNGKeyArray) -> Functions | None:
    """A quadratic one for each level, or none for random variables without finitely many
    outcomes."""
    try:
        basis = _basis(problem, 2)
    except ValueError:
        return None
    best = np.full(problem.num_outputs, len(basis.candidates) - 1)
    return _fits(problem, key, basis).chosen(best)


def num_outcomes(problem: Problem) -> int | None:
    """Of a step, if they are few."""
    try:
        outcomes = Noise.of(problem, problem.level(0)).outcomes
    except ValueError:
        return None
    return None if outcomes is None else len(outcomes[1])


def _fits(problem: Problem, key: PRNGKeyArray, basis: AbstractBasis) -> Functions:
    """For each level."""
    levels = range(len(problem.levels.h))
    each = [
        _fitted(problem, problem.level(k), jr.fold_in(key, k), basis) for k in levels
    ]
    return jtu.tree_map(lambda *xs: jnp.stack(xs), *each)


@eqx.filter_jit
def _fitted(problem: Problem, level: Level, key: PRNGKeyArray, basis: AbstractBasis):
    return fit(Noise.of(problem, level), key, basis)


def _basis(p: Problem, degree: int | None) -> AbstractBasis:
    """Raises a `ValueError` if there is not enough memory, or for random variables without
    finitely many outcomes."""
    points = len(Noise.of(p, p.level(0)).nodes()[1])
    d, levels = sum(x.size for x in jtu.tree_leaves(p.y0)), len(p.levels.h)
    outputs, item = levels * p.max_steps * math.prod(p.num_outputs), p.dtype.itemsize
    many = num_polynomials(d, 2) > _MOST_POLYNOMIALS
    steps = int(np.sum(p.levels.num_steps))
    if degree is None:
        for size in _GRID_SIZES if d <= _GRID else ():
            memory, ends = 2 * item * size**d * outputs, size**d * points
            if memory <= _MOST_MEMORY and ends <= _MOST_ENDS and ends * steps <= _MOST:
                return Grid(d, size)
        few = [k for k in range(9) if num_polynomials(d, k) <= _MOST_POLYNOMIALS]
        # The largest degree whose fit does not take too long.
        cheap = lambda k: Hermite(d, (0, k)).sites * points * steps <= _MOST
        few = [k for k in few if k <= 2 or cheap(k)]
        degrees = (0, 1, 2) if many else (*(k for k in few[:-1] if k % 2 == 0), few[-1])
    else:
        degrees = tuple({0: 0, whole_number("degree", degree, 0): 0})
    basis = Quadratic(d, degrees) if many and degrees[-1] <= 2 else Hermite(d, degrees)
    if isinstance(basis, Hermite):
        count = num_polynomials(d, degrees[-1])
        need = item * count * (basis.pilots + len(degrees) * outputs)
        if need > _MOST_MEMORY:
            raise ValueError(
                f"`degree={degree}` has {count:,} polynomials in {d} dimensions, the fit "
                f"of which needs {need / 2**30:,.0f} GiB. Pass a smaller `degree`."
            )
    numbers = basis.sites * points * steps * d
    if numbers > _OUT_OF_PROPORTION:
        warnings.warn(
            f"The fit of `ValueFunctions` takes as long as {basis.sites * points:,} plain "
            "paths. Where `tol` or the time do not ask for it, pass "
            "`sampling=IndependentPaths(num_paths)`.",
            stacklevel=5,
        )
    return basis


def _controlled_paths(
    p: Problem, functions: Functions, wide, beyond, keys: PRNGKeyArray
) -> Samples:
    """A sample is a path, with its value and what `functions`, along an axis of levels, say
    of its noise. With `wide=1` the noise is wider, and of deviations `beyond` these there
    is an unbiased estimate nonetheless."""
    n = len(keys)

    def begin(level):
        noise, u = Noise.of(p, level), jtu.tree_map(lambda x: x[level.index], functions)

        def step(i, paths):
            at, second = lambda y: u(i, y), jtu.tree_map(lambda x: x[i], u.second)

            def one(y, state, key):
                x, log_ratio = noise.draw(key, i, wide * noise.share)
                return *noise.advance(i, y, state, at, second, x), log_ratio

            out = jax.vmap(one)(paths.y, paths.solver_state, keys)
            y, state, success, change, log_ratio = out
            # A path that failed has no value, and its control must be finite all the same.
            change = jnp.where(along(success, change), change, 0)
            control, ratios = paths.control
            control = control + change, ratios + log_ratio
            return paths.moved(p, y, state, success, control)

        dtype = jax.eval_shape(lambda: u(0, p.y0)).dtype
        same = lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x)))
        state = jtu.tree_map(same, noise.fresh(0, p.y0))
        control = jnp.zeros((n, *p.num_outputs), dtype), jnp.zeros(n, dtype)
        return step, Ensemble.start(p, n, state, control)

    def controlled(level, saved, paths):
        noise, u = Noise.of(p, level), jtu.tree_map(lambda x: x[level.index], functions)
        control, log_ratio = paths.control
        promised = noise.mean(0, p.y0, lambda y: u(0, y))
        first = (level.saved_steps == 0)[:, None]
        promised = jnp.where(first, p.values(p.t0, p.y0), promised)
        control = jnp.swapaxes(control, 0, 1).astype(saved.dtype)
        return saved, control, promised[:, None].astype(saved.dtype), log_ratio

    return samples(p, begin, finish=controlled, beyond=beyond)


class Noise(eqx.Module):
    r"""The random variables $x$ of the steps of a level. If their outcomes are few, a step
    is taken for each of them, and expectations are finite sums.

    Otherwise what stands for $u(y_1)$ less its expectation is made of the first and second
    derivatives $a$ and $C$ of $u(y_1(x))$ at $x = 0$. It is $a \cdot x + \frac12 (x^\top C
    x - \mathrm{tr}\, C \Sigma)$, with the variances $\Sigma$, and has mean zero whatever
    $a$ and $C$ are, so that one $C$ does for all paths. For a quadratic function and noise
    that enters the step linearly it is exact.
    """

    problem: Problem
    level: Level
    laws: tuple[Discrete, ...] = eqx.field(static=True)
    # Values and probabilities, if they are few.
    outcomes: tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]] | None

    @staticmethod
    def of(problem: Problem, level: Level) -> "Noise":
        """Raises a `ValueError` for random variables without finitely many outcomes."""
        laws = step_variables(problem.terms, level.h).laws
        discrete = tuple(law for law in laws if isinstance(law, Discrete))
        if len(discrete) < len(laws):
            raise ValueError(
                "`ValueFunctions` sums over the outcomes of a step, of which Gaussian "
                "increments have infinitely many. Use a `WeakBrownianPath` in place of the "
                "path in `terms`, or pass `sampling=ArrayRQMC(num_paths)`."
            )
        if math.prod(len(law.values) for law in discrete) > _MOST_OUTCOMES:
            return Noise(problem, level, discrete, None)
        values, probabilities = outcomes(discrete, 1)
        few = values.astype(problem.dtype), probabilities
        return Noise(problem, level, discrete, few)

    def draw(
        self, key: PRNGKeyArray, number, wide: Any = None
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """The variables of the key and this number. With the share `wide`, from 0 to 1, all
        outcomes have the same probability. And the logarithm of how much more often that
        makes the variables what they are."""
        words = random_words(key, (number, self.level.index), 1, len(self.laws))[0]
        x = jnp.zeros(len(self.laws), self.problem.dtype)
        log_ratio = jnp.zeros_like(x)
        for law in dict.fromkeys(self.laws):
            mine = np.array([other == law for other in self.laws])
            own, p = (
                law.from_words(words, x.dtype),
                np.array(law.probabilities, x.dtype),
            )
            if wide is not None:
                q = (1 - wide) * p + wide / len(p)
                cuts = (jnp.cumsum(q)[:-1] * 2.0**32).astype(jnp.uint32)
                place = jnp.sum(words[:, None] >= cuts, axis=1)
                own = jnp.where(wide > 0, jnp.asarray(law.values, x.dtype)[place], own)
                log_ratio = jnp.where(
                    mine & (wide > 0), jnp.log(q / p)[place], log_ratio
                )
            x = jnp.where(mine, own, x)
        return x, jnp.sum(log_ratio)

    @property
    def share(self) -> Array:
        """Of `draw`, so that all variables of a path together have an information of 8 nats
        against the law that they should have."""
        levels = len(self.problem.levels.h)
        coarser = 2 ** np.arange(levels)[::-1]
        steps = self.problem.max_steps / coarser
        low, high = np.zeros(levels), np.ones(levels)
        for _ in range(30):
            share = (low + high) / 2
            enough = (
                steps * sum(_information(x, share) for x in self.laws) > _NATS / levels
            )
            low, high = np.where(enough, low, share), np.where(enough, share, high)
        return jnp.asarray(low, self.problem.dtype)[self.level.index]

    def nodes(self, x: Array | None = None) -> tuple[Any, np.ndarray]:
        """Values of the variables, and weights with which their mean is the expectation;
        with a draw `x`, and unless outcomes are few, an estimate from two values."""
        if self.outcomes is not None:
            return self.outcomes
        if x is not None:
            return jnp.stack([x, -x]), np.full(2, 0.5)
        # Exact for polynomials of degree 3, and 5 in one variable.
        m, arms = len(self.laws), np.diag(np.sqrt(3 * self._variances()))
        points = np.concatenate([arms, -arms, np.zeros((1, m))])
        weights = np.append(np.full(2 * m, 1 / 6), 1 - m / 3)
        return points.astype(self.problem.dtype), weights

    def mean(self, i, y: Y, u: Function, x: Array | None = None) -> Array:
        """The expectation of `u` after step number `i` from `y`, by `nodes(x)`."""
        (points, weights), state = self.nodes(x), self.fresh(i, y)
        values = jax.vmap(lambda x: u(self.step(i, y, state, x)[0]))(points)
        return jnp.tensordot(weights.astype(values.dtype), values, 1)

    def advance(
        self, i, y: Y, state: PyTree, u: Function, second: Array | None, x: Array
    ) -> tuple[Y, PyTree, Bool[Array, ""], Array]:
        """The states after step number `i` of a path with these variables; whether the step
        succeeded; `u` there less its expectation, or what stands for that. `second` is what
        `second` returns."""
        if self.outcomes is None:
            assert second is not None
            y1, new, success = self.step(i, y, state, x)
            first = jax.jacrev(lambda x: u(self.step(i, y, state, x)[0]))(0 * x)
            square = jnp.outer(x, x) - np.diag(self._variances()).astype(x.dtype)
            control = jnp.tensordot(first, x, 1) + jnp.tensordot(square, second, 2) / 2
            return y1, new, success, control
        points, weights = self.outcomes
        ends, states, success = jax.vmap(lambda x: self.step(i, y, state, x))(points)
        values, own = jax.vmap(u)(ends), jnp.argmax(jnp.all(points == x, axis=1))
        mean = jnp.tensordot(weights.astype(values.dtype), values, 1)
        y1, new, value = jtu.tree_map(lambda x: x[own], (ends, states, values))
        return y1, new, jnp.all(success), value - mean

    def second(self, i, ys: Y, u: Function) -> Array | None:
        """The mean of the second derivatives at the states `ys`, if outcomes are many."""
        if self.outcomes is not None:
            return None
        zero = jnp.zeros(len(self.laws), self.problem.dtype)
        after = lambda y, x: u(self.step(i, y, self.fresh(i, y), x)[0])
        at = lambda y: jax.hessian(lambda x: after(y, x))(zero)
        mean = jnp.mean(jax.lax.map(at, ys), axis=0)
        return jnp.moveaxis(mean, (-2, -1), (0, 1))

    def step(self, i, y: Y, state: PyTree, x: Array):
        return self.problem.step(self._terms(x), i, self.level.h, y, state)

    def fresh(self, i, y: Y) -> PyTree[Array]:
        """The state of a solver that begins with step number `i`. It serves for a fit,
        which decides the variance only: a path takes its own state along."""
        terms = self._terms(np.zeros(len(self.laws)))
        return self.problem.init(terms, i, self.level.h, y)

    def _terms(self, x):
        return step_variables(self.problem.terms, self.level.h).terms_with(x)

    def _variances(self) -> np.ndarray:
        return np.array(
            [np.dot(x.probabilities, np.square(x.values)) for x in self.laws]
        )


def _information(law: Discrete, share: np.ndarray) -> np.ndarray:
    """Of a draw with this share of equal probabilities, against its law."""
    p = np.array(law.probabilities)
    q = (1 - share[:, None]) * p + share[:, None] / len(p)
    return np.sum(q * np.log(q / p), axis=1)
