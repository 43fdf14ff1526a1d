"""The changes of the state by the terms over a step: by the drift, and by the vector fields
of the noise times the random variables that are drawn for the step."""

from collections.abc import Iterable

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._batch import materialize
from .._brownian import (
    AbstractWrappedPath,
    drives,
    FixedStepBrownianPath,
    GivenPath,
    Increment,
    is_random,
    most_demanding_variable,
    PlateauBrownianPath,
    TruncatedBrownianPath,
    VARIABLES,
    WeakBrownianPath,
)
from .._compat import direction, resolution, ω
from .._custom_types import Args, RealScalarLike, Terms
from .._terms import apply, brownian_paths
from .brackets import apply_brackets, apply_bridge, bridge_coefficients


def drift_change(
    drift: Terms, t0: RealScalarLike, t1: RealScalarLike, args: Args
) -> jtu.Partial:
    """A function of `(t, y)`: the change of the state over the whole step by the drift,
    evaluated at this time and state."""
    controls = [term.contr(t0, t1) for term in drift]
    return jtu.Partial(apply, drift, controls, args)


def noise_changes(
    drift: jtu.Partial,
    h: RealScalarLike,
    noise: Terms,
    names: list[str],
    t0: RealScalarLike,
    t1: RealScalarLike,
    args: Args,
    solver_name: str,
) -> dict[str, jtu.Partial]:
    """For each name of a random variable, a function of `(t, y)`: the change of the state
    over the step from `t0` to `t1`, of size `h`, by the vector fields that the variable
    multiplies, evaluated at this time and state.

    A variable multiplies the noise itself, the Lie brackets of noises, or the Lie brackets
    of the noise with the drift. For the last, `drift` is what `drift_change` returns."""
    # Most variables are attributes of an increment, and drawn. The coefficients of brackets
    # with the drift are functions of the drawn `W`, `H` and, if increments have it, `K`.
    drawn = [name for name in names if drives(name) != "drift brackets"]
    optional = []
    if len(drawn) < len(names):
        drawn = list(dict.fromkeys([*drawn, "W", "H"]))
        optional = ["K"]
    values = drawn_variables(noise, drawn, t0, t1, solver_name, optional)
    changes = {}
    for name in names:
        match drives(name):
            case "noise":
                changes[name] = jtu.Partial(apply, noise, values[name], args)
            case "drift brackets":
                coefficients = bridge_coefficients(
                    h, values["W"], values["H"], values.get("K")
                )
                changes[name] = jtu.Partial(
                    apply_bridge, drift, noise, coefficients, h, args
                )
            case "noise brackets":
                if len(noise) != 1:
                    raise ValueError(
                        f"`{solver_name}` needs all noises in one term, whose path samples "
                        f"the Lévy areas between them; got {len(noise)} noise terms. "
                        "Combine them."
                    )
                (areas,) = values[name]
                changes[name] = jtu.Partial(apply_brackets, noise[0], areas, args)
    return changes


def drawn_variables(
    noise: Terms,
    names: list[str],
    t0: RealScalarLike,
    t1: RealScalarLike,
    solver_name: str,
    optional: Iterable[str] = (),
) -> dict[str, list]:
    """The random variables of the step from `t0` to `t1`: for each name, one value for
    each noise term. The `optional` ones are left out unless all increments have them, and
    where `W` is the only one needed.

    Raises a `ValueError`, which quotes `solver_name`, if a path lacks one of `names`.
    """
    t1 = _checked_end_of_step(noise, t0, t1)
    # Without Lévy areas an increment is `W` itself.
    only_increments = names == ["W"]
    options = {} if only_increments else {"use_levy": True}

    def draw() -> list[Increment]:
        return [term.contr(t0, t1, **options) for term in noise]

    are_cheap = all(map(_is_cheap, brownian_paths(noise)))
    # XLA may compute a value anew wherever it is used, unless it is materialized.
    increments = draw() if are_cheap else materialize(draw)
    if only_increments:
        return {"W": increments}

    def all_have(name: str) -> bool:
        return all(getattr(x, name, None) is not None for x in increments)

    missing = [name for name in names if not all_have(name)]
    if missing:
        raise ValueError(f"`{solver_name}` needs {_how_to_get(missing, noise)}.")
    variables = {}
    for name in [*names, *filter(all_have, optional)]:
        values = [getattr(increment, name) for increment in increments]
        if name in VARIABLES and VARIABLES[name].even:
            # In a solve backward in time Diffrax negates all variables. An even variable is
            # the same for a path that is reversed in time, and must keep its sign.
            pairs = zip(noise, values)
            values = [(direction(term) * value**ω).ω for term, value in pairs]
        variables[name] = values
    return variables


def _how_to_get(missing: list[str], noise: Terms) -> str:
    """The end of a message such as "`SRKs4` needs ...": the random variables that are
    missing, and how to get them."""
    # If several are missing, the message is about the one of highest rank: a path that has
    # it also has the variables of lower rank.
    variable = most_demanding_variable(missing)
    if variable is None:
        return f"increments with the attribute `{missing[0]}`"
    # A path of the user's own without a random key, such as recorded noise, cannot draw
    # more. Another path would be other noise, so that only another solver helps.
    for path in brownian_paths(noise):
        if not is_random(path) and not isinstance(path, GivenPath):
            return (
                f"{variable.name}, but `{type(path).__name__}` has no random key to draw "
                "them from. Use a solver that needs only increments, such as "
                "`StormerVerlet` for separable systems or `ImplicitMidpoint` for others"
            )
    return variable.advice


def _checked_end_of_step(
    noise: Terms, t0: RealScalarLike, t1: RealScalarLike
) -> RealScalarLike:
    """Returns `t1`, the end of the step from `t0`. If a `VirtualBrownianTree` among the
    paths of the noise does not resolve the step, `t1` raises an error when it is used."""
    step_size = jnp.abs(t1 - t0)
    for path in brownian_paths(noise):
        while isinstance(path, AbstractWrappedPath):
            path = path.path
        if isinstance(path, diffrax.VirtualBrownianTree):
            tol = resolution(path)
            # The lower bound is for a last step that is as short as a rounding error, as
            # Diffrax may take it: it has next to no noise. The factor 0.999 is for a step
            # of `tol` that is rounded to less.
            t1 = eqx.error_if(
                jnp.asarray(t1),
                (step_size < 0.999 * tol) & (step_size > 1e-6 * tol),
                "A step is shorter than `tol` of the `VirtualBrownianTree`, which only "
                "interpolates at this scale, so the noise would be too small. Pass a "
                "smaller `tol`, or for fixed steps `FixedStepBrownianPath(shape, key)`.",
            )
    return t1


def _is_cheap(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether its random variables are cheaper to recompute than to store."""
    # A wrapper that samples Lévy areas sums a series, which is not cheap.
    while isinstance(path, TruncatedBrownianPath | PlateauBrownianPath):
        path = path.path
    return isinstance(path, WeakBrownianPath | FixedStepBrownianPath)
