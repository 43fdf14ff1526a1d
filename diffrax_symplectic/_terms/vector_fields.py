"""Operations on Diffrax terms: splitting drift and noise, vector fields times controls, and
Lie brackets of vector fields."""

import functools as ft

import diffrax
import equinox as eqx
import jax
import jax.core
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
    ode = diffrax.ODETerm | ConstrainedDrift
    is_ode = lambda term: isinstance(unwrapped(term), ode)
    is_noise = [
        len(brownian_paths(term)) > 0 or (i > 0 and not is_ode(term))
        for i, term in enumerate(parts)
    ]
    drift = tuple(term for term, noise in zip(parts, is_noise) if not noise)
    return drift, tuple(term for term, noise in zip(parts, is_noise) if noise)


def flattened(terms: diffrax.AbstractTerm) -> tuple:
    """The terms of a `MultiTerm`, including nested ones."""
    if isinstance(terms, diffrax.MultiTerm):
        return tuple(part for term in terms.terms for part in flattened(term))
    return (terms,)


# With `jit` this is traced and lowered once for several stages.
@eqx.filter_jit
def apply(terms: tuple, controls: list, args: Args, t: RealScalarLike, y: Y) -> Y:
    """The sum over terms of vector field times control."""
    parts = [term.vf_prod(t, y, args, c) for term, c in zip(terms, controls)]
    return _checked_sum(parts, y)


def rate(drift: tuple, t: RealScalarLike, y: Y, args: Args) -> Y:
    """The rate of change of the state by the drift."""
    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    zero = jnp.zeros_like(t)
    return apply(drift, [x.contr(zero, zero + 1) for x in drift], args, t, y)


