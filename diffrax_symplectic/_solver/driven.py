"""What drives the stages of a step: the drift over its length, and the vector fields of the
noise times the random variables that are drawn for it."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._batch import materialize
from .._brownian import (
    AbstractWrappedPath,
    drives,
    FixedStepBrownianPath,
    GivenPath,
    Increment,
    is_random,
    PlateauBrownianPath,
    TruncatedBrownianPath,
    VARIABLES,
    WeakBrownianPath,
)
from .._compat import direction, resolution, ω
from .._custom_types import Args, RealScalarLike, Terms
from .._terms import apply, brownian_paths
from .brackets import apply_brackets, apply_bridge, bridge_coefficients


def drift_driven(
    drift: Terms, t0: RealScalarLike, t1: RealScalarLike, args: Args
) -> jtu.Partial:
    """What drives the drift stages of the step: a function `(t, y)` that returns the
    change of the state by the drift over the whole step."""
    sizes = [term.contr(t0, t1) for term in drift]
    return jtu.Partial(apply, drift, sizes, args)


def noise_driven(
    drift: jtu.Partial,
    h: RealScalarLike,
    noise: Terms,
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
                areas = bridge_coefficients(
                    h, values["W"], values["H"], values.get("K")
                )
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


def drawn_variables(
    noise: Terms,
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


def _how_to_get(name: str, noise: Terms) -> str:
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
    noise: Terms, t0: RealScalarLike, t1: RealScalarLike
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
    # A wrapper for Lévy areas is not: it sums a series.
    while isinstance(path, TruncatedBrownianPath | PlateauBrownianPath):
        path = path.path
    return isinstance(path, WeakBrownianPath | FixedStepBrownianPath)
