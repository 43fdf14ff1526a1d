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

from ._brownian import AbstractLaw, GivenPath, Increment, increment_struct, laws_of
from ._terms import brownian_paths, replace_paths


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
    flat, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, shape))
    scalars = [law.outcomes(nodes) for law in laws.values() for _ in range(flat.size)]
    values = np.array([*itertools.product(*[values for values, _ in scalars])])
    weights = np.array([*itertools.product(*[weights for _, weights in scalars])])
    scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(flat.dtype)
    dt = jtu.tree_map(lambda s: jnp.asarray(h, s.dtype), shape)

    def increment(scaled):
        sets = map(unravel, scaled.reshape(-1, flat.size))
        return cast(Any, path.levy_area)(dt=dt, **dict(zip(laws, sets)))

    def put(increment):
        given = GivenPath(
            make=jtu.Partial(_constant, increment), levy_area=type(increment)
        )
        return replace_paths(terms, lambda _: given)

    return Outcomes(jax.vmap(increment)(scaled), np.prod(weights, axis=1), put)


def _constant(
    increment: diffrax.AbstractBrownianIncrement, t0, t1, use_levy: bool
) -> Increment:
    """The same increment over every step."""
    del t0, t1
    return increment if use_levy else increment.W


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
