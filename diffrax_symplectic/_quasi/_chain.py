"""All paths of one randomization, a step of all of them after the other."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, UInt32

from .._custom_types import Args, RealScalarLike, Y
from ._given_words import Layout, with_words
from ._point_set import num_seeds, randomized
from ._sorting import hilbert_order


class Problem(eqx.Module):
    """What is asked for: the arguments of `quasi_expectation` of the same names, and the
    points of `sobol_points` with a coordinate for each random variable of a step."""

    phi: Callable[[RealScalarLike, Y, Args], PyTree[Array]]
    sort_by: Callable[[Y], PyTree[Array]]
    terms: PyTree[diffrax.AbstractTerm]
    solver: diffrax.AbstractSolver
    t0: Float[Array, ""]
    y0: Y
    args: Args
    points: UInt32[Array, "n d"]
    layout: Layout = eqx.field(static=True)

    def terms_with(self, words: UInt32[Array, " d"]) -> PyTree[diffrax.AbstractTerm]:
        return with_words(self.terms, self.layout, words)


class _Ensemble(eqx.Module):
    """The paths, in the order in which they are sorted."""

    y: Y
    # The arrays of the solver's state. The rest of it does not change.
    solver_state: PyTree[Any]
    # A path that failed counts as failed until the end. It goes on from `y0`: an equation
    # without a solution would keep the other paths waiting in each step to come.
    failed: Bool[Array, " n"]


def replicate(
    problem: Problem,
    key: PRNGKeyArray,
    h: Float[Array, ""],
    num_steps: Int[Array, ""],
    saved_steps: Int[Array, " saves"],
) -> tuple[PyTree[Float[Array, "saves ..."]], Int[Array, ""]]:
    """The means of `phi` after so many steps, over the paths that have not failed, and how
    many have at the end. Array-RQMC, algorithm 1 of
    [L'Ecuyer, Lécot and Tuffin (2008)](https://doi.org/10.1287/opre.1080.0556)."""
    p = problem
    n, dimension = p.points.shape

    def words(step):
        seeds = jr.bits(jr.fold_in(key, step), (num_seeds(dimension),), jnp.uint32)
        return randomized(p.points, seeds, p.layout.sixths)

    def start(words):
        terms = p.terms_with(words)
        return p.solver.init(terms, p.t0, p.t0 + h, p.y0, p.args)

    def step(i, carry):
        ensemble, means = carry
        order = hilbert_order(coordinates(p.sort_by, ensemble.y), ensemble.failed)
        ensemble = jtu.tree_map(lambda x: x[order], ensemble)
        ensemble = _advanced(p, ensemble, static, words(i), i, h)
        return _recorded(p, ensemble, means, i + 1, h, saved_steps)

    y = jtu.tree_map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), p.y0)
    state, static = eqx.partition(eqx.filter_vmap(start)(words(0)), eqx.is_array)
    ensemble = _Ensemble(y, state, jnp.zeros(n, bool))
    phi = jax.eval_shape(p.phi, p.t0, p.y0, p.args)
    shape = lambda s: jnp.zeros((len(saved_steps), *s.shape), _real(s.dtype))
    means = jtu.tree_map(shape, phi)
    carry = _recorded(p, ensemble, means, 0, h, saved_steps)
    ensemble, means = lax.fori_loop(0, num_steps, step, carry)
    return means, jnp.sum(ensemble.failed)


def coordinates(sort_by, y: Y) -> Float[Array, "n d"]:
    """What the paths are sorted by, as one array."""
    leaves = jtu.tree_leaves(jax.vmap(sort_by)(y))
    columns = [jnp.reshape(leaf, (len(leaf), -1)) for leaf in leaves]
    return jnp.concatenate([x.astype(_real(x.dtype)) for x in columns], axis=1)


def _advanced(
    p: Problem, ensemble: _Ensemble, static, words: UInt32[Array, "n d"], i, h
) -> _Ensemble:
    """After one step."""
    t, next_t = p.t0 + i * h, p.t0 + (i + 1) * h

    def one(y, state, words):
        terms, state = p.terms_with(words), eqx.combine(state, static)
        y, _, _, state, result = p.solver.step(
            terms, t, next_t, y, p.args, state, made_jump=False
        )
        finite = [jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(y)]
        success = diffrax.is_okay(result) & jnp.all(jnp.stack(finite))
        return y, eqx.filter(state, eqx.is_array), success

    y, state, success = jax.vmap(one)(ensemble.y, ensemble.solver_state, words)
    failed = ensemble.failed | ~success
    keep = lambda new, old: jnp.where(_along(failed, new), old, new)
    return _Ensemble(
        jtu.tree_map(keep, y, p.y0),
        jtu.tree_map(keep, state, ensemble.solver_state),
        failed,
    )


def _recorded(
    p: Problem, ensemble: _Ensemble, means, step, h, saved_steps
) -> tuple[_Ensemble, PyTree[Float[Array, "saves ..."]]]:
    """With the means of `phi` after this step, where they are asked for."""

    def record():
        t = p.t0 + step * h
        phi = jax.vmap(lambda y: p.phi(t, y, p.args))(ensemble.y)
        leaves, treedef = jtu.tree_flatten(phi)
        finite = [jnp.isfinite(x).reshape(len(x), -1).all(axis=1) for x in leaves]
        failed = ensemble.failed | ~jnp.stack(finite).all(axis=0)
        saved = saved_steps == step
        put = lambda mean, x: jnp.where(_along(saved, mean), _mean(x, ~failed), mean)
        phi = treedef.unflatten(leaves)
        return failed, jtu.tree_map(put, means, phi)

    # A conditional with one predicate for all paths: `phi` is not evaluated otherwise.
    failed, means = lax.cond(
        jnp.any(saved_steps == step), record, lambda: (ensemble.failed, means)
    )
    return _Ensemble(ensemble.y, ensemble.solver_state, failed), means


def _mean(x: Array, good: Bool[Array, " n"]) -> Float[Array, "..."]:
    x = jnp.where(_along(good, x), x.astype(_real(x.dtype)), 0)
    # In two stages, so that rounding errors in single precision do not add up.
    rows = 1 << ((len(x).bit_length() - 1) // 2)
    total = jnp.sum(jnp.sum(x.reshape(rows, -1, *x.shape[1:]), axis=0), axis=0)
    return total / jnp.sum(good).astype(total.dtype)


def _along(mask: Bool[Array, " n"], x: Array) -> Array:
    """A mask of the paths, to go with an array that has them along its first axis."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))


def _real(dtype):
    return jnp.result_type(dtype, float)