def check_fit(terms: PyTree, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` unless these are terms that fit the state `y0`. (A PyTree of
    terms, as some Diffrax solvers take, is not checked further.)"""
    is_term = lambda x: isinstance(x, diffrax.AbstractTerm)
    if not any(map(is_term, jtu.tree_leaves(terms, is_leaf=is_term))):
        raise ValueError(
            "`terms` must be Diffrax terms, such as `hamiltonian_terms(H0, noise, path)`"
            f"; got {type(terms).__name__}."
        )
    if is_term(terms):
        parts = tuple(flattened(without_constraint(terms)))
        check_increments(parts, t0, y0, args)
        controls = eqx.filter_eval_shape(lambda: [x.contr(t0, t0) for x in parts])
        eqx.filter_eval_shape(apply, parts, controls, args, t0, y0)


def check_increments(terms: tuple, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` if a `ControlTerm` cannot multiply its vector field by the
    increments of its path. (The errors of JAX and Lineax name neither.)"""

    def product(term):
        field, increments = term.vf(t0, y0, args), term.contr(t0, t0)
        try:
            return term.prod(field, increments)
        except (TypeError, ValueError) as error:
            is_operator = isinstance(field, lx.AbstractLinearOperator)
            takes = field.in_structure() if is_operator else field
            kind = "a Lineax operator on" if is_operator else "an array"
            raise ValueError(
                "A `ControlTerm` cannot multiply its vector field, "
                f"{kind} {_brief(takes)}, by the increments of its path, "
                f"{_brief(increments)}. Construct the path with the shape and dtype that "
                "the vector field takes, for an array the shape of its last axes."
            ) from error

    for term in terms:
        if isinstance(unwrapped(term), diffrax.ControlTerm):
            eqx.filter_eval_shape(product, term)


def _brief(tree: PyTree) -> str:
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
    parts, before = [], 0
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


def _one_product(term, struct, number, increment, args: Args, t, y: Y) -> Y:
    """The vector field of one noise of this term times its increment."""
    if isinstance(unwrapped(term), HamiltonianNoise):
        return term.vf_prod(t, y, args, OneNoise(number, increment))
    if isinstance(unwrapped(term), diffrax.ControlTerm):
        matrix = term.vf(t, y, args)
        # A single array of noises, not a Lineax operator or another PyTree.
        one_array = eqx.is_array(matrix) and isinstance(struct, jax.ShapeDtypeStruct)
        if one_array and matrix.ndim > 0 and matrix.shape[-1:] == struct.shape:
            return matrix[..., number] * increment.astype(matrix.dtype)
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
    field = lambda y, x: term.vf_prod(t, y, args, unravel(x))

    def summand(column, unit):
        return jax.jvp(lambda y: field(y, unit), (y,), (field(y, column),))[1]

    return _total(jax.vmap(summand)(A.T, np.eye(len(A), dtype=A.dtype)), len(A))


def _total(summands: Y, m: int) -> Y:
    """The sum of `m` summands, unrolled, so that XLA fuses it with its uses: a reduction
    over the axis made a step of 8,000 paths three times slower."""
    return tree_sum([jtu.tree_map(lambda x: x[k], summands) for k in range(m)])


def tree_sum(values: list[Y]) -> Y:
    return ft.reduce(lambda a, b: (a**ω + b**ω).ω, values)


def bridge(
    h: RealScalarLike, W: PyTree, H: PyTree, K: PyTree | None
) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
    r"""$H_k$ and $L_{kl} / h$ of [`diffrax_symplectic.PlateauGauss`][] for `m` noises,
    given the space-time areas, and space-time-time areas unless `K` is `None`.

    A Brownian bridge is $6 u (1 - u) H + 120 u (1 - u) (\frac12 - u) K$ with $u = s / h$
    plus an independent remainder. The time average of its mean square is $h / 15$ without
    the second summand, and $3 h / 70$ with it.
    """
    w, first = jfu.ravel_pytree(W)[0], jfu.ravel_pytree(H)[0]
    one = jnp.eye(first.size, dtype=first.dtype) * jnp.abs(h).astype(first.dtype)
    second = 3 / 5 * jnp.outer(first, first)
    if K is None:
        return first, second + one / 30
    k = jfu.ravel_pytree(K)[0]
    mixed = jnp.outer(w, k)
    second = second + 60 / 7 * jnp.outer(k, k) - (mixed + mixed.T) / 2
    return first, second + 3 / 140 * one


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

    def b(x, t, y):
        """The noise with increments `x`."""
        controls = zip(noise, unravel(x))
        return tree_sum([term.vf_prod(t, y, args, c) for term, c in controls])

    def bracket(x, field, t, y, speed):
        """`[b(x), field]`, where `field` advances time by `speed`; and `field` itself."""
        value, change = jax.jvp(lambda y: field(t, y), (y,), (b(x, t, y),))
        _, carried = jax.jvp(lambda t, y: b(x, t, y), (t, y), (speed, value))
        return (change**ω - carried**ω).ω, value

    def summand(unit, first, column):
        inner = lambda t, y: bracket(unit, drift, t, y, jnp.asarray(h, t.dtype))[0]
        double, single = bracket(column, inner, t, y, jnp.zeros_like(t))
        return (double**ω + first * single**ω).ω

    units = np.eye(bridge[0].size, dtype=bridge[0].dtype)
    return _total(jax.vmap(summand)(units, *bridge), len(units))


def _checked_sum(parts: list[Y], y: Y) -> Y:
    """The sum. Raises a `ValueError` unless all have the dtypes and shapes of the state."""

    def check(v, x):
        # An array made before 64 bits were enabled may have a dtype unlike its result type.
        v, x = jnp.asarray(v), jnp.asarray(x)
        if (v.dtype, v.shape) != (x.dtype, x.shape):
            raise ValueError(
                f"The terms change an array of dtype and shape {x.dtype}{x.shape} by one "
                f"of {v.dtype}{v.shape}. Give the state, the vector fields and the path "
                "(as `shape=jax.ShapeDtypeStruct(shape, dtype)`) the same dtype, and times "
                "a dtype that is not wider."
            )

    for part in parts:
        jtu.tree_map(check, part, y)
    return tree_sum(parts)


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """The number of scalar Brownian motions that drive the noise terms."""
    _, noise = split_terms(terms)
    return num_noises([control_struct(term) for term in noise])
