"""Diffrax terms as a step uses them: drift and noise apart, the random variables of the
step, and checks that terms and state fit each other."""

import functools as ft
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._arguments import shapes
from ._bridge import apply_bridge, bridge
from ._brownian import (
    AbstractWrappedPath,
    FixedStepBrownianPath,
    PlateauBrownianPath,
    TruncatedBrownianPath,
    VARIABLES,
    WeakBrownianPath,
)
from ._compat import direction, is_adjoint_term, unwrapped, ω
from ._custom_types import Args, IntScalarLike, RealScalarLike, Y
from ._hamiltonian import HamiltonianNoise
from ._indexed_noise import OneNoise
from ._materialize import materialize


_BACKSOLVE = (
    "`diffrax.BacksolveAdjoint` cannot be used with the solvers of `diffrax_symplectic`: "
    "its gradients are not those of the solution. It takes steps of its own backward in "
    "time, over which a weak path has other increments, and a state that is no pair "
    "`(p, q)`. Pass `adjoint=diffrax_symplectic.ReversingAdjoint()`, whose memory does not "
    "grow with the steps either, or `adjoint=diffrax.RecursiveCheckpointAdjoint()`."
)


def split_terms(terms: diffrax.AbstractTerm) -> tuple[tuple, tuple]:
    """Drift terms and noise terms, in any order and however nested. A term is noise if it
    has a Brownian path, or if it is not the first one and time does not drive it.

    Raises a `ValueError` for the terms of `diffrax.BacksolveAdjoint`."""
    parts = _flatten(terms)
    if any(map(is_adjoint_term, parts)):
        raise ValueError(_BACKSOLVE)
    is_ode = lambda term: isinstance(unwrapped(term), diffrax.ODETerm)
    is_noise = [
        len(brownian_paths(term)) > 0 or (i > 0 and not is_ode(term))
        for i, term in enumerate(parts)
    ]
    drift = tuple(term for term, noise in zip(parts, is_noise) if not noise)
    return drift, tuple(term for term, noise in zip(parts, is_noise) if noise)


def _flatten(terms: diffrax.AbstractTerm) -> tuple:
    """The terms of a `MultiTerm`, and of every `MultiTerm` among these."""
    if isinstance(terms, diffrax.MultiTerm):
        return tuple(part for term in terms.terms for part in _flatten(term))
    return (terms,)


def brownian_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    return [x for x in jtu.tree_leaves(terms, is_leaf=_is_path) if _is_path(x)]


def replace_paths(terms: PyTree, new: Callable) -> PyTree:
    """The terms with `new(path)` in place of each Brownian path."""
    return jtu.tree_map(lambda x: new(x) if _is_path(x) else x, terms, is_leaf=_is_path)


def _is_path(x) -> bool:
    return isinstance(x, diffrax.AbstractBrownianPath)


# Called at several stages, this is traced and lowered once.
@eqx.filter_jit
def apply(terms: tuple, controls: list, args: Args, t: RealScalarLike, y: Y) -> Y:
    """The sum over terms of vector field times control."""
    total = tree_sum([_change(x, t, y, args, c) for x, c in zip(terms, controls)])
    _check_value(total, y)
    return total


def _change(term: diffrax.AbstractTerm, t, y: Y, args: Args, control: PyTree) -> Y:
    if isinstance(unwrapped(term), diffrax.ControlTerm):
        _check_product(term, t, y, args, control)
    return term.vf_prod(t, y, args, control)


def _check_product(term, t, y: Y, args: Args, control: PyTree) -> None:
    if jtu.tree_structure(y) == jtu.tree_structure(control):
        return
    matrix = eqx.filter_eval_shape(term.vf, t, y, args)
    is_operator = isinstance(matrix, lx.AbstractLinearOperator)
    if not is_operator and jtu.tree_structure(matrix) != jtu.tree_structure(control):
        # Diffrax multiplies leaf by leaf, and JAX then speaks of trees.
        raise ValueError(
            "A `ControlTerm` multiplies arrays only if state and noise have the same "
            f"structure; got a state of shape {shapes(y)} and a noise of shape "
            f"{shapes(control)}. Return the matrix of noises as a Lineax operator "
            "(`lineax.PyTreeLinearOperator`), make the state one array, or construct the "
            "terms with `hamiltonian_terms`."
        )


