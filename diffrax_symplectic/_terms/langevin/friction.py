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

from ..._arguments import check_takes, checked_not_negative, shapes
from ..._compat import is_traced
from ..._custom_types import Args, BM, RealScalarLike
from ..callers import AbstractCaller
from ..evaluation import call_user_function


# Momenta, velocities or positions: one array, or a PyTree of arrays.
_Momenta = PyTree[Array]
# A friction or a temperature, constant or a function.
Value = (
    PyTree[ArrayLike] | Callable[[RealScalarLike, _Momenta, Args], PyTree[ArrayLike]]
)

_EXPECTED = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"


class FrictionAlong(AbstractCaller):
    r"""Friction along given directions, for [`diffrax_symplectic.langevin_terms`][]:
    $G = \sum_k d_k d_k^\top$.

    For friction between pairs of particles, each pair has a direction, which is opposite
    for the two of them. The noise is $\sqrt{2 T} \sum_k d_k\,\mathrm{d}w_k$, so that no
    root of a matrix is taken, and both conserve the total momentum.
    """

    directions: Value

    def called_with(self, t, y, args):
        _, q = y
        return {"directions": (t, q, args)}


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


def value_at(name: str, value: Any, t, q: _Momenta, args: Args) -> PyTree:
    """The user's friction, temperature or directions, called `name` in messages: a
    constant, or the value of a function."""
    return (
        call_user_function(name, value, t, q, args=args) if callable(value) else value
    )


def product_with(
    friction: Any, t, q: _Momenta, args: Args, velocity: _Momenta
) -> _Momenta:
    """`G v`."""
    if isinstance(friction, FrictionAlong):
        # Products with the directions cost less than one with a matrix. Each array of
        # momenta adds its part to the speeds along the directions.
        columns = _checked_columns(friction, t, q, args)
        parts = jtu.tree_leaves(jtu.tree_map(_speeds_along, columns, velocity))
        return jtu.tree_map(lambda directions: directions @ sum(parts), columns)
    value = _value_for_each("friction", value_at("friction", friction, t, q, args), q)
    return jtu.tree_map(_product, value, velocity, is_leaf=_may_be_matrix)


def _speeds_along(directions: Array, v: Array) -> Array:
    """The scalar product of each direction with the velocity; the last axis of `directions`
    numbers them."""
    return jnp.tensordot(v, directions, axes=jnp.ndim(v))


def _product(friction: Any, v: Array) -> Array:
    """`G v` for the velocities of one array."""
    value = friction.value if isinstance(friction, _MatrixOrNumbers) else friction
    if not _is_matrix(value, jnp.shape(v)):
        return not_negative(in_precision_of(value, v)) * v
    force = jnp.tensordot(in_precision_of(value, v), v, axes=jnp.ndim(v))
    if not isinstance(friction, _MatrixOrNumbers):
        # Whether the value of a function is semidefinite is seen when its root is taken.
        return force
    return jnp.where(friction.is_semidefinite, force, jnp.nan)


def root_product_with(
    friction: Any, T: PyTree, t, q: _Momenta, args: Args, control: BM
) -> _Momenta:
    """`B W` for the increments `W = control`, with `B B^T = 2 T G`. Raises a `ValueError`
    if their shapes do not fit the friction or the momenta."""
    if isinstance(friction, FrictionAlong):
        columns = _checked_columns(friction, t, q, args)
        return _noise_along(columns, _checked_single_temperature(T), control)
    same_structure = jtu.tree_structure(control) == jtu.tree_structure(q)
    if not same_structure or _shapes_of(control) != _shapes_of(q):
        raise ValueError(
            f"The `path` of `langevin_terms` must have the shape of `q`, {shapes(q)}; got "
            f"shape {shapes(control)}."
        )
    value = _value_for_each("friction", value_at("friction", friction, t, q, args), q)
    temperature = _value_for_each("temperature", T, q)
    return jtu.tree_map(
        _noise_of, value, temperature, control, q, is_leaf=_may_be_matrix
    )


def _shapes_of(tree: PyTree) -> list[tuple[int, ...]]:
    return [jnp.shape(leaf) for leaf in jtu.tree_leaves(tree)]


