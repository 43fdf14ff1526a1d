"""The forms of friction, a number, an array, a matrix or directions, and its root in the
noise of a temperature."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._arguments import check_takes, real_array, shapes
from .._custom_types import Args, BM, RealScalarLike
from ._hamiltonian import evaluated


_P = PyTree[Array]
Value = PyTree[ArrayLike] | Callable[[RealScalarLike, _P, Args], PyTree[ArrayLike]]


class FrictionAlong(eqx.Module):
    r"""Friction along given directions, for [`diffrax_symplectic.langevin_terms`][]:
    $G = \sum_k d_k d_k^\top$.

    For friction between pairs of particles, each pair has a direction, which is opposite
    for the two of them. The noise is $\sqrt{2 T} \sum_k d_k\,\mathrm{d}w_k$, so that no
    root of a matrix is taken, and both conserve the total momentum.
    """

    directions: Value


FrictionAlong.__init__.__doc__ = """**Arguments:**

- `directions`: an array of shape `(*p.shape, m)` for `m` noises, or for momenta in a PyTree
    a PyTree of such arrays; or a function `(t, q, args)` of these. In units of the root of
    a friction, (force / velocity)^(1/2).
"""


class _Square(eqx.Module):
    """A constant array that may be a matrix; whether it is symmetric positive semidefinite,
    and then its root, computed once."""

    value: Array
    is_semidefinite: Bool[Array, ""]
    root: Array


def value_at(name: str, value: Any, t, q: _P, args: Args) -> PyTree:
    return evaluated(name, value, t, q, args=args) if callable(value) else value


def product_with(friction: Any, t, q: _P, args: Args, velocity: _P) -> _P:
    """`G v`."""
    if isinstance(friction, FrictionAlong):
        columns = _columns(friction, t, q, args)
        along = lambda d, v: jnp.tensordot(v, d, jnp.ndim(v))
        parts = jtu.tree_leaves(jtu.tree_map(along, columns, velocity))
        return jtu.tree_map(lambda d: d @ sum(parts), columns)

    def product(g, v):
        value = g.value if isinstance(g, _Square) else g
        if not _is_matrix(value, v):
            return not_negative(like(value, v)) * v
        force = jnp.tensordot(like(value, v), v, jnp.ndim(v))
        if not isinstance(g, _Square):
            return force
        return jnp.where(g.is_semidefinite, force, jnp.nan)

    value = _for_each("friction", value_at("friction", friction, t, q, args), q)
    return jtu.tree_map(product, value, velocity, is_leaf=_is_square)


def root_product_with(
    friction: Any, T: PyTree, t, q: _P, args: Args, control: BM
) -> _P:
    """`B W`."""
    if isinstance(friction, FrictionAlong):
        columns = _columns(friction, t, q, args)
        flat, _ = jfu.ravel_pytree(control)
        scale = _single_temperature(T)
        first = jtu.tree_leaves(columns)[0]
        if jnp.shape(first)[-1:] != flat.shape:
            raise ValueError(
                "The `path` of `langevin_terms` must have one noise for each direction of "
                f"the friction, shape {jnp.shape(first)[-1:]}; got shape {shapes(control)}."
            )
        along = lambda d: d @ (jnp.sqrt(2 * like(scale, d)) * flat.astype(d.dtype))
        return jtu.tree_map(along, columns)
    if jtu.tree_structure(control) != jtu.tree_structure(q) or [
        jnp.shape(x) for x in jtu.tree_leaves(control)
    ] != [jnp.shape(x) for x in jtu.tree_leaves(q)]:
        raise ValueError(
            f"The `path` of `langevin_terms` must have the shape of `q`, {shapes(q)}; got "
            f"shape {shapes(control)}."
        )

    def product(g, temperature, x, w):
        w = like(w, x)
        matrix = g.value if isinstance(g, _Square) else g
        if not _is_matrix(matrix, x):
            if jnp.shape(temperature) not in ((), jnp.shape(x)):
                raise ValueError(
                    "An array of `temperature` must be a scalar, or have the shape of its "
                    f"momenta, {jnp.shape(x)}; got shape {jnp.shape(temperature)}."
                )
            # Where either is negative, NaN makes the path fail.
            return jnp.sqrt(like(matrix, x)) * jnp.sqrt(2 * like(temperature, x)) * w
        scale = jnp.sqrt(2 * like(_single_temperature(temperature), x))
        root = like(g.root, x) if isinstance(g, _Square) else _root(like(g, x))
        return scale * jnp.tensordot(root, w, jnp.ndim(w))

    value = _for_each("friction", value_at("friction", friction, t, q, args), q)
    return jtu.tree_map(
        product, value, _for_each("temperature", T, q), q, control, is_leaf=_is_square
    )


def _columns(friction: FrictionAlong, t, q: _P, args: Args) -> _P:
    """The directions for each array of the momenta, with a trailing axis of noises."""
    columns = value_at("directions", friction.directions, t, q, args)
    columns = _for_each("directions", columns, q)
    numbers = {jnp.shape(d)[-1:] for d in jtu.tree_leaves(columns)}
    fits = lambda d, x: jnp.ndim(d) > 0 and jnp.shape(d)[:-1] == jnp.shape(x)
    if len(numbers) > 1 or not all(
        jtu.tree_leaves(jtu.tree_map(fits, columns, q))
    ):  # fmt: skip
        raise ValueError(
            "`directions` of `FrictionAlong` must have the shape of the momenta and one "
            f"more axis, for the noises; got shape {shapes(columns)} for momenta of shape "
            f"{shapes(q)}."
        )
    return jtu.tree_map(like, columns, q)


def _is_matrix(g: ArrayLike, x: Array) -> bool:
    """Whether this is a matrix for the momenta `x`, and not a number or an array of them.
    Raises a `ValueError` if it is neither."""
    if jnp.shape(g) in ((), jnp.shape(x)):
        return False
    if jnp.shape(g) != jnp.shape(x) * 2:
        raise ValueError(
            "An array of `friction` must be a scalar, or have the shape of its momenta, "
            f"{jnp.shape(x)}, or as a matrix the shape {jnp.shape(x) * 2}; got shape "
            f"{jnp.shape(g)}."
        )
    return True


def _for_each(name: str, value: PyTree, p: _P) -> PyTree:
    """`value` in the structure of the momenta."""
    if jtu.all_leaves([value], is_leaf=_is_square):
        return jtu.tree_map(lambda _: value, p)
    if jtu.tree_structure(value, is_leaf=_is_square) != jtu.tree_structure(p):
        raise ValueError(
            f"`{name}` must be one number or array, or have the structure of the momenta "
            f"{eqx.tree_pformat(p)}; got {eqx.tree_pformat(value)}."
        )
    return value


def _single_temperature(T: PyTree) -> ArrayLike:
    if not jtu.all_leaves([T]) or jnp.shape(T) != ():
        raise ValueError(
            "`temperature` must be one number for friction by a matrix or along "
            f"directions; got shape {shapes(T)}."
        )
    return T


def not_negative(g: Array) -> Array:
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(g >= 0, g, jnp.nan)


def like(x: ArrayLike, y: Array) -> Array:
    return jnp.asarray(x, jnp.result_type(y))


def _is_square(x: Any) -> bool:
    return isinstance(x, _Square)


def checked_friction(friction: Any, struct: PyTree | None) -> Any:
    """The friction with the roots of constant matrices, for a path of this shape, if there
    is one. Raises a `ValueError` if it is known to be invalid."""
    if isinstance(friction, FrictionAlong):
        if callable(friction.directions):
            check_takes("directions", friction.directions, "t", "q", "args")
        return jtu.tree_map(lambda x: x if callable(x) else jnp.asarray(x), friction)
    if callable(friction):
        check_takes("friction", friction, "t", "q", "args")
        return friction
    if len(jtu.tree_leaves(friction)) == 0:
        raise ValueError(
            "`friction` must be a number, an array, a PyTree of arrays, a `FrictionAlong`, "
            f"or a function `(t, q, args)`; got {friction!r}."
        )
    if struct is None:
        return jtu.tree_map(lambda g: _checked_array(g, None), friction)
    each = jtu.tree_map(lambda s: jnp.zeros(s.shape), struct)
    one = jtu.all_leaves([friction])
    if one and len({x.shape for x in jtu.tree_leaves(each)}) == 1:
        return _checked_array(friction, jtu.tree_leaves(each)[0])
    if one:
        return _checked_array(friction, None)
    return jtu.tree_map(_checked_array, _for_each("friction", friction, each), each)


def _checked_array(g: ArrayLike, x: Array | None) -> Array | _Square:
    """Of the friction of the momenta `x`, if their shape is known."""
    shape = jnp.shape(g)
    half = len(shape) // 2
    may_be_matrix = half > 0 and shape == shape[:half] * 2
    is_matrix = x is not None and _is_matrix(g, x)
    kind = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"
    if not may_be_matrix:
        return jnp.asarray(real_array("friction", g, positive=False, kind=kind))
    root = _root(jnp.asarray(g, jnp.result_type(g, float)))
    is_semidefinite = ~jnp.any(jnp.isnan(root))
    square = _Square(jnp.asarray(g), is_semidefinite, root)
    if isinstance(is_semidefinite, jax.core.Tracer):
        return square
    if not is_semidefinite and (is_matrix or not np.all(np.asarray(g) >= 0)):
        raise ValueError(
            "`friction` must be a symmetric positive semidefinite matrix, or an array of "
            f"numbers that are not negative, one for each momentum; got {g!r}."
        )
    return square


def checked_temperature(temperature: Any) -> Any:
    if callable(temperature):
        check_takes("temperature", temperature, "t", "q", "args")
        return temperature
    kind = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"
    checked = lambda T: jnp.asarray(
        real_array("temperature", T, positive=False, kind=kind)
    )
    return jtu.tree_map(checked, temperature)


# Traced and compiled once for each shape.
@jax.jit
def _root(matrix: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""$L$ with $L L^\top$ equal to a symmetric positive semidefinite matrix: its Cholesky
    factor, with zero columns where the matrix is singular. NaN if it is no such matrix.

    A column is zero if its pivot is a rounding error, whose root would be far larger than
    one: a friction between particles would then change their total momentum.
    """
    n = round(matrix.size**0.5)
    A = matrix.reshape(n, n)
    eps = jnp.finfo(A.dtype).eps
    diagonal = jnp.diag(A)
    # Of a pivot, which is a difference of numbers up to the entry of the diagonal.
    rounding = 10 * n * eps * diagonal
    # No entry of what is left of a semidefinite matrix without its tiny pivots is larger.
    size = jnp.sqrt(jnp.maximum(diagonal, 0))
    most = 10 * (n * eps) ** 0.5 * size[:, None] * size

    def column(j, carry):
        left, root, is_valid = carry
        pivot = left[j, j]
        used = pivot > rounding[j]
        below = left[:, j] / jnp.sqrt(jnp.where(used, pivot, 1))
        below = jnp.where(used & (jnp.arange(n) >= j), below, 0)
        left = left - below[:, None] * below
        is_valid = is_valid & (pivot >= -rounding[j])
        return left, root.at[:, j].set(below), is_valid

    begin = A, jnp.zeros_like(A), _is_symmetric(A) & jnp.all(jnp.isfinite(A))
    left, root, is_valid = jax.lax.fori_loop(0, n, column, begin, unroll=n <= 16)
    is_valid = is_valid & jnp.all(jnp.abs(left) <= most)
    return jnp.where(is_valid, root, jnp.nan).reshape(matrix.shape)


def _is_symmetric(matrix: Float[Array, "n n"]) -> Bool[Array, ""]:
    size = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    return jnp.max(jnp.abs(matrix - matrix.T)) <= size
