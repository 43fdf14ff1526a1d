"""Quadrature over the random variables of one step: their values and probabilities."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast, NamedTuple

import diffrax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._brownian import AbstractLaw, GivenPath, Increment, increment_struct, laws_of
from ._terms import brownian_paths, replace_paths


class StepVariables(NamedTuple):
    """The random variables of a step, all of them independent.

    - `laws`: the law of each, for a step of size 1.
    - `terms_with`: takes their values, in units of the root of the step size, to terms with
        the increment that they make in place of the path.
    """

    laws: tuple[AbstractLaw, ...]
    terms_with: Callable[[Float[Array, " n"]], PyTree[diffrax.AbstractTerm]]


def step_variables(terms: PyTree[diffrax.AbstractTerm], h) -> StepVariables:
    """Of a step of size `h`, for `terms` with one Brownian path."""
    path, laws = _the_path(terms)
    shape = increment_struct(path)
    flat, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, shape))

    def terms_with(values):
        dt = jtu.tree_map(lambda s: jnp.asarray(h, s.dtype), shape)
        scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(flat.dtype)
        sets = map(unravel, scaled.reshape(-1, flat.size))
        increment = cast(Any, path.levy_area)(dt=dt, **dict(zip(laws, sets)))
        make = jtu.Partial(_constant, increment)
        given = GivenPath(make=make, levy_area=type(increment))
        return replace_paths(terms, lambda _: given)

    each = tuple(law for law in laws.values() for _ in range(flat.size))
    return StepVariables(each, terms_with)


def outcomes(
    laws: Sequence[AbstractLaw], nodes: int
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]]:
    """All values of variables with these laws, and their probabilities or the weights of a
    quadrature."""
    scalars = [law.outcomes(nodes) for law in laws]
    values = np.array([*itertools.product(*[values for values, _ in scalars])])
    weights = np.array([*itertools.product(*[weights for _, weights in scalars])])
    return values, np.prod(weights, axis=1)


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
