"""Linear models and the solvers that take them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx

import diffrax_symplectic as ds


def weak(key, shape=(), **kwargs):
    return ds.WeakBrownianPath(shape, key, **kwargs)


def gaussian(key, shape=()):
    return ds.FixedStepBrownianPath(shape, key)


def areas(key, shape=()):
    return ds.SRKs4().path(shape, key)


def stationary(matrix: np.ndarray, forever: float) -> np.ndarray:
    """The moments that `matrix`, of a step, or a generator with `forever = 0`, keeps."""
    left = np.eye(len(matrix)) * forever - matrix
    moments = np.zeros(len(matrix))
    moments[0] = 1
    rest, *_ = np.linalg.lstsq(left[1:, 1:], -left[1:, 0], rcond=None)
    moments[1:] = rest
    return moments


def with_newton(solver):
    """The solver with a root finder that is exact for linear systems, and compiled sooner.
    The results are the same."""
    if isinstance(solver, ds.BAOAB) and solver.flow is not None:
        return dataclasses.replace(solver, flow=with_newton(solver.flow))
    if hasattr(solver, "root_finder"):
        newton = optx.Newton(rtol=1e-12, atol=1e-12)
        return dataclasses.replace(solver, root_finder=newton)
    return solver


class Case(NamedTuple):
    """A solver with the random variables that it is meant for."""

    solver: diffrax.AbstractSolver
    path: Callable
    # The models it takes.
    models: tuple[str, ...] = ("linear", "kubo", "spring")


_SEPARABLE = ("linear", "spring")
GENERAL = {
    "ImplicitMidpoint": Case(ds.ImplicitMidpoint(), weak),
    "SRKw1(b=0)": Case(ds.SRKw1(b=0.0), weak),
    "StrangGauss": Case(ds.StrangGauss(), weak),
}
SEPARABLE = {
    "SRKs3": Case(ds.SRKs3(), weak, _SEPARABLE),
    "SRKw4": Case(ds.SRKw4(), weak, _SEPARABLE),
}
EXPLICIT = {
    "Heun": Case(diffrax.Heun(), gaussian),
    "EulerHeun": Case(diffrax.EulerHeun(), gaussian),
    "SlowRK": Case(diffrax.SlowRK(), areas),
    # For an Ito equation: where the noise is not additive it gets the corrected drift.
    "Euler": Case(diffrax.Euler(), gaussian),
}

# Noise Hamiltonians of an oscillator with H0 = (p^2 + q^2) / 2, before the factor s.
NOISE = {
    # dp = -q dt + s dw, dq = p dt
    "linear": lambda p, q: -q,
    # dp = -q dt - s q o dw, dq = p dt + s p o dw: every path stays on its circle.
    "kubo": lambda p, q: (p**2 + q**2) / 2,
    # dp = -q dt - s q dw, dq = p dt: a noisy spring, which pumps energy in.
    "spring": lambda p, q: q**2 / 2,
}
Y0 = (jnp.zeros(()), jnp.zeros(()))


def _terms(case: Case):
    """`args` are the strengths of the models' noises."""
    energy = lambda t, p, q, args: (p**2 + q**2) / 2

    def noise(t, p, q, args):
        parts = zip(case.models, args)
        return jnp.asarray(sum(s * NOISE[name](p, q) for name, s in parts))

    terms = ds.hamiltonian_terms(energy, noise, case.path(jr.key(0)))
    if not isinstance(case.solver, diffrax.Euler):
        return terms
    drift, diffusion = terms.terms

    def corrected(t, y, args):
        # The equivalent Ito equation: -s^2 y / 2 for the rotation by Kubo's noise, and
        # nothing for the others, one of them at a time.
        s = args[case.models.index("kubo")]
        return jax.tree.map(lambda f, x: f - s**2 * x / 2, drift.vf(t, y, args), y)

    return diffrax.MultiTerm(diffrax.ODETerm(corrected), diffusion)


def moment_maps(case: Case, hs, strengths) -> dict[str, np.ndarray]:
    """For each model the maps of (E p^2, E pq, E qp, E q^2) by one step, with what additive
    noise adds left out: `maps[i, j]` for `hs[i]` and `strengths[j]`."""
    terms = _terms(case)
    one = lambda h, args: ds.second_moment_map(terms, case.solver, 0.0, h, Y0, args)
    # One program for all models.
    units = jnp.asarray(strengths)[:, None] * jnp.eye(len(case.models))[:, None]
    over_args = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(None, 0))
    K = jax.jit(jax.vmap(over_args, in_axes=(0, None)))(jnp.asarray(hs), units)
    quadratic = [4, 5, 7, 8]
    K = np.asarray(K)[..., quadratic, :][..., quadratic]
    return {name: K[:, i] for i, name in enumerate(case.models)}


def growth_factors(maps: np.ndarray) -> np.ndarray:
    """The factor by which mean squares grow in each step, in the long run."""
    return np.max(np.abs(np.linalg.eigvals(maps)), axis=-1)


def spring_growth_rate(strengths) -> np.ndarray:
    """The exact rate at which second moments of the noisy spring grow: the positive root
    of x^3 + 4 x = 2 s^2, from d/dt (E q^2, E pq, E p^2)."""
    roots = [np.roots([1, 0, 4, -2 * s**2]) for s in np.atleast_1d(strengths)]
    return np.array([np.max(r.real[np.abs(r.imag) < 1e-9]) for r in roots])
