"""Diffrax terms as a step uses them: drift and noise apart, vector fields times controls,
and the Lie brackets of vector fields."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._arguments import shapes
from .._compat import is_adjoint_term, unwrapped, ω
from .._custom_types import Args, IntScalarLike, RealScalarLike, Y
from ._hamiltonian import HamiltonianNoise, OneNoise


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
    parts = []
    for term, control in zip(terms, controls):
        parts.append(product(term, t, y, args, control))
    return _checked_sum(parts, y)


def rate(drift: tuple, t: RealScalarLike, y: Y, args: Args) -> Y:
    """The change of the state by the drift in a unit of time."""
    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    zero = jnp.zeros_like(t)
    return apply(drift, [x.contr(zero, zero + 1) for x in drift], args, t, y)


def check_fit(terms: PyTree, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` unless these are terms that change a state such as `y0`. (Some
    solvers of Diffrax take more than one, each for a part of the state.)"""
    is_term = lambda x: isinstance(x, diffrax.AbstractTerm)
    if not any(map(is_term, jtu.tree_leaves(terms, is_leaf=is_term))):
        raise ValueError(
            "`terms` must be terms of Diffrax, such as `hamiltonian_terms(H0, noise, path)`"
            f"; got {type(terms).__name__}."
        )
    if is_term(terms):
        parts = tuple(_flatten(terms))
        controls = eqx.filter_eval_shape(lambda: [x.contr(t0, t0) for x in parts])
        eqx.filter_eval_shape(apply, parts, controls, args, t0, y0)


