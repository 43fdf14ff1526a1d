"""Value functions, fitted backwards in time at the states of a pilot run."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .._custom_types import Y
from .._root_finder import PicardNewton
from .._solver import AbstractImplicitStages
from .bases import AbstractBasis
from .problem import ravel
from .simulation import Paths


# The number of states over which second derivatives along the noise are averaged.
_SECOND = 32


class Functions(eqx.Module):
    """The value functions of a level, one after each step, for each time at which to
    average (`S`) and each component of `phi` (`m`); and for each candidate (`C`), until one
    is chosen."""

    # With a leading axis of steps.
    frames: PyTree[Array]
    coefficients: Float[Array, "steps P *C S m"]
    # Second derivatives along the noise, from `Noise.second`.
    second: Float[Array, "steps n n *C S m"] | None
    basis: AbstractBasis = eqx.field(static=True)

    def __call__(self, i, y: Y) -> Float[Array, "*C S m"]:
        """Their values at a state after step `i`."""
        frame = jtu.tree_map(lambda x: x[i], self.frames)
        return self.basis.combined(frame, ravel(y), self.coefficients[i])

    def chosen(self, best: Int[np.ndarray, "S m"]) -> "Functions":
        """The functions with one candidate for each component."""

        def take(c):
            index = best.reshape(*[1] * (c.ndim - 2), *best.shape)
            return jnp.take_along_axis(c, index, -3).squeeze(-3)

        c, second = jtu.tree_map(take, (self.coefficients, self.second))
        return Functions(self.frames, c, second, self.basis)


def without_newton(solver: Any) -> Any:
    """The solver, and all solvers in it, with a root finder that ends after its sweeps.

    Newton's method is a quarter of the time to compile a fit, and few of its states need
    it. A state at which the sweeps fail is left out of the fit.
    """

    def replaced(x: Any) -> Any:
        if not (_is_implicit(x) and isinstance(x.root_finder, PicardNewton)):
            return x
        sweeps = dataclasses.replace(x.root_finder, newton_steps=0)
        return eqx.tree_at(lambda solver: solver.root_finder, x, sweeps)

    return jtu.tree_map(replaced, solver, is_leaf=_is_implicit)


def _is_implicit(x: Any) -> bool:
    return isinstance(x, AbstractImplicitStages)


def fit(
    noise: Any, key: PRNGKeyArray, basis: AbstractBasis
) -> tuple[Functions, Int[Array, ""]]:
    """The functions of a level, for its noise: a pilot run forward, and fits backward; and
    how many of the pilot's paths failed."""
    p, level = noise.problem, noise.level
    y0, unravel = jfu.ravel_pytree(p.y0)
    steps, last = level.num_steps, p.max_steps
    keys = jr.split(key, basis.pilots)
    starts, states, good = _pilot(noise, keys)
    if p.y0_of is not None:
        y0 = jnp.mean(starts, axis=0)
    # Coordinates are scaled by how far they move. (Dividing by the largest value first
    # avoids underflow of squares in single precision.)
    off = jnp.where(good[:, None], jnp.abs(states - y0), 0)
    most = jnp.max(off, axis=(0, 1))
    share = good.astype(y0.dtype) / jnp.maximum(jnp.sum(good), 1)
    off = off / jnp.where(most > 0, most, 1)
    unit = most * jnp.sqrt(jnp.einsum("n,ind->d", share, off**2) / steps)
    frame = lambda i: basis.frame(states[i], good, unit)

    def fitted(i, u):
        after = jnp.minimum(i + 1, steps - 1)

        def value(x, key=None):
            y = unravel(x)
            draw = None if key is None else noise.draw(key, last + i)[0]
            later = noise.mean(after, y, lambda y: u(after, y), draw)
            phi = p.values(p.t0 + (i + 1) * level.h, y).astype(later.dtype)
            here, before = level.saved_steps == i + 1, level.saved_steps > i + 1
            return jnp.where(here[:, None], phi, jnp.where(before[:, None], later, 0))

        own = frame(i)
        return own, basis.fitted(value, own, states[i], good, keys)

    def backward(j, u):
        i = steps - 1 - j
        put = lambda all, one: all.at[i].set(one)
        both = jtu.tree_map(put, (u.frames, u.coefficients), fitted(i, u))
        return Functions(both[0], both[1], None, basis)

    zeros = lambda s: jnp.zeros((last, *s.shape), s.dtype)
    frames = jtu.tree_map(zeros, jax.eval_shape(lambda: frame(0)))
    shape = last, basis.size, len(basis.candidates), *p.num_outputs
    u = Functions(frames, jnp.zeros(shape, p.dtype), None, basis)
    u = lax.fori_loop(0, steps, backward, u)

    def kept(args):
        i, few = args
        return noise.second(i, jax.vmap(unravel)(few), lambda y: u(i, y))

    # Some states before each step.
    few = jnp.concatenate([starts[None], states[:-1]])[:, :_SECOND]
    second = lax.map(kept, (jnp.arange(last), few))
    return Functions(u.frames, u.coefficients, second, basis), jnp.sum(~good)


def _pilot(noise: Any, keys: PRNGKeyArray):
    """The states of the pilot's paths at the start and after each step, and which paths are
    good."""
    p, last = noise.problem, noise.problem.max_steps

    def forward(i, carry):
        def one(y, args, key):
            # With equal probabilities the pilot spreads further than the paths, so that
            # the fit also holds for outliers.
            x, _ = noise.draw(key, i, jnp.ones(()))
            own = noise.with_args(args)
            return own.step(i, y, own.fresh(i, y), x)

        paths, states = carry
        y, _, success = jax.vmap(one)(paths.y, paths.args, keys)
        paths = paths.moved(p, y, None, success)
        return paths, states.at[i].set(jax.vmap(ravel)(paths.y))

    y, args = jax.vmap(p.drawn)(keys)
    paths = Paths.start(p, y, args, None)
    starts = jax.vmap(ravel)(paths.y)
    states = jnp.broadcast_to(starts, (last, *starts.shape))
    carry = paths, states
    paths, states = lax.fori_loop(0, noise.level.num_steps, forward, carry)
    return starts, states, ~paths.failed
