"""The problems that looks at steps are tested on: these take no samples."""

from typing import Any

import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu

from diffrax_symplectic._simulation import Problem


def _total(t, y, args):
    return jnp.sum(jnp.stack([jnp.sum(x) for x in jtu.tree_leaves(y)]))


def problem_of(
    terms, solver, h, y0, args: Any = None, *, t0=0.0, num_steps=8, levels=2
) -> Problem:
    """As `expectation` makes it."""
    t1 = t0 + num_steps * h
    given = _total, terms, solver, t0, t1, h, y0, args, None, levels
    return Problem.of(*given, key=jr.key(0))