def _noise_of(friction: Any, T: ArrayLike, w: Array, x: Array) -> Array:
    """`B W` for the momenta of one array, in the shape of the positions `x`, with their
    friction, temperature and increments `w`."""
    w = in_precision_of(w, x)
    has_root = isinstance(friction, _MatrixOrNumbers)
    value = friction.value if has_root else friction
    if _is_matrix(value, jnp.shape(x)):
        scale = _root(2 * in_precision_of(_checked_single_temperature(T), x))
        if has_root:
            root = friction.root
        else:
            root = semidefinite_root(in_precision_of(value, x))
        return scale * jnp.tensordot(in_precision_of(root, x), w, axes=jnp.ndim(w))
    if jnp.shape(T) not in ((), jnp.shape(x)):
        raise ValueError(
            "An array of `temperature` must be a scalar, or have the shape of its momenta, "
            f"{jnp.shape(x)}; got shape {jnp.shape(T)}."
            f"{_broadcast_advice('temperature', jnp.shape(T), jnp.shape(x))}"
        )
    # Where either is negative, NaN makes the path fail.
    return _root(in_precision_of(value, x)) * _root(2 * in_precision_of(T, x)) * w


def _noise_along(columns: _Momenta, T: ArrayLike, control: BM) -> _Momenta:
    """`sqrt(2 T) sum_k d_k W_k`, with one increment for each direction. Raises a
    `ValueError` if the path has another number of noises."""
    flat, _ = jfu.ravel_pytree(control)
    # The shape `(m,)` for `m` directions, which all arrays share.
    noise_shape = jnp.shape(jtu.tree_leaves(columns)[0])[-1:]
    if noise_shape != flat.shape:
        raise ValueError(
            "The `path` of `langevin_terms` must have one noise for each direction of the "
            f"friction, shape {noise_shape}; got shape {shapes(control)}."
        )

    def kick(directions: Array) -> Array:
        scale = _root(2 * in_precision_of(T, directions))
        return directions @ (scale * in_precision_of(flat, directions))

    return jtu.tree_map(kick, columns)


def _checked_columns(friction: FrictionAlong, t, q: _Momenta, args: Args) -> _Momenta:
    """The directions for each array of the momenta, with a trailing axis of noises. Raises
    a `ValueError` if their shapes do not fit the momenta."""
    columns = value_at("directions", friction.directions, t, q, args)
    columns = _value_for_each("directions", columns, q)
    column_shapes = _shapes_of(columns)
    # All arrays have the same directions, so their last axes agree.
    has_one_number = len({shape[-1:] for shape in column_shapes}) == 1
    pairs = zip(column_shapes, _shapes_of(q))
    fits_momenta = all(
        len(shape) > 0 and shape[:-1] == momenta_shape for shape, momenta_shape in pairs
    )
    if not has_one_number or not fits_momenta:
        raise ValueError(
            "`directions` of `FrictionAlong` must have the shape of the momenta and one "
            f"more axis, for the noises; got shape {shapes(columns)} for momenta of shape "
            f"{shapes(q)}."
        )
    return jtu.tree_map(in_precision_of, columns, q)


def _is_matrix(value: ArrayLike, momenta_shape: tuple[int, ...]) -> bool:
    """Whether this is a matrix for momenta of this shape, and not a number or an array of
    them. Raises a `ValueError` if it is neither."""
    if jnp.shape(value) in ((), momenta_shape):
        return False
    if jnp.shape(value) != momenta_shape * 2:
        raise ValueError(
            "An array of `friction` must be a scalar, or have the shape of its momenta, "
            f"{momenta_shape}, or as a matrix the shape {momenta_shape * 2}; got shape "
            f"{jnp.shape(value)}."
            f"{_broadcast_advice('friction', jnp.shape(value), momenta_shape)}"
        )
    return True


def _broadcast_advice(
    name: str, shape: tuple[int, ...], momenta_shape: tuple[int, ...]
) -> str:
    """What to pass instead of an array of this shape if NumPy would broadcast it, which is
    not done here: the shape of a matrix and that of momenta could not be told apart. Also
    if it has one value for each particle, the first axis of the momenta."""
    advice = ""
    if len(momenta_shape) > 1 and shape == momenta_shape[:1]:
        axes = ", ".join([":"] + ["None"] * (len(momenta_shape) - 1))
        advice += (
            " If it has one value for each particle, pass "
            f"`{name}[{axes}] * jnp.ones({momenta_shape})`."
        )
    if _broadcasts(shape, momenta_shape):
        advice += (
            f" To repeat it along an axis, pass `{name} * jnp.ones({momenta_shape})`."
        )
    return advice


def _broadcasts(shape: tuple[int, ...], momenta_shape: tuple[int, ...]) -> bool:
    """Whether NumPy would repeat an array of this shape to that of the momenta."""
    try:
        return np.broadcast_shapes(shape, momenta_shape) == momenta_shape
    except ValueError:
        return False


