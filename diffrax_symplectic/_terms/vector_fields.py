"""Operations on Diffrax terms: splitting drift and noise, vector fields times controls, and
Lie brackets of vector fields."""

import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._brownian import num_noises, raveled
from .._compat import is_adjoint_term, unwrapped, ω
from .._custom_types import Args, IntScalarLike, RealScalarLike, Y
from .constraint import ConstrainedDrift, without_constraint
from .hamiltonian import HamiltonianNoise, OneNoise
from .paths import brownian_paths


_BACKSOLVE = (
    "`diffrax.BacksolveAdjoint` cannot be used with the solvers of `diffrax_symplectic`: "
    "its steps backward in time differ from the forward steps, so a weak path has other "
    "increments, and the gradients would be wrong. Pass `adjoint=diffrax_symplectic."
    "ReversingAdjoint()`, whose memory does not grow with the number of steps either, or "
    "`adjoint=diffrax.RecursiveCheckpointAdjoint()`."
)


def split_terms(terms: diffrax.AbstractTerm) -> tuple[tuple, tuple]:
    """Drift terms and noise terms. A term is noise if it has a Brownian path, or if it is
    neither the first term nor an `ODETerm`.

    Raises a `ValueError` for the terms of `diffrax.BacksolveAdjoint`."""
    parts = flattened(terms)
    if any(map(is_adjoint_term, parts)):
        raise ValueError(_BACKSOLVE)
    drift = []
    noise = []
    for place, term in enumerate(parts):
        # A term of another kind after the first may be driven by a path that Diffrax knows
        # nothing of. It must not pass for a drift: most solvers treat noise differently.
        other_kind = place > 0 and not _is_ode(term)
        if len(brownian_paths(term)) > 0 or other_kind:
            noise.append(term)
        else:
            drift.append(term)
    return tuple(drift), tuple(noise)


def _is_ode(term: diffrax.AbstractTerm) -> bool:
    return isinstance(unwrapped(term), diffrax.ODETerm | ConstrainedDrift)


def flattened(terms: diffrax.AbstractTerm) -> tuple:
    """The terms of a `MultiTerm`, including nested ones."""
    if isinstance(terms, diffrax.MultiTerm):
        return tuple(part for term in terms.terms for part in flattened(term))
    return (terms,)


# With `jit` this is traced and lowered once for several stages.
@eqx.filter_jit
def apply(terms: tuple, controls: list, args: Args, t: RealScalarLike, y: Y) -> Y:
    """The sum over terms of vector field times control."""
    pairs = zip(terms, controls)
    parts = [term.vf_prod(t, y, args, control) for term, control in pairs]
    return _checked_sum(parts, y)


def rate(drift: tuple, t: RealScalarLike, y: Y, args: Args) -> Y:
    """The rate of change of the state by the drift."""
    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    # Over a step of size one, whose place does not matter to a drift driven by time.
    zero = jnp.zeros_like(t)
    controls = [term.contr(zero, zero + 1) for term in drift]
    return apply(drift, controls, args, t, y)


