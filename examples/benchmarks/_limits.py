"""Where quasi-Monte Carlo stops to gain: with the number of dimensions, and in chaos."""

import warnings
from collections.abc import Callable

import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

from ..hard_cases import chain, henon_heiles


def gains(
    terms,
    y0,
    phi: Callable,
    ts: list[float],
    h: float,
    paths: int,
    replicates: int,
    sort_by: Callable | None = None,
) -> np.ndarray:
    """The variance of a mean of independent paths over that of as many in a replicate, at
    each of the times; of a few functions the geometric mean."""

    def moments(t, y, args):
        values = phi(y)
        return jnp.stack([values, values**2])

    with warnings.catch_warnings():
        # That neighbours are far apart, which is what is measured here.
        warnings.simplefilter("ignore")
        estimate = ds.expectation(
            moments, terms, ds.StormerVerlet(), 0.0, ts[-1], h, y0, ts=ts,
            key=jr.key(0), sampling=ds.ArrayRQMC(paths, replicates, sort_by), levels=1,
        )  # fmt: skip
    assert estimate.num_failed == 0
    mean, square = np.moveaxis(estimate.mean, 1, 0)
    spread = estimate.variance[:, 0]
    return np.exp(np.mean(np.log((square - mean**2) / paths / spread), axis=-1))


def _path(noises: int):
    return ds.FixedStepBrownianPath((noises,), jr.key(0))


def _chain(n: int, s: float):
    """A nonlinear chain with a noise on each of its oscillators, from its slowest mode, and
    functions that are not linear in the noise."""
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: chain.energy(p, q, 0.5),
        lambda t, p, q, args: -s * q,
        _path(n),
    )
    mode = jnp.sin(jnp.pi * jnp.arange(1, n + 1) / (n + 1))
    phi = lambda y: jnp.stack([jnp.mean(y[1] ** 2), (mode @ y[1]) ** 2])
    return terms, (jnp.zeros(n), mode), phi, lambda y: (mode @ y[0], mode @ y[1])


def dimensions(n: int, s: float, by_mode: bool, quick: bool = False) -> float:
    """Of the chain at t = 2, sorted by the whole state, or by position and momentum of the
    slowest mode."""
    terms, y0, phi, slowest = _chain(n, s)
    paths, replicates = (2**6, 8) if quick else (2**12, 64)
    sort_by = slowest if by_mode else None
    gain = gains(terms, y0, phi, [2.0], 1 / 8, paths, replicates, sort_by)
    return float(gain[0])


def many(ts: list[float], quick: bool = False) -> np.ndarray:
    """Of the chain of 32 with strong noise, after longer and longer times."""
    terms, y0, phi, _ = _chain(2 if quick else chain.N, 1.0)
    paths, replicates = (2**6, 8) if quick else (2**10, 128)
    return gains(terms, y0, phi, ts, 1 / 8, paths, replicates)


def chaos(ts: list[float], quick: bool = False) -> np.ndarray:
    """Of the Hénon-Heiles system in its chaotic sea, after longer and longer times."""
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: henon_heiles.energy(p, q),
        lambda t, p, q, args: -0.001 * q,
        _path(2),
    )
    phi = lambda y: jnp.concatenate([*y, y[0] ** 2])
    paths, replicates = (2**6, 8) if quick else (2**10, 128)
    return gains(terms, henon_heiles.start(0.13), phi, ts, 0.1, paths, replicates)


SIZES, STRENGTHS = (1, 4, 32), (0.1, 1.0)
LONG = {
    "Hénon-Heiles": [5.0, 10.0, 20.0, 40.0, 80.0, 160.0],
    "chain": [2.0, 5.0, 10.0, 20.0],
}


def limits(quick: bool = False) -> dict:
    sizes, strengths, at = ((2,), (1.0,), 1) if quick else (SIZES, STRENGTHS, None)
    return {
        "dimensions": [
            [n, *(dimensions(n, s, m, quick) for s in strengths for m in (False, True))]
            for n in sizes
        ],
        "Hénon-Heiles": chaos(LONG["Hénon-Heiles"][:at], quick).tolist(),
        "chain": many(LONG["chain"][:at], quick).tolist(),
    }
