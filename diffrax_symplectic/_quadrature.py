"""What the random variables of one step may be, each with its probability."""

import itertools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ._brownian import (
    PlateauBrownianPath,
    PlateauIncrement,
    WeakBrownianPath,
    WeakIncrement,
)
from ._terms import brownian_paths


class Outcomes(NamedTuple):
    """Increments, stacked along leading axes, the probability of each, and what puts one
    in the place of the path."""

    increments: diffrax.AbstractBrownianIncrement
    weights: np.ndarray
    put: Callable[[diffrax.AbstractBrownianIncrement], PyTree[diffrax.AbstractTerm]]


_Law: TypeAlias = list[tuple[float, float]]
_THREE_POINT: _Law = [(-np.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (np.sqrt(3.0), 1 / 6)]
_FOUR_POINT: _Law = [
    (sign * np.sqrt(3 + s * np.sqrt(6)), (3 - s * np.sqrt(6)) / 12)
    for sign in (-1, 1)
    for s in (-1, 1)
]
_TWO_POINT: _Law = [(-1.0, 1 / 2), (1.0, 1 / 2)]


def _gaussian(variance: float, nodes: int) -> _Law:
    """Gauss--Hermite quadrature: exact for polynomials of degree `2 nodes - 1`."""
    points, weights = np.polynomial.hermite_e.hermegauss(nodes)
    scaled = np.sqrt(variance) * points, weights / np.sqrt(2 * np.pi)
    return [(float(x), float(w)) for x, w in zip(*scaled)]


def outcomes(terms: PyTree[diffrax.AbstractTerm], h, nodes: int) -> Outcomes:
    """All outcomes of a step of size `h`, for `terms` with one Brownian path."""
    path, plateaus = _the_path(terms)
    laws: dict[str, _Law]
    if isinstance(path, WeakBrownianPath):
        laws = {"W": _THREE_POINT if path.order == 2 else _FOUR_POINT}
        if path.second:
            laws["second"] = _THREE_POINT
        if path.order == 3:
            laws["third"] = _THREE_POINT
        if path.two_point:
            laws["two_point"] = _TWO_POINT
        increment_cls = WeakIncrement
    else:
        laws = {"W": _gaussian(1.0, nodes)}
        increment_cls = path.levy_area
        if issubclass(increment_cls, diffrax.SpaceTimeLevyArea):
            laws["H"] = _gaussian(1 / 12, nodes)
    if plateaus:
        laws["C"] = [(x / np.sqrt(6), weight) for x, weight in _TWO_POINT]
        increment_cls = PlateauIncrement

    zeros = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), path.shape)
    flat, unravel = jfu.ravel_pytree(zeros)
    table = list(
        itertools.product(*[v for v in laws.values() for _ in range(flat.size)])
    )
    values = np.array([[value for value, _ in row] for row in table])
    weights = np.array([np.prod([weight for _, weight in row]) for row in table])
    scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(flat.dtype)
    columns = {
        name: jax.vmap(unravel)(scaled[:, i * flat.size : (i + 1) * flat.size])
        for i, name in enumerate(laws)
    }
    dt = jtu.tree_map(lambda s: jnp.full(len(table), h, s.dtype), path.shape)

    def put(increment):
        given = _FixedIncrement(increment)  # pyright: ignore[reportCallIssue]
        return jtu.tree_map(
            lambda x: given if _is_path(x) else x, terms, is_leaf=_is_path
        )

    return Outcomes(increment_cls(dt=dt, **columns), weights, put)


class _FixedIncrement(diffrax.AbstractBrownianPath):
    """The same, given increment over every step."""

    increment: diffrax.AbstractBrownianIncrement

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    @property
    def levy_area(self):
        return type(self.increment)

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del t0, t1, left
        return self.increment if use_levy else self.increment.W


def _is_path(x) -> bool:
    return isinstance(x, diffrax.AbstractBrownianPath)


_Known: TypeAlias = (
    WeakBrownianPath | diffrax.UnsafeBrownianPath | diffrax.VirtualBrownianTree
)


def _the_path(terms) -> tuple[_Known, bool]:
    """The path, without the plateaus that may be around it, and whether they are."""
    paths = brownian_paths(terms)
    path = paths[0] if len(paths) == 1 else None
    plateaus = isinstance(path, PlateauBrownianPath)
    if plateaus:
        path = path.path
    if not isinstance(path, _Known):
        raise ValueError(
            "`terms` must hold exactly one Brownian path, a `WeakBrownianPath`, whose "
            "outcomes can be enumerated, or one of Diffrax's, whose Gaussian increments "
            "are integrated over, also within a `PlateauBrownianPath`; got "
            f"{[type(p).__name__ for p in paths]}."
        )
    gaussian = diffrax.BrownianIncrement, diffrax.SpaceTimeLevyArea
    if not isinstance(path, WeakBrownianPath) and path.levy_area not in gaussian:
        raise ValueError(
            "Expectations over Gaussian increments are for paths with `levy_area="
            f"BrownianIncrement` or `SpaceTimeLevyArea`; got {path.levy_area.__name__}."
        )
    return path, plateaus