@eqx.filter_jit
def apply_one(
    terms: tuple,
    number: IntScalarLike,
    increment: Float[Array, ""],
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """The vector field of one noise times its increment. `number` counts the noises of
    all terms, in the order of their flattened controls."""
    parts, before = [], 0
    for term in terms:
        struct = eqx.filter_eval_shape(term.contr, 0.0, 1.0)
        m = sum(s.size for s in jtu.tree_leaves(struct))
        # The noise may belong to another term: then this one adds zero.
        here = (before <= number) & (number < before + m)
        local = jnp.clip(number - before, 0, m - 1)
        only = jnp.where(here, increment, 0)
        parts.append(_along_one(term, struct, local, only, args, t, y))
        before += m
    total = tree_sum(parts)
    _check_value(total, y)
    return total


def _along_one(term, struct, number, increment, args: Args, t, y: Y) -> Y:
    if isinstance(unwrapped(term), HamiltonianNoise):
        return term.vf_prod(t, y, args, OneNoise(number, increment))
    if isinstance(unwrapped(term), diffrax.ControlTerm):
        matrix = term.vf(t, y, args)
        # One array of noises, not a Lineax operator and no other PyTree.
        one_array = eqx.is_array(matrix) and isinstance(struct, jax.ShapeDtypeStruct)
        if one_array and struct.ndim == 1:
            return matrix[..., number] * increment.astype(matrix.dtype)
    flat, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, struct))
    only = flat.at[number].set(increment.astype(flat.dtype))
    return term.vf_prod(t, y, args, unravel(only))


