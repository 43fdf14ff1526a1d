"""The random variables of a step: drawn from the paths of the terms, or given values for
quadrature."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast, NamedTuple

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
    PlateauBrownianPath,
    raveled,
    step_size,
    TruncatedBrownianPath,
    VARIABLES,
    WeakBrownianPath,
)
from .._compat import direction, ω
from .._custom_types import Args, RealScalarLike
from .paths import brownian_paths, replace_paths
from .vector_fields import apply, apply_brackets, apply_bridge, bridge


class StepVariables(NamedTuple):
    """The independent random variables of a step.

    - `laws`: the law of each, for a step of size 1.
    - `terms_with`: maps their values, in units of the square root of the step size, to
        terms whose path has this increment.
    """

    laws: tuple[AbstractLaw, ...]
    terms_with: Callable[[Float[Array, " n"]], PyTree[diffrax.AbstractTerm]]


def step_variables(terms: PyTree[diffrax.AbstractTerm], h) -> StepVariables:
    """The variables of a step of size `h`, for `terms` with one Brownian path."""
    path, laws = _the_path(terms)
    shape = increment_struct(path)
    flat, unravel = raveled(shape)

    def terms_with(values):
        scaled = (jnp.sqrt(jnp.abs(h)) * values).astype(flat.dtype)
        sets = dict(zip(laws, map(unravel, scaled.reshape(-1, flat.size))))
        increment = cast(Any, path.levy_area)(dt=step_size(h, shape), **sets)
        make = jtu.Partial(_constant, increment)
        given = GivenPath(make=make, levy_area=type(increment))
        return replace_paths(terms, lambda _: given)

    each = tuple(law for law in laws.values() for _ in range(flat.size))
    return StepVariables(each, terms_with)


def outcomes(
    laws: Sequence[AbstractLaw], nodes: int
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, " K"]]:
    """All values of variables with these laws, and their probabilities or quadrature
    weights."""
    scalars = [law.outcomes(nodes) for law in laws]
    values = np.array([*itertools.product(*[values for values, _ in scalars])])
    weights = np.array([*itertools.product(*[weights for _, weights in scalars])])
    return values, np.prod(weights, axis=1)


def _constant(increment, t0, t1, use_levy: bool) -> Increment:
    """The same increment over every step."""
    del t0, t1
    return increment if use_levy else increment.W


def _the_path(terms) -> tuple[diffrax.AbstractBrownianPath, Mapping[str, AbstractLaw]]:
    paths = brownian_paths(terms)
    laws = laws_of(paths[0]) if len(paths) == 1 else None
    if laws is None:
        raise ValueError(
            "`terms` must hold exactly one Brownian path, a `WeakBrownianPath` or a "
            "Gaussian path with `levy_area=BrownianIncrement`, `SpaceTimeLevyArea` or "
            "`SpaceTimeTimeLevyArea`, also within a `PlateauBrownianPath`; got "
            f"{[_named(path) for path in paths]}. (For a system without noise, pass a "
            "noise that is zero, such as `0 * q`.)"
        )
    return paths[0], laws


def _named(path: diffrax.AbstractBrownianPath) -> str:
    return f"{type(path).__name__} with {getattr(path.levy_area, '__name__', '?')}"


def controls(
    noise: tuple, names: list[str], t0, t1, solver: str, optional: tuple[str, ...] = ()
) -> dict[str, list]:
    """The random variables of the step from `t0` to `t1` for each noise term, and the
    `optional` ones if all increments have them."""
    t1 = _within_resolution(noise, t0, t1)
    options = {} if names == ["W"] else {"use_levy": True}
    drawn = lambda: [term.contr(t0, t1, **options) for term in noise]
    cheap = all(map(_is_cheap, brownian_paths(noise)))
    increments = drawn() if cheap else materialize(drawn)
    if names == ["W"]:
        return {"W": increments}
    # Check the variable first whose paths hold most: its advice fits the others, too.
    held = lambda name: all(getattr(i, name, None) is not None for i in increments)
    for name in sorted(names, key=lambda x: [*VARIABLES, x].index(x)):
        if not held(name):
            variable = VARIABLES.get(name)
            advice = f"increments with the attribute `{name}`"
            needs = variable.advice if variable else advice
            records = [x for x in brownian_paths(noise) if _is_record(x)]
            if variable and records:
                needs = (
                    f"{variable.name}, but `{type(records[0]).__name__}` has no random key "
                    "to draw them from. Use a solver that needs only increments, such as "
                    "`StormerVerlet` for separable systems or `ImplicitMidpoint` for others"
                )
            raise ValueError(f"`{solver}` needs {needs}.")
    return {
        name: [
            _in_time(term, name, getattr(i, name)) for term, i in zip(noise, increments)
        ]
        for name in [*names, *filter(held, optional)]
    }


def _is_record(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether a path of the user's holds given noise."""
    return not is_random(path) and not isinstance(path, GivenPath)


def _in_time(term: diffrax.AbstractTerm, name: str, x: PyTree[Array]) -> PyTree[Array]:
    """Restores the sign of even random variables, since backward in time Diffrax negates
    all of them."""
    even = name in VARIABLES and VARIABLES[name].even
    return (direction(term) * x**ω).ω if even else x


def _within_resolution(noise: tuple, t0, t1) -> RealScalarLike:
    """`t1`, with an error when run if a `VirtualBrownianTree` does not resolve the step."""
    h = jnp.abs(t1 - t0)
    for path in map(_innermost, brownian_paths(noise)):
        if isinstance(path, diffrax.VirtualBrownianTree):
            tol = path.tol * (path.t1 - path.t0)  # stored in units of its length
            # Ignore steps of a rounding error, which Diffrax may take at the end.
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
    while isinstance(path, TruncatedBrownianPath | PlateauBrownianPath):
        path = path.path
    return isinstance(path, WeakBrownianPath | FixedStepBrownianPath)


def noise_driven(
    drift: jtu.Partial,
    h,
    noise: tuple,
    names: list[str],
    t0,
    t1,
    args: Args,
    solver: str,
) -> dict[str, jtu.Partial]:
    """For each random variable, the function that drives noise stages over the step of size
    `h`; `drift` drives drift stages."""
    own = [VARIABLES[name].held if name in VARIABLES else None for name in names]
    needed = [
        x for name, held in zip(names, own) for x in (held[0] if held else [name])
    ]
    optional = tuple(x for held in own if held for x in held[1])
    drawn = controls(noise, [*dict.fromkeys(needed)], t0, t1, solver, optional)
    driven = {}
    for name in names:
        match drives(name):
            case "noise":
                driven[name] = jtu.Partial(apply, noise, drawn[name], args)
            case "drift brackets":
                bridges = bridge(h, drawn["W"], drawn["H"], drawn.get("K"))
                driven[name] = jtu.Partial(apply_bridge, drift, noise, bridges, h, args)
            case "noise brackets" if len(noise) == 1:
                A = drawn[name][0]
                driven[name] = jtu.Partial(apply_brackets, noise[0], A, args)
            case _:
                raise ValueError(
                    f"`{solver}` needs all noises in one term, whose path samples the Lévy "
                    f"areas between them; got {len(noise)} noise terms. Combine them."
                )
    return driven


def drift_driven(drift: tuple, t0, t1, args: Args) -> jtu.Partial:
    """The function that drives drift stages over the step."""
    return jtu.Partial(apply, drift, [x.contr(t0, t1) for x in drift], args)
