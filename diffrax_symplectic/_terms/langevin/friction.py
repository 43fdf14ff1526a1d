"""The forms of friction, a number, an array, a matrix or directions, and its root in the
noise of a temperature."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..._arguments import check_takes, real_array, shapes
from ..._compat import is_traced
from ..._custom_types import Args, BM, RealScalarLike
from ..evaluation import call_user_function


_P = PyTree[Array]
# A friction or a temperature, constant or a function.
Value = PyTree[ArrayLike] | Callable[[RealScalarLike, _P, Args], PyTree[ArrayLike]]

_KIND = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"


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


class _MatrixOrNumbers(eqx.Module):
    """A constant array that may be a matrix: whether it is one depends on the shape of its
    momenta, which may be known only in the solve.

    - `value`: the array.
    - `is_semidefinite`: whether it is symmetric positive semidefinite, as a matrix.
    - `root`: its root as a matrix, computed once and not in every step.
    """

    value: Array
    is_semidefinite: Bool[Array, ""]
    root: Array


def value_at(name: str, value: Any, t, q: _P, args: Args) -> PyTree:
    """A constant, or the value of a function."""
    return (
        call_user_function(name, value, t, q, args=args) if callable(value) else value
    )


def product_with(friction: Any, t, q: _P, args: Args, velocity: _P) -> _P:
    """`G v`."""
    if isinstance(friction, FrictionAlong):
        # The speed along each direction first: a matrix would cost more.
        columns = _columns(friction, t, q, args)
        speeds = jtu.tree_leaves(jtu.tree_map(_speeds_along, columns, velocity))
        return jtu.tree_map(lambda d: d @ sum(speeds), columns)
    value = _for_each("friction", value_at("friction", friction, t, q, args), q)
    return jtu.tree_map(_product, value, velocity, is_leaf=_is_matrix_or_numbers)


def _speeds_along(directions: Array, v: Array) -> Array:
    """The scalar product of each direction, along the last axis, with the velocity."""
    return jnp.tensordot(v, directions, jnp.ndim(v))


def _product(g: Any, v: Array) -> Array:
    """`G v` for the velocities of one array."""
    value = g.value if isinstance(g, _MatrixOrNumbers) else g
    if not _is_matrix(value, jnp.shape(v)):
        return not_negative(like(value, v)) * v
    force = jnp.tensordot(like(value, v), v, jnp.ndim(v))
    if not isinstance(g, _MatrixOrNumbers):
        # Whether the value of a function is semidefinite is seen when its root is taken.
        return force
    return jnp.where(g.is_semidefinite, force, jnp.nan)


def root_product_with(
    friction: Any, T: PyTree, t, q: _P, args: Args, control: BM
) -> _P:
    """`B W`, with `B B^T = 2 T G`."""
    if isinstance(friction, FrictionAlong):
        columns = _columns(friction, t, q, args)
        return _noise_along(columns, _single_temperature(T), control)
    same_structure = jtu.tree_structure(control) == jtu.tree_structure(q)
    if not same_structure or _shapes_of(control) != _shapes_of(q):
        raise ValueError(
            f"The `path` of `langevin_terms` must have the shape of `q`, {shapes(q)}; got "
            f"shape {shapes(control)}."
        )
    value = _for_each("friction", value_at("friction", friction, t, q, args), q)
    heat = _for_each("temperature", T, q)
    return jtu.tree_map(
        _noise_of, value, heat, control, q, is_leaf=_is_matrix_or_numbers
    )


def _shapes_of(tree: PyTree) -> list[tuple[int, ...]]:
    return [jnp.shape(leaf) for leaf in jtu.tree_leaves(tree)]


def _noise_of(g: Any, T: ArrayLike, w: Array, x: Array) -> Array:
    """The noise `w` of the momenta of one array, in the shape of `x`."""
    w = like(w, x)
    matrix = g.value if isinstance(g, _MatrixOrNumbers) else g
    if _is_matrix(matrix, jnp.shape(x)):
        scale = _root(2 * like(_single_temperature(T), x))
        root = (
            g.root if isinstance(g, _MatrixOrNumbers) else semidefinite_root(like(g, x))
        )
        return scale * jnp.tensordot(like(root, x), w, jnp.ndim(w))
    if jnp.shape(T) not in ((), jnp.shape(x)):
        raise ValueError(
            "An array of `temperature` must be a scalar, or have the shape of its momenta, "
            f"{jnp.shape(x)}; got shape {jnp.shape(T)}."
            f"{_broadcast_advice('temperature', jnp.shape(T), jnp.shape(x))}"
        )
    # Where either is negative, NaN makes the path fail.
    return _root(like(matrix, x)) * _root(2 * like(T, x)) * w


def _noise_along(columns: _P, T: ArrayLike, control: BM) -> _P:
    """The noise with one increment for each direction: no root is taken."""
    flat, _ = jfu.ravel_pytree(control)
    number = jnp.shape(jtu.tree_leaves(columns)[0])[-1:]
    if number != flat.shape:
        raise ValueError(
            "The `path` of `langevin_terms` must have one noise for each direction of the "
            f"friction, shape {number}; got shape {shapes(control)}."
        )

    def kick(directions: Array) -> Array:
        scale = _root(2 * like(T, directions))
        return directions @ (scale * like(flat, directions))

    return jtu.tree_map(kick, columns)


def _columns(friction: FrictionAlong, t, q: _P, args: Args) -> _P:
    """The directions for each array of the momenta, with a trailing axis of noises."""
    columns = value_at("directions", friction.directions, t, q, args)
    columns = _for_each("directions", columns, q)
    given = _shapes_of(columns)
    # All arrays have the same directions, so their last axes agree.
    one_number = len({shape[-1:] for shape in given}) == 1
    fit = [
        len(shape) > 0 and shape[:-1] == momenta
        for shape, momenta in zip(given, _shapes_of(q))
    ]
    if not one_number or not all(fit):
        raise ValueError(
            "`directions` of `FrictionAlong` must have the shape of the momenta and one "
            f"more axis, for the noises; got shape {shapes(columns)} for momenta of shape "
            f"{shapes(q)}."
        )
    return jtu.tree_map(like, columns, q)


def _is_matrix(g: ArrayLike, momenta: tuple[int, ...]) -> bool:
    """Whether this is a matrix for momenta of this shape, and not a number or an array of
    them. Raises a `ValueError` if it is neither."""
    if jnp.shape(g) in ((), momenta):
        return False
    if jnp.shape(g) != momenta * 2:
        raise ValueError(
            "An array of `friction` must be a scalar, or have the shape of its momenta, "
            f"{momenta}, or as a matrix the shape {momenta * 2}; got shape {jnp.shape(g)}."
            f"{_broadcast_advice('friction', jnp.shape(g), momenta)}"
        )
    return True


def _broadcast_advice(
    name: str, shape: tuple[int, ...], momenta: tuple[int, ...]
) -> str:
    """What to pass instead of an array of this shape if NumPy would broadcast it, which is
    not done here: the shape of a matrix and that of momenta could not be told apart."""
    if not _broadcasts(shape, momenta):
        return ""
    return f" To repeat it along an axis, pass `{name} * jnp.ones({momenta})`."


def _broadcasts(shape: tuple[int, ...], momenta: tuple[int, ...]) -> bool:
    """Whether NumPy would repeat an array of this shape to that of the momenta."""
    try:
        return np.broadcast_shapes(shape, momenta) == momenta
    except ValueError:
        return False


def _check_fits_path(g: ArrayLike, path: tuple[int, ...]) -> None:
    """Raises a `ValueError` if an array of friction and a path of this shape belong to
    momenta of different shapes. Before the solve it is not known which of them is wrong."""
    shape = jnp.shape(g)
    # Where broadcasting was meant, the path is right.
    if shape in ((), path, path * 2) or _broadcasts(shape, path):
        return
    half = len(shape) // 2
    momenta = shape[:half] if shape == shape[:half] * 2 else shape
    raise ValueError(
        "`friction` and the `path` of `langevin_terms` must be those of the same momenta; "
        f"got friction of shape {shape} and a path of shape {path}. For momenta of shape "
        f"{momenta} pass a path of shape {momenta}, one noise for each momentum. For "
        f"momenta of shape {path} pass friction of that shape, or a matrix of shape "
        f"{path * 2}."
    )


def _for_each(name: str, value: PyTree, p: _P) -> PyTree:
    """`value` in the structure of the momenta: one that is given once is that of each."""
    if jtu.all_leaves([value], is_leaf=_is_matrix_or_numbers):
        return jtu.tree_map(lambda _: value, p)
    if jtu.tree_structure(value, is_leaf=_is_matrix_or_numbers) != jtu.tree_structure(
        p
    ):
        is_list = isinstance(value, list | tuple)
        instead = (
            f" For an array pass `jnp.array({name})`, not a list." if is_list else ""
        )
        raise ValueError(
            f"`{name}` must be one number or array, or have the structure of the momenta "
            f"{eqx.tree_pformat(p)}; got {eqx.tree_pformat(value)}.{instead}"
        )
    return value


def _single_temperature(T: PyTree) -> ArrayLike:
    """Raises a `ValueError` unless this is one number. (With several, friction that mixes
    momenta has no stationary density that is known.)"""
    if not jtu.all_leaves([T]) or jnp.shape(T) != ():
        raise ValueError(
            "`temperature` must be one number for friction by a matrix or along "
            f"directions; got shape {shapes(T)}."
        )
    return T


def not_negative(g: Array) -> Array:
    """`g`, or NaN where it is negative."""
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(g >= 0, g, jnp.nan)


def _root(x: Array) -> Array:
    """The square root, with the derivative zero at zero, and NaN of negative numbers.

    A friction or temperature that is zero in a part of space, or for some momenta, stays
    zero along most directions. The infinite derivative of `jnp.sqrt`, times zero, would
    make the derivatives along these NaN.
    """
    positive = x > 0
    root = jnp.sqrt(jnp.where(positive, x, 1))
    # Zero itself, and not a part of `x`, which would hand its derivative on.
    return jnp.where(positive, root, jnp.where(x == 0, 0.0, jnp.nan).astype(x.dtype))


def like(x: ArrayLike, y: Array) -> Array:
    """`x` in the precision of `y`."""
    return jnp.asarray(x, jnp.result_type(y))


def _is_matrix_or_numbers(x: Any) -> bool:
    return isinstance(x, _MatrixOrNumbers)


def checked_friction(friction: Any, struct: PyTree | None) -> Any:
    """The friction with the roots of constant matrices, for a path of this shape, if there
    is one. Raises a `ValueError` if it is known to be invalid."""
    if isinstance(friction, FrictionAlong):
        if callable(friction.directions):
            check_takes("directions", friction.directions, "t", "q", "args")
        return jtu.tree_map(_as_array_or_function, friction)
    if callable(friction):
        check_takes("friction", friction, "t", "q", "args")
        return friction
    if len(jtu.tree_leaves(friction)) == 0:
        raise ValueError(
            "`friction` must be a number, an array, a PyTree of arrays, a `FrictionAlong`, "
            f"or a function `(t, q, args)`; got {friction!r}."
        )
    if jtu.all_leaves([friction]) or struct is None:
        # One for all momenta, whose shape is known if all have the same.
        known = {leaf.shape for leaf in jtu.tree_leaves(struct)}
        shape = known.pop() if len(known) == 1 else None
        return jtu.tree_map(lambda g: _checked_array(g, shape), friction)
    momenta = jtu.tree_map(lambda leaf: jnp.zeros(leaf.shape), struct)
    each = _for_each("friction", friction, momenta)
    return jtu.tree_map(lambda g, p: _checked_array(g, jnp.shape(p)), each, momenta)


def _as_array_or_function(x: Any) -> Any:
    return x if callable(x) else jnp.asarray(x)


def _checked_array(
    g: ArrayLike, momenta: tuple[int, ...] | None
) -> Array | _MatrixOrNumbers:
    """The friction of an array of momenta, of this shape if it is known, from that of the
    path. Raises a `ValueError` if it is known to be invalid."""
    shape = jnp.shape(g)
    # A matrix has the shape of its momenta twice.
    half = len(shape) // 2
    may_be_matrix = half > 0 and shape == shape[:half] * 2
    if momenta is not None:
        _check_fits_path(g, momenta)
    is_matrix = momenta is not None and _is_matrix(g, momenta)
    if not may_be_matrix:
        return jnp.asarray(real_array("friction", g, kind=_KIND))
    root = semidefinite_root(jnp.asarray(g, jnp.result_type(g, float)))
    is_semidefinite = ~jnp.any(jnp.isnan(root))
    either = _MatrixOrNumbers(jnp.asarray(g), is_semidefinite, root)
    if is_traced(is_semidefinite):
        return either
    # Without the shape of the momenta it may be numbers that are valid as they are.
    if not is_semidefinite and (is_matrix or not np.all(np.asarray(g) >= 0)):
        raise ValueError(
            "`friction` must be a symmetric positive semidefinite matrix, or an array of "
            f"numbers that are not negative, one for each momentum; got {g!r}."
        )
    return either


def checked_temperature(temperature: Any) -> Any:
    """The temperature, in arrays. Raises a `ValueError` if it is known to be invalid."""
    if callable(temperature):
        check_takes("temperature", temperature, "t", "q", "args")
        return temperature

    def checked(T: ArrayLike) -> Array:
        return jnp.asarray(real_array("temperature", T, kind=_KIND))

    return jtu.tree_map(checked, temperature)


# Traced and compiled once for each shape.
@jax.jit
def semidefinite_root(matrix: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""$L$ with $L L^\top$ equal to a symmetric positive semidefinite matrix: its Cholesky
    factor, with zero columns where the matrix is singular. NaN if it is no such matrix.

    A column is zero if its pivot is a rounding error, whose root would be far larger than
    one: a friction between particles would then change their total momentum.
    """
    n = round(matrix.size**0.5)
    square = matrix.reshape(n, n)
    eps = jnp.finfo(square.dtype).eps
    diagonal = jnp.diag(square)
    # The error of a pivot, a difference of numbers up to the entry of the diagonal.
    rounding = 10 * n * eps * diagonal
    # No entry of what is left of a semidefinite matrix without its tiny pivots is larger.
    size = jnp.sqrt(jnp.maximum(diagonal, 0))
    most = 10 * (n * eps) ** 0.5 * size[:, None] * size

    def column(j: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        """The next column of the root; what is left of the matrix without it."""
        left, root, is_valid = carry
        pivot = left[j, j]
        used = pivot > rounding[j]
        below = left[:, j] / jnp.sqrt(jnp.where(used, pivot, 1))
        below = jnp.where(used & (jnp.arange(n) >= j), below, 0)
        left = left - below[:, None] * below
        is_valid = is_valid & (pivot >= -rounding[j])
        return left, root.at[:, j].set(below), is_valid

    is_valid = _is_symmetric(square) & jnp.all(jnp.isfinite(square))
    begin = (square, jnp.zeros_like(square), is_valid)
    # Unrolled for all matrices that the fused engine solves with: it takes no column whose
    # number is known only when it runs.
    left, root, is_valid = jax.lax.fori_loop(0, n, column, begin, unroll=n <= 16)
    is_valid = is_valid & jnp.all(jnp.abs(left) <= most)
    return jnp.where(is_valid, root, jnp.nan).reshape(matrix.shape)


def _is_symmetric(matrix: Float[Array, "n n"]) -> Bool[Array, ""]:
    size = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    return jnp.max(jnp.abs(matrix - matrix.T)) <= size
