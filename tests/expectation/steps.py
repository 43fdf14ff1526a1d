"""Problems as `expectation` makes them, for looks at steps, which take no samples, and for
samples alone, without the looks and trials that follow them."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu

import diffrax_symplectic as ds
from diffrax_symplectic._expectation.run import run
from diffrax_symplectic._simulation import Problem


def _total(t, y, args):
    return jnp.sum(jnp.stack([jnp.sum(x) for x in jtu.tree_leaves(y)]))


def problem_of(
    terms, solver, h, y0, args: Any = None, *, t0=0.0, num_steps=8, levels=2,
    phi=_total, ts=None,
) -> Problem:  # fmt: skip
    t1 = t0 + num_steps * h
    given = phi, terms, solver, t0, t1, h, y0, args, ts, levels
    return Problem.of(*given, key=jr.key(0))


def sampled(sampling, *given, key=None, **options) -> ds.Expectation:
    """The estimate of this problem."""
    key = jr.key(0) if key is None else key
    devices = tuple(jax.devices()[:1])
    plan = sampling.prepare(problem_of(*given, **options), key, devices)
    return run(plan, key, devices)


class Kicks(ds.AbstractSymplecticSolver):
    """A kick and a drift, by a user who knows that there are a drift and a noise."""

    variables: tuple[str, ...] = ("W",)
    structure = "separable"
    interpolation_cls = diffrax.LocalLinearInterpolation

    def stage_vectors(self, num_noises):
        return ()

    def order(self, terms):
        return 1

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        drift, noise = terms.terms
        p, q = y0
        force, _ = drift.vf(t0, y0, args)
        kick, _ = noise.vf_prod(t0, y0, args, noise.contr(t0, t1))
        p = p + (t1 - t0) * force + kick
        y1 = p, q + (t1 - t0) * p
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful
