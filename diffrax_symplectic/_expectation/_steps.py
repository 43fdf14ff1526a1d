"""Paths that take fixed steps together: the loop that all samplings share."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .._custom_types import Args, RealScalarLike, Y


class Level(eqx.Module):
    """One step size: which one, counted from the coarsest, how many steps there are, and
    after which of them to average."""

    index: Int[Array, ""]
    h: Float[Array, ""]
    num_steps: Int[Array, ""]
    saved_steps: Int[Array, " saves"]


class Problem(eqx.Module):
    """What is asked for: the arguments of `expectation` of the same names, and the levels,
    along a leading axis."""

    phi: Callable[[RealScalarLike, Y, Args], PyTree[Array]]
    terms: PyTree[diffrax.AbstractTerm]
    solver: diffrax.AbstractSolver
    t0: Float[Array, ""]
    y0: Y
    args: Args
    levels: Level
    # The combinations of the means of the levels that are averaged, an array with equal
    # weights being the same program.
    weights: Float[Array, "combinations levels"]
    # Whether there is one time at which to average, without an axis for it.
    at_end: bool = eqx.field(static=True)
    # Steps of the finest level. (An array has to know its size when it is compiled.)
    max_steps: int = eqx.field(static=True)

    def level(self, index: int) -> Level:
        return jtu.tree_map(lambda x: x[index], self.levels)

    def init(self, terms, i, h: Float[Array, ""], y: Y) -> PyTree[Array]:
        """The arrays of the solver's state before step number `i`. The rest of it does not
        change."""
        t = self.t0 + i * h
        state = self.solver.init(terms, t, t + h, y, self.args)
        return eqx.filter(state, eqx.is_array)

    def step(self, terms, i, h, y: Y, state) -> tuple[Y, PyTree, Bool[Array, ""]]:
        """One step of one path, and whether it succeeded."""
        t, next_t = self.t0 + i * h, self.t0 + (i + 1) * h
        fresh = eqx.filter_eval_shape(self.solver.init, terms, t, next_t, y, self.args)
        is_struct = lambda x: isinstance(x, jax.ShapeDtypeStruct)
        state = eqx.combine(state, eqx.filter(fresh, is_struct, inverse=True))
        y, _, _, state, result = self.solver.step(
            terms, t, next_t, y, self.args, state, made_jump=False
        )
        state = eqx.filter(state, eqx.is_array)
        return y, state, diffrax.is_okay(result) & is_finite(y)

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*jtu.tree_leaves(self.y0))

    @property
    def num_outputs(self) -> tuple[int, int]:
        """How many times there are at which to average, and how many numbers `phi` has."""
        leaves = jtu.tree_leaves(jax.eval_shape(self.phi, self.t0, self.y0, self.args))
        return self.levels.saved_steps.shape[1], sum(x.size for x in leaves)


class Ensemble(eqx.Module):
    """Paths, along the first axis of each array."""

    y: Y
    solver_state: PyTree[Array]
    # A path that failed counts as failed until the end. It goes on from `y0`: an equation
    # without a solution would keep the other paths waiting in each step to come.
    failed: Bool[Array, " n"]

    @staticmethod
    def start(p: Problem, n: int, state: PyTree[Array]) -> "Ensemble":
        y = jtu.tree_map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), p.y0)
        return Ensemble(y, state, jnp.zeros(n, bool))

    def moved(self, p: Problem, y, state, success) -> "Ensemble":
        """The paths after a step to `y`, with those that failed put back."""
        failed = self.failed | ~success
        keep = lambda new, old: jnp.where(along(failed, new), old, new)
        state = jtu.tree_map(keep, state, self.solver_state)
        return Ensemble(jtu.tree_map(keep, y, p.y0), state, failed)


def simulate(
    p: Problem,
    level: Level,
    ensemble: Ensemble,
    step: Callable[[Int[Array, ""], Ensemble, Any], tuple[Ensemble, Any]],
    carried: Any,
    measure: Callable[[Array, Bool[Array, " n"]], Array],
) -> tuple[PyTree[Array], Ensemble, Any]:
    """Takes all steps of a level by `step(i, ensemble, carried)`. Returns what `measure`
    makes of the values of `phi` and of which paths have failed, with an axis in front for
    the saved steps; and the paths and what was carried along at the end."""

    def recorded(ensemble: Ensemble, saved, i):
        t = p.t0 + i * level.h

        def record():
            phi = jax.vmap(lambda y: p.phi(t, y, p.args))(ensemble.y)
            phi = jtu.tree_map(lambda x: x.astype(real(x.dtype)), phi)
            failed = ensemble.failed | ~jax.vmap(is_finite)(phi)
            here = level.saved_steps == i
            put = lambda old, x: jnp.where(along(here, old), measure(x, failed), old)
            return failed, jtu.tree_map(put, saved, phi)

        # A conditional with one predicate for all paths: `phi` is not evaluated otherwise.
        here = jnp.any(level.saved_steps == i)
        failed, saved = lax.cond(here, record, lambda: (ensemble.failed, saved))
        return Ensemble(ensemble.y, ensemble.solver_state, failed), saved

    def body(i, carry):
        ensemble, carried, saved = carry
        ensemble, carried = step(i, ensemble, carried)
        ensemble, saved = recorded(ensemble, saved, i + 1)
        return ensemble, carried, saved

    n, saves = len(ensemble.failed), len(level.saved_steps)

    def empty(s):
        one = jax.ShapeDtypeStruct((n, *s.shape), real(s.dtype))
        shape = jax.eval_shape(measure, one, ensemble.failed)
        return jnp.zeros((saves, *shape.shape), shape.dtype)

    saved = jtu.tree_map(empty, jax.eval_shape(p.phi, p.t0, p.y0, p.args))
    ensemble, saved = recorded(ensemble, saved, 0)
    carry = ensemble, carried, saved
    ensemble, carried, saved = lax.fori_loop(0, level.num_steps, body, carry)
    return saved, ensemble, carried


def independent_steps(
    p: Problem, level: Level, n: int, terms_of: Callable, randomness: Callable
) -> tuple[Callable[[Any, Ensemble, Any], tuple[Ensemble, Any]], Ensemble]:
    """What takes a step of `n` paths, and these at the start. Each has the terms
    `terms_of` its part of `randomness(i)` in step number `i`."""

    def step(i, ensemble, carried):
        def one(random, y, state):
            return p.step(terms_of(random), i, level.h, y, state)

        out = jax.vmap(one)(randomness(i), ensemble.y, ensemble.solver_state)
        return ensemble.moved(p, *out), carried

    start = lambda random: p.init(terms_of(random), 0, level.h, p.y0)
    return step, Ensemble.start(p, n, jax.vmap(start)(randomness(0)))


class Samples(eqx.Module):
    """Samples along the first axis: their values, which of them are good, and how many
    paths failed in each."""

    values: PyTree[Array]
    good: Bool[Array, " n"]
    failed: Int[Array, " n"]


class AbstractSampler(eqx.Module):
    """Makes samples of random keys: paths, or whatever else estimates of the mean can be
    averaged."""

    @abc.abstractmethod
    def __call__(self, keys: PRNGKeyArray) -> Samples:
        """One sample for each key."""


class AbstractLevelSampler(AbstractSampler):
    """Estimates the means of a problem on each level. Their combinations, along a new axis
    in front, are what is averaged."""

    problem: eqx.AbstractVar[Problem]

    @abc.abstractmethod
    def on_level(
        self, keys: PRNGKeyArray, level: Level
    ) -> tuple[PyTree[Array], Bool[Array, " n"], Bool[Array, " n"] | Int[Array, " n"]]:
        """Values of `phi` with axes in front for the saved steps and the samples; which
        samples are good; how many paths failed in each, or whether the only one did."""

    def __call__(self, keys: PRNGKeyArray) -> Samples:
        p = self.problem
        one = lambda level: self.on_level(keys, level)
        if len(p.levels.h) == 1:
            out = jtu.tree_map(lambda x: x[None], one(p.level(0)))
        else:
            # One program for all levels.
            out = lax.map(one, p.levels)
        values, good, failed = out

        def combined(x):
            x = jnp.moveaxis(jnp.tensordot(p.weights.astype(x.dtype), x, 1), 2, 0)
            return x[:, :, 0] if p.at_end else x

        # A path fails once, on however many levels.
        total = jnp.any if failed.dtype == bool else jnp.sum
        failed = total(failed, axis=0).astype(int)
        return Samples(jtu.tree_map(combined, values), jnp.all(good, axis=0), failed)


class Plan(NamedTuple):
    """How samples are taken.

    - `num_samples`: how many at most, those of an estimate to go on from included.
    - `batch_size`: how many each device takes at once.
    - `paths`: how many paths a sample has, on each level.
    - `least`: fewer samples than this do not tell their spread well enough to stop.
    """

    num_samples: int
    batch_size: int
    paths: int = 1
    least: int = 2


class Prepared(NamedTuple):
    """A sampler, how many samples it is to take, and what the result says about it."""

    sampler: AbstractSampler
    plan: Plan
    reason: str = ""


class AbstractSampling(eqx.Module):
    """How the samples of an expectation are taken, as users name it."""

    @abc.abstractmethod
    def prepare(self, problem: Problem, key: PRNGKeyArray, devices: tuple) -> Prepared:
        """Raises a `ValueError` for what it cannot do."""


def level_weights(order: int, levels: int) -> Float[np.ndarray, "combinations levels"]:
    r"""The combinations of the means with steps $h, h/2, h/4, \ldots$ that an
    [`diffrax_symplectic.Expectation`][] holds, for a method of weak order $p$. The first
    has no terms in $h^p, \ldots, h^{p + L - 2}$ for $L$ levels, and with $L > 1$ there are
    two more: the mean of the finest level less the first, and what the last extrapolation
    changed.

    [Talay and Tubaro (1990)](https://doi.org/10.1080/07362999008809220) show that the error
    has an expansion in powers of $h$.
    """
    best = _extrapolated(order, levels)
    if levels == 1:
        return best[None]
    # The finer levels alone, with one power of the step size less.
    before = np.append(0.0, _extrapolated(order, levels - 1))
    return np.stack([best, np.eye(levels)[-1] - best, best - before])


def _extrapolated(order: int, levels: int) -> Float[np.ndarray, " levels"]:
    powers = np.array([0, *range(order, order + levels - 1)])
    system = 2.0 ** -np.outer(powers, np.arange(levels))
    return np.linalg.solve(system, np.eye(levels)[0])


def along(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask of the first axis, to go with an array."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))


def is_finite(tree: PyTree[Array]) -> Bool[Array, ""]:
    leaves = [jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(tree)]
    return jnp.all(jnp.stack(leaves))


def real(dtype) -> Any:
    return jnp.result_type(dtype, float)


def ravel(y: Y) -> Float[Array, " d"]:
    return jfu.ravel_pytree(y)[0]


def check_real(name: str, leaves: list) -> None:
    kinds = jnp.floating, jnp.integer, jnp.bool_
    is_real = lambda s: any(jnp.issubdtype(jnp.result_type(s), k) for k in kinds)
    if len(leaves) == 0 or not all(map(is_real, leaves)):
        raise ValueError(
            f"`{name}` must return real arrays; got dtypes "
            f"{[str(jnp.result_type(s)) for s in leaves]}. Return real and imaginary parts."
        )
