"""How far `ds.ValueFunctions` goes: total errors against exact values, and seconds,
compilation aside:

    python -m examples.benchmarks.expectations [MODEL ...]

Prints the rows of a table. Exact values are known in closed form, or they are computed
backwards in time on Chebyshev grids (synchrotron, Hénon-Heiles). Those of the pendulum and
of the double well come from another solver, with as many digits.
"""

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

from .. import linear_oscillator, synchrotron
from ..hard_cases import chain
from . import _exact
from ._ensembles import MODELS
from .work_precision import two_noises


class Case(NamedTuple):
    """A model, and how it is estimated."""

    phi: Callable
    terms: Any
    solver: Any
    t1: float
    steps: int
    y0: Any
    levels: int
    degree: int
    paths: int
    exact: Callable[[], Any]


Y0 = (jnp.array(0.0), jnp.array(1.0))
_q2 = lambda t, y, args: y[1] ** 2
_one = ds.WeakBrownianPath((), jr.key(0))


def _harmonic(t, p, q, args):
    return (p**2 + q**2) / 2


def _quartic(t, p, q, args):
    return (p**2 + q**2) / 2 + 0.1 * (p**4 + q**4)


def _pendulum(path):
    kicks = lambda t, p, q, args: 0.4 * jnp.cos(q) + 0.1 * q
    H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
    return ds.hamiltonian_terms(H0, kicks, path)


def _double_well(path):
    H0 = lambda t, p, q, args: p**2 / 2 + q**4 / 4 - q**2 / 2
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.3 * jnp.sin(q), path)


def _quartic_kubo(path):
    return ds.hamiltonian_terms(_quartic, lambda *x: 0.3 * _quartic(*x), path)


def _quartic_two(path):
    noise = lambda t, p, q, args: 0.3 * jnp.stack([p * q, (q**2 - p**2) / 2])
    return ds.hamiltonian_terms(_quartic, noise, path)


def by_another_solver(terms, phi, y0, t1, steps) -> float:
    """With `StrangGauss`, whose error of discretization is another one."""
    return float(
        ds.expectation(
            phi, terms, ds.StrangGauss(), 0.0, t1, t1 / steps, y0, levels=4,
            key=jr.key(100), sampling=ds.ValueFunctions(8, 2**14),
        ).mean
    )  # fmt: skip


def quartic_kubo_square() -> float:
    r"""The noise only changes time: the deterministic flow at $1 + 0.3 w(1)$, averaged by
    Gauss--Hermite quadrature."""
    x, w = np.polynomial.hermite_e.hermegauss(60)
    times = jnp.asarray(1 + 0.3 * x)
    n = 400

    def flow(t):
        h = t / n

        def f(y):
            p, q = y
            return jnp.stack([-q - 0.4 * q**3, p + 0.4 * p**3])

        def step(i, y):
            a = f(y)
            b = f(y + h / 2 * a)
            c = f(y + h / 2 * b)
            return y + h / 6 * (a + 2 * b + 2 * c + f(y + h * c))

        return jax.lax.fori_loop(0, n, step, jnp.array([0.0, 1.0]))[1] ** 2

    return float(np.asarray(jax.vmap(flow)(times)) @ w / w.sum())


_henon = MODELS["Hénon-Heiles"]
_verlet = ds.StormerVerlet()
_two = lambda: ds.WeakBrownianPath((2,), jr.key(0), two_point=True)
_chain = lambda s: ds.hamiltonian_terms(
    lambda t, p, q, args: chain.energy(p, q, 0.5),
    lambda t, p, q, args: -s * q,
    ds.WeakBrownianPath((chain.N,), jr.key(0)),
)

