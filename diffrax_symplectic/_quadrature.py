"""Quadrature over the random variables of one step: their values and probabilities."""

import itertools
from collections.abc import Callable, Mapping
from typing import Any, cast, NamedTuple

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ._brownian import AbstractLaw, increment_struct, laws_of
from ._terms import brownian_paths


class Outcomes(NamedTuple):
    """The outcomes of a step.

    - `increments`: the increments, stacked along leading axes.
    - `weights`: their probabilities, or the weights of a quadrature.
    - `put`: makes terms with a given increment in place of the path.
    """

    increments: diffrax.AbstractBrownianIncrement
    weights: np.ndarray
    put: Callable[[diffrax.AbstractBrownianIncrement], PyTree[diffrax.AbstractTerm]]


def outcomes(terms: PyTree[diffrax.AbstractTerm], h, nodes: int) -> Outcomes:
    """All outcomes of a step of size `h`, for `terms` with one Brownian path."""
    path, laws = _the_path(terms)
    shape = increment_struct(path)
    zeros = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shape)
    flat, unravel = jfu.ravel_pytree(zeros)
    scalars = [law.outcomes(nodes) for law in laws.values() for _ in range(flat.size)]
    values = np.array([*itertools.product(*[values for values, _ in scalars])])
    weights = np.array([*itertools.product(*[weights for _, weights in scalars])])
    scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(flat.dtype)
    dt = jtu.tree_map(lambda s: jnp.asarray(h, s.dtype), shape)

    def increment(scaled):
        sets = map(unravel, scaled.reshape(-1, flat.size))
        return cast(Any, path.levy_area)(dt=dt, **dict(zip(laws, sets)))

    def put(increment):
        given = _FixedIncrement(increment)  # pyright: ignore[reportCallIssue]
        return jtu.tree_map(
            lambda x: given if _is_path(x) else x, terms, is_leaf=_is_path
        )

    return Outcomes(jax.vmap(increment)(scaled), np.prod(weights, axis=1), put)


class _FixedIncrement(diffrax.AbstractBrownianPath):
    """A path that has a given increment over every step."""

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


def _the_path(terms) -> tuple[diffrax.AbstractBrownianPath, Mapping[str, AbstractLaw]]:
    paths = brownian_paths(terms)
    laws = laws_of(paths[0]) if len(paths) == 1 else None
    if laws is None:
        raise ValueError(
            "`terms` must hold exactly one Brownian path, a `WeakBrownianPath`, whose "
            "outcomes can be enumerated, or a Gaussian one, whose increments are "
            "integrated over, with `levy_area=BrownianIncrement`, `SpaceTimeLevyArea` or "
            "`SpaceTimeTimeLevyArea`, also within a `PlateauBrownianPath`; got "
            f"{[_named(path) for path in paths]}."
        )
    return paths[0], laws


def _named(path: diffrax.AbstractBrownianPath) -> str:
    return f"{type(path).__name__} with {getattr(path.levy_area, '__name__', '?')}"
