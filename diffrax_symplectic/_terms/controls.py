"""The random variables of a step: drawn from the paths of the terms, or given values for
quadrature."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._batch import materialize
from .._brownian import (
    AbstractLaw,
    AbstractWrappedPath,
    drives,
    FixedStepBrownianPath,
    GivenPath,
    Increment,
    increment_struct,
    is_random,
    laws_of,
    num_noises,
    ONLY_A_SHAPE,
    PlateauBrownianPath,
    raveled,
    step_size,
    TruncatedBrownianPath,
    UnspecifiedPath,
    VARIABLES,
    WeakBrownianPath,
)
from .._compat import direction, is_traced, resolution, ω
from .._custom_types import Args, RealScalarLike
from .paths import brownian_paths, path_numbers, replace_paths, shapes_as_paths
from .vector_fields import apply, apply_brackets, apply_bridge, bridge


class StepVariables(NamedTuple):
    """The independent random variables of a step, those of one path after another.

    - `laws`: the law of each, for a step of size 1.
    - `terms_with`: maps their values, in units of the square root of the step size, to
        terms whose paths have these increments.
    """

    laws: tuple[AbstractLaw, ...]
    terms_with: Callable[[Float[Array, " n"]], PyTree[diffrax.AbstractTerm]]


def step_variables(
    terms: PyTree[diffrax.AbstractTerm], h, numbers: tuple[int, ...] | None = None
) -> StepVariables:
    """The variables of a step of size `h`. `numbers` are the `path_numbers` of the paths of
    the terms, which programs, whose keys are traced, have to be told."""
    paths = _paths_of_known_laws(terms)
    numbers = _known_numbers(paths) if numbers is None else numbers
    # Equal paths are one Brownian motion, whose variables are drawn once.
    motions = [_Motion.of(paths[numbers.index(k)]) for k in range(max(numbers) + 1)]
    ends = np.cumsum([motion.size for motion in motions])

    def terms_with(
        values: Float[Array | np.ndarray, " n"],
    ) -> PyTree[diffrax.AbstractTerm]:
        each = jnp.split(values, ends[:-1])
        given = [motion.given(x, h) for motion, x in zip(motions, each)]
        left = iter(numbers)
        return replace_paths(terms, lambda _: given[next(left)])

    laws = tuple(law for motion in motions for law in motion.each_law)
    return StepVariables(laws, terms_with)


class _Motion(NamedTuple):
    """One of the Brownian motions of a step.

    - `path`: a path that samples it.
    - `laws`: the laws of the attributes of its increments, in their order.
    - `shape`: the shape of an increment.
    - `noises`: the number of noises, each with all of these laws.
    """

    path: diffrax.AbstractBrownianPath
    laws: Mapping[str, AbstractLaw]
    shape: PyTree
    noises: int

    @staticmethod
    def of(path: diffrax.AbstractBrownianPath) -> "_Motion":
        laws = laws_of(path)
        assert laws is not None
        shape = increment_struct(path)
        return _Motion(path, laws, shape, num_noises(shape))

    @property
    def size(self) -> int:
        """The number of its random variables in a step."""
        return len(self.laws) * self.noises

    @property
    def each_law(self) -> list[AbstractLaw]:
        """The law of each of its random variables."""
        return [law for law in self.laws.values() for _ in range(self.noises)]

    def given(self, values: Float[Array, " size"], h) -> GivenPath:
        """A path with these variables in every step, in units of the root of `h`."""
        flat, unravel = raveled(self.shape)
        scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(flat.dtype)
        # One row for each attribute of the increment, in the order of the laws.
        rows = scaled.reshape(-1, self.noises)
        attributes = {name: unravel(row) for name, row in zip(self.laws, rows)}
        make_increment: Any = self.path.levy_area
        increment = make_increment(dt=step_size(h, self.shape), **attributes)
        make = jtu.Partial(_constant, increment)
        return GivenPath(make=make, levy_area=type(increment))


def outcomes(
    laws: Sequence[AbstractLaw], nodes: int
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]]:
    """All values of variables with these laws, and their probabilities or quadrature
    weights."""
    values_of_each = []
    weights_of_each = []
    for law in laws:
        values, weights = law.outcomes(nodes)
        values_of_each.append(values)
        weights_of_each.append(weights)
    # They are independent: all combinations, whose weights are products.
    values = np.array([*itertools.product(*values_of_each)])
    weights = np.array([*itertools.product(*weights_of_each)])
    return values, np.prod(weights, axis=1)


def _constant(increment, t0, t1, use_levy: bool) -> Increment:
    """The same increment over every step."""
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
            f"{[_named(path) for path in unknown]}. (For a system without noise, pass a "
            "noise that is zero, such as `0 * q`.)"
        )
    return paths


def _known_numbers(paths: list[diffrax.AbstractBrownianPath]) -> tuple[int, ...]:
    """The `path_numbers` of paths. Raises a `ValueError` for several of which it is not
    known, inside a program, whether they are the same."""
    if len(paths) > 1 and any(map(is_traced, jtu.tree_leaves(paths))):
        raise ValueError(
            "`terms` hold several Brownian paths with traced keys, of which it is not "
            "known whether they are the same. Construct the terms outside of `jax.jit`, "
            "and let the function close over them."
        )
    return path_numbers(paths)


def _named(path: diffrax.AbstractBrownianPath) -> str:
    return f"{type(path).__name__} with {getattr(path.levy_area, '__name__', '?')}"


def drawn_variables(
    noise: tuple,
    names: list[str],
    t0: RealScalarLike,
    t1: RealScalarLike,
    solver: str,
    optional: tuple[str, ...] = (),
) -> dict[str, list]:
    """The random variables of the step from `t0` to `t1`: for each name, one value for
    each noise term. The `optional` ones are left out unless all increments have them.

    Raises a `ValueError`, in the name of `solver`, if a path does not have one of `names`.
    """
    t1 = _within_resolution(noise, t0, t1)
    # Without Lévy areas an increment is `W` itself.
    only_increments = names == ["W"]
    options = {} if only_increments else {"use_levy": True}

    def draw() -> list[Increment]:
        return [term.contr(t0, t1, **options) for term in noise]

    cheap = all(map(_is_cheap, brownian_paths(noise)))
    increments = draw() if cheap else materialize(draw)
    if only_increments:
        return {"W": increments}

    def all_have(name: str) -> bool:
        return all(getattr(x, name, None) is not None for x in increments)

    # The variable first whose paths hold most: its advice fits the others, too.
    for name in sorted(names, key=_rank, reverse=True):
        if not all_have(name):
            raise ValueError(f"`{solver}` needs {_how_to_get(name, noise)}.")
    variables = {}
    for name in [*names, *filter(all_have, optional)]:
        pairs = zip(noise, increments)
        variables[name] = [_in_time(term, name, getattr(x, name)) for term, x in pairs]
    return variables


def _rank(name: str) -> int:
    """The rank of a random variable. Those of the user's own solvers come last."""
    return VARIABLES[name].rank if name in VARIABLES else -1