CASES = {
    "linear oscillator": Case(
        _q2, linear_oscillator.make_terms(_one), _verlet,
        1.0, 4, linear_oscillator.Y0, 5, 2, 512, _exact.linear_oscillator_square,
    ),
    "Kubo oscillator": Case(
        _q2, ds.hamiltonian_terms(_harmonic, _harmonic, _one), ds.StrangGauss(),
        1.0, 4, Y0, 6, 2, 512, _exact.kubo_square,
    ),
    "pendulum": Case(
        _q2, _pendulum(_one), _verlet, 2.0, 16, Y0, 4, 8, 4096,
        lambda: by_another_solver(_pendulum(_one), _q2, Y0, 2.0, 16),
    ),
    "synchrotron": Case(
        lambda t, y, args: y[0] ** 2,
        synchrotron.make_terms(ds.WeakBrownianPath((2,), jr.key(0))), _verlet,
        2.0, 16, synchrotron.Y0, 4, 8, 4096,
        lambda: _exact.by_transfer(
            synchrotron.make_terms, synchrotron.Y0, lambda y: y[0] ** 2, 2.0, 512,
            (1.0, 0.6), 20,
        ),
    ),
    "double well": Case(
        _q2, _double_well(_one), _verlet, 2.0, 20, (jnp.array(0.0), jnp.array(1.2)), 4, 8,
        4096,
        lambda: by_another_solver(
            _double_well(_one), _q2, (jnp.array(0.0), jnp.array(1.2)), 2.0, 20
        ),
    ),
    "quartic Kubo": Case(
        _q2, _quartic_kubo(_one), ds.StrangGauss(), 1.0, 4, Y0, 5, 8, 2**14,
        quartic_kubo_square,
    ),
    "Hénon-Heiles": Case(
        lambda t, y, args: y[1][0] ** 2,
        _henon.make_terms(ds.WeakBrownianPath((2,), jr.key(0))), _verlet,
        5.0, 32, _henon.y0, 3, 5, 4096, _henon.exact,
    ),
    "two noises, linear": Case(
        _q2, two_noises(_two()), ds.NinomiyaVictoir(), 1.0, 4, Y0, 4, 2, 512,
        _exact.two_noises_square,
    ),
    "two noises, quartic": Case(
        _q2, _quartic_two(_two()), ds.NinomiyaVictoir(), 1.0, 8, Y0, 3, 8, 2**14,
        lambda: np.nan,
    ),
    "chain of 32, s = 0.1": Case(
        lambda t, y, args: jnp.mean(y[1] ** 2), _chain(0.1), _verlet, 2.0, 16,
        chain.start(1.0), 3, 2, 4096, lambda: np.nan,
    ),
}  # fmt: skip


def row(name: str) -> str:
    c = CASES[name]

    def run(seed: int):
        begin = time.perf_counter()
        e = ds.expectation(
            c.phi, c.terms, c.solver, 0.0, c.t1, c.t1 / c.steps, c.y0, levels=c.levels,
            key=jr.key(seed), sampling=ds.ValueFunctions(c.degree, c.paths),
        )  # fmt: skip
        return e, time.perf_counter() - begin

    _, first = run(0)
    done = [run(seed) for seed in (1, 2, 3)]
    exact, e = c.exact(), done[0][0]
    total = max(abs(float(e.mean) - exact) for e, _ in done)
    change = float(np.sqrt(float(e.error) ** 2 - float(e.std_error) ** 2))
    cells = (
        name, f"{type(c.solver).__name__}", f"{c.steps} x {2 ** (c.levels - 1)}",
        f"{c.degree}", f"{c.paths:,}", f"{float(e.mean):.11f}", f"{exact:.11f}",
        f"{total:.1e}", f"{float(e.std_error):.1e}", f"{change:.1e}",
        f"{min(s for _, s in done):.2f}", f"{first:.1f}",
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| model | solver | steps | degree | paths | mean | exact | total error | sampling | "
    "last extrapolation | seconds | first call |\n" + "|---" * 12 + "|"
)


if __name__ == "__main__":
    print(HEAD)
    for name in sys.argv[1:] or CASES:
        print(row(name), flush=True)
        jax.clear_caches()