def check_controls(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` unless the vector fields of `ControlTerm`s take increments of
    the shapes of their paths to changes of `y0`."""
    for term in noise:
        if isinstance(unwrapped(term), diffrax.ControlTerm):
            _check_control(term, t0, y0, args)


def _check_control(term: diffrax.AbstractTerm, t0, y0: Y, args: Args) -> None:
    zeros = ft.partial(jtu.tree_map, lambda s: jnp.zeros(s.shape, s.dtype))

    def field():
        """The vector field, or for an operator what it takes and what it returns."""
        out = term.vf(t0, y0, args)
        if not isinstance(out, lx.AbstractLinearOperator):
            return False, False, out
        exact = isinstance(out, lx.FunctionLinearOperator)
        return True, exact, zeros((out.in_structure(), out.out_structure()))

    is_operator, exact, out = eqx.filter_eval_shape(field)
    path = eqx.filter_eval_shape(term.contr, t0, t0)
    like = jax.eval_shape(lambda: y0)
    if is_operator:
        known = lambda x: jtu.tree_map(lambda s: s.dtype if exact else 0, x)
        takes, returns = out
        same = lambda a, b: (
            jtu.tree_structure(a) == jtu.tree_structure(b) and _shapes(a) == _shapes(b)
        )
        if not same(takes, path) or exact and known(takes) != known(path):
            raise ValueError(
                "The operator that the vector field of a `ControlTerm` returns takes noise "
                f"of {_spelled(takes)}, and the path has increments of {_spelled(path)}. "
                "Construct the path with `shape=` what the operator takes."
            )
        if not same(returns, like):
            raise ValueError(
                "The operator that the vector field of a `ControlTerm` returns makes "
                f"{_spelled(returns)}, and the state is {_spelled(like)}."
            )
        return
    if len({*map(jtu.tree_structure, (out, path, like))}) > 1:
        return  # `product` says so.
    for matrix, increment, x in zip(*map(jtu.tree_leaves, (out, path, like))):
        if jnp.shape(matrix) != x.shape + increment.shape:
            raise ValueError(
                "The vector field of a `ControlTerm` must return an array of the shape of "
                f"the state and then of the noise, {x.shape + increment.shape}; got "
                f"{jnp.shape(matrix)}. Is the `shape={increment.shape}` of the path that "
                "of the noise?"
            )


def _shapes(tree: PyTree) -> list[tuple[int, ...]]:
    return [leaf.shape for leaf in jtu.tree_leaves(tree)]


def _spelled(tree: PyTree) -> str:
    return eqx.tree_pformat(tree, struct_as_array=True)


def product(term: diffrax.AbstractTerm, t, y: Y, args: Args, control: PyTree) -> Y:
    """Vector field times control."""
    try:
        return term.vf_prod(t, y, args, control)
    except ValueError:
        if not isinstance(unwrapped(term), diffrax.ControlTerm):
            raise
        matrix = eqx.filter_eval_shape(term.vf, t, y, args)
        is_operator = isinstance(matrix, lx.AbstractLinearOperator)
        structures = set(map(jtu.tree_structure, (matrix, y, control)))
        if is_operator or len(structures) == 1:
            raise
    # Diffrax multiplies leaf by leaf, and JAX then speaks of trees.
    raise ValueError(
        "A `ControlTerm` multiplies arrays only if vector field, state and noise have the "
        f"same structure; got shapes {shapes(matrix)}, {shapes(y)} and {shapes(control)}. "
        "Return the matrix of noises as a Lineax operator "
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
    return _checked_sum(parts, y)


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

    return _total(jax.vmap(summand)(A.T, np.eye(len(A), dtype=A.dtype)), len(A))


def _total(summands: Y, m: int) -> Y:
    """The sum of `m` of them, written out: of large batches XLA fuses no sum over an axis
    with what it goes into. With 8,000 paths a step would take three times as long."""
    return tree_sum([jtu.tree_map(lambda x: x[k], summands) for k in range(m)])


def tree_sum(values: list[Y]) -> Y:
    return ft.reduce(lambda a, b: (a**ω + b**ω).ω, values)


class Bridge(NamedTuple):
    r"""Integrals over a step of size $h$ of the Brownian bridges of `m` noises: their paths
    less the straight lines between the ends.

    - `first`: the means of the bridges over the step, $H_k$.
    - `second`: $\frac{1}{2h} \int (\text{bridge}_k + W_k (\frac sh - \frac12))
        (\text{bridge}_l + W_l (\frac sh - \frac12))\,\mathrm{d}s - \frac{1}{24} W_k W_l$,
        in expectation.
    """

    first: Float[Array, " m"]
    second: Float[Array, "m m"]


def bridge(h: RealScalarLike, W: PyTree, H: PyTree, K: PyTree | None) -> Bridge:
    r"""The expectations of these integrals given the space-time areas, and given the
    space-time-time areas as well unless `K` is `None`.

    A bridge is $6 u (1 - u) H + 120 u (1 - u) (\frac12 - u) K$ with $u = s / h$, and an
    independent rest whose square has the mean $h / 15$ without the second summand, and
    $3 h / 70$ with it.
    """
    w, first = jfu.ravel_pytree(W)[0], jfu.ravel_pytree(H)[0]
    one = jnp.eye(first.size, dtype=first.dtype) * jnp.abs(h).astype(first.dtype)
    second = 3 / 5 * jnp.outer(first, first)
    if K is None:
        return Bridge(first, second + one / 30)
    k = jfu.ravel_pytree(K)[0]
    mixed = jnp.outer(w, k)
    second = second + 60 / 7 * jnp.outer(k, k) - (mixed + mixed.T) / 2
    return Bridge(first, second + 3 / 140 * one)


@eqx.filter_jit
def apply_bridge(
    drift: jtu.Partial,
    noise: tuple[diffrax.AbstractTerm, ...],
    bridge: Bridge,
    h: RealScalarLike,
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_k H_k [b_k, A] + sum_{k, l} L_kl [b_k, [b_l, A]]`, with `A(t, y) = drift(t, y)`
    the drift times `h`, and `[b, A] = A' b - b' A`. Time is a part of the state that the
    drift moves by `h`. For `m` noises that is `m` double brackets.
    """
    struct = eqx.filter_eval_shape(lambda: [term.contr(0.0, 1.0) for term in noise])
    _, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, struct))
    t = jnp.asarray(t, jnp.result_type(h))

    def along_noise(t, y, x):
        controls = zip(noise, unravel(x))
        return tree_sum([term.vf_prod(t, y, args, c) for term, c in controls])

    def bracket(x, field, t, y, speed):
        """The bracket of the noise along `x` with `field`, which moves time by `speed`; and
        the value of `field`."""
        b = along_noise(t, y, x)
        value, change = jax.jvp(lambda y: field(t, y), (y,), (b,))
        along = lambda t, y: along_noise(t, y, x)
        _, carried = jax.jvp(along, (t, y), (speed, value))
        return (change**ω - carried**ω).ω, value

    def summand(unit, first, column):
        along_unit = lambda t, y: bracket(unit, drift, t, y, jnp.asarray(h, t.dtype))[0]
        double, single = bracket(column, along_unit, t, y, jnp.zeros_like(t))
        return (double**ω + first * single**ω).ω

    units = np.eye(bridge.first.size, dtype=bridge.first.dtype)
    return _total(jax.vmap(summand)(units, *bridge), len(units))


def _checked_sum(parts: list[Y], y: Y) -> Y:
    """The sum, which must have the dtypes and shapes of the state."""

    def check(v, x):
        # The result type of an array made before 64 bits were enabled may not be its own.
        v, x = jnp.asarray(v), jnp.asarray(x)
        if (v.dtype, v.shape) != (x.dtype, x.shape):
            raise ValueError(
                f"The terms change an array of dtype and shape {x.dtype}{x.shape} by one "
                f"of {v.dtype}{v.shape}. Give the state, the vector fields and the path "
                "(as `shape=jax.ShapeDtypeStruct(shape, dtype)`) the same dtype, and time "
                "no wider one."
            )

    total = tree_sum(parts)
    jtu.tree_map(check, total, y)
    return total


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """How many scalar random variables drive the noise terms."""
    _, noise = split_terms(terms)
    struct = eqx.filter_eval_shape(lambda: [term.contr(0.0, 1.0) for term in noise])
    return sum(int(np.prod(s.shape)) for s in jtu.tree_leaves(struct))