def _check_fits_path(friction: ArrayLike, path_shape: tuple[int, ...]) -> None:
    """Raises a `ValueError` if an array of friction and a path of this shape belong to
    momenta of different shapes. Before the solve it is not known which of them is wrong."""
    shape = jnp.shape(friction)
    # An array that NumPy would broadcast is wrong by itself, and the path is right.
    if shape in ((), path_shape, path_shape * 2) or _broadcasts(shape, path_shape):
        return
    # A matrix has the shape of its momenta twice.
    half = shape[: len(shape) // 2]
    momenta_shape = half if shape == half * 2 else shape
    raise ValueError(
        "`friction` and the `path` of `langevin_terms` must be those of the same momenta; "
        f"got friction of shape {shape} and a path of shape {path_shape}. For momenta of "
        f"shape {momenta_shape} pass a path of shape {momenta_shape}, one noise for each "
        f"momentum. For momenta of shape {path_shape} pass friction of that shape, or a "
        f"matrix of shape {path_shape * 2}."
        f"{_broadcast_advice('friction', shape, path_shape)}"
    )


def _value_for_each(name: str, value: PyTree, p: _Momenta) -> PyTree:
    """The user's argument `name`, a value for each array of momenta, in the structure of
    the momenta `p`: a single value is that of each array. Raises a `ValueError` if it has
    another structure."""
    if jtu.all_leaves([value], is_leaf=_may_be_matrix):
        return jtu.tree_map(lambda _: value, p)
    if jtu.tree_structure(value, is_leaf=_may_be_matrix) != jtu.tree_structure(p):
        # The momenta may be given by their shapes.
        momenta = eqx.tree_pformat(p, struct_as_array=True)
        advice = ""
        if isinstance(value, list | tuple):
            advice = f" For an array pass `jnp.array({name})`, not a list."
        raise ValueError(
            f"`{name}` must be one number or array, or have the structure of the momenta "
            f"{momenta}; got {eqx.tree_pformat(value)}.{advice}"
        )
    return value


def _checked_single_temperature(T: PyTree) -> ArrayLike:
    """The temperature. Raises a `ValueError` unless it is one number. (With several,
    friction that mixes momenta has no stationary density that is known.)"""
    if not jtu.all_leaves([T]) or jnp.shape(T) != ():
        raise ValueError(
            "`temperature` must be one number for friction by a matrix or along "
            f"directions; got shape {shapes(T)}."
        )
    return T


def not_negative(friction: Array) -> Array:
    """The friction, or NaN where it is negative."""
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(friction >= 0, friction, jnp.nan)


def _root(x: Array) -> Array:
    """The square root, with the derivative zero at zero, and NaN of negative numbers.

    A friction or temperature that is zero in a part of space, or for some momenta, stays
    zero along most directions. The infinite derivative of `jnp.sqrt`, times zero, would
    make the derivatives along these NaN.
    """
    positive = x > 0
    root = jnp.sqrt(jnp.where(positive, x, 1))
    # At zero the result is a constant, and not `x`, which would hand its derivative on.
    return jnp.where(positive, root, jnp.where(x == 0, 0.0, jnp.nan).astype(x.dtype))


def in_precision_of(x: ArrayLike, other: Array) -> Array:
    """`x` in the precision of `other`."""
    return jnp.asarray(x, jnp.result_type(other))


def _may_be_matrix(x: Any) -> bool:
    return isinstance(x, _MatrixOrNumbers)


def checked_friction(
    friction: Any, path_struct: PyTree[jax.ShapeDtypeStruct] | None
) -> Any:
    """The friction with the roots of constant matrices, for a path with increments like
    `path_struct`, or without a path. Raises a `ValueError` if it is known to be invalid."""
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
    if path_struct is None:
        # The shapes of the momenta are known in the solve only, so a single value is kept
        # as one for all arrays of momenta.
        return jtu.tree_map(
            lambda value: _checked_friction_of_array(value, None), friction
        )
    if jtu.all_leaves([friction]):
        # One friction for all arrays of momenta, whose shape is known if they share it.
        path_shapes = {leaf.shape for leaf in jtu.tree_leaves(path_struct)}
        momenta_shape = path_shapes.pop() if len(path_shapes) == 1 else None
        return _checked_friction_of_array(friction, momenta_shape)
    # The path has the shapes of the momenta.
    friction_of_each = _value_for_each("friction", friction, path_struct)
    return jtu.tree_map(
        lambda value, leaf: _checked_friction_of_array(value, leaf.shape),
        friction_of_each,
        path_struct,
    )


def _as_array_or_function(x: Any) -> Any:
    return x if callable(x) else jnp.asarray(x)


def _checked_friction_of_array(
    friction: ArrayLike, momenta_shape: tuple[int, ...] | None
) -> Array | _MatrixOrNumbers:
    """The friction of an array of momenta, whose shape is that of their path, or `None` if
    it is not known. Raises a `ValueError` if the friction is known to be invalid."""
    must_be_matrix = False
    if momenta_shape is not None:
        _check_fits_path(friction, momenta_shape)
        must_be_matrix = _is_matrix(friction, momenta_shape)
    if _has_shape_of_matrix(friction):
        return _checked_matrix_or_numbers(friction, must_be_matrix)
    return jnp.asarray(checked_not_negative("friction", friction, expected=_EXPECTED))


def _has_shape_of_matrix(friction: ArrayLike) -> bool:
    """Whether an array may be a matrix, which has the shape of its momenta twice."""
    shape = jnp.shape(friction)
    half = shape[: len(shape) // 2]
    return len(half) > 0 and shape == half * 2


def _checked_matrix_or_numbers(
    friction: ArrayLike, must_be_matrix: bool
) -> _MatrixOrNumbers:
    """The friction with its root as a matrix. Raises a `ValueError` if its values are known
    to be invalid: for a matrix, or if it need not be one, for numbers, too."""
    root = semidefinite_root(jnp.asarray(friction, jnp.result_type(friction, float)))
    is_semidefinite = ~jnp.any(jnp.isnan(root))
    matrix_or_numbers = _MatrixOrNumbers(jnp.asarray(friction), is_semidefinite, root)
    if is_traced(is_semidefinite):
        return matrix_or_numbers
    # Without the shape of the momenta the array may be valid as numbers.
    may_be_numbers = not must_be_matrix and bool(np.all(np.asarray(friction) >= 0))
    if not is_semidefinite and not may_be_numbers:
        raise ValueError(
            "`friction` must be a symmetric positive semidefinite matrix, or an array of "
            f"numbers that are not negative, one for each momentum; got {friction!r}."
        )
    return matrix_or_numbers


def checked_temperature(temperature: Any) -> Any:
    """The temperature, in arrays. Raises a `ValueError` if it is known to be invalid."""
    if callable(temperature):
        check_takes("temperature", temperature, "t", "q", "args")
        return temperature

    def checked(T: ArrayLike) -> Array:
        return jnp.asarray(checked_not_negative("temperature", T, expected=_EXPECTED))

    return jtu.tree_map(checked, temperature)


# With `jit` this function is traced and compiled once for each shape.
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
    # The error of a pivot, which is a difference of numbers up to the diagonal entry.
    rounding = 10 * n * eps * diagonal
    # If the matrix is semidefinite, no entry of the remainder at the end, when all pivots
    # are tiny, is larger than this.
    size = jnp.sqrt(jnp.maximum(diagonal, 0))
    largest_remainder = 10 * (n * eps) ** 0.5 * size[:, None] * size

    def with_column(j: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        """The remainder of the matrix after column `j` of the root, the root with this
        column, and whether the matrix may still be semidefinite."""
        remainder, root, is_valid = carry
        pivot = remainder[j, j]
        is_used = pivot > rounding[j]
        entries = remainder[:, j] / jnp.sqrt(jnp.where(is_used, pivot, 1))
        entries = jnp.where(is_used & (jnp.arange(n) >= j), entries, 0)
        remainder = remainder - entries[:, None] * entries
        is_valid = is_valid & (pivot >= -rounding[j])
        return remainder, root.at[:, j].set(entries), is_valid

    is_valid = _is_symmetric(square) & jnp.all(jnp.isfinite(square))
    # The remainder, the root and whether the matrix may be semidefinite, before any column.
    carry = (square, jnp.zeros_like(square), is_valid)
    # The loop is unrolled for all matrices that the fused engine solves with: the engine
    # takes no column whose number is known only when it runs.
    carry = jax.lax.fori_loop(0, n, with_column, carry, unroll=n <= 16)
    remainder, root, is_valid = carry
    is_valid = is_valid & jnp.all(jnp.abs(remainder) <= largest_remainder)
    return jnp.where(is_valid, root, jnp.nan).reshape(matrix.shape)


def _is_symmetric(matrix: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Whether a matrix is symmetric up to rounding errors."""
    rounding = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    return jnp.max(jnp.abs(matrix - matrix.T)) <= rounding