def _how_to_get(name: str, noise: tuple) -> str:
    """What a path needs to have this random variable, for messages."""
    variable = VARIABLES.get(name)
    if variable is None:
        return f"increments with the attribute `{name}`"
    records = [path for path in brownian_paths(noise) if _is_record(path)]
    if not records:
        return variable.advice
    # Another path would be other noise, so that only another solver helps.
    return (
        f"{variable.name}, but `{type(records[0]).__name__}` has no random key to draw "
        "them from. Use a solver that needs only increments, such as `StormerVerlet` for "
        "separable systems or `ImplicitMidpoint` for others"
    )


def _is_record(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether a path of the user's holds given noise."""
    return not is_random(path) and not isinstance(path, GivenPath)


def _in_time(
    term: diffrax.AbstractTerm, name: str, value: PyTree[Array]
) -> PyTree[Array]:
    """Restores the sign of even random variables, since backward in time Diffrax negates
    all of them."""
    is_even = name in VARIABLES and VARIABLES[name].even
    return (direction(term) * value**ω).ω if is_even else value


def _within_resolution(
    noise: tuple, t0: RealScalarLike, t1: RealScalarLike
) -> RealScalarLike:
    """`t1`, with an error when run if a `VirtualBrownianTree` does not resolve the step."""
    h = jnp.abs(t1 - t0)
    for path in map(_innermost, brownian_paths(noise)):
        if isinstance(path, diffrax.VirtualBrownianTree):
            tol = resolution(path)
            # Steps of a rounding error, which Diffrax may take at the end, have next to no
            # noise. A step of just `tol` may be rounded to less.
            t1 = eqx.error_if(
                jnp.asarray(t1),
                (h < 0.999 * tol) & (h > 1e-6 * tol),
                "A step is shorter than `tol` of the `VirtualBrownianTree`, which only "
                "interpolates at this scale, so the noise would be too small. Pass a "
                "smaller `tol`, or for fixed steps `FixedStepBrownianPath(shape, key)`.",
            )
    return t1


def _innermost(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
    while isinstance(path, AbstractWrappedPath):
        path = path.path
    return path


def _is_cheap(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether its random variables are cheaper to recompute than to store."""
    # Of the wrappers, Lévy areas are not: they sum a series.
    while isinstance(path, TruncatedBrownianPath | PlateauBrownianPath):
        path = path.path
    return isinstance(path, WeakBrownianPath | FixedStepBrownianPath)


def noise_driven(
    drift: jtu.Partial,
    h: RealScalarLike,
    noise: tuple,
    names: list[str],
    t0: RealScalarLike,
    t1: RealScalarLike,
    args: Args,
    solver: str,
) -> dict[str, jtu.Partial]:
    """What drives the noise stages of the step of size `h` from `t0` to `t1`: for the name
    of each random variable, a function `(t, y)` that returns the change of the state by
    the vector fields that it multiplies. `drift` is that of the drift stages."""
    # Most variables are attributes of an increment. The others are computed from several
    # of its attributes, some of which are used only if they are there.
    attributes = []
    if_there = []
    for name in names:
        held = VARIABLES[name].held if name in VARIABLES else None
        if held is None:
            attributes.append(name)
        else:
            attributes += held[0]
            if_there += held[1]
    # Each is drawn once, although several variables may be computed from it.
    attributes = list(dict.fromkeys(attributes))
    values = drawn_variables(noise, attributes, t0, t1, solver, tuple(if_there))
    functions = {}
    for name in names:
        match drives(name):
            case "noise":
                functions[name] = jtu.Partial(apply, noise, values[name], args)
            case "drift brackets":
                areas = bridge(h, values["W"], values["H"], values.get("K"))
                functions[name] = jtu.Partial(
                    apply_bridge, drift, noise, areas, h, args
                )
            case "noise brackets" if len(noise) == 1:
                (areas,) = values[name]
                functions[name] = jtu.Partial(apply_brackets, noise[0], areas, args)
            case _:
                raise ValueError(
                    f"`{solver}` needs all noises in one term, whose path samples the Lévy "
                    f"areas between them; got {len(noise)} noise terms. Combine them."
                )
    return functions


def drift_driven(
    drift: tuple, t0: RealScalarLike, t1: RealScalarLike, args: Args
) -> jtu.Partial:
    """What drives the drift stages of the step: a function `(t, y)` that returns the
    change of the state by the drift over the whole step."""
    sizes = [term.contr(t0, t1) for term in drift]
    return jtu.Partial(apply, drift, sizes, args)
