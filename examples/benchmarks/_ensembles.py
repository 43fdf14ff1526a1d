"""The models of `total_error`, and what estimates their expectations."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds

from .. import kubo, linear_oscillator, rigid_body, synchrotron
from ..hard_cases import chain, henon_heiles
from . import _exact
from ._timing import ensemble
from .work_precision import two_noises


_HEUN = {"Heun": (diffrax.Heun(), False)}
_SLOW = _HEUN | {"SlowRK": (diffrax.SlowRK(), True)}
_SHARK = _HEUN | {"ShARK": (diffrax.ShARK(), True)}


class Model(NamedTuple):
    """A problem, its solvers, and the steps that are taken."""

    make_terms: Callable
    y0: Any
    phi: Callable[[Any], jax.Array]
    t1: float
    # With one level, and on the coarser of two.
    steps: int
    coarse: int
    # The largest number of paths of a replicate, on two levels.
    paths: int
    noises: tuple[int, ...]
    # One of this package.
    solver: Any
    # Those of Diffrax, and whether they need space-time area.
    others: Mapping[str, tuple[diffrax.AbstractSolver, bool]]
    # The expectation, and its standard error if it has one.
    exact: Callable[[], float | tuple[float, float]]
    sort_by: Callable | None = None
    # Whether moments of a linear model tell the bias of every solver.
    linear: bool = False
    two_point: bool = False

    def weak_path(self, key):
        return ds.WeakBrownianPath(self.noises, key, two_point=self.two_point)

    def gaussian_path(self, key, area: bool = False):
        return ds.FixedStepBrownianPath(self.noises, key, _levy_area(area))

    def quasi_path(self):
        return (self.weak_path if self.two_point else self.gaussian_path)(jr.key(0))


def _levy_area(area: bool):
    return diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement


def _henon_heiles_terms(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: henon_heiles.energy(p, q),
        lambda t, p, q, args: -0.03 * q,
        path,
    )


def _chain_terms(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: chain.energy(p, q, 0.5),
        lambda t, p, q, args: -0.1 * q,
        path,
    )


_HENON_HEILES = _henon_heiles_terms, (jnp.array([0.4, 0.1]), jnp.array([0.0, -0.15]))
_p2, _q2 = lambda y: y[0] ** 2, lambda y: y[1] ** 2
_first2 = lambda y: y[1][0] ** 2

MODELS = {
    "linear oscillator": Model(
        linear_oscillator.make_terms, linear_oscillator.Y0, _q2, 1.0,
        64, 16, 2**16, (), ds.StormerVerlet(), _SHARK,
        _exact.linear_oscillator_square, linear=True,
    ),
    "Kubo oscillator": Model(
        kubo.make_terms, kubo.Y0, _q2, 1.0,
        32, 12, 2**16, (), ds.StrangGauss(), _SLOW, _exact.kubo_square, linear=True,
    ),
    "synchrotron": Model(
        synchrotron.make_terms, synchrotron.Y0, _p2, 2.0,
        64, 32, 2**14, (2,), ds.StormerVerlet(), _SLOW,
        lambda: _exact.by_transfer(
            synchrotron.make_terms, synchrotron.Y0, _p2, 2.0, 256, (1.0, 0.5), 16
        ),
    ),
    "rigid body": Model(
        lambda path: rigid_body.make_terms(path, 0.5), rigid_body.X0,
        lambda X: X[0] ** 2, 4.0, 64, 32, 2**14, (), ds.StrangGauss(), _SLOW,
        lambda: _exact.rigid_body_square(0.5),
        sort_by=lambda X: (X[0], jnp.arctan2(X[1], X[2])),
    ),
    "two noises": Model(
        two_noises, kubo.Y0, _q2, 1.0,
        16, 8, 2**14, (2,), ds.NinomiyaVictoir(), _HEUN, _exact.two_noises_square,
        linear=True, two_point=True,
    ),
    "Hénon-Heiles": Model(
        *_HENON_HEILES, _first2, 5.0,
        64, 32, 2**14, (2,), ds.StormerVerlet(), _SHARK,
        lambda: _exact.by_transfer(*_HENON_HEILES, _first2, 5.0, 128, (0.12,) * 4, 7),
    ),
    "chain of 32": Model(
        _chain_terms, chain.start(1.0), lambda y: jnp.mean(y[1] ** 2), 2.0,
        32, 16, 2**12, (chain.N,), ds.StormerVerlet(), _SHARK,
        lambda: _exact.chain_square(0.5, 0.1, 2.0, 64, 2**13, 32),
    ),
}  # fmt: skip


def quasi(model: Model, solver=None, area: bool = False):
    """Estimates phi and its square, by `ArrayRQMC`. One program for each number of
    paths: `terms` and the functions are made once."""
    own = solver is None
    path = model.quasi_path() if own else model.gaussian_path(jr.key(0), area)
    terms, solver = model.make_terms(path), model.solver if own else solver

    def phi(t, y, args):
        value = model.phi(y)
        return jnp.stack([value, value**2])

    def run(
        steps: int, paths: int, replicates: int, levels: int = 1, seed: int = 0
    ) -> ds.Expectation:
        return ds.expectation(
            phi, terms, solver, 0.0, model.t1, model.t1 / steps, model.y0,
            key=jr.key(seed), levels=levels,
            sampling=ds.ArrayRQMC(paths, replicates, model.sort_by),
        )  # fmt: skip

    return run


def plain(model: Model):
    """Estimates phi by independent paths with weak increments."""
    terms = model.make_terms(model.weak_path(jr.key(0)))
    phi = lambda t, y, args: model.phi(y)
    return lambda paths, seed: ds.expectation(
        phi, terms, model.solver, 0.0, model.t1, model.t1 / model.steps, model.y0,
        key=jr.key(seed), sampling=ds.IndependentPaths(paths), levels=1,
    )  # fmt: skip


def other(model: Model, name: str):
    """Takes keys to the ends of paths of one of Diffrax's solvers, by `vmap`."""
    solver, area = model.others[name]
    path = lambda key: diffrax.UnsafeBrownianPath(
        model.noises, key, levy_area=_levy_area(area)
    )
    h = model.t1 / model.steps
    return ensemble(model.make_terms, path, solver, model.y0, h, model.steps)
