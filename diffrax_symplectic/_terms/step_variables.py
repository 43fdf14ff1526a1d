"""The random variables of a step as numbers with known laws, for means over all of their
values. (`_solver/driven.py` draws them for a step.)"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax
import jax
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
    """The independent random variables of a step, those of one path after another.

    - `laws`: the law of each, for a step of size 1.
    - `terms_with`: maps their values, in units of the square root of the step size, to
        terms whose paths have these increments.
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
    """The variables of a step of size `h`. `numbers` are the `motion_numbers` of the paths
    of the terms. By default they are found by comparing keys; where keys are traced, they
    have to be given."""
    paths = _paths_of_known_laws(terms)
    numbers = _checked_numbers(paths) if numbers is None else numbers
    # Paths with the same number are one Brownian motion, whose variables are drawn once.
    first_paths = [paths[numbers.index(number)] for number in range(max(numbers) + 1)]
    motions = [_Motion.of(path) for path in first_paths]
    ends = np.cumsum([motion.num_variables for motion in motions])

    def terms_with(
        values: Float[Array | np.ndarray, " n"],
    ) -> PyTree[diffrax.AbstractTerm]:
        pieces = jnp.split(values, ends[:-1])
        given_paths = [
            motion.path_with(piece, h) for motion, piece in zip(motions, pieces)
        ]
        # `replace_paths` visits paths in the order of `paths`.
        remaining_numbers = iter(numbers)

        def new_path(path: diffrax.AbstractBrownianPath) -> GivenPath:
            del path
            return given_paths[next(remaining_numbers)]

        return replace_paths(terms, new_path)

    laws = tuple(law for motion in motions for law in motion.law_of_each)
    return StepVariables(laws, terms_with)


class _Motion(NamedTuple):
    """One of the Brownian motions of a step.

    - `path`: a path that samples it.
    - `laws`: the laws of the attributes of its increments, in their order.
    - `shape`: the shape of an increment.
    - `num_noises`: the number of noises, each of which has a variable with each law.
    """

    path: diffrax.AbstractBrownianPath
    laws: Mapping[str, AbstractLaw]
    shape: PyTree[jax.ShapeDtypeStruct]
    num_noises: int

    @staticmethod
    def of(path: diffrax.AbstractBrownianPath) -> "_Motion":
        laws = laws_of(path)
        assert laws is not None
        shape = increment_struct(path)
        return _Motion(path, laws, shape, num_noises(shape))

    @property
    def num_variables(self) -> int:
        """The number of its random variables in a step."""
        return len(self.laws) * self.num_noises

    @property
    def law_of_each(self) -> list[AbstractLaw]:
        """The law of each of its random variables."""
        return [law for law in self.laws.values() for _ in range(self.num_noises)]

    def path_with(
        self, values: Float[Array, " num_variables"], h: RealScalarLike
    ) -> GivenPath:
        """A path with these variables, in units of the root of `h`, in every step."""
        zeros, unravel = zeros_and_unravel(self.shape)
        scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(zeros.dtype)
        # (laws, noises): a row is one attribute of the increment.
        rows = scaled.reshape(-1, self.num_noises)
        attributes = {name: unravel(row) for name, row in zip(self.laws, rows)}
        make_increment: Any = self.path.levy_area
        increment = make_increment(dt=step_size(h, self.shape), **attributes)
        make = jtu.Partial(_same_increment, increment)
        return GivenPath(make=make, levy_area=type(increment))


def outcomes(
    laws: Sequence[AbstractLaw], num_nodes: int
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]]:
    """All K outcomes of n independent variables with these laws, a row for each, and their
    probabilities. For Gaussian variables the outcomes are the points of a quadrature, with
    `num_nodes` in each variable, and the probabilities its weights."""
    values_of_each = []
    weights_of_each = []
    for law in laws:
        values, weights = law.outcomes(num_nodes)
        values_of_each.append(values)
        weights_of_each.append(weights)
    # Every combination is an outcome, whose weight is a product, as they are independent.
    values = np.array([*itertools.product(*values_of_each)])
    weights = np.array([*itertools.product(*weights_of_each)])
    return values, np.prod(weights, axis=1)


def _same_increment(
    increment: Any, t0: RealScalarLike, t1: RealScalarLike | None, use_levy: bool
) -> Increment:
    """The same increment over every step, with all of its attributes or `W` alone."""
    del t0, t1
    return increment if use_levy else increment.W


def _paths_of_known_laws(
    terms: PyTree[diffrax.AbstractTerm],
) -> list[diffrax.AbstractBrownianPath]:
    """The Brownian paths of the terms. Raises a `ValueError` if there are none, or if the
    law of one is not known."""
    paths = brownian_paths(shapes_as_paths(terms))
    if any(isinstance(path, UnspecifiedPath) for path in paths):
        raise ValueError(
            f"{ONLY_A_SHAPE} For the random variables of a step, pass "
            "`path=solver.path(shape, key)` to the function that makes the terms."
        )
    unknown = [path for path in paths if laws_of(path) is None]
    if len(paths) == 0 or len(unknown) > 0:
        raise ValueError(
            "`terms` must hold Brownian paths whose laws are known, a `WeakBrownianPath` "
            "or a Gaussian path with `levy_area=BrownianIncrement`, `SpaceTimeLevyArea` or "
            "`SpaceTimeTimeLevyArea`, also within a `PlateauBrownianPath`; got "
            f"{[_name_of(path) for path in unknown]}. (For a system without noise, pass a "
            "noise that is zero, such as `0 * q`.)"
        )
    return paths


def _checked_numbers(paths: list[diffrax.AbstractBrownianPath]) -> tuple[int, ...]:
    """The `motion_numbers` of paths. Raises a `ValueError` if there are several and they
    are traced, since it is then not known which are the same."""
    if len(paths) > 1 and any(map(is_traced, jtu.tree_leaves(paths))):
        raise ValueError(
            "`terms` hold several Brownian paths with traced keys, of which it is not "
            "known whether they are the same. Construct the terms outside of `jax.jit`, "
            "and let the function close over them."
        )
    return motion_numbers(paths)


def _name_of(path: diffrax.AbstractBrownianPath) -> str:
    return f"{type(path).__name__} with {getattr(path.levy_area, '__name__', '?')}"