def check_fit(terms: PyTree, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` unless these are terms that fit the state `y0`. (A PyTree of
    terms, as some Diffrax solvers take, is not checked further.)"""
    if not any(map(_is_term, jtu.tree_leaves(terms, is_leaf=_is_term))):
        raise ValueError(
            "`terms` must be Diffrax terms, such as `hamiltonian_terms(H0, noise, path)`"
            f"; got {type(terms).__name__}."
        )
    if not _is_term(terms):
        return
    parts = tuple(flattened(without_constraint(terms)))
    # First, since its message names the term and its path.
    check_increments(parts, t0, y0, args)

    def changed(t: RealScalarLike) -> Y:
        controls = [term.contr(t, t) for term in parts]
        return apply(parts, controls, args, t0, y0)

    eqx.filter_eval_shape(changed, t0)


def _is_term(x: Any) -> bool:
    return isinstance(x, diffrax.AbstractTerm)


def check_increments(terms: tuple, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` if a `ControlTerm` cannot multiply its vector field by the
    increments of its path. (The errors of JAX and Lineax name neither.)"""

    def product(term: diffrax.AbstractTerm) -> Y:
        field = term.vf(t0, y0, args)
        increments = term.contr(t0, t0)
        try:
            return term.prod(field, increments)
        except (TypeError, ValueError) as error:
            is_operator = isinstance(field, lx.AbstractLinearOperator)
            takes = field.in_structure() if is_operator else field
            kind = "a Lineax operator on" if is_operator else "an array"
            instead = "Construct the path with the shape and dtype that the field takes"
            if len(jtu.tree_leaves(y0)) > 1 and not is_operator:
                kind = "arrays"
                instead = (
                    "Of a state of several arrays the vector field must be a Lineax "
                    "operator, such as a `lineax.FunctionLinearOperator` that maps the "
                    "increments to a change of the state"
                )
            elif not is_operator:
                instead += ", for an array the shape of its last axes"
            raise ValueError(
                "A `ControlTerm` cannot multiply its vector field, "
                f"{kind} {_brief(takes)}, by the increments of its path, "
                f"{_brief(increments)}. {instead}."
            ) from error

    for term in terms:
        if isinstance(unwrapped(term), diffrax.ControlTerm):
            eqx.filter_eval_shape(product, term)


def _brief(tree: PyTree) -> str:
    """The shapes and dtypes of arrays, for messages."""
    return eqx.tree_pformat(tree, struct_as_array=True)


def control_struct(
    term: diffrax.AbstractTerm, t: RealScalarLike = 0.0
) -> PyTree[jax.ShapeDtypeStruct]:
    """The shapes and dtypes of the control of a term, for times with the dtype of `t`."""
    return eqx.filter_eval_shape(term.contr, t, t + 1)


@eqx.filter_jit
def apply_one(
    terms: tuple,
    number: IntScalarLike,
    increment: Float[Array, ""],
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """The vector field of one noise times its increment. `number` is its index among the
    noises of all terms, in the order of their flattened controls."""
    parts = []
    # The number of noises of the terms before this one.
    before = 0
    for term in terms:
        struct = control_struct(term)
        m = num_noises(struct)
        # If the noise belongs to another term, this one adds zero.
        here = (before <= number) & (number < before + m)
        local = jnp.clip(number - before, 0, m - 1)
        only = jnp.where(here, increment, 0)
        parts.append(_one_product(term, struct, local, only, args, t, y))
        before += m
    return _checked_sum(parts, y)


def _one_product(
    term: diffrax.AbstractTerm,
    struct: PyTree[jax.ShapeDtypeStruct],
    number: IntScalarLike,
    increment: Float[Array, ""],
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """The vector field of one noise of this term times its increment. `struct` are the
    shapes of all increments. Where possible no other noise is evaluated or multiplied."""
    if isinstance(unwrapped(term), HamiltonianNoise):
        return term.vf_prod(t, y, args, OneNoise(number, increment))
    if isinstance(unwrapped(term), diffrax.ControlTerm):
        matrix = term.vf(t, y, args)
        # A single array of noises, not a Lineax operator or another PyTree.
        one_array = eqx.is_array(matrix) and isinstance(struct, jax.ShapeDtypeStruct)
        if one_array and matrix.ndim > 0 and matrix.shape[-1:] == struct.shape:
            return matrix[..., number] * increment.astype(matrix.dtype)
    # Of a term of any other kind, the sum over all noises, of which one is not zero.
    flat, unravel = raveled(struct)
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

    For antisymmetric `A` this is `sum_l Db_l (sum_k A_kl b_k)`, with `m` derivatives.
    """
    _, unravel = raveled(control_struct(term))

    def field(increments: Float[Array, " m"], y: Y) -> Y:
        return term.vf_prod(t, y, args, unravel(increments))

    def summand(column: Float[Array, " m"], unit: Float[Array, " m"]) -> Y:
        b_l = ft.partial(field, unit)
        return jax.jvp(b_l, (y,), (field(column, y),))[1]

    # NumPy's, a constant that XLA folds, unlike `jnp.eye`.
    units: Any = np.eye(len(A), dtype=A.dtype)
    return _total(jax.vmap(summand)(A.T, units), len(A))


def _total(summands: Y, m: int) -> Y:
    """The sum of `m` summands, unrolled, so that XLA fuses it with its uses: a reduction
    over the axis made a step of 8,000 paths three times slower."""
    return tree_sum([jtu.tree_map(lambda x: x[k], summands) for k in range(m)])


def tree_sum(values: list[Y]) -> Y:
    """The sum of PyTrees of the same structure, at least one."""
    total, *others = values
    for value in others:
        total = (total**ω + value**ω).ω
    return total


def bridge(
    h: RealScalarLike, W: PyTree, H: PyTree, K: PyTree | None
) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
    r"""$H_k$ and $L_{kl} / h$ of [`diffrax_symplectic.PlateauGauss`][] for `m` noises,
    given the space-time areas, and space-time-time areas unless `K` is `None`.

    A Brownian bridge is $6 u (1 - u) H + 120 u (1 - u) (\frac12 - u) K$ with $u = s / h$
    plus an independent remainder. The time average of its mean square is $h / 15$ without
    the second summand, and $3 h / 70$ with it.
    """
    increments, _ = jfu.ravel_pytree(W)
    areas, _ = jfu.ravel_pytree(H)
    # In a solve backward in time steps are negative, and the mean square is not.
    size = jnp.abs(h).astype(areas.dtype)
    one = jnp.eye(areas.size, dtype=areas.dtype) * size
    # Each of these is half of the time average of a square.
    second = 3 / 5 * jnp.outer(areas, areas)
    if K is None:
        return areas, second + one / 30
    more_areas, _ = jfu.ravel_pytree(K)
    mixed = jnp.outer(increments, more_areas)
    squares = 60 / 7 * jnp.outer(more_areas, more_areas)
    second = second + squares - (mixed + mixed.T) / 2
    return areas, second + 3 / 140 * one


@eqx.filter_jit
def apply_bridge(
    drift: jtu.Partial,
    noise: tuple[diffrax.AbstractTerm, ...],
    bridge: tuple[Float[Array, " m"], Float[Array, "m m"]],
    h: RealScalarLike,
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_k H_k [b_k, A] + sum_{k, l} L_kl [b_k, [b_l, A]]`, where `A(t, y) = drift(t, y)`
    is the drift times `h`, and `[b, A] = A' b - b' A`. Time is treated as a component of
    the state that the drift advances by `h`. Computes `m` double brackets for `m` noises.
    """
    _, unravel = raveled([control_struct(term) for term in noise])
    t = jnp.asarray(t, jnp.result_type(h))
    areas, _ = bridge

    def b(increments: Float[Array, " m"], t: Array, y: Y) -> Y:
        """The noise with these increments."""
        pairs = zip(noise, unravel(increments))
        return tree_sum([term.vf_prod(t, y, args, control) for term, control in pairs])

    def bracket(
        increments: Float[Array, " m"], field: Callable, t: Array, y: Y, speed: Array
    ) -> tuple[Y, Y]:
        """`[b, field]`, where `field` advances time by `speed`; and `field` itself."""
        along = b(increments, t, y)
        value, change = jax.jvp(lambda y: field(t, y), (y,), (along,))
        noise_of = ft.partial(b, increments)
        _, carried = jax.jvp(noise_of, (t, y), (speed, value))
        return (change**ω - carried**ω).ω, value

    def with_drift(unit: Float[Array, " m"], t: Array, y: Y) -> Y:
        """`[b_k, A]` for the noise `k` of this unit vector."""
        return bracket(unit, drift, t, y, jnp.asarray(h, t.dtype))[0]

    def summand(unit: Float[Array, " m"], area: Array, column: Float[Array, " m"]) -> Y:
        """`[L_k . b, [b_k, A]] + H_k [b_k, A]`: the outer brackets of all noises with the
        inner one of `k` are one bracket, with their sum."""
        inner = ft.partial(with_drift, unit)
        # This bracket has no drift, so that it leaves the time.
        double, single = bracket(column, inner, t, y, jnp.zeros_like(t))
        return (double**ω + area * single**ω).ω

    units: Any = np.eye(areas.size, dtype=areas.dtype)
    return _total(jax.vmap(summand)(units, *bridge), len(units))


def _checked_sum(parts: list[Y], y: Y) -> Y:
    """The sum. Raises a `ValueError` unless all have the dtypes and shapes of the state."""

    def check(change: Any, x: Any) -> None:
        # Either may be a number of Python or NumPy. (Not `jnp.result_type`: a weakly typed
        # scalar that was made before 64 bits were enabled is float32, with result type
        # float64.)
        change = jnp.asarray(change)
        x = jnp.asarray(x)
        if (change.dtype, change.shape) != (x.dtype, x.shape):
            raise ValueError(
                f"The terms change an array of dtype and shape {x.dtype}{x.shape} by one "
                f"of {change.dtype}{change.shape}. Give the state, the vector fields and "
                "the path (as `shape=jax.ShapeDtypeStruct(shape, dtype)`) the same dtype, "
                "and times a dtype that is not wider."
            )

    for part in parts:
        jtu.tree_map(check, part, y)
    return tree_sum(parts)


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """The number of scalar Brownian motions that drive the noise terms."""
    _, noise = split_terms(terms)
    return num_noises([control_struct(term) for term in noise])
