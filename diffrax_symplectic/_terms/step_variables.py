"""The random variables of a step as numbers with known laws, for means over all of their
values.

A path gives each step an increment, with one or several attributes: `W`, and for some laws
also Lévy areas. Each number in an attribute is a random variable. (The module
`_solver/driven.py` draws their values for a step.)
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._brownian import (
    AbstractLaw,
    GivenPath,
    Increment,
    increment_struct,
    laws_of,
    num_noises,
    ONLY_A_SHAPE,
    step_size,
    UnspecifiedPath,
    zeros_and_unravel,
)
from .._compat import is_traced
from .._custom_types import RealScalarLike
from .paths import brownian_paths, motion_numbers, replace_paths, shapes_as_paths


class StepVariables(NamedTuple):
    """The independent random variables of a step, those of one Brownian motion after
    another.

    - `laws`: the law of each variable, for a step of size 1, such as a Gaussian law.
    - `terms_with`: maps values of the variables, in units of the square root of the step
        size, to terms whose paths have the increments with these values.
    """

    laws: tuple[AbstractLaw, ...]
    terms_with: Callable[
        [Float[Array | np.ndarray, " n"]], PyTree[diffrax.AbstractTerm]
    ]


def step_variables(
    terms: PyTree[diffrax.AbstractTerm],
    h: RealScalarLike,
    numbers: tuple[int, ...] | None = None,
) -> StepVariables:
    """The random variables of a step of size `h`.

    `numbers` are the `motion_numbers` of the paths of the terms. By default they are found
    by comparing the paths, which is not possible for several paths with traced keys.

    Raises a `ValueError` if the terms hold no Brownian paths, if the law of a path is not
    known, or if paths with traced keys would have to be compared."""
    paths = brownian_paths(shapes_as_paths(terms))
    _check_laws_are_known(paths)
    if numbers is None:
        if len(paths) > 1 and any(map(is_traced, jtu.tree_leaves(paths))):
            raise ValueError(
                "`terms` hold several Brownian paths with traced keys, of which it is not "
                "known whether they are the same. Construct the terms outside of "
                "`jax.jit`, and let the function close over them."
            )
        numbers = motion_numbers(paths)
    # Paths with the same number are one Brownian motion, whose variables count once. Here
    # the first of these paths stands for the motion.
    motions = [paths[numbers.index(number)] for number in range(max(numbers) + 1)]
    laws_of_motions = [_law_of_each_variable(path) for path in motions]
    # Where the variables of each motion end among all variables.
    ends = np.cumsum([len(laws) for laws in laws_of_motions])

    def terms_with(
        values: Float[Array | np.ndarray, " n"],
    ) -> PyTree[diffrax.AbstractTerm]:
        values_of_each = jnp.split(values, ends[:-1])
        pairs = zip(motions, values_of_each)
        given_paths = [_path_with(path, own_values, h) for path, own_values in pairs]
        # `replace_paths` visits paths in the order of `paths`, and so of `numbers`.
        remaining_numbers = iter(numbers)
        return replace_paths(terms, lambda _: given_paths[next(remaining_numbers)])

    return StepVariables(tuple(itertools.chain(*laws_of_motions)), terms_with)


def _check_laws_are_known(paths: list[diffrax.AbstractBrownianPath]) -> None:
    """Raises a `ValueError` unless there are paths, and the law of each is known."""
    if any(isinstance(path, UnspecifiedPath) for path in paths):
        raise ValueError(
            f"{ONLY_A_SHAPE} For the random variables of a step, pass "
            "`path=solver.path(shape, key)` to the function that makes the terms."
        )
    unknown = [path for path in paths if laws_of(path) is None]
    if len(paths) == 0 or len(unknown) > 0:
        names = [
            f"{type(path).__name__} with {getattr(path.levy_area, '__name__', '?')}"
            for path in unknown
        ]
        raise ValueError(
            "`terms` must hold Brownian paths whose laws are known, a `WeakBrownianPath` "
            "or a Gaussian path with `levy_area=BrownianIncrement`, `SpaceTimeLevyArea` or "
            "`SpaceTimeTimeLevyArea`, also within a `PlateauBrownianPath`; got "
            f"{names}. Pass `WeakBrownianPath(shape, key)`. (For a system without noise, "
            "pass a noise that is zero, such as `0 * q`.)"
        )


def _law_of_each_variable(path: diffrax.AbstractBrownianPath) -> list[AbstractLaw]:
    """The law of each random variable of a path in a step. Each attribute of an increment
    has one variable for each noise."""
    laws: Any = laws_of(path)
    m = num_noises(increment_struct(path))
    return [law for law in laws.values() for _ in range(m)]


def _path_with(
    path: diffrax.AbstractBrownianPath, values: Float[Array, " n"], h: RealScalarLike
) -> GivenPath:
    """A path like `path` whose increment is the same in every step of size `h`: its random
    variables have the `values`, in units of the square root of `h`."""
    # The law of each attribute of the increment, by the name of the attribute.
    laws: Any = laws_of(path)
    shape = increment_struct(path)
    zeros, unravel = zeros_and_unravel(shape)
    scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(zeros.dtype)
    # (attributes, noises): a row holds the values of one attribute of the increment.
    rows = scaled.reshape(-1, zeros.size)
    attributes = {name: unravel(row) for name, row in zip(laws, rows)}
    make_increment: Any = path.levy_area
    increment = make_increment(dt=step_size(h, shape), **attributes)
    make = jtu.Partial(_same_increment, increment)
    return GivenPath(make=make, levy_area=type(increment))


def _same_increment(
    increment: Any, t0: RealScalarLike, t1: RealScalarLike | None, use_levy: bool
) -> Increment:
    """The `increment`, over every step: with all of its attributes, or `W` alone if the
    solver does not use Lévy areas."""
    del t0, t1
    return increment if use_levy else increment.W


def outcomes(
    laws: Sequence[AbstractLaw], num_nodes: int
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]]:
    """All K outcomes of n independent variables with these laws, a row for each outcome,
    and their K probabilities. A Gaussian variable takes the `num_nodes` points of a
    quadrature, with its weights as probabilities."""
    values_of_each = []
    weights_of_each = []
    for law in laws:
        values, weights = law.outcomes(num_nodes)
        values_of_each.append(values)
        weights_of_each.append(weights)
    # Every combination of values is an outcome. Its probability is a product, since the
    # variables are independent.
    values = np.array([*itertools.product(*values_of_each)])
    weights = np.array([*itertools.product(*weights_of_each)])
    return values, np.prod(weights, axis=1)