@eqx.filter_jit
def apply_brackets(
    term: diffrax.AbstractTerm,
    A: Float[Array, "m m"],
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_{k<l} A_kl [b_k, b_l]`, with the Lie brackets `Db_l b_k - Db_k b_l` of the
    vector fields of one term.

    For antisymmetric `A` that is `sum_l Db_l (sum_k A_kl b_k)`: `m` derivatives.
    """
    struct = eqx.filter_eval_shape(term.contr, 0.0, 1.0)
    _, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, struct))
    along = lambda y, x: term.vf_prod(t, y, args, unravel(x))

    def summand(column, unit):
        return jax.jvp(lambda y: along(y, unit), (y,), (along(y, column),))[1]

    summands = jax.vmap(summand)(A.T, jnp.eye(len(A), dtype=A.dtype))
    return jtu.tree_map(lambda x: jnp.sum(x, axis=0), summands)


def tree_sum(values: list[Y]) -> Y:
    return ft.reduce(lambda a, b: (a**ω + b**ω).ω, values)


def controls(
    noise: tuple, names: list[str], t0, t1, solver: str, optional: tuple[str, ...] = ()
) -> dict[str, list]:
    """The random variables of the step from `t0` to `t1`, for each noise term; those of
    `optional` if all increments hold them."""
    t1 = _within_resolution(noise, t0, t1)
    drawn = ft.partial(_drawn, noise, t0, t1, use_levy=names != ["W"])
    # What costs less to compute again than to keep is not kept.
    cheap = all(map(_is_cheap, brownian_paths(noise)))
    increments = drawn() if cheap else materialize(drawn)
    if names == ["W"]:
        return {"W": increments}
    # The variables of which the increments hold most are looked for first: the advice for
    # these is right for the others, too.
    held = lambda name: all(getattr(i, name, None) is not None for i in increments)
    for name in sorted(names, key=lambda x: [*VARIABLES, x].index(x)):
        if not held(name):
            variable = VARIABLES.get(name)
            advice = f"increments with the attribute `{name}`"
            raise ValueError(
                f"`{solver}` needs {variable.advice if variable else advice}."
            )
    return {
        name: [
            _in_time(term, name, getattr(i, name)) for term, i in zip(noise, increments)
        ]
        for name in [*names, *filter(held, optional)]
    }


def _in_time(term: diffrax.AbstractTerm, name: str, x: PyTree[Array]) -> PyTree[Array]:
    """Backward in time Diffrax changes the sign of all random variables. Those that stay
    the same get it back."""
    even = name in VARIABLES and VARIABLES[name].even
    return (direction(term) * x**ω).ω if even else x


def _drawn(noise: tuple, t0, t1, use_levy: bool) -> list:
    if use_levy:
        return [term.contr(t0, t1, use_levy=True) for term in noise]
    return [term.contr(t0, t1) for term in noise]


def _within_resolution(noise: tuple, t0, t1) -> RealScalarLike:
    """`t1`, with an error when run if a tree does not resolve the step."""
    h = jnp.abs(t1 - t0)
    for path in map(_innermost, brownian_paths(noise)):
        if isinstance(path, diffrax.VirtualBrownianTree):
            # The tree keeps its tolerance in units of its length.
            tol = path.tol * (path.t1 - path.t0)
            # A difference of two times that is a rounding error is not a step.
            coarse = (h < 0.999 * tol) & (h > 1e-6 * tol)
            t1 = eqx.error_if(
                jnp.asarray(t1),
                coarse,
                "A step is shorter than `tol` of the `VirtualBrownianTree`, which only "
                "interpolates there, so that the noise would be too small. Pass a smaller "
                "`tol`, or for fixed steps `FixedStepBrownianPath(shape, key)`.",
            )
    return t1


def _innermost(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
    while isinstance(path, AbstractWrappedPath):
        path = path.path
    return path


def _is_cheap(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether its random variables cost less to compute again than to keep."""
    while isinstance(path, TruncatedBrownianPath | PlateauBrownianPath):
        path = path.path
    return isinstance(path, WeakBrownianPath | FixedStepBrownianPath)


def noise_driven(
    drift: tuple, noise: tuple, names: list[str], t0, t1, args: Args, solver: str
) -> dict[str, jtu.Partial]:
    """What drives noise stages over the step, for each random variable."""
    draw = lambda names, *optional: controls(noise, names, t0, t1, solver, optional)
    if "L" not in names:
        drawn = draw(names)
    else:
        # It is computed from others.
        own = [name for name in names if name != "L"]
        drawn = draw([*dict.fromkeys(["W", "H", *own])], "K")
    driven = {}
    for name in names:
        if name == "L":
            along = drift_driven(drift, t0, t1, args)
            bridges = bridge(t1 - t0, drawn["W"], drawn["H"], drawn.get("K"))
            driven[name] = jtu.Partial(
                apply_bridge, along, noise, bridges, t1 - t0, args
            )
        elif name != "A":
            driven[name] = jtu.Partial(apply, noise, drawn[name], args)
        elif len(noise) == 1:
            driven[name] = jtu.Partial(apply_brackets, noise[0], drawn[name][0], args)
        else:
            raise ValueError(
                f"`{solver}` needs all noises in one term, whose path samples the Lévy "
                f"areas between them; got {len(noise)} noise terms."
            )
    return driven


def drift_driven(drift: tuple, t0, t1, args: Args) -> jtu.Partial:
    """What drives drift stages over the step."""
    return jtu.Partial(apply, drift, [x.contr(t0, t1) for x in drift], args)


def check_state(y0: Y, solver: str) -> None:
    leaves = jtu.tree_leaves(y0)
    if len(leaves) == 0:
        raise ValueError(f"`{solver}` needs a state with at least one array in it.")
    for leaf in leaves:
        dtype = jnp.result_type(leaf)
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise ValueError(
                f"`{solver}` needs a state `y0` of real floating-point arrays; got an "
                f"array of dtype {dtype}. For complex amplitudes `psi` with Hamiltonians "
                "construct the terms with `wave_terms(H0, noise, path)` and pass "
                "`y0=to_pair(psi0)`. For other equations split the state into real and "
                "imaginary parts."
            )
        if not jnp.issubdtype(dtype, jnp.floating) or jnp.finfo(dtype).bits < 32:
            raise ValueError(
                f"`{solver}` needs a state `y0` of real floating-point arrays; got an "
                f"array of dtype {dtype}. Convert it with `.astype(float)`, to float32 or "
                "float64."
            )
    if len({jnp.result_type(leaf) for leaf in leaves}) > 1:
        raise ValueError(
            f"`{solver}` needs all arrays of `y0` in one dtype; got "
            f"{sorted({str(jnp.result_type(leaf)) for leaf in leaves})}."
        )


def _check_value(value: PyTree[Array], y: PyTree[Array]) -> None:
    def check(v, x):
        if jnp.result_type(v) != jnp.result_type(x) or jnp.shape(v) != jnp.shape(x):
            raise ValueError(
                "The terms change an array of dtype and shape "
                f"{jnp.result_type(x)}{jnp.shape(x)} by one of {jnp.result_type(v)}"
                f"{jnp.shape(v)}. Give the state, the vector fields and the path (as "
                "`shape=jax.ShapeDtypeStruct(shape, dtype)`) the same dtype, and time "
                "no wider one."
            )

    jtu.tree_map(check, value, y)


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """How many scalar random variables drive the noise terms."""
    _, noise = split_terms(terms)
    struct = eqx.filter_eval_shape(lambda: [term.contr(0.0, 1.0) for term in noise])
    return sum(int(np.prod(s.shape)) for s in jtu.tree_leaves(struct))


def strong_order_if_commutative(terms: diffrax.AbstractTerm) -> float:
    """1 for one noise, which commutes with itself, and 1/2 for several, of which it is not
    known whether they commute."""
    return 1.0 if number_of_noises(terms) <= 1 else 0.5
